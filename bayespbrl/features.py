"""State features φ(s) and state-action features φ(s, a): one-hot and radial basis functions (paper, step 1).

Features are callables on NumPy arrays, drawn anew at each iteration from the observed samples. Each is a frozen
dataclass of arrays and numbers, so that a run can store what it used. A user's own state features are any function of
observations; `checked_features` calls it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box, Discrete
from numpy.typing import ArrayLike

from bayespbrl.kernels import as_periods, median_bandwidths, radial_basis

StateFeatures = Callable[[np.ndarray], np.ndarray]
StateActionFeatures = Callable[[np.ndarray, np.ndarray], np.ndarray]


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
class RadialBasis:
    """φ_d(s) = exp(−½ Σⱼ δⱼ²/bⱼ²) around centre d; δⱼ a difference, or a chord where dimension j is periodic.

    Attributes:
      centres: shape (D, S).
      bandwidths: b > 0 in the units of the observation, shape (S,); a dimension of bandwidth zero is left out.
      period: shape (S,), infinite where not periodic.
      normalised: whether φ is divided by its sum. A linear function of it then goes on beyond the centres with the
        value of the nearest ones, where plain radial basis functions fall to zero.
    """

    centres: np.ndarray
    bandwidths: np.ndarray
    period: np.ndarray
    normalised: bool = False

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Features of observations of shape (N, S); shape (N, D)."""
        observations = _vectors("observations", observations, self.centres.shape[1])
        return radial_basis(observations, self.centres, self.bandwidths, self.period, normalised=self.normalised)

    def rescaled(self, multiples: ArrayLike) -> Self:
        """The same centres with bandwidths `multiples` times as wide, one number or one a dimension."""
        return replace(self, bandwidths=self.bandwidths * np.asarray(multiples))


