"""Moves of weights and lapse rates where the likelihood has steps and there are many answers."""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax, random
from jax.scipy.special import logsumexp
from jaxtyping import Bool, Float, PRNGKeyArray

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
from bayespbrl.models.likelihoods import log_prob
from bayespbrl.models.refraction import Walls, flight_move, walls_of

# Dimensions from which few answers decide about each, so that the lapse rate takes the weights along.
MANY_DIMENSIONS = 64
# Flights of a draw there, where no sweep changes the number of violated answers: each changes it little.
FLIGHTS = 12
BESIDE = 1e-300  # a margin on one side of the step


_InFlight = tuple[Float[Array, " q"], Float[Array, " c"], Bool[Array, ""]]  # y, its margins, whether one was given up


class Steps(NamedTuple):
    """Precomputed parts of the moves, beside the joint problem.

    Attributes:
      walls: of each setting, stacked.
      heights: log likelihood by the number of violated answers of each answerer, with the lapse rate summed out.
      ladder: of each setting, stacked; None: lapse rates move alone.
      sweep: through the weights, where few answers touch each, in many dimensions and one setting; else None.
    """

    walls: Walls
    heights: Float[Array, "a n"]
    ladder: Ladder | None
    sweep: Sweep | None


def steps_of(fits: Sequence[GaussianFit], problem: JointProblem) -> Steps:
    """Walls and ladders of all settings."""
    loadings, answerers = np.asarray(problem.settings.loadings), np.asarray(problem.answerers)
    scale = fits[0].model.prior_scale
    groups = [same_margins(fit.factors.loadings) for fit in fits]
    walls = [walls_of(rows, same, answerers, prior_scale=scale) for rows, same in zip(loadings, groups, strict=True)]
    moving = len(problem.lapse_rate.values) > 1 and loadings.shape[2] > MANY_DIMENSIONS
    ranks = [fit.factors.loadings.shape[1] for fit in fits] if moving else []
    ladders = [ladder_of(scale * rows, rank) for rows, rank in zip(loadings, ranks, strict=False)]
    sweep = None
    if len(fits) == 1 and loadings.shape[2] > MANY_DIMENSIONS:
        sweep = sweep_of(
            fits[0].differences, fits[0].factors.basis, answerers, prior_scale=scale, rank=loadings.shape[2]
        )
    return Steps(_stacked(walls), _heights(problem), _stacked(ladders) if moving else None, sweep)


def step_moves(
    key: PRNGKeyArray, z: Float[Array, " q"], unknowns: Unknowns, problem: JointProblem, steps: Steps
) -> tuple[Float[Array, " q"], Unknowns, Bool[Array, ""]]:
    """Sweeps and flights, lapse rates drawn after them and then with the weights.

    Returns:
      the weights, the unknowns, and whether a flight was given up.
    """
    y = z / problem.settings.prior_scale
    walls = at_setting(steps.walls, unknowns.setting)
    margins = walls.normals @ y

    def lapse_weights(margins: Float[Array, " c"]) -> Float[Array, "a v"]:
        every = point_of(problem, unknowns)._replace(lapse_rate=problem.lapse_rate.values[:, None])
        log_p = jnp.atleast_2d(log_probabilities(problem, every, margins))  # one row where no answer can be a lapse
        return problem.answerers @ log_p.T + problem.lapse_rate.log_probabilities

    def total(margins: Float[Array, " c"]) -> Float[Array, ""]:
        return jnp.sum(logsumexp(lapse_weights(margins), axis=1))

    def flight(now: _InFlight, key: PRNGKeyArray) -> tuple[_InFlight, None]:
        y, margins, given_up = now
        y, margins, this_given_up = flight_move(
            key,
            y,
            walls,
            margins=margins,
            violated=problem.answerers @ (margins < 0),
            heights=steps.heights,
            log_likelihood=total,
        )
        return (y, margins, given_up | this_given_up), None

    if steps.sweep is not None:
        key_sweep, key = random.split(key)
        y, margins = sweep_move(
            key_sweep, y, margins, steps.sweep, normals=walls.normals, heights=steps.heights, log_likelihood=total
        )
    keys, now = random.split(key, 3), (y, margins, jnp.zeros((), bool))
    if steps.ladder is None or steps.sweep is not None:
        now, _ = flight(now, keys[0])
    else:
        now, _ = lax.scan(flight, now, random.split(keys[0], FLIGHTS))
    y, margins, given_up = now
    if len(problem.lapse_rate.values) > 1:
        unknowns = unknowns._replace(lapse_rate=random.categorical(keys[1], lapse_weights(margins)))
    if steps.ladder is not None:
        ladder = at_setting(steps.ladder, unknowns.setting)
        y, unknowns = _transport_move(keys[2], y, margins, unknowns, problem, walls, ladder)
    return y * problem.settings.prior_scale, unknowns, given_up


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


def _heights(problem: JointProblem) -> Float[Array, "a n"]:
    """Log likelihood of each number of violated answers of each answerer, all margins near zero, without lapse rate."""
    rates = problem.lapse_rate.values
    point = Point(
        problem.steepness.values[0], rates, problem.tie_threshold.values[0]
    )  # half at zero with any steepness
    likelihood = likelihood_with(problem.settings.likelihood, point)
    right, wrong = (log_prob(likelihood, jnp.full(rates.shape, sign * BESIDE)) for sign in (1, -1))
    given, violated = jnp.sum(problem.answerers, axis=1), jnp.arange(problem.answerers.shape[1] + 1)
    obeyed = given[:, None] - violated
    # eq. 8 at margins near zero, and the prior of λ
    log_p = obeyed[..., None] * right + violated[:, None] * wrong + problem.lapse_rate.log_probabilities
    return logsumexp(log_p, axis=-1)


Parts = TypeVar("Parts")


def _stacked(parts: Sequence[Parts]) -> Parts:
    return jax.tree.map(lambda *arrays: jnp.stack(arrays), *parts)
