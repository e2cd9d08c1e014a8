"""The inferred utility as the reward of an environment, for any library that learns from rewards."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from bayespbrl import checks
from bayespbrl.envs.spaces import spaces_of, to_plain
from bayespbrl.runs.run import Run

DRAWS = 200  # for the standard deviation: known to a twentieth


class UtilityReward(gymnasium.Wrapper):
    """`env` with the inferred utility of the next state, and of the action's effort if it counts, as its reward.

    `info` of each step has `true_reward`, the environment's own, and `utility_deviation`, the posterior standard
    deviation of the utility there. A policy that learns from this reward tells whether the utility or the policy of a
    run is at fault.

    Args:
      env: an environment with the run's spaces.
      run: a run with a utility estimate; `bayespbrl.load` reads one.
      caution: c of the reward mean − c · standard deviation; a negative one rewards what is unknown.

    Raises:
      ValueError: no environment or no run; a run without an estimate of the utility, as before its first answers or
        with the known reward; another observation or action space than the run's; caution without a posterior.
    """

    def __init__(self, env: gymnasium.Env, run: Run, *, caution: float = 0.0):
        if not isinstance(env, gymnasium.Env):
            raise ValueError(f"env: expected an environment, got {checks.one_line(env)!r}")
        super().__init__(env)
        if not isinstance(run, Run):
            raise ValueError(f"run: expected a run, as bayespbrl.load reads it, got {type(run).__name__}")
        estimate = run.estimate
        if estimate is None or estimate.features is None:
            kind = "none yet" if estimate is None else type(estimate).__name__
            raise ValueError(f"run: expected a run with an estimate of the utility of states, got {kind}")
        wanted = spaces_of(run.learner.given)
        for name, space in spaces_of(self).items():
            if space != wanted[name]:
                raise ValueError(f"{name}: expected {wanted[name]}, the run's, got {space}")
        self.caution = checks.number("caution", caution)
        if self.caution and estimate.posterior is None:
            raise ValueError(f"caution: expected 0 for an estimate without a posterior, got {self.caution:g}")
        # thinned once: where they are indexed the draws would be, at each step
        self.estimate, self._thinned = estimate, estimate.thinned(DRAWS)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """A step of the environment, with the utility as the reward."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        utility, deviation = self._utility(
            np.asarray(to_plain(self.env.observation_space, observation, self.env.action_space))[None], action
        )
        info = info | {"true_reward": float(reward), "utility_deviation": deviation}
        return observation, utility - self.caution * deviation, terminated, truncated, info

    def _utility(self, states: np.ndarray, action: Any) -> tuple[float, float]:
        states = states.astype(np.float64) if states.ndim > 1 else states  # as the learner saw them
        space, taken = self.env.action_space, None
        if isinstance(space, Box):
            taken = np.clip(np.asarray(action, dtype=np.float64), space.low, space.high).reshape(1, -1)
        if self._thinned.posterior is None:
            return float(self._thinned.utilities(states, actions=taken)[0]), 0.0
        mean, draws = self._thinned.utilities_and_draws(states, actions=taken)
        return float(mean[0]), float(draws[:, 0].std())
