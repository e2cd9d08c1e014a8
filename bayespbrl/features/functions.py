"""What features are to the rest of the package: functions of arrays, which are checked, and their linear functions."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped

from bayespbrl.checks import dense, function

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
    """φ(s) of the user's: any function of observations, in any units, whose values are checked."""

    function: StateFeatures

    def __call__(self, states: Shaped[np.ndarray, "n ..."]) -> Float[np.ndarray, "n d"]:
        """`checked_features` of the function."""
        return checked_features(self.function, states)


def linear(features: np.ndarray, weights: np.ndarray) -> Float[np.ndarray, "n ..."]:
    """wᵀφ of each row of φ, (n, D), for weights (D,), or several side by side, (D, m).

    Raises:
      ValueError: features of another length than the weights, as a function of the user's may return.
    """
    if features.shape[1] != len(weights):
        raise ValueError(f"features: expected {len(weights)} for each state, as before, got {features.shape[1]}")
    return np.asarray(features @ weights)  # u = wᵀφ(s) (paper, step 2), wᵀψ(τ) (eq. 4)
