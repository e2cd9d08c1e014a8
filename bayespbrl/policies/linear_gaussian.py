"""A linear-Gaussian policy a ~ N(K[1, s], Σ), fitted by weighted maximum likelihood in closed form (eq. 14)."""

from dataclasses import dataclass, replace
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import Space
from jax import Array
from jaxtyping import Float, Key
from numpy.typing import ArrayLike

from bayespbrl.checks import matrix, positive
from bayespbrl.policies.policy import AnyArray
from bayespbrl.policies.samples import location_and_deviation, weighted_samples
from bayespbrl.policies.spaces import centre_and_range, dimension, initial_deviation

RIDGE = 1e-8  # per unit of weight, in standardised features: decides only what the samples leave open


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class LinearGaussianPolicy:
    """a = coefficients · [1, (s − location)/scale] + factor · noise, not clipped.

    Attributes:
      coefficients: in the action's units, one column more than there are observation dimensions.
      location, scale: of the observations of the last fit.
      factor: lower triangular, Σ = factor factorᵀ.
      action_range: of the action space.
      minimum_noise: lower bound of the standard deviation in every direction, as a fraction of the action's range.
    """

    coefficients: Float[AnyArray, "a d"]
    location: Float[AnyArray, " s"]
    scale: Float[AnyArray, " s"]
    factor: Float[AnyArray, "a a"]
    action_range: Float[AnyArray, " a"]
    minimum_noise: Float[AnyArray, ""]

    @classmethod
    def initial(
        cls,
        observation_space: Space[Any],
        action_space: Space[Any],
        *,
        initial_scale: ArrayLike = 0.5,
        minimum_noise: float = 0.01,
    ) -> Self:
        """The same normal distribution everywhere, about the centre of the action's range.

        `initial_scale` is its standard deviation in multiples of the range high − low, one number or one per dimension.
        """
        states, actions = dimension("observation_space", observation_space), dimension("action_space", action_space)
        centre, width = centre_and_range("action_space", action_space)
        return cls(
            coefficients=np.column_stack([centre, np.zeros((actions, states))]),
            location=np.zeros(states),
            scale=np.ones(states),
            factor=np.diag(initial_deviation(initial_scale, width)),
            action_range=width,
            minimum_noise=np.asarray(positive("minimum_noise", minimum_noise)),
        )

    def mean(self, observation: Float[AnyArray, " s"]) -> Float[Array, " a"]:
        """Mean action at one observation, traceable."""
        coefficients = jnp.asarray(self.coefficients)
        return coefficients[:, 0] + coefficients[:, 1:] @ ((observation - self.location) / self.scale)

    def sample(self, key: Key[Array, ""], observation: Float[AnyArray, " s"]) -> Float[Array, " a"]:
        """a ~ N(mean, Σ), not clipped."""
        mean = self.mean(observation)
        return mean + jnp.asarray(self.factor) @ jax.random.normal(key, mean.shape, mean.dtype)

    def mode(self, observation: Float[AnyArray, " s"]) -> Float[Array, " a"]:
        """The mean action."""
        return self.mean(observation)

    def log_prob(self, observation: Float[AnyArray, " s"], action: Float[AnyArray, " a"]) -> Float[Array, ""]:
        """log density of an (unclipped) action."""
        factor = jnp.asarray(self.factor)
        residual = jax.scipy.linalg.solve_triangular(factor, action - self.mean(observation), lower=True)
        return -0.5 * (jnp.sum(jnp.square(residual)) + len(factor) * jnp.log(2 * jnp.pi)) - _half_log_determinant(
            factor
        )

    def entropy(self, observation: Float[AnyArray, " s"]) -> Float[Array, ""]:
        """Differential entropy of π(·|s) in nats, the same everywhere (Rasmussen & Williams 2006, section A.5)."""
        factor = jnp.asarray(self.factor)
        return 0.5 * len(factor) * jnp.log(2 * jnp.pi * jnp.e) + _half_log_determinant(factor)

    def action_standard_deviation(self, observations: ArrayLike) -> Float[np.ndarray, "n a"]:
        """Standard deviation of each action dimension at each of N observations, in the action's units."""
        deviation = np.sqrt(np.square(np.asarray(self.factor)).sum(axis=1))
        return np.tile(deviation, (len(np.asarray(observations)), 1))

    def kl_divergence(self, old: Self, observations: ArrayLike) -> Float[np.ndarray, " n"]:
        """KL(self ‖ old) of two normal distributions at N observations (Rasmussen & Williams 2006, section A.5)."""
        new_factor, old_factor = np.asarray(self.factor), np.asarray(old.factor)
        difference = np.linalg.solve(old_factor, (self._means(observations) - old._means(observations)).T)
        ratio = np.linalg.solve(old_factor, new_factor)  # lower triangular: its squares sum to the trace term
        logarithms = np.log(np.diag(ratio)).sum()
        constant = 0.5 * (np.square(ratio).sum() - len(ratio)) - logarithms
        return max(constant, 0.0) + 0.5 * np.square(difference).sum(axis=0)

    def fit(
        self,
        observations: ArrayLike,
        actions: ArrayLike,
        sample_weights: ArrayLike,
        *,
        rng: np.random.Generator | None = None,
        base_weights: ArrayLike | None = None,
    ) -> Self:
        """Weighted least squares for the mean, the weighted covariance of its residuals for the noise (eq. 14).

        With actions divided by their range, no eigenvalue of Σ falls below minimum_noise²: the maximum likelihood under
        that bound. Samples that are not twice as many as the coefficients of an action could be met by any noise: the
        noise is then held, and the mean drawn to that of the old policy, as if by as many samples as there are slopes.

        Args:
          observations, actions: sᵢ (N, S) and unclipped aᵢ (N, A).
          sample_weights, base_weights: wᵢ = pᵢ/Wᵢ and Wᵢ, shape (N,); see `Policy.fit`. Only their ratios matter.
          rng: not used, the fit is deterministic.
        """
        number, dimensions = self.coefficients.shape[0], self.coefficients.shape[1] - 1
        states = matrix("observations", observations, columns=dimensions)
        samples = weighted_samples(states, matrix("actions", actions, columns=number), sample_weights, base_weights)
        shares = samples.weights / samples.weights.sum()
        location, deviation = location_and_deviation(samples.observations, shares)
        scale = np.where(deviation > 0, deviation, 1.0)  # a constant dimension keeps a slope of zero
        standardised = (samples.observations - location) / scale
        weighted, effective = standardised * shares[:, None], 1 / np.sum(shares**2)
        few = effective < 2 * (dimensions + 1)
        old = self._means(samples.observations) if few else np.zeros_like(samples.actions)
        centre = shares @ (samples.actions - old)  # eq. 14
        gram = weighted.T @ standardised + (dimensions / effective if few else RIDGE) * np.eye(dimensions)
        slopes = np.linalg.solve(gram, weighted.T @ (samples.actions - old - centre)).T  # eq. 14
        if few:
            slopes += np.asarray(self.coefficients)[:, 1:] / np.asarray(self.scale) * scale
            centre += self._means(location[None])[0]
            held = {"coefficients": np.column_stack([centre, slopes]), "location": location, "scale": scale}
            return replace(self, **held)
        residuals = (samples.actions - centre - standardised @ slopes.T) / self.action_range
        values, vectors = np.linalg.eigh((residuals * shares[:, None]).T @ residuals)  # eq. 14
        covariance = (vectors * np.maximum(values, np.square(self.minimum_noise))) @ vectors.T
        return replace(
            self,
            coefficients=np.column_stack([centre, slopes]),
            location=location,
            scale=scale,
            factor=np.asarray(self.action_range)[:, None] * np.linalg.cholesky(covariance),
        )

    def fit_mean(
        self, *samples: ArrayLike, rng: np.random.Generator | None = None, base_weights: ArrayLike | None = None
    ) -> Self:
        """`fit` with the noise held."""
        return replace(self.fit(*samples, rng=rng, base_weights=base_weights), factor=self.factor)

    def _means(self, observations: ArrayLike) -> Float[np.ndarray, "n a"]:
        """Mean action at each of N observations, not clipped."""
        observations = np.asarray(observations, dtype=np.float64)
        coefficients = np.asarray(self.coefficients)
        standardised = (observations - np.asarray(self.location)) / np.asarray(self.scale)
        return coefficients[:, 0] + standardised @ coefficients[:, 1:].T


def _half_log_determinant(factor: Float[Array, "a a"]) -> Float[Array, ""]:
    return jnp.sum(jnp.log(jnp.diagonal(factor)))
