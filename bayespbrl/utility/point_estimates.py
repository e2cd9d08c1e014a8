"""Utilities without a posterior: the linear program's weights (eq. 10), and the known reward as the reference."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bayespbrl.features import StateFeatures, linear
from bayespbrl.trajectories import Trajectory, Transitions, step_features, trajectory_features
from bayespbrl.utility.estimate import WithoutDraws, refused
from bayespbrl.utility.quality import FitQuality


@dataclass(frozen=True)
class LinearProgramUtility(WithoutDraws):
    """u(s′) = wᵀφ(s′) with the weights of the linear program (eq. 10).

    Attributes:
      features: φ.
      weights: w in the units of φ, shape (D,).
      discount: γ of ψ(τ).
      quality: how far it can be trusted.
      scale: what the differences were divided by.
    """

    features: StateFeatures
    weights: np.ndarray
    discount: float
    quality: FitQuality
    scale: float = 1.0

    @property
    def number_of_features(self) -> int:
        """D."""
        return len(self.weights)

    def utilities(self, states: np.ndarray, *, actions: np.ndarray | None = None) -> Float[np.ndarray, " n"]:
        """wᵀφ of n states, or with the actions that led there of n steps."""
        return linear(step_features(self.features, states, actions), self.weights)

    def step_utilities(self, steps: Transitions) -> Float[np.ndarray, " n"]:
        """uᵢ = wᵀφ(sᵢ′) (paper, step 2): of the *next* state, as in ψ, and of the effort of the action."""
        return self.utilities(steps.next_states, actions=steps.actions)

    def trajectory_utilities(self, trajectories: Sequence[Trajectory]) -> Float[np.ndarray, " n"]:
        """wᵀψ(τ) of each trajectory."""
        return linear(trajectory_features(trajectories, self.features, discount=self.discount), self.weights)


@dataclass(frozen=True)
class KnownReward(WithoutDraws):
    """The environment's own reward in place of an estimate: a reference run trained on the hidden reward."""

    quality: FitQuality
    features = None
    number_of_features = 0
    utilities = refused("utilities", "a utility of states")

    def step_utilities(self, steps: Transitions) -> Float[np.ndarray, " n"]:
        """The hidden reward of each transition."""
        return steps.rewards

    def trajectory_utilities(self, trajectories: Sequence[Trajectory]) -> Float[np.ndarray, " n"]:
        """The hidden return of each trajectory."""
        return np.array([trajectory.total_reward for trajectory in trajectories])
