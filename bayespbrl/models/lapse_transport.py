"""A move of a lapse rate that takes the weights along: from quantiles under one lapse rate to the same under another.

In many dimensions a few answers decide about each, and how many are violated all but fixes the lapse rate: given the
weights it hardly moves. So the weights are written as quantiles, coordinate by coordinate, each of its distribution
given the coordinates before it and one answer whose margin has no later coordinate. A normal distribution with a step
has its quantiles in closed form. The quantiles are kept, the lapse rate is drawn anew with them: a deterministic map
with its volume (Green 1995), like the setting's move in `gibbs`.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.scipy.special import ndtr, ndtri
from jaxtyping import Bool, Float, Int
from scipy.linalg import qr

# Of the norm of an answer's row: the least part that its own coordinate has. With less, it says little about that.
LEAST_PART = 0.1


class Ladder(NamedTuple):
    """Coordinates x = Qᵀ y in which each of some answers, the pivots, ends one coordinate later than the one before.

    Attributes:
      frame: Q.
      pivots: the answer of each coordinate.
      paired: which coordinates have one.
      earlier: the pivots' margins from the coordinates before their own, in units of their own.
    """

    frame: Float[Array, "q q"]
    pivots: Int[Array, " q"]
    paired: Bool[Array, " q"]
    earlier: Float[Array, "q q"]


def ladder_of(normals: Float[np.ndarray, "c q"], rank: int) -> Ladder:
    """The ladder of padded rows, whose first `rank` coordinates count; the most independent answers come first."""
    wide = normals.shape[1]
    orthogonal, triangle, order = qr(normals[:, :rank].T, mode="economic", pivoting=True)
    signs = np.where(np.diag(triangle) < 0, -1.0, 1.0)
    lower = (triangle * signs[:, None])[:, :rank].T
    own = np.diag(lower)
    paired = own > LEAST_PART * np.maximum(np.linalg.norm(lower, axis=1), np.finfo(float).tiny)
    frame, earlier = np.eye(wide), np.zeros((wide, wide))
    frame[:rank, :rank] = orthogonal * signs
    earlier[:rank, :rank] = np.where(paired[:, None], np.tril(lower, -1) / np.where(paired, own, 1.0)[:, None], 0.0)
    pad = (0, wide - rank)
    return Ladder(*map(jnp.asarray, (frame, np.pad(order[:rank], pad), np.pad(paired, pad), earlier)))


def transported(
    y: Float[Array, " q"],
    ladder: Ladder,
    *,
    now: Float[Array, "2 q"],
    then: Float[Array, "2 v q"],
) -> tuple[Float[Array, "v q"], Float[Array, " v"]]:
    """The points with the same quantiles under V other lapse rates, and log(normal density / density) of each.

    Args:
      y: whitened by the prior.
      ladder: the coordinates.
      now, then: probability of each pivot's answer where its margin is positive, and where it is negative.
    """
    x = ladder.frame.T @ y
    steps = -ladder.earlier @ x
    obeyed, total = x > steps, now[0] * ndtr(-steps) + now[1] * ndtr(steps)
    part = jnp.where(obeyed, now[0] * ndtr(-x), now[1] * ndtr(x)) / total
    above, below = jnp.where(obeyed, part, 1 - part), jnp.where(obeyed, 1 - part, part)

    def next_coordinate(
        points: Float[Array, "q v"], i: Int[Array, ""]
    ) -> tuple[Float[Array, "q v"], Float[Array, " v"]]:
        step = -ladder.earlier[i] @ points
        right, wrong = then[0, :, i], then[1, :, i]
        beyond = ndtr(-step)
        total = right * beyond + wrong * ndtr(step)
        obeyed = above[i] * total < right * beyond
        each = jnp.where(obeyed, right, wrong)
        quantile = jnp.where(obeyed, -1, 1) * ndtri(jnp.where(obeyed, above[i], below[i]) * total / each)
        new = jnp.where(ladder.paired[i], quantile, x[i])
        return points.at[i].set(new), jnp.where(ladder.paired[i], jnp.log(total / each), 0.0)

    points, ratios = lax.scan(next_coordinate, jnp.zeros(then.shape[:0:-1], y.dtype), jnp.arange(len(y)))
    return points.T @ ladder.frame.T, jnp.sum(ratios, axis=0)  # log volume (Green 1995)
