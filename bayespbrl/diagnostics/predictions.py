"""Posterior predictive probabilities of answers that the posterior was not fitted to, by exact refits (eqs. 7-8).

Eq. 8 depends on the number of preferences K. Decision: each refit keeps the K of all answers. All refits then belong to
one model: the log probabilities of the answers, each given those before it, sum to its log marginal likelihood.
"""

from dataclasses import fields, replace

import numpy as np
import xarray as xr
from scipy.special import ndtr

from bayespbrl import checks
from bayespbrl.models import PreferenceModel, posterior_draws
from bayespbrl.models.likelihoods import ProbitMixture
from bayespbrl.models.low_rank import low_rank
from bayespbrl.models.posterior import SamplerOptions

PREFERRED, DOMINATED, TIED = 0, 1, 2


def answer_probabilities(tree: xr.DataTree, differences: np.ndarray) -> np.ndarray:
    """Probability of each possible answer to comparisons that the posterior was not fitted to.

    Only the part of a difference in the span of the fitted ones is averaged over draws. The utility of the rest has the
    prior's normal distribution and is integrated exactly.

    Args:
      tree: what `sample_posterior` returned.
      differences: ψ(one) − ψ(other) of n comparisons, in the units of the fitted differences, shape (n, D).

    Returns:
      shape (n, 3): the one is preferred, the other is preferred, no difference (0 without a tie threshold).

    Raises:
      ValueError: differences of another shape or not finite.
    """
    known = np.asarray(tree["constant_data"]["differences"])
    differences = checks.matrix("differences", differences, columns=known.shape[1])
    z = np.asarray(tree["posterior"]["coordinates"])
    draws = z.reshape(z.shape[0] * z.shape[1], z.shape[2])
    return _probabilities(draws, low_rank(known).basis, differences, fitted_model(tree), number_of_preferences(tree))


def held_out_probabilities(
    differences: np.ndarray,
    model: PreferenceModel,
    used: np.ndarray,
    asked: np.ndarray,
    *,
    indifferent: np.ndarray | None = None,
    number_of_preferences: int | None = None,
    **sampling_options: int,
) -> tuple[np.ndarray, bool]:
    """Fit a model to some rows of `differences` and predict the answers of others.

    Args:
      differences: shape (K, D).
      model: prior and likelihood.
      used, asked: the fitted rows and the n predicted ones: bool (K,), or row numbers.
      indifferent: rows with the answer "no difference", shape (K,) bool.
      number_of_preferences: K of eq. 8; all rows by default.
      sampling_options: `seed`, `num_samples` and the like of `sample_posterior`.

    Returns:
      `answer_probabilities` (n, 3) of the asked rows, and whether the sampler converged.
    """
    known, number = differences[used], len(differences) if number_of_preferences is None else number_of_preferences
    if len(known) == 0:  # the prior: no draws are needed
        nothing = np.zeros((1, 0)), np.zeros((differences.shape[1], 0))
        return _probabilities(*nothing, differences[asked], model, number), True
    tree = _fit(known, model, None if indifferent is None else indifferent[used], number, **sampling_options)
    return answer_probabilities(tree, differences[asked]), bool(tree.attrs["converged"])


def refit(tree: xr.DataTree, used: np.ndarray, **sampling_options: int) -> xr.DataTree:
    """The posterior of the same model given only the answers `used`, shape (K,) bool; eq. 8 keeps its K.

    `sampling_options` are `seed`, `num_samples` and the like of `sample_posterior`; the seed is the tree's by default.
    """
    known = np.asarray(tree["constant_data"]["differences"])[used]
    options = {"seed": int(tree.attrs["seed"]), **sampling_options}
    return _fit(known, fitted_model(tree), tied_rows(tree)[used], number_of_preferences(tree), **options)


def fitted_model(tree: xr.DataTree) -> PreferenceModel:
    """The model that a tree's draws are from."""
    options = {field.name: tree.attrs[field.name] for field in fields(PreferenceModel)}
    no_ties = np.isnan(options["tie_threshold"])
    return PreferenceModel(**options | ({"tie_threshold": None} if no_ties else {}))


def number_of_preferences(tree: xr.DataTree) -> int:
    """K of eq. 8 in a tree's model."""
    return int(tree.attrs["number_of_preferences"])


def tied_rows(tree: xr.DataTree) -> np.ndarray:
    """Rows with the answer "no difference", shape (K,) bool."""
    return np.asarray(tree["observed_data"]["answers"]) == 0


def answer_groups(groups: np.ndarray | None, number: int) -> np.ndarray:
    """The number of the answer that each of K rows follows from, shape (K,): 0 … K−1 by default.

    Raises:
      ValueError: numbers that are no integers, of another shape, or that decrease.
    """
    if groups is None:
        return np.arange(number)
    groups = np.asarray(groups)
    if groups.shape != (number,) or not np.issubdtype(groups.dtype, np.integer) or np.any(np.diff(groups) < 0):
        raise ValueError(f"groups: expected {number} integers that never decrease, got {groups}")
    return groups


def _fit(
    known: np.ndarray, model: PreferenceModel, tied: np.ndarray | None, number: int, *, seed: int = 0, **sampler: int
) -> xr.DataTree:
    tied = None if model.tie_threshold is None else tied
    options = SamplerOptions(**sampler)
    return posterior_draws(known, model, seed=seed, indifferent=tied, number_of_preferences=number, sampler=options)


def _probabilities(
    coordinates: np.ndarray, basis: np.ndarray, differences: np.ndarray, model: PreferenceModel, number: int
) -> np.ndarray:
    mixture = replace(model, tie_threshold=None).answer_likelihood(number).probit_mixture()
    inside = differences @ basis
    # the margin given z is normal: mean z·inside, and the prior's spread in the directions outside the basis
    spread = model.prior_scale * np.linalg.norm(differences - inside @ basis.T, axis=1)
    shift = 0.0 if model.tie_threshold is None else model.tie_threshold
    probabilities = np.empty((len(differences), 3))
    for k, (row, sd) in enumerate(zip(inside, spread, strict=True)):
        margins = coordinates @ row
        probabilities[k, PREFERRED] = np.mean(_smoothed(mixture, margins - shift, sd))
        probabilities[k, DOMINATED] = np.mean(_smoothed(mixture, -margins - shift, sd))
    probabilities[:, TIED] = 0.0 if model.tie_threshold is None else 1 - probabilities[:, :TIED].sum(axis=1)
    return probabilities


def _smoothed(mixture: ProbitMixture, margins: np.ndarray, sd: float) -> np.ndarray:
    """E p(t) over t ~ N(margins, sd²): each probit of the mixture stays one, with scale √(h² + sd²)."""
    total = np.full(margins.shape, float(mixture.constant))
    for weight, offset, scale in zip(mixture.weights, mixture.offsets, mixture.scales, strict=True):
        width = np.hypot(scale, sd)
        total += weight * (ndtr((margins - offset) / width) if width > 0 else (1 + np.sign(margins - offset)) / 2)
    return total
