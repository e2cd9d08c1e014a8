"""The paper's sampler: one chain of plain elliptical slices, its first half discarded, without a check of convergence.

To see what convergence is good for. Each move goes round an ellipse of the prior, from a start at a draw of the prior.
The moves are made in the coordinates that the answers determine, where they have the same law as in all D dimensions.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax import Array, lax
from jaxtyping import Bool, Float, Int, Shaped
from numpy.typing import ArrayLike

from bayespbrl import checks
from bayespbrl.models.chains import Chains
from bayespbrl.models.convergence import chain_convergence
from bayespbrl.models.elliptical_slice import Ellipse
from bayespbrl.models.elliptical_slice_kernel import Args, EllipticalSlice, EllipticalSliceState, Keywords
from bayespbrl.models.evidence import log_evidence
from bayespbrl.models.gaussian_fit import fit_gaussian
from bayespbrl.models.gibbs import conditional
from bayespbrl.models.likelihoods import log_prob
from bayespbrl.models.posterior_tree import fit_attributes, margins_of, posterior_tree, settings_of
from bayespbrl.models.preference_model import NOTHING_ELSE, PreferenceModel
from bayespbrl.models.preference_problem import PreferenceProblem, low_rank_model, prior_ellipse
from bayespbrl.models.threads import one_blas_thread

LEAST = 16  # draws: half of them are kept, and R̂ needs twice four
# Decision: at most this many draws of the second half are kept, evenly spaced; the moves between them are not stored.
KEPT = 1000


def plain_draws(
    differences: ArrayLike,
    model: PreferenceModel,
    *,
    draws: int,
    seed: int,
    number_of_preferences: int | None = None,
) -> xr.DataTree:
    """`posterior_draws` by `draws` plain moves of one chain, of which the first half is discarded.

    Args:
      differences: ψ(preferred) − ψ(dominated), shape (K, D), or (1, K, D).
      model: steepness and lapse rate given.
      draws: moves in all, >= 16; the paper makes 200 000.
      seed: of all draws.
      number_of_preferences: K of eq. 8; all rows by default.

    Raises:
      ValueError: several settings of the features; a model that leaves something to be inferred.
    """
    draws, seed = checks.whole("draws", draws, LEAST), checks.seed(seed)
    settings = settings_of(differences)
    if len(settings) > 1 or model.steepness is None or model.lapse_rate is None:
        raise ValueError(
            "plain draws: expected one setting of the length scales, a steepness and a lapse rate, got "
            f"{len(settings)}, {model.steepness} and {model.lapse_rate}"
        )
    number = settings.shape[1]
    if number_of_preferences is not None:
        number = checks.whole("number_of_preferences", number_of_preferences, 0)
    fits = [fit_gaussian(settings[0], model, number_of_preferences=number)]
    # paper, experiments: as many samples for the burn-in as for the evaluation
    half = draws // 2
    between = -(-half // KEPT)
    kept = half // between
    with jax.enable_x64(True), one_blas_thread():
        chains = Chains.start(fits, num_chains=1, chunk=kept, seed=seed)
        problem = conditional(chains.problem, jax.tree.map(lambda x: x[0], chains.unknowns))
        start = model.prior_scale * np.random.default_rng([seed, 5]).standard_normal(problem.loadings.shape[1])
        state = KERNEL.init(jax.random.key(seed), 0, {"utility_weights": start}, (problem,))
        recorded = _moves(state, problem, draws - kept * between, between, length=kept)
        chains = replace(chains, draws=(_part(chains, *map(np.asarray, recorded)),))
        margins = margins_of(fits, chains, kept)[:, : kept // 2 * 2]
        report = chain_convergence(margins.reshape(2, kept // 2, -1))  # its halves as chains
        evidence = log_evidence(chains, kept, seed=seed)
    attributes = fit_attributes(number, seed, evidence)
    return posterior_tree(fits, chains, kept, report, attributes, np.asarray(differences), NOTHING_ELSE)


def _part(
    chains: Chains, z: Float[np.ndarray, "n q"], log_p: Float[np.ndarray, "n k"], *flags: Shaped[np.ndarray, " n"]
) -> dict[str, Shaped[np.ndarray, "1 n ..."]]:
    """Draws as `Chains` keeps them, of one chain."""
    named = dict(zip(("candidates", "stuck", "diverging"), flags, strict=True))
    rows = {"coordinates": z[:, : chains.rank], "answers": log_p[:, : chains.number], **named}
    known = {name: np.repeat(np.asarray(value), len(z), axis=0) for name, value in chains.unknowns._asdict().items()}
    return {name: value[None] for name, value in (rows | known).items()}


def _ellipses(model_args: Args, model_kwargs: Keywords) -> Sequence[tuple[Ellipse, int]]:
    return [(prior_ellipse(model_args[0]), 1)]


KERNEL = EllipticalSlice(low_rank_model, batch=8, ellipses=_ellipses)


@partial(jax.jit, static_argnames="length")
def _moves(
    state: EllipticalSliceState,
    problem: PreferenceProblem,
    burn_in: Int[Array, ""],
    between: Int[Array, ""],
    *,
    length: int,
) -> tuple[Float[Array, "n q"], Float[Array, "n k"], Float[Array, " n"], Bool[Array, " n"], Bool[Array, " n"]]:
    """`length` draws after `burn_in` moves, each after `between` more: z, log p of each answer, and the flags."""

    def after(state: EllipticalSliceState, moves: Int[Array, ""]) -> EllipticalSliceState:
        moved: EllipticalSliceState = lax.fori_loop(0, moves, lambda _, now: KERNEL.sample(now, (problem,), {}), state)
        return moved

    def step(state: EllipticalSliceState, _: None) -> tuple[EllipticalSliceState, tuple[Shaped[Array, "..."], ...]]:
        state = after(state, between)
        z = state.z["utility_weights"]
        log_p = log_prob(problem.likelihood, problem.loadings @ z)
        return state, (z, log_p, jnp.asarray(state.candidates), state.stuck, state.diverging)

    _, recorded = lax.scan(step, after(state, burn_in), None, length=length)
    z, log_p, candidates, stuck, diverging = recorded
    return z, log_p, candidates, stuck, diverging
