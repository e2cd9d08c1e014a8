"""A sitting without a browser: turns, what is computed ahead, clips, the widget, and the command line around them."""

import errno
import fcntl
import io
import json
import os
import subprocess
import sys
import threading
import time
import webbrowser
from unittest import mock

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.classic_control import CartPoleEnv
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers import RecordEpisodeStatistics
from PIL import Image, ImageDraw
from toys import QUICK, Slope, fingerprint

import bayespbrl
from bayespbrl import events
from bayespbrl.cli.commands import main
from bayespbrl.cli.opening import ELSEWHERE, open_in_browser, somebody_looks
from bayespbrl.envs.opening import open_environment
from bayespbrl.events import LearnerState
from bayespbrl.models.likelihoods import Logistic
from bayespbrl.people.clips import MOST_BYTES, Clips
from bayespbrl.people.drawing import SCENES, scene_of
from bayespbrl.people.foresight import Foresight
from bayespbrl.people.plots import draw_plots, observation_names
from bayespbrl.people.practice import practice_queries
from bayespbrl.people.seat import Stale
from bayespbrl.people.session import Session, answer_of
from bayespbrl.people.views import ALL_GIVEN, FINISHED, LITTLE, QUESTION, THINKING, said_of, with_ties
from bayespbrl.people.widget import ComparisonWidget
from bayespbrl.preferences import Answer, Query
from bayespbrl.runs import lock
from bayespbrl.runs.lock import continuing
from bayespbrl.trajectories import Trajectory

WAIT = 120  # seconds at most
NO_POLICIES = [None] * 4


@pytest.fixture
def sitting():
    """Opens sessions, and closes them."""
    opened = []

    def sit(learner, **options):
        opened.append(Session(learner, **options).open())
        return opened[-1]

    yield sit
    for session in opened:
        session.close()


def answer_all(session, expert):
    while (view := session.wait(timeout=WAIT))["phase"] == QUESTION:
        session.answer(view["turn"], str(expert(*session.learner.state.query.trajectories)), 1.5)
    assert view["phase"] == FINISHED
    return view


@pytest.mark.slow
def test_what_is_computed_ahead_is_what_is_computed_without_it_bit_for_bit(sitting):
    options = QUICK | {"utility": "posterior-mean", "expert": "other"}
    session = sitting(bayespbrl.Learner("gridworld", **options), answerer="Ada")
    ahead = []
    while (view := session.wait(timeout=WAIT))["phase"] == QUESTION:
        moment, number = session._foresight.present, session.learner.state.query.number
        with session.changed:  # until the thread has foreseen both likely answers
            foreseen = session.changed.wait_for(
                lambda now=moment, n=number: (
                    len(now.after) >= 2 and all(now.after[n, a].complete for a in now.drawn[n].likely[:2])
                ),
                WAIT,
            )
        assert foreseen
        given = bayespbrl.ReturnExpert()(*session.learner.state.query.trajectories)
        ahead.append((number, given) in moment.after and moment.after[number, given].complete)
        session.answer(view["turn"], str(given), 1.5)
    plain = bayespbrl.Learner("gridworld", **options).run(bayespbrl.ReturnExpert(), answerer="Ada")
    assert fingerprint(session.learner) == fingerprint(plain)
    assert any(ahead)


@pytest.mark.filterwarnings("ignore:.*it does not repeat its episode:UserWarning")
def test_an_environment_that_goes_by_its_earlier_episodes_has_none_but_those_of_the_run(sitting):
    options = QUICK | {"expert": "other", "same_start": True}

    def learner():
        return bayespbrl.Learner(gymnasium.wrappers.NormalizeObservation(Camera()), **options)

    def higher(first, second):
        return "first" if first.states[-1, 0] > second.states[-1, 0] else "second"

    plain = learner().run(higher, answerer="Ada")
    assert plain.comparable_starts is False
    session = sitting(learner(), answerer="Ada")
    answer_all(session, higher)
    assert fingerprint(session.learner) == fingerprint(plain)


def test_a_tie_is_foreseen_last_until_the_run_has_one():
    learner = bayespbrl.Learner("gridworld", expert="other", **QUICK)
    answers = tuple(map(Answer, ("second", "first", "skip", "tie")))
    foresight = Foresight(learner.cycle, learner.state, lambda state, query, who: ("shown", answers))

    def foreseen(number):
        """The answers after which the next moments are foreseen."""
        order = []
        while len(order) < number and (moment := foresight.pending()) is not None:
            foresight.keep(moment, foresight.compute(moment))
            if moment.complete:
                after = foresight.present.after.items()
                order.append(next((str(answer) for (_, answer), known in after if known is moment), "other"))
        return order

    assert foreseen(9) == ["other", "second", "first", "skip", *["other"] * 4, "tie"]
    present = foresight.move(1, Answer.TIE, foresight.present.after[1, Answer.TIE].state)
    assert present.complete
    assert foreseen(4) == ["second", "first", "skip", "tie"]


class Known:
    """A utility estimate whose draws of both trajectories are given."""

    posterior = "some"

    def __init__(self, *draws):
        self.draws = np.array(draws)

    def trajectory_draws(self, trajectories, *, number):
        return self.draws

    def likelihood(self, number, *, answerer=None):
        return Logistic(4.0)

    def side_biases(self, number, *, answerer):
        return None

    def tie_thresholds(self, number):
        return None


