"""The features of an environment's spaces, drawn at observed samples, or φ(s) of the user's."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box, Discrete
from jaxtyping import Float, Shaped
from numpy.typing import ArrayLike

from bayespbrl.checks import indices, matrix
from bayespbrl.features.discrete import MOST_CONNECTED, OneHot, diffusion_basis, standardised
from bayespbrl.features.functions import OwnFeatures, StateFeatures
from bayespbrl.features.radial import JointRadialBasis, RadialBasis, RadialBasisOptions
from bayespbrl.kernels import of_each_action
from bayespbrl.trajectories import Trajectory, Transitions

ACTION_BANDWIDTH = 0.5  # of the action kernel, as a fraction of the action's range
MOST_OF_ACTIONS = 2000  # functions of Q in all where actions are discrete: LSTD takes the cube of their number
EFFORT = 0.1  # prior variance of an observed action's effort in the utility, in that of the functions of a state


@dataclass(frozen=True, eq=False)
class StateActionProduct:
    """φ(s, a) = φ(s) ⊗ e_a for discrete actions; column d·A + a holds φ_d(s)·1[action = a]."""

    state_features: StateFeatures
    number_of_actions: int

    def __call__(self, observations: Shaped[np.ndarray, "n ..."], actions: ArrayLike) -> Float[np.ndarray, "n da"]:
        """Features of N pairs."""
        states, actions = self.state_features(observations), indices("actions", actions, self.number_of_actions)
        if len(states) != len(actions):
            raise ValueError(f"actions: expected {len(states)}, one for each state, got {len(actions)}")
        return (states[:, :, None] * np.eye(self.number_of_actions)[actions][:, None, :]).reshape(len(states), -1)


def draw_state_features(
    observation_space: Space[Any], states: ArrayLike, options: RadialBasisOptions, *, rng: np.random.Generator
) -> OneHot | RadialBasis:
    """φ(s) for a space: one-hot where it is `Discrete`, else radial basis functions at observed states.

    Args:
      states: observed states, shape (N, S), or (N,) where discrete.
      options: of the radial basis functions.
    """
    if isinstance(observation_space, Discrete):
        return OneHot(int(observation_space.n))
    states = matrix("states", states, columns=_box("observation_space", observation_space).shape[0])
    kernel = options.state_kernel(states, rng)[0]
    if not options.constant:
        return kernel
    return replace(kernel, constant=float(np.sqrt(_variance(kernel))))


def draw_state_action_features(
    observation_space: Space[Any],
    action_space: Space[Any],
    states: ArrayLike,
    actions: ArrayLike,
    options: RadialBasisOptions,
    *,
    rng: np.random.Generator,
) -> JointRadialBasis | StateActionProduct:
    """φ(s, a) for two spaces: joint radial basis functions, or φ(s) ⊗ e_a where actions are `Discrete`.

    Many discrete actions have fewer functions each (`of_each_action`).

    Args:
      states, actions: observed pairs, shapes (N, S) and (N, A), or (N,) where discrete.
      options: of the radial basis functions, not normalised.
    """
    if options.normalised:
        raise ValueError("normalised: expected False for features of states and actions, got True")
    if isinstance(action_space, Discrete):
        number = int(action_space.n)
        options = replace(options, centres=of_each_action(options.centres, number, most=MOST_OF_ACTIONS))
        return StateActionProduct(draw_state_features(observation_space, states, options, rng=rng), number)
    box = _box("action_space", action_space)
    states = matrix("states", states, columns=_box("observation_space", observation_space).shape[0])
    actions = matrix("actions", actions, columns=box.shape[0])
    if len(states) != len(actions):
        raise ValueError(f"actions: expected {len(states)} rows, one for each state, got {len(actions)}")
    kernel, chosen = options.state_kernel(states, rng)
    low, high = box.low.astype(np.float64), box.high.astype(np.float64)
    bounded = np.isfinite(high) & np.isfinite(low)
    spread = 4 * actions.std(axis=0)  # stands for the range where a space has none
    width = np.where(bounded, np.where(bounded, high, 1.0) - np.where(bounded, low, 0.0), spread)
    return JointRadialBasis(
        states=kernel,
        action_centres=np.clip(actions[chosen], low, high),
        action_bandwidths=np.full(box.shape[0], ACTION_BANDWIDTH),
        action_low=low,
        action_high=high,
        action_range=width,
    )


@dataclass(frozen=True)
class FeatureSource:
    """Draws the features of an environment at observed samples, or takes the user's φ(s).

    Attributes:
      observation_space, action_space: of the environment.
      period: of each observation dimension, infinite where not periodic; None for none.
      own: φ(s) of the user's; None: drawn.
    """

    observation_space: Space[Any]
    action_space: Space[Any]
    period: ArrayLike | None = None
    own: StateFeatures | None = None

    def check(self, options: RadialBasisOptions) -> None:
        """`ValueError` where features of states by these options cannot be drawn, whatever will be observed."""
        space = self.observation_space
        if self.own is None and options.diffusion and isinstance(space, Discrete) and space.n > MOST_CONNECTED:
            raise ValueError(f"diffusion_utility: expected at most {MOST_CONNECTED} states, got {space.n}")

    def of_states(
        self, trajectories: Sequence[Trajectory], options: RadialBasisOptions, *, rng: np.random.Generator
    ) -> StateFeatures:
        """φ(s), the user's in the units of the states of the trajectories, or drawn at these.

        Where all are equally long and none ended by itself, no constant feature is drawn.
        """
        self.check(options)
        equally_long = len({len(each) for each in trajectories}) == 1
        if self.own is not None:
            observed = _observed(trajectories)
            states = np.unique(observed) if observed.ndim == 1 else observed
            return OwnFeatures.in_any_units(self.own, states, of_equal_lengths=equally_long)
        space = self.observation_space
        if options.diffusion and isinstance(space, Discrete):
            return diffusion_basis(trajectories, int(space.n))
        if options.standardised and isinstance(space, Discrete):
            return standardised(trajectories, int(space.n))
        if equally_long and not any(each.terminated for each in trajectories):
            options = replace(options, constant=False)
        drawn = draw_state_features(self.observation_space, _observed(trajectories), self._periodic(options), rng=rng)
        if not (options.effort and isinstance(drawn, RadialBasis) and isinstance(self.action_space, Box)):
            return drawn
        return replace(
            drawn, effort=_effort(drawn, self.action_space, np.concatenate([t.actions for t in trajectories]))
        )

    def of_steps(
        self, steps: Transitions, options: RadialBasisOptions, *, rng: np.random.Generator
    ) -> JointRadialBasis | StateActionProduct:
        """φ(s, a), drawn at observed transitions."""
        spaces = (self.observation_space, self.action_space)
        return draw_state_action_features(*spaces, steps.states, steps.actions, self._periodic(options), rng=rng)

    def _periodic(self, options: RadialBasisOptions) -> RadialBasisOptions:
        return replace(options, period=self.period)


def _observed(trajectories: Sequence[Trajectory]) -> Shaped[np.ndarray, "n ..."]:
    """All states of the trajectories."""
    return np.concatenate([trajectory.states for trajectory in trajectories])


def _effort(drawn: RadialBasis, space: Box, actions: Float[np.ndarray, "n a"]) -> tuple[float, ...]:
    """The factors of the squares of an action's parts, as `RadialBasis` has them; () where all actions are 0."""
    largest = np.maximum(np.abs(space.low), np.abs(space.high)).astype(np.float64)
    usual = np.sqrt(np.mean(actions**2, axis=0))
    unit = np.where(np.isfinite(largest), largest, usual)
    shares = 1 / (len(unit) * np.where(unit > 0, unit, 1.0) ** 2)
    observed = np.sqrt(np.mean((actions**2 @ shares) ** 2))
    return tuple((np.sqrt(EFFORT * _variance(drawn)) / observed * shares).tolist()) if observed > 0 else ()


def _variance(drawn: RadialBasis) -> float:
    """Prior variance of a state's utility by the functions alone, in the mean over the centres, which are states."""
    columns = drawn(drawn.centres)[:, : len(drawn.centres)]
    return float(np.mean(np.sum(columns**2, axis=1)))


def _box(name: str, space: Space[Any]) -> Box:
    if not isinstance(space, Box) or len(space.shape) != 1:
        raise ValueError(f"{name}: expected a Box of shape (n,), got {space}")
    return space
