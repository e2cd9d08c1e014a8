"""Properties of observation and action spaces: number of values, dimension, centre, range and bounds."""

from typing import Any

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box, Discrete
from jaxtyping import Float, Shaped
from numpy.typing import ArrayLike


def number_of_values(name: str, space: Space[Any]) -> int:
    """Number of values of a `Discrete` space that starts at zero. `ValueError` for any other space."""
    if not isinstance(space, Discrete) or space.start != 0:
        raise ValueError(f"{name}: expected a Discrete space that starts at 0, got {space}")
    return int(space.n)


def dimension(name: str, space: Space[Any]) -> int:
    """Length of the vectors of a one-dimensional `Box`. `ValueError` for any other space."""
    if not isinstance(space, Box) or len(space.shape) != 1 or space.shape[0] == 0:
        raise ValueError(f"{name}: expected a Box of shape (n,), got {space}")
    return int(space.shape[0])


def centre_and_range(name: str, space: Space[Any]) -> tuple[Float[np.ndarray, " a"], Float[np.ndarray, " a"]]:
    """(low + high)/2 and high − low of a `Box`, per dimension.

    Where both bounds are infinite 0 and 2, as for [−1, 1]; where one is, the range is the 2 next to the other.
    """
    if not isinstance(space, Box):
        raise ValueError(f"{name}: expected a Box, got {space}")
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    above, below = np.isfinite(low), np.isfinite(high)  # that there is a bound
    low, high = (
        np.where(above, low, np.where(below, high - 2.0, -1.0)),
        np.where(below, high, np.where(above, low + 2.0, 1.0)),
    )
    if not np.all(high > low):
        raise ValueError(f"{name}: expected low < high in every dimension, got {space}")
    return (low + high) / 2, high - low


def initial_deviation(initial_scale: ArrayLike, action_range: Float[np.ndarray, " a"]) -> Float[np.ndarray, " a"]:
    """Standard deviation per action dimension: `initial_scale`, one number or one per dimension, times the range."""
    scale = np.broadcast_to(np.asarray(initial_scale, dtype=np.float64), action_range.shape)
    if not np.all((scale > 0) & np.isfinite(scale)):
        raise ValueError(f"initial_scale: expected finite numbers > 0, got {initial_scale!r}")
    return scale * action_range


def clipped(actions: Shaped[np.ndarray, "n ..."], action_space: Space[Any]) -> Shaped[np.ndarray, "n ..."]:
    """Continuous actions as the environment will see them; discrete ones as they are."""
    return np.clip(actions, action_space.low, action_space.high) if isinstance(action_space, Box) else actions
