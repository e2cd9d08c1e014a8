"""The events of a run and the learner's state: the state is a fold over an append-only log of events.

Resuming a run, undoing an answer and reporting on a run in progress all use this fold. There are five events:

* `collected`: new trajectories (step 3), and which of them to ask about, in order (step 4); `restarted` where they
  follow the first policy again;
* `asked`: a question, with the order in which the two trajectories were shown, the number of the earlier question that
  it `repeats`, if any, and the `answerer` who is asked, where several people answer at once;
* `answered`: the expert's answer; `answerer`, the name of who gave it, and `seconds`, the time they took, where known;
* `improved`: a new estimate and a new policy (steps 1 and 2), which end an iteration;
* `undone`: the last answer and everything after it is taken back.
"""

import math
import operator
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from bayespbrl import checks
from bayespbrl.improvement.schedules import Bound
from bayespbrl.preferences import Answer, PastQuestion, Preferences, Query, parse_answer
from bayespbrl.settings import Settings
from bayespbrl.trajectories import Trajectory, clips_of
from bayespbrl.utility.estimate import UtilityEstimate

# Each state holds all answers so far: to keep every state would take memory by the square of their number.
MOST_UNDONE = 50


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

    def append(self, entry: Entry, state: "LearnerState") -> None: ...


@dataclass(frozen=True)
class Restart:
    """The policy was started anew.

    Attributes:
      iteration: iterations completed by then.
      number, policy, tried: of the policy that the run kept by then: its number, and its trajectories without noise.
    """

    iteration: int
    number: int
    policy: Any
    tried: tuple[Trajectory, ...]


