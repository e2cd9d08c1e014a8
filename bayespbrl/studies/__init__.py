"""Many runs of the same settings, for claims about learning."""

from bayespbrl.studies.trials import Trials, run_trials

__all__ = ["Trials", "run_trials"]
