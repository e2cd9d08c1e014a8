"""What the default preset depends on in a task: its spaces, its horizon, and what random actions do there."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gymnasium import Space
from gymnasium.spaces import Box

# Trajectories of an iteration where actions are continuous; steps that the first ones should have in all, and the most
# trajectories that an iteration may take for them.
TRAJECTORIES, LEAST_STEPS, MOST_TRAJECTORIES = 10, 400, 100


@dataclass(frozen=True)
class Task:
    """The properties of a task that the default preset depends on.

    Attributes:
      observation_space, action_space: of the environment.
      horizon: its time limit, in steps.
      steps_at_first: how many steps an episode of random actions takes, cut after the given number; None: not measured.
    """

    observation_space: Space[Any]
    action_space: Space[Any]
    horizon: int
    steps_at_first: Callable[[int], float] | None = None

    def derived(self, *, people: bool) -> dict[str, Any]:
        """Options by spaces and horizon, and by whether people answer (they wait).

        Decision: Q looks a quarter of the horizon ahead; the noise of continuous actions is held for a fortieth of an
        episode (long for MountainCarContinuous; short for InvertedPendulum, which falls at once); in few dimensions
        functions are as fine as half the median rule, which learns Pendulum in half the iterations. Discrete actions
        have features of their own each, so there are fewer centres and more trajectories (CartPole); whether such a
        policy fails in an episode is a matter of luck, so more of them check it. A policy of discrete states, a table,
        is not stuck, and is not started anew.
        """
        continuous = isinstance(self.action_space, Box)
        dimensions = self.observation_space.shape[0] if isinstance(self.observation_space, Box) else 0
        return ({} if dimensions else {"restart_iterations": 0}) | {
            "discount": min(max(1 - 4 / self.horizon, 0.98), 0.995),
            "exploration_hold": None if continuous else 1,
            "trajectories_per_iteration": TRAJECTORIES if continuous else 20,
            "check_episodes": (8 if people else 32) if continuous else (40 if people else 100),
            "centres": 300 if continuous else 100,
            "bandwidth_factor": 0.5 if dimensions <= 3 else 1.0 if dimensions <= 4 else 2.0,
        }

    def more_trajectories(self) -> dict[str, Any]:
        """More trajectories an iteration where the first episodes of a task with continuous actions end at once.

        Decision: as many as have `LEAST_STEPS` steps, but at most `MOST_TRAJECTORIES`; from ten of four steps each
        nothing is learned about InvertedPendulum.
        """
        enough = LEAST_STEPS // TRAJECTORIES  # steps of an episode: of longer ones the usual number suffices
        if self.steps_at_first is None or not isinstance(self.action_space, Box) or self.horizon <= enough:
            return {}
        wanted = math.ceil(LEAST_STEPS / self.steps_at_first(enough))
        return {"trajectories_per_iteration": min(wanted, MOST_TRAJECTORIES)}
