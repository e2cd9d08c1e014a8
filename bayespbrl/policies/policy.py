"""What the learner asks of a stochastic policy π(a|s) (paper, preliminaries and eq. 14)."""

from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from gymnasium import Space
from jax import Array


@runtime_checkable
class Policy(Protocol):
    """A stochastic policy: a frozen dataclass, registered as a JAX pytree, whose shapes stay fixed for a whole run.

    The methods that take a single observation are JAX-traceable, so that a rollout compiled once takes any policy of
    the same type as an argument (`batch` maps them over N observations); the others take and return NumPy arrays.
    Policies over discrete actions also have `probabilities(observations) -> (N, A)`, those over continuous actions
    `action_standard_deviation(observations) -> (N, A)`; and they may have `fit_mean`, called as `fit` is, which holds
    the spread and takes its place in all but the first update of an iteration.
    """

    @classmethod
    def initial(cls, observation_space: Space, action_space: Space) -> Self:
        """The policy before any fit; keyword options are each policy's own.

        `ValueError` where the spaces do not suit this kind of policy.
        """
        ...

    def sample(self, key: Array, observation: Any) -> Any:
        """One action for one observation. Continuous actions are not clipped: the environment does that."""
        ...

    def log_prob(self, observation: Any, action: Any) -> Any:
        """log π(a|s): the log mass of a discrete action, the log density of a continuous one. Scalar."""
        ...

    def entropy(self, observation: Any) -> Any:
        """Entropy of π(·|s) in nats (differential for continuous actions). Scalar."""
        ...

    def kl_divergence(self, old: Self, observations: np.ndarray) -> np.ndarray:
        """KL(self(·|s) ‖ old(·|s)) at each observation, in closed form. Shape (N,)."""
        ...

    def fit(
        self,
        observations: np.ndarray,
        actions: np.ndarray,
        sample_weights: np.ndarray,
        *,
        rng: np.random.Generator,
        base_weights: np.ndarray | None = None,
    ) -> Self:
        """A new policy by weighted maximum likelihood (eq. 14); `self`, the old one, is the warm start.

        Args:
          observations: sᵢ, shape (N, S), or (N,) where discrete.
          actions: aᵢ, shape (N, A), or (N,) where discrete.
          sample_weights: wᵢ = pᵢ/Wᵢ, with mean 1 under W; shape (N,), ≥ 0.
          rng: source of every random choice of the fit.
          base_weights: Wᵢ, shape (N,), ≥ 0, of any sum; None for the uniform 1/N. Sample i counts with pᵢ = wᵢWᵢ.
        """
        ...


def is_discrete(policy: Any) -> bool:
    """Whether a policy's actions can be enumerated."""
    return hasattr(policy, "probabilities")
