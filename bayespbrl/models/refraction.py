"""Flights among steps: Hamiltonian dynamics of a Gaussian times a likelihood that jumps, without a step size.

Under eq. 8 the posterior of z ~ N(0, σ²I) is a Gaussian times a factor that jumps where a margin changes its sign.
Between these walls the dynamics of the Gaussian are a rotation of position and velocity, so that the next wall is found
in closed form. At a wall the velocity along its normal changes as the energy demands: the flight goes through with
another speed, or is reflected (hard walls: Pakman & Paninski 2014; finite ones: Afshar & Domke 2015). What else the
likelihood changes between the walls is small, and corrected by a Metropolis test.

The lapse rates are summed out: the height of a wall depends on how many answers are violated by then. Given the lapse
rate the number of violations hardly changes, nor does the lapse rate given that number.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax, random
from jaxtyping import Bool, Float, Int, PRNGKeyArray

# Of a flight, radians: a quarter of the period, after which nothing is left of the position where there are no walls.
DURATION = np.pi / 2
# Walls that a flight may meet, per answer; a flight that meets more is rejected.
MOST_EVENTS = 20


class Walls(NamedTuple):
    """Where the likelihood of z = σ y jumps: where a margin, a row of normals · y, is at a wall's place.

    Attributes:
      normals: σ L.
      products: of the normals with each other.
      relieved: how many answers of each answerer cease to be violated where the margin grows past the wall, less those
        that begin to be; zero in padding, and where an earlier answer has the same wall, which counts for both.
      margins, places: which margin each wall is of, and where; None: one of each, at zero.
    """

    normals: Float[Array, "c q"]
    products: Float[Array, "c c"]
    relieved: Float[Array, "w a"]
    margins: Int[Array, " w"] | None = None
    places: Float[Array, " w"] | None = None

    def at(self, threshold: Float[Array, ""]) -> "Walls":
        """The walls where those of ties are given in units of this threshold."""
        return self if self.places is None else self._replace(places=self.places * threshold)


class _Flight(NamedTuple):
    """A point in flight.

    Attributes:
      margins, speeds: of σ L y, and its derivative.
      violated: answers of each answerer.
      time: since the start, radians.
      last: the wall that was met last.
      events: walls that were met.
      kicks: the velocity gained at each wall, in units of its normal and turned back to the start: what it adds there
        to the position and to the velocity.
    """

    margins: Float[Array, " c"]
    speeds: Float[Array, " c"]
    violated: Float[Array, " a"]
    time: Float[Array, ""]
    last: Int[Array, ""]
    events: Int[Array, ""]
    kicks: Float[Array, "c 2"]


def walls_of(
    loadings: Float[np.ndarray, "c q"],
    groups: Sequence[tuple[Int[np.ndarray, " _"], Float[np.ndarray, " _"]]],
    answerers: Float[np.ndarray, "a c"],
    *,
    prior_scale: float,
    indifferent: Bool[np.ndarray, " k"] | None = None,
) -> Walls:
    """The walls of answers in padded arrays; `groups` have the rows about one margin each, and their ratios to it.

    `indifferent` tells the ties, of which each has a wall on either side; None: there are none, nor a threshold.
    """
    normals, there = prior_scale * loadings, np.any(loadings != 0, axis=1)
    products, relieved = normals @ normals.T, np.zeros(answerers.T.shape)
    if indifferent is None:
        for rows, ratios in groups:
            relieved[rows[0]] = answerers[:, rows] @ np.sign(ratios)
        relieved[~there] = 0.0
        return Walls(*map(jnp.asarray, (normals, products, relieved)))
    walls: dict[tuple[int, float], Float[np.ndarray, " a"]] = {}
    for rows, ratios in groups:
        for row, ratio in zip(rows, ratios, strict=True):
            sides = (-1.0, 1.0) if indifferent[row] else (np.sign(ratio),)
            for side in sides if there[row] else ():
                wall = int(rows[0]), float(np.round(side / abs(ratio), 9))
                # a tie is obeyed between its walls
                relief = -side if indifferent[row] else side
                walls[wall] = walls.get(wall, 0.0) + relief * answerers[:, row]
    pad = 2 * len(normals) - len(walls)
    margins, places = np.array([*walls, *[(0, 0.0)] * pad]).T
    relieved = np.array([*walls.values(), *[np.zeros(len(answerers))] * pad])
    return Walls(*map(jnp.asarray, (normals, products, relieved, margins.astype(int), places)))


def at_violated(heights: Float[Array, "a n"], violated: Float[Array, " a"]) -> Float[Array, " a"]:
    """Each answerer's height at so many violated answers."""
    return heights[jnp.arange(len(heights)), violated.astype(int)]


