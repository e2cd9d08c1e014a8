"""The squared-exponential kernel with periodic dimensions, and the median rule for its bandwidths.

k(x, z) = exp(−½ Σⱼ δⱼ²/bⱼ²), with δⱼ = xⱼ − zⱼ, or, in a dimension of period P, the chord δⱼ = P/π · sin(π(xⱼ − zⱼ)/P):
the kernel over (cos, sin) on a circle of circumference P, which agrees with the plain one over short distances
(Rasmussen & Williams 2006, eqs. 4.9 and 4.31). A dimension of bandwidth zero is left out. Coordinates in which the
chord is an ordinary Euclidean distance turn every kernel matrix into one matrix product.
"""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from bayespbrl import checks

Vector = Float[Array, " s"] | Float[np.ndarray, " s"]
Rows = Float[Array, "d s"] | Float[np.ndarray, "d s"]
SMALLEST_SUM = 1e-200  # of a row of products of exponentials: below it they have lost digits
ROUNDING = 1e-12  # of a dimension of the states, as a share of its largest value
FAR = 1e6  # bandwidths from the middle, from where on the expansion of the square may lose more than 1e-4
LEAST_OF_AN_ACTION = 10  # functions of one of many discrete actions
ROWS_AT_A_TIME = 1024  # keeps a block of a wide kernel matrix in the processor's cache between its three passes


