"""The log of a run as far as it can be read: the learner's state without its heavy parts, the answers, the summaries.

The same fold as the learner's own; where it cannot go on, what is read so far counts, and a sentence says why.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bayespbrl import events
from bayespbrl.events import Entry, LearnerState
from bayespbrl.preferences import Answer
from bayespbrl.runs.directory import read_summary
from bayespbrl.settings import Settings


@dataclass(frozen=True)
class AnswerRecord:
    """One question that was answered.

    Attributes:
      question: its number, from 1.
      iteration: in which it was asked, from 1.
      first, second: numbers of the two trajectories in the order shown.
      answer: what the expert said.
      row: which of the K ordered pairs it is; None where it gave none (a tie, a skip).
      predicted: probability that the first is preferred, by the estimate that the learner had when it asked; NaN where
        that was no posterior or cannot be read.
    """

    question: int
    iteration: int
    first: int
    second: int
    answer: Answer
    row: int | None
    predicted: float = float("nan")


@dataclass(frozen=True)
class RunLog:
    """What the log says.

    Attributes:
      state: the learner's, with None in place of trajectories, policy and estimate.
      answers: in their order, those taken back left out.
      summaries: of the completed iterations.
      collected: how many iterations have trajectories.
      broken: what could not be read, a sentence each.
    """

    state: LearnerState
    answers: tuple[AnswerRecord, ...]
    summaries: tuple[Mapping[str, Any], ...]
    collected: int
    broken: tuple[str, ...]


def read_log(path: Path, settings: Settings) -> RunLog:
    """Read `events.jsonl` and `summary.json` of the run directory `path`, whole or not."""
    broken: list[str] = []
    state, answers, collected = _folded(_surviving(path, broken), settings, broken)
    summaries = _summaries(path, state, broken)
    return RunLog(state, tuple(answers), summaries, collected, tuple(broken))


def _surviving(path: Path, broken: list[str]) -> list[Mapping[str, Any]]:
    """The events up to the first line that is none, what was undone left out."""
    file = path / "events.jsonl"
    if not file.exists():
        return []
    try:
        *lines, rest = file.read_text(encoding="utf-8", errors="replace").split("\n")
    except OSError as error:
        broken.append(f"events.jsonl cannot be read ({error}).")
        return []
    if rest:
        broken.append("events.jsonl: the last line is cut off, as a process killed while writing leaves it.")
    log: list[Mapping[str, Any]] = []
    for number, line in enumerate(lines, start=1):
        try:
            event = json.loads(line)
        except ValueError:
            event = None
        if not isinstance(event, dict) or "event" not in event:
            broken.append(f"events.jsonl, line {number}: no event; this line and what follows is left out.")
            break
        log.append(event)
    try:
        return events.surviving(log)
    except ValueError as error:
        broken.append(f"events.jsonl: {error}.")
        return [event for event in log if event["event"] != "undone"]


def _folded(
    log: list[Mapping[str, Any]], settings: Settings, broken: list[str]
) -> tuple[LearnerState, list[AnswerRecord], int]:
    """The learner's state without its heavy parts, the answers, and how many iterations have trajectories."""
    state, records, collected = LearnerState(None), [], 0
    # what the fold asks of the heavy parts is that they are there
    parts = {"trajectories": [None] * settings.trajectories_per_iteration, "policy": None, "estimate": None}
    for event in log:
        query, pairs = state.query, len(state.preferences.pairs)
        try:
            state = events.replay(state, [Entry(event, parts)])
        except ValueError as error:
            broken.append(f"events.jsonl: {error}; what follows is left out.")
            break
        if event["event"] == "collected":
            collected += 1
        elif event["event"] == "answered" and query is not None:
            after = len(state.preferences.pairs)
            row = after - 1 if after > pairs else None  # the pair that was asked about is the last of its answer's
            answer = Answer(event["answer"])
            records.append(AnswerRecord(query.number, state.iteration + 1, query.first, query.second, answer, row))
    return state, records, collected


def _summaries(path: Path, state: LearnerState, broken: list[str]) -> tuple[Mapping[str, Any], ...]:
    """Summaries by the log, or by `summary.json` where the log has fewer."""
    logged = tuple(summary for summary in state.summaries if isinstance(summary, Mapping))
    if not (path / "summary.json").exists():
        return logged
    try:
        kept = read_summary(path)["iterations"]
    except ValueError as error:
        broken.append(f"{error}.")
        return logged
    kept = tuple(summary for summary in kept if isinstance(summary, Mapping)) if isinstance(kept, list) else ()
    if len(kept) > len(logged):
        broken.append(f"events.jsonl holds {len(logged)} completed iterations, summary.json {len(kept)}.")
        return kept
    return logged
