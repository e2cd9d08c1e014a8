"""Many runs: what a claim about learning rests on."""