def flown(
    y: Float[Array, " q"],
    velocity: Float[Array, " q"],
    walls: Walls,
    *,
    margins: Float[Array, " c"],
    violated: Float[Array, " a"],
    heights: Float[Array, "a n"],
) -> tuple[Float[Array, " q"], Float[Array, " q"], Bool[Array, ""]]:
    """Position and velocity at the end of a flight, and whether it was given up.

    Args:
      y, velocity: at the start, whitened by the prior.
      walls: where the likelihood jumps.
      margins: at the start.
      violated: answers of each answerer at the start.
      heights: log likelihood by the number of violated answers, for each answerer.
    """
    number, squares = len(walls.relieved), jnp.diagonal(walls.products)
    of = jnp.arange(number) if walls.margins is None else walls.margins
    there = jnp.any(walls.relieved != 0, axis=1) & (squares[of] > 0)

    def to_next_wall(now: _Flight) -> _Flight:
        cotangents = jnp.where(there, _cotangents(now, walls), -jnp.inf)
        # two reductions, because the compiler makes a slow loop of argmax
        wall = jnp.min(jnp.where(cotangents == jnp.max(cotangents), jnp.arange(number), number - 1))
        angle, margin = jnp.arctan2(1.0, cotangents[wall]), of[wall]
        met = angle < DURATION - now.time
        angle = jnp.where(met, angle, DURATION - now.time)
        time = jnp.where(met, now.time + angle, DURATION)
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        speed = now.speeds[margin] * cos - now.margins[margin] * sin
        beyond = now.violated - jnp.sign(speed) * walls.relieved[wall]
        gain = jnp.sum(at_violated(heights, beyond) - at_violated(heights, now.violated))
        # Afshar & Domke (2015): through with the speed that is left, or reflected where none is
        square = speed**2 + 2 * squares[margin] * gain
        through = square > 0
        after = jnp.where(through, jnp.sign(speed) * jnp.sqrt(jnp.maximum(square, 0)), -speed)
        kick = jnp.where(met, (after - speed) / squares[margin], 0.0)
        return _Flight(
            now.margins * cos + now.speeds * sin,
            now.speeds * cos - now.margins * sin + kick * walls.products[margin],
            jnp.where(met & through, beyond, now.violated),
            time,
            jnp.where(met, wall, now.last),
            now.events + met,
            now.kicks.at[margin].add(kick * jnp.stack([-jnp.sin(time), jnp.cos(time)])),
        )

    zero = jnp.zeros((), int)
    kicks = jnp.zeros((len(walls.normals), 2), y.dtype)
    start = _Flight(margins, walls.normals @ velocity, violated, jnp.zeros((), y.dtype), zero - 1, zero, kicks)
    most = MOST_EVENTS * number
    end = lax.while_loop(lambda now: (now.time < DURATION) & (now.events < most), to_next_wall, start)
    position, velocity = jnp.stack([y, velocity]) + end.kicks.T @ walls.normals
    cos, sin = np.cos(DURATION), np.sin(DURATION)
    # Pakman & Paninski (2014): the motion under a standard normal distribution is a rotation
    return position * cos + velocity * sin, velocity * cos - position * sin, end.time < DURATION


def _cotangents(now: _Flight, walls: Walls) -> Float[Array, " w"]:
    """Of the angle until the flight meets each wall again; −∞ for those that it does not meet in half a period."""
    number = jnp.arange(len(walls.relieved))
    if walls.margins is None or walls.places is None:
        # Pakman & Paninski (2014): t cos s + u sin s is zero where cot s = −u/t: the next wall is that of the largest
        return jnp.where(number != now.last, -now.speeds / now.margins, -jnp.inf)
    # it is c where x = tan s/2 solves (c + t) x² − 2u x + c − t = 0; at the wall itself x = 0 is one of the solutions
    t, u, c = now.margins[walls.margins], now.speeds[walls.margins], walls.places
    square = u**2 + t**2 - c**2
    q = u + jnp.where(u < 0, -1, 1) * jnp.sqrt(jnp.maximum(square, 0))
    one, other = q / (c + t), (c - t) / q
    nearest = jnp.minimum(jnp.where(one > 0, one, jnp.inf), jnp.where(other > 0, other, jnp.inf))
    again = jnp.where(u / c > 0, u / c, jnp.inf)
    x = jnp.where(number == now.last, again, jnp.where(square >= 0, nearest, jnp.inf))
    return jnp.where(x < jnp.inf, (1 / x - x) / 2, -jnp.inf)


def flight_move(
    key: PRNGKeyArray,
    y: Float[Array, " q"],
    walls: Walls,
    *,
    margins: Float[Array, " c"],
    violated: Float[Array, " a"],
    heights: Float[Array, "a n"],
    log_likelihood: Callable[[Float[Array, " c"]], Float[Array, ""]],
) -> tuple[Float[Array, " q"], Float[Array, " c"], Bool[Array, ""]]:
    """y and its margins after one flight with a fresh velocity, and whether that was given up; arguments as in `flown`.

    The flight conserves prior × velocities × `heights`, and volumes; the test makes of it the law of `log_likelihood`,
    a function of the margins.
    """
    key_velocity, key_test = random.split(key)
    velocity = random.normal(key_velocity, y.shape, dtype=y.dtype)
    end, at_end, given_up = flown(y, velocity, walls, margins=margins, violated=violated, heights=heights)
    then = walls.normals @ end

    def energy(y: Float[Array, " q"], velocity: Float[Array, " q"], margins: Float[Array, " c"]) -> Float[Array, ""]:
        return 0.5 * jnp.sum(y**2) + 0.5 * jnp.sum(velocity**2) - log_likelihood(margins)

    # Metropolis test (Afshar & Domke 2015)
    lost = energy(y, velocity, margins) - energy(end, at_end, then)
    accepted = (jnp.log(random.uniform(key_test, dtype=y.dtype)) < lost) & ~given_up
    return jnp.where(accepted, end, y), jnp.where(accepted, then, margins), given_up
