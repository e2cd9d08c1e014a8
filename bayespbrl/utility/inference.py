"""Step 1, preference-based inverse reinforcement learning: from answers to an estimate of the utility (eqs. 5-10)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from xarray import DataTree

from bayespbrl import checks
from bayespbrl.features import DiffusionBasis, OwnFeatures, RadialBasis, StateFeatures, ranges
from bayespbrl.models import Answers, PreferenceModel, linear_program, plain_chain, plain_draws, posterior_draws
from bayespbrl.models.posterior_tree import bases_of
from bayespbrl.preferences import known_pairs
from bayespbrl.trajectories import DISCOUNT
from bayespbrl.utility.comparisons import Comparisons, normalised
from bayespbrl.utility.estimate import UtilityEstimate
from bayespbrl.utility.length_scales import bandwidth_multiples, sums_under
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
      hyperparameters: `inferred`: the length scales of the features are part of the posterior, and so are steepness and
        lapse rate unless they are set; `given` keeps all.
      trajectory_discount: γ of ψ(τ) in the answers; 1 for an expert who judges whole trajectories; None for the
        critic's, as in the paper.
      plain_draws: moves of the paper's sampler, one chain without a check of convergence (`models.plain_chain`), which
        leaves ties out; None: chains until they converge.
    """

    utility: str = "posterior-mean"
    hyperparameters: str = "inferred"
    trajectory_discount: float | None = 1.0
    plain_draws: int | None = None

    def __post_init__(self) -> None:
        checks.one_of("utility", self.utility, METHODS)
        checks.one_of("hyperparameters", self.hyperparameters, ("inferred", "given"))
        checks.optional(checks.share, "trajectory_discount", self.trajectory_discount)
        if self.plain_draws is not None:
            checks.whole("plain_draws", self.plain_draws, plain_chain.LEAST)
            if self.hyperparameters != "given":
                raise ValueError(f"hyperparameters: expected 'given' with plain_draws, got {self.hyperparameters!r}")


def estimate(
    comparisons: Comparisons, features: StateFeatures, options: Estimation, model: PreferenceModel, *, seed: int
) -> UtilityEstimate:
    """The utility by the chosen method.

    Args:
      comparisons: the answers.
      features: φ as given.
      options: method and hyperparameters.
      model: prior and likelihood.
      seed: of everything random.

    Source: paper, eqs. 5-10.
    """
    if options.utility == "known-reward":
        returns = np.array([trajectory.total_reward for trajectory in comparisons.trajectories])
        ordered = [pair for pair, stated in zip(comparisons.pairs, comparisons.ordered, strict=True) if stated]
        satisfied = sum(bool(returns[i] > returns[j]) for i, j in ordered)  # eq. 6
        return KnownReward(FitQuality(True, "known reward", len(ordered), satisfied))
    if options.utility == "linear-program":
        return _by_linear_program(comparisons.feature_sums(features), comparisons, features)
    rng = np.random.default_rng([seed, 2])
    multiples = bandwidth_multiples(features, inferred=options.hyperparameters == "inferred", rng=rng)
    sums = sums_under(features, multiples, comparisons.trajectories, discount=comparisons.discount)
    method, plain = options.utility, options.plain_draws
    return _by_posterior(sums, multiples, comparisons, features, method, model, seed, plain)


def infer_utility(
    feature_sums: ArrayLike,
    pairs: Sequence[tuple[int, int]],
    *,
    ties: Sequence[tuple[int, int]] = (),
    shown_first: ArrayLike | None = None,
    answerers: ArrayLike | None = None,
    features: StateFeatures | None = None,
    method: str = "posterior-mean",
    discount: float = DISCOUNT,
    prior_scale: float = PreferenceModel.prior_scale,
    steepness: float | None = None,
    lapse_rate: float | None = None,
    likelihood: str = PreferenceModel.likelihood,
    tie_threshold: float | None = None,
    scaled: bool = False,
    seed: int = 0,
) -> PosteriorUtility | LinearProgramUtility:
    """The posterior without a learner, from feature sums of anything that was compared, and the answers.

    Args:
      feature_sums: ψ of n trajectories, or the features of n items of any kind, shape (n, D).
      pairs: ordered pairs (preferred, dominated) of their row numbers.
      ties: pairs that were answered with "no difference". There are K pairs and ties in all.
      shown_first: 1 where the first of the pair was shown first, −1 where the second was, 0 where nothing is known,
        shape (K,), for the pairs and then the ties: a side bias is inferred. None: there is none.
      answerers: who gave each answer, by names or whole numbers (the name of 7 is "7"), in the same order:
        each has a lapse rate and, with `shown_first`, a side bias. `posterior["posterior"]["lapse_rate"].sel(
        answerer="Ada")` are the draws of one.
      features: φ, where utilities of single states are wanted too; None: the rows themselves.
      method: `posterior-mean`; `most-likely`; `posterior-draw`, one draw picked by `seed`, with directions that the
        answers do not touch at their mean, zero; or `linear-program`, which leaves ties out.
      discount: γ of ψ, for trajectories that the estimate is asked about later.
      prior_scale: σ > 0 of the weights of features divided by `scales`: then the differences have a root mean square
        length of 1. Steepness and threshold are in these units too.
      likelihood: `mixed` (eq. 8), `logistic` or `probit`.
      steepness, lapse_rate, tie_threshold: None: inferred, the threshold where there are ties.
      scaled: whether each of the D columns is divided by its range over the n rows, and φ with it: for columns in
        different units, of which a priori the largest would decide. Without, all weights are alike a priori (eq. 7) in
        the units of the columns.
      seed: of the sampler.

    Returns:
      the estimate; its `weights` are in the units of its `features`, the given ones or with `scaled` the divided ones.
      The draws of `utility_weights` in its `posterior` are of these divided by its `scales`, and so are the differences
      that `bayespbrl.diagnostics` take.

    Raises:
      ValueError: an unknown method, feature sums that are no finite matrix, pairs that name no row, and any other
        argument that is not as above, whether the method uses it or not.
    """
    checks.one_of("method", method, (*POSTERIOR_METHODS, "linear-program"))
    checks.seed(seed)
    sums = checks.matrix("feature_sums", feature_sums)
    if not sums.shape[1]:
        raise ValueError(f"feature_sums: expected shape (n, D >= 1), got {sums.shape}")
    every = np.concatenate([known_pairs("pairs", pairs, len(sums)), known_pairs("ties", ties, len(sums))])
    tied = np.arange(len(every)) >= len(pairs)
    answers = Answers(tied if tied.any() else None, shown_first, answerers).checked(len(every))
    numbers = tuple((first, second) for first, second in every.tolist())
    comparisons = Comparisons((), numbers, checks.share("discount", discount), answers)
    chosen = _as_they_are if features is None else _checking(features)
    if checks.boolean("scaled", scaled):
        if isinstance(features, RadialBasis | DiffusionBasis):
            raise ValueError(f"scaled: expected false with {type(features).__name__}, which has no units, got true")
        units = ranges(sums)
        chosen, sums = OwnFeatures(chosen, tuple(units.tolist())), sums / units
    model = PreferenceModel(prior_scale, steepness, lapse_rate, likelihood, tie_threshold)
    if method == "linear-program":
        model.check_threshold(1.0)  # as `posterior_draws` does, of differences that are normalised
        return _by_linear_program(sums, comparisons, chosen)
    unscaled = bandwidth_multiples(chosen, inferred=False, rng=np.random.default_rng(0))
    return _by_posterior([sums], unscaled, comparisons, chosen, method, model, seed)


