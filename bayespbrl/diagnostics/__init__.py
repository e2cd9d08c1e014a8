"""What a researcher puts before a reviewer: convergence, calibration, sensitivity, influence, comparison, pictures.

Each result is an xarray `Dataset`; each figure function draws on the matplotlib axes it is given and returns them.

  convergence, chains    R̂, effective sample size, Monte Carlo error, ranks
  predictions            probabilities of answers, by exact refits
  prequential            calibration: each answer predicted before it was used
  comparison             likelihoods against each other, by k-fold refits
  leave_one_out          which answer carries the posterior
  power_scaling          sensitivity to the prior scale and to the likelihood
  uncertainty            draws of returns, rankings, Q and greedy actions
  plots                  figures of a run
  report, report_*       the report: evidence read from the run directory, tables, figures, sections, warnings
"""

from bayespbrl.diagnostics.chains import convergence, plot_convergence, plot_ranks
from bayespbrl.diagnostics.comparison import compare_likelihoods, plot_comparison
from bayespbrl.diagnostics.leave_one_out import influence, plot_influence
from bayespbrl.diagnostics.power_scaling import plot_sensitivity, sensitivity
from bayespbrl.diagnostics.predictions import answer_probabilities
from bayespbrl.diagnostics.prequential import (
    calibration,
    plot_calibration,
    prequential_predictions,
    score_predictions,
)

__all__ = [
    "answer_probabilities",
    "calibration",
    "compare_likelihoods",
    "convergence",
    "influence",
    "plot_calibration",
    "plot_comparison",
    "plot_convergence",
    "plot_influence",
    "plot_ranks",
    "plot_sensitivity",
    "prequential_predictions",
    "score_predictions",
    "sensitivity",
]
