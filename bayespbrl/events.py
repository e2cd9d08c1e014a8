"""The events of a run and the learner's state: the state is a fold over an append-only log of events.

Resuming a run, undoing an answer and reporting on a run in progress all use this fold. There are five events:

* `collected`: new trajectories (step 3), and which of them to ask about, in order (step 4);
* `asked`: a question, with the order in which the two trajectories were shown;
* `answered`: the expert's answer;
* `improved`: a new estimate and a new policy (steps 1 and 2), which end an iteration;
* `undone`: the last answer and everything after it is taken back.
"""

import math
import operator
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from bayespbrl.improvement.schedules import Bound
from bayespbrl.preferences import Answer, Preferences, Query, parse_answer
from bayespbrl.trajectories import Trajectory
from bayespbrl.utility.estimate import UtilityEstimate


@dataclass(frozen=True)
class Entry:
    """One event and the heavy parts that came with it.

    Attributes:
      event: plain data, one line of the log.
      parts: `trajectories` of `collected`; `trajectories`, `policy` and `estimate` of `improved`.
    """

    event: Mapping[str, Any]
    parts: Mapping[str, Any] = field(default_factory=dict)


class Log(Protocol):
    """Keeps each entry, and the state after it, before the learner moves on."""

    def append(self, entry: Entry, state: "LearnerState") -> None: ...


@dataclass(frozen=True)
class LearnerState:
    """What the learner knows between two calls.

    Attributes:
      policy: the current policy.
      estimate: the last utility estimate; None before the first.
      bound: the last decision on the KL bound; None before the first.
      iteration: iterations completed.
      trajectories: all of them, by number.
      preferences: the answers so far.
      collected: whether the next iteration's trajectories are among them.
      candidates: trajectories to ask about in this iteration, best first.
      wanted: number of answers still wanted in this iteration.
      unasked: number of consecutive iterations, up to now, without a question.
      query: the question that waits for an answer; None if none does.
      queries: number of questions so far.
      shown: the trajectories that were shown in some question.
      summaries: one for each completed iteration.
      previous: the state before the last answer.
    """

    policy: Any
    estimate: UtilityEstimate | None = None
    bound: Bound | None = None
    iteration: int = 0
    trajectories: tuple[Trajectory, ...] = ()
    preferences: Preferences = field(default_factory=Preferences)
    collected: bool = False
    candidates: tuple[int, ...] = ()
    wanted: int = 0
    unasked: int = 0
    query: Query | None = None
    queries: int = 0
    shown: frozenset[int] = frozenset()
    summaries: tuple[Mapping[str, Any], ...] = ()
    previous: "LearnerState | None" = field(default=None, repr=False)


def apply(state: LearnerState, entry: Entry) -> LearnerState:
    """The state after one more event.

    Raises:
      ValueError: an unknown event, or one that cannot follow this state.
    """
    event = entry.event
    match event.get("event"):
        case "collected":
            return _collected(state, event, entry.parts)
        case "asked":
            shown = (event["first"], event["second"])
            if any(not 0 <= number < len(state.trajectories) for number in shown):
                raise ValueError(f"asked: expected trajectories below {len(state.trajectories)}, got {shown}")
            both = (state.trajectories[shown[0]], state.trajectories[shown[1]])
            query = Query(event["query"], *shown, event["newcomer"], both)
            return replace(state, query=query, queries=event["query"], shown=state.shown.union(shown))
        case "answered":
            return _answered(state, event)
        case "improved":
            return replace(
                state,
                policy=entry.parts["policy"],
                estimate=entry.parts["estimate"],
                bound=Bound.recalled(event["summary"]["kl_bound"], event["summary"]["schedule"]),
                iteration=operator.index(event["iteration"]),
                collected=False,
                candidates=(),
                wanted=0,
                summaries=(*state.summaries, event["summary"]),
            )
        case "undone":
            if state.previous is None:
                raise ValueError("undo: expected an answer to take back, got none yet")
            return state.previous
        case other:
            raise ValueError(f"event: expected collected, asked, answered, improved or undone, got {other!r}")


def replay(state: LearnerState, entries: Iterable[Entry]) -> LearnerState:
    """The state after all of `entries`.

    Raises:
      ValueError: as `apply`; also an incomplete event, as in a foreign log.
    """
    for entry in entries:
        try:
            state = apply(state, entry)
        except (KeyError, TypeError, IndexError, AttributeError) as error:
            reason = f"{type(error).__name__} {error}"
            raise ValueError(f"event: expected a complete one, got {dict(entry.event)} ({reason})") from error
    return state


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


def _collected(state: LearnerState, event: Mapping[str, Any], parts: Mapping[str, Any]) -> LearnerState:
    candidates, preferences = tuple(event["candidates"]), state.preferences
    if not preferences.undominated:
        preferences, candidates = preferences.start(candidates[0]), candidates[1:]
    return replace(
        state,
        trajectories=state.trajectories + tuple(parts["trajectories"]),
        preferences=preferences,
        collected=True,
        candidates=candidates,
        wanted=event["wanted"],
        unasked=0 if event["wanted"] else state.unasked + 1,
    )


def _answered(state: LearnerState, event: Mapping[str, Any]) -> LearnerState:
    query = state.query
    if query is None or query.number != event["query"]:
        raise ValueError(f"answered: expected an answer to {query}, got one to question {event['query']}")
    left = tuple(number for number in state.candidates if number != query.newcomer)
    after = replace(state, query=None, candidates=left, previous=state)
    answer = parse_answer(event["answer"])
    if answer is Answer.SKIP:
        return after
    preferred = {Answer.FIRST: query.first, Answer.SECOND: query.second, Answer.TIE: None}[answer]
    preferences = state.preferences.add(query.newcomer, query.incumbent, preferred=preferred)
    return replace(after, preferences=preferences, wanted=state.wanted - 1)


def plain(value: Any) -> Any:
    """`value` as JSON gives it back: NumPy numbers as Python's, tuples as lists, NaN and infinity as None."""
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
