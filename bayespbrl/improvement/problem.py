"""Step 2, the problem: how the policy is updated, and the data that the updates of an iteration share."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium import Space
from jaxtyping import Float, Int, Shaped

from bayespbrl import checks
from bayespbrl.features import OwnFeatures, StateActionFeatures, StateFeatures
from bayespbrl.improvement.q_function import Critic
from bayespbrl.policies.samples import location_and_deviation
from bayespbrl.trajectories import Trajectory, Transitions
from bayespbrl.utility.estimate import UtilityEstimate

# Bounds on the transitions of the last iterations that LSTD takes: about ten for each of its features, and no more than
# a person would wait for; but so many trajectories, however long: the last two of an iteration may be without noise,
# and tell nothing of other actions.
LEAST_TRANSITIONS, MOST_TRANSITIONS = 5_000, 10_000
LEAST_TRAJECTORIES = 6


@dataclass(frozen=True)
class PolicyUpdate:
    """How the policy is updated in each iteration.

    Attributes:
      kl_bound: ε of eq. 11, nats.
      schedule: what decides on the bound of each iteration, a name of `SCHEDULES` (`improvement.schedules`); `other` is
        a schedule of the user's. `Settings` checks it.
      updates_per_iteration: most updates of the policy from the same trajectories and utility, until it has moved by
        most of the bound. Each has the Q of the policy before it; all but the first hold a continuous policy's spread.
        The bound is that of each update: the last of several begins short of it and may go beyond, for Gaussians of one
        spread up to 3.6 times. The paper's is 1.
      recent_iterations: number of last iterations whose states the update takes; None for all.
      critic_iterations: number of last iterations whose transitions LSTD takes, but at least `LEAST_TRANSITIONS` and at
        most `MOST_TRANSITIONS`, or `LEAST_TRAJECTORIES` if they have more; None for all, as in the paper. Old ones say
        little about the current policy.
      checked: whether each update is checked by trajectories of the policy without its noise: the run keeps the policy
        that the posterior thinks best, without noise, and goes on from there after a step back. The paper's learner
        never looks back.
      check_episodes: number of these trajectories, of each policy.
      restart_iterations: number of iterations at the end of the run after the policy is restarted, because the first
        may be stuck where its own trajectories show nothing better; 0: no restart. Only where updates are checked and
        the number of iterations follows from the answers.
      update_states: maximum number of these states, drawn at random, where they are continuous: it bounds time and
        memory for long episodes.
    """

    kl_bound: float = 0.3
    schedule: str = "constant"
    updates_per_iteration: int = 1
    recent_iterations: int | None = None
    critic_iterations: int | None = None
    update_states: int = 20_000
    checked: bool = False
    check_episodes: int = 8
    restart_iterations: int = 0

    def __post_init__(self) -> None:
        checks.positive("kl_bound", self.kl_bound)
        checks.whole("updates_per_iteration", self.updates_per_iteration)
        for name in ("recent_iterations", "critic_iterations"):
            checks.optional(checks.whole, name, getattr(self, name))
        checks.whole("update_states", self.update_states)
        checks.boolean("checked", self.checked)
        checks.whole("check_episodes", self.check_episodes, 2)
        checks.whole("restart_iterations", self.restart_iterations, 0)


@dataclass(frozen=True, eq=False)
class UpdateProblem:
    """The data and options that all updates of one iteration share.

    Attributes:
      steps: N observed transitions, under whatever policies.
      utilities: uᵢ of each, shape (N,).
      states: those of the update.
      critic: LSTD's options.
      state_action_features: φ(s, a) of Q.
      state_features: φ(s) of the constraint on the state distribution (eq. 11); not needed for discrete actions in
        continuous states.
      action_space: bounds the actions.
      quarters: which quarter of the trajectories each transition is of; None where nobody asks for the reliability
        of Q.

    Raises:
      ValueError: utilities that do not fit the transitions or are not finite.
    """

    steps: Transitions
    utilities: Float[np.ndarray, "..."]
    states: Shaped[np.ndarray, "m ..."]
    critic: Critic
    state_action_features: StateActionFeatures
    state_features: StateFeatures
    action_space: Space[Any]
    quarters: Int[np.ndarray, " n"] | None = None

    def __post_init__(self) -> None:
        if self.utilities.shape != (len(self.steps),):
            raise ValueError(f"utilities: expected shape ({len(self.steps)},), got {self.utilities.shape}")
        checks.finite("utilities", self.utilities)

    @cached_property
    def visited(self) -> tuple[Shaped[np.ndarray, "v ..."], Float[np.ndarray, " v"]]:
        """The states and the share of visits of each: discrete ones are counted, not repeated."""
        if self.states.ndim > 1:
            return self.states, np.full(len(self.states), 1 / len(self.states))
        unique, counts = np.unique(self.states, return_counts=True)
        return unique, counts / len(self.states)

    @cached_property
    def constrained(self) -> Float[np.ndarray, "v d"]:
        """φ(s) of the `visited` states, evaluated once for all updates.

        Features of the user's own are divided by their standard deviations: the constraint leaves out what is small
        beside the largest.
        """
        states, shares = self.visited
        features = self.state_features(states)
        if not isinstance(self.state_features, OwnFeatures):
            return features
        deviation = location_and_deviation(features, shares)[1]
        return features / np.where(deviation > 0, deviation, 1.0)


def step_utilities(
    utility: UtilityEstimate, steps: Transitions, *, draws: int
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n s"] | None]:
    """uᵢ of each transition, and under S posterior draws: at most `draws`, None where there are none."""
    if not draws or utility.posterior is None:
        return utility.step_utilities(steps), None
    if steps.next_states.ndim == 1:  # discrete: each is evaluated once
        states, rows = np.unique(steps.next_states, return_inverse=True)
        utilities, drawn = utility.utilities_and_draws(states, number=draws)
        return utilities[rows], drawn[:, rows].T
    utilities, drawn = utility.utilities_and_draws(steps.next_states, number=draws, actions=steps.actions)
    return utilities, drawn.T


def recent(trajectories: Sequence[Trajectory], options: PolicyUpdate, *, an_iteration: int) -> Sequence[Trajectory]:
    """The trajectories whose transitions LSTD takes; arguments as in `states_of_update`."""
    if options.critic_iterations is None:
        return trajectories
    lengths = np.cumsum([len(trajectory) for trajectory in reversed(trajectories)])
    least = 1 + int(np.searchsorted(lengths, LEAST_TRANSITIONS))
    most = max(LEAST_TRAJECTORIES, int(np.searchsorted(lengths, MOST_TRANSITIONS, side="right")))
    return trajectories[-max(least, min(most, options.critic_iterations * an_iteration)) :]


def quarters(trajectories: Sequence[Trajectory]) -> Int[np.ndarray, " n"]:
    """The quarter of the trajectories, 0 to 3, that each transition is in; every fourth trajectory shares one."""
    return np.repeat(np.arange(len(trajectories)) % 4, [len(trajectory) for trajectory in trajectories])


def states_of_update(
    trajectories: Sequence[Trajectory], options: PolicyUpdate, *, an_iteration: int, rng: np.random.Generator
) -> Shaped[np.ndarray, "m ..."]:
    """The states that a policy update takes.

    Args:
      trajectories: all so far, the newest last.
      options: `recent_iterations` and `update_states`.
      an_iteration: trajectories in each iteration.
      rng: picks states where there are too many.
    """
    recent = 0 if options.recent_iterations is None else options.recent_iterations * an_iteration
    states = np.concatenate([trajectory.states[:-1] for trajectory in trajectories[-recent:]])
    if states.ndim == 1 or len(states) <= options.update_states:
        return states  # discrete ones are counted, not repeated
    return states[np.sort(rng.choice(len(states), options.update_states, replace=False))]
