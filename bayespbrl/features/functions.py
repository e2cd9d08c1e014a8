"""What features are to the rest of the package: functions of arrays, which are checked, and their linear functions."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Float, Shaped

from bayespbrl.checks import dense, finite, function
from bayespbrl.kernels import beyond_rounding

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
    def in_any_units(cls, function: StateFeatures, states: Shaped[np.ndarray, "n ..."]) -> Self:
        """Features divided by their `ranges` over observed states, so that all weights mean as much a priori."""
        return cls(function, tuple(ranges(checked_features(function, states)).tolist()))

    def __call__(self, states: Shaped[np.ndarray, "n ..."]) -> Float[np.ndarray, "n d"]:
        """`checked_features` of the function, in the units."""
        values = checked_features(self.function, states)
        if not self.units:
            return values
        if values.shape[1] != len(self.units):
            raise ValueError(f"features: expected {len(self.units)} for each state, as before, got {values.shape[1]}")
        return values / np.array(self.units)


def ranges(values: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " d"]:
    """Greatest less least value of each column; of one that is constant its size, or 1 if it is zero."""
    if not len(values):
        return np.ones(values.shape[1])
    with np.errstate(over="ignore"):
        width = np.ptp(values, axis=0)
    finite("features: ranges", width)  # of numbers near the largest
    width = beyond_rounding(width, values)
    width = np.where(width > 0, width, np.abs(values).max(axis=0))
    return np.where(width > 0, width, 1.0)


def linear(features: np.ndarray, weights: np.ndarray) -> Float[np.ndarray, "n ..."]:
    """wᵀφ of each row of φ, (n, D), for weights (D,), or several side by side, (D, m).

    Raises:
      ValueError: features of another length than the weights, as a function of the user's may return.
    """
    if features.shape[1] != len(weights):
        raise ValueError(f"features: expected {len(weights)} for each state, as before, got {features.shape[1]}")
    return np.asarray(features @ weights)  # u = wᵀφ(s) (paper, step 2), wᵀψ(τ) (eq. 4)
