"""Chains of elliptical slice sampling on a preference problem, by one compiled sampler for each capacity."""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float, Shaped

from bayespbrl.models.elliptical_slice import Ellipse
from bayespbrl.models.elliptical_slice_kernel import Args, EllipticalSlice, EllipticalSliceState, Keywords, Values
from bayespbrl.models.gaussian_fit import GaussianFit
from bayespbrl.models.likelihoods import log_prob, total_log_prob
from bayespbrl.models.low_rank import used_rows
from bayespbrl.models.preference_problem import (
    PreferenceProblem,
    low_rank_model,
    padded_problem,
    prior_ellipse,
    reference_ellipse,
)

# Share of each answer's Gaussian factor that enters the reference: with all of it the reference is as narrow as the
# posterior's bulk and its residual has no bound in the tails; with none of it the reference is the prior, which mixes
# badly.
REFERENCE_POWER = 0.5
# Moves around the reference's and the prior's ellipses per recorded draw; those around the prior's help in the tails.
REFERENCE_MOVES, PRIOR_MOVES = 26, 6
# Draws that one call of the compiled sampler makes; its length is part of what is compiled.
CHUNK = 25


@dataclass(frozen=True)
class Chains:
    """Chains that can be extended, a chunk of fixed length at a time.

    Attributes:
      problem: what they sample.
      state: of all chains after their last draw.
      chunk: draws per call of the compiled sampler.
      rank, number: r and K, without the padding.
      draws: the chunks so far.
    """

    problem: PreferenceProblem
    state: EllipticalSliceState
    chunk: int
    rank: int
    number: int
    draws: tuple[dict[str, Shaped[np.ndarray, "chain draw ..."]], ...] = ()

    @classmethod
    def start(cls, fit: GaussianFit, *, num_chains: int, chunk: int, seed: int) -> "Chains":
        """Chains that start at draws of the reference."""
        loadings, approximation = fit.factors.loadings, fit.approximation
        site_precisions = np.zeros(len(loadings))
        site_precisions[used_rows(loadings)] = REFERENCE_POWER * approximation.site_precisions
        problem = padded_problem(
            loadings,
            fit.likelihood,
            prior_scale=fit.model.prior_scale,
            mean=approximation.mean,
            site_precisions=site_precisions,
        )
        # the reference is wider than the posterior's bulk: chains that agree have forgotten their start
        noise = np.random.default_rng(seed).standard_normal((num_chains, len(problem.centre)))
        start = np.asarray(problem.centre) + noise @ np.asarray(problem.root).T
        zeros = jnp.zeros(num_chains)
        keys = jax.random.split(jax.random.key(seed), num_chains)
        no = zeros.astype(bool)
        state = EllipticalSliceState({"utility_weights": jnp.asarray(start)}, zeros, zeros, no, no, keys)
        return cls(problem, state, chunk, loadings.shape[1], len(loadings))

    @property
    def length(self) -> int:
        """Draws a chain so far."""
        return sum(len(part["stuck"][0]) for part in self.draws)

    def extended(self, more: int) -> "Chains":
        """At least `more` draws longer."""
        draws, state = list(self.draws), self.state
        for _ in range(-(-more // self.chunk)):
            state, states, answers = draw_chunk(state, self.problem, length=self.chunk)
            z, log_p = np.asarray(states.z["utility_weights"]), np.asarray(answers)
            flags = {name: np.asarray(getattr(states, name)) for name in ("candidates", "stuck", "diverging")}
            draws.append({"coordinates": z[:, :, : self.rank], "answers": log_p[:, :, : self.number], **flags})
        return replace(self, state=state, draws=tuple(draws))

    def collected(self, name: str, length: int) -> Shaped[np.ndarray, "chain {length} ..."]:
        """The first `length` draws of what is called `name`."""
        return np.concatenate([part[name] for part in self.draws], axis=1)[:, :length]


def _ellipses(model_args: Args, model_kwargs: Keywords) -> list[tuple[Ellipse, int]]:
    (problem,) = model_args
    return [(reference_ellipse(problem), REFERENCE_MOVES), (prior_ellipse(problem), PRIOR_MOVES)]


def _log_likelihood(z: Values, model_args: Args, model_kwargs: Keywords) -> Float[Array, ""]:
    (problem,) = model_args
    return total_log_prob(problem.likelihood, problem.loadings @ z["utility_weights"], problem.used)


# numpyro.infer.MCMC would compile this kernel anew on every run; `draw_chunk` compiles once for each capacity.
KERNEL = EllipticalSlice(low_rank_model, batch=8, ellipses=_ellipses, log_likelihood=_log_likelihood)


# Level 1 compiles faster, and a loop over small vectors runs as fast.
@partial(jax.jit, static_argnames="length", compiler_options={"xla_backend_optimization_level": 1})
def draw_chunk(
    state: EllipticalSliceState, problem: PreferenceProblem, *, length: int
) -> tuple[EllipticalSliceState, EllipticalSliceState, Float[Array, "chain draw k"]]:
    """`length` draws of all chains: the last state, all states (chain, draw, ...), and log p of each answer at each."""

    def draw(state: EllipticalSliceState, _: None) -> tuple[EllipticalSliceState, EllipticalSliceState]:
        state = KERNEL.sample(state, (problem,), {})
        return state, state._replace(rng_key=jnp.zeros(()))

    last, states = lax.scan(draw, state, None, length=length)
    states = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1) if x.ndim > 1 else x, states)
    answers = log_prob(problem.likelihood, states.z["utility_weights"] @ problem.loadings.T)
    return last, states, answers
