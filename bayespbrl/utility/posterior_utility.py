"""The posterior of the utility under one setting of the hyperparameters (paper, eqs. 7-8)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from xarray import DataTree

from bayespbrl import checks
from bayespbrl.features import StateFeatures
from bayespbrl.models import PreferenceModel
from bayespbrl.models.likelihoods import Likelihood
from bayespbrl.trajectories import Trajectory, Transitions, trajectory_features
from bayespbrl.utility.quality import FitQuality


@dataclass(frozen=True)
class PosteriorUtility:
    """u(s′) = wᵀφ(s′) with draws of w from its posterior.

    Attributes:
      features: φ.
      weights: the w that is acted on (posterior mean, most likely draw or one draw), in the units of φ, shape (D,).
      discount: γ of ψ(τ).
      quality: how far it can be trusted.
      posterior: draws in ArviZ's schema.
      scale: what the differences were divided by: a draw of the posterior over `scale` is in the units of φ.
    """

    features: StateFeatures
    weights: np.ndarray
    discount: float
    quality: FitQuality
    posterior: DataTree
    scale: float = 1.0

    @property
    def sampled(self) -> "PosteriorUtility":
        """Itself."""
        return self

    @property
    def likelihood(self) -> Likelihood:
        """Of the next answer, as a function of the difference of two utilities wᵀψ."""
        fitted = self.posterior.attrs
        model = PreferenceModel(
            steepness=fitted["steepness"], lapse_rate=fitted["lapse_rate"], likelihood=fitted["likelihood"]
        )
        return model.answer_likelihood(self.quality.pairs)

    def utilities(self, states: np.ndarray) -> Float[np.ndarray, " n"]:
        """wᵀφ(s) of n states."""
        return linear(self.features(states), self.weights)

    def step_utilities(self, steps: Transitions) -> Float[np.ndarray, " n"]:
        """uᵢ = wᵀφ(sᵢ′): the utility of the *next* state, the same convention as in ψ."""
        return self.utilities(steps.next_states)

    def utilities_and_draws(
        self, states: np.ndarray, *, number: int | None = None
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "s n"]]:
        """`utilities` of n states and draws of them, all chains in one, from one evaluation of the features."""
        features = self.features(states)
        return linear(features, self.weights), self.draws(features, number=number).reshape(-1, len(states))

    def trajectory_utilities(self, trajectories: Sequence[Trajectory]) -> Float[np.ndarray, " n"]:
        """wᵀψ(τ) of each trajectory."""
        return linear(trajectory_features(trajectories, self.features, discount=self.discount), self.weights)

    def trajectory_draws(
        self, trajectories: Sequence[Trajectory], *, number: int | None = None
    ) -> Float[np.ndarray, "s n"]:
        """Posterior draws of wᵀψ(τ) of each trajectory, all chains in one."""
        features = trajectory_features(trajectories, self.features, discount=self.discount)
        return self.draws(features, number=number).reshape(-1, len(trajectories))

    def margin_draws(self, first: Trajectory, second: Trajectory) -> Float[np.ndarray, " s"]:
        """By how much each draw prefers the first."""
        draws = self.trajectory_draws([first, second])
        return draws[:, 0] - draws[:, 1]

    def draws(self, features: np.ndarray, *, number: int | None = None) -> Float[np.ndarray, "chain draw n"]:
        """Posterior draws of wᵀφ for each row of `features`: of states, or of feature sums ψ(τ).

        Args:
          features: shape (n, D).
          number: most draws in all, evenly spaced, but at least one a chain; None for all.

        Returns:
          in the units of `weights`.

        Raises:
          ValueError: features of another length, or a number < 1.
        """
        if features.ndim != 2 or features.shape[1] != len(self.weights):
            raise ValueError(f"features: expected shape (n, {len(self.weights)}), got {features.shape}")
        weights = self.posterior.children["posterior"].to_dataset()["utility_weights"]
        return weights[:, :: spacing(weights.shape[0] * weights.shape[1], number)].values @ features.T / self.scale


def linear(features: np.ndarray, weights: np.ndarray) -> Float[np.ndarray, " n"]:
    """wᵀφ of each row of φ, (n, D).

    Raises:
      ValueError: features of another length than the weights, as a function of the user's may return.
    """
    if features.shape[1] != len(weights):
        raise ValueError(f"features: expected {len(weights)} of each state, as before, got {features.shape[1]}")
    return features @ weights


def spacing(total: int, number: int | None) -> int:
    """Distance between at most `number` of `total` draws, evenly spaced; 1 for None, which is all of them."""
    return 1 if number is None else -(-total // checks.whole("number", number))