@pytest.mark.parametrize(
    ("draws", "sure", "worth", "likely"),
    [
        ([(3.0, 0.0), (3.0, 0.0)], 1.0, 0.0, "first"),  # what is certain is worth nothing
        ([(0.0, 3.0), (0.0, 3.0)], 1.0, 0.0, "second"),
        ([(9.0, 0.0), (0.0, 9.0)], 0.5, 1.0, "first"),  # the draws disagree: the answer tells all
        ([(0.1, 0.0), (0.1, 0.0)], 1 / (1 + np.exp(-0.4)), 0.0, "first"),  # a coin toss tells nothing
    ],
)
def test_what_is_said_of_a_question_is_how_sure_the_answer_is_and_what_it_is_worth(draws, sure, worth, likely):
    query = Query(1, 0, 1, 1, (None, None))
    said, order = said_of(query, LearnerState(*NO_POLICIES, estimate=Known(*draws)))
    np.testing.assert_allclose([said["sure"], said["worth"]], [sure, worth], atol=1e-4)
    assert order[0] == likely
    stop = "That is less than 0.01 bit: it changes little. If the next are worth no more, you can stop."
    assert said["advice"] == (stop if worth < LITTLE else "")


def test_what_is_said_of_a_question_counts_ties_once_the_run_has_one():
    class Tying(Known):
        def tie_thresholds(self, number):
            return np.array([[4.0], [0.01]])

    def said(*draws):
        return said_of(Query(1, 0, 1, 1, (None, None)), LearnerState(*NO_POLICIES, estimate=Tying(*draws)))[0]

    likely = said((0.0, 0.0), (9.0, 0.0))  # a tie by the one draw, the first by the other
    np.testing.assert_allclose([likely["sure"], likely["worth"]], [0.5, 1.0], atol=1e-3)
    assert likely["most"] == pytest.approx(1.585, abs=1e-3)
    both = said((0.0, 0.0), (0.0, 0.0))  # by the one a tie, by the other a coin toss
    p = 1 / (1 + np.exp(4 * 0.01))
    entropy = lambda *chances: -sum(chance * np.log2(chance) for chance in chances)  # noqa: E731
    first, tie = (p + 1 / (1 + np.exp(16.0))) / 2, (2 - 2 * p - 2 / (1 + np.exp(16.0))) / 2
    of_each = [entropy(p, p, 1 - 2 * p), entropy(*[1 / (1 + np.exp(16.0))] * 2, 1 - 2 / (1 + np.exp(16.0)))]
    np.testing.assert_allclose([both["sure"]], [tie], atol=1e-6)
    np.testing.assert_allclose([both["worth"]], [entropy(first, first, tie) - np.mean(of_each)], atol=1e-6)


def test_a_person_may_stop_from_the_least_worth_on_and_not_before(monkeypatch):
    query, state = Query(1, 0, 1, 1, (None, None)), LearnerState(*NO_POLICIES, estimate=Known((1.0, 0.0), (0.9, 0.0)))
    worth = said_of(query, state)[0]["worth"]
    for little, stops in ((worth * 1.001, True), (worth * 0.999, False)):
        monkeypatch.setattr("bayespbrl.people.views.LITTLE", little)
        assert ("you can stop" in said_of(query, state)[0]["advice"]) == stops
    assert said_of(query, LearnerState(*NO_POLICIES))[0] == {"worth": None, "sure": None, "advice": ""}


@pytest.mark.parametrize(
    ("margin", "threshold", "order"),
    [
        (0.0, None, "second first skip tie"),
        (0.1, 1.0, "tie first skip second"),
        (-0.1, 1.0, "tie second skip first"),
        (2.0, 1.0, "first tie skip second"),
        (0.2, 0.01, "first second skip tie"),
    ],
)
def test_a_tie_is_foreseen_as_early_as_it_is_likely_once_the_run_has_one(margin, threshold, order):
    before = tuple(map(Answer, ("second", "first", "skip", "tie")))
    thresholds = None if threshold is None else np.full((5, 1), threshold)
    likely = with_ties(before, np.full((5, 1), margin), Logistic(4.0), thresholds)
    assert " ".join(likely) == order


def test_nothing_reaches_the_log_before_the_answer(sitting, tmp_path):
    learner = bayespbrl.start("gridworld", tmp_path / "run", expert="page", **QUICK)
    session = sitting(learner)
    session.wait(timeout=WAIT)
    before = learner.log.log_file.read_bytes()
    moment = session._foresight.present
    with session.changed:
        assert session.changed.wait_for(lambda: len(moment.after) > 1, WAIT)
    assert learner.log.log_file.read_bytes() == before


def test_after_the_last_answer_nobody_needs_to_wait_and_nothing_is_computed_ahead(sitting):
    session, views = sitting(bayespbrl.Learner("gridworld", expert="other", answers=1, **QUICK)), []
    session.listen(lambda: views.append(session.view))
    session.wait(timeout=WAIT)
    while not session.idle:
        time.sleep(0.01)
    assert all(after.complete == (answer == "skip") for (_, answer), after in session._foresight.present.after.items())
    session.answer(1, "first", 2.0)
    assert session.wait((FINISHED,), WAIT)["say"].startswith("Your answer is given")
    thinking = [view for view in views if view["phase"] == THINKING]
    assert {(view["say"], view["all_given"]) for view in thinking} == {(ALL_GIVEN, True)}
    with pytest.raises(Stale, match=r"turn 2: expected a question that waits, got none \(finished\)"):
        session.answer(session.view["turn"], "first")


def test_a_turn_takes_one_answer_and_an_undo_is_a_turn_of_its_own(sitting):
    session = sitting(bayespbrl.Learner("gridworld", expert="other", **QUICK))
    first = session.wait(timeout=WAIT)
    assert (first["turn"], first["answered"], first["undo"]) == (1, 0, False)
    session.answer(1, "first", 2.0)
    with pytest.raises(Stale, match="turn: expected 2, got 1"):
        session.answer(1, "second")
    second = session.wait(timeout=WAIT)
    session.answer(2, "undo")
    again = session.wait(timeout=WAIT)
    assert (second["answered"], again["turn"], again["answered"]) == (1, 3, 0)
    assert again["clips"] == first["clips"]
    with pytest.raises(ValueError, match="answer: expected one of"):
        session.answer(3, "left")
    session.answer(3, "second")
    view = answer_all(session, lambda first, second: "tie")
    assert view["answered"] == 4
    assert "3 iterations" in view["say"]


