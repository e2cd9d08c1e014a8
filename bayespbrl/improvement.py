"""Step 2: from a utility to a better policy: LSTD-Q, actor-critic REPS, policy fit (paper, "Step 2")."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from operator import add
from typing import Any

import jax
import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box

from bayespbrl.lstd import TransitionSums, solve_lstd, transition_sums
from bayespbrl.policies import entropies, sample_actions
from bayespbrl.reps import RepsSolution, WhitenedFeatures, advantages, reps_weights, reps_weights_by_state, whitened
from bayespbrl.trajectories import Transitions

ROWS_AT_A_TIME = 16_384
NEARLY = 0.8  # of the bound; a further update would take most policies beyond it


@dataclass(frozen=True)
class QFunction:
    """Q(s, a) = [φ(s, a), 1]ᵀθ.

    Attributes:
      features: φ(s, a), from N states and N actions to (N, Q).
      weights: θ, shape (Q + 1,), or (Q + 1, n) for n utilities side by side; the last row is the bias.
    """

    features: Callable[[np.ndarray, np.ndarray], np.ndarray]
    weights: np.ndarray

    def __call__(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Q of N pairs, shape (N,), or (N, n)."""
        return self.features(states, actions) @ self.weights[:-1] + self.weights[-1]


@dataclass(frozen=True)
class Improvement:
    """A better policy and what really happened on the way to it.

    Attributes:
      policy: the new policy.
      q_function: the estimate of Q that the last update follows, under the policy before it.
      reps: of the last update: sample weights, temperature, KL reached against its bound, feature gaps, rank kept,
        effective samples.
      updates: how many there were.
      kl_fitted_policy: mean KL of the new policy from the one given over the states of the updates, nats.
      entropy: mean entropy of the fitted policy over the same states, nats.
      action_standard_deviation: mean of the fitted policy's over the same states, one number an action dimension, in
        the action's units; None for discrete actions.
    """

    policy: Any
    q_function: QFunction
    reps: RepsSolution
    updates: int
    kl_fitted_policy: float
    entropy: float
    action_standard_deviation: tuple[float, ...] | None


@dataclass(frozen=True, eq=False)
class ProposedUpdate:
    """What an update of any size would do, before one is decided on.

    Attributes:
      q_values: Qᵢ of the samples of the update, shape (N,).
      state_features: φ(sᵢ) of the constraint on the state distribution, shape (N, D), or the number of each sample's
        state, shape (N,) int, where the constraint is to hold for every single state.
      base_weights: Wᵢ, shape (N,).
      q_draws: Qᵢ under each of S posterior draws of the utility, shape (N, S); None without a posterior.
    """

    q_values: np.ndarray
    state_features: np.ndarray
    base_weights: np.ndarray
    q_draws: np.ndarray | None = None
    solved: dict[float, RepsSolution] = field(default_factory=dict, repr=False)

    @cached_property
    def constraint(self) -> WhitenedFeatures | np.ndarray:
        """The features whitened, which every bound shares; or the states' numbers."""
        if self.state_features.ndim == 1:
            return self.state_features
        return whitened(self.state_features, self.base_weights)

    def solve(self, kl_bound: float) -> RepsSolution:
        """REPS for the mean Q at this bound (eqs. 11-13); each bound is solved once."""
        if kl_bound not in self.solved:
            problem = (self.q_values, self.state_features, self.base_weights)
            self.solved[kl_bound] = (
                reps_weights(*problem, kl_bound=kl_bound, constraint=self.constraint)
                if isinstance(self.constraint, WhitenedFeatures)
                else reps_weights_by_state(*problem, kl_bound=kl_bound)
            )
        return self.solved[kl_bound]

    def gains(self, kl_bound: float | None = None) -> np.ndarray:
        """Σ (pᵢ − Wᵢ)Qᵢ under each draw: what it expects of the update at this bound, in its utility's units; (S,).

        Without a bound, of the smallest updates, up to a factor that all draws share: Σ WᵢAᵢQᵢ with the `advantages` A
        of the mean Q. That takes no solution of REPS.
        """
        if self.q_draws is None:
            raise ValueError("gains: expected a utility estimate with a posterior, got one without")
        if kl_bound is None:
            return (self.base_weights * advantages(self.q_values, self.constraint, self.base_weights)) @ self.q_draws
        return (self.solve(kl_bound).probabilities - self.base_weights) @ self.q_draws

    def agreement(self, kl_bound: float | None = None) -> float:
        """Share of the draws that expect a gain."""
        return float(np.mean(self.gains(kl_bound) > 0))


