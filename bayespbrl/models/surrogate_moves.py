"""Gibbs moves between settings of the features that keep the margins nearly as they are, for chains that get stuck.

The moves of `bayespbrl.models.gibbs` carry the weights from one setting's Gaussian reference to that of another. Where
answers contradict each other, the posterior has several modes, each of which follows other answers, and references are
far from all of them: a mode that two settings share is then mapped to a point of negligible probability. The moves
here keep the margins instead, and with them which answers are followed.

Noisy margins are drawn, g ~ N(L z, τ²I). Given g the weights have a Gaussian distribution N(m, AAᵀ) under each
setting, before the answers. Setting and weights move together so that g and the whitened weights A⁻¹ (z − m) stay
(surrogate data; Murray and Adams 2010). A small τ keeps the margins; with a large one this is the move of weights that
are whitened by the prior.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, random
from jaxtyping import Float, PRNGKeyArray

from bayespbrl.models.gibbs import FEW, JointProblem, Surrogate, Unknowns, log_likelihood

# Standard deviations τ of the noise, where margins have a root mean square of 1 a priori.
NOISE = (0.1, 0.5)


def with_surrogates(problem: JointProblem, noise: Sequence[float] = NOISE) -> JointProblem:
    """The same problem with a move for each τ; as it is if it has them, with one setting, or above `FEW` answers.

    τ is in units of the margins: of their scale a priori, rounded to a power of two.
    """
    if problem.surrogates:
        return problem
    loadings, prior_scale = np.asarray(problem.settings.loadings), float(problem.settings.prior_scale)
    squares = np.einsum("skq,skr->sqr", loadings, loadings)
    rows = np.sum(np.any(loadings != 0, axis=2))
    if len(loadings) == 1 or loadings.shape[1] > FEW or not rows:
        return problem
    unit = 2.0 ** np.round(np.log2(prior_scale * np.sqrt(np.trace(squares, axis1=1, axis2=2).sum() / rows)))
    prior_precision = np.eye(loadings.shape[2]) / prior_scale**2
    them = []
    for tau in unit * np.asarray(noise):
        inverse_root = np.linalg.cholesky(prior_precision + squares / tau**2).mT
        them.append(Surrogate(*jax.device_put((tau, np.linalg.inv(inverse_root), inverse_root))))
    return problem._replace(surrogates=tuple(them))


def surrogate_moves(
    key: PRNGKeyArray, z: Float[Array, " q"], unknowns: Unknowns, problem: JointProblem
) -> tuple[Float[Array, " q"], Unknowns]:
    """New weights and setting after a move for each τ."""
    for surrogate, each in zip(problem.surrogates, random.split(key, len(problem.surrogates)), strict=True):
        z, unknowns = _surrogate_move(each, z, unknowns, problem, surrogate)
    return z, unknowns


def _surrogate_move(
    key: PRNGKeyArray, z: Float[Array, " q"], unknowns: Unknowns, problem: JointProblem, surrogate: Surrogate
) -> tuple[Float[Array, " q"], Unknowns]:
    """The setting drawn from its distribution given g and the weights whitened by it, and the weights under it."""
    key_noise, key_setting = random.split(key)
    loadings, now = problem.settings.loadings, unknowns.setting
    tau, root, inverse_root = surrogate
    noisy = loadings[now] @ z
    noisy += tau * random.normal(key_noise, noisy.shape, dtype=z.dtype)
    # A Aᵀ = (I/σ² + LᵀL/τ²)⁻¹ and m = A c with c = Aᵀ Lᵀ g / τ²
    centres = jnp.einsum("sqr,skq,k->sr", root, loadings, noisy) / tau**2
    whitened = inverse_root[now] @ z - centres[now]
    points = jnp.einsum("sqr,sr->sq", root, centres + whitened)
    # log N(g; 0, σ² L Lᵀ + τ²I), but for what all settings share
    log_p = 0.5 * jnp.sum(centres**2, axis=1) + jnp.sum(jnp.log(jnp.diagonal(root, axis1=1, axis2=2)), axis=1)
    log_p += problem.log_probabilities + log_likelihood(problem, unknowns, jnp.einsum("skq,sq->sk", loadings, points))
    setting = random.categorical(key_setting, log_p)
    return points[setting], unknowns._replace(setting=setting)
