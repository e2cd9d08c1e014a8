"""The log marginal likelihood of the answers by bridge sampling, with its Monte Carlo error (Meng and Wong 1996).

Two samples are compared: the posterior's draws, and draws of a proposal that has the priors of all that is not a weight
and, for the weights under each setting, the Gaussian reference of the chains. The identity is exact for any proposal;
expectation propagation's own estimate is not, where answers contradict each other.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int
from scipy.special import logsumexp

from bayespbrl.models.chains import Chains
from bayespbrl.models.convergence import chain_convergence
from bayespbrl.models.gibbs import JointProblem, Unknowns, conditional, log_likelihood, prior_draws, reference_scale

NUMBER = 1000  # draws of each sample
LEAST_OVERLAP = 5.0  # effective draws of each sample that are as the other's; with fewer the error is not known
TOLERANCE, ITERATIONS = 1e-9, 1000  # nats; the fixed point converges geometrically, fast where the two samples overlap


def log_evidence(chains: Chains, length: int, *, seed: int) -> tuple[float, float]:
    """Log marginal likelihood in nats, and its standard error, from the first `length` draws of each chain.

    The error is infinite where hardly any of the posterior's draws are as those of the proposal.

    Source: Meng & Wong (1996), eqs. 2.3 and 4.1; the error is that of the two means of the last iteration.
    """
    if chains.number == 0:
        return 0.0, 0.0
    z = chains.collected("coordinates", length)
    each = (
        np.linspace(0, length - 1, max(4, NUMBER // z.shape[0])).round().astype(int)
    )  # as many, however long the chains are
    rank, rng = chains.problem.settings.centre.shape[1], np.random.default_rng([seed, 3])
    scale = float(chains.problem.settings.prior_scale)
    padding = scale * rng.standard_normal((z.shape[0], len(each), rank - z.shape[2]))
    z = np.concatenate([z[:, each], padding], axis=2)
    drawn = [chains.collected(name, length)[:, each] for name in Unknowns._fields]
    proposed, of_proposal = _proposed(chains.problem, rng)
    rows = z.shape[0] * len(each)
    together = [np.concatenate([a.reshape(rows, *a.shape[2:]), b]) for a, b in zip(drawn, of_proposal, strict=True)]
    with jax.enable_x64(True):
        points = np.concatenate([z.reshape(rows, rank), proposed])
        points, together = jax.device_put((points, together))
        # the moves' matrices do not enter, and would be a compilation more
        ratios = np.asarray(_log_ratios(chains.problem._replace(surrogates=()), points, Unknowns(*together)))
    of_posterior = ratios[:rows].reshape(z.shape[:2])
    relative = float(np.min(chain_convergence(of_posterior[..., None]).effective_sample_size)) / rows
    return _bridged(ratios[:rows], ratios[rows:], min(relative, 1.0))


def _bridged(
    posterior: Float[np.ndarray, " p"], proposal: Float[np.ndarray, " n"], relative: float
) -> tuple[float, float]:
    effective, number = relative * len(posterior), len(proposal)
    log_share, log_rest = np.log([effective / (effective + number), number / (effective + number)])
    estimate = 0.0 if np.all(proposal == -np.inf) else float(logsumexp(proposal) - np.log(number))
    last = np.inf
    for _ in range(ITERATIONS):  # Meng & Wong (1996), eq. 4.1, in logarithms
        if abs(estimate - last) < TOLERANCE:
            break
        last = estimate
        above = proposal - np.logaddexp(log_share + proposal, log_rest + estimate)
        below = -np.logaddexp(log_share + posterior, log_rest + estimate)
        estimate = float(logsumexp(above) - np.log(len(proposal)) - logsumexp(below) + np.log(len(posterior)))
    above, below = np.exp(above - above.max()), np.exp(below - below.max())
    if min(each.sum() ** 2 / np.sum(each**2) for each in (above, below)) < LEAST_OVERLAP:
        return estimate, float("inf")
    errors = [  # of the two means of Meng & Wong (1996), eq. 2.3, by the delta method
        np.var(values) / np.mean(values) ** 2 / size for values, size in ((above, number), (below, effective))
    ]
    return estimate, float(np.sqrt(sum(errors)))


def _proposed(
    problem: JointProblem, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "n q"], list[Int[np.ndarray, "n ..."]]]:
    """Draws of the weights and of the unknowns from the proposal."""
    probabilities = np.exp(np.asarray(problem.log_probabilities, dtype=np.float64))
    setting = rng.choice(len(probabilities), NUMBER, p=probabilities / probabilities.sum())
    unknowns = [setting, *prior_draws(problem, rng, NUMBER)]
    points = np.array(problem.settings.centre)[setting]
    noise = rng.standard_normal(points.shape)
    for number, root in enumerate(np.asarray(problem.settings.root)):
        chosen = setting == number
        points[chosen] += noise[chosen] @ root.T
    return points * np.asarray(reference_scale(problem, Unknowns(*jax.device_put(unknowns))))[..., None], unknowns


@jax.jit
def _log_ratios(problem: JointProblem, z: Float[Array, "n q"], unknowns: Unknowns) -> Float[Array, " n"]:
    """log (prior × likelihood / proposal) of each; the priors of all but the weights cancel."""

    def one(z: Float[Array, " q"], unknowns: Unknowns) -> Float[Array, ""]:
        given = conditional(problem, unknowns)
        log_p = log_likelihood(problem, unknowns, given.loadings @ z)
        whitened = given.inverse_root @ (z - given.centre)
        scale = given.prior_scale
        if given.width is not None:
            whitened /= given.width
            log_p += len(z) * jnp.log(given.width)
        # eq. 7, over the density of the reference
        log_p += 0.5 * jnp.sum(whitened**2) - 0.5 * jnp.sum(z**2) / scale**2 - len(z) * jnp.log(scale)
        return log_p + jnp.sum(jnp.log(jnp.diagonal(given.root)))

    return jax.vmap(one)(z, unknowns)
