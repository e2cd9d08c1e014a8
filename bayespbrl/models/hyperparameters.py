"""Which length scale, prior scale and steepness the answers speak for: weights by their log marginal likelihood.

Expectation propagation gives the log evidence log p(answers | candidate) for the price of one Gaussian fit.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from bayespbrl.models.posterior import GaussianFit, fit_gaussian
from bayespbrl.models.preference_model import PreferenceModel

LEAST_GAIN = 1e-6  # nats; evidence that differs by rounding only says nothing


@dataclass(frozen=True)
class Candidate:
    """One setting to be weighed.

    Attributes:
      differences: ψ(preferred) − ψ(dominated), shape (K, D), D as this candidate's features have it; they carry its
        length scales.
      model: prior and likelihood.
    """

    differences: np.ndarray
    model: PreferenceModel

    def fit(self) -> GaussianFit:
        """Expectation propagation's Gaussian under this setting, with its log evidence; errors as of `fit_gaussian`."""
        return fit_gaussian(self.differences, self.model)


@dataclass(frozen=True)
class HyperparameterSearch:
    """A climb over a grid by the marginal likelihood.

    Attributes:
      points: the settings that were examined, in their order, shape (C, axes).
      log_evidence: log p(answers | setting) of each by expectation propagation, shape (C,).
      reached: index of the point where the climb ended.
    """

    points: np.ndarray
    log_evidence: np.ndarray
    reached: int

    @property
    def best(self) -> tuple[float, ...]:
        """The setting where the climb ended."""
        return tuple(self.points[self.reached].tolist())

    @property
    def weights(self) -> np.ndarray:
        """p(setting | answers) of each, all being as likely beforehand, shape (C,), summing to 1."""
        return np.exp(self.log_evidence - logsumexp(self.log_evidence))


def search_hyperparameters(
    candidate: Callable[[tuple[float, ...]], Candidate],
    axes: Sequence[Sequence[float]],
    *,
    start: Sequence[float],
    together: int = 0,
    rounds: int = 2,
) -> HyperparameterSearch:
    """Climb the evidence over a grid, one axis at a time, instead of weighing the whole grid.

    A length scale of its own for each of S dimensions makes a grid of 5^S, of which this examines about 5 + 4S.

    Args:
      candidate: makes the candidate of a point of the grid; its answers must be the same everywhere.
      axes: the values of each axis, in increasing order.
      start: where to begin; each value must be in its axis.
      together: so many axes at the front, of equal values, are first moved as one over all their values.
      rounds: how often each axis is gone through at most.

    Returns:
      the points examined and where it ended: at the start, where the answers speak for nothing else.

    Raises:
      ValueError: a start that is not on the grid; else as `fit_gaussian`.
    """
    if len(start) != len(axes) or any(value not in axis for value, axis in zip(start, axes, strict=True)):
        raise ValueError(f"start: expected a value of each of {len(axes)} axes, got {tuple(start)}")
    found: dict[tuple[float, ...], float] = {}

    def weigh(point: tuple[float, ...]) -> float:
        if point not in found:
            found[point] = float(candidate(point).fit().log_evidence)
        return found[point]

    def better(point: tuple[float, ...], best: tuple[float, ...]) -> bool:
        return weigh(point) > weigh(best) + LEAST_GAIN

    best = tuple(float(value) for value in start)
    weigh(best)
    for value in axes[0] if together else ():
        point = (float(value),) * together + best[together:]
        best = point if better(point, best) else best
    for _ in range(rounds):
        before = best
        for axis, values in enumerate(axes):
            for direction in (-1, 1):
                position = list(values).index(best[axis]) + direction
                while 0 <= position < len(values):
                    point = (*best[:axis], float(values[position]), *best[axis + 1 :])
                    if not better(point, best):
                        break
                    best, position = point, position + direction
        if best == before:
            break
    return HyperparameterSearch(
        points=np.array(list(found)).reshape(len(found), -1),
        log_evidence=np.array(list(found.values())),
        reached=list(found).index(best),
    )