@dataclass(frozen=True)
class LearnerState:
    """What the learner knows between two calls.

    Attributes:
      policy: the newest policy, which the next trajectories follow.
      first_policy: the one that a policy started anew begins with.
      best_policy: where updates are checked, the one that the posterior thinks best of the policies before the newest;
        the next update starts there after a step back.
      best: the number of the best policy, that is of the iterations before it; since a restart, where there was one.
      kept: the number of the policy that the run keeps: the best or, if the posterior prefers it, the newest; after a
        restart that kept before it, unless one of these is clearly better.
      tried, best_tried: trajectories of the newest and of the best policy without their noise, where updates are
        checked; () where there are none.
      trust: share of the KL bound that the next update may use; it falls after a step back.
      restart: when the policy was started anew, and what was kept by then; None: it was not.
      estimate: the last utility estimate; None before the first.
      bound: the last decision on the KL bound; None before the first.
      iteration: iterations completed.
      trajectories: all of them, by number.
      clips: first step and number of steps of the part of each that questions are about; () where they are about all.
      preferences: the answers so far.
      collected: whether the next iteration's trajectories are among them.
      candidates: trajectories to ask about in this iteration, best first.
      opponents: whom some of them are compared with; the newest undominated trajectory where it names none.
      information: what the answer about the first of them was expected to tell, nats; None where that is unknown.
      wanted: number of answers still wanted in this iteration.
      unasked: number of consecutive iterations, up to now, without a question.
      open: the questions that wait for an answer, in the order in which they were asked; where one person answers, one
        at most.
      queries: number of questions so far.
      past: the questions so far that were answered.
      shown: the trajectories that were shown in some question.
      summaries: one for each completed iteration.
      before: the states before the last answers, at most `MOST_UNDONE`, the newest last; they have none themselves.
    """

    policy: Any
    first_policy: Any = None
    best_policy: Any = None
    best: int = 0
    kept: int = 0
    tried: tuple[Trajectory, ...] = ()
    best_tried: tuple[Trajectory, ...] = ()
    trust: float = 1.0
    restart: Restart | None = None
    estimate: UtilityEstimate | None = None
    bound: Bound | None = None
    iteration: int = 0
    trajectories: tuple[Trajectory, ...] = ()
    clips: tuple[tuple[int, int], ...] = ()
    preferences: Preferences = field(default_factory=Preferences)
    collected: bool = False
    candidates: tuple[int, ...] = ()
    opponents: Mapping[int, int] = field(default_factory=dict)
    information: float | None = None
    wanted: int = 0
    unasked: int = 0
    open: tuple[Query, ...] = ()
    queries: int = 0
    past: tuple[PastQuestion, ...] = ()
    shown: frozenset[int] = frozenset()
    summaries: tuple[Mapping[str, Any], ...] = ()
    before: tuple["LearnerState", ...] = field(default=(), repr=False)

    def finished(self, settings: Settings) -> bool:
        """Whether a run with these settings ends here: after an iteration, not within one."""
        restart = None if self.restart is None else self.restart.iteration
        return not self.collected and settings.finished(self.iteration, self.preferences.answers, self.unasked, restart)

    def restarts(self, settings: Settings) -> bool:
        """Whether the next trajectories follow the first policy again."""
        return self.restart is None and settings.restarts(self.iteration, self.preferences.answers, self.unasked)

    @property
    def started(self) -> int:
        """Iterations completed when the present policy was started."""
        return 0 if self.restart is None else self.restart.iteration

    @property
    def query(self) -> Query | None:
        """The question that has waited longest for an answer; None if none does."""
        return self.open[0] if self.open else None

    @property
    def previous(self) -> "LearnerState | None":
        """The state before the last answer; None where no answer can be taken back."""
        return replace(self.before[-1], before=self.before[:-1]) if self.before else None

    @property
    def compared(self) -> tuple[Trajectory, ...]:
        """What questions are about, by the numbers of the trajectories: the trajectories, or a part of each."""
        return clips_of(self.trajectories, self.clips or None)

    @property
    def kept_policy(self) -> Any:
        """The policy number `kept`."""
        if self.restart is not None and self.kept == self.restart.number:
            return self.restart.policy
        return self.policy if self.kept == self.iteration else self.best_policy

    @property
    def kept_tried(self) -> tuple[Trajectory, ...]:
        """Trajectories of the policy number `kept` without its noise; () where it was not tried."""
        if self.restart is not None and self.kept == self.restart.number:
            return self.restart.tried
        return self.tried if self.kept == self.iteration else self.best_tried


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
            return _asked(state, event)
        case "answered":
            return _answered(state, event)
        case "improved":
            summary = _with_figures(event["summary"])
            iteration, check = operator.index(event["iteration"]), summary.get("check")  # of a checked update
            best = iteration if check is None else operator.index(check["best"])
            kept = operator.index(summary.get("kept", best))
            if check is not None and best not in (state.best, state.iteration):
                raise ValueError(f"improved: expected {state.best} or {state.iteration} as the best, got {best}")
            if kept not in (best, iteration, *(() if state.restart is None else (state.restart.number,))):
                raise ValueError(f"improved: expected policy {best} or {iteration} to be kept, got {kept}")
            last_is_best = best == state.iteration
            return replace(
                state,
                policy=entry.parts["policy"],
                best_policy=state.policy if last_is_best else state.best_policy,
                best=best,
                kept=kept,
                tried=tuple(entry.parts.get("tried", ())),
                best_tried=state.tried if last_is_best else state.best_tried,
                trust=1.0 if check is None else float(check["trust"]),
                estimate=entry.parts["estimate"],
                bound=Bound.recalled(event["summary"]["kl_bound"], event["summary"]["schedule"]),
                iteration=iteration,
                collected=False,
                candidates=(),
                wanted=0,
                summaries=(*state.summaries, event["summary"]),
            )
        case "undone":
            if (before := state.previous) is None:
                got = f"{MOST_UNDONE} undone" if state.past else "none yet"
                raise ValueError(f"undo: expected an answer to take back, got {got}")
            return before
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


def _with_figures(summary: Any) -> Mapping[str, Any]:
    """`summary`, where it has what all its readers need; `ValueError` where it has not."""
    if not has_figures(summary):
        raise ValueError(f"improved: expected a summary with answers and value, got {str(summary)[:60]}")
    return dict(summary)


def has_figures(summary: Any) -> bool:
    """Whether the summary of an iteration has what all its readers need: its number, answers and value."""
    if not isinstance(summary, Mapping):
        return False
    return all(
        isinstance(summary.get(name), int | float) and not isinstance(summary[name], bool)
        for name in ("iteration", "answers", "value")
    )


