"""A linear-Gaussian policy a ~ N(K[1, s], Σ), fitted by weighted maximum likelihood in closed form (eq. 14)."""

from dataclasses import dataclass, field, replace
from typing import Any, Literal, Self

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import Space
from numpy.typing import ArrayLike

from bayespbrl.policies.samples import weighted_samples
from bayespbrl.policies.spaces import centre_and_range, dimension

RIDGE = 1e-8  # a unit of weight, in standardised features: decides only what the samples leave open


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class LinearGaussianPolicy:
    """a = coefficients · [1, (s − location)/scale] + factor · noise, not clipped.

    Attributes:
      coefficients: in the action's units, shape (A, 1 + S).
      location, scale: of the observations of the last fit, shape (S,).
      factor: lower triangular, Σ = factor factorᵀ; shape (A, A).
      action_range: shape (A,).
      minimum_noise: lower bound of the standard deviation in every direction, as a fraction of the action's range.
      covariance: "full", or "diagonal" for independent action dimensions.
    """

    coefficients: np.ndarray
    location: np.ndarray
    scale: np.ndarray
    factor: np.ndarray
    action_range: np.ndarray
    minimum_noise: np.ndarray
    covariance: Literal["full", "diagonal"] = field(default="full", metadata={"static": True})

    @classmethod
    def initial(
        cls,
        observation_space: Space,
        action_space: Space,
        *,
        initial_scale: ArrayLike = 0.5,
        minimum_noise: float = 0.01,
        covariance: Literal["full", "diagonal"] = "full",
    ) -> Self:
        """The same normal distribution everywhere, about the centre of the action's range.

        `initial_scale` is its standard deviation as a multiple of the range high − low, one number or one a dimension.
        """
        states, actions = dimension("observation_space", observation_space), dimension("action_space", action_space)
        centre, width = centre_and_range("action_space", action_space)
        scale = np.broadcast_to(np.asarray(initial_scale, dtype=np.float64), (actions,))
        for name, value in (("initial_scale", scale), ("minimum_noise", minimum_noise)):
            if not np.all((np.asarray(value) > 0) & np.isfinite(value)):
                raise ValueError(f"{name}: expected a finite number > 0, got {value}")
        if covariance not in ("full", "diagonal"):
            raise ValueError(f'covariance: expected "full" or "diagonal", got {covariance!r}')
        return cls(
            coefficients=np.column_stack([centre, np.zeros((actions, states))]),
            location=np.zeros(states),
            scale=np.ones(states),
            factor=np.diag(scale * width),
            action_range=width,
            minimum_noise=np.asarray(float(minimum_noise)),
            covariance=covariance,
        )

    def mean(self, observation: Any) -> Any:
        """Mean action at one observation, traceable; shape (A,)."""
        coefficients = jnp.asarray(self.coefficients)
        return coefficients[:, 0] + coefficients[:, 1:] @ ((observation - self.location) / self.scale)

    def sample(self, key: jax.Array, observation: Any) -> Any:
        """a ~ N(mean, Σ), shape (A,), not clipped."""
        mean = self.mean(observation)
        return mean + jnp.asarray(self.factor) @ jax.random.normal(key, mean.shape, mean.dtype)

    def log_prob(self, observation: Any, action: Any) -> Any:
        """log density of an (unclipped) action."""
        factor = jnp.asarray(self.factor)
        residual = jax.scipy.linalg.solve_triangular(factor, action - self.mean(observation), lower=True)
        return -0.5 * (jnp.sum(jnp.square(residual)) + len(factor) * jnp.log(2 * jnp.pi)) - _half_log_determinant(
            factor
        )

    def entropy(self, observation: Any) -> Any:
        """Differential entropy of π(·|s) in nats, the same at every observation."""
        factor = jnp.asarray(self.factor)
        return 0.5 * len(factor) * jnp.log(2 * jnp.pi * jnp.e) + _half_log_determinant(factor)

    def action_standard_deviation(self, observations: np.ndarray) -> np.ndarray:
        """Standard deviation of each action dimension at each observation, in the action's units; shape (N, A)."""
        deviation = np.sqrt(np.square(np.asarray(self.factor)).sum(axis=1))
        return np.tile(deviation, (len(observations), 1))

    def kl_divergence(self, old: Self, observations: np.ndarray) -> np.ndarray:
        """KL(self ‖ old) of the two normal distributions at each observation, shape (N,)."""
        new_factor, old_factor = np.asarray(self.factor), np.asarray(old.factor)
        difference = np.linalg.solve(old_factor, (self._means(observations) - old._means(observations)).T)
        ratio = np.linalg.solve(old_factor, new_factor)  # lower triangular: its squares sum to the trace term
        logarithms = np.log(np.diag(ratio)).sum()
        constant = 0.5 * (np.square(ratio).sum() - len(ratio)) - logarithms
        return max(constant, 0.0) + 0.5 * np.square(difference).sum(axis=0)

    def fit(
        self,
        observations: np.ndarray,
        actions: np.ndarray,
        sample_weights: np.ndarray,
        *,
        rng: np.random.Generator | None = None,
        base_weights: np.ndarray | None = None,
    ) -> Self:
        """Weighted least squares for the mean, the weighted covariance of its residuals for the noise (eq. 14).

        With actions divided by their range, no eigenvalue of Σ falls below minimum_noise²: the maximum likelihood under
        that bound.

        Args:
          observations, actions: sᵢ (N, S) and unclipped aᵢ (N, A).
          sample_weights, base_weights: wᵢ = pᵢ/Wᵢ and Wᵢ, shape (N,); see `Policy.fit`. Only their ratios matter.
          rng: not used, the fit is deterministic.
        """
        number, dimensions = self.coefficients.shape[0], self.coefficients.shape[1] - 1
        samples = weighted_samples(
            observations,
            actions,
            sample_weights,
            base_weights,
            observation_dimension=dimensions,
            action_dimension=number,
        )
        shares = samples.weights / samples.weights.sum()
        location = shares @ samples.observations
        deviation = np.sqrt(shares @ np.square(samples.observations - location))
        # a constant dimension keeps a slope of zero; rounding leaves it a tiny deviation that must not be divided by
        scale = np.where(deviation > 1e-12 * (1 + np.abs(location)), deviation, 1.0)
        standardised = (samples.observations - location) / scale
        centre = shares @ samples.actions
        weighted = standardised * shares[:, None]
        gram = weighted.T @ standardised + RIDGE * np.eye(dimensions)
        slopes = np.linalg.solve(gram, weighted.T @ (samples.actions - centre)).T
        residuals = (samples.actions - centre - standardised @ slopes.T) / self.action_range
        covariance = self._bounded((residuals * shares[:, None]).T @ residuals)
        return replace(
            self,
            coefficients=np.column_stack([centre, slopes]),
            location=location,
            scale=scale,
            factor=np.asarray(self.action_range)[:, None] * np.linalg.cholesky(covariance),
        )

    def fit_mean(self, *samples: np.ndarray, **options: Any) -> Self:
        """`fit` with the noise held."""
        return replace(self.fit(*samples, **options), factor=self.factor)

    def _means(self, observations: np.ndarray) -> np.ndarray:
        observations = np.asarray(observations, dtype=np.float64)
        coefficients = np.asarray(self.coefficients)
        standardised = (observations - np.asarray(self.location)) / np.asarray(self.scale)
        return coefficients[:, 0] + standardised @ coefficients[:, 1:].T

    def _bounded(self, covariance: np.ndarray) -> np.ndarray:
        """`covariance` with its eigenvalues raised to the bound, off-diagonal entries dropped where it is diagonal."""
        if self.covariance == "diagonal":
            return np.diag(np.maximum(np.diag(covariance), np.square(self.minimum_noise)))
        values, vectors = np.linalg.eigh(covariance)
        return (vectors * np.maximum(values, np.square(self.minimum_noise))) @ vectors.T


def _half_log_determinant(factor: jax.Array) -> jax.Array:
    return jnp.sum(jnp.log(jnp.diagonal(factor)))
