"""The protocol of a utility estimate, used by the other steps."""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float
from xarray import DataTree

from bayespbrl.models.likelihoods import Likelihood
from bayespbrl.trajectories import Trajectory, Transitions
from bayespbrl.utility.quality import FitQuality


class UtilityEstimate(Protocol):
    """An estimate of the expert's utility: a point, or a posterior with draws.

    `posterior` says which. Where it is None the methods that need one (`likelihood`, `trajectory_draws`,
    `margin_draws`, `utilities_and_draws`) raise a ValueError.
    """

    @property
    def quality(self) -> FitQuality:
        """Convergence of the estimate, and its fit to the answers."""
        ...

    @property
    def posterior(self) -> DataTree | None:
        """The draws whose convergence `quality` reports and which all else is of; None for a point estimate."""
        ...

    def likelihood(self, number: int | None = None) -> Likelihood:
        """Of the next answer given its margin under each of S draws, at most `number`: margins have shape (S, n)."""
        ...

    def hyperparameters(self) -> dict[str, Any] | None:
        """The inferred hyperparameters as plain data; None where there are none."""
        ...

    def step_utilities(self, steps: Transitions) -> Float[np.ndarray, " n"]:
        """uᵢ of each transition."""
        ...

    def utilities_and_draws(
        self, states: np.ndarray, *, number: int | None = None
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "s n"]]:
        """Expected utility of n states and S posterior draws of it, at most `number`, in one pass over the features."""
        ...

    def trajectory_utilities(self, trajectories: Sequence[Trajectory]) -> Float[np.ndarray, " n"]:
        """Expected utility wᵀψ(τ) of each trajectory."""
        ...

    def trajectory_draws(
        self, trajectories: Sequence[Trajectory], *, number: int | None = None
    ) -> Float[np.ndarray, "s n"]:
        """S posterior draws of the utility wᵀψ(τ) of each trajectory, at most `number`."""
        ...

    def margin_draws(self, first: Trajectory, second: Trajectory) -> Float[np.ndarray, " s"]:
        """Utility of the first minus that of the second, under each draw."""
        ...


class WithoutDraws:
    """The part of the protocol that a point estimate lacks."""

    posterior = None

    def hyperparameters(self) -> None:
        """None: a point estimate infers no hyperparameters."""

    def likelihood(self, number: int | None = None) -> Likelihood:
        """Raises ValueError: a point estimate has no draws."""
        raise self._no_posterior("likelihood")

    def utilities_and_draws(self, states: np.ndarray, *, number: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Raises ValueError: a point estimate has no draws."""
        raise self._no_posterior("utilities_and_draws")

    def trajectory_draws(self, trajectories: Sequence[Trajectory], *, number: int | None = None) -> np.ndarray:
        """Raises ValueError: a point estimate has no draws."""
        raise self._no_posterior("trajectory_draws")

    def margin_draws(self, first: Trajectory, second: Trajectory) -> np.ndarray:
        """Raises ValueError: a point estimate has no draws."""
        raise self._no_posterior("margin_draws")

    def _no_posterior(self, asked: str) -> ValueError:
        return ValueError(f"{asked}: expected an estimate with a posterior, got {type(self).__name__} without")
