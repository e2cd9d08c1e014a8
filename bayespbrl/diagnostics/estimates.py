"""Helpers for utility estimates: their posterior, and whether they are a utility of states."""

import numpy as np
from xarray import DataTree

from bayespbrl.diagnostics.predictions import PREFERRED, answer_probabilities, if_stated
from bayespbrl.models import Answers
from bayespbrl.models.posterior_tree import answers_of
from bayespbrl.trajectories import Trajectory
from bayespbrl.utility import UtilityEstimate


def expect_posterior(estimate: UtilityEstimate | None) -> tuple[UtilityEstimate, DataTree]:
    """`estimate` and its posterior; `ValueError` where it has none."""
    if estimate is None or estimate.posterior is None:
        raise ValueError(f"estimate: expected a utility estimate with a posterior, got {type(estimate).__name__}")
    return estimate, estimate.posterior


def expect_estimate(estimate: UtilityEstimate | None) -> UtilityEstimate:
    """`estimate`; `ValueError` before there is one."""
    if estimate is None:
        raise ValueError("estimate: expected a utility estimate, got None")
    return estimate


def predicted_answer(
    estimate: UtilityEstimate, first: Trajectory, second: Trajectory, *, answerer: str | None = None
) -> tuple[float, float]:
    """Posterior predictive probability that the first of two trajectories, shown first, is preferred, if either is.

    Args:
      estimate: with a posterior.
      answerer: who is asked, as the posterior names them: "" who gave no name where others did. A name that it does not
        know, or None where it knows names, has the lapse rate of all of them together, and no side bias.

    Returns:
      that, ½ where the model rules out that either is, and the probability that either is preferred: 1 where nobody
      called two equal so far.
    """
    estimate, posterior = expect_posterior(estimate)
    names = answers_of(posterior).names or ()
    who = np.array([answerer]) if answerer in names else None
    answers = Answers(shown_first=np.ones(1, int), answerers=who)
    differences = estimate.differences([first, second])
    predicted, stated = if_stated(answer_probabilities(posterior, differences, answers), np.array([PREFERRED]))
    return float(predicted[0]), float(stated[0])
