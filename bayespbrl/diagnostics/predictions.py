"""What a posterior predicts for comparisons that it was not told the answers of, by exact refits (eqs. 7-8).

Eq. 8 depends on the number of preferences K. Decision: K stays that of all answers however few a refit uses, so that
all refits belong to one model: the log probabilities of the answers, each given those before it, sum to its evidence.
"""

from inspect import signature
from typing import Any

import numpy as np
import xarray as xr
from scipy.special import ndtr

# the package and not its function: `models` imports `diagnostics.convergence`, and may be half loaded at this line
from bayespbrl import models
from bayespbrl.models.likelihoods import ProbitMixture, preference_likelihood
from bayespbrl.models.low_rank import low_rank

PREFERRED, DOMINATED, TIED = 0, 1, 2
_MODEL_OPTIONS = ("prior_scale", "steepness", "lapse_rate", "likelihood", "tie_threshold")


def answer_probabilities(tree: xr.DataTree, differences: np.ndarray) -> np.ndarray:
    """Probability of each possible answer to comparisons that the posterior was not fitted to.

    The part of a difference outside those that were fitted is integrated exactly (its utility has the prior's normal
    distribution); only the part inside is averaged over draws.

    Args:
      tree: what `sample_posterior` returned.
      differences: ψ(one) − ψ(other) of n comparisons, in the units of the differences that were fitted, shape (n, D).

    Returns:
      shape (n, 3): the one is preferred, the other is preferred, no difference (0 without a tie threshold).

    Raises:
      ValueError: differences of another shape or not finite.
    """
    known = np.asarray(tree["constant_data"]["differences"])
    differences = checked_differences(differences, length=known.shape[1])
    z = np.asarray(tree["posterior"]["coordinates"])
    draws = z.reshape(z.shape[0] * z.shape[1], z.shape[2])
    return _probabilities(draws, low_rank(known).basis, differences, **model_options(tree))


def held_out_probabilities(
    differences: np.ndarray,
    used: np.ndarray,
    asked: np.ndarray,
    *,
    indifferent: np.ndarray | None = None,
    number_of_preferences: int | None = None,
    **options: Any,
) -> tuple[np.ndarray, bool]:
    """Fit to some rows of `differences`, predict others.

    Args:
      differences: shape (K, D).
      used, asked: which rows are fitted, and which n are predicted: bool (K,), or row numbers.
      indifferent: which rows are answered "no difference", shape (K,) bool.
      number_of_preferences: K of eq. 8; all rows by default.
      options: of `sample_posterior`.

    Returns:
      `answer_probabilities` (n, 3) of the asked rows, and whether the sampler converged.
    """
    options = {
        **options,
        "number_of_preferences": len(differences) if number_of_preferences is None else number_of_preferences,
    }
    known = differences[used]
    if len(known) == 0:  # the prior: no draws are needed
        defaults = signature(models.sample_posterior).parameters
        model = {name: options.get(name, defaults[name].default) for name in _MODEL_OPTIONS}
        number = options["number_of_preferences"]
        nothing = np.zeros((1, 0)), np.zeros((differences.shape[1], 0))
        return _probabilities(*nothing, differences[asked], **model, number_of_preferences=number), True
    if indifferent is not None and options.get("tie_threshold") is not None:
        options["indifferent"] = indifferent[used]
    tree = models.sample_posterior(known, **options)
    return answer_probabilities(tree, differences[asked]), bool(tree.attrs["converged"])


def refit(tree: xr.DataTree, used: np.ndarray, **sampling_options: Any) -> xr.DataTree:
    """The posterior of the same model given only the answers `used`, shape (K,) bool; eq. 8 keeps its K.

    `sampling_options` are `num_samples` and the like of `sample_posterior`; the seed is the tree's by default.
    """
    options = {"seed": int(tree.attrs["seed"]), **model_options(tree), **sampling_options}
    if options["tie_threshold"] is not None:
        options["indifferent"] = tied_rows(tree)[used]
    return models.sample_posterior(np.asarray(tree["constant_data"]["differences"])[used], **options)


def model_options(tree: xr.DataTree) -> dict[str, Any]:
    """The options of `sample_posterior` that say which model a tree's draws are from."""
    threshold = float(tree.attrs["tie_threshold"])
    options = {name: tree.attrs[name] for name in _MODEL_OPTIONS}
    return {
        **options,
        "tie_threshold": None if np.isnan(threshold) else threshold,
        "number_of_preferences": int(  # trees of the first releases had no such attribute
            tree.attrs.get("number_of_preferences", tree["constant_data"].sizes["preference"])
        ),
    }


def tied_rows(tree: xr.DataTree) -> np.ndarray:
    """Which answers were "no difference", shape (K,) bool."""
    return np.asarray(tree["observed_data"]["answers"]) == 0


def checked_differences(differences: np.ndarray, *, name: str = "differences", length: int | None = None) -> np.ndarray:
    """As float64; raises `ValueError` unless it is a finite matrix (K, D), with D = `length` where that is given."""
    differences = np.asarray(differences, dtype=np.float64)
    if differences.ndim != 2 or length not in (None, differences.shape[1]):
        raise ValueError(f"{name}: expected shape (n, {length or 'D'}), got {differences.shape}")
    if not np.all(np.isfinite(differences)):
        raise ValueError(f"{name}: expected finite entries, got {np.sum(~np.isfinite(differences))} that are not")
    return differences


def checked_bool(name: str, values: np.ndarray, number: int) -> np.ndarray:
    """Raises `ValueError` unless it is bool of shape (number,)."""
    values = np.asarray(values)
    if values.shape != (number,) or values.dtype != bool:
        raise ValueError(f"{name}: expected bool of shape ({number},), got {values.dtype} of shape {values.shape}")
    return values


def checked_groups(groups: np.ndarray | None, number: int) -> np.ndarray:
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


def _probabilities(
    coordinates: np.ndarray,
    basis: np.ndarray,
    differences: np.ndarray,
    *,
    prior_scale: float,
    tie_threshold: float | None,
    likelihood: str,
    **options: Any,
) -> np.ndarray:
    mixture = preference_likelihood(likelihood, **options).probit_mixture()
    inside = differences @ basis
    # the margin given z is normal: mean z·inside, and the prior's spread along what no answer has seen
    spread = prior_scale * np.linalg.norm(differences - inside @ basis.T, axis=1)
    shift = 0.0 if tie_threshold is None else tie_threshold
    probabilities = np.empty((len(differences), 3))
    for k, (row, sd) in enumerate(zip(inside, spread, strict=True)):
        margins = coordinates @ row
        probabilities[k, PREFERRED] = np.mean(_smoothed(mixture, margins - shift, sd))
        probabilities[k, DOMINATED] = np.mean(_smoothed(mixture, -margins - shift, sd))
    probabilities[:, TIED] = 0.0 if tie_threshold is None else 1 - probabilities[:, :TIED].sum(axis=1)
    return probabilities


def _smoothed(mixture: ProbitMixture, margins: np.ndarray, sd: float) -> np.ndarray:
    """E p(t) over t ~ N(margins, sd²): each probit of the mixture stays one, with scale √(h² + sd²)."""
    total = np.full(margins.shape, float(mixture.constant))
    for weight, offset, scale in zip(mixture.weights, mixture.offsets, mixture.scales, strict=True):
        width = np.hypot(scale, sd)
        total += weight * (ndtr((margins - offset) / width) if width > 0 else (1 + np.sign(margins - offset)) / 2)
    return total