def improve(
    policy: Any,
    steps: Transitions,
    utilities: np.ndarray,
    *,
    key: jax.Array,
    rng: np.random.Generator,
    action_space: Space,
    state_features: Callable[[np.ndarray], np.ndarray],
    state_action_features: Callable[[np.ndarray, np.ndarray], np.ndarray],
    kl_bound: float | Callable[[ProposedUpdate], float],
    discount: float,
    fixed_point_ridge: float,
    projection_ridge: float,
    updates: int = 1,
    visited: np.ndarray | None = None,
    utility_draws: np.ndarray | None = None,
) -> Improvement:
    """A better policy by actor-critic REPS from all observed transitions.

    Args:
      policy: the current policy.
      steps: N transitions observed so far, under whatever policies.
      utilities: uᵢ of each, shape (N,).
      key, rng: for the fresh actions and for the policy fit.
      state_features: φ(s) of the constraint on the state distribution (eq. 11); not needed for discrete actions in
        continuous states.
      state_action_features: φ(s, a) of Q.
      kl_bound: ε, nats; or what decides on it, once it has seen what updates would do.
      discount, fixed_point_ridge, projection_ridge: of LSTD.
      updates: at most so many with the same bound, each with the Q of the policy that the one before it left. There is
        another while the policy has moved by less than `NEARLY` of the bound: a policy that smooths over its samples
        follows their weights a part of the way only. All but the first hold a continuous policy's spread. 1 is the
        paper's.
      visited: states of the policy update, shape (n, S) or (n,); those of all transitions when None. LSTD always has
        all transitions.
      utility_draws: the utilities under each of S posterior draws, shape (N, S): LSTD is linear in them, so that they
        cost no more solutions. None: only the utilities count.

    Raises:
      ValueError: utilities that do not fit the transitions or are not finite.

    Source: paper, step 2, eqs. 11-14.
    """
    if utilities.shape != (len(steps),) or not np.all(np.isfinite(utilities)):
        raise ValueError(f"utilities: expected {len(steps)} finite numbers, got shape {utilities.shape} or NaN")
    states, visits = _visited(steps.states if visited is None else visited)
    # the draws are there for whoever decides on the bound, which is decided once
    columns = utilities if utility_draws is None else np.column_stack([utilities, utility_draws])
    improved, bound = policy, kl_bound
    for number in range(updates):
        next_key, fresh_key = jax.random.split(jax.random.fold_in(key, number) if number else key)
        q_functions = estimate_q(
            improved,
            steps,
            columns,
            key=next_key,
            action_space=action_space,
            features=state_action_features,
            discount=discount,
            fixed_point_ridge=fixed_point_ridge,
            projection_ridge=projection_ridge,
        )
        proposed, samples = _proposed(improved, q_functions, states, visits, fresh_key, action_space, state_features)
        bound = bound(proposed) if callable(bound) else bound
        reps = proposed.solve(bound)
        # Decision: further updates hold the policy's spread. Fitted anew each time it would narrow before the utility
        # is known well enough (RESULTS.md, "More updates an iteration").
        fit = getattr(improved, "fit_mean", improved.fit) if number else improved.fit
        improved = fit(*samples, reps.sample_weights, rng=rng, base_weights=proposed.base_weights)
        moved = float(visits @ improved.kl_divergence(policy, states))
        columns = utilities
        if moved >= NEARLY * bound:
            break
    return Improvement(
        policy=improved,
        q_function=replace(q_functions, weights=q_functions.weights.reshape(len(q_functions.weights), -1)[:, 0]),
        reps=reps,
        updates=number + 1,
        kl_fitted_policy=moved,
        entropy=float(visits @ entropies(improved, states)),
        action_standard_deviation=None
        if is_discrete(improved)
        else tuple((visits @ improved.action_standard_deviation(states)).tolist()),
    )


