"""The figures of a report. Each function draws on the matplotlib axes it is given and returns them."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from bayespbrl.diagnostics.axes import finished, number_cells
from bayespbrl.models.convergence import RHAT_LIMIT, SIZE_LIMIT

MAIN, ACCENT = "#1b6ca8", "#c2571a"


def plot_value(table: xr.Dataset, axes: Axes, *, optimum: float | None = None) -> Axes:
    """Value of the kept policy and of the newest against the number of answers; the best one is marked."""
    answers, value = table["answers"].values, table["value"].values
    axes.plot(answers, value, marker="o", markersize=3.5, color=MAIN)
    newest = table["value_newest"].values if "value_newest" in table else value
    if np.any(np.isfinite(newest) & (newest != value)):
        axes.plot(answers, newest, linewidth=0.8, color="0.55", label="newest")
    if np.isfinite(value).any():
        best = int(np.nanargmax(value))
        axes.plot(answers[best], value[best], "*", markersize=13, color=ACCENT, label=f"best: {value[best]:.4g}")
    if optimum is not None:
        axes.axhline(optimum, color="0.4", linestyle="--", linewidth=1, label=f"optimum: {optimum:.4g}")
    return finished(axes, xlabel="answers", ylabel="mean return of fresh episodes")


def plot_progress(table: xr.Dataset, axes: Axes) -> Axes:
    """Utility of each iteration's trajectories by the last estimate, relative to the last's, with its 90 % interval."""
    iterations = table["iteration"].values
    if "lower" in table:
        axes.fill_between(
            iterations, table["lower"], table["upper"], alpha=0.25, linewidth=0, color=MAIN, label="90 % interval"
        )
    axes.plot(iterations, table["utility"], marker="o", markersize=3.5, color=MAIN, label="expected utility")
    axes.axhline(0, color="0.4", linestyle="--", linewidth=1)
    return finished(axes, xlabel="iteration", ylabel="utility relative to the last")


def plot_rhat(table: xr.Dataset, axes: Axes) -> Axes:
    """Largest R̂ of each iteration's fit."""
    _series(table, axes, {"rhat_max": "largest R̂"}, converged="utility_converged")
    axes.axhline(RHAT_LIMIT, color="0.4", linestyle="--", linewidth=1, label=f"limit {RHAT_LIMIT:g}")
    low, high = axes.get_ylim()
    return finished(axes, ylabel="R̂", ylim=(min(low, 0.9995), max(high, RHAT_LIMIT + 0.002)))


def plot_effective_sample_size(table: xr.Dataset, axes: Axes) -> Axes:
    """Effective sample size of whatever mixes worst in each iteration's fit."""
    _series(table, axes, {"effective_sample_size_min": "the worst"}, converged="utility_converged")
    axes.axhline(SIZE_LIMIT, color="0.4", linestyle="--", linewidth=1, label=f"limit {SIZE_LIMIT:g}")
    return finished(axes, ylabel="effective sample size", ylim=(0, None))


def plot_bound(table: xr.Dataset, axes: Axes) -> Axes:
    """The KL bound, the KL that REPS reached and the fitted policy's KL, on a logarithmic scale."""
    names = {"kl_bound": "bound", "kl": "reached by REPS", "kl_fitted_policy": "fitted policy"}
    values = np.concatenate([table[name].values for name in names])
    positive = values[np.isfinite(values) & (values > 0)]
    lowest = max(1e-6, positive.min() / 2) if positive.size else 1e-6
    _series(table.assign({name: np.maximum(table[name], lowest) for name in names}), axes, names)
    return finished(axes, ylabel="KL to the policy that was updated (nats)", yscale="log")


def plot_temperature(table: xr.Dataset, axes: Axes) -> Axes:
    """Temperature of REPS on a logarithmic scale; crosses mark updates whose solver did not converge."""
    _series(table, axes, {"temperature": "temperature"}, converged="reps_converged")
    if np.nanmin(table["temperature"].values, initial=np.inf) > 0:
        axes.set_yscale("log")
    axes.set(ylabel="temperature (utility)")
    return axes


def plot_entropy(table: xr.Dataset, axes: Axes) -> Axes:
    """Mean entropy of each iteration's policy over the visited states, and its action noise where there is one."""
    _series(table, axes, {"entropy": "entropy"})
    axes.set(ylabel="entropy (nats)")
    spread = table["action_standard_deviation"].values
    if np.isfinite(spread).any():
        other = axes.twinx()
        other.plot(table["iteration"], spread, "s--", markersize=3, color=ACCENT, label="standard deviation")
        other.set(ylabel="standard deviation of the action", ylim=(0, None))
        other.legend(loc="lower left")
    return axes


def plot_column(table: xr.Dataset, name: str, axes: Axes, *, label: str | None = None) -> Axes:
    """One variable of the iterations; `label` is its name by default."""
    _series(table, axes, {name: name})
    axes.set(ylabel=(name if label is None else label).replace("_", " "))
    return axes


