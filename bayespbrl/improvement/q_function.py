"""Step 2, the critic: from the utilities of transitions to Q, by LSTD (paper, "Step 2")."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import chain, combinations
from operator import add
from typing import Any, TypeVar, cast

import numpy as np
from gymnasium import Space
from jax import Array
from jaxtyping import Float, Int, Key, Shaped

from bayespbrl import checks
from bayespbrl.features import StateActionFeatures
from bayespbrl.improvement.lstd import Targets, TransitionSums, solve_lstd, transition_sums
from bayespbrl.models.threads import in_threads
from bayespbrl.policies import Policy, clipped, is_discrete, sample_actions
from bayespbrl.policies.policy import DiscretePolicy
from bayespbrl.trajectories import DISCOUNT, Transitions

ROWS_AT_A_TIME = 16_384


@dataclass(frozen=True)
class Critic:
    """How Q is estimated.

    Attributes:
      discount: γ in [0, 1).
      fixed_point_ridge, projection_ridge: LSTD's penalties β₁, β₂ ≥ 0.
    """

    discount: float = DISCOUNT
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
      weights: θ, of one utility or of several side by side; the last row is the bias.
      halves: θ of the first utility from either half of the data alone, for each of m divisions into halves; None
        without quarters.
    """

    features: StateActionFeatures
    weights: Targets
    halves: Float[np.ndarray, "q 2 m"] | None = None

    def __call__(
        self, states: Shaped[np.ndarray, "n ..."], actions: Shaped[np.ndarray, "n ..."]
    ) -> Float[np.ndarray, "n *u"]:
        """Q of N pairs, by each utility."""
        return self.with_halves(states, actions)[0]

    def with_halves(
        self, states: Shaped[np.ndarray, "n ..."], actions: Shaped[np.ndarray, "n ..."]
    ) -> tuple[Float[np.ndarray, "n *u"], Float[np.ndarray, "n 2 m"] | None]:
        """Q of N pairs, and that of the halves."""
        values = np.empty((len(states), *self.weights.shape[1:]))
        halves = None if self.halves is None else np.empty((len(states), *self.halves.shape[1:]))
        for rows in _blocks(len(states)):
            table = _with_bias(self.features(states[rows], actions[rows]))
            values[rows] = table @ self.weights  # Q = φᵀθ (paper, step 2)
            if halves is not None:
                halves[rows] = np.tensordot(table, cast(np.ndarray, self.halves), axes=1)
        return values, halves


@dataclass(frozen=True, eq=False)
class CriticData:
    """The transitions and utilities that Q is estimated from.

    Attributes:
      steps: N transitions, under whatever policies.
      utilities: uᵢ of each, or several of them side by side.
      quarters: which quarter of the trajectories each transition is of, 0 to 3: Q is also estimated from
        half of the data, and what two halves disagree on is not told by the data; None: from all alone.
    """

    steps: Transitions
    utilities: Float[np.ndarray, "n *u"]
    quarters: Int[np.ndarray, " n"] | None = None


def estimate_q(
    policy: Policy,
    data: CriticData,
    *,
    key: Key[Array, ""],
    action_space: Space[Any],
    features: StateActionFeatures,
    critic: Critic,
) -> QFunction:
    """LSTD-Q (Lagoudakis & Parr 2003) with a bias column (paper, step 2), from every given transition.

    Args:
      policy: whose Q.
      data: transitions and their utilities.
      key: for the fresh action in each next state, where actions cannot be enumerated.
      action_space: bounds the fresh actions.
      features: φ(s, a).
      critic: LSTD's options.
    """
    steps = data.steps
    following = None if is_discrete(policy) else clipped(sample_actions(policy, key, steps.next_states), action_space)
    parts = np.zeros(len(steps), int) if data.quarters is None else data.quarters
    sums = [_sums(policy, data, following, features, np.flatnonzero(parts == part)) for part in np.unique(parts)]
    weights = solve_lstd(reduce(add, sums), **vars(critic))
    if len(sums) == 1:
        return QFunction(features, weights)
    first = [replace(part, target=part.target.reshape(len(part.target), -1)[:, 0]) for part in sums]
    them = [reduce(add, half) for half in chain.from_iterable(halvings(first))]
    halves = in_threads(lambda half: solve_lstd(half, **vars(critic)), them)
    return QFunction(features, weights, np.reshape(halves, (-1, 2, len(weights))).T)


