"""The model of Bayesian PBIRL (eqs. 7-8): its options, and its form in NumPyro."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax import Array
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from bayespbrl import checks
from bayespbrl.models.likelihoods import (
    LIKELIHOODS,
    Likelihood,
    Logistic,
    Mixed,
    Probit,
    Scalar,
    WithLapses,
    WithTies,
    log_prob,
)


@dataclass(frozen=True)
class PreferenceModel:
    """Prior and likelihood (eqs. 7-8): w ~ N(0, σ²I), and the probability of an answer given its margin t = wᵀψ.

    Differences ψ have the unit of the features; the learner divides them by their largest absolute entry. Without ties
    the answers depend on σ·m alone.

    Attributes:
      prior_scale: σ > 0, standard deviation of each weight, in utility per feature.
      steepness: m > 0, slope of the sigmoid, in 1/utility.
      lapse_rate: λ in [0, 1), the probability that an answer is a coin toss.
      likelihood: "mixed" (eq. 8), "logistic" (Bradley-Terry) or "probit" (Thurstone).
      tie_threshold: δ > 0, in utility: margins within it are often answered with "no difference". None: there are no
        such answers.
    """

    prior_scale: float = 1.0
    steepness: float = 5.0
    lapse_rate: float = 0.0
    likelihood: str = "mixed"
    tie_threshold: float | None = None

    def __post_init__(self) -> None:
        checks.positive("prior_scale", self.prior_scale)
        checks.positive("steepness", self.steepness)
        checks.share("lapse_rate", self.lapse_rate, below_one=True)
        checks.one_of("likelihood", self.likelihood, LIKELIHOODS)
        if self.tie_threshold is not None:
            checks.positive("tie_threshold", self.tie_threshold)

    def answer_likelihood(self, number_of_preferences: int, indifferent: ArrayLike | None = None) -> Likelihood:
        """The probability of each answer as a function of its margin.

        Args:
          number_of_preferences: K of eq. 8.
          indifferent: which answers were "no difference", bool, one entry for each margin; needs `tie_threshold`. None
            for K answers of which none was.

        Raises:
          ValueError: indifferent answers without a tie threshold, or an `indifferent` that is not a vector of bool.
        """
        steepness = float(self.steepness)
        likelihood: Mixed | Logistic | Probit | WithLapses
        match self.likelihood:
            case "mixed":
                likelihood = Mixed(steepness, float(max(number_of_preferences, 1)))
            case "logistic":
                likelihood = Logistic(steepness)
            case _:
                likelihood = Probit(steepness)
        if self.lapse_rate > 0:
            likelihood = WithLapses(likelihood, float(self.lapse_rate))
        tied = np.zeros(number_of_preferences, dtype=bool) if indifferent is None else np.asarray(indifferent)
        if self.tie_threshold is None:
            if np.any(tied):
                raise ValueError("tie_threshold: expected a number > 0 because some answers are indifferent, got None")
            return likelihood
        if tied.ndim != 1 or tied.dtype != bool:
            raise ValueError(f"indifferent: expected a vector of bool, got {tied.dtype} of shape {tied.shape}")
        return WithTies(likelihood, float(self.tie_threshold), tied)


def preference_model(
    differences: Float[Array, "k d"] | Float[np.ndarray, "k d"],
    likelihood: Likelihood,
    *,
    prior_scale: Scalar = PreferenceModel.prior_scale,
    used: Bool[Array, " k"] | bool = True,
) -> None:
    """w ~ N(0, σ²I_D); answer k is "as given" with probability p(t_k), t = differences @ w.

    Sites: `utility_weights` (D,), deterministic `margins` (K,), and `answers`, Bernoulli in the plate "preference",
    observed as 1: each row of the differences is ψ(preferred) − ψ(dominated).

    Args:
      differences: ψ(preferred) − ψ(dominated).
      likelihood: p, one of `bayespbrl.models.likelihoods`.
      prior_scale: σ > 0; may be traced, so it may be a site of an enclosing model.
      used: which rows count; one bool for all.
    """
    number, dimension = differences.shape
    weights = numpyro.sample("utility_weights", dist.Normal(0, prior_scale).expand([dimension]).to_event(1))  # eq. 7
    margins = numpyro.deterministic("margins", differences @ weights)
    # eq. 8; rounding must not lift log p to 0 or above, where the logit is not a number
    log_p = jnp.minimum(log_prob(likelihood, margins), -1e-30)
    with numpyro.plate("preference", number), numpyro.handlers.mask(mask=used):
        logits = log_p - jnp.log(-jnp.expm1(log_p))
        numpyro.sample("answers", dist.Bernoulli(logits=logits), obs=jnp.ones(number, dtype=int))
