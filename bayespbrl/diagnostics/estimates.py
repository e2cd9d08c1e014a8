"""Helpers for utility estimates: their posterior, and whether they are a utility of states."""

from typing import TypeGuard

import numpy as np

from bayespbrl.diagnostics.predictions import PREFERRED, answer_probabilities
from bayespbrl.models import Answers
from bayespbrl.models.posterior_tree import answers_of
from bayespbrl.trajectories import Trajectory
from bayespbrl.utility import LinearProgramUtility, PosteriorUtility, UtilityEstimate

StateUtility = PosteriorUtility | LinearProgramUtility


def expect_posterior(estimate: UtilityEstimate | None) -> PosteriorUtility:
    """`estimate`; `ValueError` where it has no posterior."""
    if not isinstance(estimate, PosteriorUtility):
        raise ValueError(f"estimate: expected one with a posterior, got {type(estimate).__name__} without")
    return estimate


def expect_estimate(estimate: UtilityEstimate | None) -> UtilityEstimate:
    """`estimate`; `ValueError` before there is one."""
    if estimate is None:
        raise ValueError("estimate: expected a utility estimate, got none yet")
    return estimate


def of_states(estimate: UtilityEstimate | None) -> TypeGuard[StateUtility]:
    """Whether the estimate is a utility of states, as all but the known reward are."""
    return isinstance(estimate, StateUtility)


def number_of_features(estimate: StateUtility) -> int:
    """Number of features D."""
    return int(estimate.weights.shape[-1])


def first_preferred_probability(
    estimate: UtilityEstimate, first: Trajectory, second: Trajectory, *, answerer: str | None = None
) -> float:
    """Posterior predictive probability that the first of two trajectories, which is shown first, is preferred.

    Args:
      estimate: with a posterior.
      answerer: who is asked; a name that the posterior does not know, or None, is any of its answerers.
    """
    posterior = expect_posterior(estimate)
    names = answers_of(posterior.posterior).names or ()
    who = np.array([answerer]) if answerer in names else None
    answers = Answers(shown_first=np.ones(1, int), answerers=who)
    differences = posterior.differences([first, second])
    return float(answer_probabilities(posterior.posterior, differences, answers)[0, PREFERRED])
