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
      centre, root: mean m and Cholesky factor A of the reference's covariance, shapes (c,) and (c, c).
      inverse_root: A⁻¹.
    """

    loadings: jax.Array
    used: jax.Array
    likelihood: Likelihood
    prior_scale: float
    centre: jax.Array
    root: jax.Array
    inverse_root: jax.Array


def low_rank_model(problem: PreferenceProblem) -> None:
    """`preference_model` of a problem in low rank; `utility_weights` are then the coordinates z."""
    preference_model(problem.loadings, problem.likelihood, prior_scale=problem.prior_scale, used=problem.used)


def reference_ellipse(problem: PreferenceProblem) -> Ellipse:
    """Ellipses of N(m, AAᵀ); v = (L(z − m), z − m, A⁻¹(z − m)), so that a candidate costs O(K + r)."""
    loadings, centre = problem.loadings, problem.centre
    number, rank = loadings.shape
    map_noise = jnp.concatenate([loadings @ problem.root, problem.root])
    margins_at_centre = loadings @ centre

    def lift(z):
        return jnp.concatenate([loadings @ (z - centre), z - centre, problem.inverse_root @ (z - centre)])

    def residual(v):
        margins, displacements, whitened = v[:, :number], v[:, number : number + rank], v[:, number + rank :]
        log_likelihood = total_log_prob(problem.likelihood, margins_at_centre + margins, problem.used)
        prior = jnp.sum((centre + displacements) ** 2, axis=-1) / problem.prior_scale**2
        return log_likelihood + 0.5 * (jnp.sum(whitened**2, axis=-1) - prior)

    def noise(key, moves):
        whitened = random.normal(key, (moves, rank), dtype=loadings.dtype)
        return jnp.concatenate([whitened @ map_noise.T, whitened], axis=1)

    return Ellipse(
        lift,
        noise,
        residual,
        lambda v: centre + v[number : number + rank],
    )


def prior_ellipse(problem: PreferenceProblem) -> Ellipse:
    """Ellipses of the prior N(0, σ²I); v = (L z, z)."""
    number, rank = problem.loadings.shape
    map_noise = problem.prior_scale * jnp.concatenate([problem.loadings, jnp.eye(rank)])
    return Ellipse(
        lambda z: jnp.concatenate([problem.loadings @ z, z]),
        lambda key, moves: random.normal(key, (moves, rank), dtype=problem.loadings.dtype) @ map_noise.T,
        lambda v: total_log_prob(problem.likelihood, v[:, :number], problem.used),
        lambda v: v[number:],
    )


def padded_problem(
    loadings: np.ndarray,
    likelihood: Likelihood,
    *,
    prior_scale: float,
    mean: np.ndarray,
    covariance: np.ndarray,
) -> PreferenceProblem:
    """Pad K answers and rank r to a capacity: a power of two, at least 8, or three quarters of one above 64.

    Padded coordinates keep the prior.

    Args:
      loadings: L, shape (K, r); rows of exactly zero are not used.
      likelihood: p.
      prior_scale: σ.
      mean, covariance: of the reference, shapes (r,) and (r, r).
    """
    number, rank = loadings.shape
    capacity = max(8, 1 << (max(number, 1) - 1).bit_length())
    # above 64 the padding costs more than the compilation that a step between two powers saves
    capacity = 3 * capacity // 4 if capacity > 64 and number <= 3 * capacity // 4 else capacity
    padded, used = np.zeros((capacity, capacity)), np.zeros(capacity, dtype=bool)
    padded[:number, :rank] = loadings
    used[:number] = np.any(loadings != 0, axis=1)
    root = prior_scale * np.eye(capacity)
    inverse_root = np.eye(capacity) / prior_scale
    if rank:
        root[:rank, :rank] = np.linalg.cholesky(covariance)
        inverse_root[:rank, :rank] = np.linalg.inv(root[:rank, :rank])
    centre = np.zeros(capacity)
    centre[:rank] = mean
    arrays = [jnp.asarray(a) for a in (padded, used, centre, root, inverse_root)]
    return PreferenceProblem(
        arrays[0], arrays[1], padded_likelihood(likelihood, capacity), float(prior_scale), *arrays[2:]
    )


def padded_likelihood(likelihood: Likelihood, capacity: int) -> Likelihood:
    """The likelihood with an entry for every padded row."""
    if isinstance(likelihood, WithTies):
        indifferent = np.zeros(capacity, dtype=bool)
        indifferent[: len(likelihood.indifferent)] = likelihood.indifferent
        return WithTies(likelihood.ordered, likelihood.threshold, indifferent)
    return likelihood
