"""What features are to the rest of the package: functions of arrays, which are checked, and their linear functions."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Float, Shaped

from bayespbrl.checks import dense, finite, function

SINGLE_PRECISION = 1e-6  # ten times its rounding
StateFeatures = Callable[[Shaped[np.ndarray, "n ..."]], Shaped[np.ndarray, "n d"]]
StateActionFeatures = Callable[[Shaped[np.ndarray, "n ..."], Shaped[np.ndarray, "n ..."]], Shaped[np.ndarray, "n d"]]


def checked_features(features: StateFeatures, states: Shaped[np.ndarray, "n ..."]) -> Float[np.ndarray, "n d"]:
    """`features(states)` as finite float64 numbers of shape (N, D); `ValueError` where it is anything else."""
    name = getattr(features, "__name__", type(features).__name__)
    function("features", features, " of states (N, S)")
    values = dense(f"features {name}", features(np.array(states)))  # a copy, which the function may change
    if values.ndim != 2 or len(values) != len(states) or values.shape[1] == 0:
        raise ValueError(f"features {name}: expected shape ({len(states)}, D), got {values.shape}")
    if not (np.issubdtype(values.dtype, np.number) or values.dtype == bool) or np.iscomplexobj(values):
        raise ValueError(f"features {name}: expected real numbers, got {values.dtype}")
    if (bad := ~np.isfinite(values := values.astype(np.float64)).all(axis=1)).any():
        raise ValueError(f"features {name}: expected finite numbers, got NaN or infinity for state {states[bad][0]}")
    return values


@dataclass(frozen=True)
class OwnFeatures:
    """φ(s) of the user's: any function of observations, whose values are checked.

    Attributes:
      function: of observations.
      units: what each of D features is divided by; () for none.
    """

    function: StateFeatures
    units: tuple[float, ...] = ()

    @classmethod
    def in_any_units(
        cls, function: StateFeatures, states: Shaped[np.ndarray, "n ..."], *, of_equal_lengths: bool
    ) -> Self:
        """Features divided by what they are over observed states, so that all weights mean as much a priori.

        Among trajectories `of_equal_lengths` only their `ranges` tell, because what is the same everywhere cancels.
        Otherwise it is their `sizes`: one that hardly changes, over its range, would count nothing but the steps.
        """
        values = checked_features(function, states)
        return cls(function, tuple((ranges(values) if of_equal_lengths else sizes(values)).tolist()))

    def __call__(self, states: Shaped[np.ndarray, "n ..."]) -> Float[np.ndarray, "n d"]:
        """`checked_features` of the function, in the units."""
        values = checked_features(self.function, states)
        if not self.units:
            return values
        _check_number(values, len(self.units))
        return values / np.array(self.units)


def sizes(values: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " d"]:
    """Largest absolute value of each column; 1 where all are zero."""
    largest = np.abs(values).max(axis=0, initial=0.0)
    return np.where(largest > 0, largest, 1.0)


def ranges(values: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " d"]:
    """Greatest less least value of each column; its size where that is rounding, of single precision too."""
    largest = sizes(values)
    if not len(values):
        return largest
    with np.errstate(over="ignore"):
        width = np.ptp(values, axis=0)
    finite("features: ranges", width)  # of numbers near the largest
    return np.where(width > SINGLE_PRECISION * largest, width, largest)


def linear(features: np.ndarray, weights: np.ndarray) -> Float[np.ndarray, "n ..."]:
    """wᵀφ of each row of φ, (n, D), for weights (D,), or several side by side, (D, m).

    Raises:
      ValueError: features of another length than the weights, as a function of the user's may return.
    """
    _check_number(features, len(weights))
    return np.asarray(features @ weights)  # u = wᵀφ(s) (paper, step 2), wᵀψ(τ) (eq. 4)


def _check_number(features: np.ndarray, number: int) -> None:
    if features.shape[1] != number:
        raise ValueError(f"features: expected {number} for each state, as before, got {features.shape[1]}")
