"""Calibration of the schedule's confidence: how often updates were gains, by the stated confidence.

For runs whose hidden reward is known: it never enters the learner, and here it is the judge.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr

OURS = ("agreement", "signal")  # a run with a constant bound has neither, and no update to show
EDGES = (0.0, 0.25, 0.5, 0.75, 0.9, 0.99, 1.0)


def gain_calibration(
    runs: Iterable[Sequence[Mapping[str, Any]]], statistic: str = "agreement", *, edges: Sequence[float] = EDGES
) -> xr.Dataset:
    """How often the newest policy's value rose, by the `agreement` or the `signal` that the schedule reported.

    The first iteration of a run has no value before it, and one without the statistic has no place: both are left out.

    Args:
      runs: the iterations' summaries of each run.
      statistic: `agreement`, the share of the posterior draws that call the update a gain; `signal`; or any other
        statistic of the schedule in [0, 1].
      edges: of the bins, increasing; the last is closed. What is in none of them is left out.

    Returns:
      along `bin`: `lower` and `upper` edge, `updates` (their number), `stated` (mean statistic), `gained` (the share
      that was a gain) and its `standard_error`; NaN where a bin is empty.

    Raises:
      ValueError: edges that do not increase; the iterations of one run, not in a list; a statistic that no run has.
    """
    bounds = np.asarray(edges, dtype=float)
    if bounds.ndim != 1 or len(bounds) < 2 or not np.all(np.diff(bounds) > 0):
        raise ValueError(f"edges: expected at least two increasing numbers, got {edges!r}")
    expected = "runs: expected the iterations of several runs, a list for each, got something else"
    try:
        of_each = [list(summaries) for summaries in runs]
    except TypeError as reason:
        raise ValueError(expected) from reason
    if not all(isinstance(summary, Mapping) for summaries in of_each for summary in summaries):
        raise ValueError(expected)
    reported = [summary.get("schedule") or {} for summaries in of_each for summary in summaries]
    if statistic not in OURS and reported and not any(statistic in each for each in reported):
        raise ValueError(f"statistic: expected one that the runs' schedule reported, got {statistic!r}")
    pairs = [pair for summaries in of_each for pair in _stated_and_gained(summaries, statistic)]
    stated, gained = np.reshape(np.array(pairs, dtype=float), (-1, 2)).T
    inside = (stated >= bounds[0]) & (stated <= bounds[-1])
    stated, gained = stated[inside], gained[inside]
    place = np.minimum(np.searchsorted(bounds, stated, side="right") - 1, len(bounds) - 2)
    counts = np.bincount(place, minlength=len(bounds) - 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.bincount(place, stated, len(bounds) - 1) / counts
        share = np.bincount(place, gained, len(bounds) - 1) / counts
        error = np.sqrt(share * (1 - share) / counts)
    data = {"lower": bounds[:-1], "upper": bounds[1:], "updates": counts, "stated": mean, "gained": share}
    return xr.Dataset({name: ("bin", values) for name, values in (data | {"standard_error": error}).items()})


def _stated_and_gained(summaries: Sequence[Mapping[str, Any]], statistic: str) -> list[tuple[float, bool]]:
    found = []
    for before, after in pairwise(summaries):
        if after.get("restarted", -1) == before.get("iteration"):
            continue  # the policy was started anew in between
        check = after.get("check") or {}
        if check.get("stepped_back"):  # the update began with an earlier policy
            before = {} if not check["best"] else summaries[check["best"] - 1]
        figures = [summary.get("value_newest", summary.get("value")) for summary in (before, after)]
        figures.append((after.get("schedule") or {}).get(statistic))
        if all(isinstance(figure, int | float) and np.isfinite(figure) for figure in figures):
            old, new, stated = (float(figure) for figure in figures)
            found.append((stated, new > old))
    return found
