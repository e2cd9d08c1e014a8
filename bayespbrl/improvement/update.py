"""Step 2, the actor: propose an update of the policy by actor-critic REPS, then apply it within a KL bound.

`propose` estimates Q and says what an update of any size would do. A schedule decides on the bound
(`bayespbrl.improvement.schedules`). `apply_update` solves REPS at that bound and fits the policy (paper, eqs. 11-14).
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, cast

import jax
import numpy as np
from jax import Array
from jaxtyping import Float, Int, Key, Shaped

from bayespbrl import checks
from bayespbrl.improvement.problem import UpdateProblem
from bayespbrl.improvement.q_function import CriticData, QFunction, estimate_q
from bayespbrl.improvement.reps import RepsSolution, advantages, reps_weights, reps_weights_by_state
from bayespbrl.improvement.whitening import WhitenedFeatures, whitened
from bayespbrl.policies import Policy, clipped, entropies, is_discrete, sample_actions
from bayespbrl.policies.policy import ContinuousPolicy, DiscretePolicy, fit_converged

NEARLY = 0.8  # of the bound; a further update would take most policies beyond it
NOTHING = 1e-3  # of the bound, or of a nat where it is larger; weights that have moved by less have nothing to gain
LEAST_MOVE = 1e-6  # nats, below any bound of a schedule of ours; a fit to samples alone moves a policy by far more
MOST_CONSTRAINED = 0.25  # features of the constraint on the state distribution, of the samples


@dataclass(frozen=True, eq=False)
class ProposedUpdate:
    """An update before its size is decided on.

    Attributes:
      policy: the current one.
      problem: what all updates of the iteration share.
      q_functions: Q under the current policy; of the mean utility, then of each draw.
      samples: states and actions of the N samples of the update.
      q_values: Qᵢ of the samples, shape (N,).
      state_features: φ(sᵢ) of the constraint on the state distribution, shape (N, D), or the number of each sample's
        state, shape (N,) int, where the constraint holds for every single state.
      base_weights: Wᵢ, shape (N,).
      q_draws: Qᵢ under each of S posterior draws of the utility, shape (N, S); None without a posterior.
      q_halves: Qᵢ by either half of the data, for each of m divisions into halves; None where it was not asked for.
      solved: the solutions so far, by their bounds.
    """

    policy: Policy
    problem: UpdateProblem
    q_functions: QFunction
    samples: tuple[Shaped[np.ndarray, "n ..."], Shaped[np.ndarray, "n ..."]]
    q_values: Float[np.ndarray, " n"]
    state_features: Float[np.ndarray, "n d"] | Int[np.ndarray, " n"]
    base_weights: Float[np.ndarray, " n"]
    q_draws: Float[np.ndarray, "n s"] | None = None
    q_halves: Float[np.ndarray, "n 2 m"] | None = None
    solved: dict[float, RepsSolution] = field(default_factory=dict, repr=False)

    @cached_property
    def constraint(self) -> WhitenedFeatures | Int[np.ndarray, " n"]:
        """The whitened features, which every bound shares; or the states' numbers.

        Decision: sampled actions differ between samples only as their states do. As many constraints as samples would
        leave no weights but the present ones, so there are at most `MOST_CONSTRAINED` as many.
        """
        if self.state_features.ndim == 1:
            return self.state_features
        most = None if is_discrete(self.policy) else max(1, int(MOST_CONSTRAINED * len(self.base_weights)))
        return whitened(self.state_features, self.base_weights, most=most)

    def solve(self, kl_bound: float) -> RepsSolution:
        """REPS for the mean Q at this bound (eqs. 11-13); each bound is solved once."""
        if kl_bound not in self.solved:
            data = (self.q_values, self.state_features, self.base_weights)
            self.solved[kl_bound] = (
                reps_weights(*data, kl_bound=kl_bound, constraint=self.constraint)
                if isinstance(self.constraint, WhitenedFeatures)
                else reps_weights_by_state(*data, kl_bound=kl_bound)
            )
        return self.solved[kl_bound]

    def gains(self, kl_bound: float | None = None) -> Float[np.ndarray, " s"]:
        """Σ (pᵢ − Wᵢ)Qᵢ under each draw: the gain that it expects of the update at this bound, in its utility's units.

        Without a bound: of the smallest updates, up to a factor that all draws share, Σ WᵢAᵢQᵢ with the `advantages` A
        of the mean Q. That takes no solution of REPS.
        """
        if self.q_draws is None:
            raise ValueError("gains: expected Q under posterior draws, got none: this utility has no posterior")
        if kl_bound is None:
            promised = advantages(self.q_values, self.constraint, self.base_weights)  # eq. 12 at small bounds
            return np.asarray((self.base_weights * promised) @ self.q_draws)
        # the objective of eq. 11, less its value without an update
        return np.asarray((self.solve(kl_bound).probabilities - self.base_weights) @ self.q_draws)

    @cached_property
    def reliability(self) -> float:
        """Share of the variance of the advantages that is not sampling error of Q; 1 without halves.

        Source: Spearman (1910) and Brown (1910): 2r/(1 + r), with r the correlation of the advantages by the Q of two
        halves of the data, in the mean over the divisions into halves.
        """
        if self.q_halves is None:
            return 1.0
        correlations = []
        for division in self.q_halves.T:  # (2, N)
            first, second = (advantages(q, self.constraint, self.base_weights) for q in division)
            product = (self.base_weights @ first**2) * (self.base_weights @ second**2)
            correlations.append(self.base_weights @ (first * second) / np.sqrt(product) if product > 0 else 0.0)
        correlation = min(max(float(np.mean(correlations)), 0.0), 1.0)  # rounding may take it above 1
        return 2 * correlation / (1 + correlation)  # Spearman (1910), Brown (1910)

    def agreement(self, kl_bound: float | None = None) -> float:
        """Share of the draws that expect a gain."""
        return float(np.mean(self.gains(kl_bound) > 0))


@dataclass(frozen=True)
class Improvement:
    """A better policy and what the update did.

    Attributes:
      policy: the new policy.
      q_function: Q that the last update follows, under the policy before it.
      reps: of the last update: sample weights, temperature, KL and its bound, feature gaps, rank, effective samples.
        Where there was none, of the one that was proposed.
      updates: how many there were; 0 where REPS had nothing to gain, or failed.
      kl_fitted_policy: mean KL of the new policy from the old one over the states of the updates, nats.
      entropy: mean entropy of the new policy over the same states, nats.
      action_standard_deviation: mean of the new policy's over the same states, one number per action dimension, in the
        action's units; None for discrete actions.
    """

    policy: Policy
    q_function: QFunction
    reps: RepsSolution
    updates: int
    kl_fitted_policy: float
    entropy: float
    action_standard_deviation: tuple[float, ...] | None

    def summary(self) -> dict[str, Any]:
        """The figures as an iteration reports them; `policy_fit_converged` is of policies that know it."""
        reps, fitted = self.reps, fit_converged(self.policy)
        return {
            "kl_bound": reps.kl_bound,
            "bound_active": reps.bound_active,
            "kl": reps.kl,
            "updates": self.updates,
            "kl_fitted_policy": self.kl_fitted_policy,
            "feature_gap": reps.feature_gap,
            "feature_gap_raw": reps.feature_gap_raw,
            "rank_kept": reps.rank_kept,
            "effective_samples": reps.effective_samples,
            "temperature": reps.temperature,
            "reps_converged": reps.converged,
            **({} if fitted is None else {"policy_fit_converged": fitted}),
            "entropy": self.entropy,
            "action_standard_deviation": self.action_standard_deviation,
        }


def propose(
    policy: Policy,
    problem: UpdateProblem,
    *,
    key: Key[Array, ""],
    utility_draws: Float[np.ndarray, "n s"] | None = None,
) -> ProposedUpdate:
    """Q under `policy`, and the samples whose weights an update would change.

    Args:
      policy: the current policy.
      problem: what all updates of the iteration share.
      key: of the fresh actions.
      utility_draws: the utilities of the N transitions under each of S posterior draws. LSTD is linear in them, so they
        cost no further solution. None: only the mean counts.

    Source: paper, step 2.
    """
    columns = problem.utilities if utility_draws is None else np.column_stack([problem.utilities, utility_draws])
    next_key, fresh_key = jax.random.split(key)
    q_functions = estimate_q(
        policy,
        CriticData(problem.steps, columns, problem.quarters),
        key=next_key,
        action_space=problem.action_space,
        features=problem.state_action_features,
        critic=problem.critic,
    )
    states, visits = problem.visited
    if is_discrete(policy):
        rows, actions, base_weights = _all_actions(policy, states, visits)
    else:
        rows, base_weights = np.arange(len(states)), visits
        actions = sample_actions(policy, fresh_key, states)
    # Q is of the action that the environment would see. The fit is of the action that the policy drew: fitting clipped
    # ones would shrink the policy at every update.
    q_values, q_halves = q_functions.with_halves(states[rows], clipped(actions, problem.action_space))
    q_values = q_values.reshape(len(rows), -1)
    # Decision: where the actions of continuous states can be enumerated, the constraint holds at every single state.
    # Radial basis functions would let the weights move between states, which no policy can follow.
    each_state = is_discrete(policy) and states.ndim > 1
    return ProposedUpdate(
        policy,
        problem,
        q_functions,
        (states[rows], actions),
        q_values[:, 0],
        rows if each_state else problem.constrained[rows],
        base_weights,
        q_values[:, 1:] if q_values.shape[1] > 1 else None,
        q_halves,
    )


def apply_update(
    proposed: ProposedUpdate, kl_bound: float, *, key: Key[Array, ""], rng: np.random.Generator, updates: int = 1
) -> Improvement:
    """The policy after the proposed update at this bound, and further ones while they have something to gain.

    Args:
      proposed: the first update.
      kl_bound: ε of each update, nats.
      key, rng: of the further updates' fresh actions and of the policy fits.
      updates: most of them. Another follows while the policy has moved by less than `NEARLY` of the bound and REPS
        finds a gain: a policy that smooths over its samples follows their weights only part of the way. All but the
        first hold the spread of a policy with `fit_mean`, which would otherwise narrow before the utility is known.
        Where REPS finds nothing or fails, the policy stays as it is: a fit to its own samples would narrow it.

    Source: paper, eqs. 11-14.
    """
    policy, (states, visits) = proposed.policy, proposed.problem.visited
    improved, number, moved, applied = policy, 0, 0.0, None
    while number < checks.whole("updates", updates):
        if number:
            proposed = propose(improved, proposed.problem, key=jax.random.fold_in(key, number))
        reps = proposed.solve(kl_bound)
        if reps.kl < max(NOTHING * min(kl_bound, 1.0), LEAST_MOVE) or not reps.converged:
            break
        fit = getattr(improved, "fit_mean" if number and hasattr(type(improved), "fit_mean") else "fit")
        improved = fit(*proposed.samples, reps.sample_weights, rng=rng, base_weights=proposed.base_weights)  # eq. 14
        moved = float(visits @ improved.kl_divergence(policy, states))
        number, applied = number + 1, (proposed, reps)
        if moved >= NEARLY * kl_bound:
            break
    proposed, reps = applied or (proposed, reps)
    weights = proposed.q_functions.weights
    return Improvement(
        policy=improved,
        q_function=replace(proposed.q_functions, weights=weights.reshape(len(weights), -1)[:, 0]),
        reps=reps,
        updates=number,
        kl_fitted_policy=moved,
        entropy=float(visits @ entropies(improved, states)),
        action_standard_deviation=None
        if is_discrete(improved)
        else tuple((visits @ cast(ContinuousPolicy, improved).action_standard_deviation(states)).tolist()),
    )


def _all_actions(
    policy: DiscretePolicy, states: Shaped[np.ndarray, "v ..."], visits: Float[np.ndarray, " v"]
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Every action of every visited state, weighted by q(a|s) × visits; actions that q excludes are left out."""
    weights = policy.probabilities(states) * visits[:, None]  # q(a|s) × visits (paper, step 2)
    rows, actions = np.nonzero(weights)
    base_weights = weights[rows, actions]
    return rows, actions, base_weights / np.sum(base_weights)
