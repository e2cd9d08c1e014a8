"""Priors of the hyperparameters: steepness, lapse rate and tie threshold, each on a grid.

A grid makes each of their conditional distributions a table, from which a Gibbs move draws exactly. The values are the
medians of cells of equal probability of a continuous prior. All are in units of the margins, whose prior standard
deviation is near 1 once they are normalised (`bayespbrl.utility.comparisons.normalised`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats


class Grid(NamedTuple):
    """A prior on a grid of values; a value that is given has probability 1."""

    values: Float[np.ndarray, " v"]
    probabilities: Float[np.ndarray, " v"]

    @property
    def mean(self) -> float:
        """The mean of the prior."""
        return float(self.values @ self.probabilities)


def _medians(distribution: "stats.rv_frozen", cells: int) -> Float[np.ndarray, " v"]:
    return np.asarray(distribution.ppf((np.arange(cells) + 0.5) / cells))


def _even(values: Float[np.ndarray, " v"]) -> Grid:
    return Grid(values, np.full(len(values), 1 / len(values)))


def given(value: float) -> Grid:
    """The prior of a value that is known."""
    return _even(np.array([float(value)]))


# m: by the sigmoid a margin of one standard deviation is answered rightly with probability 0.73 at the lowest, and
# surely at most; under eq. 8 with probability 1 - 0.27/K at the lowest.
STEEPNESS = _even(_medians(stats.lognorm(s=1.0, scale=5.0), 9))
# λ: half of all answerers are attentive; of the others it is Beta(1, 3), mean a quarter, and above a half in 13 %.
_LAPSES = _medians(stats.beta(1, 3), 12)
LAPSE_RATE = Grid(np.concatenate([[0.0], _LAPSES]), np.concatenate([[0.5], np.full(12, 0.5 / 12)]))
# δ: a tenth of a standard deviation of the margins, give or take a factor of e². Some people call what differs by a
# third of it equal, others only what is exactly equal: an expert who computes returns.
TIE_THRESHOLD = _even(_medians(stats.lognorm(s=2.0, scale=0.1), 12))
# Standard deviation of the margin by which an answerer favours the one shown first.
SIDE_BIAS_SCALE = 0.3
