"""Step 2: from the utility to a better policy."""
