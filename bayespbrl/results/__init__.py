"""Results of studies: tables, figures and intervals from the data that studies leave."""

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
