"""A climb over a grid of hyperparameters by the marginal likelihood."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

LEAST_GAIN = 1e-6  # nats; smaller differences of the evidence are rounding
ROUNDS = 2  # how often each axis is gone through at most
Point = tuple[float, ...]


@dataclass(frozen=True)
class HyperparameterSearch:
    """A climb over a grid by the marginal likelihood.

    Attributes:
      points: the settings that were examined, in their order.
      log_evidence: log p(answers | setting) of each by expectation propagation, nats.
      reached: index of the point where the climb ended.
    """

    points: Float[np.ndarray, "c axes"]
    log_evidence: Float[np.ndarray, " c"]
    reached: int

    @property
    def best(self) -> Point:
        """The setting where the climb ended."""
        return tuple(self.points[self.reached].tolist())

    @property
    def weights(self) -> Float[np.ndarray, " c"]:
        """p(setting | answers) of each under a uniform prior; they sum to 1."""
        return np.asarray(np.exp(self.log_evidence - logsumexp(self.log_evidence)))


def search_hyperparameters(
    log_evidence: Callable[[Point], float],
    axes: Sequence[Sequence[float]],
    *,
    start: Sequence[float],
    together: int = 0,
) -> HyperparameterSearch:
    """Climb the marginal likelihood over a grid, one axis at a time (coordinate ascent).

    With five length scales for each of S dimensions the grid has 5^S points, and the climb examines about 5 + 4S.

    Args:
      log_evidence: log p(answers | setting) of a point of the grid, nats, as by `fit_gaussian`.
      axes: the values of each axis, in increasing order.
      start: where to begin; each value must be in its axis.
      together: number of axes at the front, of equal values, that are first moved as one over all their values.

    Returns:
      the points examined, and where the climb ended: at the start, where no neighbour is more likely.

    Raises:
      ValueError: a start that is not on the grid.
    """
    if len(start) != len(axes) or any(value not in axis for value, axis in zip(start, axes, strict=True)):
        raise ValueError(f"start: expected a value of each of {len(axes)} axes, got {tuple(start)}")
    found: dict[Point, float] = {}

    def better(point: Point, best: Point) -> bool:
        for each in (best, point):
            if each not in found:
                found[each] = log_evidence(each)
        return found[point] > found[best] + LEAST_GAIN

    best = tuple(float(value) for value in start)
    better(best, best)
    for value in axes[0] if together else ():
        point = (float(value),) * together + best[together:]
        best = point if better(point, best) else best
    best = _climb(best, axes, better)
    return HyperparameterSearch(
        points=np.array(list(found)).reshape(len(found), -1),
        log_evidence=np.array(list(found.values())),
        reached=list(found).index(best),
    )


def _climb(best: Point, axes: Sequence[Sequence[float]], better: Callable[[Point, Point], bool]) -> Point:
    """Where single steps along the axes lead, each taken only if it is `better`."""
    for _ in range(ROUNDS):
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
    return best
