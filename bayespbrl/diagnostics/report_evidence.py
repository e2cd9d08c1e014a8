"""What can be read of a run directory, finished, in progress or broken: the evidence that the report is made of.

The same fold over the log as the learner's own, but a file that cannot be read costs what is in it and nothing more.
"""

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from bayespbrl import events
from bayespbrl.diagnostics.predictions import PREFERRED, answer_probabilities
from bayespbrl.envs.opening import open_environment
from bayespbrl.events import Entry, LearnerState
from bayespbrl.features import checked_features
from bayespbrl.preferences import Answer, Preferences
from bayespbrl.runs import RunDirectory, read_parts, read_summary
from bayespbrl.settings import Settings
from bayespbrl.trajectories import Trajectory, trajectory_features

WITHOUT_POSTERIOR = ("linear-program", "known-reward")


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
class Evidence:
    """What a run left behind.

    Attributes:
      path, settings: of the run.
      iterations: summaries of the completed iterations.
      answers: in their order, those taken back left out.
      preferences: what follows from them.
      trajectories: by number, those that can be read.
      estimate: the newest utility estimate that can be read, which is that after iteration `estimate_iteration`; None
        and 0 without any.
      features_missing: why the estimate's φ, a function of the user's, cannot be used; empty where it can.
      environment: opened; None where it cannot be.
      waiting: the number of the question that waits for an answer.
      broken: what could not be read, a sentence each.
    """

    path: Path
    settings: Settings
    iterations: tuple[Mapping[str, Any], ...] = ()
    answers: tuple[AnswerRecord, ...] = ()
    preferences: Preferences = field(default_factory=Preferences)
    trajectories: Mapping[int, Trajectory] = field(default_factory=dict)
    estimate: Any = None
    estimate_iteration: int = 0
    features_missing: str = ""
    environment: Any = None
    waiting: int | None = None
    broken: tuple[str, ...] = ()

    @property
    def finished(self) -> bool:
        return len(self.iterations) >= self.settings.iterations

    @property
    def posterior(self) -> xr.DataTree | None:
        """Draws of the estimate; None where it is no posterior."""
        return getattr(self.estimate, "posterior", None)

    @property
    def dynamics(self) -> Any:
        """The environment's pure functions, where it has some."""
        return getattr(getattr(self.environment, "unwrapped", None), "dynamics", None)


def read_evidence(directory: Path | str, *, env: Any = None, features: Any = None) -> Evidence:
    """Read all that can be read of a run directory, and change nothing.

    Args:
      directory: of a run, finished or not, whole or not.
      env, features: what the run was started with, where these were objects of the user's.

    Raises:
      ValueError: a directory that is no run, or one of a newer version.
    """
    log = RunDirectory.open(directory)
    broken: list[str] = []
    kept = _surviving(log.path, broken)
    state, records, done = _folded(kept, log.settings, broken)
    summaries = _summaries(log.path, state, broken)
    environment = _environment(log.settings.env if env is None else env, broken)
    reader = _Reader(log, features, broken)
    for number in range(1, max(done, len(summaries)) + 1):
        records = reader.read(number, records, improved=number <= len(summaries))
    return Evidence(
        path=log.path,
        settings=log.settings,
        iterations=summaries,
        answers=tuple(records),
        preferences=state.preferences,
        trajectories=reader.trajectories,
        estimate=reader.estimate,
        estimate_iteration=reader.estimate_iteration,
        features_missing=reader.features_missing,
        environment=environment,
        waiting=None if state.query is None else state.query.number,
        broken=tuple(broken),
    )


def _not_passed(states: np.ndarray) -> np.ndarray:
    raise ValueError("features: expected those that the run was started with, got none")


class _Reader:
    """Reads one iteration's file after the other, and predicts its answers by the estimate from before them."""

    def __init__(self, log: RunDirectory, features: Callable[[np.ndarray], np.ndarray] | None, broken: list[str]):
        self.log, self.broken, self.features, self.features_missing = log, broken, features, ""
        if features is None and log.settings.features == "other":
            self.features, self.features_missing = _not_passed, "it was not passed again"
        self.trajectories: dict[int, Trajectory] = {}
        self.estimate: Any = None
        self.estimate_iteration = 0

    def read(self, number: int, records: list[AnswerRecord], *, improved: bool) -> list[AnswerRecord]:
        """`records` with the predictions of the answers of iteration `number`."""
        file = self.log.iteration_file(number)
        parts: dict[str, Any] = {}
        try:
            parts = read_parts(
                file, ("trajectories", "estimate") if improved else ("trajectories",), features=self.features
            )
        except ValueError as error:
            self.broken.append(f"iterations/{error}.")
            with suppress(ValueError):  # it may be only the estimate that cannot be read
                parts = read_parts(file, ("trajectories",))
        if not parts:
            return records
        first = (number - 1) * self.log.settings.trajectories_per_iteration
        self.trajectories |= dict(enumerate(parts["trajectories"], start=first))
        if self.estimate_iteration == number - 1:
            records = [self._predicted(record) if record.iteration == number else record for record in records]
        if "estimate" in parts:
            self.estimate, self.estimate_iteration = parts["estimate"], number
            self.features_missing = self.features_missing or self._failure(parts["trajectories"][0])
        return records

    def _failure(self, trajectory: Trajectory) -> str:
        """What is wrong with features that were passed."""
        if self.features is None or not hasattr(self.estimate, "weights"):
            return ""
        try:
            number = checked_features(self.features, trajectory.states).shape[1]
        except Exception as error:  # a function of the user's may raise anything
            return f"the one that was passed fails ({type(error).__name__}: {' '.join(str(error).split())})"
        expected = len(self.estimate.weights)
        return "" if number == expected else f"the one that was passed has {number} features, the run's {expected}"

    def _predicted(self, record: AnswerRecord) -> AnswerRecord:
        numbers = (record.first, record.second)
        both = [self.trajectories[number] for number in numbers if number in self.trajectories]
        if self.log.settings.utility in WITHOUT_POSTERIOR or len(both) < 2:
            return record
        if self.estimate is None:
            probability = 0.5  # before any answer, the prior says nothing of which is better
        elif getattr(self.estimate, "posterior", None) is None or self.features_missing:
            return record
        else:
            sums = trajectory_features(both, self.estimate.features, discount=self.estimate.discount)
            difference = (sums[[0]] - sums[[1]]) / self.estimate.scale
            probability = float(answer_probabilities(self.estimate.posterior, difference)[0, PREFERRED])
        return AnswerRecord(**{**vars(record), "predicted": probability})


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
        query, pairs, iteration = state.query, len(state.preferences.pairs), state.iteration + 1
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
            records.append(AnswerRecord(query.number, iteration, query.first, query.second, answer, row))
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


def _environment(env: Any, broken: list[str]) -> Any:
    try:
        return open_environment(env)
    except ValueError as error:
        broken.append(f"The environment cannot be opened ({error}): what needs it is left out.")
        return None
