"""Step 1: from preferences to an estimate of the expert's utility."""
