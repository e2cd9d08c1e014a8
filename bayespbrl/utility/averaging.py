"""The utility averaged over what the answers leave open: its length scales and the steepness of the likelihood.

A few answers hardly tell "high is good" from "fast is good": the evidence of the length scales that say the one and of
those that say the other differ by a fraction of a nat, and whichever is largest would decide what is learnt next. Here
each setting of a grid counts with its posterior probability, p(setting | answers) ∝ p(answers | setting), and with
expectation propagation's Gaussian for the weights (Bayesian model averaging; Hoeting, Madigan, Raftery and Volinsky
1999).
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.special import softmax

from bayespbrl.models import PreferenceModel
from bayespbrl.models.posterior import GaussianFit, fit_gaussian
from bayespbrl.trajectories import Trajectory, trajectory_features
from bayespbrl.utility.estimate import LinearUtility, StateFeatures, compared, spacing
from bayespbrl.utility.hyperparameters import STEEPNESS_MULTIPLES, number_of_bandwidths, rescaled, rescaled_differences

# Of the bandwidths as given, in each state dimension; coarser than those that `evidence.choose_hyperparameters` climbs
# over, for an average has no need of a maximum.
BANDWIDTH_MULTIPLES = (0.5, 1.4, 4.0)
MOST_BANDWIDTHS = 27  # beyond three dimensions, so many points of the grid, drawn at random
LEAST_PROBABILITY = 0.004  # of the bandwidths that count
NUMBER_OF_DRAWS = 200
Table = Callable[[StateFeatures], np.ndarray]  # what one component's features are of: states, or trajectories


@dataclass(frozen=True, kw_only=True)
class AveragedUtility(LinearUtility):
    """A mixture over settings, round the one that the evidence speaks for most.

    What the learner acts on is the mixture's: `utilities`, `step_utilities`, `trajectory_utilities`, `state_draws`,
    `trajectory_draws`, `margin_draws` and `utilities_and_draws`; so is the number of pairs that it satisfies. All else
    is of that one setting, whose posterior was sampled and can be diagnosed: `likelihood` too, with the steepness and
    the lapse rate that the evidence chose, though the mixture's draws are of several and of the lapse rate as given.

    Attributes:
      base: φ as given.
      multiples: of its bandwidths, one row for each of C components, shape (C, S); S = 0 for features without any.
      probabilities: of the components, over all steepnesses, shape (C,), summing to 1.
      means: each component's expected weights times its probability, shape (C, D).
      components: of which component each draw is, shape (S,), in increasing order.
      weight_draws: draws of the weights in the mixture, shape (S, D).
    """

    base: StateFeatures
    multiples: np.ndarray
    probabilities: np.ndarray
    means: np.ndarray
    components: np.ndarray
    weight_draws: np.ndarray

    def utilities(self, states: np.ndarray) -> np.ndarray:
        """Expected utility of N states, shape (N,)."""
        return self._mixed(_of_states(states), slice(0))[0]

    def trajectory_utilities(self, trajectories: Sequence[Trajectory]) -> np.ndarray:
        return self._mixed(self._of_trajectories(trajectories), slice(0))[0]

    def state_draws(self, states: np.ndarray, *, number: int | None = None) -> np.ndarray:
        return self._mixed(_of_states(states), self._spaced(number))[1]

    def trajectory_draws(self, trajectories: Sequence[Trajectory], *, number: int | None = None) -> np.ndarray:
        return self._mixed(self._of_trajectories(trajectories), self._spaced(number))[1]

    def margin_draws(self, one: Trajectory, other: Trajectory) -> np.ndarray:
        """How much higher each draw puts `one`, shape (S,)."""
        draws = self.trajectory_draws([one, other])
        return draws[:, 0] - draws[:, 1]

    def utilities_and_draws(self, states: np.ndarray, *, number: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        return self._mixed(_of_states(states), self._spaced(number))

    def _of_trajectories(self, trajectories: Sequence[Trajectory]) -> Table:
        return lambda features: trajectory_features(trajectories, features, discount=self.discount)

    def _spaced(self, number: int | None) -> slice:
        return slice(None, None, spacing(len(self.components), number))

    def _mixed(self, table: Table, draws: slice) -> tuple[np.ndarray, np.ndarray]:
        """The mean for each of n rows of `table`, (n,), and some draws, (S, n): one pass over the components."""
        components, weights = self.components[draws], self.weight_draws[draws]
        means, drawn = [], []
        for component, multiples in enumerate(self.multiples):
            features = table(rescaled(self.base, multiples))
            means.append(features @ self.means[component])
            drawn.append(features @ weights[components == component].T)
        return np.sum(means, axis=0), np.hstack(drawn).T


def _of_states(states: np.ndarray) -> Table:
    return lambda features: features(states)


def average_utility(
    chosen: LinearUtility,
    trajectories: Sequence[Trajectory],
    pairs: Sequence[tuple[int, int]],
    features: StateFeatures,
    *,
    discount: float,
    prior_scale: float = PreferenceModel.prior_scale,
    steepness: float = PreferenceModel.steepness,
    lapse_rate: float = PreferenceModel.lapse_rate,
    likelihood: str = PreferenceModel.likelihood,
    seed: int = 0,
) -> AveragedUtility:
    """The mixture over all settings round `chosen`.

    Args:
      chosen: the estimate with the setting of highest evidence.
      trajectories, pairs, features, …: as of `evidence.choose_hyperparameters`; at least one pair.
      seed: of the draws, and of the settings where there are too many.
    """
    rng = np.random.default_rng([seed, 2])
    shown, rows = compared(trajectories, pairs)
    multiples = _grid(number_of_bandwidths(features), rng)
    fits: list[list[GaussianFit]] = []
    scales = []
    for row in multiples:
        differences, scale = rescaled_differences(shown, rows, features, row, discount=discount)
        scales.append(scale)
        fits.append([])
        for relative in STEEPNESS_MULTIPLES:
            model = PreferenceModel(prior_scale, steepness * relative, lapse_rate, likelihood)
            fits[-1].append(fit_gaussian(differences, model))
    weights = softmax([[fit.log_evidence for fit in row] for row in fits])
    counts = np.flatnonzero(weights.sum(axis=1) >= LEAST_PROBABILITY)
    weights = weights[counts] / weights[counts].sum()
    means = [
        sum(p * (fit.factors.basis @ fit.approximation.mean) for p, fit in zip(weights[c], fits[index], strict=True))
        / scales[index]
        for c, index in enumerate(counts)
    ]
    evenly = (np.arange(NUMBER_OF_DRAWS) + rng.random()) / NUMBER_OF_DRAWS
    settings = np.minimum(np.searchsorted(np.cumsum(weights), evenly), weights.size - 1)
    components, steepnesses = np.divmod(settings, len(STEEPNESS_MULTIPLES))
    draws = [_draw(fits[counts[c]][m], rng) / scales[counts[c]] for c, m in zip(components, steepnesses, strict=True)]
    # what each component expects of the margins, weighted: no features are needed again
    margins = sum(
        p * (fit.factors.loadings @ fit.approximation.mean)
        for c, index in enumerate(counts)
        for p, fit in zip(weights[c], fits[index], strict=True)
    )
    chosen = replace(chosen, quality=replace(chosen.quality, pairs_satisfied=int(np.sum(margins > 0))))
    return AveragedUtility(
        **{field.name: getattr(chosen, field.name) for field in fields(chosen)},
        base=features,
        multiples=multiples[counts],
        probabilities=weights.sum(axis=1),
        means=np.array(means),
        components=components,
        weight_draws=np.array(draws, dtype=np.float32),  # kept on disk; half of float64, and read back as they are
    )


def _grid(dimensions: int, rng: np.random.Generator) -> np.ndarray:
    """Multiples of the bandwidths, one row a component: the grid, or some of a large one."""
    if len(BANDWIDTH_MULTIPLES) ** dimensions <= MOST_BANDWIDTHS:
        grid = list(itertools.product(BANDWIDTH_MULTIPLES, repeat=dimensions))
        return np.array(grid).reshape(len(grid), dimensions)
    return np.unique(rng.choice(BANDWIDTH_MULTIPLES, size=(MOST_BANDWIDTHS, dimensions)), axis=0)


def _draw(fit: GaussianFit, rng: np.random.Generator) -> np.ndarray:
    """One draw of the weights, shape (D,): what the answers do not touch keeps its prior."""
    basis, approximation = fit.factors.basis, fit.approximation
    values, directions = np.linalg.eigh(approximation.covariance)
    z = approximation.mean + directions @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values)))
    noise = fit.prior_scale * rng.standard_normal(len(basis))
    return basis @ (z - basis.T @ noise) + noise