Part = TypeVar("Part")


def halvings(parts: Sequence[Part]) -> list[tuple[list[Part], list[Part]]]:
    """All divisions of the parts into two halves: three of four parts, one of two or three, else none."""
    size = len(parts) // 2
    firsts = [each for each in combinations(range(len(parts)), size) if 0 in each] if size else []
    return [([parts[i] for i in each], [parts[i] for i in range(len(parts)) if i not in each]) for each in firsts]


def _sums(
    policy: Policy,
    data: CriticData,
    following: Shaped[np.ndarray, "n ..."] | None,
    features: StateActionFeatures,
    rows: Int[np.ndarray, " r"],
) -> TransitionSums:
    """LSTD's sums over some of the transitions."""
    chosen, utilities, counts = _counted(data.steps.at(rows), data.utilities[rows])
    following = None if following is None else following[rows]

    def sums(rows: slice) -> TransitionSums:
        current = _with_bias(features(chosen.states[rows], chosen.actions[rows]))
        if following is None:
            successor = _expected_features(cast(DiscretePolicy, policy), chosen.next_states[rows], features)
        else:
            successor = features(chosen.next_states[rows], following[rows])
        successor = _with_bias(successor)
        successor[chosen.terminal[rows]] = 0.0
        repeats = np.sqrt(counts[rows])[:, None]  # a row times √n enters every Gram matrix as n rows
        return transition_sums(current * repeats, successor * repeats, (utilities[rows].T * repeats[:, 0]).T)

    return reduce(add, map(sums, _blocks(len(chosen))))


def _blocks(rows: int) -> list[slice]:
    """Some rows at a time: the features of all of a long run, or of many states and actions, would fill the memory."""
    return [slice(start, start + ROWS_AT_A_TIME) for start in range(0, rows, ROWS_AT_A_TIME)]


def _counted(
    steps: Transitions, utilities: Float[np.ndarray, "n *u"]
) -> tuple[Transitions, Float[np.ndarray, "m *u"], Float[np.ndarray, " m"]]:
    """Discrete transitions once each, with the mean of their utilities and how often they occurred."""
    if steps.states.ndim > 1 or steps.actions.ndim > 1:
        return steps, utilities, np.ones(len(steps))
    table = np.column_stack([steps.states, steps.actions, steps.next_states, steps.terminal])
    _, first, inverse, counts = np.unique(table, axis=0, return_index=True, return_inverse=True, return_counts=True)
    columns = utilities.reshape(len(utilities), -1).T
    sums = [np.bincount(inverse.ravel(), weights=column) for column in columns]
    means = (np.stack(sums) / counts).T.reshape(-1, *utilities.shape[1:])
    return steps.at(first), means, counts.astype(float)


def _expected_features(
    policy: DiscretePolicy, states: Shaped[np.ndarray, "n ..."], features: StateActionFeatures
) -> Float[np.ndarray, "n d"]:
    """Σₐ π(a|s)φ(s, a). Decision: where actions can be enumerated, their expectation replaces one fresh sample."""
    probabilities = policy.probabilities(states)
    total: Float[np.ndarray, "n d"] = probabilities[:, :1] * features(states, np.zeros(len(states), dtype=np.int64))
    for action in range(1, probabilities.shape[1]):
        total += probabilities[:, action, None] * features(states, np.full(len(states), action))
    return total


def _with_bias(features: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d+1"]:
    return np.column_stack([features, np.ones(len(features))])  # bias term (paper, step 2)
