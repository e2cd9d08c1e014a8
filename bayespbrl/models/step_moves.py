"""Moves of weights and lapse rates where the likelihood has steps and there are many answers."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax, random
from jax.scipy.special import logsumexp
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from bayespbrl.models.coordinate_sweep import Sweep, sweep_move, sweep_of
from bayespbrl.models.expectation_propagation import same_margins
from bayespbrl.models.gaussian_fit import GaussianFit
from bayespbrl.models.gibbs import (
    JointProblem,
    Point,
    Unknowns,
    at_setting,
    likelihood_with,
    log_probabilities,
    point_of,
)
from bayespbrl.models.lapse_transport import Ladder, ladder_of, transported
from bayespbrl.models.likelihoods import log_prob, ties_of
from bayespbrl.models.refraction import Walls, at_violated, flight_move, walls_of
from bayespbrl.models.tempering import walked

# Dimensions from which few answers decide about each, so that the lapse rate takes the weights along.
MANY_DIMENSIONS = 64
# Flights of a draw there, where no sweep changes the number of violated answers: each changes it little.
FLIGHTS = 12
BESIDE = 1e-300  # a margin on one side of the step


class _Walker(NamedTuple):
    """What flights move.

    Attributes:
      y, margins: weights whitened by the prior, and theirs.
      threshold: number of the tie threshold.
    """

    y: Float[Array, " q"]
    margins: Float[Array, " c"]
    threshold: Int[Array, ""]


class Steps(NamedTuple):
    """Precomputed parts of the moves, beside the joint problem.

    Attributes:
      walls: of each setting, stacked.
      heights: log likelihood by the number of violated answers of each answerer, with the lapse rate summed out.
      ladder: of each setting, stacked; None: lapse rates move alone.
      sweep: through the weights, where few answers touch each, in many dimensions and one setting; else None.
        None of it with ties.
      tempered: (), a marker that is part of what is compiled, where each draw has a tempered walk too; else None.
    """

    walls: Walls
    heights: Float[Array, "a n"]
    ladder: Ladder | None
    sweep: Sweep | None
    tempered: tuple[()] | None = None


def steps_of(fits: Sequence[GaussianFit], problem: JointProblem) -> Steps:
    """Walls and ladders of all settings."""
    loadings, answerers = np.asarray(problem.settings.loadings), np.asarray(problem.answerers)
    scale = fits[0].model.prior_scale
    groups = [same_margins(fit.factors.loadings) for fit in fits]
    ties = ties_of(fits[0].likelihood)
    tied = None if ties is None else np.asarray(ties.indifferent)
    walls = [
        walls_of(rows, same, answerers, prior_scale=scale, indifferent=tied)
        for rows, same in zip(loadings, groups, strict=True)
    ]
    wide = loadings.shape[2] > MANY_DIMENSIONS and ties is None
    moving = len(problem.lapse_rate.values) > 1 and wide
    ranks = [fit.factors.loadings.shape[1] for fit in fits] if moving else []
    ladders = [ladder_of(scale * rows, rank) for rows, rank in zip(loadings, ranks, strict=False)]
    sweep = None
    if len(fits) == 1 and wide:
        sweep = sweep_of(
            fits[0].differences, fits[0].factors.basis, answerers, prior_scale=scale, rank=loadings.shape[2]
        )
    return Steps(_stacked(walls), _heights(problem), _stacked(ladders) if moving else None, sweep)


def step_moves(
    key: PRNGKeyArray, z: Float[Array, " q"], unknowns: Unknowns, problem: JointProblem, steps: Steps
) -> tuple[Float[Array, " q"], Unknowns, Bool[Array, ""]]:
    """A tempered walk, sweeps and flights, lapse rates drawn after them and then with the weights.

    Returns:
      the weights, the unknowns, and whether a flight was given up.
    """
    y = z / problem.settings.prior_scale
    walls = at_setting(steps.walls, unknowns.setting)
    now = _Walker(y, walls.normals @ y, unknowns.tie_threshold)
    if steps.tempered is not None:
        key_tempered, key = random.split(key)
        now = _tempered_move(key_tempered, now, unknowns, problem, steps)
        unknowns = unknowns._replace(tie_threshold=now.threshold)
    total = partial(_total, problem, unknowns)

    def flight(
        before: tuple[_Walker, Bool[Array, ""]], key: PRNGKeyArray
    ) -> tuple[tuple[_Walker, Bool[Array, ""]], None]:
        now, given_up = before
        now, this_given_up = _flown(key, now, problem, walls, heights=steps.heights, log_likelihood=total)
        return (now, given_up | this_given_up), None

    if steps.sweep is not None:
        key_sweep, key = random.split(key)
        y, margins = sweep_move(
            key_sweep,
            now.y,
            now.margins,
            steps.sweep,
            normals=walls.normals,
            heights=steps.heights,
            log_likelihood=total,
        )
        now = now._replace(y=y, margins=margins)
    keys, start = random.split(key, 3), (now, jnp.zeros((), bool))
    if steps.ladder is None or steps.sweep is not None:
        (now, given_up), _ = flight(start, keys[0])
    else:
        (now, given_up), _ = lax.scan(flight, start, random.split(keys[0], FLIGHTS))
    y, margins = now.y, now.margins
    if len(problem.lapse_rate.values) > 1:
        weights = _lapse_weights(problem, unknowns, margins)
        unknowns = unknowns._replace(lapse_rate=random.categorical(keys[1], weights))
    if steps.ladder is not None:
        ladder = at_setting(steps.ladder, unknowns.setting)
        y, unknowns = _transport_move(keys[2], y, margins, unknowns, problem, walls, ladder)
    return y * problem.settings.prior_scale, unknowns, given_up


def _flown(
    key: PRNGKeyArray,
    now: _Walker,
    problem: JointProblem,
    walls: Walls,
    *,
    heights: Float[Array, "a n"],
    log_likelihood: Callable[[Float[Array, " c"]], Float[Array, ""]],
) -> tuple[_Walker, Bool[Array, ""]]:
    """After one flight, and whether it was given up."""
    threshold = problem.tie_threshold.values[now.threshold]
    y, margins, given_up = flight_move(
        key,
        now.y,
        walls.at(threshold),
        margins=now.margins,
        violated=_violated(problem, threshold, now.margins),
        heights=heights,
        log_likelihood=log_likelihood,
    )
    return now._replace(y=y, margins=margins), given_up


def _lapse_weights(problem: JointProblem, unknowns: Unknowns, margins: Float[Array, " c"]) -> Float[Array, "a v"]:
    """log probability of each lapse rate of each answerer, and of the answers with it."""
    every = point_of(problem, unknowns)._replace(lapse_rate=problem.lapse_rate.values[:, None])
    log_p = jnp.atleast_2d(log_probabilities(problem, every, margins))  # one row where no answer can be a lapse
    return problem.answerers @ log_p.T + problem.lapse_rate.log_probabilities


def _total(problem: JointProblem, unknowns: Unknowns, margins: Float[Array, " c"]) -> Float[Array, ""]:
    """log probability of the answers, with the lapse rates summed out."""
    return jnp.sum(logsumexp(_lapse_weights(problem, unknowns, margins), axis=1))


def _tempered_move(
    key: PRNGKeyArray, start: _Walker, unknowns: Unknowns, problem: JointProblem, steps: Steps
) -> _Walker:
    """After a tempered walk of the weights and the tie threshold: at each level a flight, and a draw of that."""
    walls, (thresholds, log_prior) = at_setting(steps.walls, unknowns.setting), problem.tie_threshold

    def flight(key: PRNGKeyArray, now: _Walker, share: Float[Array, ""]) -> _Walker:
        height = partial(_height, problem, share * steps.heights, thresholds[now.threshold])
        return _flown(key, now, problem, walls, heights=share * steps.heights, log_likelihood=height)[0]

    def redrawn(key: PRNGKeyArray, now: _Walker, share: Float[Array, ""]) -> _Walker:
        if len(thresholds) == 1:
            return now
        each = jax.vmap(_height, (None, None, 0, None))(problem, steps.heights, thresholds, now.margins)
        return now._replace(threshold=random.categorical(key, share * each + log_prior))

    def height(now: _Walker) -> Float[Array, ""]:
        return _height(problem, steps.heights, thresholds[now.threshold], now.margins)

    def besides(now: _Walker) -> Float[Array, ""]:
        """What the likelihood has besides the heights."""
        return _total(problem, unknowns._replace(tie_threshold=now.threshold), now.margins) - height(now)

    key_walk, key_test = random.split(key)
    end, gained = walked(key_walk, start, (flight, redrawn), height)
    accepted = jnp.log(random.uniform(key_test)) < gained + besides(end) - besides(start)
    return jax.tree.map(lambda old, new: jnp.where(accepted, new, old), start, end)


def _height(
    problem: JointProblem, heights: Float[Array, "a n"], threshold: Float[Array, ""], margins: Float[Array, " c"]
) -> Float[Array, ""]:
    """The heights' sum over the answerers."""
    return jnp.sum(at_violated(heights, _violated(problem, threshold, margins)))


