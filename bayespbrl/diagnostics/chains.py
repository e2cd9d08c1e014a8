"""Convergence of a posterior's chains: R̂, effective sample sizes and Monte Carlo errors of the margins (step 1)."""

import numpy as np
import xarray as xr
from arviz_stats.base import array_stats
from matplotlib.axes import Axes

from bayespbrl import checks
from bayespbrl.diagnostics.axes import finished
from bayespbrl.models.convergence import RHAT_LIMIT, SIZE_LIMIT, chain_convergence
from bayespbrl.models.posterior_tree import check_posterior


def convergence(
    tree: xr.DataTree, *, rhat_max: float = RHAT_LIMIT, effective_sample_size_min: float = SIZE_LIMIT
) -> xr.Dataset:
    """Convergence diagnostics of each margin.

    Args:
      tree: what `sample_posterior` returned.
      rhat_max, effective_sample_size_min: limits for every margin.

    Returns:
      rhat, effective_sample_size (bulk), effective_sample_size_tail, monte_carlo_error (of the mean), converged, each
      (preference), with the attributes rhat_max, effective_sample_size_min, converged (0 or 1) and both limits.

    Source: Vehtari et al. (2021).
    """
    check_posterior(tree)
    margins = np.asarray(tree["posterior"]["margins"])
    report = chain_convergence(margins)
    tail = np.full(margins.shape[2], float(margins.shape[0] * margins.shape[1]))
    varies = ~np.all(margins == margins[:1, :1], axis=(0, 1))
    if varies.any():
        tail[varies] = array_stats.ess(
            margins[:, :, varies], method="tail", prob=(0.05, 0.95), chain_axis=0, draw_axis=1
        )
    each = (report.rhat <= rhat_max) & (report.effective_sample_size >= effective_sample_size_min)
    return xr.Dataset(
        {
            "rhat": ("preference", report.rhat),
            "effective_sample_size": ("preference", report.effective_sample_size),
            "effective_sample_size_tail": ("preference", tail),
            "monte_carlo_error": ("preference", report.monte_carlo_error),
            "converged": ("preference", each),
        },
        attrs={
            "rhat_max": report.rhat_max,
            "effective_sample_size_min": report.effective_sample_size_min,
            "converged": int(each.all()),
            "rhat_limit": rhat_max,
            "effective_sample_size_limit": effective_sample_size_min,
        },
    )


def plot_convergence(result: xr.Dataset, axes: Axes) -> Axes:
    """Effective sample size of each margin; R̂ is written beside those that have not converged."""
    numbers = np.arange(result.sizes["preference"])
    axes.plot(numbers, result["effective_sample_size"], "o", markersize=3, label="bulk")
    axes.plot(numbers, result["effective_sample_size_tail"], "x", markersize=4, label="tail")
    limit = result.attrs["effective_sample_size_limit"]
    axes.axhline(limit, color="0.5", linestyle="--", linewidth=1, label=f"limit {limit:g}")
    for k in numbers[~result["converged"].values]:
        place = (k, float(result["effective_sample_size"][k]))
        axes.annotate(f"R̂ {float(result['rhat'][k]):.2f}", place, xytext=(3, 3), textcoords="offset points", fontsize=7)
    verdict = "converged" if result.attrs["converged"] else "not converged"
    title = f"{verdict}, largest R̂ {result.attrs['rhat_max']:.3f}"
    return finished(axes, xlabel="preference", ylabel="effective sample size", ylim=(0, None), title=title)


def plot_ranks(tree: xr.DataTree, axes: Axes, *, preference: int | None = None, bins: int = 20) -> Axes:
    """Rank plot: histogram of each chain's ranks among all draws, one line per chain, flat where the chains agree.

    Args:
      tree: what `sample_posterior` returned.
      axes: to draw on.
      preference: number of the margin; the one with the largest R̂ by default.
      bins: of the ranks.

    Raises:
      ValueError: an unknown preference.

    Source: Vehtari et al. (2021), section 4.2.
    """
    check_posterior(tree)
    margins = np.asarray(tree["posterior"]["margins"])
    if not margins.shape[2]:
        raise ValueError("tree: expected a posterior of at least one answer, got none")
    if preference is None:
        preference = int(np.argmax(chain_convergence(margins).rhat))
    preference = checks.index("preference", preference, margins.shape[2])
    draws = margins[:, :, preference]
    equal = np.random.default_rng(0).random(draws.size)  # decides among equal draws, which no chain has first
    ranks = np.argsort(np.lexsort((equal, draws.ravel()))).reshape(draws.shape)
    for chain, row in enumerate(ranks):
        counts, edges = np.histogram(row, bins=bins, range=(0, draws.size))
        axes.stairs(counts * bins / row.size, edges, baseline=None, label=f"chain {chain}")
    axes.axhline(1.0, color="0.5", linestyle="--", linewidth=1)
    axes.set(xlabel="rank", ylabel="relative frequency", ylim=(0, None), title=f"Ranks of margin {preference}")
    axes.legend(fontsize=7)
    return axes
