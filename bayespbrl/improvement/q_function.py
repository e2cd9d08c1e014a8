"""Step 2, its critic: from the utilities of transitions to Q, by LSTD (paper, "Step 2")."""

from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Any

import jax
import numpy as np
from gymnasium import Space

from bayespbrl import checks
from bayespbrl.features import StateActionFeatures
from bayespbrl.improvement.lstd import TransitionSums, solve_lstd, transition_sums
from bayespbrl.policies import clipped, is_discrete, sample_actions
from bayespbrl.trajectories import Transitions

ROWS_AT_A_TIME = 16_384


@dataclass(frozen=True)
class Critic:
    """How Q is estimated.

    Attributes:
      discount: γ in [0, 1).
      fixed_point_ridge, projection_ridge: LSTD's penalties β₁, β₂ ≥ 0.
    """

    discount: float = 0.98
    fixed_point_ridge: float = 1e-8
    projection_ridge: float = 1e-8

    def __post_init__(self) -> None:
        checks.share("discount", self.discount, below_one=True)
        checks.non_negative("fixed_point_ridge", self.fixed_point_ridge)
        checks.non_negative("projection_ridge", self.projection_ridge)


@dataclass(frozen=True)
class QFunction:
    """Q(s, a) = [φ(s, a), 1]ᵀθ.

    Attributes:
      features: φ(s, a), from N states and N actions to (N, Q).
      weights: θ, shape (Q + 1,), or (Q + 1, n) for n utilities side by side; the last row is the bias.
    """

    features: StateActionFeatures
    weights: np.ndarray

    def __call__(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Q of N pairs, shape (N,), or (N, n)."""
        return np.asarray(self.features(states, actions) @ self.weights[:-1] + self.weights[-1])


def estimate_q(
    policy: Any,
    steps: Transitions,
    utilities: np.ndarray,
    *,
    key: jax.Array,
    action_space: Space[Any],
    features: StateActionFeatures,
    critic: Critic,
) -> QFunction:
    """LSTD-Q with a bias column, from every observed transition.

    Args:
      policy: whose Q.
      steps: N transitions, under whatever policies.
      utilities: uᵢ of each, shape (N,), or n of them side by side, (N, n).
      key: for the fresh action in each next state, where actions cannot be enumerated.
      action_space: bounds the fresh actions.
      features: φ(s, a).
      critic: LSTD's options.
    """
    steps, utilities, counts = _counted(steps, utilities)
    following = None if is_discrete(policy) else clipped(sample_actions(policy, key, steps.next_states), action_space)

    def sums(rows: slice) -> TransitionSums:
        current = _with_bias(features(steps.states[rows], steps.actions[rows]))
        if following is None:
            successor = _expected_features(policy, steps.next_states[rows], features)
        else:
            successor = features(steps.next_states[rows], following[rows])
        successor = _with_bias(successor)
        successor[steps.terminal[rows]] = 0.0
        repeats = np.sqrt(counts[rows])[:, None]  # a row times √n enters every Gram matrix as n rows
        return transition_sums(current * repeats, successor * repeats, (utilities[rows].T * repeats[:, 0]).T)

    # a block at a time: the features of all transitions would fill the memory of a long run
    blocks = [slice(start, start + ROWS_AT_A_TIME) for start in range(0, len(steps), ROWS_AT_A_TIME)]
    weights = solve_lstd(reduce(add, map(sums, blocks)), **vars(critic))
    return QFunction(features, weights)


def _counted(steps: Transitions, utilities: np.ndarray) -> tuple[Transitions, np.ndarray, np.ndarray]:
    """Discrete transitions once each, with the mean of their utilities and how often they occurred."""
    if steps.states.ndim > 1 or steps.actions.ndim > 1:
        return steps, utilities, np.ones(len(steps))
    table = np.column_stack([steps.states, steps.actions, steps.next_states, steps.terminal])
    _, first, inverse, counts = np.unique(table, axis=0, return_index=True, return_inverse=True, return_counts=True)
    columns = utilities.reshape(len(utilities), -1).T
    sums = [np.bincount(inverse.ravel(), weights=column) for column in columns]
    means = (np.stack(sums) / counts).T.reshape(-1, *utilities.shape[1:])
    return Transitions(*(column[first] for column in vars(steps).values())), means, counts.astype(float)


def _expected_features(policy: Any, states: np.ndarray, features: StateActionFeatures) -> np.ndarray:
    """Σₐ π(a|s)φ(s, a). Decision: where actions can be enumerated, their expectation replaces one fresh sample."""
    probabilities = policy.probabilities(states)
    total: np.ndarray = probabilities[:, :1] * features(states, np.zeros(len(states), dtype=np.int64))
    for action in range(1, probabilities.shape[1]):
        total += probabilities[:, action, None] * features(states, np.full(len(states), action))
    return total


def _with_bias(features: np.ndarray) -> np.ndarray:
    return np.column_stack([features, np.ones(len(features))])
