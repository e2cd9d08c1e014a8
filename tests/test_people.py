"""Answers of people: who gave each, how long it took, and what is kept of it."""

import json

import pytest
from toys import QUICK, fingerprint

from bayespbrl import Learner, Preferences, ReturnExpert, resume, start
from bayespbrl.events import Entry, LearnerState, apply
from bayespbrl.preferences import Source
from bayespbrl.utility.comparisons import Comparisons

OPTIONS = QUICK | {"iterations": 2}


class Memory:
    """A log in memory."""

    def __init__(self):
        self.entries = []

    def append(self, entry, state):
        self.entries.append(entry)

    def answers(self):
        return [entry.event for entry in self.entries if entry.event["event"] == "answered"]


def remembered(**changes):
    log = Memory()
    return Learner("gridworld", **(OPTIONS | changes)).logged(log), log


def test_who_answered_and_how_long_it_took_is_in_the_log():
    run, log = remembered()
    run.ask()
    run.tell(["first"], answerer="Ada", seconds=2.5)
    run.tell(["skip"], answerer="Böb 2", seconds=0)
    run.tell(["tie"])
    assert log.answers() == [
        {"event": "answered", "query": 1, "answer": "first", "answerer": "Ada", "seconds": 2.5},
        {"event": "answered", "query": 2, "answer": "skip", "answerer": "Böb 2", "seconds": 0.0},
        {"event": "answered", "query": 3, "answer": "tie"},
    ]
    assert {name for _, name in run.preferences.answered_by} == {"Ada"}
    assert run.preferences.answerers == ("Ada", None)
    assert run.preferences.answers == 2  # who cannot tell has not answered


@pytest.mark.parametrize("answerer", ["", " ", "a ", "a\nb", "\x07", "x" * 65, 3, b"Ada", ["Ada"]])
def test_a_bad_name_is_refused_and_nothing_has_happened(answerer):
    run, log = remembered()
    run.ask()
    state, length = run.state, len(log.entries)
    with pytest.raises(ValueError, match=r"answerer: expected a printable name of 1 to 64 characters, got"):
        run.tell(["first"], answerer=answerer)
    assert (run.state, len(log.entries)) == (state, length)
    with pytest.raises(ValueError, match="answerer: expected a printable name"):
        apply(state, Entry({"event": "answered", "query": 1, "answer": "tie", "answerer": answerer}))


@pytest.mark.parametrize("seconds", [-1, float("nan"), float("inf"), "3", True, [1.0]])
def test_a_bad_response_time_is_refused_and_nothing_has_happened(seconds):
    run, log = remembered()
    run.ask()
    with pytest.raises(ValueError, match=r"seconds: expected a non-negative finite number, got"):
        run.tell(["first"], answerer="Ada", seconds=seconds)
    assert log.answers() == []
    assert run.ask()[0].number == 1


def test_a_named_person_who_answers_in_a_loop_is_timed_and_a_simulated_expert_is_not():
    run, log = remembered()
    run.run(ReturnExpert(), answerer="Ada")
    assert all(event["answerer"] == "Ada" and event["seconds"] >= 0 for event in log.answers())
    plain, plain_log = remembered()
    plain.run(ReturnExpert())
    assert all(set(event) == {"event", "query", "answer"} for event in plain_log.answers())
    assert fingerprint(plain)["policy"] == fingerprint(run)["policy"]  # one answerer changes nothing


def test_a_run_on_disk_replays_who_answered(tmp_path):
    run = start("gridworld", tmp_path / "run", **OPTIONS)
    run.ask()
    run.tell(["first"], answerer="Ada", seconds=1)
    run.tell(["second"], answerer="Bob", seconds=2)
    again = resume(tmp_path / "run")
    assert again.preferences == run.preferences
    assert again.preferences.answerers == ("Ada", "Bob")
    lines = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    assert [line["seconds"] for line in lines if line["event"] == "answered"] == [1.0, 2.0]


def test_all_that_follows_from_an_answer_is_its_answerers_and_only_what_was_shown_has_a_side():
    before = Preferences(undominated=(0, 2), answers=2)
    after = before.add(7, 2, preferred=7, shown_first=2, answerer="Ada").add(
        8, 7, preferred=None, shown_first=8, answerer="Bob"
    )
    assert after.answered_by == (((7, 0), "Ada"), ((7, 2), "Ada"), ((8, 7), "Bob"))
    assert after.rows() == [
        Source(False, 0, 0, "Ada"),
        Source(False, 1, -1, "Ada"),
        Source(True, 0, 1, "Bob"),
    ]


def test_several_answerers_are_numbered_by_their_first_answer_and_one_is_not():
    trajectories, pairs = [object()] * 4, [(0, 1), (2, 1), (3, 0)]
    several = Comparisons.among(trajectories, pairs, discount=1.0, answered_by=["Bob", "Ada", "Bob"])
    checked = several.answers.checked(3)
    assert (checked.answerers.tolist(), checked.names) == ([0, 1, 0], ("Bob", "Ada"))
    one = Comparisons.among(trajectories, pairs, discount=1.0, answered_by=["Bob"] * 3)
    assert one.answers == Comparisons.among(trajectories, pairs, discount=1.0).answers


def test_nobody_has_answered_a_new_run_and_an_answer_without_a_name_is_somebodys():
    assert LearnerState("policy").preferences.answerers == ()
    assert Preferences(answers=1).answerers == (None,)
