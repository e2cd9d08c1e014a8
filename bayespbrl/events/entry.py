"""One event of a run, and the plain data that a log keeps of it."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from bayespbrl import checks
from bayespbrl.events.state import LearnerState
from bayespbrl.preferences import Answer


@dataclass(frozen=True)
class Entry:
    """One event and the heavy parts that came with it.

    Attributes:
      event: plain data, one line of the log.
      parts: `trajectories` of `collected`; `trajectories`, `tried`, `policy` and `estimate` of `improved`.
    """

    event: Mapping[str, Any]
    parts: Mapping[str, Any] = field(default_factory=dict)


class Log(Protocol):
    """Keeps each entry, and the state after it, before the learner moves on."""

    def append(self, entry: Entry, state: LearnerState) -> None: ...


MOST_REPLAYS = 10_000  # that are kept of one question


def answered(
    query: int,
    answer: Answer,
    *,
    answerer: str | None = None,
    seconds: float | None = None,
    session: str | None = None,
    replays: int | None = None,
) -> Entry:
    """The event of an answer to question number `query`.

    Args:
      answerer, seconds: as in `Learner.tell`.
      session: of the sitting, the same in all its answers.
      replays: how often the clips began again while the question was shown.

    Raises:
      ValueError: an answerer or session that is no short name, a time that is no finite number >= 0, or replays that
        are no whole number from 0 to `MOST_REPLAYS`.
    """
    about = {"answerer": answerer, "seconds": seconds, "session": session, "replays": replays}
    return Entry({"event": "answered", "query": query, "answer": str(answer), **checked_about(about)})


def undone(answerer: str | None = None) -> Entry:
    """The event of an undo by this person; `ValueError` where that is no short name."""
    return Entry({"event": "undone", **checked_about({"answerer": answerer})})


def checked_about(event: Mapping[str, Any]) -> dict[str, Any]:
    """What an event says about who answered and how, of what is known; `ValueError` as in `answered`."""
    known: dict[str, Any] = {}
    for name in ("answerer", "session"):
        if event.get(name) is not None:
            known[name] = checks.short_name(name, event[name])
    if event.get("seconds") is not None:
        known["seconds"] = checks.non_negative("seconds", event["seconds"])
    if event.get("replays") is not None:
        known["replays"] = checks.whole("replays", event["replays"], 0, most=MOST_REPLAYS)
    return known


def surviving(log: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The events without those that were undone, which lead to the same state.

    The heavy parts of an undone event may have been overwritten since, so it cannot be replayed.

    Raises:
      ValueError: an `undone` without an answer before it.
    """
    kept: list[Mapping[str, Any]] = []
    for event in log:
        if event.get("event") != "undone":
            kept.append(event)
            continue
        answers = [number for number, earlier in enumerate(kept) if earlier.get("event") == "answered"]
        if not answers:
            raise ValueError("undo: expected an answer to take back, got none yet")
        del kept[answers[-1] :]
    return kept


def has_figures(summary: Any) -> bool:
    """Whether the summary of an iteration has what all its readers need: its number, answers and value."""
    if not isinstance(summary, Mapping):
        return False
    return all(
        isinstance(summary.get(name), int | float) and not isinstance(summary[name], bool)
        for name in ("iteration", "answers", "value")
    )


def clips_in(event: Mapping[str, Any]) -> tuple[tuple[int, int], ...]:
    """First step and number of steps of the part of each trajectory that came with `collected`; () for all of them."""
    return tuple(
        (checks.whole("clips: first step", first, 0), checks.whole("clips: steps", steps))
        for first, steps in event.get("clips", ())
    )


def plain(value: Any) -> Any:
    """`value` as JSON gives it back: NumPy numbers as Python's, tuples as lists, NaN and infinity as None."""
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
