"""The Gaussian process policy (paper, "Obtaining a new exploration policy"): weighted, sparse, one per dimension.

a_j ~ N(mean_j(s), var_j(s)) in each action dimension j, not clipped. The prior mean is the centre of the action's
range; far from all samples the policy returns to it, and to the variance s² + σ².
"""

from dataclasses import dataclass, replace
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import Space
from jax import Array
from jaxtyping import Bool, Float, Int, Key
from numpy.typing import ArrayLike

from bayespbrl import kernels
from bayespbrl.checks import matrix, positive, whole
from bayespbrl.policies.hyperparameter_search import (
    FAILED,
    Hyperparameters,
    OutputSamples,
    SearchResult,
    search,
)
from bayespbrl.policies.policy import AnyArray
from bayespbrl.policies.samples import weighted_samples
from bayespbrl.policies.spaces import centre_and_range, dimension, initial_deviation
from bayespbrl.policies.sparse_regression import fit_sparse_regression, inducing_rows

# Evaluations of the objective of the hyper-parameter search: in the first fit, and in those that begin where the last
# one ended.
FIRST_EVALUATIONS, LATER_EVALUATIONS = 240, 90


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class GaussianProcessPolicy:
    """Predictive distributions of A sparse Gaussian processes with M inducing points each.

    Attributes:
      inducing_points: Z in the observation's units; unused ones have zero weights.
      mean_weights: mean_j(s) = centre_j + r(s, Z_j)ᵀ mean_weights_j, with correlations r.
      reduction: var_j(s) = s²(1 − |reduction_j r(s, Z_j)|²) + σ².
      bandwidths: zero where a dimension is not used.
      signal_variance, noise_variance: s² and σ² in the action's units squared.
      action_centre, action_range: of the action space.
      period: infinite where not periodic.
      minimum_noise: lower bound of σ as a fraction of the action's range.
      fits: how many fits led here; zero for the initial policy.
      objective: of the last hyper-parameter search, per unit of weight; NaN where there was none.
      noise_at_bound: whether the last search left σ² on a bound.
    """

    inducing_points: Float[AnyArray, "a m s"]
    mean_weights: Float[AnyArray, "a m"]
    reduction: Float[AnyArray, "a m m"]
    bandwidths: Float[AnyArray, "a s"]
    signal_variance: Float[AnyArray, " a"]
    noise_variance: Float[AnyArray, " a"]
    action_centre: Float[AnyArray, " a"]
    action_range: Float[AnyArray, " a"]
    period: Float[AnyArray, " s"]
    minimum_noise: Float[AnyArray, ""]
    fits: Int[AnyArray, ""]
    objective: Float[AnyArray, " a"]
    noise_at_bound: Bool[AnyArray, " a"]

    @classmethod
    def initial(
        cls,
        observation_space: Space[Any],
        action_space: Space[Any],
        *,
        period: ArrayLike | None = None,
        initial_scale: ArrayLike = 0.5,
        number_of_inducing_points: int = 100,
        minimum_noise: float = 0.01,
    ) -> Self:
        """The same normal distribution everywhere, about the centre of the action's range.

        Args:
          period: of each observation dimension, infinite where not periodic; None for none.
          initial_scale: standard deviation as a multiple of the range high − low, one number or one per dimension.
          number_of_inducing_points: M.
          minimum_noise: the noise σ never falls below this fraction of the range.
        """
        states, actions = dimension("observation_space", observation_space), dimension("action_space", action_space)
        centre, width = centre_and_range("action_space", action_space)
        variance = 0.5 * np.square(initial_deviation(initial_scale, width))
        inducing = whole("number_of_inducing_points", number_of_inducing_points)
        return cls(
            inducing_points=np.zeros((actions, inducing, states)),
            mean_weights=np.zeros((actions, inducing)),
            reduction=np.zeros((actions, inducing, inducing)),
            bandwidths=np.zeros((actions, states)),
            signal_variance=variance,
            noise_variance=variance,
            action_centre=centre,
            action_range=width,
            period=kernels.as_periods(period, states),
            minimum_noise=np.asarray(positive("minimum_noise", minimum_noise)),
            fits=np.asarray(0),
            objective=np.full(actions, np.nan),
            noise_at_bound=np.zeros(actions, dtype=bool),
        )

    @property
    def converged(self) -> bool:
        """Whether the last search found hyper-parameters that can be fitted, with σ² within its bounds."""
        return not (np.any(np.asarray(self.objective) <= -FAILED) or np.any(self.noise_at_bound))

    def moments(self, observation: Float[AnyArray, " s"]) -> tuple[Float[Array, " a"], Float[Array, " a"]]:
        """Mean and variance of each action dimension at one observation, traceable. O(AM²)."""

        def one(
            points: Float[AnyArray, "m s"],
            bandwidths: Float[AnyArray, " s"],
            mean_weights: Float[AnyArray, " m"],
            reduction: Float[AnyArray, "m m"],
        ) -> tuple[Float[Array, ""], Float[Array, ""]]:
            correlations = kernels.radial_basis_row(jnp.asarray(observation), points, bandwidths, self.period)
            return correlations @ mean_weights, jnp.sum(jnp.square(reduction @ correlations))

        mean, explained = jax.vmap(one)(self.inducing_points, self.bandwidths, self.mean_weights, self.reduction)
        # Snelson & Ghahramani (2006), predictive mean and variance, as in `SparseRegression`
        variance = jnp.asarray(self.signal_variance) * jnp.maximum(1.0 - explained, 0.0) + self.noise_variance
        return jnp.asarray(self.action_centre) + mean, variance

    def sample(self, key: Key[Array, ""], observation: Float[AnyArray, " s"]) -> Float[Array, " a"]:
        """a ~ N(mean, var), not clipped."""
        mean, variance = self.moments(observation)
        return mean + jnp.sqrt(variance) * jax.random.normal(key, mean.shape, mean.dtype)

    def mode(self, observation: Float[AnyArray, " s"]) -> Float[Array, " a"]:
        """The mean action."""
        return self.moments(observation)[0]

    def log_prob(self, observation: Float[AnyArray, " s"], action: Float[AnyArray, " a"]) -> Float[Array, ""]:
        """log density of an (unclipped) action."""
        mean, variance = self.moments(observation)
        return -0.5 * jnp.sum(jnp.square(action - mean) / variance + jnp.log(2 * jnp.pi * variance))

    def entropy(self, observation: Float[AnyArray, " s"]) -> Float[Array, ""]:
        """Differential entropy of π(·|s) in nats (Rasmussen & Williams 2006, section A.5)."""
        return 0.5 * jnp.sum(jnp.log(2 * jnp.pi * jnp.e * self.moments(observation)[1]))

    def mean_and_variance(self, observations: ArrayLike) -> tuple[Float[np.ndarray, "n a"], Float[np.ndarray, "n a"]]:
        """`moments` at N observations by matrix products."""
        observations = np.asarray(observations, dtype=np.float64)
        means, explained = [], []
        for points, bandwidths, mean_weights, reduction in zip(
            *map(np.asarray, (self.inducing_points, self.bandwidths, self.mean_weights, self.reduction)), strict=True
        ):
            correlations = kernels.radial_basis(observations, points, bandwidths, np.asarray(self.period))
            means.append(correlations @ mean_weights)
            # the layout in memory decides on the last digit, and that of a policy read from disk is another
            explained.append(np.square(correlations @ np.ascontiguousarray(reduction.T)).sum(axis=1))
        left = np.maximum(1.0 - np.stack(explained, axis=1), 0.0)
        # Snelson & Ghahramani (2006), predictive mean and variance
        variance = np.asarray(self.signal_variance) * left + np.asarray(self.noise_variance)
        return np.asarray(self.action_centre) + np.stack(means, axis=1), variance

    def action_standard_deviation(self, observations: ArrayLike) -> Float[np.ndarray, "n a"]:
        """Standard deviation of the action at each of N observations, in the action's units."""
        return np.sqrt(self.mean_and_variance(observations)[1])

    def kl_divergence(self, old: Self, observations: ArrayLike) -> Float[np.ndarray, " n"]:
        """KL(self ‖ old) of two normal distributions at N observations (Rasmussen & Williams 2006, section A.5)."""
        mean, variance = self.mean_and_variance(observations)
        old_mean, old_variance = old.mean_and_variance(observations)
        ratio = variance / old_variance
        # ratio − 1 − log ratio cancels as ratio → 1
        difference = (variance - old_variance) / old_variance
        return 0.5 * (np.square(mean - old_mean) / old_variance + ratio - 1 - np.log1p(difference)).sum(axis=1)

    def fit(
        self,
        observations: ArrayLike,
        actions: ArrayLike,
        sample_weights: ArrayLike,
        *,
        rng: np.random.Generator,
        base_weights: ArrayLike | None = None,
        evaluations: int | None = None,
    ) -> Self:
        """Condition the prior on samples with noise σ²/wᵢ (eq. 14), at new inducing points and hyper-parameters.

        The weights' scale matters, for σ² is the noise of a sample of weight one: wᵢ of mean 1 under W.

        Args:
          observations, actions: sᵢ (N, S) and unclipped aᵢ (N, A).
          sample_weights, base_weights: wᵢ = pᵢ/Wᵢ and Wᵢ, shape (N,); see `Policy.fit`.
          evaluations: of the objective of the hyper-parameter search, for each action dimension; None for
            `FIRST_EVALUATIONS` in the first fit and `LATER_EVALUATIONS` after it. 0 keeps the hyper-parameters, and
            takes the median rule's bandwidths if there are none yet.
        """
        number, _, dimensions = self.inducing_points.shape
        samples = weighted_samples(
            matrix("observations", observations, columns=dimensions),
            matrix("actions", actions, columns=number),
            sample_weights,
            base_weights,
        )
        if evaluations is None:
            evaluations = LATER_EVALUATIONS if int(self.fits) > 0 else FIRST_EVALUATIONS
        whole("evaluations", evaluations, least=0)
        period = np.asarray(self.period)
        rule = kernels.median_bandwidths(samples.observations, period=period, rng=rng)
        outputs = []
        for output in range(number):
            targets = samples.actions[:, output] - self.action_centre[output]
            own = OutputSamples(samples.observations, targets, samples.weights, period)
            found = self._searched(output, own, rule, evaluations, rng)
            outputs.append(
                vars(found.hyperparameters)
                | {"objective": found.objective, "noise_at_bound": found.at_bound}
                | self._condition(own, found.hyperparameters, rng)
            )
        stacked = {name: np.stack([fitted[name] for fitted in outputs]) for name in outputs[0]}
        return replace(self, fits=np.asarray(int(self.fits) + 1), **stacked)

    def fit_mean(self, *samples: ArrayLike, rng: np.random.Generator, base_weights: ArrayLike | None = None) -> Self:
        """`fit` with the hyper-parameters held: noise and signal variance, bandwidths."""
        kept = self.fit(*samples, rng=rng, base_weights=base_weights, evaluations=0)
        return replace(kept, objective=self.objective, noise_at_bound=self.noise_at_bound)

    def _searched(
        self,
        output: int,
        samples: OutputSamples,
        rule: Float[np.ndarray, " s"],
        evaluations: int,
        rng: np.random.Generator,
    ) -> SearchResult:
        """Hyper-parameters of one action dimension, the old ones without any evaluation; `rule` is the median rule."""
        # the median rule stands for a bandwidth that there was none of; a constant dimension has none
        old = np.asarray(self.bandwidths[output])
        bandwidths = np.where(rule > 0, np.where(old > 0, old, rule), 0.0)
        held = Hyperparameters(bandwidths, float(self.signal_variance[output]), float(self.noise_variance[output]))
        if evaluations == 0:
            return SearchResult(held, np.nan, at_bound=False)
        later = int(self.fits) > 0
        return search(
            samples,
            start=held if later else None,
            rule=rule,
            minimum_noise_variance=float(np.square(self.minimum_noise * self.action_range[output])),
            step_size=0.3 if later else 0.7,
            evaluations=evaluations,
            rng=rng,
        )

    def _condition(
        self, samples: OutputSamples, parameters: Hyperparameters, rng: np.random.Generator
    ) -> dict[str, Float[np.ndarray, "..."]]:
        """Inducing points and the posterior that goes with them, padded to M with points of no weight."""
        size = self.inducing_points.shape[1]
        scale = kernels.inverse_bandwidths(parameters.bandwidths, samples.period)
        points = kernels.coordinates(samples.observations, samples.period) * scale
        rows = inducing_rows(points, samples.weights, size, rng=rng)
        centres = points[rows]
        regression = fit_sparse_regression(
            kernels.squared_exponential(centres, points),
            kernels.squared_exponential(centres, centres),
            samples.targets,
            samples.weights,
            signal_variance=parameters.signal_variance,
            noise_variance=parameters.noise_variance,
        )
        missing = size - len(rows)
        return {
            "inducing_points": np.pad(samples.observations[rows], ((0, missing), (0, 0)), mode="edge"),
            "mean_weights": np.pad(regression.mean_weights, (0, missing)),
            "reduction": np.pad(regression.reduction, ((0, missing), (0, missing))),
        }
