"""Whether an update improved the policy: the newest compared with the best one, by the utility of their trajectories.

An update follows an estimate of Q. Trajectories of the policy after it show what it did, and the posterior, not the
hidden reward, says whether that is better. They are without the policy's noise and start alike for all policies, so
that neither luck nor exploration decides. After a step back the run goes on from the best policy, with smaller updates.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bayespbrl.trajectories import Trajectory
from bayespbrl.utility.estimate import UtilityEstimate

LEAST_TRUST = 0.05
# Shares of the posterior's draws. Decision: a quarter is enough to ask, and three quarters to keep.
CLEARLY, POSSIBLY = 0.75, 0.25
STANDARD_ERRORS = 1.0  # by which the newest policy has to be worse for a step back


@dataclass(frozen=True)
class Check:
    """The result for one iteration.

    Attributes:
      best: number of the best policy so far, that is of the iterations before it.
      trust: share of the KL bound that the next update may use.
      stepped_back: whether the run goes on from the best policy rather than from the newest.
      gain, standard_error: mean difference of the utilities of the trajectories, newest minus best, and its error.
    """

    best: int
    trust: float
    stepped_back: bool = False
    gain: float = 0.0
    standard_error: float = 0.0


def judged(utility: UtilityEstimate, tried: Sequence[Trajectory], *, by_draws: bool = True) -> Float[np.ndarray, "s n"]:
    """Utilities of a policy's n trajectories under each of S posterior draws.

    One row, the utility that is acted on, without a posterior or where it is not to be `by_draws`.
    """
    if by_draws and utility.posterior is not None:
        return utility.trajectory_draws(tried)
    return utility.trajectory_utilities(tried)[None]


def median_differences(newest: Float[np.ndarray, "s n"], best: Float[np.ndarray, "s n"]) -> Float[np.ndarray, " n"]:
    """By how much one policy's trajectories are better than another's from the same starts: of S draws the median.

    Decision: not the mean. Draws have no common scale, and a few of large utilities may turn it against an answer that
    most draws follow (docs/tuning.md).
    """
    return np.asarray(np.median(newest - best, axis=0))


def share_better(newest: Float[np.ndarray, "s n"], best: Float[np.ndarray, "s n"]) -> float:
    """Share of the draws under which one policy's trajectories are better in the mean than another's."""
    return float(np.mean((newest - best).mean(axis=1) > 0))


def checked(differences: Float[np.ndarray, " n"], *, newest: int, best: int, trust: float) -> Check:
    """The check of one update.

    Args:
      differences: utility of each of the newest policy's trajectories minus that of the best one's from the same
        start.
      newest, best: numbers of the iterations of both.
      trust: so far; it is doubled, up to 1, after a step forward and halved after a step back.
    """
    gain, error = float(differences.mean()), float(differences.std(ddof=1) / np.sqrt(len(differences)))
    if gain > 0:
        return Check(newest, min(1.0, 2 * trust), False, gain, error)
    if gain < -STANDARD_ERRORS * error:
        return Check(best, max(LEAST_TRUST, trust / 2), True, gain, error)
    return Check(best, trust, False, gain, error)
