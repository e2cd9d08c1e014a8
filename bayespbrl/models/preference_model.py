"""The model of Bayesian PBIRL (eqs. 7-8): its options, its form in NumPyro, and the ellipses that sample it fast.

`preference_model` is for any matrix of differences and any NumPyro algorithm. `PreferenceProblem` is the same model
after the thin factorisation, with a Gaussian reference, padded so that problems of different size share a compilation.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax import random

from bayespbrl import checks
from bayespbrl.models.elliptical_slice import Ellipse
from bayespbrl.models.likelihoods import (
    LIKELIHOODS,
    Likelihood,
    Logistic,
    Mixed,
    Probit,
    WithLapses,
    WithTies,
    log_prob,
    total_log_prob,
)
from bayespbrl.models.low_rank import used_rows


@dataclass(frozen=True)
class PreferenceModel:
    """Prior and likelihood of the posterior (eqs. 7-8): w ~ N(0, σ²I), and p(answer | margin t = wᵀ difference).

    σ and m have units: those of the differences that the model is used with. Only σ·m matters for the probabilities.

    Attributes:
      prior_scale: σ > 0, the standard deviation of each weight.
      steepness: m > 0, the slope of the sigmoid in the margin.
      lapse_rate: λ in [0, 1), the probability that an answer is a coin toss.
      likelihood: "mixed" (eq. 8), "logistic" (Bradley-Terry) or "probit" (Thurstone).
      tie_threshold: δ > 0: margins within it are often answered with "no difference". None: such answers never occur.
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

    def answer_likelihood(self, number_of_preferences: int, indifferent: np.ndarray | None = None) -> Likelihood:
        """The probability of each answer as a function of its margin.

        Args:
          number_of_preferences: K of eq. 8.
          indifferent: which answers were "no difference", bool, one entry for each margin; needs `tie_threshold`. None:
            one for each of the K preferences, all False.

        Raises:
          ValueError: indifferent answers without a tie threshold, or `indifferent` that is no vector of bool.
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


def preference_model(differences, likelihood: Likelihood, *, prior_scale=1.0, used=True) -> None:
    """w ~ N(0, σ²I_D); answer k is "as given" with probability p(t_k), t = differences @ w.

    Sites: `utility_weights` (D,), deterministic `margins` (K,), and `answers`, Bernoulli in the plate "preference",
    observed as 1: each row of the differences is ψ(preferred) − ψ(dominated).

    Args:
      differences: shape (K, D).
      likelihood: p, one of `bayespbrl.models.likelihoods`.
      prior_scale: σ > 0; may be traced, so it may be a site of an enclosing model.
      used: which rows count, shape (K,) or one bool.
    """
    number, dimension = differences.shape
    weights = numpyro.sample("utility_weights", dist.Normal(0, prior_scale).expand([dimension]).to_event(1))
    margins = numpyro.deterministic("margins", differences @ weights)
    # rounding must not lift log p to 0 or above, where the logit is not a number
    log_p = jnp.minimum(log_prob(likelihood, margins), -1e-30)
    with numpyro.plate("preference", number), numpyro.handlers.mask(mask=used):
        logits = log_p - jnp.log(-jnp.expm1(log_p))
        numpyro.sample("answers", dist.Bernoulli(logits=logits), obs=jnp.ones(number, dtype=int))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PreferenceProblem:
    """t = L z, z ~ N(0, σ²I): what the compiled sampler takes, every array padded to the capacity c ≥ K, r.

    Attributes:
      loadings: L, shape (c, c).
      used: rows that carry an answer with a margin other than exactly zero, shape (c,) bool.
      likelihood: p; its arrays padded too.
      prior_scale: σ.
      centre: mean m of the reference, shape (c,).
      site_precisions: s of the reference's precision I/σ² + Lᵀ diag(s) L, shape (c,).
      root, inverse_root: A, with AAᵀ the reference's covariance, and A⁻¹, shapes (c, c).
    """

    loadings: jax.Array
    used: jax.Array
    likelihood: Likelihood
    prior_scale: float
    centre: jax.Array
    site_precisions: jax.Array
    root: jax.Array
    inverse_root: jax.Array


def low_rank_model(problem: PreferenceProblem) -> None:
    """`preference_model` of a problem in low rank; `utility_weights` are then the coordinates z."""
    preference_model(problem.loadings, problem.likelihood, prior_scale=problem.prior_scale, used=problem.used)


def reference_ellipse(problem: PreferenceProblem) -> Ellipse:
    """Ellipses of N(m, AAᵀ) with v = (L(z − m), mᵀ(z − m)/σ², A⁻¹(z − m)), so that a candidate costs O(K).

    The reference differs from the prior by one Gaussian factor an answer, so that their ratio needs the margins alone:
    log N(z; 0, σ²I) − log N(z; m, AAᵀ) = ½ Σ s_k (L(z − m))_k² − mᵀ(z − m)/σ² + a constant.
    Rows that are not used have a margin of zero everywhere, so that they are constants too.
    """
    loadings, centre = problem.loadings, problem.centre
    number = len(loadings)
    map_displacement = jnp.concatenate([loadings, centre[None] / problem.prior_scale**2])
    map_noise = (map_displacement @ problem.root).T
    margins_at_centre = loadings @ centre

    def lift(z):
        return jnp.concatenate([map_displacement @ (z - centre), problem.inverse_root @ (z - centre)])

    def residual(v):
        margins, tilt = v[:, :number], v[:, number]
        log_likelihood = total_log_prob(problem.likelihood, margins_at_centre + margins)
        return log_likelihood + 0.5 * jnp.sum(problem.site_precisions * margins**2, axis=-1) - tilt

    def noise(key, moves):
        whitened = random.normal(key, (moves, number), dtype=loadings.dtype)
        return jnp.concatenate([whitened @ map_noise, whitened], axis=1)

    return Ellipse(lift, noise, residual, lambda v: centre + problem.root @ v[number + 1 :])


def prior_ellipse(problem: PreferenceProblem) -> Ellipse:
    """Ellipses of the prior N(0, σ²I); v = (L z, z)."""
    number, rank = problem.loadings.shape
    map_noise = problem.prior_scale * jnp.concatenate([problem.loadings, jnp.eye(rank)])
    return Ellipse(
        lambda z: jnp.concatenate([problem.loadings @ z, z]),
        lambda key, moves: random.normal(key, (moves, rank), dtype=problem.loadings.dtype) @ map_noise.T,
        lambda v: total_log_prob(problem.likelihood, v[:, :number]),
        lambda v: v[number:],
    )


def padded_problem(
    loadings: np.ndarray,
    likelihood: Likelihood,
    *,
    prior_scale: float,
    mean: np.ndarray,
    site_precisions: np.ndarray,
) -> PreferenceProblem:
    """Pad K answers and rank r to a capacity; padded coordinates keep the prior.

    Args:
      loadings: L, shape (K, r); rows of exactly zero are not used.
      likelihood: p.
      prior_scale: σ.
      mean: of the reference, shape (r,).
      site_precisions: s >= 0 of the reference's precision I/σ² + Lᵀ diag(s) L, shape (K,).
    """
    number, rank = loadings.shape
    capacity = _capacity(number)
    precisions, used = np.zeros(capacity), np.zeros(capacity, dtype=bool)
    used[:number] = used_rows(loadings)
    precisions[:number] = site_precisions
    padded, centre = np.zeros((capacity, capacity)), np.zeros(capacity)
    padded[:number, :rank], centre[:rank] = loadings, mean
    root, inverse_root = prior_scale * np.eye(capacity), np.eye(capacity) / prior_scale
    if rank:
        precision = np.eye(rank) / prior_scale**2 + loadings.T @ (site_precisions[:, None] * loadings)
        inverse_root[:rank, :rank] = np.linalg.cholesky(precision).T
        root[:rank, :rank] = np.linalg.inv(inverse_root[:rank, :rank])
    arrays = [jnp.asarray(a) for a in (padded, used, centre, precisions, root, inverse_root)]
    return PreferenceProblem(
        arrays[0], arrays[1], padded_likelihood(likelihood, capacity), float(prior_scale), *arrays[2:]
    )


def _capacity(number: int) -> int:
    """A power of two, at least 32; above 64, where padding costs more than a compilation, in quarter steps.

    Up to 32 padding costs nothing: a draw takes as long at 32 as at 8, and less than at 16.
    """
    power = max(32, 1 << (max(number, 1) - 1).bit_length())
    step = power // 8
    return power if power <= 64 else -(-number // step) * step


def padded_likelihood(likelihood: Likelihood, capacity: int) -> Likelihood:
    """The likelihood with an entry for every padded row."""
    if isinstance(likelihood, WithTies):
        indifferent = np.zeros(capacity, dtype=bool)
        indifferent[: len(likelihood.indifferent)] = likelihood.indifferent
        return WithTies(likelihood.ordered, likelihood.threshold, indifferent)
    return likelihood
