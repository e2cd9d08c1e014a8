"""The state is a fold over the log: pure, and undoing is the same as never having answered."""

import dataclasses

import numpy as np
import pytest

from bayespbrl.events import Entry, LearnerState, NumberedPolicy, Restart, apply, plain, replay, surviving
from bayespbrl.improvement.schedules import Bound
from bayespbrl.trajectories import Trajectory


def some_trajectories(number, seed=0):
    rng = np.random.default_rng(seed)
    return tuple(
        Trajectory(rng.normal(size=(4, 2)), rng.normal(size=(3, 1)), rng.normal(size=3)) for _ in range(number)
    )


def collected(iteration, candidates, wanted=1, seed=0):
    event = {"event": "collected", "iteration": iteration, "candidates": candidates, "wanted": wanted}
    return Entry(event, {"trajectories": some_trajectories(len(candidates), seed)})


def asked(query, first, second, newcomer):
    return Entry({"event": "asked", "query": query, "first": first, "second": second, "newcomer": newcomer})


def answered(query, answer):
    return Entry({"event": "answered", "query": query, "answer": answer})


def summary(iteration):
    schedule = {"reason": "confidence", "signal": iteration / 8, "gain": 0.25}
    return {"iteration": iteration, "answers": iteration, "value": 0.5, "kl_bound": iteration / 4, "schedule": schedule}


def improved(iteration):
    event = {"event": "improved", "iteration": iteration, "summary": summary(iteration)}
    return Entry(event, {"policy": f"policy {iteration}", "estimate": f"estimate {iteration}"})


UNDONE = Entry({"event": "undone"})
START = LearnerState.begun("policy 0")
# Two iterations by hand: 2 beats 0; 1 is worse than 2; then 4 ties with 2.
HISTORY = (
    collected(1, [0, 2, 1], wanted=2),
    asked(1, 2, 0, 2),
    answered(1, "first"),
    asked(2, 2, 1, 1),
    answered(2, "first"),
    improved(1),
    collected(2, [4, 3], seed=1),
    asked(3, 4, 2, 4),
    answered(3, "tie"),
    improved(2),
)


def test_two_iterations_by_hand():
    state = replay(START, HISTORY)
    assert state.preferences.pairs == ((2, 0), (2, 1))
    assert state.preferences.undominated == (2, 4)
    assert state.preferences.answers == 3
    assert (state.iteration, state.queries, len(state.trajectories)) == (2, 3, 5)
    assert (state.newest.policy, state.estimate) == ("policy 2", "estimate 2")
    assert state.summaries == (summary(1), summary(2))
    assert state.bound == Bound(kl_bound=0.5, reason="confidence", signal=0.25, statistics={"gain": 0.25})
    assert (state.collected, state.query, state.candidates, state.wanted) == (False, None, (), 0)


def test_the_learner_reads_what_an_update_decided_and_never_its_summary():
    bound = {"kl_bound": 0.4, "reason": "mine", "signal": 0.5, "statistics": {"gain": 1.0}}
    check = {"best": 1, "trust": 0.5, "stepped_back": True, "gain": -1.0, "standard_error": 0.1}
    fields = {"check": check, "kept": 1, "bound": bound, "value": 7.0}
    entries = (*HISTORY[:-1], Entry({**HISTORY[-1].event, **fields}, HISTORY[-1].parts))
    state = replay(START, entries)
    assert (state.bound, state.kept.number, state.best.number, state.trust) == (Bound(**bound), 1, 1, 0.5)
    assert state.values == (0.5, 7.0)  # the first by a log of an earlier version
    assert state.summaries == (summary(1), summary(2))


def test_the_first_candidate_of_a_run_is_what_the_others_are_compared_with():
    state = replay(START, HISTORY[:1])
    assert state.preferences.undominated == (0,)
    assert (state.candidates, state.wanted, state.collected) == ((2, 1), 2, True)


def test_iterations_in_a_row_without_a_question_are_counted():
    quiet = (collected(3, [], wanted=0), improved(3), collected(4, [], wanted=0), improved(4))
    assert [replay(START, (*HISTORY, *quiet[:n])).unasked for n in range(5)] == [0, 1, 1, 2, 2]
    assert replay(START, (*HISTORY, *quiet, collected(5, [5], seed=2))).unasked == 0
    assert replay(START, (*HISTORY, *quiet, UNDONE)).query.number == 3


def test_a_question_holds_the_two_trajectories_in_the_order_shown():
    state = replay(START, HISTORY[:4])
    assert state.query.trajectories == (state.trajectories[2], state.trajectories[1])
    assert (state.query.newcomer, state.query.incumbent) == (1, 2)


def test_a_skip_counts_as_no_answer_and_drops_the_candidate():
    state = replay(START, (*HISTORY[:2], answered(1, "skip")))
    assert (state.preferences.answers, state.preferences.pairs, state.wanted) == (0, (), 2)
    assert (state.candidates, state.query) == ((1,), None)


def test_the_fold_changes_nothing_that_it_is_given():
    state = START
    for entry in HISTORY:
        before = {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}
        event = dict(entry.event)
        after = apply(state, entry)
        assert all(getattr(state, name) is value for name, value in before.items())
        assert entry.event == event
        assert apply(state, entry).preferences == after.preferences
        state = after


