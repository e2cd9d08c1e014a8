"""A policy without its noise, which explores nothing: what a run keeps and is judged by."""

from dataclasses import dataclass
from typing import Any

import jax
from jax import Array
from jaxtyping import Key, Shaped

from bayespbrl.policies.policy import AnyArray


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Greedy:
    """The most probable action of a policy: the mean of continuous actions.

    Attributes:
      policy: stochastic, with a `mode`.
    """

    policy: Any

    def sample(self, key: Key[Array, ""], observation: Shaped[AnyArray, "..."]) -> Shaped[Array, "..."]:
        """argmaxₐ π(a|s), whatever the key."""
        action: Array = self.policy.mode(observation)
        return action


def greedy(policy: Any) -> Any:
    """`policy` without its noise; itself where it is one of the user's that has no `mode`."""
    return Greedy(policy) if callable(getattr(type(policy), "mode", None)) else policy
