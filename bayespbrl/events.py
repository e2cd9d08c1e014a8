"""What happens in a run, and the learner's state that follows from it: a fold over an append-only log.

Resume, undo, a person who answers next week and a report on a run in progress are all this fold. Five events:

* `collected`: step 3 brought new trajectories, and these of them are to be asked about, in this order;
* `asked`: a question was put, with the order in which the two were shown;
* `answered`: the expert said something;
* `improved`: steps 1 and 2 made a new estimate and a new policy: the end of an iteration;
* `undone`: the last answer was taken back, and everything that followed from it.
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
      parts: `collected` brings `trajectories`; `improved` brings `trajectories`, `policy` and `estimate`.
    """

    event: Mapping[str, Any]
    parts: Mapping[str, Any] = field(default_factory=dict)


class Log(Protocol):
    """Where entries go before the learner moves on, with the state that each leads to."""

    def append(self, entry: Entry, state: "LearnerState") -> None: ...


@dataclass(frozen=True)
class LearnerState:
    """Everything the learner knows between two calls.

    Attributes:
      policy: the current policy.
      estimate: the last utility estimate; None before the first.
      bound: the last decision on the KL bound; None before the first.
      iteration: iterations completed.
      trajectories: all of them, by number.
      preferences: the answers so far.
      collected: whether the next iteration's trajectories are among them.
      candidates: trajectories to ask about in this iteration, best first.
      wanted: answers still wanted in this iteration.
      unasked: iterations in a row, up to now, that wanted none.
      query: the question that waits for an answer.
      queries: questions put so far.
      shown: the trajectories that some question showed.
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
      ValueError: an event there is not, or one that cannot follow this state.
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
      ValueError: as `apply`; also an event that lacks what it should say, as in a foreign log.
    """
    for entry in entries:
        try:
            state = apply(state, entry)
        except (KeyError, TypeError, IndexError, AttributeError) as error:
            reason = f"{type(error).__name__} {error}"
            raise ValueError(f"event: expected a complete one, got {dict(entry.event)} ({reason})") from error
    return state


def surviving(log: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The events that lead to the same state without any undoing.

    What was undone is left out, and not only to save time: its heavy parts may have been written over since.

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
    """An event as it will be read back from JSON: NumPy numbers as Python's, what is not finite as None."""
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
