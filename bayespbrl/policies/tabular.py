"""A table π(a|s) for discrete states and actions, fitted by weighted maximum likelihood in closed form (eq. 14)."""

from dataclasses import dataclass, field
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import Space
from jax import Array
from jaxtyping import Float, Int, Key
from numpy.typing import ArrayLike
from scipy.special import rel_entr

from bayespbrl.checks import indices
from bayespbrl.policies.policy import AnyArray
from bayespbrl.policies.samples import weighted_samples
from bayespbrl.policies.spaces import number_of_values


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class TabularPolicy:
    """π(a|s) = table[s, a].

    Attributes:
      table: probabilities, rows sum to one.
      minimum_probability: a fit mixes in as much of the uniform policy as gives every action this probability. An
        action of probability zero would not be sampled any more, and could never come back.
    """

    table: Float[AnyArray, "s a"]
    minimum_probability: float = field(default=0.0, metadata={"static": True})

    @classmethod
    def initial(
        cls, observation_space: Space[Any], action_space: Space[Any], *, minimum_probability: float = 0.0
    ) -> Self:
        """The uniform policy. `ValueError` unless both spaces are `Discrete` and start at zero."""
        states = number_of_values("observation_space", observation_space)
        actions = number_of_values("action_space", action_space)
        if not 0 <= minimum_probability * actions < 1:
            raise ValueError(f"minimum_probability: expected a number in [0, 1/{actions}), got {minimum_probability}")
        return cls(np.full((states, actions), 1.0 / actions), minimum_probability)

    def sample(self, key: Key[Array, ""], observation: Int[AnyArray, ""]) -> Int[Array, ""]:
        """a ~ π(·|s)."""
        return jax.random.categorical(key, jnp.log(jnp.asarray(self.table)[observation]))

    def mode(self, observation: Int[AnyArray, ""]) -> Int[Array, ""]:
        """The most probable action."""
        return jnp.argmax(jnp.asarray(self.table)[observation])

    def log_prob(self, observation: Int[AnyArray, ""], action: Int[AnyArray, ""]) -> Float[Array, ""]:
        """log π(a|s); −∞ where the table holds a zero."""
        return jnp.log(jnp.asarray(self.table)[observation, action])

    def entropy(self, observation: Int[AnyArray, ""]) -> Float[Array, ""]:
        """Entropy of π(·|s) in nats."""
        return jax.scipy.special.entr(jnp.asarray(self.table)[observation]).sum()

    def probabilities(self, observations: ArrayLike) -> Float[np.ndarray, "n a"]:
        """π(·|sᵢ) for each of N observations."""
        return np.asarray(self.table)[np.asarray(observations)]

    def kl_divergence(self, old: Self, observations: ArrayLike) -> Float[np.ndarray, " n"]:
        """KL(self ‖ old) at each of N observations; ∞ where `old` excludes an action that `self` takes."""
        return rel_entr(self.probabilities(observations), old.probabilities(observations)).sum(axis=1)

    def fit(
        self,
        observations: ArrayLike,
        actions: ArrayLike,
        sample_weights: ArrayLike,
        *,
        rng: np.random.Generator | None = None,
        base_weights: ArrayLike | None = None,
    ) -> Self:
        """π(a|s) ∝ Σᵢ Wᵢwᵢ over the samples at (s, a) (eq. 14), mixed with `minimum_probability` of each action.

        A state without any weight keeps its row.

        Args:
          observations, actions: integers, shape (N,).
          sample_weights, base_weights: wᵢ = pᵢ/Wᵢ and Wᵢ, shape (N,); see `Policy.fit`.
          rng: not used, the fit is deterministic.
        """
        table = np.asarray(self.table)
        number_of_states, number_of_actions = table.shape
        states = indices("observations", observations, number_of_states)
        samples = weighted_samples(states, indices("actions", actions, number_of_actions), sample_weights, base_weights)
        cells = samples.observations * number_of_actions + samples.actions
        mass = np.bincount(cells, weights=samples.weights, minlength=table.size).reshape(table.shape)
        visits = mass.sum(axis=1, keepdims=True)
        uniform_share = self.minimum_probability * number_of_actions
        fitted = (1 - uniform_share) * mass / np.where(visits > 0, visits, 1.0) + self.minimum_probability  # eq. 14
        return type(self)(np.where(visits > 0, fitted, table), self.minimum_probability)
