"""The protocol of a utility estimate, used by the other steps."""

from collections.abc import Callable, Sequence
from typing import Any, NoReturn, Protocol, Self

import numpy as np
from jaxtyping import Float
from xarray import DataTree

from bayespbrl.features import StateFeatures
from bayespbrl.models.likelihoods import Likelihood
from bayespbrl.trajectories import Trajectory, Transitions
from bayespbrl.utility.quality import FitQuality


class UtilityEstimate(Protocol):
    """An estimate of the expert's utility: a point, or a posterior with draws.

    `posterior` says which. Where it is None the methods that need one (from `likelihood` on) raise a ValueError.
    `features` says whether it is a utility of states; where it is None, `utilities` raises a ValueError.
    """

    @property
    def quality(self) -> FitQuality:
        """Convergence of the estimate, and its fit to the answers."""
        ...

    @property
    def posterior(self) -> DataTree | None:
        """The draws from which all else follows, and whose convergence `quality` reports; None for a point estimate."""
        ...

    @property
    def features(self) -> StateFeatures | None:
        """φ of a utility of states; None for another."""
        ...

    @property
    def number_of_features(self) -> int:
        """D; 0 without `features`."""
        ...

    def thinned(self, number: int) -> Self:
        """About `number` of the draws, for `utilities` and `utilities_and_draws` alone; itself without draws."""
        ...

    def hyperparameters(self) -> dict[str, Any] | None:
        """The inferred hyperparameters as plain data; None where there are none."""
        ...

    def step_utilities(self, steps: Transitions) -> Float[np.ndarray, " n"]:
        """uᵢ of each transition."""
        ...

    def utilities(self, states: np.ndarray, *, actions: np.ndarray | None = None) -> Float[np.ndarray, " n"]:
        """The utility wᵀφ of n states, flattened as in `Trajectory.states`; with `actions`, of n steps there."""
        ...

    def trajectory_utilities(self, trajectories: Sequence[Trajectory]) -> Float[np.ndarray, " n"]:
        """The utility wᵀψ(τ) of each trajectory."""
        ...

    def likelihood(self, number: int | None = None, *, answerer: str | None = None) -> Likelihood:
        """Likelihood of the next answer given its margin under each of S draws, about `number`; margins (S, n)."""
        ...

    def side_biases(self, number: int | None = None, *, answerer: str | None = None) -> Float[np.ndarray, "s 1"] | None:
        """What each of these draws adds to the margin of the first shown; None where nothing is known."""
        ...

    def tie_thresholds(self, number: int | None = None) -> Float[np.ndarray, "s 1"] | None:
        """The tie threshold of each of these draws; None where no answer was a tie."""
        ...

    def utilities_and_draws(
        self, states: np.ndarray, *, number: int | None = None, actions: np.ndarray | None = None
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "s n"]]:
        """`utilities` of n states and S posterior draws of them, about `number`, in one pass over the features."""
        ...

    def mean_utilities(self, states: np.ndarray) -> Float[np.ndarray, " n"]:
        """The posterior mean of the utility of n states, whichever utility is acted on."""
        ...

    def prior_deviations(self, states: np.ndarray) -> Float[np.ndarray, " n"]:
        """Prior standard deviation of the utility of n states."""
        ...

    def trajectory_draws(
        self, trajectories: Sequence[Trajectory], *, number: int | None = None
    ) -> Float[np.ndarray, "s n"]:
        """S posterior draws of the utility wᵀψ(τ) of each trajectory, about `number`."""
        ...

    def differences(self, trajectories: Sequence[Trajectory]) -> Float[np.ndarray, "c n d"]:
        """ψ(first) − ψ of each trajectory under each of C settings, in the units of the posterior's differences."""
        ...


def refused(asked: str, needed: str = "an estimate with a posterior") -> Callable[..., NoReturn]:
    """A method that raises a ValueError, for an estimate without what the method needs."""

    def method(self: object, *arguments: Any, **options: Any) -> NoReturn:
        raise ValueError(f"{asked}: expected {needed}, got {type(self).__name__}")

    return method


class WithoutDraws:
    """The part of the protocol that a point estimate lacks."""

    posterior = None
    likelihood = refused("likelihood")
    side_biases = refused("side_biases")
    tie_thresholds = refused("tie_thresholds")
    utilities_and_draws = refused("utilities_and_draws")
    mean_utilities = refused("mean_utilities")
    prior_deviations = refused("prior_deviations")
    trajectory_draws = refused("trajectory_draws")
    differences = refused("differences")

    def thinned(self, number: int) -> Self:
        """Itself: there are no draws."""
        return self

    def hyperparameters(self) -> None:
        """None: nothing is inferred."""