def plot_states(table: xr.Dataset, values: np.ndarray, axes: Axes, *, label: str, **limits: Any) -> Axes:
    """One number of each state, as a map or as coloured points, by the `kind` of the table.

    Args:
      table: what `utility_table` returned.
      values: shape (state,); NaN stays blank.
      axes: to draw on.
      label: of the colour bar.
      **limits: `vmin`, `vmax` and `cmap` of the colours.
    """
    kind, states = table.attrs["kind"], table["states"].values
    axes.set_facecolor("0.9")
    if kind == "grid":
        rows, columns = table.attrs["shape"]
        image: Any = axes.imshow(values.reshape(rows, columns), **limits)
        number_cells(axes, (rows, columns))
        axes.set(xlabel="column", ylabel="row")
    elif kind == "plane":
        x, y = (states[:, d].reshape(table.attrs["shape"]) for d in (0, 1))
        image = axes.pcolormesh(x, y, values.reshape(table.attrs["shape"]), shading="auto", rasterized=True, **limits)
        axes.set(xlabel="observation 0", ylabel="observation 1")
    else:
        first, second = table.attrs["dimensions"]
        image = axes.scatter(
            states[:, first], states[:, second], c=values, s=5, linewidths=0, rasterized=True, **limits
        )
        axes.set(xlabel=f"observation {first}", ylabel=f"observation {second}")
    axes.figure.colorbar(image, ax=axes, shrink=0.85, label=label)
    return axes


def plot_state_bands(table: xr.Dataset, axes: Axes) -> Axes:
    """Mean utility ± two standard deviations of states on a line, or of those in a list that were visited."""
    states, certain = table["states"].values.reshape(table.sizes["state"]), "sd" not in table
    mean = table["used" if certain else "mean"].values
    sd = np.zeros(len(mean)) if certain else table["sd"].values
    if table.attrs["kind"] == "line":
        axes.fill_between(states, mean - 2 * sd, mean + 2 * sd, alpha=0.25, linewidth=0, label="± 2 sd")
        axes.plot(states, mean, color=MAIN, label="mean")
    else:
        seen = table["reached"].values
        states, mean, sd = states[seen], mean[seen], sd[seen]
        axes.errorbar(states, mean, yerr=2 * sd, fmt="o", markersize=4, capsize=2, color=MAIN, label="mean ± 2 sd")
    axes.axhline(0, color="0.6", linewidth=0.8)
    place = "observation 0" if table.attrs["kind"] == "line" else "state"
    return finished(axes, whole=False, xlabel=place, ylabel="utility")


def plot_trajectories(table: xr.Dataset, axes: Axes) -> Axes:
    """Inferred utility of the compared trajectories, with 90 % intervals, against their hidden return."""
    x, y = table["hidden_return"].values, table["utility"].values
    if "lower" in table:
        # which a single draw may lie outside of
        axes.vlines(x, table["lower"].values, table["upper"].values, color="0.7", linewidth=1, label="90 % interval")
    axes.plot(x, y, "o", markersize=4, color=MAIN)
    return finished(axes, whole=False, xlabel="hidden return (the learner never sees it)", ylabel="inferred utility")


def plot_answers(table: xr.Dataset, axes: Axes) -> Axes:
    """Probability of each answer before it was given and by the last posterior."""
    question = table["question"].values
    after, before = table["probability"].values, table["before"].values
    axes.vlines(question, np.fmin(before, after), np.fmax(before, after), color="0.8", linewidth=1)
    axes.plot(question, before, "o", fillstyle="none", markersize=5, color="0.4", label="before it was given")
    axes.plot(question, after, "o", markersize=4, color=MAIN, label="given all answers")
    wrong = after < 0.5
    if wrong.any():
        axes.plot(question[wrong], after[wrong], "o", markersize=6, color=ACCENT, label="improbable given all answers")
    axes.axhline(0.5, color="0.4", linestyle="--", linewidth=1)
    axes.set(xlabel="question", ylabel="probability of the answer", ylim=(-0.03, 1.03))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, frameon=False)
    return axes


def _series(table: xr.Dataset, axes: Axes, names: dict[str, str], *, converged: str | None = None) -> None:
    iterations = table["iteration"].values
    for number, (name, label) in enumerate(names.items()):
        look: dict[str, Any] = {"marker": "o", "markersize": 3.5, "color": f"C{number}"}
        if number == 0 and len(names) > 1:  # the reference for the others: drawn on top, but thin
            look = {"linestyle": "--", "marker": "_", "markersize": 5, "color": "0.2", "linewidth": 1.2, "zorder": 3}
        axes.plot(iterations, table[name], label=label, **look)
        if converged is not None and (failed := table[converged].values == 0).any():
            at = table[name].values[failed]
            axes.plot(iterations[failed], at, "x", markersize=9, color=ACCENT, label="not converged")
    axes.set_xlabel("iteration")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