def test_a_policy_is_started_anew_once_and_what_was_kept_is_remembered():
    anew = collected(3, [5], seed=2)
    anew = dataclasses.replace(anew, event={**anew.event, "restarted": True})
    state = replay(START, (*HISTORY, anew))
    first, kept = NumberedPolicy(2, "policy 0"), NumberedPolicy(2, "policy 2")
    assert (state.newest, state.best, state.started, state.trust) == (first, first, 2, 1.0)
    assert (state.kept, state.restart) == (kept, Restart(2, kept))
    assert apply(dataclasses.replace(replay(START, HISTORY), trust=0.25), anew).trust == 1.0
    checked = {"check": {"best": 2, "trust": 1.0}}
    for kept, policy in ((3, "policy 3"), (2, "policy 2")):
        update = improved(3)
        update.event["summary"].update(checked, kept=kept)
        assert apply(state, update).kept.policy == policy
    first, again = (dataclasses.replace(anew, event={**anew.event, "iteration": number}) for number in (1, 4))
    for history in ((first,), (*HISTORY, anew, improved(3), again)):
        with pytest.raises(ValueError, match="collected: expected at most one restart"):
            replay(START, history)


def test_a_number_that_no_float_holds_is_refused():
    fields = {"check": None, "kept": 2, "bound": {"kl_bound": 1.0, "reason": ""}, "value": 10**400}
    with pytest.raises(ValueError, match="expected a complete event"):
        replay(START, (*HISTORY[:-1], Entry({**HISTORY[-1].event, **fields}, HISTORY[-1].parts)))


@pytest.mark.parametrize(
    ("history", "follows"),
    [
        ((improved(1),), "collected of iteration 1"),
        ((collected(2, [0, 1]),), "collected of iteration 1"),
        ((*HISTORY[:1], HISTORY[0]), "improved of iteration 1"),
        ((*HISTORY[:5], improved(2)), "improved of iteration 1"),
        ((*HISTORY[:6], improved(1)), "collected of iteration 2"),
        ((*HISTORY[:6], collected(1, [4, 3])), "collected of iteration 2"),
    ],
)
def test_an_iteration_that_took_place_or_is_not_the_next_is_refused(history, follows):
    with pytest.raises(ValueError, match=f"expected {follows}, got"):
        replay(START, history)


@pytest.mark.parametrize("length", range(3, len(HISTORY) + 1))
def test_undoing_leads_to_the_state_before_the_last_answer(length):
    last = max(i for i, entry in enumerate(HISTORY[:length]) if entry.event["event"] == "answered")
    undone, never = replay(START, (*HISTORY[:length], UNDONE)), replay(START, HISTORY[:last])
    assert undone.query.number == never.query.number
    names = (
        "newest",
        "kept",
        "estimate",
        "bound",
        "iteration",
        "preferences",
        "candidates",
        "wanted",
        "queries",
        "summaries",
    )
    for name in names:
        assert getattr(undone, name) == getattr(never, name)
    assert len(undone.trajectories) == len(never.trajectories)


def test_undoing_works_back_to_the_first_question_and_no_further():
    state = replay(START, (*HISTORY, UNDONE, UNDONE, UNDONE))
    assert (state.query.number, state.iteration, state.preferences.answers) == (1, 0, 0)
    with pytest.raises(ValueError, match="undo: expected an answer to take back"):
        apply(state, UNDONE)


@pytest.mark.parametrize("undone", [0, 1, 2, 3])
def test_what_survives_leads_to_the_same_state(undone):
    log = [*HISTORY, *[UNDONE] * undone]
    left = surviving(entry.event for entry in log)
    assert [dict(entry.event) for entry in HISTORY[: len(left)]] == left
    whole, short = replay(START, log), replay(START, HISTORY[: len(left)])
    assert (whole.preferences, whole.iteration, whole.queries) == (short.preferences, short.iteration, short.queries)
    assert "undone" not in {event["event"] for event in left}


def test_undoing_and_answering_anew_survives_as_the_new_answer():
    log = [*HISTORY[:5], UNDONE, answered(2, "tie"), improved(1)]
    left = surviving(entry.event for entry in log)
    assert [event.get("answer") for event in left if event["event"] == "answered"] == ["first", "tie"]
    with pytest.raises(ValueError, match="undo"):
        surviving([UNDONE.event])


@pytest.mark.parametrize(
    "foreign",
    [
        {"event": "answered", "query": 7, "answer": "first"},
        {"event": "answered", "query": 1, "answer": "both"},
        {"event": "answered", "query": 1, "answer": "undo"},
        {"event": "answered", "query": 1},
        {"event": "asked", "query": 2, "first": 0, "second": 99, "newcomer": 0},
        {"event": "asked", "query": 2},
        {"event": "collected", "candidates": [0], "wanted": 1},
        {"event": "improved", "iteration": 1},
        {"event": "burnt"},
        {},
    ],
)
def test_an_event_that_cannot_follow_is_refused(foreign):
    with pytest.raises(ValueError, match=r"expected"):
        replay(START, (*HISTORY[:2], Entry(foreign)))


def test_a_second_answer_to_the_same_question_is_refused():
    with pytest.raises(ValueError, match=r"answered: expected an answer to an open question of \[\], got one to 1"):
        replay(START, (*HISTORY[:3], answered(1, "first")))


def test_plain_is_what_json_gives_back():
    numbers = {"a": np.float64(0.1), "b": [np.int64(3), float("nan"), np.inf], "c": (True, None, "x"), "d": np.bool_(1)}
    assert plain(numbers) == {"a": 0.1, "b": [3, None, None], "c": [True, None, "x"], "d": True}
    assert type(plain(np.float64(0.1))) is float
    assert plain(np.bool_(True)) is True
