"""A table π(a|s) for discrete states and actions, fitted by weighted maximum likelihood in closed form (eq. 14)."""

from dataclasses import dataclass, field
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import Space
from scipy.special import rel_entr

from bayespbrl.policies.samples import weighted_samples
from bayespbrl.policies.spaces import number_of_values


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class TabularPolicy:
    """π(a|s) = table[s, a].

    Attributes:
      table: probabilities, shape (states, actions), rows sum to one.
      minimum_probability: a fit mixes in as much of the uniform policy as gives every action this probability: an
        action at zero would have no sample any more, and could never come back.
    """

    table: np.ndarray
    minimum_probability: float = field(default=0.0, metadata={"static": True})

    @classmethod
    def initial(cls, observation_space: Space, action_space: Space, *, minimum_probability: float = 0.0) -> Self:
        """The uniform policy. `ValueError` unless both spaces are `Discrete` and start at zero."""
        states = number_of_values("observation_space", observation_space)
        actions = number_of_values("action_space", action_space)
        if not 0 <= minimum_probability * actions < 1:
            raise ValueError(f"minimum_probability: expected a number in [0, 1/{actions}), got {minimum_probability}")
        return cls(np.full((states, actions), 1.0 / actions), minimum_probability)

    def sample(self, key: jax.Array, observation: Any) -> Any:
        """a ~ π(·|s), an integer scalar."""
        return jax.random.categorical(key, jnp.log(jnp.asarray(self.table)[observation]))

    def log_prob(self, observation: Any, action: Any) -> Any:
        """log π(a|s); −∞ where the table holds a zero."""
        return jnp.log(jnp.asarray(self.table)[observation, action])

    def entropy(self, observation: Any) -> Any:
        """Entropy of π(·|s) in nats."""
        return jax.scipy.special.entr(jnp.asarray(self.table)[observation]).sum()

    def probabilities(self, observations: np.ndarray) -> np.ndarray:
        """π(·|sᵢ) for each observation, shape (N, A)."""
        return np.asarray(self.table)[np.asarray(observations)]

    def kl_divergence(self, old: Self, observations: np.ndarray) -> np.ndarray:
        """KL(self ‖ old) at each observation, shape (N,); ∞ where `old` excludes an action that `self` takes."""
        return rel_entr(self.probabilities(observations), old.probabilities(observations)).sum(axis=1)

    def fit(
        self,
        observations: np.ndarray,
        actions: np.ndarray,
        sample_weights: np.ndarray,
        *,
        rng: np.random.Generator | None = None,
        base_weights: np.ndarray | None = None,
    ) -> Self:
        """π(a|s) ∝ Σᵢ Wᵢwᵢ over the samples at (s, a) (eq. 14), mixed with `minimum_probability` of each action.

        A state without any weight keeps its row.

        Args:
          observations, actions: integers, shape (N,).
          sample_weights, base_weights: wᵢ = pᵢ/Wᵢ and Wᵢ, shape (N,); see `Policy.fit`.
          rng: not used, the fit is deterministic.
        """
        table = np.asarray(self.table)
        states, number_of_actions = table.shape
        samples = weighted_samples(
            observations,
            actions,
            sample_weights,
            base_weights,
            number_of_states=states,
            number_of_actions=number_of_actions,
        )
        cells = samples.observations * number_of_actions + samples.actions
        mass = np.bincount(cells, weights=samples.weights, minlength=table.size).reshape(table.shape)
        visits = mass.sum(axis=1, keepdims=True)
        uniform_share = self.minimum_probability * number_of_actions
        fitted = (1 - uniform_share) * mass / np.where(visits > 0, visits, 1.0) + self.minimum_probability
        return type(self)(np.where(visits > 0, fitted, table), self.minimum_probability)