def of_each_action(functions: int, actions: int, *, most: int) -> int:
    """How many functions each discrete action has: `functions`, but at most `most` in all, or ten each."""
    return min(functions, max(LEAST_OF_AN_ACTION, most // actions))


def as_periods(period: ArrayLike | None, dimension: int) -> Float[np.ndarray, "{dimension}"]:
    """`period` as an array, all infinite for None. `ValueError` unless there are `dimension` numbers > 0."""
    if period is None:
        return np.full(dimension, np.inf)
    periods = np.asarray(period, dtype=np.float64)
    if periods.shape != (dimension,) or not np.all(periods > 0):
        raise ValueError(f"period: expected {dimension} positive numbers (inf where not periodic), got {period}")
    return periods


def coordinates(points: Float[np.ndarray, "n s"], period: Float[np.ndarray, " s"]) -> Float[np.ndarray, "n e"]:
    """Points in the kernel's Euclidean coordinates: plain dimensions, then P/2π·cos, then P/2π·sin."""
    periodic = np.isfinite(period)
    radius = period[periodic] / (2 * np.pi)
    # Rasmussen & Williams (2006), eq. 4.31, by (cos, sin)
    angles = points[:, periodic] / radius
    return np.concatenate([points[:, ~periodic], radius * np.cos(angles), radius * np.sin(angles)], axis=1)


def inverse_bandwidths(bandwidths: Float[np.ndarray, " s"], period: Float[np.ndarray, " s"]) -> Float[np.ndarray, " e"]:
    """1/b for each of the `coordinates`; zero where the bandwidth is zero, which leaves the dimension out."""
    inverse = np.divide(1.0, bandwidths, out=np.zeros(len(bandwidths)), where=bandwidths > 0)
    periodic = np.isfinite(period)
    return np.concatenate([inverse[~periodic], inverse[periodic], inverse[periodic]])


def squared_exponential(
    points: Float[np.ndarray, "n e"], centres: Float[np.ndarray, "d e"], *, normalised: bool = False
) -> Float[np.ndarray, "n d"]:
    """exp(−½‖xᵢ − zⱼ‖²) of scaled coordinates, or that over its sum over j."""
    middle = centres.mean(axis=0)  # the expansion of the square cancels; near the origin it loses least
    points, centres = points - middle, centres - middle
    left = np.column_stack([points, -0.5 * np.square(points).sum(axis=1), np.ones(len(points))])
    right = np.column_stack([centres, np.ones(len(centres)), -0.5 * np.square(centres).sum(axis=1)]).T
    kernel = np.empty((len(points), len(centres)))
    far = max(np.abs(points).max(initial=0), np.abs(centres).max(initial=0)) > FAR
    for start in range(0, len(points), ROWS_AT_A_TIME):
        block = kernel[start : start + ROWS_AT_A_TIME]
        if far:
            apart = points[start : start + ROWS_AT_A_TIME, None, :] - centres
            block[:] = -0.5 * np.square(apart).sum(axis=2)
        else:
            np.matmul(left[start : start + ROWS_AT_A_TIME], right, out=block)
        if normalised:  # the nearest centre's is exp(0), so that the sum is never zero, however far the point
            block -= block.max(axis=1, keepdims=True)
        np.minimum(block, 0.0, out=block)
        np.exp(block, out=block)  # Rasmussen & Williams (2006), eq. 4.9
        if normalised:
            block /= block.sum(axis=1, keepdims=True)
    return kernel


def radial_basis(
    points: Float[np.ndarray, "n s"],
    centres: Float[np.ndarray, "d s"],
    bandwidths: Float[np.ndarray, " s"],
    period: Float[np.ndarray, " s"],
    *,
    normalised: bool = False,
) -> Float[np.ndarray, "n d"]:
    """k(xᵢ, zⱼ) for points x and centres z; with `normalised` each row is divided by its sum."""
    scale = inverse_bandwidths(bandwidths, period)
    return squared_exponential(
        coordinates(points, period) * scale, coordinates(centres, period) * scale, normalised=normalised
    )


def radial_basis_under(
    multiples: Float[np.ndarray, "c s"],
    points: Float[np.ndarray, "n s"],
    centres: Float[np.ndarray, "d s"],
    bandwidths: Float[np.ndarray, " s"],
    period: Float[np.ndarray, " s"],
    *,
    normalised: bool = False,
) -> Iterator[tuple[Float[np.ndarray, "n d"], Float[np.ndarray, " n"]]]:
    """k under each row of bandwidth multiples in turn, and the factor by which to multiply each of its rows.

    Both together are `radial_basis`; they are only good until the next. k is a product over dimensions, so that the
    exponentials are taken once for each multiple and dimension; rows in lexicographic order share what they begin with.
    """
    squares = _squares(points, centres, bandwidths, period)
    # Rasmussen & Williams (2006), eq. 4.9, one factor for each dimension
    factors = [
        {multiple: np.exp(square / (-2 * multiple**2)) for multiple in np.unique(column)}
        for square, column in zip(squares, multiples.T, strict=True)
    ]
    products, ones = [np.empty_like(square) for square in squares], np.ones(len(points))
    kernel, shares, last = products[-1], ones, np.zeros(len(squares))
    for row in multiples:
        if (row != last).any():
            for j in range(int(np.argmax(row != last)), len(row)):  # the products of what comes before are at hand
                if j == 0:
                    products[0] = factors[0][row[0]]
                else:
                    np.multiply(products[j - 1], factors[j][row[j]], out=products[j])
            kernel, last = products[-1], row
            if normalised:
                totals = kernel @ np.ones(len(centres))
                if (far := totals < SMALLEST_SUM).any():
                    kernel[far] = radial_basis(points[far], centres, bandwidths * row, period, normalised=True)
                    totals[far] = 1.0
                shares = 1 / totals
        yield kernel, shares


def _squares(
    points: Float[np.ndarray, "n s"],
    centres: Float[np.ndarray, "d s"],
    bandwidths: Float[np.ndarray, " s"],
    period: Float[np.ndarray, " s"],
) -> list[Float[np.ndarray, "n d"]]:
    """δⱼ²/bⱼ² of each dimension j."""
    scale, periodic = inverse_bandwidths(bandwidths, period), np.isfinite(period)
    left, right = coordinates(points, period) * scale, coordinates(centres, period) * scale
    dimensions = np.concatenate([np.flatnonzero(~periodic), np.flatnonzero(periodic), np.flatnonzero(periodic)])
    return [
        sum(np.square(left[:, e, None] - right[:, e]) for e in np.flatnonzero(dimensions == j))
        for j in range(len(period))
    ]


def radial_basis_row(point: Vector, centres: Rows, bandwidths: Vector, period: Vector) -> Float[Array, " d"]:
    """`radial_basis` of one point, traceable by JAX."""
    bandwidths = jnp.asarray(bandwidths)
    inverse = jnp.where(bandwidths > 0, 1 / jnp.where(bandwidths > 0, bandwidths, 1.0), 0.0)
    difference = _on_circles(jnp.asarray(point), period) - _on_circles(jnp.asarray(centres), period)
    # Rasmussen & Williams (2006), eq. 4.9
    return jnp.exp(-0.5 * jnp.sum(jnp.square(difference * jnp.tile(inverse, 2)), axis=-1))


def _on_circles(points: Float[Array, "*b s"], period: Vector) -> Float[Array, "*b e"]:
    """`coordinates` with two for each dimension, traceable: the second one of a plain dimension is zero.

    Those of the centres are the same for all points, so that no sine is taken of a difference.
    """
    periodic = jnp.isfinite(period)
    radius = jnp.where(periodic, period, 1.0) / (2 * jnp.pi)  # no infinity inside: its gradient would be NaN
    angles = points / radius  # Rasmussen & Williams (2006), eq. 4.31
    first = jnp.where(periodic, radius * jnp.cos(angles), points)
    return jnp.concatenate([first, jnp.where(periodic, radius * jnp.sin(angles), 0.0)], axis=-1)


def median_bandwidths(
    points: ArrayLike,
    *,
    factor: float = 1.0,
    period: ArrayLike | None = None,
    rng: np.random.Generator,
    number_of_pairs: int = 4096,
) -> Float[np.ndarray, " s"]:
    """The median rule: factor × sqrt(median over pairs of the squared difference), per dimension.

    The median is over random pairs of rows of `points` (N, S), periodic differences wrapped. Where more than half of
    the pairs agree the mean takes the median's place; only a dimension that is constant but for rounding gets bandwidth
    zero. The bandwidths are in the units of `points`.

    Raises:
      ValueError: points that are no finite matrix with rows, a factor or a period that is not > 0.
    """
    factor, points = checks.positive("factor", factor), checks.matrix("points", points)
    if len(points) == 0:
        raise ValueError(f"points: expected shape (N >= 1, S), got {points.shape}")
    periods = as_periods(period, points.shape[1])
    if len(points) == 1:
        return np.zeros(points.shape[1])
    first = rng.integers(len(points), size=number_of_pairs)
    second = (first + rng.integers(1, len(points), size=number_of_pairs)) % len(points)  # never the row itself
    squares = np.square(_wrapped(points[first] - points[second], periods))
    middle, mean = np.median(squares, axis=0), squares.mean(axis=0)
    if (equal := mean == 0).any():  # a rare value may be in no pair
        mean[equal] = _mean_square(points[:, equal], periods[equal])
    deviations = np.sqrt(np.where(middle > 0, middle, mean))
    return factor * beyond_rounding(deviations, points)


def beyond_rounding(deviations: Float[np.ndarray, " s"], points: Rows) -> Float[np.ndarray, " s"]:
    """Deviations of the dimensions of `points`; zero where a dimension is constant but for rounding."""
    return np.where(deviations > ROUNDING * np.abs(points).max(axis=0), deviations, 0.0)


def _wrapped(difference: Float[np.ndarray, "n s"], periods: Float[np.ndarray, " s"]) -> Float[np.ndarray, "n s"]:
    """Differences, those of periodic dimensions the shorter way round."""
    periodic = np.isfinite(periods)
    some_period = np.where(periodic, periods, 1.0)
    return difference - np.where(periodic, some_period * np.round(difference / some_period), 0.0)


def _mean_square(points: Float[np.ndarray, "n s"], periods: Float[np.ndarray, " s"]) -> Float[np.ndarray, " s"]:
    """Mean over all pairs of rows of the squared difference, exactly 0 where constant; around the first row."""
    return 2 * _wrapped(points - points[0], periods).var(axis=0, ddof=1)
