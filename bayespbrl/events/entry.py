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


def answered(query: int, answer: Answer, *, answerer: str | None = None, seconds: float | None = None) -> Entry:
    """The event of an answer to question number `query`; arguments as of `Learner.tell`.

    Raises:
      ValueError: an answerer that is no short name, or a time that is no finite number >= 0.
    """
    event: dict[str, Any] = {"event": "answered", "query": query, "answer": str(answer)}
    if answerer is not None:
        event["answerer"] = checks.short_name("answerer", answerer)
    if seconds is not None:
        event["seconds"] = checks.non_negative("seconds", seconds)
    return Entry(event)


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
