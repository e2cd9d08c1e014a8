"""State features φ(s) and state-action features φ(s, a): one-hot and radial basis functions (paper, step 1)."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class OneHot:
    """φ(s) = e_s for discrete states: with it a linear function of the features is exact, not an approximation."""

    number_of_states: int

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Features of integer observations of shape (N,); shape (N, number_of_states)."""
        observations = np.asarray(observations)
        if observations.ndim != 1 or not np.issubdtype(observations.dtype, np.integer):
            raise ValueError(
                f"observations: expected integers of shape (N,), got {observations.dtype} of shape {observations.shape}"
            )
        if observations.size and (observations.min() < 0 or observations.max() >= self.number_of_states):
            raise ValueError(
                f"observations: expected states in 0 … {self.number_of_states - 1}, "
                f"got {observations.min()} … {observations.max()}"
            )
        features = np.zeros((len(observations), self.number_of_states))
        features[np.arange(len(observations)), observations] = 1.0
        return features


@dataclass(frozen=True, eq=False)
class StateActionProduct:
    """φ(s, a) = φ(s) ⊗ e_a for discrete actions; one-hot (s, a), column s·A + a, where φ(s) is one-hot."""

    state_features: "OneHot"
    number_of_actions: int

    def __call__(self, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Features of N state-action pairs; shape (N, D·A), column d·A + a holding φ_d(s)·1[action = a]."""
        states = self.state_features(observations)
        chosen = OneHot(self.number_of_actions)(actions)
        return (states[:, :, None] * chosen[:, None, :]).reshape(len(states), -1)
