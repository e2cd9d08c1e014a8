"""The model of eqs. 7-8 after the thin factorisation, with a Gaussian reference, and the ellipses that sample it fast.

It is conditional on all that is not a weight; `bayespbrl.models.gibbs` samples that.

Arrays are padded, so that problems of different size share a compilation.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, random
from jaxtyping import Bool, Float, PRNGKeyArray

from bayespbrl.models.elliptical_slice import Ellipse
from bayespbrl.models.likelihoods import Likelihood, Scalar, WithLapses, WithTies, total_log_prob
from bayespbrl.models.low_rank import used_rows
from bayespbrl.models.preference_model import preference_model


class PreferenceProblem(NamedTuple):
    """t = L z, z ~ N(0, σ²I): what the compiled sampler takes, padded to capacities c ≥ K and q ≥ r.

    Attributes:
      loadings: L.
      used: rows that carry an answer with a margin other than exactly zero.
      likelihood: p; its arrays padded too.
      prior_scale: σ.
      centre: mean m of the reference.
      site_precisions: s of the reference's precision (1/σ² + e) I + Lᵀ diag(s) L.
      root, inverse_root: A, with AAᵀ the reference's covariance, and A⁻¹.
      excess: e; None for zero.
      width: w where there is an excess; the reference's covariance is then w² AAᵀ.
    """

    loadings: Float[Array, "c q"]
    used: Bool[Array, " c"]
    likelihood: Likelihood
    prior_scale: Scalar
    centre: Float[Array, " q"]
    site_precisions: Float[Array, " c"]
    root: Float[Array, "q q"]
    inverse_root: Float[Array, "q q"]
    excess: Scalar | None = None
    width: Scalar | None = None


def low_rank_model(problem: PreferenceProblem) -> None:
    """`preference_model` of a problem in low rank; `utility_weights` are then the coordinates z."""
    preference_model(problem.loadings, problem.likelihood, prior_scale=problem.prior_scale, used=problem.used)


def reference_ellipse(problem: PreferenceProblem) -> Ellipse:
    """Ellipses of N(m, AAᵀ) with v = (L(z − m), mᵀ(z − m)/σ², A⁻¹(z − m)), so that a candidate costs O(K).

    The reference differs from the prior by one Gaussian factor an answer, so that their ratio needs the margins alone:
    log N(z; 0, σ²I) − log N(z; m, AAᵀ) = ½ Σ s_k (L(z − m))_k² + ½ e |z − m|² − mᵀ(z − m)/σ² + a constant.
    Rows that are not used have a margin of zero everywhere, so that they are constants too. With an excess e, v has
    z − m too.
    """
    loadings, centre = problem.loadings, problem.centre
    number, rank = loadings.shape
    if problem.excess is not None:
        return _scaled_ellipse(problem, problem.excess)
    map_displacement = jnp.concatenate([loadings, centre[None] / problem.prior_scale**2])
    map_noise = (map_displacement @ problem.root).T
    margins_at_centre = loadings @ centre

    def lift(z: Float[Array, " q"]) -> Float[Array, " v"]:
        return jnp.concatenate([map_displacement @ (z - centre), problem.inverse_root @ (z - centre)])

    def residual(v: Float[Array, "j v"]) -> Float[Array, " j"]:
        margins, tilt = v[:, :number], v[:, number]
        log_likelihood = total_log_prob(problem.likelihood, margins_at_centre + margins)
        # Nishihara, Murray & Adams (2014), section 3: prior × likelihood / reference
        return log_likelihood + 0.5 * jnp.sum(problem.site_precisions * margins**2, axis=-1) - tilt

    def noise(key: PRNGKeyArray, moves: int) -> Float[Array, "{moves} v"]:
        whitened = random.normal(key, (moves, rank), dtype=loadings.dtype)
        return jnp.concatenate([whitened @ map_noise, whitened], axis=1)

    return Ellipse(lift, noise, residual, lambda v: centre + problem.root @ v[number + 1 :])


def _scaled_ellipse(problem: PreferenceProblem, excess: Scalar) -> Ellipse:
    """`reference_ellipse` with an excess: v = (L(z − m), mᵀ(z − m)/σ², z − m)."""
    loadings, centre = problem.loadings, problem.centre
    number, rank = loadings.shape
    margins_at_centre, width = loadings @ centre, 1.0 if problem.width is None else problem.width

    def lifted(displacement: Float[Array, "*j q"]) -> Float[Array, "*j v"]:
        tilt = displacement @ centre[:, None] / problem.prior_scale**2
        return jnp.concatenate([displacement @ loadings.T, tilt, displacement], axis=-1)

    def residual(v: Float[Array, "j v"]) -> Float[Array, " j"]:
        margins, tilt, displacement = v[:, :number], v[:, number], v[:, number + 1 :]
        log_likelihood = total_log_prob(problem.likelihood, margins_at_centre + margins)
        squares = jnp.sum(problem.site_precisions * margins**2, axis=-1) + excess * jnp.sum(displacement**2, axis=-1)
        # Nishihara, Murray & Adams (2014), section 3: prior × likelihood / reference
        return log_likelihood + 0.5 * squares - tilt

    def noise(key: PRNGKeyArray, moves: int) -> Float[Array, "{moves} v"]:
        # one product after the other: that of both matrices would cost more than all moves
        whitened = random.normal(key, (moves, rank), dtype=loadings.dtype)
        return lifted(jnp.asarray(width * (whitened @ problem.root.T)))

    return Ellipse(lambda z: lifted(z - centre), noise, residual, lambda v: centre + v[number + 1 :])


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
    loadings: Float[np.ndarray, "k r"],
    likelihood: Likelihood,
    *,
    prior_scale: float,
    mean: Float[np.ndarray, " r"],
    site_precisions: Float[np.ndarray, " k"],
    rank_at_least: int = 0,
) -> PreferenceProblem:
    """Pad K answers and rank r to capacities; padded coordinates keep the prior.

    Args:
      loadings: L; rows of exactly zero are not used.
      likelihood: p.
      prior_scale: σ.
      mean: of the reference.
      site_precisions: s of the reference's precision I/σ² + Lᵀ diag(s) L, which is positive definite.
      rank_at_least: so that problems of different rank can be stacked.
    """
    number, rank = loadings.shape
    capacity, wide = padded_size(number), padded_size(max(rank, rank_at_least))
    precisions, used = np.zeros(capacity), np.zeros(capacity, dtype=bool)
    used[:number] = used_rows(loadings)
    precisions[:number] = site_precisions
    padded, centre = np.zeros((capacity, wide)), np.zeros(wide)
    padded[:number, :rank], centre[:rank] = loadings, mean
    root, inverse_root = prior_scale * np.eye(wide), np.eye(wide) / prior_scale
    if rank:
        # Rasmussen & Williams (2006), eq. 3.53: I/σ² + Lᵀ diag(s) L
        precision = np.eye(rank) / prior_scale**2 + loadings.T @ (site_precisions[:, None] * loadings)
        # A is lower triangular, as L is: whitened coordinates mean alike under different features
        inverse_root[:rank, :rank] = np.linalg.cholesky(precision[::-1, ::-1])[::-1, ::-1].T
        root[:rank, :rank] = np.linalg.inv(inverse_root[:rank, :rank])
    # not by jnp.asarray, which compiles a program for each shape
    arrays = jax.device_put((padded, used, centre, precisions, root, inverse_root))
    return PreferenceProblem(
        arrays[0], arrays[1], _padded_likelihood(likelihood, capacity), float(prior_scale), *arrays[2:]
    )


def padded_size(number: int) -> int:
    """A power of two, at least 32; above 64, where padding costs more than a compilation, in quarter steps.

    Up to 32 padding costs nothing: a draw takes as long at 32 as at 8, and less than at 16.
    """
    power = max(32, 1 << (max(number, 1) - 1).bit_length())
    step = power // 8
    return power if power <= 64 else -(-number // step) * step


def _padded_likelihood(likelihood: Likelihood, capacity: int) -> Likelihood:
    """The likelihood with an entry for every padded row."""
    if isinstance(likelihood, WithLapses):
        return replace(likelihood, attentive=_padded_likelihood(likelihood.attentive, capacity))
    if isinstance(likelihood, WithTies):
        tied = np.asarray(likelihood.indifferent)
        return replace(likelihood, indifferent=np.pad(tied, (0, capacity - len(tied))))
    return likelihood
