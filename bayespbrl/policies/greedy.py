"""A policy without its exploration noise: the form in which a run keeps and evaluates policies."""

from dataclasses import dataclass

import jax
from jax import Array
from jaxtyping import Key, Shaped

from bayespbrl.policies.policy import AnyArray, Sampler, WithMode, has_mode


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Greedy:
    """The most probable action of a policy: the mean of continuous actions.

    Attributes:
      policy: stochastic, with a `mode`.
    """

    policy: WithMode

    def sample(self, key: Key[Array, ""], observation: Shaped[AnyArray, "..."]) -> Shaped[Array, "..."]:
        """argmaxₐ π(a|s), whatever the key."""
        return self.policy.mode(observation)


def greedy(policy: Sampler) -> Sampler:
    """`policy` without its noise; itself where it is one of the user's that has no `mode`."""
    return Greedy(policy) if has_mode(policy) else policy
