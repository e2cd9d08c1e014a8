"""Hyper-parameters of the Gaussian process policy by CMA-ES after each iteration (paper, experiments).

The objective is the two-fold held-out weighted predictive log-likelihood (specification, section 8), on a random
subsample of bounded size and with few inducing points, so that the cost does not depend on N. The paper's own, the
training-set error, stays as an option: it cannot identify the noise variance, which ends exploration.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from cmaes import CMA

from bayespbrl.kernels import coordinates, inverse_bandwidths, squared_exponential
from bayespbrl.policies.sparse_regression import inducing_rows, precisions, whitened_correlations

Objective = Literal["held-out", "training-error"]
FAILED = 1e10  # the cost of hyper-parameters at which the linear algebra breaks down


@dataclass(frozen=True, eq=False)
class Hyperparameters:
    """Of one output: bandwidths (S,) in the observation's units, variances in the action's units squared."""

    bandwidths: np.ndarray
    signal_variance: float
    noise_variance: float

    @property
    def logarithms(self) -> np.ndarray:
        """log b of the dimensions that are used (b > 0), then log s², log σ²."""
        used = self.bandwidths[self.bandwidths > 0]
        return np.log(np.concatenate([used, [self.signal_variance, self.noise_variance]]))

    def replaced(self, logarithms: np.ndarray) -> "Hyperparameters":
        """The same dimensions with other values, given as `logarithms`."""
        values = np.exp(logarithms)
        bandwidths = np.zeros_like(self.bandwidths)
        bandwidths[self.bandwidths > 0] = values[:-2]
        return Hyperparameters(bandwidths, float(values[-2]), float(values[-1]))


@dataclass(frozen=True, eq=False)
class SearchResult:
    """What CMA-ES found.

    Attributes:
      hyperparameters: the best ones seen, the start included.
      objective: theirs: log-likelihood a unit of weight (nats), or minus the weighted mean squared error.
      start_objective: that of the start, clipped to the bounds.
      evaluations: of the objective.
      at_bound: whether the best noise variance lies on one of its bounds.
    """

    hyperparameters: Hyperparameters
    objective: float
    start_objective: float
    evaluations: int
    at_bound: bool


def search(
    observations: np.ndarray,
    targets: np.ndarray,
    weights: np.ndarray,
    *,
    start: Hyperparameters,
    reference: Hyperparameters,
    minimum_noise_variance: float,
    period: np.ndarray,
    rng: np.random.Generator,
    objective: Objective = "held-out",
    step_size: float = 0.5,
    evaluations: int,
    subsample: int = 800,
    inducing_points: int = 50,
) -> SearchResult:
    """CMA-ES over log b, log s², log σ², from `start`.

    Args:
      observations, targets, weights: xᵢ (N, S), yᵢ and wᵢ > 0 (N,); the targets about their prior mean.
      reference: the median rule's bandwidths b̄ (zero: dimension not used) and the weighted mean square ȳ² of the
        targets in both variances. Bounds: b in [b̄/20, 20 b̄], s² in [ȳ²/1000, 10 ȳ²], σ² in
        [minimum_noise_variance, 2 ȳ²].
      step_size: initial, in the logarithms.
    """
    chosen = rng.choice(len(targets), size=min(subsample, len(targets)), replace=False)
    data = (observations[chosen], targets[chosen], weights[chosen])
    centre = reference.logarithms
    reach = np.full(len(centre), np.log(20.0))
    low, high = centre - reach, centre + reach
    low[-2:] = centre[-2] - np.log(1000.0), np.log(minimum_noise_variance)
    high[-2:] = centre[-2] + np.log(10.0), max(centre[-1] + np.log(2.0), low[-1] + 1e-3)
    first = np.clip(start.logarithms, low, high)
    cost = _cost(data, reference.replaced(first), period=period, rng=rng, objective=objective, number=inducing_points)

    optimiser = CMA(
        mean=first, sigma=step_size, bounds=np.column_stack([low, high]), seed=int(rng.integers(2**31)), lr_adapt=False
    )
    best, best_cost = first, cost(first)
    start_cost, used = best_cost, 1
    while used + optimiser.population_size <= evaluations and not optimiser.should_stop():
        candidates = [optimiser.ask() for _ in range(optimiser.population_size)]
        costs = [cost(candidate) for candidate in candidates]
        used += len(costs)
        optimiser.tell(list(zip(candidates, costs, strict=True)))
        if min(costs) < best_cost:
            best_cost = min(costs)
            best = candidates[int(np.argmin(costs))]
    return SearchResult(
        hyperparameters=reference.replaced(best),
        objective=-best_cost,
        start_objective=-start_cost,
        evaluations=used,
        at_bound=bool(min(best[-1] - low[-1], high[-1] - best[-1]) < 1e-2),
    )


def _cost(
    data: tuple[np.ndarray, np.ndarray, np.ndarray],
    start: Hyperparameters,
    *,
    period: np.ndarray,
    rng: np.random.Generator,
    objective: Objective,
    number: int,
) -> Callable[[np.ndarray], float]:
    """The function of the logarithms that CMA-ES minimises; folds and inducing points are fixed before it starts."""
    observations, targets, weights = data
    points = coordinates(observations, period)
    scale = inverse_bandwidths(start.bandwidths, period)
    inducing = points[inducing_rows(points * scale, weights, number, rng=rng)]
    order, middle = rng.permutation(len(targets)), len(targets) // 2
    points, targets, weights = points[order], targets[order], weights[order]  # so that a fold is a view
    folds = [(slice(middle), slice(middle, None)), (slice(middle, None), slice(middle))]
    if objective == "training-error" or not middle:
        folds = [(slice(None), slice(None))]

    def cost(logarithms: np.ndarray) -> float:
        parameters = start.replaced(logarithms)
        scale = inverse_bandwidths(parameters.bandwidths, period)
        centres = inducing * scale
        try:
            whitened = whitened_correlations(
                squared_exponential(centres, points * scale), squared_exponential(centres, centres)
            )
            total = 0.0
            for train, test in folds:
                mean, variance = _predict(whitened, targets, weights, train, test, parameters)
                errors = np.square(targets[test] - mean)
                if objective == "held-out":
                    errors = 0.5 * (errors / variance + np.log(2 * np.pi * variance))
                total += float(weights[test] @ errors)
        except np.linalg.LinAlgError:
            return FAILED
        return total / weights.sum() if np.isfinite(total) else FAILED

    return cost


def _predict(
    whitened: np.ndarray,
    targets: np.ndarray,
    weights: np.ndarray,
    train: slice,
    test: slice,
    parameters: Hyperparameters,
) -> tuple[np.ndarray, np.ndarray]:
    """Predictive mean and variance of the samples `test` from the samples `train`."""
    signal, noise = parameters.signal_variance, parameters.noise_variance
    seen, new = whitened[:, train], whitened[:, test]
    scaled = seen * precisions(seen, weights[train], signal_variance=signal, noise_variance=noise)
    inverse_lower = np.linalg.inv(np.linalg.cholesky(np.eye(len(seen)) + signal * (scaled @ seen.T)))
    left = inverse_lower @ new
    mean = signal * (left.T @ (inverse_lower @ (scaled @ targets[train])))
    unexplained = np.maximum(1.0 - np.einsum("mn,mn->n", new, new), 0.0)
    return mean, signal * (unexplained + np.einsum("mn,mn->n", left, left)) + noise
