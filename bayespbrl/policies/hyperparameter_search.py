"""Hyper-parameters of the Gaussian process policy by CMA-ES (Hansen & Ostermeier 2001; paper, experiments).

Decision: the objective is the weighted predictive log-likelihood of two held-out halves, not the paper's training-set
error, which cannot identify the noise variance. It is computed on a random subsample of bounded size and with few
inducing points, so that the cost does not depend on N.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from cmaes import CMA
from jaxtyping import Float, Int

from bayespbrl.kernels import coordinates, inverse_bandwidths, squared_exponential
from bayespbrl.policies.sparse_regression import inducing_rows, inverse_factor, precisions

SUBSAMPLE, INDUCING_POINTS = 800, 50  # what the objective is computed with
FAILED = 1e10  # the cost of hyper-parameters at which the linear algebra breaks down
PerSample = Float[np.ndarray, " n"]  # one number per sample
Logarithms = Float[np.ndarray, " p"]  # of the hyper-parameters searched


@dataclass(frozen=True, eq=False)
class OutputSamples:
    """Samples of one output.

    Attributes:
      observations: xᵢ.
      targets: yᵢ, about their prior mean.
      weights: wᵢ > 0.
      period: of each observation dimension, infinite where not periodic.
    """

    observations: Float[np.ndarray, "n s"]
    targets: PerSample
    weights: PerSample
    period: Float[np.ndarray, " s"]

    def rows(self, chosen: Int[np.ndarray, " m"]) -> "OutputSamples":
        """Some of the samples."""
        return OutputSamples(self.observations[chosen], self.targets[chosen], self.weights[chosen], self.period)


@dataclass(frozen=True, eq=False)
class Hyperparameters:
    """Hyper-parameters of one output: bandwidths in the observation's units, variances in the action's squared."""

    bandwidths: Float[np.ndarray, " s"]
    signal_variance: float
    noise_variance: float

    @property
    def logarithms(self) -> Logarithms:
        """log b of the dimensions that are used (b > 0), then log s², log σ²."""
        used = self.bandwidths[self.bandwidths > 0]
        return np.log(np.concatenate([used, [self.signal_variance, self.noise_variance]]))

    def replaced(self, logarithms: Logarithms) -> "Hyperparameters":
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
      objective: their log-likelihood per unit of weight (nats).
      at_bound: whether the best noise variance lies on one of its bounds.
    """

    hyperparameters: Hyperparameters
    objective: float
    at_bound: bool


def search(
    samples: OutputSamples,
    *,
    start: Hyperparameters | None,
    rule: Float[np.ndarray, " s"],
    minimum_noise_variance: float,
    step_size: float,
    evaluations: int,
    rng: np.random.Generator,
) -> SearchResult:
    """CMA-ES over log b, log s², log σ².

    Bounds, with the weighted mean square ȳ² of the targets: b in [b̄/20, 20 b̄], s² in [ȳ²/1000, 10 ȳ²], σ² in
    [minimum_noise_variance, 2 ȳ²].

    Args:
      start: where to begin, clipped to the bounds; b̄ and ȳ²/2 when None.
      rule: the median rule's bandwidths b̄; zero for a dimension that is not used.
      step_size: initial, in the logarithms.
      evaluations: of the objective, at most.
    """
    square = max(float(samples.weights @ np.square(samples.targets) / samples.weights.sum()), minimum_noise_variance)
    number = len(samples.targets)
    chosen = rng.choice(number, size=min(SUBSAMPLE, number), replace=False)
    reference = Hyperparameters(rule, square, square)
    low, high = _bounds(reference.logarithms, minimum_noise_variance)
    first = np.clip((start or Hyperparameters(rule, 0.5 * square, 0.5 * square)).logarithms, low, high)
    cost = _cost(samples.rows(chosen), reference.replaced(first), rng)
    bounds, seed = np.column_stack([low, high]), int(rng.integers(2**31))
    optimiser = CMA(mean=first, sigma=step_size, bounds=bounds, seed=seed, lr_adapt=False)
    best, best_cost, used = first, cost(first), 1
    while used + optimiser.population_size <= evaluations and not optimiser.should_stop():
        candidates = [optimiser.ask() for _ in range(optimiser.population_size)]
        costs = [cost(candidate) for candidate in candidates]
        used += len(costs)
        optimiser.tell(list(zip(candidates, costs, strict=True)))
        if min(costs) < best_cost:
            best_cost = min(costs)
            best = candidates[int(np.argmin(costs))]
    at_bound = bool(min(best[-1] - low[-1], high[-1] - best[-1]) < 1e-2)
    return SearchResult(reference.replaced(best), -best_cost, at_bound)


