"""The fold: the learner's state after one more event."""

import operator
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from bayespbrl import checks
from bayespbrl.events.entry import Entry, checked_about, clips_in, has_figures
from bayespbrl.events.state import LearnerState, NumberedPolicy, Restart
from bayespbrl.improvement.schedules import Bound
from bayespbrl.preferences import Answer, PastQuestion, Query, parse_answer

# Each state holds all answers so far: to keep every state would take memory by the square of their number.
MOST_UNDONE = 50
ABOUT = ("seconds", "session", "replays")  # the last fields of a `PastQuestion`


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
            return _improved(state, event, entry.parts)
        case "undone":
            checked_about(event)
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
        except (KeyError, TypeError, IndexError, AttributeError, OverflowError) as error:
            reason = f"{type(error).__name__} {error}"
            raise ValueError(f"event: expected a complete event, got {dict(entry.event)} ({reason})") from error
    return state


def _improved(state: LearnerState, event: Mapping[str, Any], parts: Mapping[str, Any]) -> LearnerState:
    if not has_figures(event["summary"]):
        raise ValueError(f"improved: expected a summary with answers and value, got {str(event['summary'])[:60]}")
    iteration, found = _next_iteration(state, event), event if "bound" in event else _by_summary(event["summary"])
    check = found["check"]  # of a checked update
    best = iteration if check is None else operator.index(check["best"])
    kept = best if found["kept"] is None else operator.index(found["kept"])
    if check is not None and best not in (state.best.number, state.iteration):
        raise ValueError(f"improved: expected {state.best.number} or {state.iteration} as the best, got {best}")
    restart, confirmed = state.restart, event.get("confirmed", False)
    if confirmed and restart is not None:
        restart = replace(restart, kept=state.newest)
    newest = NumberedPolicy(iteration, parts["policy"], tuple(parts.get("tried", ())))
    of_best = newest if check is None else state.newest if best == state.iteration else state.best
    choice = {best: of_best, iteration: newest} | ({} if restart is None else {restart.kept.number: restart.kept})
    if kept not in choice:
        raise ValueError(f"improved: expected policy {best} or {iteration} to be kept, got {kept}")
    return replace(
        state,
        newest=newest,
        best=of_best,
        kept=choice[kept],
        trust=1.0 if check is None else float(check["trust"]),
        restart=restart,
        nominated=restart is not None and event.get("nominated", False) is True,
        estimate=parts["estimate"],
        bound=Bound(**found["bound"]),
        values=(*state.values, float(found["value"])),
        iteration=iteration,
        collected=False,
        candidates=(),
        wanted=0,
        summaries=(*state.summaries, event["summary"]),
    )


def _next_iteration(state: LearnerState, event: Mapping[str, Any]) -> int:
    """The iteration of an event `collected` or `improved`; `ValueError` where that cannot follow."""
    iteration, collected = operator.index(event["iteration"]), event["event"] == "improved"
    if iteration != state.iteration + 1 or state.collected != collected:
        follows = f"{'improved' if state.collected else 'collected'} of iteration {state.iteration + 1}"
        raise ValueError(f"{event['event']}: expected {follows}, got {event['event']} of iteration {iteration}")
    return iteration


def _by_summary(summary: Mapping[str, Any]) -> Mapping[str, Any]:
    """What `improved` has beside its summary, for a log of earlier versions, where only the summary has it."""
    figures = {name: value for name, value in summary["schedule"].items() if name not in ("reason", "signal")}
    said = {"reason": summary["schedule"].get("reason", ""), "signal": summary["schedule"].get("signal")}
    bound = {"kl_bound": summary["kl_bound"], **said, "statistics": figures}
    value = summary.get("value_newest", summary["value"])
    return {"check": summary.get("check"), "kept": summary.get("kept"), "bound": bound, "value": value}


def _collected(state: LearnerState, event: Mapping[str, Any], parts: Mapping[str, Any]) -> LearnerState:
    _next_iteration(state, event)
    candidates, preferences = tuple(event["candidates"]), state.preferences
    opponents = event.get("opponents")
    if not preferences.undominated and opponents is None:
        preferences, candidates = preferences.start(candidates[0]), candidates[1:]
    if event.get("restarted", False):
        if state.restart is not None or not state.kept.number:
            raise ValueError(
                f"collected: expected at most one restart, of a run that keeps a policy, got {event['iteration']}"
            )
        first, restart = NumberedPolicy(state.iteration, state.first_policy), Restart(state.iteration, state.kept)
        state = replace(state, newest=first, best=first, trust=1.0, restart=restart)
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


def _asked(state: LearnerState, event: Mapping[str, Any]) -> LearnerState:
    shown, repeats = (event["first"], event["second"]), event.get("repeats")
    if any(not 0 <= number < len(state.trajectories) for number in shown):
        raise ValueError(f"asked: expected trajectories below {len(state.trajectories)}, got {shown}")
    if repeats is not None and (repeats, *shown[::-1]) not in [past[:3] for past in state.past]:
        raise ValueError(f"asked: expected a question that was asked before with sides swapped, got {dict(event)}")
    compared = state.compared
    both = (compared[shown[0]], compared[shown[1]])
    rivals, answerer = event.get("rivals"), event.get("answerer")
    checks.optional(checks.short_name, "answerer", answerer)
    if rivals is None and event["newcomer"] in shown and repeats is None:
        incumbent = shown[shown[0] == event["newcomer"]]
        newest = incumbent in state.preferences.undominated[-1:]
        rivals = state.preferences.tied_with(incumbent) if newest else None
    rivals = None if rivals is None else tuple(rivals)
    query = Query(event["query"], *shown, event["newcomer"], both, repeats, rivals, answerer, event.get("duel", False))
    return replace(state, open=(*state.open, query), queries=query.number, shown=state.shown.union(shown))


def _answered(state: LearnerState, event: Mapping[str, Any]) -> LearnerState:
    query = next((waiting for waiting in state.open if waiting.number == event["query"]), None)
    if query is None:
        waiting = [waiting.number for waiting in state.open]
        raise ValueError(f"answered: expected an answer to an open question of {waiting}, got one to {event['query']}")
    answer, about = parse_answer(event["answer"]), checked_about(event)
    answerer = about.get("answerer")
    left, again = state.candidates, query.repeats is not None
    if not again:
        left = tuple(number for number in left if number != query.newcomer)
    shown = (query.number, query.first, query.second, query.newcomer, query.repeats)
    past = (*state.past, PastQuestion(*shown, answer, answerer, *(about.get(name) for name in ABOUT)))
    after = replace(state, open=tuple(each for each in state.open if each is not query), candidates=left, past=past)
    after = replace(after, before=(*state.before[1 - MOST_UNDONE :], replace(state, before=())))
    if answer is Answer.SKIP:
        return after
    preferred = {Answer.FIRST: query.first, Answer.SECOND: query.second, Answer.TIE: None}[answer]
    wanted = max(0, state.wanted - 1)
    if again or query.duel:
        more = state.preferences.add_repeated(query.first, query.second, preferred=preferred, answerer=answerer)
        return replace(after, preferences=more, wanted=state.wanted if again else wanted)
    preferences = state.preferences.add(
        query.newcomer,
        query.incumbent,
        preferred=preferred,
        rivals=query.rivals,
        shown_first=query.first,
        answerer=answerer,
    )
    return replace(after, preferences=preferences, wanted=wanted)
