"""Step 2, its actor: from Q to a better policy by actor-critic REPS and the policy fit (paper, "Step 2")."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np
from gymnasium import Space

from bayespbrl.improvement.q_function import QFunction, estimate_q
from bayespbrl.improvement.reps import (
    RepsSolution,
    WhitenedFeatures,
    advantages,
    reps_weights,
    reps_weights_by_state,
    whitened,
)
from bayespbrl.policies import clipped, entropies, is_discrete, sample_actions
from bayespbrl.trajectories import Transitions

NEARLY = 0.8  # of the bound; a further update would take most policies beyond it
NOTHING = 1e-3  # of the bound; weights that have moved by less have nothing to gain


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
        another while the policy has moved by less than `NEARLY` of the bound and REPS finds something to gain: a policy
        that smooths over its samples follows their weights a part of the way only. All but the first hold the spread of
        a policy with `fit_mean`. 1 is the paper's.
      visited: states of the policy update, shape (n, S) or (n,); those of all transitions when None. LSTD always has
        all transitions.
      utility_draws: the utilities under each of S posterior draws, shape (N, S): LSTD is linear in them, so that they
        cost no more solutions. None: only the utilities count.

    Raises:
      ValueError: utilities that do not fit the transitions or are not finite; no update.

    Source: paper, step 2, eqs. 11-14.
    """
    if utilities.shape != (len(steps),) or not np.all(np.isfinite(utilities)):
        raise ValueError(f"utilities: expected {len(steps)} finite numbers, got shape {utilities.shape} or NaN")
    if updates < 1:
        raise ValueError(f"updates: expected at least 1, got {updates}")
    states, visits = _visited(steps.states if visited is None else visited)
    # Decision: where the actions of continuous states can be enumerated, the state distribution is kept at every single
    # state, and not in φ only. Radial basis functions let the weights move between states, which no policy can follow:
    # on CartPole-v1 half of a bound of 0.3 went there, and the fitted policy moved by 0.01 to 0.09.
    each_state = is_discrete(policy) and states.ndim > 1
    constrained = None if each_state else state_features(states)
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
        proposed, samples = _proposed(improved, q_functions, states, visits, fresh_key, action_space, constrained)
        bound = bound(proposed) if callable(bound) else bound
        reps = proposed.solve(bound)
        # Decision: further updates hold the policy's spread. Fitted anew each time it would narrow before the utility
        # is known well enough (RESULTS.md, "More updates an iteration").
        fit = improved.fit_mean if number and hasattr(type(improved), "fit_mean") else improved.fit
        improved = fit(*samples, reps.sample_weights, rng=rng, base_weights=proposed.base_weights)
        moved = float(visits @ improved.kl_divergence(policy, states))
        columns = utilities
        if moved >= NEARLY * bound or reps.kl < NOTHING * bound or not reps.converged:
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
    constrained: np.ndarray | None,
) -> tuple[ProposedUpdate, tuple[np.ndarray, np.ndarray]]:
    """What an update would do, and the states and actions of its samples; `constrained` is φ(s), or None."""
    if is_discrete(policy):
        rows, actions, base_weights = _all_actions(policy, states, visits)
    else:
        rows, base_weights = np.arange(len(states)), visits
        actions = sample_actions(policy, key, states)
    # Q is of the action that the environment would see; the fit is of the action that the policy drew, because
    # fitting clipped ones would shrink the policy at every update
    q_values = q_functions(states[rows], clipped(actions, action_space)).reshape(len(rows), -1)
    update = ProposedUpdate(
        q_values[:, 0],
        rows if constrained is None else constrained[rows],
        base_weights,
        q_values[:, 1:] if q_values.shape[1] > 1 else None,
    )
    return update, (states[rows], actions)


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
