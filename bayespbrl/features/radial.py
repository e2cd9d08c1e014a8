"""Radial basis functions of states, and of states and actions (paper, step 1)."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from bayespbrl.checks import matrix, positive, whole
from bayespbrl.kernels import as_periods, median_bandwidths, radial_basis, radial_basis_under


@dataclass(frozen=True, eq=False)
class RadialBasis:
    """φ_d(s) = exp(−½ Σⱼ δⱼ²/bⱼ²) around centre d; δⱼ a difference, or a chord where dimension j is periodic.

    Attributes:
      centres, bandwidths: D centres, and b, in the units of the observation; a dimension with b = 0 is left out.
      period: infinite where not periodic.
      normalised: whether φ is divided by its sum. A linear function of it then keeps the value of the nearest centres
        beyond them, where plain radial basis functions fall to zero.
      constant: value of one more feature, the last, which is the same for all states; 0: there is none.
    """

    centres: Float[np.ndarray, "d s"]
    bandwidths: Float[np.ndarray, " s"]
    period: Float[np.ndarray, " s"]
    normalised: bool = False
    constant: float = 0.0

    def __call__(self, observations: ArrayLike) -> Float[np.ndarray, "n d"]:
        """Features of N observations, shape (N, S)."""
        observations = matrix("observations", observations, columns=self.centres.shape[1])
        basis = radial_basis(observations, self.centres, self.bandwidths, self.period, normalised=self.normalised)
        return np.pad(basis, ((0, 0), (0, 1)), constant_values=self.constant) if self.constant else basis

    def rescaled(self, multiples: ArrayLike) -> Self:
        """The same centres with bandwidths `multiples` times as wide, one number or one per dimension."""
        return replace(self, bandwidths=self.bandwidths * np.asarray(multiples))

    def under(
        self, multiples: Float[np.ndarray, "c s"], observations: ArrayLike
    ) -> Iterator[tuple[Float[np.ndarray, "n d"], Float[np.ndarray, " n"]]]:
        """`rescaled(row)(observations)` for each row of `multiples` in turn, as in `radial_basis_under`.

        The constant feature is not among them.
        """
        points = matrix("observations", observations, columns=self.centres.shape[1])
        return radial_basis_under(
            multiples, points, self.centres, self.bandwidths, self.period, normalised=self.normalised
        )


@dataclass(frozen=True, eq=False)
class JointRadialBasis:
    """φ_d(s, a) = state kernel × action kernel, both at centre d.

    Actions are clipped to [low, high], as the environment does, and divided by their range.

    Attributes:
      states: the state kernel.
      action_centres: in the action's units, inside the bounds.
      action_bandwidths: as fractions of the range.
      action_low, action_high: infinite where the space has no bound.
      action_range: high − low; in an unbounded dimension four standard deviations of the observed actions.
    """

    states: RadialBasis
    action_centres: Float[np.ndarray, "d a"]
    action_bandwidths: Float[np.ndarray, " a"]
    action_low: Float[np.ndarray, " a"]
    action_high: Float[np.ndarray, " a"]
    action_range: Float[np.ndarray, " a"]

    def __call__(self, observations: ArrayLike, actions: ArrayLike) -> Float[np.ndarray, "n d"]:
        """Features of N pairs, observations (N, S) and actions (N, A)."""
        states, kernel = self.states, self.action_bandwidths * self.action_range
        observations = matrix("observations", observations, columns=states.centres.shape[1])
        actions = matrix("actions", actions, columns=self.action_centres.shape[1])
        if len(observations) != len(actions):
            raise ValueError(f"actions: expected {len(observations)} rows, one for each state, got {len(actions)}")
        clipped = np.clip(actions, self.action_low, self.action_high)
        return radial_basis(  # a product of exponentials is one exponential over both
            np.hstack([observations, clipped]),
            np.hstack([states.centres, self.action_centres]),
            np.concatenate([states.bandwidths, kernel]),
            np.concatenate([states.period, np.full(len(kernel), np.inf)]),
        )


@dataclass(frozen=True, eq=False)
class RadialBasisOptions:
    """How radial basis functions are drawn at observed samples.

    Attributes:
      centres: how many, drawn without replacement; at most one per sample.
      bandwidth_factor: multiplies the median rule.
      period: of each observation dimension, infinite where not periodic; None for none.
      normalised: as in `RadialBasis`; for φ(s) alone.
      constant: whether φ(s) has a constant feature too, which gives the utility of a state as much prior variance as
        the others give it in the mean. Then how long a trajectory is counts by itself.
      diffusion: whether φ(s) of discrete states is a `DiffusionBasis` of the observed steps instead of one-hot.
      standardised: whether the one-hot φ(s) of discrete states is divided by how much the number of their visits varies
        between trajectories.
    """

    centres: int
    bandwidth_factor: float = 1.0
    period: ArrayLike | None = None
    normalised: bool = False
    constant: bool = False
    diffusion: bool = False
    standardised: bool = False

    def __post_init__(self) -> None:
        whole("centres", self.centres)
        positive("bandwidth_factor", self.bandwidth_factor)

    def state_kernel(
        self, states: Float[np.ndarray, "n s"], rng: np.random.Generator
    ) -> tuple[RadialBasis, Int[np.ndarray, " d"]]:
        """Functions at some of `states`, and the rows that were drawn."""
        if len(states) == 0:
            raise ValueError("states: expected at least one row, got none")
        chosen = rng.choice(len(states), size=min(self.centres, len(states)), replace=False)
        bandwidths = median_bandwidths(states, factor=self.bandwidth_factor, period=self.period, rng=rng)
        period = as_periods(self.period, states.shape[1])
        return RadialBasis(states[chosen], bandwidths, period, self.normalised), chosen