def _collected(state: LearnerState, event: Mapping[str, Any], parts: Mapping[str, Any]) -> LearnerState:
    candidates, preferences = tuple(event["candidates"]), state.preferences
    opponents = event.get("opponents")
    if not preferences.undominated and opponents is None:
        preferences, candidates = preferences.start(candidates[0]), candidates[1:]
    if event.get("restarted", False):
        kept = Restart(state.iteration, state.kept, state.kept_policy, state.kept_tried)
        state = replace(
            state,
            policy=state.first_policy,
            best=state.iteration,
            best_policy=None,
            tried=(),
            best_tried=(),
            trust=1.0,
            restart=kept,
        )
    return replace(
        state,
        trajectories=state.trajectories + tuple(parts["trajectories"]),
        clips=state.clips + clips_in(event),
        preferences=preferences,
        collected=True,
        candidates=candidates,
        opponents={} if opponents is None else dict(zip(candidates, opponents, strict=True)),
        information=event.get("information"),
        wanted=event["wanted"],
        unasked=0 if event["wanted"] else state.unasked + 1,
    )


def clips_in(event: Mapping[str, Any]) -> tuple[tuple[int, int], ...]:
    """First step and number of steps of the part of each trajectory that came with `collected`; () for all of them."""
    return tuple(
        (checks.whole("clips: first step", first, 0), checks.whole("clips: steps", steps))
        for first, steps in event.get("clips", ())
    )


def _asked(state: LearnerState, event: Mapping[str, Any]) -> LearnerState:
    shown, repeats = (event["first"], event["second"]), event.get("repeats")
    if any(not 0 <= number < len(state.trajectories) for number in shown):
        raise ValueError(f"asked: expected trajectories below {len(state.trajectories)}, got {shown}")
    if repeats is not None and (repeats, *shown[::-1]) not in [past[:3] for past in state.past]:
        raise ValueError(f"asked: expected a question that was asked before with sides swapped, got {dict(event)}")
    compared = state.compared
    both = (compared[shown[0]], compared[shown[1]])
    rivals, answerer = event.get("rivals"), event.get("answerer")
    if answerer is not None:
        checks.short_name("answerer", answerer)
    if rivals is None and event["newcomer"] in shown and repeats is None:
        incumbent = shown[shown[0] == event["newcomer"]]
        newest = incumbent in state.preferences.undominated[-1:]
        rivals = state.preferences.tied_with(incumbent) if newest else None
    rivals = None if rivals is None else tuple(rivals)
    query = Query(event["query"], *shown, event["newcomer"], both, repeats, rivals, answerer)
    return replace(state, open=(*state.open, query), queries=query.number, shown=state.shown.union(shown))


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


def _answered(state: LearnerState, event: Mapping[str, Any]) -> LearnerState:
    query = next((waiting for waiting in state.open if waiting.number == event["query"]), None)
    if query is None:
        waiting = [waiting.number for waiting in state.open]
        raise ValueError(f"answered: expected an answer to an open question of {waiting}, got one to {event['query']}")
    answer, answerer, seconds = parse_answer(event["answer"]), event.get("answerer"), event.get("seconds")
    if answerer is not None:
        checks.short_name("answerer", answerer)
    if seconds is not None:
        checks.non_negative("seconds", seconds)
    left, again = state.candidates, query.repeats is not None
    if not again:
        left = tuple(number for number in left if number != query.newcomer)
    shown = (query.number, query.first, query.second, query.newcomer, query.repeats)
    past = (*state.past, PastQuestion(*shown, answer, answerer, seconds))
    after = replace(state, open=tuple(each for each in state.open if each is not query), candidates=left, past=past)
    after = replace(after, before=(*state.before[1 - MOST_UNDONE :], replace(state, before=())))
    if answer is Answer.SKIP:
        return after
    preferred = {Answer.FIRST: query.first, Answer.SECOND: query.second, Answer.TIE: None}[answer]
    if again:
        more = state.preferences.add_repeated(query.first, query.second, preferred=preferred, answerer=answerer)
        return replace(after, preferences=more)
    preferences = state.preferences.add(
        query.newcomer,
        query.incumbent,
        preferred=preferred,
        rivals=query.rivals,
        shown_first=query.first,
        answerer=answerer,
    )
    return replace(after, preferences=preferences, wanted=max(0, state.wanted - 1))


def plain(value: Any) -> Any:
    """`value` as JSON gives it back: NumPy numbers as Python's, tuples as lists, NaN and infinity as None."""
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
