"""What the default preset depends on in a task: its spaces, its horizon, and what random actions do there."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box, Discrete
from jaxtyping import Float

from bayespbrl.envs.stepping import random_episodes, step_limit

# Trajectories of an iteration where actions are continuous, and where they are discrete; steps that the first ones
# should have in all, and where states are discrete; and the most trajectories that an iteration may take for them.
TRAJECTORIES, OF_DISCRETE_ACTIONS = 10, 20
LEAST_STEPS, LEAST_OF_DISCRETE_STATES, MOST_TRAJECTORIES = 400, 800, 100
# Random actions end no episode if these take at least such a share of the horizon; and how many of them an episode has
# at least, however long they are repeated.
NEARLY_ALL, LEAST_DRAWS = 0.9, 10


@dataclass(frozen=True)
class Task:
    """The properties of a task that the default preset depends on.

    Attributes:
      observation_space, action_space: of the environment.
      horizon: its time limit, in steps.
      random_episodes: the states of a few episodes of random actions, by the steps after which one is cut and the
        steps for which an action is repeated; None: not measured.
    """

    observation_space: Space[Any]
    action_space: Space[Any]
    horizon: int
    random_episodes: Callable[[int, int], list[Float[np.ndarray, "t d"]]] | None = None

    @classmethod
    def of(cls, environment: gymnasium.Env, max_steps: int | None = None) -> "Task":
        """The properties of an environment; `ValueError` where no time limit is known."""
        horizon = step_limit(environment, max_steps)
        measured = partial(random_episodes, environment, time_limit=max_steps)
        return cls(environment.observation_space, environment.action_space, horizon, measured)

    def derived(self, *, people: bool) -> dict[str, Any]:
        """Options by spaces and horizon, and by whether people answer (they wait).

        Decision: Q looks a quarter of the horizon ahead; the noise of continuous actions is held for a fortieth of an
        episode (long for MountainCarContinuous; short for InvertedPendulum, which falls at once); in few dimensions
        functions are as fine as half the median rule, which learns Pendulum in half the iterations. Discrete actions
        have features of their own each, so there are fewer centres and more trajectories (CartPole); whether such a
        policy fails in an episode is a matter of luck, so more of them check it. A policy of discrete states, a table,
        is not stuck, and is not started anew; its Q is a table too, and forgets nothing by old transitions. Its
        goals may be rare: one that few trajectories reach counts as much, and ties tell of it. Without its noise it may
        stay somewhere for good, which trajectories with it do not show. Continuous actions may cost something by
        themselves, and with them a policy that hardly acts may seem good, which duels of policies without noise rule
        out; people see states rather than actions, and would wait for the last duels.
        """
        continuous = isinstance(self.action_space, Box)
        dimensions = self.observation_space.shape[0] if isinstance(self.observation_space, Box) else 0
        of_a_table = {"restart_iterations": 0, "critic_iterations": None, "noise_free": True}
        of_rare_goals = {"standardised_utility": True, "informative_ties": True}
        of_effort = {"effort_utility": True, "noise_free": True, "against_kept": True}
        special = {} if dimensions else of_a_table | of_rare_goals
        if continuous and not people:
            special = special | of_effort
        return special | {
            "discount": min(max(1 - 4 / self.horizon, 0.98), 0.995),
            "exploration_hold": None if continuous else 1,
            "trajectories_per_iteration": TRAJECTORIES if continuous else OF_DISCRETE_ACTIONS,
            "check_episodes": (8 if people else 32) if continuous else (40 if people else 100),
            "centres": 300 if continuous else 100,
            "bandwidth_factor": 0.5 if dimensions <= 3 else 1.0 if dimensions <= 4 else 2.0,
        }

    def more_trajectories(self) -> dict[str, Any]:
        """More trajectories an iteration where the first episodes end at once, if actions are continuous or states not.

        Decision: as many as have `LEAST_STEPS` steps, but at most `MOST_TRAJECTORIES`; from ten of four steps each
        nothing is learned about InvertedPendulum. With a limit of 40 steps the usual number stays. Where states are
        discrete, as have `LEAST_OF_DISCRETE_STATES`, whatever the limit: goals may be rare (FrozenLake-v1).
        """
        continuous, table = isinstance(self.action_space, Box), isinstance(self.observation_space, Discrete)
        least = LEAST_STEPS if continuous else LEAST_OF_DISCRETE_STATES
        # steps of an episode: of longer ones the usual number suffices
        enough = least // (TRAJECTORIES if continuous else OF_DISCRETE_ACTIONS)
        if self.random_episodes is None or not (continuous or table) or (continuous and self.horizon <= enough):
            return {}
        wanted = math.ceil(least / _mean_steps(self.random_episodes(min(enough, self.horizon), 1)))
        return {"trajectories_per_iteration": min(wanted, MOST_TRAJECTORIES)}

    def longer_hold(self) -> dict[str, Any]:
        """Random discrete actions that are repeated, where single ones lead nowhere: none of them ends an episode.

        Decision: for 1, 2, 4, … steps, whichever spreads the states most: the mean over dimensions of their standard
        deviation, as a share of the largest. Acrobot-v1 and MountainCar-v0 reach their goals so, and hardly ever by
        single actions; where episodes end early, as CartPole's, staying is what has to be learned.
        """
        observed = self.observation_space
        if self.random_episodes is None or isinstance(self.action_space, Box) or not isinstance(observed, Box):
            return {}
        episodes = self.random_episodes(self.horizon, 1)
        if _mean_steps(episodes) < NEARLY_ALL * self.horizon:
            return {}
        holds = [2**power for power in range(1, 16) if 2**power * LEAST_DRAWS <= self.horizon]
        spreads = [_spread(episodes)] + [_spread(self.random_episodes(self.horizon, hold)) for hold in holds]
        shares = np.array(spreads) / np.maximum(np.max(spreads, axis=0), np.finfo(float).tiny)
        return {"exploration_hold": [1, *holds][int(np.argmax(shares.mean(axis=1)))]}


def _mean_steps(episodes: list[Float[np.ndarray, "t d"]]) -> float:
    return float(np.mean([len(states) - 1 for states in episodes]))


def _spread(episodes: list[Float[np.ndarray, "t d"]]) -> Float[np.ndarray, " d"]:
    return np.concatenate(episodes).std(axis=0)
