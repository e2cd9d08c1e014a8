"""What an answer says about a margin t = d(w, k, ζ): the preference likelihoods (eq. 8 and its relatives).

Every likelihood here is a constant plus a mixture of probits, p(t) = c + Σⱼ aⱼ Φ((t − oⱼ)/hⱼ): a step is h = 0, and the
logistic function is a scale mixture of normal distribution functions (Andrews & Mallows 1974: scale 2κ, κ Kolmogorov
distributed). So one closed form serves expectation propagation for all of them, at any steepness.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np


class ProbitMixture(NamedTuple):
    """p(t) = constant + Σⱼ weights[j] Φ((t − offsets[j]) / scales[j]); a scale of 0 is the step with value ½ at its offset."""

    constant: float | np.ndarray
    weights: np.ndarray
    offsets: np.ndarray
    scales: np.ndarray


@runtime_checkable
class Likelihood(Protocol):
    """The probability of the answer that was given, as a function of its margin."""

    def log_prob(self, margins: jax.Array) -> jax.Array:
        """log p(answer | t), elementwise; JAX-traceable, dtype of `margins`."""
        ...

    def probit_mixture(self) -> ProbitMixture:
        """The same probability, as a mixture of probits."""
        ...


@lru_cache(maxsize=1)
def _logistic_mixture() -> tuple[np.ndarray, np.ndarray]:
    """Weights and scales with sigmoid(x) = Σⱼ weights[j] Φ(x / scales[j]), to about 1e-13 everywhere.

    The trapezoidal rule in log κ over the Kolmogorov density, Σₙ (−1)ⁿ⁺¹ 8 n² κ exp(−2n²κ²), or its theta-function twin
    for small κ; it converges geometrically because the integrand vanishes with all derivatives at both ends.
    """
    log_kappa = np.linspace(np.log(0.14), np.log(4.3), 28)
    kappa = np.exp(log_kappa)[:, None]
    n = np.arange(1, 60)
    large = np.sum((-1.0) ** (n + 1) * 8 * n**2 * kappa * np.exp(-2 * n**2 * kappa**2), axis=1)
    odd = (2 * n - 1) * np.pi / np.sqrt(8)
    small = np.sum(np.sqrt(2 * np.pi) * (2 * odd**2 / kappa**4 - 1 / kappa**2) * np.exp(-((odd / kappa) ** 2)), axis=1)
    weights = np.where(kappa[:, 0] > 0.8, large, small) * kappa[:, 0]
    return weights / weights.sum(), 2 * kappa[:, 0]


def _with_lapses(log_prob: jax.Array, lapse_rate: jax.Array | float) -> jax.Array:
    """log(λ/2 + (1 − λ) p): with probability λ the answer is a coin toss."""
    return jnp.logaddexp(jnp.log(jnp.asarray(lapse_rate) / 2), jnp.log1p(-jnp.asarray(lapse_rate)) + log_prob)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Mixed:
    """The paper's mixture of a 0-1 and a sigmoid likelihood (eq. 8): ((K − 1) 1[t > 0] + sigmoid(m t)) / K, with 1[0] = ½.

    Attributes:
      steepness: m > 0.
      number_of_preferences: K of eq. 8. It stays the full K when the likelihood predicts a held-out answer.
      lapse_rate: λ in [0, 1).
    """

    steepness: float
    number_of_preferences: float
    lapse_rate: float = 0.0

    def log_prob(self, margins: jax.Array) -> jax.Array:
        """log p(answer | t), elementwise."""
        scaled = self.steepness * margins
        decay = jnp.exp(-jnp.abs(scaled))
        above = jnp.log1p(-decay / (1 + decay) / self.number_of_preferences)
        below = -jnp.abs(scaled) - jnp.log1p(decay) - jnp.log(self.number_of_preferences)
        log_prob = jnp.where(margins > 0, above, jnp.where(margins < 0, below, jnp.log(0.5)))
        # NaN margins must stay NaN: every comparison with them is false
        return _with_lapses(log_prob + 0 * scaled, self.lapse_rate)

    def probit_mixture(self) -> ProbitMixture:
        """A step and a smooth part."""
        weights, scales = _logistic_mixture()
        share = 1 / self.number_of_preferences
        return _lapsed_mixture(
            np.append(share * weights, 1 - share), np.append(scales / self.steepness, 0.0), self.lapse_rate
        )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Logistic:
    """Bradley–Terry: sigmoid(m t), with lapses."""

    steepness: float
    lapse_rate: float = 0.0

    def log_prob(self, margins: jax.Array) -> jax.Array:
        """log p(answer | t), elementwise."""
        return _with_lapses(jax.nn.log_sigmoid(self.steepness * margins), self.lapse_rate)

    def probit_mixture(self) -> ProbitMixture:
        """The scale mixture of the logistic function."""
        weights, scales = _logistic_mixture()
        return _lapsed_mixture(weights, scales / self.steepness, self.lapse_rate)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Probit:
    """Thurstone: Φ(m t), with lapses."""

    steepness: float
    lapse_rate: float = 0.0

    def log_prob(self, margins: jax.Array) -> jax.Array:
        """log p(answer | t), elementwise."""
        return _with_lapses(jax.scipy.special.log_ndtr(self.steepness * margins), self.lapse_rate)

    def probit_mixture(self) -> ProbitMixture:
        """One probit."""
        return _lapsed_mixture(np.ones(1), np.array([1 / self.steepness]), self.lapse_rate)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WithTies:
    """A threshold within which people say "no difference" (Rao & Kupper 1967), around any likelihood above.

    p(≻) = p(t − δ), p(≺) = p(−t − δ), p(tie) = p(t + δ) − p(t − δ); they sum to one because p(t) + p(−t) = 1.

    Attributes:
      ordered: the likelihood p of an answer without a threshold.
      threshold: δ > 0, in units of the margin.
      indifferent: which answers were "no difference", shape (K,) bool, in the order of the margins' last axis.
    """

    ordered: Mixed | Logistic | Probit
    threshold: float
    indifferent: jax.Array | np.ndarray

    def log_prob(self, margins: jax.Array) -> jax.Array:
        """log p(answer | t); the last axis of `margins` is K."""
        preferred = self.ordered.log_prob(margins - self.threshold)
        # p(tie) is symmetric: at −|t| both terms are small and their difference keeps its relative precision
        upper = self.ordered.log_prob(self.threshold - jnp.abs(margins))
        lower = self.ordered.log_prob(-self.threshold - jnp.abs(margins))
        return jnp.where(self.indifferent, upper + jnp.log(-jnp.expm1(lower - upper)), preferred)

    def probit_mixture(self) -> ProbitMixture:
        """Weights (K, 2J): an ordered answer uses the half shifted by δ, a tie the difference of both."""
        constant, weights, offsets, scales = self.ordered.probit_mixture()
        tied = np.asarray(self.indifferent)[:, None]
        return ProbitMixture(
            np.where(tied[:, 0], 0.0, constant),
            np.concatenate([np.where(tied, -1.0, 1.0) * weights, np.where(tied, 1.0, 0.0) * weights], axis=1),
            np.concatenate([offsets + self.threshold, offsets - self.threshold]),
            np.concatenate([scales, scales]),
        )


def _lapsed_mixture(weights: np.ndarray, scales: np.ndarray, lapse_rate: float) -> ProbitMixture:
    return ProbitMixture(lapse_rate / 2, (1 - lapse_rate) * weights, np.zeros_like(scales), scales)


def preference_likelihood(
    name: str, *, steepness: float, number_of_preferences: int, lapse_rate: float
) -> Mixed | Logistic | Probit:
    """The likelihood called `name`: "mixed" (eq. 8), "logistic" or "probit".

    Raises:
      ValueError: an unknown name, steepness m ≤ 0, or a lapse rate outside [0, 1).
    """
    if not (np.isfinite(steepness) and steepness > 0):
        raise ValueError(f"steepness: expected a finite number > 0, got {steepness}")
    if not 0 <= lapse_rate < 1:
        raise ValueError(f"lapse_rate: expected a number in [0, 1), got {lapse_rate}")
    match name:
        case "mixed":
            return Mixed(float(steepness), float(max(number_of_preferences, 1)), float(lapse_rate))
        case "logistic":
            return Logistic(float(steepness), float(lapse_rate))
        case "probit":
            return Probit(float(steepness), float(lapse_rate))
    raise ValueError(f'likelihood: expected "mixed", "logistic", "probit" or a Likelihood, got {name!r}')