def _by_linear_program(
    feature_sums: np.ndarray, comparisons: Comparisons, features: StateFeatures
) -> LinearProgramUtility:
    """The utility by eq. 10, from ψ of the trajectories, (n, D)."""
    checks.finite("feature_sums", feature_sums)
    scaled, scale = normalised(comparisons.differences(feature_sums)[comparisons.ordered])
    program = linear_program(scaled)
    satisfied = int(np.sum(scaled @ program.weights > 0))  # eq. 6
    quality = FitQuality(program.converged, program.status, len(scaled), satisfied)
    return LinearProgramUtility(features, program.weights / scale, comparisons.discount, quality, scale)


def _by_posterior(
    feature_sums: Sequence[np.ndarray],
    multiples: np.ndarray,
    comparisons: Comparisons,
    features: StateFeatures,
    method: str,
    model: PreferenceModel,
    seed: int,
    plain: int | None = None,
) -> PosteriorUtility:
    """The utility by eqs. 7-8, from ψ of the trajectories under each setting, (n, D)."""
    for each in feature_sums:
        checks.finite("feature_sums", each)
    scaled = [normalised(comparisons.differences(each)) for each in feature_sums]
    differences, scales = np.array([each for each, _ in scaled]), np.array([scale for _, scale in scaled])
    if plain is None:
        tree = posterior_draws(differences, model, seed=seed, answers=comparisons.answers)
    else:
        ordered = comparisons.ordered  # a row of zeros has no say
        known = np.where(ordered[:, None], differences, 0.0)
        tree = plain_draws(known, model, draws=plain, seed=seed, number_of_preferences=int(ordered.sum()))
    parts = _parts(tree, method, seed)
    margins = np.einsum("ckd,cd->k", differences, parts)  # eq. 5
    quality = FitQuality(
        converged=bool(tree.attrs["converged"]),
        status="converged" if tree.attrs["converged"] else "the sampler did not converge within its cap of draws",
        pairs=int(comparisons.ordered.sum()),
        pairs_satisfied=int(np.sum(margins[comparisons.ordered] > 0)),  # eq. 6
        rhat_max=float(tree.attrs["rhat_max"]),
        effective_sample_size_min=float(tree.attrs["effective_sample_size_min"]),
        log_evidence=float(tree.attrs["log_evidence"] if np.isfinite(tree.attrs["log_evidence_error"]) else np.nan),
    )
    return PosteriorUtility(features, multiples, scales, parts / scales[:, None], comparisons.discount, quality, tree)


def _parts(tree: DataTree, method: str, seed: int) -> np.ndarray:
    """The weights of each setting, shape (C, D), whose functions add up to the utility that is acted on."""
    if method != "posterior-draw":
        return np.asarray(tree["utility_weights_" + method.removeprefix("posterior-").replace("-", "_")])
    z, numbers = np.asarray(tree["posterior"]["coordinates"]), np.asarray(tree["posterior"]["setting"])
    chain, draw = np.random.default_rng([seed, 1]).integers(z.shape[:2])
    parts = np.zeros(tree["utility_weights_mean"].shape)
    basis = bases_of(tree)[numbers[chain, draw]]
    parts[numbers[chain, draw]] = (basis @ z[chain, draw, : basis.shape[1]])[: parts.shape[1]]
    return parts


def _as_they_are(states: np.ndarray) -> np.ndarray:
    return checks.matrix("states", states)


def _checking(features: StateFeatures) -> StateFeatures:
    """φ of the user's with its values checked; ours check themselves, and their bandwidths are read."""
    checks.function("features", features, " of states (N, S)")
    return features if isinstance(features, RadialBasis | DiffusionBasis) else OwnFeatures(features)