def _transport_move(
    key: PRNGKeyArray,
    y: Float[Array, " q"],
    margins: Float[Array, " c"],
    unknowns: Unknowns,
    problem: JointProblem,
    walls: Walls,
    ladder: Ladder,
) -> tuple[Float[Array, " q"], Unknowns]:
    """Draw a new lapse rate for one answerer, keeping the quantiles of the weights."""
    key_who, key_value = random.split(key)
    rates = problem.lapse_rate.values
    who = random.randint(key_who, (), 0, len(problem.answerers))
    now = point_of(problem, unknowns)
    every = now._replace(lapse_rate=jnp.where(problem.answerers[who] > 0, rates[:, None], now.lapse_rate))
    points, log_p = transported(
        y,
        ladder,
        now=_beside(problem, now)[:, ladder.pivots],
        then=_beside(problem, every)[..., ladder.pivots],
    )
    before = unknowns.lapse_rate[who]
    points = points.at[before].set(y)  # as it is, and not as it comes back from its quantiles
    each = (points @ walls.normals.T).at[before].set(margins)
    log_p += jnp.sum(log_probabilities(problem, every, each), axis=-1)
    log_p += problem.lapse_rate.log_probabilities
    chosen = random.categorical(key_value, jnp.where(jnp.isfinite(log_p), log_p, -jnp.inf))
    return points[chosen], unknowns._replace(lapse_rate=unknowns.lapse_rate.at[who].set(chosen))


