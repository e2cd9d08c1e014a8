"""Diagnostics of a posterior and of a run: convergence, calibration, sensitivity, influence, comparison, uncertainty.

Each result is an xarray `Dataset`. Each plot function draws on the matplotlib axes it is given and returns them.

chains             convergence: R̂, effective sample size, Monte Carlo error, rank plots
predictions        posterior predictive probabilities of held-out answers, by exact refits
prequential        calibration: each answer predicted before it was used
predictive_checks  posterior predictive checks: surprises, cycles and ties
gains              calibration of the schedule: was an update a gain as often as it said?
comparison         models compared by k-fold cross-validation
leave_one_out      influence of each answer on the posterior
people             lapse rate, side bias and consistency of each answerer
power_scaling      sensitivity to the prior scale and to the likelihood
uncertainty        posterior draws of returns, rankings, Q and greedy actions
estimates          what all of these ask of a utility estimate
plots              figures of a run and of a study
axes               what figures share: labels, legends, numbered cells
report             the diagnostic report of a run, as one HTML or Markdown file
"""

from bayespbrl.diagnostics.chains import convergence, plot_convergence, plot_ranks
from bayespbrl.diagnostics.comparison import compare_likelihoods, plot_comparison
from bayespbrl.diagnostics.gains import gain_calibration
from bayespbrl.diagnostics.leave_one_out import influence, plot_influence
from bayespbrl.diagnostics.people import people
from bayespbrl.diagnostics.power_scaling import plot_sensitivity, sensitivity
from bayespbrl.diagnostics.predictions import answer_probabilities
from bayespbrl.diagnostics.predictive_checks import predictive_checks
from bayespbrl.diagnostics.prequential import calibration, plot_calibration, prequential_predictions, score_predictions

__all__ = [
    "answer_probabilities",
    "calibration",
    "compare_likelihoods",
    "convergence",
    "gain_calibration",
    "influence",
    "people",
    "plot_calibration",
    "plot_comparison",
    "plot_convergence",
    "plot_influence",
    "plot_ranks",
    "plot_sensitivity",
    "predictive_checks",
    "prequential_predictions",
    "score_predictions",
    "sensitivity",
]
