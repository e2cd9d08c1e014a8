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
      constant: value of one more feature, which is the same for all states; 0: there is none.
      effort: what the squares of an action's parts are multiplied with in one more feature of a step, the last; it is 0
        for a state alone; (): there is none.
    """

    centres: Float[np.ndarray, "d s"]
    bandwidths: Float[np.ndarray, " s"]
    period: Float[np.ndarray, " s"]
    normalised: bool = False
    constant: float = 0.0
    effort: tuple[float, ...] = ()

    def __call__(self, observations: ArrayLike) -> Float[np.ndarray, "n d"]:
        """Features of N observations, shape (N, S)."""
        observations = matrix("observations", observations, columns=self.centres.shape[1])
        basis = radial_basis(observations, self.centres, self.bandwidths, self.period, normalised=self.normalised)
        if self.constant:
            basis = np.pad(basis, ((0, 0), (0, 1)), constant_values=self.constant)
        return np.pad(basis, ((0, 0), (0, 1))) if self.effort else basis

    def of_steps(self, next_states: ArrayLike, actions: ArrayLike) -> Float[np.ndarray, "n d"]:
        """Features of N steps: of the next states, and of the effort of the actions where that is one."""
        values = self(next_states)
        if self.effort:
            values[:, -1] = self.efforts(actions)
        return values

    def efforts(self, actions: ArrayLike) -> Float[np.ndarray, " n"]:
        """The feature of the effort of N actions, shape (N, A)."""
        return np.square(matrix("actions", actions, columns=len(self.effort))) @ np.array(self.effort)

    def rescaled(self, multiples: ArrayLike) -> Self:
        """The same centres with bandwidths `multiples` times as wide, one number or one per dimension.

        With one more, the feature of the effort is multiplied by it.
        """
        multiples, dimensions = np.asarray(multiples), len(self.bandwidths)
        if multiples.ndim == 0 or len(multiples) <= dimensions:
            return replace(self, bandwidths=self.bandwidths * multiples)
        effort = tuple((np.array(self.effort) * multiples[dimensions]).tolist())
        return replace(self, bandwidths=self.bandwidths * multiples[:dimensions], effort=effort)

    def effort_multiples(self, multiples: Float[np.ndarray, "c s"]) -> Float[np.ndarray, " c"]:
        """By what each row of multiples multiplies the feature of the effort; 1 where it says nothing of it."""
        return multiples[:, len(self.bandwidths) :].prod(axis=1)

    def under(
        self, multiples: Float[np.ndarray, "c s"], observations: ArrayLike
    ) -> Iterator[tuple[Float[np.ndarray, "n d"], Float[np.ndarray, " n"]]]:
        """`rescaled(row)(observations)` for each row of `multiples` in turn, as in `radial_basis_under`.

        Neither the constant feature nor that of the effort is among them.
        """
        points = matrix("observations", observations, columns=self.centres.shape[1])
        return radial_basis_under(
            multiples[:, : len(self.bandwidths)],
            points,
            self.centres,
            self.bandwidths,
            self.period,
            normalised=self.normalised,
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
      effort: whether φ of a step has one more feature: the mean square of the action's parts, as shares of the largest
        that the space allows, or where it has no bound of their root mean square. An observed one then has a tenth of
        the prior variance that the functions give a state, under settings where effort counts. Only where actions are
        continuous.
      diffusion: whether φ(s) of discrete states is a `DiffusionBasis` of the observed steps instead of one-hot.
      standardised: whether the one-hot φ(s) of discrete states is divided by how much the number of their visits varies
        between trajectories.
    """

    centres: int
    bandwidth_factor: float = 1.0
    period: ArrayLike | None = None
    normalised: bool = False
    constant: bool = False
    effort: bool = False
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
