"""The model of Bayesian PBIRL in NumPyro (eqs. 7-8), and the ellipses that make it fast to sample.

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

from bayespbrl.models.elliptical_slice import Ellipse
from bayespbrl.models.likelihoods import Likelihood, WithTies, log_prob, total_log_prob
from bayespbrl.models.low_rank import used_rows


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
