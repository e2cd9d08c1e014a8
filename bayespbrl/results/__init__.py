"""Results of studies: tables, figures and intervals from the data that studies leave.

study_data   the data of a study: four files
predictions  each answer beside the probability that it was given beforehand
intervals    medians, paired differences, answers needed, failed trials, and their intervals
tables       values, comparisons, runs, what was kept, calibration
figures      learning curves, performance profiles
write        `bayespbrl results`
"""

from bayespbrl.results.study_data import StudyData, read_study
from bayespbrl.results.tables import calibration_table, kept_table, pairs_table, runs_table, values_table
from bayespbrl.results.write import write_results

__all__ = [
    "StudyData",
    "calibration_table",
    "kept_table",
    "pairs_table",
    "read_study",
    "runs_table",
    "values_table",
    "write_results",
]