def _proposed(
    policy: Any,
    q_functions: QFunction,
    states: np.ndarray,
    visits: np.ndarray,
    key: jax.Array,
    action_space: Space,
    state_features: Callable[[np.ndarray], np.ndarray],
) -> tuple[ProposedUpdate, tuple[np.ndarray, np.ndarray]]:
    """What an update would do, and the states and actions of its samples."""
    if is_discrete(policy):
        rows, actions, base_weights = _all_actions(policy, states, visits)
    else:
        rows, base_weights = np.arange(len(states)), visits
        actions = sample_actions(policy, key, states)
    # Q is of the action that the environment would see; the fit is of the action that the policy drew, because
    # fitting clipped ones would shrink the policy at every update
    q_values = q_functions(states[rows], clipped(actions, action_space)).reshape(len(rows), -1)
    # Decision: where the actions of continuous states can be enumerated, the state distribution is kept at every single
    # state, and not in φ only. Radial basis functions let the weights move between states, which no policy can follow:
    # on CartPole-v1 half of a bound of 0.3 went there, and the fitted policy moved by 0.01 to 0.09.
    each_state = is_discrete(policy) and states.ndim > 1
    update = ProposedUpdate(
        q_values[:, 0],
        rows if each_state else state_features(states)[rows],
        base_weights,
        q_values[:, 1:] if q_values.shape[1] > 1 else None,
    )
    return update, (states[rows], actions)


def is_discrete(policy: Any) -> bool:
    """Whether a policy's actions can be enumerated."""
    return hasattr(policy, "probabilities")


def clipped(actions: np.ndarray, action_space: Space) -> np.ndarray:
    """Continuous actions as the environment will see them; discrete ones as they are."""
    return np.clip(actions, action_space.low, action_space.high) if isinstance(action_space, Box) else actions


def _visited(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The states of the update and the share of visits of each: discrete ones are counted, not repeated."""
    if states.ndim > 1:
        return states, np.full(len(states), 1 / len(states))
    unique, counts = np.unique(states, return_counts=True)
    return unique, counts / len(states)


def _all_actions(policy: Any, states: np.ndarray, visits: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every action of every visited state, weighted by q(a|s) × visits; actions that q excludes are left out."""
    weights = policy.probabilities(states) * visits[:, None]
    rows, actions = np.nonzero(weights)
    base_weights = weights[rows, actions]
    return rows, actions, base_weights / np.sum(base_weights)


def estimate_q(
    policy: Any,
    steps: Transitions,
    utilities: np.ndarray,
    *,
    key: jax.Array,
    action_space: Space,
    features: Callable[[np.ndarray, np.ndarray], np.ndarray],
    discount: float,
    fixed_point_ridge: float,
    projection_ridge: float,
) -> QFunction:
    """LSTD-Q with a bias column, from every observed transition.

    Args:
      policy: whose Q.
      steps: N transitions, under whatever policies.
      utilities: uᵢ of each, shape (N,), or n of them side by side, (N, n).
      key: for the fresh action in each next state, where actions cannot be enumerated.
      action_space: bounds the fresh actions.
      features: φ(s, a).
      discount, fixed_point_ridge, projection_ridge: of LSTD.
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
    weights = solve_lstd(
        reduce(add, map(sums, blocks)),
        discount=discount,
        fixed_point_ridge=fixed_point_ridge,
        projection_ridge=projection_ridge,
    )
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
    unique = Transitions(
        steps.states[first], steps.actions[first], steps.next_states[first], steps.rewards[first], steps.terminal[first]
    )
    return unique, means, counts.astype(float)


def _expected_features(
    policy: Any, states: np.ndarray, features: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> np.ndarray:
    """Σₐ π(a|s)φ(s, a). Decision: where actions can be enumerated, their expectation replaces one fresh sample."""
    probabilities = policy.probabilities(states)
    total = probabilities[:, :1] * features(states, np.zeros(len(states), dtype=np.int64))
    for action in range(1, probabilities.shape[1]):
        total += probabilities[:, action, None] * features(states, np.full(len(states), action))
    return total


def _with_bias(features: np.ndarray) -> np.ndarray:
    return np.column_stack([features, np.ones(len(features))])