def _beside(problem: JointProblem, point: Point) -> Float[Array, "2 *b c"]:
    """The probability of each answer where its margin is just positive, and where it is just negative."""
    likelihood = likelihood_with(problem.settings.likelihood, point)
    shape = jnp.broadcast_shapes(jnp.shape(point.lapse_rate), (problem.answerers.shape[1],))
    return jnp.exp(jnp.stack([log_prob(likelihood, jnp.full(shape, sign * BESIDE)) for sign in (1, -1)]))


def _violated(problem: JointProblem, threshold: Float[Array, ""], margins: Float[Array, " c"]) -> Float[Array, " a"]:
    """How many answers of each answerer their margins contradict."""
    ties = ties_of(problem.settings.likelihood)
    if ties is None:
        return problem.answerers @ (margins < 0)
    return problem.answerers @ jnp.where(ties.indifferent, jnp.abs(margins) > threshold, margins < threshold)


def _heights(problem: JointProblem) -> Float[Array, "a n"]:
    """Log likelihood of each number of violated answers of each answerer, all margins near zero, without lapse rate.

    Ties count as answers that order. By what they differ, the smooth part of eq. 8, is left to the Metropolis tests.
    """
    rates = problem.lapse_rate.values
    # half at zero with any steepness
    point = Point(problem.steepness.values[0], rates, problem.tie_threshold.values[0])
    likelihood = likelihood_with(problem.settings.likelihood, point)
    beside = [jnp.full(rates.shape, sign * BESIDE) for sign in (1, -1)]
    if (ties := ties_of(likelihood)) is None:
        right, wrong = (log_prob(likelihood, margins) for margins in beside)
    else:
        attentive = (jnp.exp(log_prob(ties.ordered, margins)) for margins in beside)
        right, wrong = (jnp.log(rates / 3 + (1 - rates) * each) for each in attentive)
    given, violated = jnp.sum(problem.answerers, axis=1), jnp.arange(problem.answerers.shape[1] + 1)
    obeyed = given[:, None] - violated
    # eq. 8 at margins near zero, and the prior of λ
    log_p = obeyed[..., None] * right + violated[:, None] * wrong + problem.lapse_rate.log_probabilities
    return logsumexp(log_p, axis=-1)


Parts = TypeVar("Parts")


def _stacked(parts: Sequence[Parts]) -> Parts:
    return jax.tree.map(lambda *arrays: jnp.stack(arrays), *parts)
