"""Which length scale, prior scale and steepness the answers speak for: weights by their log marginal likelihood.

Expectation propagation gives the log evidence log p(answers | candidate) for the price of one Gaussian fit.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from bayespbrl.models.likelihoods import preference_likelihood
from bayespbrl.models.posterior import GaussianFit, fit_gaussian

LEAST_GAIN = 1e-6  # nats; evidence that differs by rounding only says nothing


@dataclass(frozen=True)
class Candidate:
    """One setting to be weighed; `differences` carries its features, and so its length scale.

    Attributes:
      differences: ψ(preferred) − ψ(dominated), shape (K, D), D as this candidate's features have it.
      prior_scale, steepness, lapse_rate, likelihood: as in `sample_posterior`.
      log_prior: log of the weight that the candidate had before the answers, up to a constant.
    """

    differences: np.ndarray
    prior_scale: float = 1.0
    steepness: float = 5.0
    lapse_rate: float = 0.0
    likelihood: str = "mixed"
    log_prior: float = 0.0


@dataclass(frozen=True)
class HyperparameterWeights:
    """What the answers say about the candidates, in their order.

    Attributes:
      weights: posterior probability of each, shape (C,), summing to 1.
      log_evidence: log p(answers | candidate) by expectation propagation, shape (C,).
      converged: whether each fit did, shape (C,) bool.
    """

    weights: np.ndarray
    log_evidence: np.ndarray
    converged: np.ndarray

    @property
    def best(self) -> int:
        """Index of the candidate of highest weight."""
        return int(np.argmax(self.weights))


def fit_candidate(candidate: Candidate) -> GaussianFit:
    """Expectation propagation's Gaussian under this setting, with its log evidence; errors as of `fit_gaussian`."""
    c = candidate
    likelihood = preference_likelihood(
        c.likelihood, steepness=c.steepness, number_of_preferences=len(c.differences), lapse_rate=c.lapse_rate
    )
    return fit_gaussian(c.differences, prior_scale=c.prior_scale, likelihood=likelihood)


def select_hyperparameters(candidates: Sequence[Candidate]) -> HyperparameterWeights:
    """Weigh candidates by p(candidate | answers) ∝ p(answers | candidate) p(candidate).

    All candidates must be about the same answers: the same K.

    Raises:
      ValueError: no candidates, candidates of different K, or an argument out of its range.
    """
    if not candidates:
        raise ValueError("candidates: expected at least one, got none")
    numbers = sorted({len(candidate.differences) for candidate in candidates})
    if len(numbers) > 1:
        raise ValueError(f"candidates: expected the same number of answers K in each, got {numbers}")
    fits = [fit_candidate(candidate) for candidate in candidates]
    log_evidence = np.array([fit.log_evidence for fit in fits])
    log_weights = log_evidence + np.array([candidate.log_prior for candidate in candidates])
    return HyperparameterWeights(
        np.exp(log_weights - logsumexp(log_weights)),
        log_evidence,
        np.array([fit.approximation.converged for fit in fits]),
    )


@dataclass(frozen=True)
class HyperparameterSearch:
    """A climb over a grid by the evidence.

    Attributes:
      points: the settings that were examined, in their order, shape (C, axes).
      weighed: what the answers say about them.
      reached: index of the point where the climb ended.
    """

    points: np.ndarray
    weighed: HyperparameterWeights
    reached: int

    @property
    def best(self) -> tuple[float, ...]:
        """The setting where the climb ended."""
        return tuple(self.points[self.reached].tolist())


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
      ValueError: a start that is not on the grid; else as `select_hyperparameters`.
    """
    if len(start) != len(axes) or any(value not in axis for value, axis in zip(start, axes, strict=True)):
        raise ValueError(f"start: expected a value of each of {len(axes)} axes, got {tuple(start)}")
    found: dict[tuple[float, ...], HyperparameterWeights] = {}

    def weigh(point: tuple[float, ...]) -> float:
        if point not in found:
            found[point] = select_hyperparameters([candidate(point)])
        return float(found[point].log_evidence[0])

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
    log_evidence = np.concatenate([weighed.log_evidence for weighed in found.values()])
    return HyperparameterSearch(
        points=np.array(list(found)).reshape(len(found), -1),
        weighed=HyperparameterWeights(
            np.exp(log_evidence - logsumexp(log_evidence)),
            log_evidence,
            np.concatenate([weighed.converged for weighed in found.values()]),
        ),
        reached=list(found).index(best),
    )
