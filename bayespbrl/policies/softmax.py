"""A softmax policy for discrete actions in continuous states, by weighted multinomial logistic regression (eq. 14).

π(a|s) ∝ exp f_a(s), each f_a a sparse Gaussian process (a linear function plus radial basis functions whose prior is
that of the process), fitted by maximum a posteriori: the discrete sibling of the Gaussian process policy.
"""

from dataclasses import dataclass, replace
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import Space
from numpy.typing import ArrayLike
from scipy.special import rel_entr

from bayespbrl.kernels import (
    as_periods,
    coordinates,
    inverse_bandwidths,
    median_bandwidths,
    radial_basis,
    radial_basis_row,
    squared_exponential,
)
from bayespbrl.policies.samples import WeightedSamples, weighted_samples
from bayespbrl.policies.spaces import dimension, number_of_values
from bayespbrl.policies.sparse_regression import inducing_rows, inverse_factor

DECREMENT = 1e-12  # the fit has converged where its quadratic model promises less than half of this, in nats


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class SoftmaxPolicy:
    """Logits f(s) = intercepts + slopes · (s − location)/scale + kernel_weights · r(s), r the M radial basis functions.

    Attributes:
      intercepts, slopes, kernel_weights: shapes (A,), (A, S), (A, M).
      location, scale: of the observations of the last fit, shape (S,); the scale of a constant or periodic dimension is
        infinite (no linear function is periodic).
      centres: shape (M, S); unused ones have zero weights.
      bandwidths: shape (S,).
      period: shape (S,), infinite where not periodic.
      bandwidth_factor: of the median rule.
      prior_scale: prior standard deviation of each logit's three parts.
      fits: how many fits led here.
      converged: whether the last fit reached its optimum; true of the initial policy.
      newton_decrement: twice what the last fit has left to gain, by its quadratic model; nats a unit of weight.
    """

    intercepts: np.ndarray
    slopes: np.ndarray
    kernel_weights: np.ndarray
    location: np.ndarray
    scale: np.ndarray
    centres: np.ndarray
    bandwidths: np.ndarray
    period: np.ndarray
    bandwidth_factor: np.ndarray
    prior_scale: np.ndarray
    fits: np.ndarray
    converged: np.ndarray
    newton_decrement: np.ndarray

    @classmethod
    def initial(
        cls,
        observation_space: Space,
        action_space: Space,
        *,
        period: ArrayLike | None = None,
        number_of_centres: int = 50,
        bandwidth_factor: float = 1.0,
        prior_scale: float = 10.0,
    ) -> Self:
        """The uniform policy.

        Args:
          period: of each observation dimension, infinite where not periodic; None for none.
          number_of_centres: M.
          bandwidth_factor: of the median rule; the kernel's length scale.
          prior_scale: prior standard deviation of a logit, in nats: what a penalty would be elsewhere.
        """
        states = dimension("observation_space", observation_space)
        actions = number_of_values("action_space", action_space)
        for name, value in (("bandwidth_factor", bandwidth_factor), ("prior_scale", prior_scale)):
            if not (value > 0 and np.isfinite(value)):
                raise ValueError(f"{name}: expected a finite number > 0, got {value}")
        if number_of_centres < 1:
            raise ValueError(f"number_of_centres: expected at least 1, got {number_of_centres}")
        return cls(
            intercepts=np.zeros(actions),
            slopes=np.zeros((actions, states)),
            kernel_weights=np.zeros((actions, number_of_centres)),
            location=np.zeros(states),
            scale=np.ones(states),
            centres=np.zeros((number_of_centres, states)),
            bandwidths=np.zeros(states),
            period=as_periods(period, states),
            bandwidth_factor=np.asarray(float(bandwidth_factor)),
            prior_scale=np.asarray(float(prior_scale)),
            fits=np.asarray(0),
            converged=np.asarray(True),
            newton_decrement=np.asarray(0.0),
        )

    def log_probabilities_at(self, observation: Any) -> Any:
        """log π(·|s) at one observation, traceable; shape (A,)."""
        kernel = radial_basis_row(observation, self.centres, self.bandwidths, self.period)
        linear = jnp.asarray(self.slopes) @ ((observation - self.location) / self.scale)
        return jax.nn.log_softmax(self.intercepts + linear + jnp.asarray(self.kernel_weights) @ kernel)

    def sample(self, key: jax.Array, observation: Any) -> Any:
        """a ~ π(·|s), an integer scalar."""
        return jax.random.categorical(key, self.log_probabilities_at(observation))

    def log_prob(self, observation: Any, action: Any) -> Any:
        """log π(a|s)."""
        return self.log_probabilities_at(observation)[action]

    def entropy(self, observation: Any) -> Any:
        """Entropy of π(·|s) in nats."""
        logarithms = self.log_probabilities_at(observation)
        return -jnp.sum(jnp.exp(logarithms) * logarithms)

    def probabilities(self, observations: np.ndarray) -> np.ndarray:
        """π(·|sᵢ) for each observation, shape (N, A)."""
        observations = np.asarray(observations, dtype=np.float64)
        centres, period = np.asarray(self.centres), np.asarray(self.period)
        kernel = radial_basis(observations, centres, np.asarray(self.bandwidths), period)
        standardised = (observations - np.asarray(self.location)) / np.asarray(self.scale)
        logits = np.asarray(self.intercepts) + standardised @ np.asarray(self.slopes).T
        return np.exp(_log_softmax(logits + kernel @ np.asarray(self.kernel_weights).T))

    def kl_divergence(self, old: Self, observations: np.ndarray) -> np.ndarray:
        """KL(self ‖ old) at each observation, shape (N,)."""
        return rel_entr(self.probabilities(observations), old.probabilities(observations)).sum(axis=1)

    def fit(
        self,
        observations: np.ndarray,
        actions: np.ndarray,
        sample_weights: np.ndarray,
        *,
        rng: np.random.Generator,
        base_weights: np.ndarray | None = None,
        iterations: int = 50,
    ) -> Self:
        """Maximum a posteriori of the weighted likelihood, at new centres, by Newton's method.

        A weight counts samples: its scale matters as far as the prior does.

        Args:
          observations, actions: sᵢ (N, S) and integers aᵢ (N,). Rows that repeat a state, once for each action, cost as
            much as one.
          sample_weights, base_weights: wᵢ = pᵢ/Wᵢ and Wᵢ, shape (N,); see `Policy.fit`.
          iterations: of Newton's method at most, O(N A²M²) each; `converged` says whether they sufficed.
        """
        if iterations < 1:
            raise ValueError(f"iterations: expected at least 1, got {iterations}")
        number, dimensions = self.slopes.shape
        samples = weighted_samples(
            observations,
            actions,
            sample_weights,
            base_weights,
            observation_dimension=dimensions,
            number_of_actions=number,
        )
        states, mass = _by_state(samples, number)
        visits, period = mass.sum(axis=1), np.asarray(self.period)
        shares = visits / visits.sum()
        location = shares @ states
        deviation = np.sqrt(shares @ np.square(states - location))
        linear = (deviation > 1e-12 * (1 + np.abs(location))) & ~np.isfinite(period)
        scale = np.where(linear, deviation, np.inf)

        bandwidths = median_bandwidths(states, factor=float(self.bandwidth_factor), period=period, rng=rng)
        points = coordinates(states, period) * inverse_bandwidths(bandwidths, period)
        rows = inducing_rows(points, visits, self.centres.shape[0], rng=rng)
        back = inverse_factor(squared_exponential(points[rows], points[rows])).T
        design = np.column_stack(
            [np.ones(len(states)), (states - location) / scale, squared_exponential(points, points[rows]) @ back]
        )
        weights, newton_decrement, converged = _logistic_regression(
            design, mass, prior_scale=float(self.prior_scale), iterations=iterations
        )
        missing = self.centres.shape[0] - len(rows)
        kernel_weights = weights[:, 1 + dimensions :] @ back.T
        return replace(
            self,
            intercepts=weights[:, 0],
            slopes=weights[:, 1 : 1 + dimensions],
            kernel_weights=np.pad(kernel_weights, ((0, 0), (0, missing))),
            location=location,
            scale=scale,
            centres=np.pad(states[rows], ((0, missing), (0, 0)), mode="edge"),
            bandwidths=bandwidths,
            fits=np.asarray(int(self.fits) + 1),
            converged=np.asarray(converged),
            newton_decrement=np.asarray(newton_decrement),
        )


