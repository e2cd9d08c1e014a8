"""Step 1: from preferences to an estimate of the expert's utility (paper, "Preference-based Inverse RL")."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from xarray import DataTree

from bayespbrl.models import linear_program, sample_posterior
from bayespbrl.models.likelihoods import Likelihood, preference_likelihood
from bayespbrl.models.low_rank import low_rank
from bayespbrl.preferences import pair_differences
from bayespbrl.trajectories import Trajectory, Transitions, trajectory_features

StateFeatures = Callable[[np.ndarray], np.ndarray]
METHODS = ("posterior-mean", "most-likely", "posterior-draw")


@dataclass(frozen=True)
class FitQuality:
    """How far an estimate can be trusted.

    Attributes:
      converged: the sampler's R̂ and effective sample size, or the linear program's status, are in order.
      status: in words.
      rhat_max, effective_sample_size_min: the worst over the margins (nan where there are no draws).
      pairs, pairs_satisfied: K, and how many of the ordered pairs have a positive margin (eq. 6).
      log_evidence: log marginal likelihood of the answers (nan where there is no posterior).
    """

    converged: bool
    status: str
    pairs: int
    pairs_satisfied: int
    rhat_max: float = float("nan")
    effective_sample_size_min: float = float("nan")
    log_evidence: float = float("nan")


class UtilityEstimate(Protocol):
    """What steps 2 and 4 ask of an estimate."""

    quality: FitQuality

    def step_utilities(self, steps: Transitions) -> np.ndarray:
        """uᵢ of each transition, shape (N,)."""
        ...

    def trajectory_utilities(self, trajectories: Sequence[Trajectory]) -> np.ndarray:
        """wᵀψ(τ) of each trajectory, shape (n,)."""
        ...


@dataclass(frozen=True)
class LinearUtility:
    """u(s′) = wᵀφ(s′).

    Attributes:
      features: φ.
      weights: w in the units of φ, shape (D,).
      discount: γ of ψ(τ).
      quality: how far it can be trusted.
      posterior: draws in ArviZ's schema; None for the linear program.
      scale: what the differences were divided by: a draw of the posterior over `scale` is in the units of φ.
    """

    features: StateFeatures
    weights: np.ndarray
    discount: float
    quality: FitQuality
    posterior: DataTree | None = None
    scale: float = 1.0

    def utilities(self, states: np.ndarray) -> np.ndarray:
        """wᵀφ(s) of N states, shape (N,)."""
        return self._same_width(self.features(states)) @ self.weights

    def step_utilities(self, steps: Transitions) -> np.ndarray:
        """uᵢ = wᵀφ(sᵢ′): the utility of the *next* state, the same convention as in ψ."""
        return self.utilities(steps.next_states)

    def trajectory_utilities(self, trajectories: Sequence[Trajectory]) -> np.ndarray:
        features = trajectory_features(trajectories, self.features, discount=self.discount)
        return self._same_width(features) @ self.weights

    def _same_width(self, features: np.ndarray) -> np.ndarray:
        if features.shape[1] != len(self.weights):
            raise ValueError(f"features: expected {len(self.weights)}, as many as ever, got {features.shape[1]}")
        return features

    def draws(self, features: np.ndarray, *, number: int | None = None) -> np.ndarray:
        """Posterior draws of wᵀφ for each row of `features`, (n, D): of states, or of feature sums ψ(τ).

        Args:
          features: shape (n, D).
          number: at most so many draws in all, evenly spaced, but at least one a chain; None for all.

        Returns:
          shape (chain, draw, n), in the units of `weights`.

        Raises:
          ValueError: an estimate without a posterior, features of another length, or a number < 1.
        """
        if self.posterior is None:
            raise ValueError("draws: expected an estimate with a posterior, got one without")
        if features.ndim != 2 or features.shape[1] != len(self.weights):
            raise ValueError(f"features: expected shape (n, {len(self.weights)}), got {features.shape}")
        weights = self.posterior.children["posterior"].to_dataset()["utility_weights"]
        return weights[:, :: spacing(weights.shape[0] * weights.shape[1], number)].values @ features.T / self.scale

    def trajectory_draws(self, trajectories: Sequence[Trajectory], *, number: int | None = None) -> np.ndarray:
        """Posterior draws of wᵀψ(τ) of each trajectory, all chains' in one, shape (S, n); arguments of `draws`."""
        features = trajectory_features(trajectories, self.features, discount=self.discount)
        return self.draws(features, number=number).reshape(-1, len(trajectories))

    def state_draws(self, states: np.ndarray, *, number: int | None = None) -> np.ndarray:
        """Posterior draws of wᵀφ(s) of N states, all chains' in one, shape (S, N); `number` as of `draws`."""
        return self.draws(self.features(states), number=number).reshape(-1, len(states))

    def utilities_and_draws(self, states: np.ndarray, *, number: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """`utilities` and `state_draws` of N states, (N,) and (S, N), from one evaluation of the features."""
        features = self._same_width(self.features(states))
        return features @ self.weights, self.draws(features, number=number).reshape(-1, len(states))

    @property
    def likelihood(self) -> Likelihood:
        """Of the next answer, as a function of the difference of two utilities wᵀψ; needs a posterior."""
        if self.posterior is None:
            raise ValueError("likelihood: expected an estimate with a posterior, got one without")
        options = {name: self.posterior.attrs[name] for name in ("steepness", "lapse_rate")}
        return preference_likelihood(
            self.posterior.attrs["likelihood"], number_of_preferences=self.quality.pairs, **options
        )


@dataclass(frozen=True)
class KnownReward:
    """The environment's own reward in place of an estimate: the ceiling of every preference method."""

    quality: FitQuality

    def step_utilities(self, steps: Transitions) -> np.ndarray:
        return steps.rewards

    def trajectory_utilities(self, trajectories: Sequence[Trajectory]) -> np.ndarray:
        return np.array([trajectory.total_reward for trajectory in trajectories])


def compared(
    trajectories: Sequence[Trajectory], pairs: Sequence[tuple[int, int]]
) -> tuple[list[Trajectory], list[tuple[int, int]]]:
    """The trajectories that some pair names, or one where none does, and the pairs by their numbers among these."""
    numbers = sorted({number for pair in pairs for number in pair} or {0})
    row = {number: position for position, number in enumerate(numbers)}
    return [trajectories[number] for number in numbers], [(row[i], row[j]) for i, j in pairs]


def spacing(total: int, number: int | None) -> int:
    """How far apart at most `number` of `total` draws are, evenly spaced; 1 for None, which is all of them."""
    if number is not None and number < 1:
        raise ValueError(f"number: expected at least 1 draw, got {number}")
    return 1 if number is None else -(-total // number)


def scaled_differences(differences: np.ndarray) -> tuple[np.ndarray, float]:
    """Differences divided by their largest absolute entry, and that."""
    scale = float(np.max(np.abs(differences), initial=0.0)) or 1.0
    return differences / scale, scale


def estimate_utility(
    trajectories: Sequence[Trajectory],
    pairs: Sequence[tuple[int, int]],
    features: StateFeatures,
    *,
    method: str,
    discount: float,
    prior_scale: float = 1.0,
    steepness: float = 5.0,
    lapse_rate: float = 0.0,
    likelihood: str = "mixed",
    seed: int = 0,
) -> LinearUtility | KnownReward:
    """The utility that explains the answers.

    Decision: the differences ψ(preferred) − ψ(dominated) are divided once by their largest absolute entry before
    `prior_scale` and `steepness` apply; the weights come back in the units of the features.

    Args:
      trajectories: n of them.
      pairs: K ordered pairs (preferred, dominated) of their numbers.
      features: φ, (N, S) states to (N, D).
      method: `posterior-mean`, `most-likely`, `posterior-draw`, `linear-program` or `known-reward`.
      discount: γ of ψ.
      prior_scale, steepness, lapse_rate, likelihood: of the posterior.
      seed: of the sampler.

    Source: paper, eqs. 5-10.
    """
    if method == "known-reward":
        returns = np.array([trajectory.total_reward for trajectory in trajectories])
        satisfied = sum(bool(returns[i] > returns[j]) for i, j in pairs)
        return KnownReward(FitQuality(True, "known reward", len(pairs), satisfied))
    shown, pairs = compared(trajectories, pairs)
    return infer_utility(
        trajectory_features(shown, features, discount=discount),
        pairs,
        features=features,
        method=method,
        discount=discount,
        prior_scale=prior_scale,
        steepness=steepness,
        lapse_rate=lapse_rate,
        likelihood=likelihood,
        seed=seed,
    )


def infer_utility(
    feature_sums: np.ndarray,
    pairs: Sequence[tuple[int, int]],
    *,
    features: StateFeatures | None = None,
    method: str = "posterior-mean",
    discount: float = 0.98,
    prior_scale: float = 1.0,
    steepness: float = 5.0,
    lapse_rate: float = 0.0,
    likelihood: str = "mixed",
    seed: int = 0,
) -> LinearUtility:
    """The posterior without a learner: feature sums of anything that was compared, and the answers.

    Args:
      feature_sums: ψ of n trajectories, or the features of n items of any kind, shape (n, D).
      pairs: K ordered pairs (preferred, dominated) of their row numbers.
      features: φ, where utilities of single states are wanted too; the rows themselves otherwise.
      method: `posterior-mean`; `most-likely`; `posterior-draw`, one draw picked by `seed`, with what the answers do not
        touch at its mean, zero, where a draw of the prior would only be noise; or `linear-program`.
      discount, prior_scale, steepness, lapse_rate, likelihood, seed: as of `estimate_utility`.

    Raises:
      ValueError: a method there is not, feature sums that are no finite matrix, pairs that name no row.
    """
    feature_sums = np.asarray(feature_sums, dtype=np.float64)
    if feature_sums.ndim != 2 or not np.all(np.isfinite(feature_sums)):
        raise ValueError(f"feature_sums: expected a finite matrix (n, D), got shape {feature_sums.shape} or NaN")
    if method not in METHODS and method != "linear-program":
        raise ValueError(f"method: expected {', '.join(METHODS)} or linear-program, got {method!r}")
    features = _as_they_are if features is None else features
    differences = pair_differences(pairs, feature_sums)
    scaled, scale = scaled_differences(differences)
    if method == "linear-program":
        program = linear_program(scaled)
        satisfied = int(np.sum(differences @ program.weights > 0))
        quality = FitQuality(program.converged, program.status, len(pairs), satisfied)
        return LinearUtility(features, program.weights / scale, discount, quality, scale=scale)
    tree = sample_posterior(
        scaled,
        prior_scale=prior_scale,
        steepness=steepness,
        lapse_rate=lapse_rate,
        likelihood=likelihood,
        seed=seed,
    )
    weights = _weights(tree, method, seed) / scale
    quality = FitQuality(
        converged=bool(tree.attrs["converged"]),
        status="converged" if tree.attrs["converged"] else "the sampler did not converge within its cap of draws",
        pairs=len(pairs),
        pairs_satisfied=int(np.sum(differences @ weights > 0)),
        rhat_max=float(tree.attrs["rhat_max"]),
        effective_sample_size_min=float(tree.attrs["effective_sample_size_min"]),
        log_evidence=float(tree.attrs["log_evidence"]),
    )
    return LinearUtility(features, weights, discount, quality, tree, scale)


def _weights(tree: DataTree, method: str, seed: int) -> np.ndarray:
    """The weights, shape (D,), that stand for a posterior."""
    if method != "posterior-draw":
        return np.asarray(tree["utility_weights_" + method.removeprefix("posterior-").replace("-", "_")])
    z = np.asarray(tree["posterior"]["coordinates"])
    chain, draw = np.random.default_rng([seed, 1]).integers(z.shape[:2])
    return low_rank(np.asarray(tree["constant_data"]["differences"])).basis @ z[chain, draw]


def _as_they_are(features: np.ndarray) -> np.ndarray:
    return features
