"""Single weights drawn among their steps, block by block: for items with a feature each, which few answers touch.

Given all other weights, that of an item is normal times a factor that jumps where a margin of one of its few answers
changes its sign. If every violated answer had the same price, it would be drawn exactly, and so at once would be the
weights of a block, of which no two share an answer. But the price depends on how many answers are violated, as in
`refraction`. The proposal is made at the price of the present number, and a Metropolis test pays the difference. What
else the likelihood changes is small, and corrected by a test after a sweep forth and back (surrogate transitions; Liu
2001).

A flight changes the number of violated answers by a few, because its energy is conserved. A sweep may change many.
Where an answer touches many weights hardly any two could be drawn at once, and flights are better.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax, random
from jax.scipy.special import ndtri
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from bayespbrl.models.preference_problem import padded_size
from bayespbrl.models.refraction import at_violated

# A weight that more answers touch is not drawn here. None is, where these are too large a part of all, or where an
# answer touches more of the others.
MOST_ANSWERS, LEAST_SHARE, MOST_WEIGHTS = 32, 0.9, 4
# Weights of a block: with more, the price changes more between proposal and test.
BLOCK = 64
# Blocks are of weights that at most so many answers touch: what touches few is drawn faster.
WIDTHS = (4, 8, 16, MOST_ANSWERS)
# Coordinates for each sweep of a move: the more there are, the longer the number of violated answers wanders.
COORDINATES = 64


class Blocks(NamedTuple):
    """Blocks of one width; padded weights and answers have numbers behind the last.

    Attributes:
      weights: their numbers among those that any answer touches, block by block.
      answers: those that touch each.
      slopes: of the margins of those, by the whitened weight; 0 in padding.
    """

    weights: Int[Array, "b s"]
    answers: Int[Array, "b s n"]
    slopes: Float[Array, "b s n"]


class Sweep(NamedTuple):
    """What a sweep goes through.

    Attributes:
      basis: Q, with w = Q z + what no answer depends on; of the weights that any answer touches, and padded.
      answerers: who gave each answer, one-hot.
      blocks: of each width.
    """

    basis: Float[Array, "d q"]
    answerers: Float[Array, "a c"]
    blocks: tuple[Blocks, ...]


_State = tuple[Float[Array, " d"], Float[Array, " c"], Float[Array, " a"]]  # weights, margins, violated answers


def sweep_of(
    differences: Float[np.ndarray, "k d"],
    basis: Float[np.ndarray, "d r"],
    answerers: Float[np.ndarray, "a c"],
    *,
    prior_scale: float,
    rank: int,
) -> Sweep | None:
    """The sweep of differences, for so many coordinates with padding; None where sweeps do not pay."""
    some = np.any(differences != 0, axis=0)
    differences, basis = differences[:, some], basis[some]
    number = np.sum(differences != 0, axis=0)
    drawn = np.flatnonzero(number <= MOST_ANSWERS)
    widest = np.max(np.sum(differences[:, drawn] != 0, axis=1), initial=0)
    if not len(drawn) or len(drawn) < LEAST_SHARE * len(number) or widest > MOST_WEIGHTS:
        return None
    touching = [np.flatnonzero(column) for column in differences.T]
    touched = [drawn[np.flatnonzero(row)] for row in differences[:, drawn]]
    group = np.full(len(number), -1)  # no two weights of a group share an answer
    for weight in drawn[np.argsort(-number[drawn], kind="stable")]:
        taken = {group[other] for row in touching[weight] for other in touched[row]}
        group[weight] = next(free for free in range(len(taken) + 1) if free not in taken)
    size = padded_size(len(number))
    blocks = []
    for least, width in zip((0, *WIDTHS), WIDTHS, strict=False):
        those = [np.flatnonzero((group == g) & (least < number) & (number <= width)) for g in range(group.max() + 1)]
        parts = [them[first : first + BLOCK] for them in those for first in range(0, len(them), BLOCK)]
        if not parts:
            continue
        shape = (len(parts) + len(parts) % 2, BLOCK, width)  # an even number: fewer shapes are fewer compilations
        weights, answers, slopes = np.full(shape[:2], size), np.full(shape, answerers.shape[1]), np.zeros(shape)
        for block, part in enumerate(parts):
            weights[block, : len(part)] = part
            for place, weight in enumerate(part):
                rows = touching[weight]
                answers[block, place, : len(rows)] = rows
                slopes[block, place, : len(rows)] = prior_scale * differences[rows, weight]
        blocks.append(Blocks(*map(jnp.asarray, (weights, answers, slopes))))
    wide = np.pad(basis, ((0, size - len(basis)), (0, rank - basis.shape[1])))
    return Sweep(jnp.asarray(wide), jnp.asarray(answerers), tuple(blocks))


def sweep_move(
    key: PRNGKeyArray,
    y: Float[Array, " q"],
    margins: Float[Array, " c"],
    sweep: Sweep,
    *,
    normals: Float[Array, "c q"],
    heights: Float[Array, "a v"],
    log_likelihood: Callable[[Float[Array, " c"]], Float[Array, ""]],
) -> tuple[Float[Array, " q"], Float[Array, " c"]]:
    """y and its margins after some sweeps through all blocks, each forth and back.

    Args:
      y: coordinates, whitened by the prior.
      margins: at y.
      sweep: through the weights.
      normals: of the margins' steps, as in `refraction.Walls`.
      heights: log likelihood by the number of violated answers, for each answerer.
      log_likelihood: a function of the margins.
    """
    key_rest, key_rounds = random.split(key)
    basis, answerers = sweep.basis, sweep.answerers
    noise = random.normal(key_rest, (len(basis),), dtype=y.dtype)
    # what no answer depends on keeps its prior, and is drawn anew
    start = basis @ y + noise - basis @ (basis.T @ noise)
    path = forth_and_back(sweep.blocks)

    def next_block(state: _State, now: tuple[PRNGKeyArray, Blocks]) -> tuple[_State, None]:
        key, block = now
        return _block_move(key, state, block, answerers, heights), None

    def next_round(before: _State, key: PRNGKeyArray) -> tuple[_State, None]:
        key_test, *keys = random.split(key, 1 + len(path))
        after = before
        for key, each in zip(keys, path, strict=True):
            after, _ = lax.scan(next_block, after, (random.split(key, len(each.weights)), each))
        # Liu (2001): forth and back, the sweep is reversible for prior × heights
        accepted = jnp.log(random.uniform(key_test, dtype=y.dtype)) < besides(after) - besides(before)
        return jax.tree.map(lambda old, new: jnp.where(accepted, new, old), before, after), None

    def besides(state: _State) -> Float[Array, ""]:
        """What the likelihood has besides the heights."""
        _, margins, violated = state
        return log_likelihood(margins) - jnp.sum(at_violated(heights, violated))

    state = (start, margins, answerers @ (margins < 0))
    (weights, *_), _ = lax.scan(next_round, state, random.split(key_rounds, max(1, len(y) // COORDINATES)))
    end = y + basis.T @ (weights - start)
    return end, normals @ end


def forth_and_back(blocks: Sequence[Blocks]) -> list[Blocks]:
    """The blocks, and then the same in the opposite order."""
    return [*blocks, *(Blocks(*(part[::-1] for part in each)) for each in blocks[::-1])]


def _block_move(
    key: PRNGKeyArray,
    state: _State,
    block: Blocks,
    answerers: Float[Array, "a c"],
    heights: Float[Array, "a v"],
) -> _State:
    """Weights, margins and violated answers after those of one block, without its axis b, are drawn anew and tested."""
    (every, margins, violated), (weights, answers, slopes) = state, block
    key_place, key_test = random.split(key)
    now = every.at[weights].get(mode="fill", fill_value=0.0)
    before = margins.at[answers].get(mode="fill", fill_value=0.0)
    whose = answerers.at[:, answers].get(mode="fill", fill_value=0.0)
    others = before - slopes * now[:, None]
    intervals = _intervals(others, slopes)

    def priced(violated: Float[Array, " a"]) -> tuple[Float[Array, "s n"], Float[Array, "s m"], Float[Array, " s"]]:
        """The price of an answer by so many violated ones, each interval's share, and the log of the shares' factor."""
        each = jnp.einsum("a,asn->sn", _price(heights, violated), whose)
        left = jnp.sum(jnp.where(slopes > 0, each, 0.0), axis=1, keepdims=True)
        passed = jnp.where(slopes > 0, -each, each)[:, :, None]
        passed = jnp.sum(jnp.where(intervals.earlier, passed, 0.0), axis=1)
        price = left + jnp.concatenate([jnp.zeros_like(left), passed], axis=1)
        least = jnp.min(jnp.where(intervals.mass > 0, price, jnp.inf), axis=1)
        return each, intervals.mass * jnp.exp(least[:, None] - price), least

    prices, shares, least = priced(violated)
    new = _drawn(key_place, intervals, shares)
    after = others + slopes * new[:, None]
    then = violated + jnp.einsum("asn,sn->a", whose, (after < 0) * 1.0 - (before < 0))
    prices_then, shares_then, least_then = priced(then)
    # the ratio of Metropolis and Hastings: heights, and the proposals' densities there and back, but for the prior's
    gained = jnp.sum(at_violated(heights, then) - at_violated(heights, violated)) + jnp.sum(least_then - least)
    gained += jnp.sum(jnp.log(jnp.sum(shares, axis=1)) - jnp.log(jnp.sum(shares_then, axis=1)))
    gained += jnp.sum(prices * (after < 0)) - jnp.sum(prices_then * (before < 0))
    accepted = jnp.log(random.uniform(key_test, dtype=now.dtype)) < gained
    return (
        jnp.where(accepted, every.at[weights].set(new, mode="drop"), every),
        jnp.where(accepted, margins.at[answers].set(after, mode="drop"), margins),
        jnp.where(accepted, then, violated),
    )


class _Intervals(NamedTuple):
    """Where the likelihood of each weight is constant: before all its steps, and from each step to the next.

    Attributes:
      low, high: their ends.
      tail, beyond: normal probability beyond |low| and |high|: of these, digits are left where an end is large.
      mass: normal probability between the ends.
      earlier: which steps (second axis) are not behind the one where an interval begins (third axis).
    """

    low: Float[Array, "s m"]
    high: Float[Array, "s m"]
    tail: Float[Array, "s m"]
    beyond: Float[Array, "s m"]
    mass: Float[Array, "s m"]
    earlier: Bool[Array, "s n n"]


def _intervals(others: Float[Array, "s n"], slopes: Float[Array, "s n"]) -> _Intervals:
    """The intervals of weights; `others` are the margins without them. Padded answers have their step behind all."""
    steps = jnp.where(slopes != 0, -others / jnp.where(slopes != 0, slopes, 1.0), jnp.inf)
    each, step, begin = jnp.arange(steps.shape[1]), steps[:, :, None], steps[:, None]
    earlier = (step < begin) | ((step == begin) & (each[:, None] <= each))
    low = jnp.concatenate([jnp.full((len(steps), 1), -jnp.inf), steps], axis=1)
    following = jnp.min(jnp.where(earlier, jnp.inf, step), axis=1)
    high = jnp.concatenate([jnp.min(steps, axis=1, keepdims=True), following], axis=1)
    tail, beyond = (0.5 * lax.erfc(jnp.abs(end) / np.sqrt(2)) for end in (low, high))
    mass = jnp.where((low < 0) & (high > 0), 1 - tail - beyond, jnp.abs(tail - beyond))
    return _Intervals(low, high, tail, beyond, mass, earlier)


def _drawn(key: PRNGKeyArray, intervals: _Intervals, shares: Float[Array, "s m"]) -> Float[Array, " s"]:
    """A weight each: an interval by its share, and a place in it by the normal distribution, of one random number."""
    reached = jnp.cumsum(shares, axis=1)
    until = jnp.concatenate([jnp.zeros_like(reached[:, :1]), reached[:, :-1]], axis=1)
    place = reached[:, -1:] * random.uniform(key, (len(shares), 1), dtype=shares.dtype)
    chosen = (until <= place) & (place < reached)
    low, high, tail, beyond, mass, begin, end = (
        jnp.sum(jnp.where(chosen, part, 0.0), axis=1) for part in (*intervals[:5], until, reached)
    )
    part = jnp.where(low > 0, end - place[:, 0], place[:, 0] - begin) / (end - begin)
    quantile = ndtri(jnp.where(low > 0, beyond, tail) + part * mass)
    return jnp.clip(jnp.where(low > 0, -quantile, quantile), low, high)


def _price(heights: Float[Array, "a v"], violated: Float[Array, " a"]) -> Float[Array, " a"]:
    """By how much one violated answer more lowers the height, for each answerer: the mean of the last and the next."""
    fewer, more = jnp.maximum(violated - 1, 0), jnp.minimum(violated + 1, heights.shape[1] - 1)
    return (at_violated(heights, fewer) - at_violated(heights, more)) / (more - fewer)