@dataclass(frozen=True, eq=False)
class JointRadialBasis:
    """φ_d(s, a) = state kernel × action kernel at the joint centre d (specification, section 8).

    Actions are clipped to [low, high], as the environment does, and divided by their range.

    Attributes:
      states: the state kernel, with D centres.
      action_centres: in the action's units, inside the bounds; shape (D, A).
      action_bandwidths: as fractions of the range, shape (A,).
      action_low, action_high: shape (A,); infinite where the space has no bound.
      action_range: high − low, or what stands for it in an unbounded dimension; shape (A,).
    """

    states: RadialBasis
    action_centres: np.ndarray
    action_bandwidths: np.ndarray
    action_low: np.ndarray
    action_high: np.ndarray
    action_range: np.ndarray

    def __call__(self, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Features of N pairs, observations (N, S) and actions (N, A); shape (N, D)."""
        states, kernel = self.states, self.action_bandwidths * self.action_range
        observations = _vectors("observations", observations, states.centres.shape[1])
        actions = _vectors("actions", actions, self.action_centres.shape[1])
        if len(observations) != len(actions):
            raise ValueError(f"actions: expected {len(observations)} rows, one an observation, got {len(actions)}")
        clipped = np.clip(actions, self.action_low, self.action_high)
        return radial_basis(  # a product of exponentials is one exponential over both
            np.hstack([observations, clipped]),
            np.hstack([states.centres, self.action_centres]),
            np.concatenate([states.bandwidths, kernel]),
            np.concatenate([states.period, np.full(len(kernel), np.inf)]),
        )


@dataclass(frozen=True, eq=False)
class StateActionProduct:
    """φ(s, a) = φ(s) ⊗ e_a for discrete actions; one-hot (s, a), column s·A + a, where φ(s) is one-hot."""

    state_features: StateFeatures
    number_of_actions: int

    def __call__(self, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Features of N state-action pairs; shape (N, D·A), column d·A + a holding φ_d(s)·1[action = a]."""
        states = self.state_features(observations)
        chosen = OneHot(self.number_of_actions)(actions)
        return (states[:, :, None] * chosen[:, None, :]).reshape(len(states), -1)


def draw_state_features(
    observation_space: Space,
    states: np.ndarray,
    *,
    rng: np.random.Generator,
    number_of_centres: int,
    bandwidth_factor: float = 1.0,
    period: ArrayLike | None = None,
    normalised: bool = False,
) -> OneHot | RadialBasis:
    """φ(s) for a space: one-hot where it is `Discrete`, else radial basis functions at observed states.

    Args:
      states: observed states, shape (N, S), or (N,) where discrete.
      number_of_centres: D, drawn without replacement; at most N are.
      bandwidth_factor: multiple of the median rule.
      period: of each dimension, infinite where not periodic; None for none.
      normalised: as of `RadialBasis`.
    """
    if isinstance(observation_space, Discrete):
        return OneHot(int(observation_space.n))
    states = _vectors("states", states, _box("observation_space", observation_space).shape[0])
    centres = states[_without_replacement(len(states), number_of_centres, rng)]
    bandwidths = median_bandwidths(states, factor=bandwidth_factor, period=period, rng=rng)
    return RadialBasis(centres, bandwidths, as_periods(period, states.shape[1]), normalised)


def draw_state_action_features(
    observation_space: Space,
    action_space: Space,
    states: np.ndarray,
    actions: np.ndarray,
    *,
    rng: np.random.Generator,
    number_of_centres: int,
    bandwidth_factor: float = 1.0,
    action_bandwidth: float = 0.5,
    period: ArrayLike | None = None,
) -> JointRadialBasis | StateActionProduct:
    """φ(s, a) for two spaces: joint radial basis functions, or φ(s) ⊗ e_a where actions are `Discrete`.

    Args:
      states, actions: observed pairs, shapes (N, S) and (N, A), or (N,) where discrete.
      number_of_centres, bandwidth_factor, period: as of `draw_state_features`.
      action_bandwidth: of the action kernel, as a fraction of the action's range, > 0.
    """
    if isinstance(action_space, Discrete):
        features = draw_state_features(
            observation_space,
            states,
            rng=rng,
            number_of_centres=number_of_centres,
            bandwidth_factor=bandwidth_factor,
            period=period,
        )
        return StateActionProduct(features, int(action_space.n))
    if not action_bandwidth > 0:
        raise ValueError(f"action_bandwidth: expected a number > 0, got {action_bandwidth}")
    box = _box("action_space", action_space)
    states = _vectors("states", states, _box("observation_space", observation_space).shape[0])
    actions = _vectors("actions", actions, box.shape[0])
    if len(states) != len(actions):
        raise ValueError(f"actions: expected {len(states)} rows, one a state, got {len(actions)}")
    chosen = _without_replacement(len(states), number_of_centres, rng)
    bandwidths = median_bandwidths(states, factor=bandwidth_factor, period=period, rng=rng)
    low, high = box.low.astype(np.float64), box.high.astype(np.float64)
    bounded = np.isfinite(high) & np.isfinite(low)
    spread = 4 * actions.std(axis=0)  # stands for the range where a space has none
    width = np.where(bounded, np.where(bounded, high, 1.0) - np.where(bounded, low, 0.0), spread)
    return JointRadialBasis(
        states=RadialBasis(states[chosen], bandwidths, as_periods(period, states.shape[1])),
        action_centres=np.clip(actions[chosen], low, high),
        action_bandwidths=np.full(box.shape[0], action_bandwidth),
        action_low=low,
        action_high=high,
        action_range=width,
    )


def checked_features(features: StateFeatures, states: np.ndarray) -> np.ndarray:
    """`features(states)` as float64 of shape (N, D); `ValueError`, naming what came, unless it is that and finite."""
    name = getattr(features, "__name__", type(features).__name__)
    values = np.asarray(features(states))
    if values.ndim != 2 or len(values) != len(states) or values.shape[1] == 0:
        raise ValueError(f"features {name}: expected shape ({len(states)}, D), got {values.shape}")
    if not (np.issubdtype(values.dtype, np.number) or values.dtype == bool) or np.iscomplexobj(values):
        raise ValueError(f"features {name}: expected real numbers, got {values.dtype}")
    values = values.astype(np.float64)
    if not np.isfinite(values).all():
        row = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
        raise ValueError(f"features {name}: expected finite numbers, got NaN or infinity for state {states[row]}")
    return values


def _vectors(name: str, values: np.ndarray, dimension: int) -> np.ndarray:
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] != dimension:
        raise ValueError(f"{name}: expected shape (N, {dimension}), got {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"{name}: expected finite numbers, got NaN or infinity")
    return values


def _box(name: str, space: Space) -> Box:
    if not isinstance(space, Box) or len(space.shape) != 1:
        raise ValueError(f"{name}: expected a Discrete space or a Box of shape (n,), got {space}")
    return space


def _without_replacement(number: int, wanted: int, rng: np.random.Generator) -> np.ndarray:
    if wanted < 1:
        raise ValueError(f"number_of_centres: expected at least 1, got {wanted}")
    if number < 1:
        raise ValueError("states: expected at least one row, got none")
    return rng.choice(number, size=min(wanted, number), replace=False)
