"""A policy acting in an environment: one observation in, one action out."""

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box
from jaxtyping import Array, Key

from bayespbrl import checks
from bayespbrl.envs.spaces import from_plain, given_to_plain, plain_space, unbatched
from bayespbrl.policies.batch import sample_actions
from bayespbrl.policies.greedy import Greedy, greedy
from bayespbrl.policies.policy import Sampler, is_discrete


@dataclass(frozen=True)
class Actor:
    """A policy in an environment.

    Attributes:
      policy: π(a|s), of plain observations and actions (`plain_space`).
      observation_space, action_space: of the environment.
      rng: where a call without a key draws from.
    """

    policy: Sampler
    observation_space: Space[Any]
    action_space: Space[Any]
    rng: np.random.Generator

    def act(self, observation: Any, *, key: Key[Array, ""] | None = None) -> Any:
        """An action a ~ π(·|observation), clipped to the action space; an int where actions are discrete.

        Raises:
          ValueError: an observation of another shape.
        """
        expected = self.observation_space.shape
        if expected is not None and (shape := np.asarray(observation).shape) != expected:
            raise ValueError(f"observation: expected shape {expected}, got {shape}")
        return self._drawn(self.policy, [observation], key)[0]

    __call__ = act

    def predict(
        self, observation: Any, state: object = None, episode_start: object = None, deterministic: bool = False
    ) -> tuple[Any, object]:
        """Action and `state`, for one observation or a batch of them, as stable-baselines3's policies give.

        Args:
          observation: of the environment, or a batch with a leading axis, which each part has where there are several.
          state, episode_start: of recurrent policies; passed through and not looked at.
          deterministic: the mean of continuous actions, or the most probable discrete one, instead of a sample.

        Raises:
          ValueError: observations of another shape; a policy of the user's that has neither `mode` nor `probabilities`.
        """
        shape = self.observation_space.shape
        if shape is None:
            batch = unbatched(self.observation_space, observation)
        elif (observed := np.asarray(observation)).shape == shape:
            batch = None
        elif observed.shape[1:] == shape:
            batch = list(observed)
        else:
            raise ValueError(f"observation: expected shape {shape}, or a batch of them, got {observed.shape}")
        if batch is None:
            return self._chosen([observation], deterministic)[0], state
        return np.array([np.asarray(action) for action in self._chosen(batch, deterministic)]), state

    def _chosen(self, observations: Any, deterministic: bool) -> list[Any]:
        """An action for each of several observations."""
        policy = greedy(self.policy) if deterministic else self.policy
        if not deterministic or isinstance(policy, Greedy):
            return self._drawn(policy, observations)
        if not is_discrete(policy):
            raise ValueError(
                f"deterministic: expected a policy with a method mode or probabilities, got {type(policy).__name__}"
            )
        best = np.argmax(policy.probabilities(self._rows(observations)), axis=1)
        return [int(from_plain(self.action_space, int(action))) for action in best]

    def _rows(self, observations: Any) -> np.ndarray:
        rows = np.array([given_to_plain(self.observation_space, each, self.action_space) for each in observations])
        checks.finite("observation", rows)
        return rows.astype(np.int64 if rows.ndim == 1 else np.float64)

    def _drawn(self, policy: Sampler, observations: Any, key: Key[Array, ""] | None = None) -> list[Any]:
        if key is None:
            key = jax.random.key(int(self.rng.integers(2**31)))
        actions, space = sample_actions(policy, key, self._rows(observations)), plain_space(self.action_space)
        if not isinstance(space, Box):
            return [int(from_plain(self.action_space, action)) for action in actions]
        clipped = [np.clip(action, space.low, space.high).astype(space.dtype) for action in actions]
        return [from_plain(self.action_space, action) for action in clipped]
