"""Chains over all unknowns: Gibbs moves and elliptical slices, by one compiled sampler per capacity."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax, random
from jaxtyping import Bool, Float, Shaped
from scipy.special import softmax

from bayespbrl.models.elliptical_slice import Ellipse
from bayespbrl.models.elliptical_slice_kernel import Args, EllipticalSlice, EllipticalSliceState, Keywords, SiteValues
from bayespbrl.models.gaussian_fit import GaussianFit
from bayespbrl.models.gibbs import (
    FEW,
    JointProblem,
    Table,
    Unknowns,
    conditional,
    moved,
    prior_draws,
    reference_scale,
    stacked,
)
from bayespbrl.models.likelihoods import has_steps, log_prob, ties_of, total_log_prob
from bayespbrl.models.low_rank import used_rows
from bayespbrl.models.preference_problem import (
    PreferenceProblem,
    low_rank_model,
    padded_problem,
    prior_ellipse,
    reference_ellipse,
)
from bayespbrl.models.priors import Grid, given
from bayespbrl.models.split_dynamics import split_move
from bayespbrl.models.step_moves import Steps, step_moves, steps_of
from bayespbrl.models.surrogate_moves import surrogate_moves, with_surrogates
from bayespbrl.models.threads import in_threads

# Share of each answer's Gaussian factor that enters the reference: with all of it the reference is as narrow as the
# posterior's bulk and its residual has no bound in the tails; with none of it the reference is the prior, which mixes
# badly.
REFERENCE_POWER = 0.5
# Moves around the reference's and the prior's ellipses per recorded draw; those around the prior's help in the tails.
# They are split into SWEEPS sweeps where more than the weights is unknown: lapse rate and weights move in turn.
REFERENCE_MOVES, PRIOR_MOVES, SWEEPS = 26, 6, 6
# Above `FEW` answers other moves are made, and the references are fitted again after the burn-in. Among steps the
# weights move by flights; without steps the reference is nearly the posterior, and most is done by its dynamics.
SMOOTH_MOVES = 1
# Of the reference that is fitted again: among contradicting answers the posterior is wider than any one Gaussian fit.
LEAST_POWER = 0.2
# The least lapse rate of a reference: with none, answers that contradict each other leave no Gaussian.
LEAST_LAPSES = 0.005
# Draws that one call of the compiled sampler makes; its length is part of what is compiled.
CHUNK = 25

Recorded = tuple[EllipticalSliceState, Unknowns, Float[Array, "*draws k"]]
Chunk = tuple[tuple[EllipticalSliceState, Unknowns], Recorded]


@dataclass(frozen=True)
class Chains:
    """Chains that can be extended, a chunk of fixed length at a time.

    Attributes:
      problem: what they sample.
      steps: what the moves need among the steps of many answers.
      state, unknowns: of all chains after their last draw.
      chunk: draws per call of the compiled sampler.
      rank, number: r and K, without the padding.
      draws: the chunks so far.
    """

    problem: JointProblem
    state: EllipticalSliceState
    unknowns: Unknowns
    chunk: int
    rank: int
    number: int
    steps: Steps | None = None
    draws: tuple[dict[str, Shaped[np.ndarray, "chain draw ..."]], ...] = ()

    @classmethod
    def start(
        cls,
        fits: Sequence[GaussianFit],
        *,
        num_chains: int,
        chunk: int,
        seed: int,
        by_answerer: Float[np.ndarray, "a k"] | None = None,
    ) -> "Chains":
        """Chains that start far apart: at draws of the reference, of the unknowns' priors, and of the settings.

        Args:
          fits: one for each setting, equally probable a priori.
          num_chains, chunk, seed: numbers of chains and of draws a call; of all draws.
          by_answerer: who gave each answer, one-hot; None: one for all.
        """
        problem, rank = joint_problem(fits, by_answerer), max(fit.factors.loadings.shape[1] for fit in fits)
        rng = np.random.default_rng(seed)
        # likely settings, but spread wider than the posterior over them: chains that agree have forgotten their start
        setting = rng.choice(len(fits), num_chains, p=softmax([0.5 * fit.log_evidence for fit in fits]))
        unknowns = Unknowns(*jax.device_put((setting, *prior_draws(problem, rng, num_chains))))
        wider = np.asarray(reference_scale(problem, unknowns))[..., None]
        centres, roots = np.asarray(problem.settings.centre)[setting], np.asarray(problem.settings.root)[setting]
        start = wider * (centres + np.einsum("cij,cj->ci", roots, rng.standard_normal(centres.shape)))
        start, zeros, no = jax.device_put((start, np.zeros(num_chains), np.zeros(num_chains, bool)))
        keys = jax.random.split(jax.random.key(seed), num_chains)
        state = EllipticalSliceState({"utility_weights": start}, zeros, zeros, no, no, keys)
        steps = steps_of(fits, problem) if _flies(problem.settings) else None
        return cls(problem, state, unknowns, chunk, rank, len(fits[0].differences), steps)

    @property
    def many(self) -> bool:
        """Whether there are many answers."""
        return self.problem.settings.loadings.shape[1] > FEW

    def with_references(self, fits: Sequence[GaussianFit], values: Mapping[str, float]) -> "Chains":
        """The same chains with the references of other fits, which were made at these values of the unknowns."""
        rank = max(fit.factors.loadings.shape[1] for fit in fits)
        power = self._power(fits) if self.many and has_steps(fits[0].likelihood) else REFERENCE_POWER
        settings = stacked([_with_reference(fit, rank, power) for fit in fits])
        fitted = None if self.problem.fitted_steepness is None else values["steepness"]
        return replace(self, problem=self.problem._replace(settings=settings, fitted_steepness=fitted))

    def _power(self, fits: Sequence[GaussianFit]) -> float:
        """The power of the Gaussian factors at which references are as wide as the last half of many answers' draws.

        Decision: one for all settings. That of a setting without draws would be anybody's guess, and a reference of
        another width than its neighbours' is never entered.
        """
        half = self.length // 2
        z, setting = (self.collected(name, self.length)[:, half:] for name in ("coordinates", "setting"))
        dimensions = squares = 0.0
        for number, fit in enumerate(fits):
            rank, site_precisions = fit.factors.loadings.shape[1], np.zeros(len(fit.differences))
            away = z[setting == number][:, :rank] - fit.approximation.mean
            site_precisions[used_rows(fit.factors.loadings)] = fit.approximation.site_precisions
            margins = away @ fit.factors.loadings.T
            squares += np.sum(away**2) / fit.model.prior_scale**2 + np.sum(site_precisions * margins**2)
            dimensions += rank * len(away)
        return float(np.clip(dimensions / max(squares, 1e-9), LEAST_POWER, 1.0))

    def typical(self) -> dict[str, float]:
        """Mean over all draws of steepness and lapse rate, median of the tie threshold.

        A threshold may be a thousandth of where chains start: one first draw among many would make the mean.
        """
        draws = {name: self.values(name, self.length) for name in ("steepness", "lapse_rate", "tie_threshold")}
        return {name: float((np.median if name == "tie_threshold" else np.mean)(them)) for name, them in draws.items()}

    def with_further_moves(self) -> "Chains":
        """The same chains with the moves for slow ones; as they are, where they have them or there are none."""
        if self.steps is not None and self.steps.tempered is None:
            return replace(self, steps=self.steps._replace(tempered=()))
        problem = with_surrogates(self.problem)
        return self if problem is self.problem else replace(self, problem=problem)

    @property
    def length(self) -> int:
        """Number of draws in each chain so far."""
        return sum(len(part["stuck"][0]) for part in self.draws)

    def extended(self, more: int) -> "Chains":
        """The same chains, at least `more` draws longer."""
        draws, state, unknowns = list(self.draws), self.state, self.unknowns
        for _ in range(-(-more // self.chunk)):
            (state, unknowns), (states, them, answers) = self._next_chunk(state, unknowns, compiled=bool(draws))
            z, log_p = np.asarray(states.z["utility_weights"]), np.asarray(answers)
            flags = {name: np.asarray(getattr(states, name)) for name in ("candidates", "stuck", "diverging")}
            part = {"coordinates": z[:, :, : self.rank], "answers": log_p[:, :, : self.number], **flags}
            draws.append(part | {name: np.asarray(value) for name, value in them._asdict().items()})
        return replace(self, state=state, unknowns=unknowns, draws=tuple(draws))

    def _next_chunk(self, state: EllipticalSliceState, unknowns: Unknowns, *, compiled: bool) -> Chunk:
        if self.steps is None:
            return draw_chunk(state, unknowns, self.problem, length=self.chunk)
        # several threads would each compile
        return flight_chunk(state, unknowns, self.problem, self.steps, length=self.chunk, at_once=compiled)

    def collected(self, name: str, length: int) -> Shaped[np.ndarray, "chain {length} ..."]:
        """The first `length` draws of the variable `name`."""
        return np.concatenate([part[name] for part in self.draws], axis=1)[:, :length]

    def values(self, name: str, length: int) -> Shaped[np.ndarray, "chain {length} ..."]:
        """The first `length` draws of `steepness`, `lapse_rate` or `tie_threshold`, as values."""
        return np.asarray(getattr(self.problem, name).values)[self.collected(name, length)]


def joint_problem(fits: Sequence[GaussianFit], by_answerer: Float[np.ndarray, "a k"] | None = None) -> JointProblem:
    """The problem of all settings, with the references of their fits."""
    model, likelihood = fits[0].model, fits[0].likelihood
    rank = max(fit.factors.loadings.shape[1] for fit in fits)
    problems = [_with_reference(fit, rank) for fit in fits]
    number = len(fits[0].differences)
    known = np.ones((1, number)) if by_answerer is None else by_answerer
    one_hot = np.zeros((len(known), problems[0].loadings.shape[0]))
    one_hot[:, :number] = known

    def table(prior: Grid) -> Table:
        values, probabilities = jax.device_put((np.asarray(prior.values), np.asarray(prior.probabilities)))
        return Table(values, jnp.log(probabilities))

    scaled = len(fits[0].differences) > FEW and model.steepness is None and not has_steps(likelihood)
    return JointProblem(
        stacked(problems),
        jax.device_put(np.full(len(fits), -np.log(len(fits)))),
        table(model.steepness_prior),
        table(model.lapse_rate_prior),
        table(model.tie_threshold_prior if ties_of(likelihood) is not None else given(0.0)),
        jax.device_put(one_hot),
        model.steepness_prior.mean if scaled else None,
    )


def _with_reference(fit: GaussianFit, rank: int, power: float = REFERENCE_POWER) -> PreferenceProblem:
    """The problem of one setting, with the reference of its fit."""
    loadings, site_precisions = fit.factors.loadings, np.zeros(len(fit.differences))
    power = 1.0 if len(fit.differences) > FEW and not has_steps(fit.likelihood) else power
    site_precisions[used_rows(loadings)] = power * fit.approximation.site_precisions
    return padded_problem(
        loadings,
        fit.likelihood,
        prior_scale=fit.model.prior_scale,
        mean=fit.approximation.mean,
        site_precisions=site_precisions,
        rank_at_least=rank,
    )


def _flies(problem: PreferenceProblem) -> bool:
    """Whether the weights move by flights: many answers, and steps."""
    return problem.loadings.shape[-2] > FEW and has_steps(problem.likelihood)


def _ellipses(model_args: Args, model_kwargs: Keywords, *, sweeps: int = 1) -> list[tuple[Ellipse, int]]:
    (problem,) = model_args
    if problem.loadings.shape[0] > FEW:
        if not has_steps(problem.likelihood):
            return [(reference_ellipse(problem), SMOOTH_MOVES), (prior_ellipse(problem), 1)]
        return [(prior_ellipse(problem), 1)]
    return [
        (reference_ellipse(problem), -(-REFERENCE_MOVES // sweeps)),
        (prior_ellipse(problem), -(-PRIOR_MOVES // sweeps)),
    ]


def _log_likelihood(z: SiteValues, model_args: Args, model_kwargs: Keywords) -> Float[Array, ""]:
    (problem,) = model_args
    return total_log_prob(problem.likelihood, problem.loadings @ z["utility_weights"], problem.used)


# numpyro.infer.MCMC would compile this kernel anew on every run; `draw_chunk` compiles once for each capacity.
KERNEL, KERNEL_OF_SWEEP = (
    EllipticalSlice(low_rank_model, batch=8, ellipses=partial(_ellipses, sweeps=sweeps), log_likelihood=_log_likelihood)
    for sweeps in (1, SWEEPS)
)


def draw(state: EllipticalSliceState, unknowns: Unknowns, problem: JointProblem) -> Recorded:
    """One draw of one chain of few answers, or without steps, and log p of each answer there."""
    grids = problem.steepness.values, problem.lapse_rate.values, problem.tie_threshold.values
    unknown = any(len(prior) > 1 for prior in (problem.log_probabilities, *grids))
    capacity = problem.settings.loadings.shape[1]
    kernel, sweeps = (KERNEL_OF_SWEEP, SWEEPS) if unknown and capacity <= FEW else (KERNEL, 1)

    def sweep(
        last: tuple[EllipticalSliceState, Unknowns], _: None
    ) -> tuple[tuple[EllipticalSliceState, Unknowns], tuple[Float[Array, ""], Bool[Array, ""]]]:
        state, unknowns = last
        key, key_unknowns, key_weights = random.split(state.rng_key, 3)
        z, unknowns = moved(key_unknowns, state.z["utility_weights"], unknowns, problem)
        if problem.surrogates:
            key, key_surrogates = random.split(key)
            z, unknowns = surrogate_moves(key_surrogates, z, unknowns, problem)
        if capacity > FEW:
            z = split_move(key_weights, z, conditional(problem, unknowns))
        state = state._replace(z={"utility_weights": z}, rng_key=key)
        state = kernel.sample(state, (conditional(problem, unknowns),), {})
        return (state, unknowns), (state.candidates, state.stuck)

    (state, unknowns), (candidates, stuck) = lax.scan(sweep, (state, unknowns), None, length=sweeps)
    state = state._replace(candidates=jnp.mean(candidates), stuck=jnp.any(stuck))
    one = conditional(problem, unknowns)
    return state, unknowns, log_prob(one.likelihood, one.loadings @ state.z["utility_weights"])


def flight_draw(state: EllipticalSliceState, unknowns: Unknowns, problem: JointProblem, steps: Steps) -> Recorded:
    """As `draw`, with a flight in each draw; one that is given up counts as stuck."""
    key, *keys = random.split(state.rng_key, 3)
    z, unknowns = moved(keys[0], state.z["utility_weights"], unknowns, problem)
    z, unknowns, given_up = step_moves(keys[1], z, unknowns, problem, steps)
    one = conditional(problem, unknowns)
    state = KERNEL.sample(state._replace(z={"utility_weights": z}, rng_key=key), (one,), {})
    state = state._replace(stuck=state.stuck | given_up)
    return state, unknowns, log_prob(one.likelihood, one.loadings @ state.z["utility_weights"])


# Level 1 compiles faster, and a loop over small vectors runs as fast.
@partial(jax.jit, static_argnames="length", compiler_options={"xla_backend_optimization_level": 1})
def draw_chunk(
    state: EllipticalSliceState, unknowns: Unknowns, problem: JointProblem, steps: Steps | None = None, *, length: int
) -> Chunk:
    """`length` draws of all chains, with `steps` of one: the last, and all, with log p of each answer at each."""

    def chain(state: EllipticalSliceState, unknowns: Unknowns) -> Chunk:
        def step(last: tuple[EllipticalSliceState, Unknowns], _: None) -> Chunk:
            drawn = draw(*last, problem) if steps is None else flight_draw(*last, problem, steps)
            state, unknowns, answers = drawn
            return (state, unknowns), (state._replace(rng_key=jnp.zeros(())), unknowns, answers)

        return lax.scan(step, (state, unknowns), None, length=length)

    if steps is None:
        return jax.vmap(chain)(state, unknowns)
    return chain(state, unknowns)


def flight_chunk(
    state: EllipticalSliceState,
    unknowns: Unknowns,
    problem: JointProblem,
    steps: Steps,
    *,
    length: int,
    at_once: bool,
) -> Chunk:
    """As `draw_chunk`, each chain by itself, so that none waits for a longer flight; `at_once` in several threads."""

    def one(number: int) -> Chunk:
        with jax.enable_x64(True):  # a setting of the thread
            start = jax.tree.map(lambda all_chains: all_chains[number], (state, unknowns))
            drawn: Chunk = draw_chunk(*start, problem, steps, length=length)
            drawn[1][2].block_until_ready()
            return drawn

    numbers = range(len(unknowns.setting))
    drawn = in_threads(one, numbers) if at_once else [one(number) for number in numbers]
    chains: Chunk = jax.tree.map(lambda *each: jnp.stack(each), *drawn)
    return chains