def test_each_answer_of_a_sitting_has_its_session_and_replays_which_change_nothing(sitting, tmp_path):
    learner, sessions = bayespbrl.start("gridworld", tmp_path / "run", expert="other", **QUICK), []
    for replays in (3, None):
        session = sitting(learner, answerer="Ada", most_answers=2)
        for given in ("first", "undo", "second", "tie"):
            view = session.wait(timeout=WAIT)
            session.answer(view["turn"], given, 1.5, replays)
        session.wait((FINISHED,), WAIT)
        session.close()
        sessions.append(session.name)
    events = list(map(json.loads, (tmp_path / "run" / "events.jsonl").read_text().splitlines()))
    answered = [event for event in events if event["event"] == "answered"]
    assert [event["session"] for event in answered] == [sessions[0]] * 3 + [sessions[1]] * 3
    assert [event.get("replays") for event in answered] == [3, 3, 3, None, None, None]
    assert [event for event in events if event["event"] == "undone"] == [{"event": "undone", "answerer": "Ada"}] * 2
    assert sessions[0] != sessions[1]
    read = bayespbrl.load(tmp_path / "run")
    assert [past.replays for past in read.learner.state.past] == [3, 3, None, None]
    assert read.write_answers().read_text().splitlines()[1].endswith(f",Ada,1.5,,{sessions[0]},3")
    told = iter(["second", "tie"] * 2)
    plain = bayespbrl.Learner("gridworld", expert="other", **QUICK).run(lambda a, b: next(told), answerer="Ada")
    assert fingerprint(learner) == fingerprint(read.learner) == fingerprint(plain)


def test_a_sitting_ends_after_its_answers_and_the_run_goes_on(sitting):
    learner = bayespbrl.Learner("gridworld", expert="other", **QUICK)
    view = answer_all(sitting(learner, most_answers=2), lambda first, second: "tie")
    assert view["answered"] == 2
    assert "2 answers of this sitting" in view["say"]
    assert learner.ask()


def test_practice_comes_before_the_first_question_of_a_person_and_records_nothing(sitting, tmp_path):
    learner = bayespbrl.start("gridworld", tmp_path / "run", expert="page", **QUICK)
    session = sitting(learner, answerer="Ada", practice=True)
    assert session.wait(("instructions",))["turn"] == 1
    with pytest.raises(ValueError, match="answer: expected 'begin' to the instructions, got 'first'"):
        session.answer(1, "first")
    seen, turns = [], []
    for given in ("begin", "first", "undo", "skip", "tie"):
        session.answer(session.view["turn"], given)
        view = session.wait(timeout=WAIT)
        seen.append(view["practice"])
        turns.append(view["turn"])
        assert session.sheet(view["turn"], 0).startswith(b"\x89PNG")
    assert seen == [(1, 2), (2, 2), (1, 2), (2, 2), None]
    assert turns == [2, 3, 4, 5, 6]
    assert "From now on your answers are kept" in view["notice"]
    assert not view["undo"]
    with pytest.raises(ValueError, match="answer: expected one of"):
        session.answer(6, "begin")
    events = [line.split('"')[3] for line in learner.log.log_file.read_text().splitlines()]
    assert events == ["collected", "asked"]
    session.answer(6, "first")
    session.close()
    assert sitting(learner, answerer="Ada", practice=True).wait(timeout=WAIT)["phase"] == QUESTION


def test_a_second_person_practises_too_and_takes_no_answer_of_the_first_back(sitting):
    learner = bayespbrl.Learner("gridworld", expert="other", **QUICK)
    learner.ask()
    learner.tell(["first"], answerer="Ada")
    session = sitting(learner, answerer="Bob", practice=True)
    for given in ("begin", "tie", "tie"):
        session.answer(session.wait(("instructions", QUESTION), WAIT)["turn"], given)
    view = session.wait(timeout=WAIT)
    assert (view["practice"], view["answered"], view["undo"]) == (None, 1, False)
    with pytest.raises(ValueError, match="undo: expected an answer by the same person to take back, got none"):
        session.answer(view["turn"], "undo")
    session.answer(view["turn"], "tie")
    assert session.wait(timeout=WAIT)["undo"]


def test_practice_questions_are_about_other_trajectories_where_there_are_enough():
    trajectories = [Trajectory(np.arange(3.0), np.zeros(2), np.zeros(2)) for _ in range(6)]

    def asked(number, first, second):
        both = (trajectories[first], trajectories[second])
        state = LearnerState(
            *NO_POLICIES, trajectories=tuple(trajectories[:number]), open=(Query(1, first, second, second, both),)
        )
        return [(query.first, query.second) for query in practice_queries(state)]

    assert asked(6, 1, 0) == [(2, 3), (4, 5)]
    assert asked(6, 1, 4) == [(2, 3), (0, 2)]
    assert asked(3, 0, 2) == [(0, 1), (1, 2)]
    assert asked(2, 0, 1) == [(0, 1)]


def test_a_quiet_line_now_and_then_says_that_a_person_may_pause(sitting, monkeypatch):
    monkeypatch.setattr("bayespbrl.people.views.BREAK", 2)
    session, notices = sitting(bayespbrl.Learner("gridworld", expert="other", **QUICK)), []
    while (view := session.wait(timeout=WAIT))["phase"] == QUESTION:
        notices.append(view["notice"])
        session.answer(view["turn"], "tie")
    assert notices == ["", "", "You have given 2 answers. Pause when you like; nothing is lost.", ""]


