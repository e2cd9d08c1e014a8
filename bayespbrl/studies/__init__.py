"""Many runs of the same settings, for claims about learning; declared studies of many such rows."""

from bayespbrl.studies.declaration import declared
from bayespbrl.studies.study import Study
from bayespbrl.studies.trials import Trials, run_trials

__all__ = ["Study", "Trials", "declared", "run_trials"]
