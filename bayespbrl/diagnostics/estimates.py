"""What the diagnostics ask of a utility estimate: its posterior, its features, whether it is an average."""

from typing import TypeGuard

from bayespbrl.diagnostics.predictions import PREFERRED, answer_probabilities
from bayespbrl.models.likelihoods import prob
from bayespbrl.trajectories import Trajectory, trajectory_features
from bayespbrl.utility import AveragedUtility, LinearProgramUtility, PosteriorUtility, UtilityEstimate

StateUtility = PosteriorUtility | LinearProgramUtility | AveragedUtility


def sampled(estimate: UtilityEstimate | None) -> PosteriorUtility | None:
    """The setting whose posterior was sampled; None where there is no estimate or no posterior."""
    return None if estimate is None else estimate.sampled


def expect_sampled(estimate: UtilityEstimate | None) -> PosteriorUtility:
    """`sampled`; `ValueError` where that is None."""
    if (found := sampled(estimate)) is None:
        raise ValueError(f"estimate: expected one with a posterior, got {type(estimate).__name__} without")
    return found


def expect_estimate(estimate: UtilityEstimate | None) -> UtilityEstimate:
    """`estimate`; `ValueError` before there is one."""
    if estimate is None:
        raise ValueError("estimate: expected a utility estimate, got none yet")
    return estimate


def is_average(estimate: UtilityEstimate | None) -> TypeGuard[AveragedUtility]:
    """Whether the learner acts on an average over settings, of which `sampled` is one."""
    return isinstance(estimate, AveragedUtility)


def of_states(estimate: UtilityEstimate | None) -> TypeGuard[StateUtility]:
    """Whether it is a utility of states, as every estimate is but the known reward."""
    return isinstance(estimate, StateUtility)


def one_setting(estimate: StateUtility) -> PosteriorUtility | LinearProgramUtility:
    """The estimate itself, linear in features of the state, or the sampled setting of an average."""
    return estimate if isinstance(estimate, LinearProgramUtility) else estimate.sampled


def first_preferred_probability(estimate: UtilityEstimate, first: Trajectory, second: Trajectory) -> float:
    """Posterior predictive probability that the first of two trajectories is preferred; needs a posterior."""
    if is_average(estimate):
        return float(prob(estimate.likelihood, estimate.margin_draws(first, second)).mean())
    fit = expect_sampled(estimate)
    sums = trajectory_features([first, second], fit.features, discount=fit.discount)
    difference = (sums[[0]] - sums[[1]]) / fit.scale
    return float(answer_probabilities(fit.posterior, difference)[0, PREFERRED])
