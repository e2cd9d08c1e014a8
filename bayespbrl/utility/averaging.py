"""The utility averaged over length scales and steepness by their posterior probability (Bayesian model averaging).

A few answers hardly tell "high is good" from "fast is good": the marginal likelihoods of the length scales that say the
one and the other differ by a fraction of a nat. Here each setting of a grid counts with its posterior probability,
p(setting | answers) ∝ p(answers | setting), and with expectation propagation's Gaussian for the weights (Hoeting,
Madigan, Raftery and Volinsky 1999).
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.special import softmax

from bayespbrl.features import StateFeatures
from bayespbrl.models import PreferenceModel
from bayespbrl.models.gaussian_fit import GaussianFit, fit_gaussian
from bayespbrl.models.likelihoods import Likelihood
from bayespbrl.trajectories import Trajectory, Transitions, trajectory_features
from bayespbrl.utility.comparisons import Comparisons, number_of_bandwidths, rescaled
from bayespbrl.utility.hyperparameters import STEEPNESS_MULTIPLES
from bayespbrl.utility.posterior_utility import PosteriorUtility, spacing
from bayespbrl.utility.quality import FitQuality

# Of the bandwidths as given, in each state dimension; coarser than the grid of `choose_hyperparameters`, because an
# average needs no maximum.
BANDWIDTH_MULTIPLES = (0.5, 1.4, 4.0)
MOST_BANDWIDTHS = 27  # beyond three dimensions, so many points of the grid, drawn at random
LEAST_PROBABILITY = 0.004  # of the bandwidths that count
NUMBER_OF_DRAWS = 200
Table = Callable[[StateFeatures], np.ndarray]  # the features of one component: of states, or of trajectories


@dataclass(frozen=True)
class AveragedUtility:
    """A mixture of Gaussians over settings.

    Utilities and draws are the mixture's. `sampled` is the posterior of one setting, the one of highest marginal
    likelihood: `quality` reports its convergence, and `likelihood` has its steepness and lapse rate, though the
    mixture's draws have several steepnesses and the lapse rate as given.

    Attributes:
      sampled: the posterior of the setting of highest marginal likelihood.
      quality: the convergence of `sampled`, and the pairs that the mixture satisfies.
      base: φ as given.
      multiples: of its bandwidths, one row for each of C components, shape (C, S); S = 0 for features without any.
      probabilities: of the components, over all steepnesses, shape (C,), summing to 1.
      means: each component's expected weights times its probability, shape (C, D).
      components: of which component each draw is, shape (S,), in increasing order.
      weight_draws: draws of the weights in the mixture, shape (S, D).
    """

    sampled: PosteriorUtility
    quality: FitQuality
    base: StateFeatures
    multiples: np.ndarray
    probabilities: np.ndarray
    means: np.ndarray
    components: np.ndarray
    weight_draws: np.ndarray

    @property
    def likelihood(self) -> Likelihood:
        """Of the next answer under the sampled setting, as a function of the difference of two utilities."""
        return self.sampled.likelihood

    def utilities(self, states: np.ndarray) -> Float[np.ndarray, " n"]:
        """Expected utility of n states."""
        return self._mixed(_of_states(states), slice(0))[0]

    def step_utilities(self, steps: Transitions) -> Float[np.ndarray, " n"]:
        """Expected utility of the next state of each transition."""
        return self.utilities(steps.next_states)

    def utilities_and_draws(
        self, states: np.ndarray, *, number: int | None = None
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "s n"]]:
        """Expected utility of n states and draws of it, in one pass over the components."""
        return self._mixed(_of_states(states), self._spaced(number))

    def trajectory_utilities(self, trajectories: Sequence[Trajectory]) -> Float[np.ndarray, " n"]:
        """Expected utility of each trajectory."""
        return self._mixed(self._of_trajectories(trajectories), slice(0))[0]

    def trajectory_draws(
        self, trajectories: Sequence[Trajectory], *, number: int | None = None
    ) -> Float[np.ndarray, "s n"]:
        """Draws of the utility of each trajectory."""
        return self._mixed(self._of_trajectories(trajectories), self._spaced(number))[1]

    def margin_draws(self, first: Trajectory, second: Trajectory) -> Float[np.ndarray, " s"]:
        """By how much each draw prefers the first."""
        draws = self.trajectory_draws([first, second])
        return draws[:, 0] - draws[:, 1]

    def _of_trajectories(self, trajectories: Sequence[Trajectory]) -> Table:
        return lambda features: trajectory_features(trajectories, features, discount=self.sampled.discount)

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
    sampled: PosteriorUtility,
    comparisons: Comparisons,
    features: StateFeatures,
    *,
    model: PreferenceModel,
    seed: int = 0,
) -> AveragedUtility:
    """The mixture over all settings.

    Args:
      sampled: the posterior of the setting of highest marginal likelihood.
      comparisons: at least one pair.
      features, model: as given; the grid multiplies their bandwidths and steepness.
      seed: of the draws, and of the settings where there are too many.
    """
    rng = np.random.default_rng([seed, 2])
    multiples = _grid(number_of_bandwidths(features), rng)
    fits: list[list[GaussianFit]] = []
    scales = []
    for row in multiples:
        differences, scale = comparisons.scaled_differences(rescaled(features, row))
        models = [replace(model, steepness=model.steepness * relative) for relative in STEEPNESS_MULTIPLES]
        fits.append([fit_gaussian(differences, each) for each in models])
        scales.append(scale)
    weights = softmax([[fit.log_evidence for fit in row] for row in fits])
    counts = np.flatnonzero(weights.sum(axis=1) >= LEAST_PROBABILITY)
    weights, fits, scales = (
        weights[counts] / weights[counts].sum(),
        [fits[c] for c in counts],
        [scales[c] for c in counts],
    )
    components, draws = _draws(weights, fits, scales, rng)
    # the margins that each component expects, weighted: no features are needed again
    margins = sum(
        p * (fit.factors.loadings @ fit.approximation.mean)
        for row, of_row in zip(weights, fits, strict=True)
        for p, fit in zip(row, of_row, strict=True)
    )
    return AveragedUtility(
        sampled=sampled,
        quality=replace(sampled.quality, pairs_satisfied=int(np.sum(margins > 0))),
        base=features,
        multiples=multiples[counts],
        probabilities=weights.sum(axis=1),
        means=np.array([_mean(row, of_row) / scale for row, of_row, scale in zip(weights, fits, scales, strict=True)]),
        components=components,
        weight_draws=draws.astype(np.float32),  # kept on disk; half of float64, and read back as they are
    )


def _mean(probabilities: np.ndarray, fits: Sequence[GaussianFit]) -> np.ndarray:
    """Expected weights under some settings, each times its probability; shape (D,)."""
    parts = [p * (fit.factors.basis @ fit.approximation.mean) for p, fit in zip(probabilities, fits, strict=True)]
    return np.asarray(sum(parts))


def _draws(
    weights: np.ndarray, fits: Sequence[Sequence[GaussianFit]], scales: Sequence[float], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draws of the weights in the mixture, (S, D), and the component of each, (S,), in increasing order."""
    evenly = (np.arange(NUMBER_OF_DRAWS) + rng.random()) / NUMBER_OF_DRAWS
    settings = np.minimum(np.searchsorted(np.cumsum(weights), evenly), weights.size - 1)
    components, steepnesses = np.divmod(settings, weights.shape[1])
    draws = [_draw(fits[c][m], rng) / scales[c] for c, m in zip(components, steepnesses, strict=True)]
    return components, np.array(draws)


def _grid(dimensions: int, rng: np.random.Generator) -> np.ndarray:
    """Multiples of the bandwidths, one row a component: the grid, or some of a large one."""
    if len(BANDWIDTH_MULTIPLES) ** dimensions <= MOST_BANDWIDTHS:
        grid = list(itertools.product(BANDWIDTH_MULTIPLES, repeat=dimensions))
        return np.array(grid).reshape(len(grid), dimensions)
    return np.unique(rng.choice(BANDWIDTH_MULTIPLES, size=(MOST_BANDWIDTHS, dimensions)), axis=0)


def _draw(fit: GaussianFit, rng: np.random.Generator) -> np.ndarray:
    """One draw of the weights, shape (D,): directions that the answers do not touch keep their prior."""
    basis, approximation = fit.factors.basis, fit.approximation
    values, directions = np.linalg.eigh(approximation.covariance)
    z = approximation.mean + directions @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values)))
    noise = fit.model.prior_scale * rng.standard_normal(len(basis))
    return basis @ (z - basis.T @ noise) + noise
