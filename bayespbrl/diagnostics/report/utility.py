"""The section of a report on the utility: over the states with its uncertainty, and of the compared trajectories."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from bayespbrl.diagnostics.report import figures
from bayespbrl.diagnostics.report.contents import RunContents
from bayespbrl.diagnostics.report.document import Block, Body, Picture, drawn
from bayespbrl.diagnostics.report.formatting import number, percent
from bayespbrl.diagnostics.report.tables import trajectories_table, utility_table
from bayespbrl.diagnostics.uncertainty import plot_ranking

PLACES = {
    "grid": "over the cells of the grid",
    "list": "of every state",
    "line": "over the observed range",
    "plane": "over the observed range",
    "cloud": "at observed states, in the two dimensions that they fill best",
}


def utility(contents: RunContents, ranking: xr.Dataset) -> Body:
    """The utility with its uncertainty over the states, and of the compared trajectories."""
    estimate = contents.estimate
    if estimate is None:
        return ["No utility estimate yet."], []
    if contents.features_missing:
        return [f"The features φ are a function of your own, and {contents.features_missing}."], []
    blocks: list[Block] = []
    text = [] if contents.posterior is not None else [contents.posterior_missing]
    settings = 0 if contents.posterior is None else len(contents.posterior["utility_weights_mean"])
    if settings:
        text.append(_what_else(estimate.hyperparameters() or {}, settings))
    if estimate.features is not None:
        table = utility_table(contents)
        blocks += _maps(table)
        text += _remaining_uncertainty(table, several=settings > 1)
    compared = trajectories_table(contents)
    if compared.sizes["trajectory"] and np.ptp(compared["hidden_return"].values) > 0:
        blocks.append(_trajectories(compared, clips=bool(contents.clips)))
    if ranking.sizes["trajectory"] > 1:
        caption = (
            "Probability of each rank of the newest trajectories and the newest undominated one; rank 1 is the best. A "
            "sharp diagonal: the order is well determined. A uniform column: the rank is unknown."
        )
        alt = f"Probabilities of the ranks of {ranking.sizes['trajectory']} trajectories."
        panels = [("Ranking", partial(plot_ranking, ranking))]
        blocks.append(drawn("ranking", panels, caption, alt, size=(6.0, 3.6)))
    return text, blocks


def _what_else(found: Mapping[str, Any], settings: int) -> str:
    """What the posterior says about all but the weights, in words; `settings` of length scales, and of effort."""

    def inferred(name: str) -> str:
        low, mean, high = (found[f"{name}{end}"] for end in (" lower", "", " upper"))
        given = np.allclose([low, high], mean, atol=0)
        return f"{number(mean)}" if given else f"{number(mean)} ({number(low)} to {number(high)})"

    text = f"Lapse rate: {inferred('lapse_rate')}, steepness: {inferred('steepness')}"
    effort = "weight of the effort of actions, in prior standard deviations"
    for name, label in (("tie_threshold", "tie threshold"), ("side_bias", "side bias"), ("effort", effort)):
        text += f", {label}: {inferred(name)}" if name in found else ""
    text += ", with 90 % intervals where they are inferred."
    if "effort counts" in found:
        settings //= 2  # each with effort and without
        text += f" That effort counts has probability {percent(found['effort counts'])}, a priori {percent(0.5)}."
    if settings > 1:
        text += (
            f" The posterior is over {settings} choices of length scales as well; the most probable has "
            f"probability {percent(found['most probable length scales'])}, a priori "
            f"{percent(1 / settings)}."
        )
    return text


def _remaining_uncertainty(table: xr.Dataset, *, several: bool) -> list[str]:
    if "sd" not in table:
        return []
    inside = table["reached"].values & (table["prior_sd"].values > 0)
    if not inside.any():
        return []
    left = table["sd"].values[inside] / table["prior_sd"].values[inside]
    least = f", and {percent(left.min())} where most was learnt" if left.min() < 1 else ""
    lengths = " With it, the length scales that became probable change both." if several else ""
    return [
        f"The posterior standard deviation is {percent(np.median(left))} of the prior's in the median over the states "
        f"shown{least}. Answers distinguish what was shown as a whole, and say less about single "
        f"states.{lengths}"
    ]


def _trajectories(compared: xr.Dataset, *, clips: bool) -> Picture:
    caption = (
        "Every trajectory that a question showed. A rising cloud means that the utility orders the trajectories as the "
        "hidden return does. The scale is arbitrary."
    )
    if clips:
        caption += " Both are of the clip that was shown."
    if "lower" in compared:
        caption += (
            f" The intervals are the posterior's, for the utility of the whole {'clip' if clips else 'trajectory'}."
        )
    alt = f"Inferred utility against hidden return of {compared.sizes['trajectory']} trajectories."
    panels = [("Trajectories", partial(figures.plot_trajectories, compared))]
    return drawn("trajectories", panels, caption, alt, size=(6.0, 3.3))


def _maps(table: xr.Dataset) -> list[Picture]:
    where = PLACES[table.attrs["kind"]]
    if table.attrs["kind"] in ("list", "line"):
        bands = [("Utility of the states", partial(figures.plot_state_bands, table))]
        bars = "posterior mean ± two standard deviations" if "sd" in table else "as the learner used it"
        caption = f"Utility {where}: {bars}. The scale is arbitrary."
        return [drawn("utility", bands, caption, f"Utility {where}.", size=(7.6, 3.2))]
    blank = np.where(table["reached"].values, 0.0, np.nan)
    used = ("used", "Utility that the learner used", "utility", "viridis")
    shown, caption = [used], f"The utility {where}. The scale is arbitrary."
    if "sd" in table:
        table = table.assign(left=table["sd"] / table["prior_sd"].where(table["reached"]))
        shown = [("mean", "Mean", "utility", "viridis"), ("sd", "Standard deviation", "sd", "magma")]
        shown.append(("left", "Remaining uncertainty", "sd / prior sd", "magma"))
        caption = (
            f"The utility {where}: its posterior mean; its standard deviation, which is also small where the features "
            "are small; and the standard deviation as a share of the prior's, dark where the answers, or the length "
            "scales that they made probable, leave less. The scale is arbitrary."
        )
        if not np.array_equal(table["used"], table["mean"]):
            shown.append(used)
            caption += " The learner acted on the fourth map."
    if np.isnan(blank).any():
        near_zero = "where the features, and with them the utility, are nearly zero"
        caption += f" Grey: {'states that no trajectory visited' if 'visits' in table else near_zero}."
    panels = [
        (title, partial(figures.plot_states, table, table[name].values + blank, label=label, cmap=colours))
        for name, title, label, colours in shown
    ]
    columns = 2 if len(panels) == 4 else 3
    maps = [drawn("utility", panels, caption, f"Map of the utility {where}.", columns=columns, size=(3.5, 2.9))]
    return maps + ([_draws(table, blank, where)] if "draws" in table else [])


def _draws(table: xr.Dataset, blank: np.ndarray, where: str) -> Picture:
    draws = table["draws"].values + blank
    limits: dict[str, Any] = {"vmin": np.nanmin(draws), "vmax": np.nanmax(draws), "cmap": "viridis"}
    panels = [
        (f"Draw {i + 1}", partial(figures.plot_states, table, draw, label="utility", **limits))
        for i, draw in enumerate(draws)
    ]
    caption = "Three posterior draws on one scale. Where they agree, the utility is well determined."
    alt = f"Three posterior draws of the utility {where}."
    return drawn("draws", panels, caption, alt, columns=3, size=(3.5, 2.9))
