"""The readable part of a run's log: the learner's state without its heavy parts, answers, summaries.

The events are applied as the learner applies them. Where one cannot be applied, those before it count, and a warning
says why.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from bayespbrl import events
from bayespbrl.diagnostics.report.document import ReportWarning
from bayespbrl.events import Entry, LearnerState
from bayespbrl.policies import Policy
from bayespbrl.preferences import Answer, Query
from bayespbrl.runs.directory import PartialLine, read_log_lines, read_summary
from bayespbrl.settings import Settings

Summary = Mapping[str, Any]  # the figures of one iteration, as JSON has them
Event = Mapping[str, Any]
Pairs = tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class AnsweredQuestion:
    """One question that was answered.

    Attributes:
      question: its number, from 1.
      iteration: in which it was answered, from 1; of several people, one may answer a question of an earlier iteration.
      first, second: numbers of the two trajectories in the order shown.
      answer: the expert's.
      row: which of the ordered pairs it is, or which of the ties; None of a skip.
      predicted: probability that the first is preferred, given that either is, by the estimate that the learner had
        when it was answered; NaN where that has no posterior or cannot be read.
      stated: probability that either is, by the same; 1 if it has seen no tie.
      answerer, seconds: who answered, and how long they took; None where that is not known.
    """

    question: int
    iteration: int
    first: int
    second: int
    answer: Answer
    row: int | None
    predicted: float = float("nan")
    stated: float = 1.0
    answerer: str | None = None
    seconds: float | None = None

    @property
    def states_order(self) -> bool:
        """Whether it says that one of the two is better."""
        return self.answer in (Answer.FIRST, Answer.SECOND)

    @property
    def before(self) -> float:
        """The predicted probability of the answer that was given; NaN of a skip, or of a tie before `stated` < 1."""
        if self.answer is Answer.TIE and np.isfinite(self.predicted) and self.stated < 1:
            return 1 - self.stated
        if not self.states_order:
            return float("nan")
        return self.stated * (self.predicted if self.answer is Answer.FIRST else 1 - self.predicted)


@dataclass(frozen=True)
class RunLog:
    """The readable part of a log.

    Attributes:
      state: the learner's, with None in place of trajectories, policy and estimate.
      answers: in their order, without those taken back.
      summaries: of the completed iterations.
      damage: one warning for each thing that cannot be read.
    """

    state: LearnerState
    answers: tuple[AnsweredQuestion, ...]
    summaries: tuple[Summary, ...]
    damage: tuple[ReportWarning, ...]


def read_log(path: Path, settings: Settings) -> RunLog:
    """Read `events.jsonl` and `summary.json` of the run directory `path`, complete or not."""
    damage: list[ReportWarning] = []
    state, answers = _applied(_surviving_events(path, damage), settings, damage)
    return RunLog(state, tuple(answers), _summaries(path, state, damage), tuple(damage))


def _damage(text: str) -> ReportWarning:
    remedy = "The report uses the part that can be read. Restore the file from a copy before you continue the run."
    return ReportWarning(f"Missing data: {text}.", remedy)


def _surviving_events(path: Path, damage: list[ReportWarning]) -> Sequence[Event]:
    """The events up to the first unreadable line, without those that were undone."""
    try:
        lines = read_log_lines(path / "events.jsonl")
    except OSError as error:
        damage.append(_damage(f"events.jsonl cannot be read ({error})"))
        return []
    log: list[Event] = []
    for line in lines:
        if isinstance(line, PartialLine):
            remedy = "No action is needed if nothing else is damaged: bayespbrl resume drops this line and continues."
            damage.append(ReportWarning(f"Missing data: {line}, as a process killed while writing leaves it.", remedy))
        elif isinstance(line, ValueError):
            damage.append(_damage(f"{line}; this line and all that follow are left out"))
            break
        else:
            log.append(line)
    try:
        return events.surviving(log)
    except ValueError as error:
        damage.append(_damage(f"events.jsonl: {error}"))
        return [event for event in log if event["event"] != "undone"]


def _applied(
    log: Sequence[Event], settings: Settings, damage: list[ReportWarning]
) -> tuple[LearnerState, list[AnsweredQuestion]]:
    """The learner's state without its heavy parts, and the answers."""
    # stand-ins: applying an event only needs the heavy parts to be there
    none = cast(Policy, None)
    state, answers = LearnerState.begun(none), []
    parts = {"trajectories": [None] * settings.rollouts.trajectories_per_iteration, "policy": None, "estimate": None}
    clips: list[tuple[int, int]] = []
    for event in log:
        asked, before = {query.number: query for query in state.open}, state.preferences
        try:
            if event["event"] == "collected":
                clips += events.clips_in(event)
            state = events.replay(state, [Entry({**event, "clips": ()}, parts)])
        except (ValueError, TypeError) as error:
            damage.append(_damage(f"events.jsonl: {error}; what follows is left out"))
            break
        if event["event"] == "answered":
            query = asked[event["query"]]
            answer = Answer(event["answer"])
            row = _row(before.ties, state.preferences.ties, query)
            row = _row(before.pairs, state.preferences.pairs, query) if row is None else row
            who = {name: event[name] for name in ("answerer", "seconds") if name in event}
            shown = (query.first, query.second)
            answers.append(AnsweredQuestion(query.number, state.iteration + 1, *shown, answer, row, **who))
    return replace(state, clips=tuple(clips)), answers


def _row(before: Pairs, after: Pairs, query: Query) -> int | None:
    """The place of the two trajectories of a question among the pairs that its answer added."""
    new = range(len(before), len(after))
    return next((row for row in new if {*after[row]} == {query.first, query.second}), None)


def _summaries(path: Path, state: LearnerState, damage: list[ReportWarning]) -> tuple[Summary, ...]:
    """Summaries by the log, or by `summary.json` where the log has fewer."""
    logged = tuple(summary for summary in state.summaries if isinstance(summary, Mapping))
    if not (path / "summary.json").exists():
        return logged
    try:
        kept = read_summary(path)["iterations"]
    except ValueError as error:
        damage.append(_damage(str(error)))
        return logged
    kept = tuple(summary for summary in kept if isinstance(summary, Mapping)) if isinstance(kept, list) else ()
    if len(kept) <= len(logged):
        return logged
    what = f"events.jsonl holds {len(logged)} completed iterations, summary.json {len(kept)}."
    remedy = (
        "The report uses summary.json. Unless an interruption explains the difference, restore the log from a copy: "
        "the run cannot continue without it."
    )
    damage.append(ReportWarning(f"Missing data: {what}", remedy))
    return kept