def _by_state(samples: WeightedSamples, number_of_actions: int) -> tuple[np.ndarray, np.ndarray]:
    """The different states (N', S) and the weight of each action in each of them (N', A)."""
    states, index = np.unique(samples.observations, axis=0, return_inverse=True)
    cells = index.reshape(-1) * number_of_actions + samples.actions
    mass = np.bincount(cells, weights=samples.weights, minlength=len(states) * number_of_actions)
    return states, mass.reshape(len(states), number_of_actions)


def _logistic_regression(
    design: np.ndarray, mass: np.ndarray, *, prior_scale: float, iterations: int
) -> tuple[np.ndarray, float, bool]:
    """argmax Σₙₐ massₙₐ log softmax(designₙ · weightsᵀ)ₐ − |weights|²/(2 prior_scale²); shape (A, D), and how well.

    Newton's method with a halved step where the full one does not descend; the loss is strictly convex.
    """
    actions, size = mass.shape[1], design.shape[1]
    precision = 1 / (prior_scale**2 * mass.sum())
    shares = mass / mass.sum()
    visits = shares.sum(axis=1)

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        logarithms = _log_softmax(design @ weights.T)
        return 0.5 * precision * np.vdot(weights, weights) - np.vdot(shares, logarithms), np.exp(logarithms)

    weights = np.zeros((actions, size))
    value, probabilities = loss(weights)
    for _ in range(iterations):
        gradient = (visits[:, None] * probabilities - shares).T @ design + precision * weights
        hessian = _hessian(design, visits, probabilities) + precision * np.eye(actions * size)
        step = np.linalg.solve(hessian, gradient.ravel()).reshape(weights.shape)
        decrement = float(np.vdot(gradient, step))
        length = 1.0
        while length > 1e-6:
            new_value, new_probabilities = loss(weights - length * step)
            if new_value <= value - 0.1 * length * decrement or decrement < DECREMENT:
                break
            length /= 2
        weights, value, probabilities = weights - length * step, new_value, new_probabilities
        if decrement < DECREMENT:
            return weights, decrement, True
    return weights, decrement, False


def _hessian(design: np.ndarray, visits: np.ndarray, probabilities: np.ndarray) -> np.ndarray:
    """Second derivative of −Σ share · log softmax, blocks Σₙ visits p_a(1[a = b] − p_b) xxᵀ; shape (AD, AD)."""
    actions, size = probabilities.shape[1], design.shape[1]
    hessian = np.empty((actions, size, actions, size))
    for a in range(actions):
        for b in range(a + 1):
            curvature = visits * probabilities[:, a] * (float(a == b) - probabilities[:, b])
            hessian[a, :, b, :] = (design * curvature[:, None]).T @ design
            hessian[b, :, a, :] = hessian[a, :, b, :].T
    return hessian.reshape(actions * size, actions * size)


def _log_softmax(logits: np.ndarray) -> np.ndarray:
    shifted = logits - logits.max(axis=1, keepdims=True)
    return shifted - np.log(np.exp(shifted).sum(axis=1, keepdims=True))
