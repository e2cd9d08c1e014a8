"""A softmax policy for discrete actions in continuous states, by weighted multinomial logistic regression (eq. 14).

π(a|s) ∝ exp f_a(s), each f_a a sparse Gaussian process (a linear function plus radial basis functions whose prior is
that of the process), fitted by maximum a posteriori: the discrete sibling of the Gaussian process policy
(Rasmussen & Williams 2006, eq. 3.34 and, for the sparse process, section 8.3.1).
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
from scipy.special import log_softmax, rel_entr

from bayespbrl import kernels
from bayespbrl.checks import indices, matrix, positive, whole
from bayespbrl.policies.policy import AnyArray
from bayespbrl.policies.samples import WeightedSamples, location_and_deviation, weighted_samples
from bayespbrl.policies.spaces import dimension, number_of_values
from bayespbrl.policies.sparse_regression import inducing_rows, steady_inverse_factor

DECREMENT = 1e-12  # the fit has converged where its quadratic model promises less than half of this, in nats
NEWTON_STEPS = 50  # at most, O(N A²M²) each; `converged` says whether they sufficed
CENTRES, MOST_OF_ACTIONS = 50, 1000  # of each action, and of all, unless a number is given


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class SoftmaxPolicy:
    """Logits f(s) = intercepts + slopes · (s − location)/scale + kernel_weights · r(s), r the M radial basis functions.

    Attributes:
      intercepts, slopes, kernel_weights: of each action's logit.
      location, scale: of the observations of the last fit; the scale of a constant or periodic dimension is infinite
        (no linear function is periodic).
      centres: unused ones have zero weights.
      bandwidths: zero where a dimension is constant.
      period: infinite where not periodic.
      bandwidth_factor: of the median rule.
      prior_scale: prior standard deviation of each logit's three parts.
      fits: how many fits led here.
      converged: whether the last fit reached its optimum; true of the initial policy.
      newton_decrement: twice what the last fit has left to gain, by its quadratic model; nats per unit of weight.
    """

    intercepts: Float[AnyArray, " a"]
    slopes: Float[AnyArray, "a s"]
    kernel_weights: Float[AnyArray, "a m"]
    location: Float[AnyArray, " s"]
    scale: Float[AnyArray, " s"]
    centres: Float[AnyArray, "m s"]
    bandwidths: Float[AnyArray, " s"]
    period: Float[AnyArray, " s"]
    bandwidth_factor: Float[AnyArray, ""]
    prior_scale: Float[AnyArray, ""]
    fits: Int[AnyArray, ""]
    converged: Bool[AnyArray, ""]
    newton_decrement: Float[AnyArray, ""]

    @classmethod
    def initial(
        cls,
        observation_space: Space[Any],
        action_space: Space[Any],
        *,
        period: ArrayLike | None = None,
        number_of_centres: int | None = None,
        bandwidth_factor: float = 1.0,
        prior_scale: float = 10.0,
    ) -> Self:
        """The uniform policy.

        Args:
          period: of each observation dimension, infinite where not periodic; None for none.
          number_of_centres: M; None: 50, and less with many actions (`kernels.of_each_action`).
          bandwidth_factor: of the median rule; the kernel's length scale.
          prior_scale: prior standard deviation of a logit, in nats.
        """
        states = dimension("observation_space", observation_space)
        actions = number_of_values("action_space", action_space)
        if number_of_centres is None:
            number_of_centres = kernels.of_each_action(CENTRES, actions, most=MOST_OF_ACTIONS)
        number_of_centres = whole("number_of_centres", number_of_centres)
        return cls(
            intercepts=np.zeros(actions),
            slopes=np.zeros((actions, states)),
            kernel_weights=np.zeros((actions, number_of_centres)),
            location=np.zeros(states),
            scale=np.ones(states),
            centres=np.zeros((number_of_centres, states)),
            bandwidths=np.zeros(states),
            period=kernels.as_periods(period, states),
            bandwidth_factor=np.asarray(positive("bandwidth_factor", bandwidth_factor)),
            prior_scale=np.asarray(positive("prior_scale", prior_scale)),
            fits=np.asarray(0),
            converged=np.asarray(True),
            newton_decrement=np.asarray(0.0),
        )

    def log_probabilities_at(self, observation: Float[AnyArray, " s"]) -> Float[Array, " a"]:
        """log π(·|s) at one observation, traceable."""
        kernel = kernels.radial_basis_row(jnp.asarray(observation), self.centres, self.bandwidths, self.period)
        linear = jnp.asarray(self.slopes) @ ((observation - self.location) / self.scale)
        return jax.nn.log_softmax(self.intercepts + linear + jnp.asarray(self.kernel_weights) @ kernel)

    def sample(self, key: Key[Array, ""], observation: Float[AnyArray, " s"]) -> Int[Array, ""]:
        """a ~ π(·|s)."""
        return jax.random.categorical(key, self.log_probabilities_at(observation))

    def mode(self, observation: Float[AnyArray, " s"]) -> Int[Array, ""]:
        """The most probable action."""
        return jnp.argmax(self.log_probabilities_at(observation))

    def log_prob(self, observation: Float[AnyArray, " s"], action: Int[AnyArray, ""]) -> Float[Array, ""]:
        """log π(a|s)."""
        return self.log_probabilities_at(observation)[action]

    def entropy(self, observation: Float[AnyArray, " s"]) -> Float[Array, ""]:
        """Entropy of π(·|s) in nats."""
        logarithms = self.log_probabilities_at(observation)
        return -jnp.sum(jnp.exp(logarithms) * logarithms)

    def probabilities(self, observations: ArrayLike) -> Float[np.ndarray, "n a"]:
        """π(·|sᵢ) for each of N observations."""
        observations = np.asarray(observations, dtype=np.float64)
        centres, period = np.asarray(self.centres), np.asarray(self.period)
        kernel = kernels.radial_basis(observations, centres, np.asarray(self.bandwidths), period)
        standardised = (observations - np.asarray(self.location)) / np.asarray(self.scale)
        logits = np.asarray(self.intercepts) + standardised @ np.asarray(self.slopes).T
        return np.exp(log_softmax(logits + kernel @ np.asarray(self.kernel_weights).T, axis=1))

    def kl_divergence(self, old: Self, observations: ArrayLike) -> Float[np.ndarray, " n"]:
        """KL(self ‖ old) at each of N observations."""
        return rel_entr(self.probabilities(observations), old.probabilities(observations)).sum(axis=1)

    def fit(
        self,
        observations: ArrayLike,
        actions: ArrayLike,
        sample_weights: ArrayLike,
        *,
        rng: np.random.Generator,
        base_weights: ArrayLike | None = None,
    ) -> Self:
        """Maximum a posteriori of the weighted likelihood (eq. 14), at new centres, by Newton's method.

        A weight counts samples: its scale matters as far as the prior does.

        Args:
          observations, actions: sᵢ (N, S) and integers aᵢ (N,). Rows that repeat a state, once for each action, cost as
            much as one.
          sample_weights, base_weights: wᵢ = pᵢ/Wᵢ and Wᵢ, shape (N,); see `Policy.fit`.
        """
        number, dimensions = self.slopes.shape
        given = matrix("observations", observations, columns=dimensions)
        samples = weighted_samples(given, indices("actions", actions, number), sample_weights, base_weights)
        states, mass = _by_state(samples, number)
        visits, period = mass.sum(axis=1), np.asarray(self.period)
        location, deviation = location_and_deviation(states, visits / visits.sum())
        scale = np.where((deviation > 0) & ~np.isfinite(period), deviation, np.inf)
        bandwidths = kernels.median_bandwidths(states, factor=float(self.bandwidth_factor), period=period, rng=rng)
        points = kernels.coordinates(states, period) * kernels.inverse_bandwidths(bandwidths, period)
        rows = inducing_rows(points, visits, self.centres.shape[0], rng=rng)
        # features whose independent weights have the process's prior: K_NM L⁻ᵀ
        back = steady_inverse_factor(kernels.squared_exponential(points[rows], points[rows])).T
        kernel = kernels.squared_exponential(points, points[rows]) @ back
        design = np.column_stack([np.ones(len(states)), (states - location) / scale, kernel])
        weights, newton_decrement, converged = _logistic_regression(design, mass, float(self.prior_scale))
        missing = self.centres.shape[0] - len(rows)
        return replace(
            self,
            intercepts=weights[:, 0],
            slopes=weights[:, 1 : 1 + dimensions],
            kernel_weights=np.pad(weights[:, 1 + dimensions :] @ back.T, ((0, 0), (0, missing))),
            location=location,
            scale=scale,
            centres=np.pad(states[rows], ((0, missing), (0, 0)), mode="edge"),
            bandwidths=bandwidths,
            fits=np.asarray(int(self.fits) + 1),
            converged=np.asarray(converged),
            newton_decrement=np.asarray(newton_decrement),
        )


def _by_state(
    samples: WeightedSamples, number_of_actions: int
) -> tuple[Float[np.ndarray, "n s"], Float[np.ndarray, "n a"]]:
    """The different states and the weight of each action in each of them."""
    states, index = np.unique(samples.observations, axis=0, return_inverse=True)
    cells = index.reshape(-1) * number_of_actions + samples.actions
    mass = np.bincount(cells, weights=samples.weights, minlength=len(states) * number_of_actions)
    return states, mass.reshape(len(states), number_of_actions)


def _logistic_regression(
    design: Float[np.ndarray, "n d"], mass: Float[np.ndarray, "n a"], prior_scale: float
) -> tuple[Float[np.ndarray, "a d"], float, bool]:
    """argmax Σₙₐ massₙₐ log softmax(designₙ · weightsᵀ)ₐ − |weights|²/(2 prior_scale²); last decrement, convergence.

    Newton's method with a halved step where the full one does not descend; the loss is strictly convex.

    Source: Boyd & Vandenberghe (2004), algorithms 9.2 and 9.5.
    """
    actions, size = mass.shape[1], design.shape[1]
    precision = 1 / (prior_scale**2 * mass.sum())
    shares = mass / mass.sum()
    visits = shares.sum(axis=1)

    def loss(weights: Float[np.ndarray, "a d"]) -> tuple[float, Float[np.ndarray, "n a"]]:
        logarithms = log_softmax(design @ weights.T, axis=1)
        penalty = 0.5 * precision * np.vdot(weights, weights)
        return penalty - np.vdot(shares, logarithms), np.exp(logarithms)  # eq. 14, and the prior

    weights = np.zeros((actions, size))
    value, probabilities = loss(weights)
    for _ in range(NEWTON_STEPS):
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


def _hessian(
    design: Float[np.ndarray, "n d"], visits: Float[np.ndarray, " n"], probabilities: Float[np.ndarray, "n a"]
) -> Float[np.ndarray, "a*d a*d"]:
    """Second derivative of −Σ share · log softmax, blocks Σₙ visits p_a(1[a = b] − p_b) xxᵀ."""
    actions, size = probabilities.shape[1], design.shape[1]
    hessian = np.empty((actions, size, actions, size))
    for a in range(actions):
        for b in range(a + 1):
            curvature = visits * probabilities[:, a] * (float(a == b) - probabilities[:, b])
            hessian[a, :, b, :] = (design * curvature[:, None]).T @ design
            hessian[b, :, a, :] = hessian[a, :, b, :].T
    return hessian.reshape(actions * size, actions * size)
