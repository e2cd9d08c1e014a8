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
from bayespbrl.policies.policy import Policy


@dataclass(frozen=True)
class Actor:
    """A stochastic policy and the action space whose bounds its actions keep.

    Attributes:
      policy: stochastic policy.
      action_space: of the policy's actions.
      rng: where a call without a key draws from.
      observe: from an observation of the environment to one of the policy's.
      enact: from an action of the policy's to one of the environment.
    """

    policy: Policy
    action_space: Space[Any]
    rng: np.random.Generator
    observe: Callable[[Any], Any] = np.asarray
    enact: Callable[[Any], Any] = np.asarray

    def act(self, observation: Any, *, key: Key[Array, ""] | None = None) -> Any:
        """An action a ~ π(·|observation), clipped to the action space; an int where actions are discrete."""
        if key is None:
            key = jax.random.key(int(self.rng.integers(2**31)))
        observation = self.observe(observation)
        dtype = np.int64 if np.ndim(observation) == 0 else np.float64
        action = sample_actions(self.policy, key, np.asarray(observation, dtype=dtype)[None])[0]
        if isinstance(self.action_space, Box):
            action = np.clip(action, self.action_space.low, self.action_space.high).astype(self.action_space.dtype)
            return self.enact(action)
        return int(self.enact(action))

    __call__ = act
