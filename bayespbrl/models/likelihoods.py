"""The probability of an answer given its margin t = d(w, k, ζ): the preference likelihoods (eq. 8 and its relatives).

Every likelihood here is a constant plus a mixture of probits, p(t) = c + Σⱼ aⱼ Φ((t − oⱼ)/hⱼ): a step is h = 0, and the
logistic function is a scale mixture of normal distribution functions (Andrews & Mallows 1974: scale 2κ, κ Kolmogorov
distributed). Expectation propagation has one closed form for all of them, at any steepness.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int
from scipy.special import ndtr

LIKELIHOODS = ("mixed", "logistic", "probit")  # names of those that have neither lapses nor ties
LEAST_SCALED = 1e-8  # threshold of ties by which their probability is scaled: a product of 32 factors must stay finite
Values = Float[Array, "..."]  # one for each margin, and for each value of a parameter
# a number, or what JAX makes of it where it traces a function, or an array that broadcasts against the margins
Scalar = float | Float[Array, "..."] | Float[np.ndarray, "..."]
Margins = Float[Array, "*b k"] | Float[np.ndarray, "*b k"]


class ProbitMixture(NamedTuple):
    """p(t) = constant + Σⱼ weights[j] Φ((t − offsets[j]) / scales[j]); a scale of 0 is a step with ½ at its offset.

    Answers of different kinds each have a constant and weights.
    """

    constant: float | Float[np.ndarray, " k"]
    weights: Float[np.ndarray, " j"] | Float[np.ndarray, "k j"]
    offsets: Float[np.ndarray, " j"]
    scales: Float[np.ndarray, " j"]

    def of(self, rows: Bool[np.ndarray, " k"] | Int[np.ndarray, " n"]) -> "ProbitMixture":
        """The mixture of some of the answers; the same where all are of one kind."""
        if np.ndim(self.weights) == 1:
            return self
        return self._replace(constant=np.asarray(self.constant)[rows], weights=self.weights[rows])


@runtime_checkable
class Likelihood(Protocol):
    """The probability of the answer that was given, as a function of its margin; a JAX pytree."""

    def factor(self, margins: Margins) -> tuple[Values, Values]:
        """(e, q) with p(answer | t) = exp(e) q, elementwise, e ≤ 0 and q never much below 1/(2K).

        The product of the q over some dozens of answers cannot underflow, so their logarithm is taken once.
        """
        ...

    def probit_mixture(self) -> ProbitMixture:
        """The same probability, as a mixture of probits."""
        ...


def log_prob(likelihood: Likelihood, margins: Margins) -> Values:
    """log p(answer | t), elementwise; JAX-traceable, in the dtype of `margins`."""
    exponent, ratio = likelihood.factor(margins)
    return exponent + jnp.log(ratio)


def prob(likelihood: Likelihood, margins: Float[np.ndarray, "*b k"]) -> Float[np.ndarray, "*b k"]:
    """p(answer | t), elementwise, in float64."""
    with jax.enable_x64(True):
        return np.asarray(np.exp(np.asarray(_log_prob(likelihood, margins))))


_log_prob = jax.jit(log_prob)


def total_log_prob(
    likelihood: Likelihood, margins: Margins, used: Bool[Array, " k"] | Bool[np.ndarray, " k"] | None = None
) -> Float[Array, "*b"]:
    """Σ log p over the answers where `used`, all when None. One logarithm for 32 answers, because it costs most."""
    exponent, ratio = likelihood.factor(margins)
    if used is not None:
        exponent, ratio = jnp.where(used, exponent, 0), jnp.where(used, ratio, 1)
    ratio = jnp.pad(ratio, [(0, 0)] * (ratio.ndim - 1) + [(0, -ratio.shape[-1] % 32)], constant_values=1)
    groups = jnp.prod(ratio.reshape(*ratio.shape[:-1], -1, 32), axis=-1)
    return jnp.sum(exponent, axis=-1) + jnp.sum(jnp.log(groups), axis=-1)


@lru_cache(maxsize=1)
def _logistic_mixture() -> tuple[Float[np.ndarray, " j"], Float[np.ndarray, " j"]]:
    """Weights and scales with sigmoid(x) = Σⱼ weights[j] Φ(x / scales[j]), to 1e-15 everywhere.

    The trapezoidal rule in log κ over the Kolmogorov density, Σₙ (−1)ⁿ⁺¹ 8 n² κ exp(−2n²κ²), or its theta-function twin
    for small κ; it converges geometrically because the integrand vanishes with all derivatives at both ends.
    """
    log_kappa = np.linspace(np.log(0.14), np.log(4.3), 28)
    kappa = np.exp(log_kappa)[:, None]
    n = np.arange(1, 60)
    # Andrews & Mallows (1974): κ has Kolmogorov's distribution
    large = np.sum((-1.0) ** (n + 1) * 8 * n**2 * kappa * np.exp(-2 * n**2 * kappa**2), axis=1)
    odd = (2 * n - 1) * np.pi / np.sqrt(8)
    small = np.sum(np.sqrt(2 * np.pi) * (2 * odd**2 / kappa**4 - 1 / kappa**2) * np.exp(-((odd / kappa) ** 2)), axis=1)
    weights = np.where(kappa[:, 0] > 0.8, large, small) * kappa[:, 0]
    return weights / weights.sum(), 2 * kappa[:, 0]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Mixed:
    """The paper's mixture of a 0-1 and a sigmoid likelihood (eq. 8): ((K − 1) 1[t > 0] + sigmoid(m t)) / K, 1[0] = ½.

    Attributes:
      steepness: m > 0.
      number_of_preferences: K of eq. 8. It stays the full K when the likelihood predicts a held-out answer.
    """

    steepness: Scalar
    number_of_preferences: Scalar

    def factor(self, margins: Margins) -> tuple[Values, Values]:
        """exp(min(m t, 0)) times a ratio between 1/(2K) and 1."""
        scaled = self.steepness * margins
        decay = jnp.exp(-jnp.abs(scaled))
        share = 1 / self.number_of_preferences
        above = 1 + decay * (1 - share)
        # eq. 8; at 0 the step is ½; a NaN margin makes `decay` NaN and stays NaN
        return jnp.minimum(scaled, 0), jnp.where(margins > 0, above, jnp.where(margins < 0, share, 1.0)) / (1 + decay)

    def probit_mixture(self) -> ProbitMixture:
        """A step and a smooth part."""
        weights, scales = _logistic_mixture()
        share = 1 / self.number_of_preferences
        return _mixture(np.append(share * weights, 1 - share), np.append(scales / self.steepness, 0.0))  # eq. 8


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Logistic:
    """The sigmoid of eq. 8 alone, sigmoid(m t): the model of Bradley & Terry (1952)."""

    steepness: Scalar

    def factor(self, margins: Margins) -> tuple[Values, Values]:
        """exp(min(m t, 0)) / (1 + exp(−|m t|))."""
        scaled = self.steepness * margins
        return jnp.minimum(scaled, 0), 1 / (1 + jnp.exp(-jnp.abs(scaled)))  # eq. 8, L_sig

    def probit_mixture(self) -> ProbitMixture:
        """The scale mixture of the logistic function."""
        weights, scales = _logistic_mixture()
        return _mixture(weights, scales / self.steepness)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Probit:
    """Φ(m t): the model of Thurstone (1927)."""

    steepness: Scalar

    def factor(self, margins: Margins) -> tuple[Values, Values]:
        """Φ(m t) itself is the exponential of its logarithm."""
        exponent = jax.scipy.special.log_ndtr(self.steepness * margins)  # Thurstone (1927)
        return exponent, jnp.ones_like(exponent)

    def probit_mixture(self) -> ProbitMixture:
        """One probit."""
        return _mixture(np.ones(1), np.array([1 / self.steepness]))


Ordered = Mixed | Logistic | Probit  # neither lapses nor ties


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WithLapses:
    """A constant share of answers at random around any likelihood: λ/g + (1 − λ) p, each of g answers equally probable.

    They are two, coin tosses, so that 20 % wrong answers are λ = 0.4; where ties are possible, three. Answers that
    contradict each other then always have a probability, ties too.

    Source: Wichmann & Hill (2001), eq. 1, with equal rates of guesses and lapses.

    Attributes:
      attentive: the likelihood p of an answer that is not given at random.
      lapse_rate: λ in [0, 1).
    """

    attentive: Likelihood
    lapse_rate: Scalar

    @property
    def choices(self) -> int:
        """g."""
        return 3 if isinstance(self.attentive, WithTies) else 2

    def factor(self, margins: Margins) -> tuple[Values, Values]:
        """e is the larger exponent of both terms."""
        exponent, ratio = self.attentive.factor(margins)
        floor = jnp.log(self.lapse_rate / self.choices)
        above = exponent > floor
        smaller = jnp.exp(-jnp.abs(exponent - floor))  # of exp(e) and λ/g, over the larger
        lapsed, attentive = jnp.where(above, smaller, 1.0), jnp.where(above, 1.0, smaller)
        # Wichmann & Hill (2001), eq. 1
        return jnp.maximum(exponent, floor), lapsed + (1 - self.lapse_rate) * attentive * ratio

    def probit_mixture(self) -> ProbitMixture:
        """The mixture shrunk, and a constant."""
        constant, weights, offsets, scales = self.attentive.probit_mixture()
        lapses, keep = float(self.lapse_rate), 1 - float(self.lapse_rate)
        # Wichmann & Hill (2001), eq. 1
        return ProbitMixture(lapses / self.choices + keep * constant, keep * weights, offsets, scales)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WithTies:
    """A threshold within which people say "no difference" (Rao & Kupper 1967), around a likelihood without lapses.

    p(≻) = p(t − δ), p(≺) = p(−t − δ), p(tie) = p(t + δ) − p(t − δ); they sum to one because p(t) + p(−t) = 1.

    Attributes:
      ordered: the likelihood p of an answer without a threshold.
      threshold: δ > 0, in units of the margin.
      indifferent: which answers were "no difference", in the order of the margins' last axis.
    """

    ordered: Ordered
    threshold: Scalar
    indifferent: Bool[Array, "*b k"] | Bool[np.ndarray, "*b k"]

    def factor(self, margins: Margins) -> tuple[Values, Values]:
        """Of a tie e is that of the upper term times δ / (1 + δ): q, what the lower one leaves, cannot underflow."""
        # p(tie) is symmetric: at −|t| both terms are small and their difference keeps its relative precision
        below = -jnp.abs(margins)
        exponent, ratio = self.ordered.factor(
            jnp.where(self.indifferent, below + self.threshold, margins - self.threshold)
        )
        lower, of_lower = self.ordered.factor(below - self.threshold)
        scale = 1 + 1 / jnp.maximum(self.threshold, LEAST_SCALED)
        # Rao & Kupper (1967): p(tie) = p(t + δ) − p(t − δ)
        left = jnp.maximum(ratio - jnp.exp(lower - exponent) * of_lower, 0) * scale
        exponent = jnp.where(self.indifferent, exponent - jnp.log(scale), exponent)
        return exponent, jnp.where(self.indifferent, left, ratio)

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


def has_steps(likelihood: Likelihood) -> bool:
    """Whether the likelihood jumps, as eq. 8 does. Given many answers the posterior of any other is nearly Gaussian."""
    if isinstance(likelihood, WithLapses):
        return has_steps(likelihood.attentive)
    return isinstance(likelihood.ordered if isinstance(likelihood, WithTies) else likelihood, Mixed)


def ties_of(likelihood: Likelihood) -> WithTies | None:
    """The part of the likelihood that has a threshold; None where there is none."""
    if isinstance(likelihood, WithLapses):
        return ties_of(likelihood.attentive)
    return likelihood if isinstance(likelihood, WithTies) else None


def with_threshold(
    likelihood: Likelihood, threshold: Scalar, indifferent: Bool[Array, "*b k"] | Bool[np.ndarray, "*b k"]
) -> Likelihood:
    """A likelihood without ties, with this threshold; `indifferent` as in `WithTies`."""
    if isinstance(likelihood, WithLapses):
        return replace(likelihood, attentive=with_threshold(likelihood.attentive, threshold, indifferent))
    if not isinstance(likelihood, Ordered):
        raise ValueError(f"likelihood: expected one without ties, got {type(likelihood).__name__}")
    return WithTies(likelihood, threshold, indifferent)


def likelihood_of(
    name: str,
    number_of_preferences: float,
    *,
    steepness: Scalar,
    lapse_rate: Scalar | None = None,
    tie_threshold: Scalar | None = None,
    indifferent: Bool[Array, " k"] | Bool[np.ndarray, " k"] | None = None,
) -> Likelihood:
    """The likelihood `name` with these values: numbers, or arrays that broadcast against the margins.

    Args:
      name: one of `LIKELIHOODS`.
      number_of_preferences: K of eq. 8.
      steepness: m.
      lapse_rate: λ; None for no lapses.
      tie_threshold: δ; None for no ties.
      indifferent: which answers were "no difference"; goes with a threshold.
    """
    ordered: Ordered | WithLapses
    if name == "mixed":
        ordered = Mixed(steepness, number_of_preferences)
    else:
        ordered = (Logistic if name == "logistic" else Probit)(steepness)
    if lapse_rate is not None:
        ordered = WithLapses(ordered, lapse_rate)
    if tie_threshold is None:
        return ordered
    if indifferent is None:
        raise ValueError("indifferent: expected which answers were ties, because there is a tie_threshold, got None")
    return with_threshold(ordered, tie_threshold, indifferent)


def smoothed_probability(
    likelihood: Likelihood, margins: Float[np.ndarray, "*b k"], spread: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "*b k"]:
    """E p(t) over t ~ N(margin, spread²), exactly: each probit of the mixture stays one; for an ordered answer."""
    if isinstance(likelihood, WithLapses):
        # Wichmann & Hill (2001), eq. 1
        lapses = np.asarray(likelihood.lapse_rate)
        attentive = smoothed_probability(likelihood.attentive, margins, spread)
        return np.asarray(lapses / likelihood.choices + (1 - lapses) * attentive)
    if isinstance(likelihood, WithTies):
        # Rao & Kupper (1967): p(t − δ)
        return smoothed_probability(likelihood.ordered, margins - np.asarray(likelihood.threshold), spread)
    if isinstance(likelihood, Mixed):
        share = 1 / np.asarray(likelihood.number_of_preferences)
        smooth = smoothed_probability(Logistic(likelihood.steepness), margins, spread)
        # eq. 8
        return np.asarray((1 - share) * _widened(margins, np.zeros(1), spread) + share * smooth)
    if not isinstance(likelihood, Logistic | Probit):
        raise ValueError(f"likelihood: expected one of this module, got {type(likelihood).__name__}")
    weights, scales = _logistic_mixture() if isinstance(likelihood, Logistic) else (np.ones(1), np.ones(1))
    # Andrews & Mallows (1974): sigmoid = Σⱼ wⱼ Φ(·/hⱼ)
    parts = zip(weights, scales, strict=True)
    return np.asarray(sum(w * _widened(margins, h / np.asarray(likelihood.steepness), spread) for w, h in parts))


def _widened(
    margins: Float[np.ndarray, "*b k"], scale: Float[np.ndarray, "..."], spread: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "*b k"]:
    """Φ(t / √(h² + spread²)), a step where both are zero (Rasmussen & Williams 2006, section 3.9)."""
    width = np.broadcast_to(np.hypot(scale, spread), margins.shape)
    step = (1 + np.sign(margins)) / 2
    return np.where(width > 0, ndtr(margins / np.where(width > 0, width, 1.0)), step)


def _mixture(weights: Float[np.ndarray, " j"], scales: Float[np.ndarray, " j"]) -> ProbitMixture:
    return ProbitMixture(0.0, weights, np.zeros_like(scales), scales)
