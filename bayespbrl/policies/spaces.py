"""What an observation or action space says: the number of values, or the dimension, centre and range; its bounds."""

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box, Discrete


def number_of_values(name: str, space: Space) -> int:
    """Number of values of a `Discrete` space that starts at zero. `ValueError` for any other space."""
    if not isinstance(space, Discrete) or space.start != 0:
        raise ValueError(f"{name}: expected a Discrete space that starts at 0, got {space}")
    return int(space.n)


def dimension(name: str, space: Space) -> int:
    """Length of the vectors of a one-dimensional `Box`. `ValueError` for any other space."""
    if not isinstance(space, Box) or len(space.shape) != 1 or space.shape[0] == 0:
        raise ValueError(f"{name}: expected a Box of shape (n,), got {space}")
    return int(space.shape[0])


def centre_and_range(name: str, space: Space) -> tuple[np.ndarray, np.ndarray]:
    """(low + high)/2 and high − low of a `Box`, per dimension; 0 and 2, as of [−1, 1], where a bound is infinite."""
    if not isinstance(space, Box):
        raise ValueError(f"{name}: expected a Box, got {space}")
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    bounded = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
    if not np.all(high > low):
        raise ValueError(f"{name}: expected low < high in every dimension, got {space}")
    return (low + high) / 2, high - low


def clipped(actions: np.ndarray, action_space: Space) -> np.ndarray:
    """Continuous actions as the environment will see them; discrete ones as they are."""
    return np.clip(actions, action_space.low, action_space.high) if isinstance(action_space, Box) else actions
