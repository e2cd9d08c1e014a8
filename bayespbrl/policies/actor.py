"""A policy put to work: one observation in, one action for the environment out."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box
from jaxtyping import Array, Key

from bayespbrl.policies.batch import sample_actions
from bayespbrl.policies.policy import Policy, is_discrete


@dataclass(frozen=True)
class Actor:
    """A stochastic policy and the action space whose bounds its actions keep.

    Attributes:
      policy: stochastic policy.
      action_space: of the policy's actions.
      rng: where a call without a key draws from.
      observe: from an observation of the environment to one of the policy's.
      enact: from an action of the policy's to one of the environment.
      observation_shape: of one observation of the environment.
    """

    policy: Policy
    action_space: Space[Any]
    rng: np.random.Generator
    observe: Callable[[Any], Any] = np.asarray
    enact: Callable[[Any], Any] = np.asarray
    observation_shape: tuple[int, ...] = ()

    def act(self, observation: Any, *, key: Key[Array, ""] | None = None) -> Any:
        """An action a ~ π(·|observation), clipped to the action space; an int where actions are discrete."""
        if key is None:
            key = jax.random.key(int(self.rng.integers(2**31)))
        observation = self.observe(observation)
        dtype = np.int64 if np.ndim(observation) == 0 else np.float64
        action = sample_actions(self.policy, key, np.asarray(observation, dtype=dtype)[None])[0]
        if isinstance(self.action_space, Box):
            return self._within(action)
        return int(self.enact(action))

    __call__ = act

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[Any, Any]:
        """Action and `state`, for one observation or a batch of them, as stable-baselines3's policies give.

        Args:
          observation: of the environment, or a batch with a leading axis.
          state, episode_start: of recurrent policies; passed through and not looked at.
          deterministic: the mean of continuous actions, or the most probable discrete one, instead of a sample.
        """
        observations = np.asarray(observation)
        if observations.shape == self.observation_shape:
            return self._chosen(observation, deterministic), state
        if observations.shape[1:] != self.observation_shape:
            shape = self.observation_shape
            raise ValueError(f"observation: expected shape {shape}, or a batch of them, got {observations.shape}")
        return np.stack([np.asarray(self._chosen(each, deterministic)) for each in observations]), state

    def _chosen(self, observation: Any, deterministic: bool) -> Any:
        if not deterministic:
            return self.act(observation)
        rows = np.asarray(self.observe(observation))[None]
        if is_discrete(self.policy):
            return int(self.enact(int(np.argmax(self.policy.probabilities(rows)[0]))))  # type: ignore[attr-defined]
        return self._within(self.policy.mean_actions(rows.astype(float))[0])  # type: ignore[attr-defined]

    def _within(self, action: np.ndarray) -> Any:
        space = self.action_space
        assert isinstance(space, Box)
        return self.enact(np.clip(action, space.low, space.high).astype(space.dtype))
