"""Step 1, preference-based inverse reinforcement learning: from answers to an estimate of the utility (eqs. 5-10)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from xarray import DataTree

from bayespbrl import checks
from bayespbrl.features import StateFeatures
from bayespbrl.models import PreferenceModel, linear_program, posterior_draws
from bayespbrl.models.low_rank import low_rank
from bayespbrl.preferences import pair_differences
from bayespbrl.utility.averaging import average_utility
from bayespbrl.utility.comparisons import Comparisons, scaled_differences
from bayespbrl.utility.estimate import UtilityEstimate
from bayespbrl.utility.hyperparameters import HyperparameterChoice, choose_hyperparameters
from bayespbrl.utility.point_estimates import KnownReward, LinearProgramUtility
from bayespbrl.utility.posterior_utility import PosteriorUtility
from bayespbrl.utility.quality import FitQuality

POSTERIOR_METHODS = ("posterior-mean", "most-likely", "posterior-draw")
WITHOUT_POSTERIOR = ("linear-program", "known-reward")
METHODS = (*POSTERIOR_METHODS, *WITHOUT_POSTERIOR)


@dataclass(frozen=True)
class Estimation:
    """How the utility is estimated in each iteration.

    Attributes:
      utility: the method, one of `METHODS`; `known-reward` is the hidden reward itself, for reference runs.
      hyperparameters: `evidence` chooses length scales, steepness and lapse rate by the marginal likelihood of the
        answers, beginning at the given ones; `averaged` averages over length scales and steepness; `given` keeps all.
      trajectory_discount: γ of ψ(τ) in the answers; None for the critic's, as in the paper; 1 for an expert who judges
        whole trajectories.
    """

    utility: str = "posterior-mean"
    hyperparameters: str = "evidence"
    trajectory_discount: float | None = None

    def __post_init__(self) -> None:
        checks.one_of("utility", self.utility, METHODS)
        checks.one_of("hyperparameters", self.hyperparameters, ("evidence", "given", "averaged"))
        if self.trajectory_discount is not None:
            checks.share("trajectory_discount", self.trajectory_discount)
        if self.hyperparameters == "averaged" and self.utility != "posterior-mean":
            raise ValueError(f"utility: expected posterior-mean with averaged hyperparameters, got {self.utility!r}")


def estimate(
    comparisons: Comparisons, features: StateFeatures, options: Estimation, model: PreferenceModel, *, seed: int
) -> tuple[UtilityEstimate, HyperparameterChoice | None]:
    """The utility by the chosen method, with its hyperparameters, and the choice of these where there was one.

    Args:
      comparisons: the answers.
      features: φ as given.
      options: method and hyperparameters.
      model: prior and likelihood as given.
      seed: of everything random.
    """
    choice, fitted = None, (features, model)
    if options.hyperparameters != "given" and options.utility != "known-reward":
        choice = choose_hyperparameters(comparisons, features, model)
        fitted = (choice.features, choice.model)
    utility = estimate_utility(comparisons, *fitted, method=options.utility, seed=seed)
    if options.hyperparameters == "averaged" and comparisons.pairs and isinstance(utility, PosteriorUtility):
        return average_utility(utility, comparisons, features, model=model, seed=seed), choice
    return utility, choice


def estimate_utility(
    comparisons: Comparisons, features: StateFeatures, model: PreferenceModel, *, method: str, seed: int = 0
) -> PosteriorUtility | LinearProgramUtility | KnownReward:
    """The utility that explains the answers, under one setting; weights in the units of the features.

    Args:
      comparisons: the answers.
      features: φ, (N, S) states to (N, D).
      model: prior and likelihood.
      method: one of `METHODS`.
      seed: of the sampler.

    Source: paper, eqs. 5-10.
    """
    if method == "known-reward":
        returns = np.array([trajectory.total_reward for trajectory in comparisons.trajectories])
        satisfied = sum(bool(returns[i] > returns[j]) for i, j in comparisons.pairs)
        return KnownReward(FitQuality(True, "known reward", len(comparisons.pairs), satisfied))
    return _fitted(comparisons.feature_sums(features), comparisons, features, model, method, seed)


def infer_utility(
    feature_sums: ArrayLike,
    pairs: Sequence[tuple[int, int]],
    *,
    features: StateFeatures | None = None,
    method: str = "posterior-mean",
    discount: float = 0.98,
    prior_scale: float = PreferenceModel.prior_scale,
    steepness: float = PreferenceModel.steepness,
    lapse_rate: float = PreferenceModel.lapse_rate,
    likelihood: str = PreferenceModel.likelihood,
    seed: int = 0,
) -> PosteriorUtility | LinearProgramUtility:
    """The posterior without a learner, from feature sums of anything that was compared, and the answers.

    Args:
      feature_sums: ψ of n trajectories, or the features of n items of any kind, shape (n, D).
      pairs: K ordered pairs (preferred, dominated) of their row numbers.
      features: φ, where utilities of single states are wanted too; None: the rows themselves.
      method: `posterior-mean`; `most-likely`; `posterior-draw`, one draw picked by `seed`, with directions that the
        answers do not touch at their mean, zero; or `linear-program`.
      discount: γ of ψ, for trajectories that the estimate is asked about later.
      prior_scale, steepness, lapse_rate, likelihood: as of `PreferenceModel`.
      seed: of the sampler.

    Raises:
      ValueError: an unknown method, feature sums that are no finite matrix, pairs that name no row.
    """
    checks.one_of("method", method, (*POSTERIOR_METHODS, "linear-program"))
    model = PreferenceModel(prior_scale, steepness, lapse_rate, likelihood)
    comparisons = Comparisons((), tuple(pairs), discount)
    return _fitted(
        checks.matrix("feature_sums", feature_sums),
        comparisons,
        _as_they_are if features is None else features,
        model,
        method,
        seed,
    )


def _fitted(
    feature_sums: np.ndarray,
    comparisons: Comparisons,
    features: StateFeatures,
    model: PreferenceModel,
    method: str,
    seed: int,
) -> PosteriorUtility | LinearProgramUtility:
    """The posterior or the linear program from ψ of the trajectories, (n, D)."""
    checks.one_of("method", method, (*POSTERIOR_METHODS, "linear-program"))
    checks.finite("feature_sums", feature_sums)
    pairs, discount = comparisons.pairs, comparisons.discount
    differences = pair_differences(pairs, feature_sums)
    scaled, scale = scaled_differences(differences)
    if method == "linear-program":
        program = linear_program(scaled)
        satisfied = int(np.sum(differences @ program.weights > 0))
        quality = FitQuality(program.converged, program.status, len(pairs), satisfied)
        return LinearProgramUtility(features, program.weights / scale, discount, quality, scale)
    tree = posterior_draws(scaled, model, seed=seed)
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
    return PosteriorUtility(features, weights, discount, quality, tree, scale)


def _weights(tree: DataTree, method: str, seed: int) -> np.ndarray:
    """The weights, shape (D,), that stand for a posterior."""
    if method != "posterior-draw":
        return np.asarray(tree["utility_weights_" + method.removeprefix("posterior-").replace("-", "_")])
    z = np.asarray(tree["posterior"]["coordinates"])
    chain, draw = np.random.default_rng([seed, 1]).integers(z.shape[:2])
    return low_rank(np.asarray(tree["constant_data"]["differences"])).basis @ z[chain, draw]


def _as_they_are(features: np.ndarray) -> np.ndarray:
    return features