@pytest.mark.parametrize("command", ["run", "ask"])
@pytest.mark.parametrize(
    ("options", "changes", "opens"),
    [
        ([], {}, True),
        (["--no-browser"], {}, False),
        (["--answerer", "Ada", "--answerer", "Ben"], {}, False),
        ([], {"DISPLAY": ""}, False),
        ([], {"SSH_CONNECTION": "10.0.0.1"}, False),
        ([], {"CI": "true"}, False),
    ],
)
def test_the_page_is_opened_where_somebody_looks_unless_told(
    monkeypatch, capsys, directory, tmp_path, command, options, changes, opens
):
    opened = []
    monkeypatch.setattr("bayespbrl.people.page.Page.serve", lambda page: page._socket.close())
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr("bayespbrl.cli.opening.sys.stdout.isatty", lambda: True, raising=False)
    monkeypatch.setattr("webbrowser.get", lambda: mock.Mock(open=opened.append))
    for name in (*ELSEWHERE, "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for name, value in ({"DISPLAY": ":0"} | changes).items():
        monkeypatch.setenv(name, value)
    chosen = (
        ["ask", directory] if command == "ask" else ["run", "gridworld", "--expert", "page", "--out", tmp_path / "new"]
    )
    monkeypatch.setattr(sys, "argv", ["bayespbrl", *map(str, chosen), *options])
    with pytest.raises(SystemExit) as stop:
        main()
    printed = [line for line in capsys.readouterr().out.splitlines() if line.startswith("http://")]
    assert (stop.value.code, opened) == (0, printed if opens else [])
    assert opens or len(printed) == ("Ada" not in options)


def test_a_browser_that_needs_the_terminal_and_one_that_is_not_there_are_left_alone(monkeypatch):
    monkeypatch.setattr("webbrowser.get", lambda: webbrowser.GenericBrowser("lynx"))
    assert not open_in_browser("http://127.0.0.1:1/")
    monkeypatch.setattr("webbrowser.get", mock.Mock(side_effect=webbrowser.Error))
    assert not open_in_browser("http://127.0.0.1:1/")
    assert not somebody_looks({"DISPLAY": ":0"})  # a test's output is no terminal


@pytest.mark.parametrize("command", ["run", "ask"])
@pytest.mark.parametrize(("options", "first"), [([], True), (["--no-practice"], False)])
def test_the_command_line_begins_with_the_practice_unless_told(
    monkeypatch, directory, tmp_path, command, options, first
):
    practises = []

    def look(page):
        page.session.open()
        practises.append(page.session.view["phase"] == "instructions")
        page.session.close()
        page._socket.close()

    monkeypatch.setattr("bayespbrl.people.page.Page.serve", look)
    chosen = (
        ["ask", directory] if command == "ask" else ["run", "gridworld", "--expert", "page", "--out", tmp_path / "new"]
    )
    monkeypatch.setattr(sys, "argv", ["bayespbrl", *map(str, chosen), *options])
    with pytest.raises(SystemExit) as stop:
        main()
    assert (stop.value.code, practises) == (0, [first])


def test_an_interrupt_while_an_answer_is_kept_leaves_a_question_that_can_be_answered(sitting, monkeypatch):
    """A notebook's kernel may be interrupted at any moment."""
    learner = bayespbrl.Learner("gridworld", expert="other", **QUICK)
    session = sitting(learner)
    session.wait(timeout=WAIT)
    with session.changed:  # what follows is at hand, and shown before its events are kept
        assert session.changed.wait_for(lambda: session.idle, WAIT)
    kept, calls = learner.record, []

    def interrupted(entry):
        calls.append(entry)
        if len(calls) == 2:
            raise KeyboardInterrupt
        kept(entry)

    with monkeypatch.context() as patched:
        patched.setattr(learner, "record", interrupted)
        with pytest.raises(KeyboardInterrupt):
            session.answer(session.view["turn"], "first")
    view = session.wait(timeout=WAIT)
    assert (view["phase"], learner.preferences.answers) == (QUESTION, 1)
    session.answer(view["turn"], "second")
    session.wait(timeout=WAIT)
    assert learner.preferences.answers == 2


@pytest.mark.parametrize("error", [KeyboardInterrupt, KeyError])
def test_whatever_is_raised_right_after_an_answer_is_kept_leaves_a_question_too(error, sitting, monkeypatch):
    learner = bayespbrl.Learner("gridworld", expert="other", **QUICK)
    session, coming = sitting(learner), []
    turn = session._turn

    def interrupted(seat):
        if coming:
            raise coming.pop()
        turn(seat)

    monkeypatch.setattr(session, "_turn", interrupted)
    for answer, kept in (("first", 1), ("undo", 0), ("second", 1)):
        view = session.wait(timeout=WAIT)
        coming.append(error())
        with pytest.raises(error):
            session.answer(view["turn"], answer)
        assert learner.preferences.answers == kept


def test_nobody_is_introduced_to_questions_once_all_answers_are_given(sitting):
    learner = bayespbrl.Learner("gridworld", **QUICK | {"expert": "other", "answers": 1})
    (query,) = learner.ask()
    learner.record(events.answered(query.number, "first", answerer="Ada"))  # stopped before the policy caught up
    assert not learner.finished
    seen = []
    session = Session(learner, answerer="Zoe", practice=True)
    session.listen(lambda: seen.append(session.view["phase"]))
    session.open()
    with session.changed:
        assert session.changed.wait_for(lambda: session.over, WAIT)
    session.close()
    assert set(seen) == {THINKING, FINISHED}


def test_a_full_disk_ends_the_sitting_and_keeps_the_answers(sitting, tmp_path):
    learner = bayespbrl.start("gridworld", tmp_path / "run", expert="page", **QUICK)
    session = sitting(learner)
    session.wait(timeout=WAIT)
    append = learner.log.append

    def full(entry, state):
        if entry.event["event"] != "answered":
            raise OSError("No space left on device")
        append(entry, state)

    with mock.patch.object(learner.log, "append", full):
        session.answer(1, "first")
        view = session.wait(("failed",), WAIT)
    assert view["say"] == "Stopped: No space left on device Your answers are kept."
    assert bayespbrl.load(tmp_path / "run").preferences.answers == 1


@pytest.mark.parametrize(
    "message",
    [None, [], {"turn": True, "answer": "first"}, {"turn": 1}, {"turn": 1, "answer": "first", "seconds": True}]
    + [{"turn": 1, "answer": "first", "replays": replays} for replays in (-1, 0.5, "1", True, 10_001)],
)
def test_a_message_that_is_no_answer_is_refused(message):
    with pytest.raises(ValueError, match="expected"):
        answer_of(message)


class Camera(gymnasium.Env):
    """A point on a line that its own pictures show; `jumps` makes an episode differ from its repetition."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (gymnasium's interface)
    observation_space = Box(-10.0, 10.0, (1,), dtype=np.float64)
    action_space = Discrete(2, start=3)

    def __init__(self, render_mode="rgb_array", jumps=False):
        self.render_mode, self.jumps, self.episodes = render_mode, jumps, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episodes += 1
        self.position = self.np_random.normal(0, 0.1, 1) + self.jumps * self.episodes
        return self.position.copy(), {}

    def step(self, action):
        self.position = self.position + (0.2 if action == 4 else -0.2) + self.np_random.normal(0, 0.01, 1)
        return self.position.copy(), 0.0, False, False, {}

    def render(self):
        noise = np.random.default_rng(0).integers(0, 255, (60, 90, 3), dtype=np.uint8)
        noise[:, int(np.clip(45 + 5 * self.position[0], 0, 89))] = 0
        return noise


class Many(Slope):
    """Observations that nobody can draw, with names or without."""

    observation_space = Box(-10.0, 10.0, (8,), dtype=np.float64)

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        return np.resize(observation, 8), info

    def step(self, action):
        observation, *rest = super().step(action)
        return np.resize(observation, 8), *rest


def clips_of(env, **options):
    """The clips of the first question of a run."""
    learner = bayespbrl.Learner(env, expert="other", **QUICK | options)
    return checked_clips(learner, learner.ask()[0])


def checked_clips(learner, query):
    drawn = Clips(learner)
    clips = drawn.of(query, learner.state)
    for clip, trajectory in zip(clips, query.trajectories, strict=True):
        sheet = Image.open(io.BytesIO(clip.sheet))
        assert sheet.size == (clip.columns * clip.width, -(-clip.frames // clip.columns) * clip.height)
        assert (clip.steps, clip.ended) == (len(trajectory), trajectory.terminated)
        assert len(clip.sheet) <= MOST_BYTES
        box = (0, 0, clip.width, clip.height)
        assert sheet.convert("RGBA").crop(box).getextrema() != ((0, 0),) * 4  # something is drawn
    longest = max(clip.steps for clip in clips)
    assert longest / 8 <= drawn.rate(clips) <= longest / 2.5
    return clips


@pytest.mark.parametrize("env", ["gridworld", "swing-up", *SCENES])
def test_shipped_tasks_and_classics_are_drawn_from_their_observations(env):
    learner = bayespbrl.Learner(env, expert="other", **QUICK)
    space, rng = learner.environment.observation_space, np.random.default_rng(0)

    def trajectory(steps):
        if isinstance(space, Discrete):
            states = rng.integers(space.n, size=steps + 1)
        else:
            states = np.clip(rng.normal(0, 0.3, (steps + 1, *space.shape)), space.low, space.high).astype(float)
        return Trajectory(states, np.zeros((steps, 1)), np.zeros(steps), terminated=steps == 12)

    clips = checked_clips(learner, Query(1, 0, 1, 1, (trajectory(20), trajectory(12))))
    assert [(clip.width, clip.frames) for clip in clips] == [(320, 21), (320, 13)]


class Mirrored(gymnasium.ObservationWrapper):
    """Other observations in the same space."""

    def observation(self, observation):
        return -observation


class OneEntry(Mirrored):
    """One entry of the observation."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = Box(-1, 1, (1,))

    def observation(self, observation):
        return observation[:1]


@pytest.mark.parametrize("wrapper", [Mirrored, OneEntry])
def test_an_environment_whose_wrapper_gives_other_observations_is_not_drawn_from_them(wrapper):
    assert scene_of(open_environment("Pendulum-v1")) is not None
    assert scene_of(open_environment(gymnasium.make("Pendulum-v1"))) is not None
    assert scene_of(open_environment(wrapper(gymnasium.make("Pendulum-v1")))) is None


class Scaled(gymnasium.Wrapper):
    """Other observations in the same space, by a wrapper of gymnasium's most general kind."""

    def reset(self, **arguments):
        observation, info = self.env.reset(**arguments)
        return observation / 2, info

    def step(self, action):
        observation, *rest = self.env.step(action)
        return observation / 2, *rest


class Strong(gymnasium.ActionWrapper):
    def action(self, action):
        return 2 * action


class Cautious(gymnasium.RewardWrapper):
    def reward(self, reward):
        return reward - 1


class Noting(gymnasium.Wrapper):
    """Changes nothing."""

    note = "of the user's"


@pytest.mark.parametrize(
    ("wrapper", "drawn"),
    [(Scaled, False), (Strong, True), (Cautious, True), (Noting, True), (RecordEpisodeStatistics, True)],
)
def test_an_environment_is_drawn_where_no_wrapper_touches_its_observations(wrapper, drawn):
    env = open_environment(wrapper(gymnasium.make("Pendulum-v1")))
    assert (scene_of(env) is not None) is drawn


class Single(Camera):
    """Returns more digits than its space has."""

    observation_space = Box(-10.0, 10.0, (1,))


@pytest.mark.parametrize("env", [Camera(), Single()])
def test_an_environment_that_renders_is_filmed_by_itself(env):
    clips = clips_of(env)
    assert {(clip.width, clip.height, clip.frames) for clip in clips} == {(90, 60, 21)}
    assert all(clip.sheet.startswith(b"\xff\xd8") for clip in clips)  # JPEG: many colours


class FilmedCartPole(CartPoleEnv):
    """Gymnasium's CartPole with pictures of its own state, which need no library for games."""

    def render(self):
        picture = Image.new("RGB", (96, 64), "white")
        x, _, angle, _ = self.state
        foot = 48 + 18 * x, 50
        ImageDraw.Draw(picture).line([foot, (foot[0] + 40 * np.sin(angle), 50 - 40 * np.cos(angle))], "black", 3)
        return np.asarray(picture)


def test_a_part_of_an_episode_is_filmed_by_an_environment_that_begins_at_the_reset():
    env = FilmedCartPole(render_mode="rgb_array")
    learner = bayespbrl.Learner(env, expert="other", clip_steps=6, **QUICK)
    query = learner.ask()[0]
    assert max(learner.state.clips[number][0] for number in (query.first, query.second)) > 0  # not at the reset
    for clip, part in zip(checked_clips(learner, query), query.trajectories, strict=True):
        assert (clip.width, clip.height, clip.frames) == (96, 64, 7)
        sheet = np.asarray(Image.open(io.BytesIO(clip.sheet)).convert("L"))
        for place, state in enumerate(part.states):
            row, column = divmod(place, clip.columns)
            shown = sheet[64 * row : 64 * (row + 1), 96 * column : 96 * (column + 1)]
            env.state = state
            np.testing.assert_array_equal(shown > 127, env.render()[:, :, 0] > 127)


class Blind(Camera):
    """Says that it renders, and fails."""

    def render(self):
        raise OSError("no display")


@pytest.mark.parametrize("env", [Slope(), Many()])
def test_where_an_environment_has_no_pictures_its_observations_are_plotted(env):
    clips = clips_of(env)
    assert {(clip.width, clip.height) for clip in clips} == {(440, 400)}


@pytest.mark.parametrize(
    ("env", "reason"),
    [
        (Camera(jumps=True), "reset with the same seed, it does not repeat its episode"),
        (Camera(render_mode=None), "expected render_mode rgb_array, got None"),
        (Blind(), "no display"),
    ],
)
def test_where_an_episode_cannot_be_filmed_a_warning_says_why_there_are_plots(env, reason):
    with pytest.warns(UserWarning, match=f"{type(env).__name__} is not rendered but plotted: {reason}"):
        clips = clips_of(env)
    assert {(clip.width, clip.height) for clip in clips} == {(440, 400)}


class SideBySide(VectorEnv):
    """Cameras that share random numbers, as a vector version of its own may."""

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012 (gymnasium's interface)
    single_observation_space, single_action_space = Camera.observation_space, Camera.action_space

    def __init__(self, num_envs=1, max_episode_steps=None, render_mode=None):
        self.num_envs, self.ended = num_envs, np.zeros(num_envs, bool)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.normal(size=(self.num_envs, 1)), {}

    def step(self, actions):
        return self.np_random.normal(size=(self.num_envs, 1)), np.zeros(self.num_envs), self.ended, self.ended, {}


def test_where_a_vector_version_collects_the_warning_names_it():
    class Plain(Camera):
        action_space = Discrete(2)

    SideBySide.single_action_space = Plain.action_space
    gymnasium.register("Cameras-v0", entry_point=Plain, vector_entry_point=SideBySide, max_episode_steps=20)
    try:
        with pytest.warns(UserWarning, match="plotted: its own vector version, which collects, shares random numbers"):
            clips_of("Cameras-v0", max_steps=None)
    finally:
        del gymnasium.registry["Cameras-v0"]


def test_a_plot_names_the_observations_as_the_environment_does():
    env = Slope()
    assert observation_names(env, 2) == ["observation 0", "observation 1"]
    env.observation_names = ("position", "speed")
    assert observation_names(env, 2) == ["position", "speed"]
    env.observation_names = ("a $x^$ b", r"$\theta$")  # no formula, and one: both are drawn
    states = np.array([[0.0, 1.0], [1.0, 0.0]])
    (film,) = draw_plots(env, [Trajectory(states, np.zeros((1, 1)), np.zeros(1))], lambda number: np.arange(number))
    assert len(film) == 2
    env.observation_names = ("position",)
    assert observation_names(env, 2) == ["observation 0", "observation 1"]


def test_a_clip_of_many_large_pictures_is_made_to_fit():
    class Large(Camera):
        def render(self):
            return np.random.default_rng(0).integers(0, 255, (500, 900, 3), dtype=np.uint8)

    clips = clips_of(Large(), max_steps=60)
    assert {clip.width for clip in clips} == {480}
    assert all(clip.frames < 61 for clip in clips)


def test_the_widget_asks_and_tells_by_its_messages():
    expert = bayespbrl.ReturnExpert()
    widget = bayespbrl.Learner("gridworld", expert="other", **QUICK).widget(answerer="Ada", practice=False)
    assert isinstance(widget, ComparisonWidget)
    try:
        session = widget.session
        sent = []
        with mock.patch.object(widget, "send", sent.append):
            while (view := session.wait(timeout=WAIT))["phase"] == QUESTION:
                given = str(expert(*session.learner.state.query.trajectories))
                message = {"turn": view["turn"], "answer": given, "seconds": 1.0}
                widget._handle_custom_msg(message, [])
                widget._handle_custom_msg(message, [])  # a second click
        assert widget.view["phase"] == FINISHED
        assert [message["refused"] for message in sent] == [1, 2, 3, 4]
        assert widget.first.startswith(b"\x89PNG")
    finally:
        widget.close()
    plain = bayespbrl.Learner("gridworld", expert="other", **QUICK).run(expert, answerer="Ada")
    assert fingerprint(session.learner) == fingerprint(plain)


def test_the_widget_says_that_an_answer_was_not_kept_and_takes_it_when_it_can(directory):
    learner = bayespbrl.resume(directory)
    widget = learner.widget(answerer="Ada", practice=False)
    try:
        view, before, sent = widget.session.wait(timeout=WAIT), lines_of(directory), []
        message = {"turn": view["turn"], "answer": "first"}
        full = OSError(errno.ENOSPC, "No space left on device")
        with mock.patch.object(widget, "send", sent.append):
            with mock.patch.object(learner.log, "append", side_effect=full):
                widget._handle_custom_msg(message, [])
            say = "your answer was not kept: [Errno 28] No space left on device"
            assert sent == [{"refused": view["turn"], "say": say}]
            assert (lines_of(directory), widget.session.view) == (before, view)
            widget._handle_custom_msg(message, [])
            later = widget.session.wait(timeout=WAIT)["turn"]
            with mock.patch.object(learner.log, "append", side_effect=full):
                widget._handle_custom_msg({"turn": later, "answer": "undo"}, [])
            assert sent[1:] == [{"refused": later, "say": say}]
        assert learner.preferences.answers == 1
        assert sum(line.startswith("answered") for line in lines_of(directory)) == 1
    finally:
        widget.close()


def test_the_widget_begins_with_the_practice_for_a_person_new_to_the_run(directory):
    learner = bayespbrl.resume(directory)
    widget, before = learner.widget(answerer="Ada"), lines_of(directory)
    phases = []
    try:
        for given in ("begin", "first", "tie"):
            view = widget.session.wait(("instructions", QUESTION), WAIT)
            phases.append((view["phase"], view["practice"]))
            assert widget.view == view
            assert (widget.first.startswith(b"\x89PNG"), widget.second != b"") == (given != "begin",) * 2
            widget._handle_custom_msg({"turn": view["turn"], "answer": given}, [])
        assert phases == [("instructions", None), (QUESTION, (1, 2)), (QUESTION, (2, 2))]
        assert widget.session.wait(timeout=WAIT)["practice"] is None
        assert lines_of(directory) == before
        widget._handle_custom_msg({"turn": widget.view["turn"], "answer": "tie"}, [])
        widget = learner.widget(answerer="Ada")  # again, when Ada has answered
        assert widget.session.wait(("instructions", QUESTION), WAIT)["phase"] == QUESTION
    finally:
        widget.close()


def lines_of(directory):
    """The events of a run in their order, answers and questions with their numbers."""
    events = map(json.loads, (directory / "events.jsonl").read_text().splitlines())
    return [f"{event['event']} {event.get('query', '')}".strip() for event in events]


def test_a_cell_that_shows_the_widget_may_run_again_and_nothing_is_asked_twice(directory):
    learner, opened = bayespbrl.resume(directory), []
    try:
        for number in range(3):
            run = learner if number < 2 else bayespbrl.resume(directory)  # as by a cell that resumes the run too
            opened.append(run.widget(practice=False))
            session = opened[-1].session
            view = session.wait(timeout=WAIT)
            assert session.learner.state.query.number == number + 1
            session.answer(view["turn"], "tie")
            session.wait(timeout=WAIT)
        with pytest.raises(Stale, match="session: expected an open one"):
            opened[0].session.answer(opened[0].session.view["turn"], "tie")
    finally:
        for widget in opened:
            widget.close()
    asked = [line for line in lines_of(directory) if line.startswith(("asked", "answered"))]
    assert asked == [f"{event} {number}" for number in (1, 2, 3) for event in ("asked", "answered")] + ["asked 4"]
    assert len(bayespbrl.resume(directory).ask()) == 1
    assert not held(directory)


def test_a_run_that_another_process_continues_shows_no_widget(directory):
    learner = bayespbrl.resume(directory)
    code = "import sys; from bayespbrl.runs.lock import continuing\nwith continuing(sys.argv[1]): print(input())"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", code, str(directory)], **pipes) as other:
        late = time.monotonic() + WAIT
        while not held(directory):
            assert time.monotonic() < late
            time.sleep(0.02)
        before = (directory / "events.jsonl").read_bytes()
        with pytest.raises(
            ValueError, match="expected a run that no other program continues, got one that does; stop it first"
        ):
            learner.widget()
        other.communicate("end\n")
    assert (directory / "events.jsonl").read_bytes() == before
    bayespbrl.resume(directory).run(lambda first, second: "tie")  # another learner goes on
    with pytest.raises(ValueError, match="got events that another learner has written; resume the run"):
        learner.widget()
    assert not held(directory)


def test_a_widget_holds_the_run_until_it_is_closed(monkeypatch, capsys, directory):
    widget = bayespbrl.resume(directory).widget()
    try:
        assert "expected a run that no other program continues, got one that does" in refused(
            monkeypatch, capsys, "ask", directory
        )
    finally:
        widget.close()
    assert not held(directory)


def test_a_widget_stays_open_where_another_is_refused(directory):
    outdated, learner = bayespbrl.resume(directory), bayespbrl.resume(directory)
    widget = learner.widget(practice=False)
    try:
        for number in (1, 2):
            widget.session.answer(widget.session.wait(timeout=WAIT)["turn"], "first")
            for other, options, said in (
                (learner, {"answers": 0}, "answers: expected"),
                (outdated, {}, "events that another learner has written"),
            ):
                with pytest.raises(ValueError, match=said):
                    other.widget(**options)
            assert (held(directory), learner.preferences.answers) == (True, number)
    finally:
        widget.close()


def test_a_step_that_is_computed_while_the_session_closes_is_left_to_the_next(directory):
    learner = bayespbrl.resume(directory)
    session, begun, go_on = Session(learner), threading.Event(), threading.Event()
    compute = session._foresight.compute

    def slowly(moment):
        begun.set()
        assert go_on.wait(WAIT)
        return compute(moment)

    session._foresight.compute = slowly
    session.open()
    assert begun.wait(WAIT)
    before = (directory / "events.jsonl").read_bytes() if (directory / "events.jsonl").exists() else b""
    closing = threading.Thread(target=session.close)
    closing.start()
    while not session._closing:
        time.sleep(0.01)
    go_on.set()
    closing.join(WAIT)
    assert ((directory / "events.jsonl").read_bytes() if before else b"") == before
    (next_one,) = bayespbrl.resume(directory).ask()
    assert next_one.number == 1


def held(directory):
    """Whether somebody continues a run."""
    try:
        with continuing(directory):
            return False
    except ValueError:
        return True


@pytest.mark.parametrize(
    "options", [{"answers": 0}, {"answerer": ""}, {"answerer": ["Ada", "Ben"]}, {"practice": "no"}]
)
def test_the_widget_refuses_bad_options(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        bayespbrl.Learner("gridworld", expert="other", **QUICK).widget(**options)


def refused(monkeypatch, capsys, *arguments):
    """The one line with which the command line refuses these arguments."""
    monkeypatch.setattr(sys, "argv", ["bayespbrl", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        main()
    error = capsys.readouterr().err
    assert (stop.value.code, error.count("\n")) == (2, 1)
    return error


@pytest.fixture
def directory(tmp_path):
    """A run that waits for a person, and its size."""
    bayespbrl.start("gridworld", tmp_path / "run", expert="page", **QUICK).ask()
    return tmp_path / "run"


def test_a_run_that_is_continued_elsewhere_is_refused(monkeypatch, capsys, directory):
    with continuing(directory):
        for command in ("ask", "resume"):
            assert "expected a run that no other program continues, got one that does" in refused(
                monkeypatch, capsys, command, directory
            )
    with continuing(directory):
        pass


def test_a_file_system_without_locks_is_no_other_program(directory, monkeypatch):
    def refuses(file, operation):
        raise OSError(errno.ENOLCK, "no locks available")

    monkeypatch.setattr(lock.fcntl, "flock", refuses)
    with continuing(directory):
        pass


def test_a_lock_is_of_a_file_that_may_be_written(directory, monkeypatch):
    """NFS refuses an exclusive lock of any other."""
    modes = []
    monkeypatch.setattr(
        lock.fcntl, "flock", lambda file, _: modes.append(fcntl.fcntl(file, fcntl.F_GETFL) & os.O_ACCMODE)
    )
    with continuing(directory):
        assert modes == [os.O_RDWR]


def test_a_run_that_nobody_can_be_asked_about_is_refused(monkeypatch, capsys, directory, tmp_path):
    assert "settings.json" in refused(monkeypatch, capsys, "ask", tmp_path)
    bayespbrl.resume(directory).run(lambda first, second: "tie")
    assert "expected a run with questions left, got a finished run" in refused(monkeypatch, capsys, "ask", directory)
    bayespbrl.start("gridworld", tmp_path / "simulated", **QUICK)
    assert "expected a run that a person answers" in refused(monkeypatch, capsys, "ask", tmp_path / "simulated")


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--answers", "0"], "answers"),
        (["--answerer", " "], "answerer"),
        (["--port", "-1"], "port"),
        (["--port", "65536"], "port: expected a number from 0 to 65535, got 65536"),
        (["--host", "192.0.2.1"], "expected an address to listen on, got '192.0.2.1' and 0"),  # another machine's
        (["--host", ""], "expected an address to listen on, got '' and 0"),
        (["--host", "a..b"], "expected an address to listen on, got 'a..b' and 0"),
    ],
)
def test_bad_options_of_ask_are_refused(monkeypatch, capsys, directory, options, named):
    before = (directory / "events.jsonl").read_bytes()
    assert named in refused(monkeypatch, capsys, "ask", directory, *options)
    assert (directory / "events.jsonl").read_bytes() == before


@pytest.mark.parametrize("option", ["practice", "browser"])
def test_a_simulated_expert_takes_no_practice_and_no_browser(monkeypatch, capsys, tmp_path, option):
    error = refused(monkeypatch, capsys, "run", "gridworld", f"--no-{option}", "--out", tmp_path / "new")
    assert f"{option}: expected --no-{option} only with the expert page, got the expert return" in error
    assert not (tmp_path / "new").exists()


def test_without_the_extra_one_line_says_what_to_install(monkeypatch, capsys, directory, tmp_path):
    for module in ("bayespbrl.people.page", "bayespbrl.people.widget"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.delattr("bayespbrl.people.page", raising=False)
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    monkeypatch.setitem(sys.modules, "anywidget", None)
    assert "pip install '.[people]'" in refused(monkeypatch, capsys, "ask", directory)
    new = tmp_path / "new"
    assert "pip install" in refused(monkeypatch, capsys, "run", "gridworld", "--expert", "page", "--out", new)
    assert not new.exists()
    with pytest.raises(ValueError, match="widget: expected the extra people"):
        bayespbrl.resume(directory).widget()
