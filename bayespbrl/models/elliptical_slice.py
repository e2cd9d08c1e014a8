"""Elliptical slice sampling (Murray, Adams & MacKay 2010): moves round ellipses through the current point.

A move is x ← c + (x − c) cos α + (ν − c) sin α with a fresh ν ~ N(c, Σ). With the prior as that Gaussian the slice is
one of the likelihood. With any other Gaussian, the reference, it is one of prior × likelihood / reference, and the move
leaves the posterior invariant all the same (Nishihara, Murray & Adams 2014).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax, random
from jaxtyping import Bool, Float, Int, PRNGKeyArray, Shaped

# Batches of candidate angles that are drawn for all moves at once. A move that needs more draws them in its inner loop.
BATCHES_AHEAD = 2


def turned(v: Float[Array, "*v"], fresh: Float[Array, "*v"], angles: Float[Array, " j"]) -> Float[Array, " j *v"]:
    """J points of the ellipse: v cos α + v′ sin α (Murray, Adams & MacKay 2010, figure 2, step 4)."""
    axes = (slice(None),) + (None,) * v.ndim
    return v * jnp.cos(angles)[axes] + fresh * jnp.sin(angles)[axes]


class Ellipse(NamedTuple):
    """A Gaussian to draw ellipses from, and the residual to slice, in coordinates v linear in the displacement x − c.

    All that the residual needs and is linear in x (margins, whitened coordinates) is part of v, so that a move costs
    only vector arithmetic: v ← v cos α + v′ sin α.

    Attributes:
      lift: x ↦ v.
      noise: (key, moves) ↦ v′ of fresh draws of the Gaussian.
      residual: J points v ↦ log(target / Gaussian) at each.
      lower: v ↦ x.
    """

    lift: Callable[[Float[Array, " n"]], Float[Array, "*v"]]
    noise: Callable[[PRNGKeyArray, int], Float[Array, " moves *v"]]
    residual: Callable[[Float[Array, " j *v"]], Float[Array, " j"]]
    lower: Callable[[Float[Array, "*v"]], Float[Array, " n"]]


_Bracket = tuple[Float[Array, "*m"], Float[Array, "*m"], Float[Array, "*m"]]  # the angle, and its ends


def shrink(
    angle: Float[Array, "*m"], low: Float[Array, "*m"], high: Float[Array, "*m"], uniforms: Float[Array, "*m j"]
) -> tuple[Float[Array, "*m j"], Float[Array, "*m"], Float[Array, "*m"]]:
    """The next candidate angles if `angle` and all that follow are rejected: the bracket shrinks towards 0 each time.

    Which angles come next does not depend on the density, only whether they are needed does: they can be drawn ahead.

    Args:
      angle, low, high: rejected angle and its bracket, radians.
      uniforms: independent draws from [0, 1).

    Returns:
      the angles, and the bracket within which the last was drawn.

    Source: Murray, Adams & MacKay (2010), figure 2, steps 8 and 9.
    """

    # a loop rather than unrolled: the compiler would fuse the steps into each other, again and again
    def step(bracket: _Bracket, uniform: Float[Array, "*m"]) -> tuple[_Bracket, Float[Array, "*m"]]:
        angle, low, high = bracket
        low, high = jnp.where(angle < 0, angle, low), jnp.where(angle < 0, high, angle)  # figure 2, step 8
        angle = low + (high - low) * uniform  # figure 2, step 9
        return (angle, low, high), angle

    (_, low, high), angles = lax.scan(step, (angle, low, high), jnp.moveaxis(uniforms, -1, 0))
    return jnp.moveaxis(angles, 0, -1), low, high


def elliptical_moves(
    key: PRNGKeyArray, x: Float[Array, " n"], ellipse: Ellipse, *, moves: int, batch: int, max_candidates: int
) -> tuple[Float[Array, " n"], Int[Array, ""], Bool[Array, ""]]:
    """`moves` elliptical slice steps from `x`; the new x, the number of candidates tried, and whether any got stuck.

    `batch` candidates are evaluated at once, `max_candidates` at most, rounded up to whole batches; a move without an
    acceptable one stays.

    Source: Murray, Adams & MacKay (2010), figure 2.
    """
    v = ellipse.lift(x)
    ahead = min(BATCHES_AHEAD, -(-max_candidates // batch))
    drawn = _drawn(key, ellipse, x.dtype, moves=moves, batches=ahead, batch=batch)

    # One loop over the batches of all moves, not a loop of loops: where chains run side by side, none waits for the
    # slowest at every move, only at the end.
    def evaluate(walk: _Walk) -> _Walk:
        candidates, bracket = _next_candidates(walk, drawn)
        fresh = drawn.noise[walk.move]
        values = ellipse.residual(turned(walk.v, fresh, candidates))  # figure 2, step 4
        # figure 2, step 5; NaN compares as false, so that a NaN candidate is rejected
        accepted = values > walk.value + drawn.heights[walk.move]
        first_accepted, found = jnp.argmax(accepted), jnp.any(accepted)
        failed = ~found & ((walk.batches + 1) * batch >= max_candidates)
        angle = jnp.where(found, candidates[first_accepted], 0.0)
        return _Walk(
            v=turned(walk.v, fresh, angle[None])[0],
            value=jnp.where(found, values[first_accepted], walk.value),
            move=walk.move + (found | failed),
            batches=jnp.where(found | failed, 0, walk.batches + 1),
            bracket=bracket,
            tried=walk.tried + jnp.where(found, first_accepted + 1, batch),
            stuck=walk.stuck | failed,
        )

    # a current point that is impossible or NaN is left for any that is possible
    value = ellipse.residual(v[None])[0]
    value = jnp.where(value > -jnp.inf, value, -jnp.inf)
    zero = jnp.zeros((), int)
    start = _Walk(v, value, zero, zero, drawn.brackets[0], zero, jnp.zeros((), bool))
    end = lax.while_loop(lambda walk: walk.move < moves, evaluate, start)
    return ellipse.lower(end.v), end.tried, end.stuck


class _Walk(NamedTuple):
    """The state of a chain within its moves.

    Attributes:
      v, value: the point and its residual.
      move: number of the move.
      batches: of candidates that this move has seen.
      bracket: last angle, low and high beyond the candidates drawn ahead.
      tried: candidates of all moves so far.
      stuck: whether any move found none to accept.
    """

    v: Float[Array, "*v"]
    value: Float[Array, ""]
    move: Int[Array, ""]
    batches: Int[Array, ""]
    bracket: Float[Array, "3"]
    tried: Int[Array, ""]
    stuck: Bool[Array, ""]


class _Drawn(NamedTuple):
    """The random numbers of all moves, drawn before the first.

    Attributes:
      noise: ν of each move.
      heights: log u, by how much the slice lies below the current value.
      angles: the first candidates of each move, in batches.
      brackets: last of these angles, low and high.
      keys: for the candidates beyond them.
    """

    noise: Float[Array, " moves *v"]
    heights: Float[Array, " moves"]
    angles: Float[Array, "moves batches batch"]
    brackets: Float[Array, "moves 3"]
    keys: Shaped[Array, "moves ..."]


def _drawn(key: PRNGKeyArray, ellipse: Ellipse, dtype: jnp.dtype, *, moves: int, batches: int, batch: int) -> _Drawn:
    # Murray, Adams & MacKay (2010), figure 2; the candidates ahead are steps 4 and 9
    key_noise, key_uniform, key_more = random.split(key, 3)
    noise = ellipse.noise(key_noise, moves)  # figure 2, step 1
    uniforms = random.uniform(key_uniform, (moves, batches * batch + 1), dtype=dtype)
    heights = jnp.log(uniforms[:, 0])  # figure 2, step 2
    first = 2 * jnp.pi * uniforms[:, 1]  # figure 2, step 3
    rest, low, high = shrink(first, first - 2 * jnp.pi, first, uniforms[:, 2:])
    angles = jnp.concatenate([first[:, None], rest], axis=1).reshape(moves, batches, batch)
    brackets = jnp.stack([angles[:, -1, -1], low, high], axis=1)
    return _Drawn(noise, heights, angles, brackets, random.split(key_more, moves))


# angles, their bracket, and the number of the batch that is wanted
_Candidates = tuple[Float[Array, " batch"], Float[Array, "3"], Int[Array, ""]]


def _next_candidates(walk: _Walk, drawn: _Drawn) -> tuple[Float[Array, " batch"], Float[Array, "3"]]:
    """The next batch of angles of the walk's move: drawn ahead, or now where those are used up; and the bracket."""
    _, ahead, batch = drawn.angles.shape

    def draw(state: _Candidates) -> _Candidates:
        _, bracket, wanted = state
        last, low, high = jnp.where(wanted == ahead, drawn.brackets[walk.move], bracket)
        key = random.fold_in(drawn.keys[walk.move], wanted * batch)
        candidates, low, high = shrink(last, low, high, random.uniform(key, (batch,), dtype=low.dtype))
        return candidates, jnp.stack([candidates[-1], low, high]), -jnp.ones_like(wanted)

    # A loop that runs once or not at all: a conditional, in a batch of chains, would draw in any case. What it draws
    # from is part of its state, or the compiler would move the drawing before the loop.
    prepared = drawn.angles[walk.move, jnp.minimum(walk.batches, ahead - 1)]
    start = (prepared, walk.bracket, jnp.where(walk.batches < ahead, -1, walk.batches))
    candidates, bracket, _ = lax.while_loop(lambda state: state[2] >= 0, draw, start)
    return candidates, bracket
