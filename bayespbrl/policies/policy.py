"""The protocol of a stochastic policy π(a|s) (paper, preliminaries and eq. 14)."""

from typing import Protocol, Self, TypeGuard, runtime_checkable

import jax
import numpy as np
from jax import Array
from jaxtyping import Float, Key, Shaped
from numpy.typing import ArrayLike

AnyArray = Array | np.ndarray  # a policy holds NumPy's arrays, within a trace JAX's


class Sampler(Protocol):
    """The part of a policy that a rollout needs."""

    def sample(self, key: Key[Array, ""], observation: Shaped[AnyArray, "..."]) -> Shaped[Array, "..."]:
        """One action for one observation. Continuous actions are not clipped: the environment does that."""
        ...


@runtime_checkable
class Policy(Sampler, Protocol):
    """A stochastic policy: a frozen dataclass, registered as a JAX pytree, whose shapes stay fixed for a whole run.

    The methods that take a single observation are JAX-traceable, so that a rollout compiled once takes any policy of
    the same type as an argument (`batch` maps them over N observations); the others take and return NumPy arrays.
    Policies over discrete actions also have `probabilities(observations) -> (N, A)`, those over continuous actions
    `action_standard_deviation(observations) -> (N, A)`. They may have `fit_mean`, called as `fit` is, which holds the
    spread; it takes the place of `fit` in all but the first update of an iteration; `mode(observation)`, the most
    probable action, JAX-traceable: without it a run keeps the policy with its noise; and `converged`, whether the last
    fit succeeded, which a run reports.
    """

    def entropy(self, observation: Shaped[AnyArray, "..."]) -> Float[Array, ""]:
        """Entropy of π(·|s) in nats (differential for continuous actions)."""
        ...

    def kl_divergence(self, old: Self, observations: ArrayLike) -> Float[np.ndarray, " n"]:
        """KL(self(·|s) ‖ old(·|s)) at each of N observations, in closed form."""
        ...

    def fit(
        self,
        observations: ArrayLike,
        actions: ArrayLike,
        sample_weights: ArrayLike,
        *,
        rng: np.random.Generator,
        base_weights: ArrayLike | None = None,
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


class DiscretePolicy(Policy, Protocol):
    """A policy whose actions can be enumerated."""

    def probabilities(self, observations: ArrayLike) -> Float[np.ndarray, "n a"]:
        """π(·|sᵢ) at each of N observations."""
        ...


class ContinuousPolicy(Policy, Protocol):
    """A policy over vectors of actions."""

    def action_standard_deviation(self, observations: ArrayLike) -> Float[np.ndarray, "n a"]:
        """Standard deviation of each action dimension at each of N observations."""
        ...


class WithDensity(Protocol):
    """A policy that knows the probabilities of its actions."""

    def log_prob(self, observation: Shaped[AnyArray, "..."], action: Shaped[AnyArray, "..."]) -> Float[Array, ""]:
        """log π(a|s): the log mass of a discrete action, the log density of a continuous one; JAX-traceable."""
        ...


class WithMode(Sampler, Protocol):
    """A policy that knows its most probable action."""

    def mode(self, observation: Shaped[AnyArray, "..."]) -> Shaped[Array, "..."]:
        """argmaxₐ π(a|s)."""
        ...


def has_mode(policy: object) -> TypeGuard[WithMode]:
    """Whether a policy knows its most probable action; one of the user's may not."""
    return callable(getattr(type(policy), "mode", None))


def fit_converged(policy: object) -> bool | None:
    """Whether the last fit of a policy succeeded; None where the policy does not know."""
    known = getattr(policy, "converged", None)
    return None if known is None else bool(np.all(known))


def is_pytree(policy: object) -> bool:
    """Whether a policy is a JAX pytree of numbers, so that it can be compiled."""
    return all(isinstance(leaf, Array | np.ndarray | np.generic | float | int) for leaf in jax.tree.leaves(policy))


def is_discrete(policy: object) -> TypeGuard[DiscretePolicy]:
    """Whether a policy's actions can be enumerated."""
    return hasattr(policy, "probabilities")
