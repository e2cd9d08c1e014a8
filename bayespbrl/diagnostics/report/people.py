"""The section of a report on the people who answered."""

from collections.abc import Iterator

import numpy as np
import xarray as xr

from bayespbrl.diagnostics.people import people
from bayespbrl.diagnostics.report.contents import RunContents
from bayespbrl.diagnostics.report.document import Body, ReportWarning, Table
from bayespbrl.diagnostics.report.formatting import count, number, percent
from bayespbrl.experts import SIMULATED

# A lapse rate that is surely above the first is worth less trust; above the second the answers are worth little.
LESS_TRUST, LITTLE_WORTH = 0.1, 0.5
RARELY_CONSISTENT = 0.8  # a share of repeated answers that is surely below
HASTY, FEW, MANY = 1.0, 5, 0.3  # seconds; answers that say something about a person; share of questions


def has_people(contents: RunContents) -> bool:
    """Whether people answered: some answer has a name, or the expert is no simulation."""
    named = any(question.answerer is not None for question in contents.past)
    return bool(contents.past) and (named or contents.settings.expert not in SIMULATED)


def people_section(contents: RunContents) -> Body:
    """The figures of each person, and the warnings about them."""
    table = _table(contents)
    shared = bool(np.any(table["shared"].values))  # whether some question was answered by two people
    head = ["person", "answers", "ties", "cannot tell", "lapse rate", "side bias", "same on repeats"]
    head += ["same as others"] * shared + ["median time"]
    given = contents.model.lapse_rate is not None
    rows = [_row(table.isel(answerer=place), given=given, shared=shared) for place in range(table.sizes["answerer"])]
    caption = (
        "Everyone who answered, with 90 % intervals. Lapse rate: the share of answers given at random. Side bias: "
        "how much better the trajectory shown first looks; before any answer, differences in utility have a standard "
        f"deviation of {contents.model.prior_scale:g}. Same on repeats: how many repeated questions were answered as "
        "before, with the exact interval of the share. "
        f"{'Same as others: how many questions that somebody else answered too were answered alike. ' * shared}"
        "Median time: the interval holds the median of all their answers, by order statistics; from five times on."
    )
    text = [f"{warning.what} {warning.remedy}" for warning in people_warnings(contents)]
    return text or ["No warnings about any person."], [Table(caption, head, rows)]


def people_warnings(contents: RunContents) -> list[ReportWarning]:
    """The warnings about each person, with their remedies."""
    table = _table(contents)
    several = table.sizes["answerer"] > 1
    return [
        warning
        for place in range(table.sizes["answerer"])
        for warning in _of_one(table.isel(answerer=place), several=several, given=contents.model.lapse_rate is not None)
    ]


def _table(contents: RunContents) -> xr.Dataset:
    return people(contents.past, contents.posterior)


def _row(one: xr.Dataset, *, given: bool, shared: bool) -> list[str]:
    repeated, seconds = int(one["repeated"]), float(one["seconds"])
    shares = [f"{int(one['consistent'])} of {repeated} ({_range(one, 'consistency')})" if repeated else "–"]
    if shared:
        both = int(one["shared"])
        shares.append(f"{int(one['agreed'])} of {both} ({_range(one, 'agreement')})" if both else "–")
    inferred = [
        "–" if np.isnan(float(one[name])) else f"{number(round(float(one[name]), 3))} ({_range(one, name)})"
        for name in ("lapse_rate", "side_bias")
    ]
    if given:
        inferred[0] = inferred[0].split(" ")[0] + " (set)"
    time = "–" if np.isnan(seconds) else f"{seconds:.1f} s"
    if not np.isnan(float(one["seconds_lower"])):
        time += f" ({float(one['seconds_lower']):.1f} to {float(one['seconds_upper']):.1f})"
    counts = [str(int(one[name])) for name in ("answers", "ties", "cannot_tell")]
    return [_name(one), *counts, *inferred, *shares, time]


def _range(one: xr.Dataset, name: str) -> str:
    low, high = (number(round(float(one[f"{name}_{end}"]), 3)) for end in ("lower", "upper"))
    return f"{low} to {high}"


def _name(one: xr.Dataset) -> str:
    return str(one["answerer"].item()) or "no name"


def _of_one(one: xr.Dataset, *, several: bool, given: bool) -> Iterator[ReportWarning]:
    name = str(one["answerer"].item()) or None
    who = name or "The person without a name"
    others = f"run.estimate_without({name!r}) infers the utility without them."
    rate, lower, upper = (float(one[f"lapse_rate{end}"]) for end in ("", "_lower", "_upper"))
    if given:  # the answers did not decide on it
        pass
    elif lower > LITTLE_WORTH:
        what = f"{who}: {percent(rate)} of the answers look random ({percent(lower)} to {percent(upper)})."
        yield ReportWarning(what, f"Drop them. {others}" if several else "Start a new run with someone else.")
    elif lower > LESS_TRUST:
        what = f"{who}: {percent(rate)} of the answers look random ({percent(lower)} to {percent(upper)})."
        yield ReportWarning(what, "The posterior already trusts them less. Ask more questions to make up for it.")
    repeated, consistent = int(one["repeated"]), int(one["consistent"])
    if float(one["consistency_upper"]) < RARELY_CONSISTENT:
        what = f"{who}: only {consistent} of {count(repeated, 'repeated question')} were answered as before."
        yield ReportWarning(what, "Ask again, with clearer instructions or longer trajectories.")
    bias, low, high = (float(one[f"side_bias{end}"]) for end in ("", "_lower", "_upper"))
    if low > 0 or high < 0:
        what = f"{who} favours the trajectory shown {'first' if bias > 0 else 'second'}."
        yield ReportWarning(what, "The posterior corrects for it; ask them to look at both before they answer.")
    unsure, told = int(one["cannot_tell"]), int(one["answers"])
    if unsure > MANY * max(FEW, unsure + told):
        what = f"{who} could not tell in {unsure} of {count(unsure + told, 'question')}."
        yield ReportWarning(what, "Show longer trajectories, or explain what to look for.")
    if float(one["seconds"]) < HASTY and told >= FEW:
        what = f"{who} took {float(one['seconds']):.1f} s in the median, less than it takes to watch two trajectories."
        yield ReportWarning(what, "Ask again, and ask them to watch both.")