def _bounds(centre: Logarithms, minimum_noise_variance: float) -> tuple[Logarithms, Logarithms]:
    """Lower and upper bounds of the logarithms, about those of b̄, ȳ² and ȳ²."""
    reach = np.full(len(centre), np.log(20.0))
    low, high = centre - reach, centre + reach
    low[-2:] = centre[-2] - np.log(1000.0), np.log(minimum_noise_variance)
    high[-2:] = centre[-2] + np.log(10.0), max(centre[-1] + np.log(2.0), low[-1] + 1e-3)
    return low, high


def _cost(samples: OutputSamples, start: Hyperparameters, rng: np.random.Generator) -> Callable[[Logarithms], float]:
    """The function of the logarithms that CMA-ES minimises; folds and inducing points are fixed before it starts."""
    points, period = coordinates(samples.observations, samples.period), samples.period
    scale = inverse_bandwidths(start.bandwidths, period)
    inducing = points[inducing_rows(points * scale, samples.weights, INDUCING_POINTS, rng=rng)]
    order, middle = rng.permutation(len(points)), len(points) // 2
    points, samples = points[order], samples.rows(order)  # so that a fold is a view
    folds = [(slice(middle), slice(middle, None)), (slice(middle, None), slice(middle))]
    if not middle:
        folds = [(slice(None), slice(None))]  # one sample cannot be halved

    def cost(logarithms: Logarithms) -> float:
        parameters = start.replaced(logarithms)
        scale = inverse_bandwidths(parameters.bandwidths, period)
        centres = inducing * scale
        try:
            inverse_lower = inverse_factor(squared_exponential(centres, centres))
            whitened = inverse_lower @ squared_exponential(centres, points * scale)
            total = 0.0
            for train, test in folds:
                mean, variance = _predict(whitened, samples, train, test, parameters)
                errors = np.square(samples.targets[test] - mean)
                # Rasmussen & Williams (2006), eq. 5.10, weighted
                total += float(samples.weights[test] @ (0.5 * (errors / variance + np.log(2 * np.pi * variance))))
        except np.linalg.LinAlgError:
            return FAILED
        return float(total / samples.weights.sum()) if np.isfinite(total) else FAILED

    return cost


def _predict(
    whitened: Float[np.ndarray, "m n"], samples: OutputSamples, train: slice, test: slice, parameters: Hyperparameters
) -> tuple[Float[np.ndarray, " t"], Float[np.ndarray, " t"]]:
    """Predictive mean and variance of the samples `test` from the samples `train` (Snelson and Ghahramani 2006)."""
    signal, noise = parameters.signal_variance, parameters.noise_variance
    seen, new = whitened[:, train], whitened[:, test]
    scaled = seen * precisions(seen, samples.weights[train], signal_variance=signal, noise_variance=noise)
    inverse_lower = np.linalg.inv(np.linalg.cholesky(np.eye(len(seen)) + signal * (scaled @ seen.T)))
    left = inverse_lower @ new
    mean = signal * (left.T @ (inverse_lower @ (scaled @ samples.targets[train])))
    unexplained = np.maximum(1.0 - np.einsum("mn,mn->n", new, new), 0.0)
    return mean, signal * (unexplained + np.einsum("mn,mn->n", left, left)) + noise
