"""The section of a report on the utility: over the states with its uncertainty, and of what was compared."""

from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from bayespbrl.diagnostics.report import figures
from bayespbrl.diagnostics.report.contents import Evidence
from bayespbrl.diagnostics.report.document import Picture, Section, drawn
from bayespbrl.diagnostics.report.summary import no_posterior, percent
from bayespbrl.diagnostics.report.tables import trajectories_table, utility_table
from bayespbrl.diagnostics.uncertainty import plot_ranking
from bayespbrl.utility.averaging import AveragedUtility


def utility(evidence: Evidence, ranking: xr.Dataset) -> Section:
    """The utility with its uncertainty over the states, and of the trajectories that were compared."""
    title = "What it thinks is good"
    if evidence.estimate is None:
        return Section("utility", title, ["No utility estimate yet."])
    if evidence.features_missing:
        return Section("utility", title, [f"The features φ are a function of your own: {evidence.features_missing}."])
    blocks: list[Any] = []
    text = [] if evidence.posterior is not None else [no_posterior(evidence)]
    if isinstance(evidence.estimate, AveragedUtility):
        likeliest = percent(evidence.estimate.probabilities.max())
        text.append(
            f"The learner acted on an average over {len(evidence.estimate.probabilities)} choices of length scales, "
            f"the likeliest of probability {likeliest}. The trajectories below are ordered by that average, and it "
            "gives the answers their probabilities; mean, deviation and draws over the states, and all that is said of "
            "convergence, influence and sensitivity, are of the one setting whose posterior was sampled."
        )
    if hasattr(evidence.estimate, "utilities"):
        table = utility_table(evidence)
        blocks += _maps(table)
        if "sd" in table:
            inside = table["reached"].values
            left = table["sd"].values[inside] / table["prior_sd"].values[inside]
            text.append(
                f"Of the prior's standard deviation {percent(np.median(left))} is left in the median over the states "
                f"shown, and {percent(left.min())} where most was learnt: answers tell whole trajectories apart, and "
                "say less of single states."
            )
    compared = trajectories_table(evidence)
    if compared.sizes["trajectory"] and np.ptp(compared["hidden_return"].values) > 0:
        caption = (
            "Every trajectory that was asked about. A rising cloud says that the utility orders trajectories as the "
            "hidden return does. The scale is free."
        )
        if "lower" in compared:
            caption += " The interval is the posterior's for the utility of the whole."
        panels = [("Trajectories", partial(figures.plot_trajectories, compared))]
        alt = f"Inferred utility against hidden return of {compared.sizes['trajectory']} trajectories."
        blocks.append(drawn("trajectories", panels, caption, alt, columns=1, size=(6.0, 3.3)))
    if ranking.sizes["trajectory"] > 1:
        caption = (
            "The newest trajectories and the undominated one: the probability of each rank, rank 1 the best. A sharp "
            "diagonal is an order that is known; columns of one shade are one that is not."
        )
        panels = [("Ranking", partial(plot_ranking, ranking))]
        alt = f"Probabilities of the ranks of {ranking.sizes['trajectory']} trajectories."
        blocks.append(drawn("ranking", panels, caption, alt, columns=1, size=(6.0, 3.6)))
    return Section("utility", title, text, blocks)


def _maps(table: xr.Dataset) -> list[Picture]:
    kind = table.attrs["kind"]
    where = {
        "grid": "over the cells of the grid",
        "list": "of every state",
        "line": "along what was observed",
        "plane": "over the range of what was observed",
        "cloud": "at observed states, along the two dimensions that they fill best",
    }[kind]
    if kind in ("list", "line"):
        panels: list[Any] = [("Utility of the states", partial(figures.plot_state_bands, table))]
        caption = f"Utility {where}: mean, and two posterior standard deviations either way. The scale is free."
        return [drawn("utility", panels, caption, f"Utility {where}.", columns=1, size=(7.6, 3.2))]
    blank = np.where(table["reached"].values, 0.0, np.nan)
    shown = [("used", "As the learner used it", "utility", "viridis")]
    caption = f"The utility {where}. The scale is free."
    if "sd" in table:
        table = table.assign(left=table["sd"] / table["prior_sd"].where(table["reached"]))
        shown = [("mean", "Mean", "utility", "viridis"), ("sd", "Standard deviation", "sd", "magma")]
        shown += [("left", "Share of the prior left", "sd / prior sd", "magma")]
        caption = (
            f"The utility {where}: its posterior mean; its standard deviation, which is small also where the features "
            "are; and how much of the prior's is left, dark where something was learnt. The scale is free."
        )
        if not np.array_equal(table["used"], table["mean"]):
            shown.append(("used", "As the learner used it", "utility", "viridis"))
            caption += " The learner acted on the fourth."
    if np.isnan(blank).any():
        caption += " Grey: too far from every centre of the features for the utility to be anything but zero."
    panels = [
        (title, partial(figures.plot_states, table, table[name].values + blank, label=label, cmap=colours))
        for name, title, label, colours in shown
    ]
    columns = 2 if len(panels) == 4 else 3
    blocks = [drawn("utility", panels, caption, f"Map of the utility {where}.", columns=columns, size=(3.5, 2.9))]
    if "draws" in table:
        draws = table["draws"].values
        limits: dict[str, Any] = {"vmin": float(draws.min()), "vmax": float(draws.max()), "cmap": "viridis"}
        panels = [
            (f"Draw {i + 1}", partial(figures.plot_states, table, draw + blank, label="utility", **limits))
            for i, draw in enumerate(draws)
        ]
        caption = "Three draws of the posterior on one scale: each explains the answers. What they share is known."
        alt = f"Three posterior draws of the utility {where}."
        blocks.append(drawn("draws", panels, caption, alt, columns=3, size=(3.5, 2.9)))
    return blocks
