"""State features φ(s) and state-action features φ(s, a): one-hot and radial basis functions (paper, step 1).

Features are callables on NumPy arrays, drawn anew at each iteration from the observed samples. Each is a frozen
dataclass of arrays and numbers, so that a run can store what it used. A user's own state features are any function of
observations; `checked_features` calls it.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Self

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box, Discrete
from jaxtyping import Float, Int, Shaped
from numpy.typing import ArrayLike

from bayespbrl.checks import dense, indices, matrix, positive, whole
from bayespbrl.kernels import as_periods, median_bandwidths, radial_basis, radial_basis_under
from bayespbrl.trajectories import Trajectory, Transitions

StateFeatures = Callable[[Shaped[np.ndarray, "n ..."]], Shaped[np.ndarray, "n d"]]
StateActionFeatures = Callable[[Shaped[np.ndarray, "n ..."], Shaped[np.ndarray, "n ..."]], Shaped[np.ndarray, "n d"]]

ACTION_BANDWIDTH = 0.5  # of the action kernel, as a fraction of the action's range
DIFFUSION_STEPS = 1 / 3  # the length scale of a diffusion basis as drawn: states are nearly independent
MOST_CONNECTED = 1000  # discrete states of a diffusion basis; the eigenvectors of so many take a third of a second


@dataclass(frozen=True, eq=False)
class OneHot:
    """φ(s) = e_s for discrete states: the paper's tabular model, in which linear functions are exact (step 1)."""

    number_of_states: int

    def __call__(self, observations: ArrayLike) -> Float[np.ndarray, "n {self.number_of_states}"]:
        """Features of N integer observations."""
        observations = indices("observations", observations, self.number_of_states)
        features = np.zeros((len(observations), self.number_of_states))
        features[np.arange(len(observations)), observations] = 1.0
        return features


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
class DiffusionBasis:
    """φ(s) = V_s exp(−¼ b² Λ), divided by its length, for discrete states: VΛVᵀ is the Laplacian of a graph of them.

    A linear function of φ with independent standard normal weights is a Gaussian process whose covariance is the
    diffusion kernel exp(−½ b² L), scaled to a variance of one: states that few steps part have similar values. At b = 0
    all states are independent, as with `OneHot`.

    Attributes:
      eigenvectors, eigenvalues: V and Λ.
      bandwidths: b, the length scale in steps.

    Source: Kondor & Lafferty (2002).
    """

    eigenvectors: Float[np.ndarray, "d d"]
    eigenvalues: Float[np.ndarray, " d"]
    bandwidths: Float[np.ndarray, "1"]

    def __call__(self, observations: ArrayLike) -> Float[np.ndarray, "n d"]:
        """Features of N integer observations."""
        observations = indices("observations", observations, len(self.eigenvalues))
        rows = self.eigenvectors * np.exp(-0.25 * self.bandwidths**2 * self.eigenvalues)  # Kondor & Lafferty (2002)
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        return rows[observations]

    def rescaled(self, multiples: ArrayLike) -> Self:
        """The same graph with a length scale `multiples` times as long."""
        return replace(self, bandwidths=self.bandwidths * np.asarray(multiples))


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
class StateActionProduct:
    """φ(s, a) = φ(s) ⊗ e_a for discrete actions; column d·A + a holds φ_d(s)·1[action = a]."""

    state_features: StateFeatures
    number_of_actions: int

    def __call__(self, observations: Shaped[np.ndarray, "n ..."], actions: ArrayLike) -> Float[np.ndarray, "n da"]:
        """Features of N pairs."""
        states, actions = self.state_features(observations), indices("actions", actions, self.number_of_actions)
        if len(states) != len(actions):
            raise ValueError(f"actions: expected {len(states)}, one for each state, got {len(actions)}")
        return (states[:, :, None] * np.eye(self.number_of_actions)[actions][:, None, :]).reshape(len(states), -1)


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
    """

    centres: int
    bandwidth_factor: float = 1.0
    period: ArrayLike | None = None
    normalised: bool = False
    constant: bool = False
    diffusion: bool = False

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


def draw_state_features(
    observation_space: Space[Any], states: ArrayLike, options: RadialBasisOptions, *, rng: np.random.Generator
) -> OneHot | RadialBasis:
    """φ(s) for a space: one-hot where it is `Discrete`, else radial basis functions at observed states.

    Args:
      states: observed states, shape (N, S), or (N,) where discrete.
      options: of the radial basis functions.
    """
    if isinstance(observation_space, Discrete):
        return OneHot(int(observation_space.n))
    states = matrix("states", states, columns=_box("observation_space", observation_space).shape[0])
    kernel = options.state_kernel(states, rng)[0]
    if not options.constant:
        return kernel
    variances = np.sum(kernel(kernel.centres) ** 2, axis=1)  # the centres are a sample of the states
    return replace(kernel, constant=float(np.sqrt(np.mean(variances))))


def diffusion_basis(trajectories: Sequence[Trajectory], number_of_states: int) -> DiffusionBasis:
    """The basis of the graph that joins two states where some trajectory stepped from one to the other."""
    edges = np.zeros((number_of_states, number_of_states))
    for trajectory in trajectories:
        states = indices("states", trajectory.states, number_of_states)
        edges[states[:-1], states[1:]] = 1.0
    edges = np.maximum(edges, edges.T)
    np.fill_diagonal(edges, 0.0)
    eigenvalues, eigenvectors = np.linalg.eigh(np.diag(edges.sum(axis=1)) - edges)  # Kondor & Lafferty (2002)
    return DiffusionBasis(eigenvectors, np.maximum(eigenvalues, 0.0), np.array([DIFFUSION_STEPS]))


def draw_state_action_features(
    observation_space: Space[Any],
    action_space: Space[Any],
    states: ArrayLike,
    actions: ArrayLike,
    options: RadialBasisOptions,
    *,
    rng: np.random.Generator,
) -> JointRadialBasis | StateActionProduct:
    """φ(s, a) for two spaces: joint radial basis functions, or φ(s) ⊗ e_a where actions are `Discrete`.

    Args:
      states, actions: observed pairs, shapes (N, S) and (N, A), or (N,) where discrete.
      options: of the radial basis functions, not normalised.
    """
    if options.normalised:
        raise ValueError("normalised: expected False for features of states and actions, got True")
    if isinstance(action_space, Discrete):
        features = draw_state_features(observation_space, states, options, rng=rng)
        return StateActionProduct(features, int(action_space.n))
    box = _box("action_space", action_space)
    states = matrix("states", states, columns=_box("observation_space", observation_space).shape[0])
    actions = matrix("actions", actions, columns=box.shape[0])
    if len(states) != len(actions):
        raise ValueError(f"actions: expected {len(states)} rows, one for each state, got {len(actions)}")
    kernel, chosen = options.state_kernel(states, rng)
    low, high = box.low.astype(np.float64), box.high.astype(np.float64)
    bounded = np.isfinite(high) & np.isfinite(low)
    spread = 4 * actions.std(axis=0)  # stands for the range where a space has none
    width = np.where(bounded, np.where(bounded, high, 1.0) - np.where(bounded, low, 0.0), spread)
    return JointRadialBasis(
        states=kernel,
        action_centres=np.clip(actions[chosen], low, high),
        action_bandwidths=np.full(box.shape[0], ACTION_BANDWIDTH),
        action_low=low,
        action_high=high,
        action_range=width,
    )


@dataclass(frozen=True)
class FeatureSource:
    """Draws the features of an environment at observed samples, or takes the user's φ(s).

    Attributes:
      observation_space, action_space: of the environment.
      period: of each observation dimension, infinite where not periodic; None for none.
      own: φ(s) of the user's; None: drawn.
    """

    observation_space: Space[Any]
    action_space: Space[Any]
    period: ArrayLike | None = None
    own: StateFeatures | None = None

    def of_states(
        self, trajectories: Sequence[Trajectory], options: RadialBasisOptions, *, rng: np.random.Generator
    ) -> StateFeatures:
        """φ(s), the user's or drawn at all states of the trajectories.

        Where all are equally long and none ended by itself, there is no constant feature.
        """
        if self.own is not None:
            return partial(checked_features, self.own)
        space = self.observation_space
        if options.diffusion and isinstance(space, Discrete) and space.n <= MOST_CONNECTED:
            return diffusion_basis(trajectories, int(space.n))
        if len({len(each) for each in trajectories}) == 1 and not any(each.terminated for each in trajectories):
            options = replace(options, constant=False)
        observed = np.concatenate([trajectory.states for trajectory in trajectories])
        return draw_state_features(self.observation_space, observed, self._periodic(options), rng=rng)

    def of_steps(
        self, steps: Transitions, options: RadialBasisOptions, *, rng: np.random.Generator
    ) -> JointRadialBasis | StateActionProduct:
        """φ(s, a), drawn at observed transitions."""
        spaces = (self.observation_space, self.action_space)
        return draw_state_action_features(*spaces, steps.states, steps.actions, self._periodic(options), rng=rng)

    def _periodic(self, options: RadialBasisOptions) -> RadialBasisOptions:
        return replace(options, period=self.period)


def checked_features(features: StateFeatures, states: Shaped[np.ndarray, "n ..."]) -> Float[np.ndarray, "n d"]:
    """`features(states)` as finite float64 numbers of shape (N, D); `ValueError` where it is anything else."""
    name = getattr(features, "__name__", type(features).__name__)
    if not callable(features):
        raise ValueError(f"features: expected a function of states (N, S), got {features!r}")
    values = dense(f"features {name}", features(np.array(states)))  # a copy, which the function may change
    if values.ndim != 2 or len(values) != len(states) or values.shape[1] == 0:
        raise ValueError(f"features {name}: expected shape ({len(states)}, D), got {values.shape}")
    if not (np.issubdtype(values.dtype, np.number) or values.dtype == bool) or np.iscomplexobj(values):
        raise ValueError(f"features {name}: expected real numbers, got {values.dtype}")
    if (bad := ~np.isfinite(values := values.astype(np.float64)).all(axis=1)).any():
        raise ValueError(f"features {name}: expected finite numbers, got NaN or infinity for state {states[bad][0]}")
    return values


def linear(features: np.ndarray, weights: np.ndarray) -> Float[np.ndarray, "n ..."]:
    """wᵀφ of each row of φ, (n, D), for weights (D,), or several side by side, (D, m).

    Raises:
      ValueError: features of another length than the weights, as a function of the user's may return.
    """
    if features.shape[1] != len(weights):
        raise ValueError(f"features: expected {len(weights)} for each state, as before, got {features.shape[1]}")
    return np.asarray(features @ weights)  # u = wᵀφ(s) (paper, step 2), wᵀψ(τ) (eq. 4)


def _box(name: str, space: Space[Any]) -> Box:
    if not isinstance(space, Box) or len(space.shape) != 1:
        raise ValueError(f"{name}: expected a Box of shape (n,), got {space}")
    return space
