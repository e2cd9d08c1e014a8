"""Many runs of the same settings, for claims about learning; declared studies of many such rows.

declaration                 the TOML of a study; those that come with the package are in declared/
study                       its directory: a run directory for each cell, and one table
rows, trials                one row of it: a task with one choice of options; the command `trials` is one row
baseline_trials             a trial of a baseline
engine, processes, cluster  cells by any executor: processes of this machine, or a Dask cluster
tables                      what the runs of a row say, a line for each iteration
machine                     on what it ran, and with which source
"""

from bayespbrl.studies.declaration import declared
from bayespbrl.studies.study import Study
from bayespbrl.studies.trials import Trials, run_trials

__all__ = ["Study", "Trials", "declared", "run_trials"]
