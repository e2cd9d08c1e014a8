"""Influence of each answer: how the posterior changes without it, by importance weights and by exact refits.

Pareto-smoothed importance weights estimate each change from the draws at hand. Their k̂ is itself a measure of
influence; above 0.7, which is common for a likelihood with a jump, the estimate is not reliable. The refits are exact.
"""

import numpy as np
import xarray as xr
from arviz_stats.base import array_stats
from matplotlib.axes import Axes

from bayespbrl import checks
from bayespbrl.diagnostics.axes import finished
from bayespbrl.diagnostics.predictions import (
    PREFERRED,
    TIED,
    answer_groups,
    answer_probabilities,
    refit,
    tied_rows,
)
from bayespbrl.models.posterior_tree import answers_of, bases_of, check_posterior, settings_of

PARETO_K_LIMIT = 0.7  # Vehtari et al. (2024)


def influence(
    tree: xr.DataTree, *, refits: int | None = 3, groups: np.ndarray | None = None, **sampling_options: int
) -> xr.Dataset:
    """Change of the posterior when each of the answers, of which the K rows follow, is left out.

    Args:
      tree: what `sample_posterior` returned.
      groups: the number of the answer that each row follows from, never decreasing, shape (K,): rows of one answer are
        left out together, and have the same figures. Every row is an answer of its own by default.
      refits: number of answers left out by an exact refit: those with the largest change by importance weights, a
        better predictor of the exact change than k̂. None for all.
      sampling_options: `num_samples` and the like of the refits; eq. 8 keeps the full K.

    Returns:
      along `preference`, the rows: `pareto_k`; `change_estimated`, the root mean square change of the margins' means,
      by importance weights; where `refitted`, and NaN elsewhere: `change`, the same by the refit, `probability` of the
      row given the others, and `margin_means` (preference, margin), the means of all margins
      without the answer; `converged`, whether the refit converged. Also `margin_mean` (margin), given all answers.
    """
    check_posterior(tree)
    number = tree["constant_data"].sizes["preference"]
    refits = None if refits is None else checks.whole("refits", refits, 0)
    differences, answers = np.asarray(tree["constant_data"]["differences"]), answers_of(tree)
    margin_mean = np.asarray(tree["posterior"]["margins"]).mean(axis=(0, 1))
    groups = answer_groups(groups, number)
    pareto_k, estimated = _estimates(tree, groups)
    chosen = list(dict.fromkeys(groups[np.argsort(-estimated, kind="stable")]))[:refits]
    changes, probability = np.full(number, np.nan), np.full(number, np.nan)
    means, converged = np.full((number, number), np.nan), np.zeros(number, dtype=bool)
    outcome = np.where(tied_rows(tree), TIED, PREFERRED)
    for group in chosen:
        rows = np.flatnonzero(groups == group)
        others = refit(tree, groups != group, **sampling_options)
        without = _mean_margins(others, answers.with_sides(settings_of(differences), others.attrs["prior_scale"]))
        means[rows], changes[rows] = without, _length(without - margin_mean)
        predicted = answer_probabilities(others, differences[..., rows, :], answers.of(rows))
        probability[rows] = np.take_along_axis(predicted, outcome[rows][:, None], axis=1)[:, 0]
        converged[rows] = bool(others.attrs["converged"])
    return xr.Dataset(
        {
            "pareto_k": ("preference", pareto_k),
            "change_estimated": ("preference", estimated),
            "refitted": ("preference", np.isin(groups, chosen)),
            "change": ("preference", changes),
            "probability": ("preference", probability),
            "converged": ("preference", converged),
            "margin_means": (("preference", "margin"), means),
            "margin_mean": ("margin", margin_mean),
        }
    )


def plot_influence(result: xr.Dataset, axes: Axes) -> Axes:
    """Change of the margins' means without each answer, with the exact refits, and k̂ where above its limit."""
    numbers = np.arange(result.sizes["preference"])
    axes.plot(numbers, result["change_estimated"], "o", markersize=4, fillstyle="none", label="by importance weights")
    axes.plot(numbers, result["change"], "o", markersize=4, label="by exact refit")
    highest = np.fmax(result["change_estimated"].values, result["change"].values)
    for k in numbers[result["pareto_k"].values > PARETO_K_LIMIT]:
        text = f"k̂ {float(result['pareto_k'][k]):.1f}"
        axes.annotate(text, (k, highest[k]), xytext=(3, 3), textcoords="offset points", fontsize=7)
    axes.set(ylim=(0, None), title="Influence")
    return finished(axes, xlabel="answer left out", ylabel="change of the mean margins")


def _estimates(tree: xr.DataTree, groups: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """k̂ and the root mean square change of the margins' means, each shape (K,)."""
    margins = np.asarray(tree["posterior"]["margins"])
    log_likelihood = np.asarray(tree["log_likelihood"]["answers"])
    draws = margins.reshape(margins.shape[0] * margins.shape[1], margins.shape[2])
    pareto_k, change = np.zeros(log_likelihood.shape[2]), np.zeros(log_likelihood.shape[2])
    for group in np.unique(groups):
        k, column = groups == group, log_likelihood[:, :, groups == group].sum(axis=2)
        if np.ptp(column) == 0:  # a row of zeros: all weights are equal
            continue
        relative = min(1.0, float(array_stats.ess(column[..., None], chain_axis=0, draw_axis=1)[0]) / column.size)
        log_weights, pareto_k[k] = array_stats.psislw(column.ravel(), r_eff=relative)  # Vehtari et al. (2024)
        weights = np.exp(log_weights - np.max(log_weights))
        change[k] = _length(weights @ draws / weights.sum() - draws.mean(axis=0))
    return pareto_k, change


def _mean_margins(tree: xr.DataTree, rows: np.ndarray) -> np.ndarray:
    """Mean of each margin, shape (K,), with `rows` (C, K, D and the sides); what no answer touches has the mean 0."""
    z, settings = np.asarray(tree["posterior"]["coordinates"]), np.asarray(tree["posterior"]["setting"])
    parts = [basis @ z[settings == c][:, : basis.shape[1]].sum(axis=0) for c, basis in enumerate(bases_of(tree))]
    return np.asarray(np.einsum("ckd,cd->k", rows, np.array(parts)) / settings.size)


def _length(change: np.ndarray) -> float:
    return float(np.sqrt(np.mean(change**2)))
