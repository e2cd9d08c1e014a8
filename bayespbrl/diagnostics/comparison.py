"""Comparison of preference models by k-fold cross-validation with exact refits (eq. 8 and the alternatives to it).

Importance-sampling estimates from one fit fail for a likelihood with a jump. Here each answer is predicted by a
posterior that was fitted without it.
"""

from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from bayespbrl import checks
from bayespbrl.diagnostics.predictions import PREFERRED, TIED, answer_groups, held_out_probabilities
from bayespbrl.models import NOTHING_ELSE, Answers, PreferenceModel
from bayespbrl.models.posterior_tree import settings_of


def compare_likelihoods(
    differences: np.ndarray,
    candidates: Mapping[str, PreferenceModel],
    *,
    folds: int = 5,
    groups: np.ndarray | None = None,
    answers: Answers = NOTHING_ELSE,
    seed: int = 0,
    **sampling_options: int,
) -> xr.Dataset:
    """Expected log predictive density (elpd) of the answers under each candidate.

    Args:
      differences: ψ(preferred) − ψ(dominated), shape (K, D), or (C, K, D) under C settings of the features; eq. 8 keeps
        the full K.
      candidates: models by name; `PreferenceModel(steepness=None, lapse_rate=None)` is what `infer_utility` fits.
      folds: >= 2, assigned at random; leave-one-out with as many folds as answers.
      groups: the number of the answer that each row follows from, shape (K,), never decreasing: rows of one answer are
        left out together. Every row is an answer of its own by default.
      answers: ties, sides and answerers of the rows. What a candidate leaves open, such as the tie threshold, is
        inferred. Flags of ties that are all False say that ties were possible; None that they were not.
      seed: of the folds and of the sampler.
      sampling_options: `num_samples` and the like, the same for all candidates.

    Returns:
      `log_probability` (candidate, preference) of each answer given the other folds; `elpd`, its sum in nats, and
      `standard_error`; `difference` in elpd from the best and `difference_error`; `converged`, whether every refit
      converged; `fold` (preference). The best candidate comes first.

    Source: Vehtari, Gelman & Gabry (2017), section 2.3 and eq. 24.
    """
    settings = settings_of(differences)
    number = settings.shape[1]
    groups = answer_groups(groups, number)
    fold = _assigned_folds(groups, checks.whole("folds", folds, 2), seed=seed)
    answers = answers.checked(number)
    if not candidates:
        raise ValueError("candidates: expected at least one, got none")
    results = [
        _held_out_log_probability(settings, model, fold, answers, seed=seed, **sampling_options)
        for model in candidates.values()
    ]
    log_probability, converged = (np.array(values) for values in zip(*results, strict=True))
    return _table(list(candidates), log_probability, converged, fold, groups)


def plot_comparison(result: xr.Dataset, axes: Axes) -> Axes:
    """Difference of each candidate's expected log predictive density from the best, with one standard error."""
    numbers = np.arange(result.sizes["candidate"])
    axes.errorbar(result["difference"], numbers, xerr=result["difference_error"], fmt="o", markersize=4, capsize=2)
    names = [str(name) for name in result["candidate"].values]
    axes.set_yticks(
        numbers, [n if ok else f"{n} (not converged)" for n, ok in zip(names, result["converged"], strict=True)]
    )
    axes.invert_yaxis()
    axes.axvline(0.0, color="0.5", linestyle="--", linewidth=1)
    best = f"best: {float(result['elpd'][0]):.2f} ± {float(result['standard_error'][0]):.2f}"
    axes.set(xlabel="difference in elpd (nats)", title=best)
    return axes


def _held_out_log_probability(
    settings: np.ndarray, model: PreferenceModel, fold: np.ndarray, answers: Answers, **sampling_options: int
) -> tuple[np.ndarray, bool]:
    """Log probability of each answer given the other folds, shape (K,), and whether every refit converged."""
    outcome = np.where(answers.tied(len(fold)), TIED, PREFERRED)
    log_probability, converged = np.zeros(len(fold)), True
    for held_out in np.unique(fold):
        asked = fold == held_out
        probabilities, fit_converged = held_out_probabilities(
            settings, model, ~asked, asked, answers=answers, **sampling_options
        )
        chosen = probabilities[np.arange(len(probabilities)), outcome[asked]]
        with np.errstate(divide="ignore"):  # an answer that the model rules out: log 0
            log_probability[asked] = np.log(chosen)
        converged &= fit_converged
    return log_probability, converged


def _assigned_folds(groups: np.ndarray, folds: int, *, seed: int) -> np.ndarray:
    """The fold of each row, shape (K,): whole answers, in folds whose sizes differ by at most one."""
    labels, place = np.unique(groups, return_inverse=True)
    return np.random.default_rng(seed).permutation(np.arange(len(labels)) % folds)[place]


def _table(
    names: list[str], log_probability: np.ndarray, converged: np.ndarray, fold: np.ndarray, groups: np.ndarray
) -> xr.Dataset:
    elpd = log_probability.sum(axis=1)
    order = np.argsort(-elpd, kind="stable")
    with np.errstate(invalid="ignore"):  # both −∞: neither is better
        best = log_probability[order[0]]
        behind = np.where(log_probability == best, 0.0, log_probability - best)
    values = {
        "elpd": elpd,
        "standard_error": _error_of_sum(log_probability, groups),
        "difference": np.sum(behind, axis=1),
        "difference_error": _error_of_sum(behind, groups),
        "converged": converged,
    }
    columns = {name: ("candidate", value[order]) for name, value in values.items()}
    pointwise = (("candidate", "preference"), log_probability[order])
    coordinates = {"candidate": [names[c] for c in order]}
    return xr.Dataset({**columns, "log_probability": pointwise, "fold": ("preference", fold)}, coordinates)


def _error_of_sum(values: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Standard error of the sum along the last axis, in which the rows of an answer are one summand.

    NaN for fewer than two answers, or where a value is infinite.
    """
    labels = np.unique(groups)
    if (number := len(labels)) < 2:
        return np.full(values.shape[0], np.nan)
    with np.errstate(invalid="ignore"):
        sums = np.stack([values[..., groups == label].sum(axis=-1) for label in labels], axis=-1)
        return np.sqrt(number * np.var(sums, axis=-1, ddof=1))  # Vehtari et al. (2017), eq. 24
