"""Which likelihood the answers speak for: k-fold cross-validation by exact refits (eq. 8 and its relatives).

Importance-sampling estimates from one fit fail on a likelihood with a jump; here each answer is predicted by a
posterior that has not seen it.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from bayespbrl.diagnostics.predictions import (
    PREFERRED,
    TIED,
    checked_bool,
    checked_differences,
    checked_groups,
    held_out_probabilities,
)


def compare_likelihoods(
    differences: np.ndarray,
    candidates: Mapping[str, Mapping[str, Any]],
    *,
    folds: int = 5,
    groups: np.ndarray | None = None,
    indifferent: np.ndarray | None = None,
    seed: int = 0,
    **sampling_options: Any,
) -> xr.Dataset:
    """Expected log predictive density of the answers under each candidate.

    Args:
      differences: ψ(preferred) − ψ(dominated), shape (K, D).
      candidates: for each name the options of `sample_posterior` that make the model (likelihood, steepness,
        lapse_rate, prior_scale, tie_threshold). Eq. 8 keeps the full K.
      folds: >= 2; answers are dealt to them at random, and as many as there are answers leave out one at a time.
      groups: the number of the answer that each row follows from, shape (K,), never decreasing: rows of one answer are
        left out together. Every row is an answer of its own by default.
      indifferent: which answers were "no difference", shape (K,) bool; then every candidate needs a `tie_threshold`,
        for without one its probability of such an answer is zero.
      seed: of the folds and of the sampler.
      sampling_options: `num_samples` and the like, the same for all candidates.

    Returns:
      `log_probability` (candidate, preference) of each answer given the other folds; by candidate `elpd`, its sum in
      nats, and `standard_error`; `difference` of elpd to the best and `difference_error` from the answers' differences;
      `converged`, whether every refit did; `fold` (preference). Best first.

    Raises:
      ValueError: an argument out of its range, named with what came.

    Source: Vehtari, Gelman & Gabry (2017), section 2.3 and eq. 24.
    """
    differences = checked_differences(differences)
    number = len(differences)
    groups = checked_groups(groups, number)
    tied = np.zeros(number, dtype=bool) if indifferent is None else checked_bool("indifferent", indifferent, number)
    if not candidates:
        raise ValueError("candidates: expected at least one, got none")
    lacking = [name for name, options in candidates.items() if tied.any() and options.get("tie_threshold") is None]
    if lacking:
        raise ValueError(
            f"candidates: expected a tie_threshold in each because some answers are ties, got none in {lacking}"
        )
    if not isinstance(folds, int | np.integer) or folds < 2:
        raise ValueError(f"folds: expected an integer >= 2, got {folds!r}")
    fold = _dealt(groups, folds, seed=seed)
    outcome = np.where(tied, TIED, PREFERRED)
    log_probability = np.zeros((len(candidates), number))
    converged = np.ones(len(candidates), dtype=bool)
    for c, options in enumerate(candidates.values()):
        for held_out in np.unique(fold):
            asked = fold == held_out
            probabilities, in_order = held_out_probabilities(
                differences, ~asked, asked, indifferent=tied, **{"seed": seed, **sampling_options, **options}
            )
            chosen = probabilities[np.arange(len(probabilities)), outcome[asked]]
            with np.errstate(divide="ignore"):  # what a candidate calls impossible costs it everything
                log_probability[c, asked] = np.log(chosen)
            converged[c] &= in_order
    return _table(list(candidates), log_probability, converged, fold)


def plot_comparison(result: xr.Dataset, axes: Axes) -> Axes:
    """Difference of each candidate's expected log predictive density to the best, with one standard error."""
    numbers = np.arange(result.sizes["candidate"])
    axes.errorbar(result["difference"], numbers, xerr=result["difference_error"], fmt="o", markersize=4, capsize=2)
    names = [str(name) for name in result["candidate"].values]
    axes.set_yticks(
        numbers, [n if ok else f"{n} (not converged)" for n, ok in zip(names, result["converged"], strict=True)]
    )
    axes.invert_yaxis()
    axes.axvline(0.0, color="0.5", linestyle="--", linewidth=1)
    best = f"best: {float(result['elpd'][0]):.2f} ± {float(result['standard_error'][0]):.2f}"
    axes.set(xlabel="difference of elpd (nats)", title=best)
    return axes


def _dealt(groups: np.ndarray, folds: int, *, seed: int) -> np.ndarray:
    """The fold of each row, shape (K,): whole answers, as many in each fold as in any other, give or take one."""
    labels, place = np.unique(groups, return_inverse=True)
    return np.random.default_rng(seed).permutation(np.arange(len(labels)) % folds)[place]


def _table(names: list[str], log_probability: np.ndarray, converged: np.ndarray, fold: np.ndarray) -> xr.Dataset:
    elpd = log_probability.sum(axis=1)
    order = np.argsort(-elpd, kind="stable")
    with np.errstate(invalid="ignore"):  # both impossible: neither is better
        behind = log_probability - log_probability[order[0]]
    values = {
        "elpd": elpd,
        "standard_error": _error_of_sum(log_probability),
        "difference": np.sum(behind, axis=1),
        "difference_error": _error_of_sum(behind),
        "converged": converged,
    }
    columns = {name: ("candidate", value[order]) for name, value in values.items()}
    pointwise = (("candidate", "preference"), log_probability[order])
    coordinates = {"candidate": [names[c] for c in order]}
    return xr.Dataset({**columns, "log_probability": pointwise, "fold": ("preference", fold)}, coordinates)


def _error_of_sum(values: np.ndarray) -> np.ndarray:
    """Standard error of the sum along the last axis; NaN for fewer than two, or where one is infinite."""
    number = values.shape[-1]
    if number < 2:
        return np.full(values.shape[0], np.nan)
    with np.errstate(invalid="ignore"):
        return np.sqrt(number * np.var(values, axis=-1, ddof=1))
