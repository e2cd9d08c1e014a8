"""The page in a browser: a scripted person, two tabs, lost connections, killed servers."""

import http.client
import json
import logging
import os
import queue
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from importlib.resources import files
from unittest import mock
from urllib.parse import urlsplit

import numpy as np
import pytest
from toys import INTERRUPTIBLE, QUICK, READY, Slope, fingerprint

import bayespbrl
from bayespbrl.cli.display import ask_on_page
from bayespbrl.people.clips import MOST_BYTES
from bayespbrl.people.page import KINDS, LARGEST_BODY, SHELL, Page
from bayespbrl.people.session import Session
from bayespbrl.people.views import UNKNOWN

pytestmark = pytest.mark.slow
KEYS = {"first": "ArrowLeft", "second": "ArrowRight", "tie": "ArrowDown", "skip": "s", "undo": "u"}
KILLS = int(os.environ.get("BAYESPBRL_KILLS", "2"))  # of the server, in the test of killed servers


@contextmanager
def served(learner, **options):
    """A page on the questions of a learner."""
    page = Page(Session(learner, **options))
    server = threading.Thread(target=page.serve)
    server.start()
    try:
        yield page
    finally:
        page.stop()
        server.join()


@pytest.fixture
def gridworld(tmp_path):
    """A small run, kept on the disk, and the page that asks its questions."""
    learner = bayespbrl.start("gridworld", tmp_path / "run", expert="page", **QUICK)
    with served(learner) as page:
        yield page


@contextmanager
def tab(browser, page, ready=READY, address=None, before=None, **options):
    """A tab of the browser in a context of its own, which shows a question, or what `ready` selects.

    `before` is called with the tab before it makes its first request.
    """
    context = browser.new_context(**options)
    context.set_default_timeout(120_000)  # milliseconds; machines may be busy
    try:
        opened = context.new_page()
        opened.on("pageerror", lambda error: pytest.fail(f"JavaScript: {error}"))
        if before is not None:
            before(opened)
        opened.goto(address or page.address)
        opened.wait_for_selector(ready)
        yield opened
    finally:
        context.close()


def turn_of(opened):
    return int(opened.get_attribute(".bp-box", "data-turn"))


def next_turn(opened, turn, other=".bp-box[data-phase=finished]"):
    """Wait for the question after a turn, for the end, or for what else is selected."""
    shown = ".bp-box:is([data-phase=question], [data-phase=instructions])[data-locked=false]"
    opened.wait_for_selector(f"{shown}:not([data-turn='{turn}']), .bp-box[data-phase=finished], {other}")


def until(opened, condition):
    """Wait, while the browser goes on, until a condition holds."""
    late = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < late, opened.inner_text("body")
        opened.wait_for_timeout(20)


def press(opened, answer):
    turn = turn_of(opened)
    opened.keyboard.press(KEYS[answer])
    next_turn(opened, turn)


def settled(page):
    """The learner of a page; the next question, or the end, is shown a moment before it is recorded."""
    page.session.wait(timeout=120)
    return page.session.learner


def answers_of(page):
    """The answers in the log, those taken back among them."""
    events = map(json.loads, page.session.learner.log.log_file.read_text().splitlines())
    return [event.get("answer", "undone") for event in events if event["event"] in ("answered", "undone")]


def test_a_scripted_person_answers_a_whole_run_as_the_simulated_expert_does(browser, gridworld):
    expert, requests = bayespbrl.ReturnExpert(), []

    def listen(opened):
        opened.on("request", lambda request: requests.append(request.url))

    with tab(browser, gridworld, before=listen) as opened:
        while opened.get_attribute(".bp-box", "data-phase") != "finished":
            query = settled(gridworld).state.query
            press(opened, str(expert(*query.trajectories)))
        assert "4 answers" in opened.inner_text(".bp-ask")
    learner = bayespbrl.Learner("gridworld", expert="other", **QUICK).run(expert)
    assert learner.preferences.answers == 4
    assert fingerprint(settled(gridworld)) == fingerprint(learner)
    assert {url.removeprefix(gridworld.address) for url in requests} >= {"", "host.js", "front.js", "front.css"}
    assert [url for url in requests if not url.startswith(gridworld.address)] == []


def test_every_key_and_button_gives_its_answer(browser, gridworld):
    with tab(browser, gridworld) as opened:
        press(opened, "tie")
        press(opened, "undo")
        for answer in ("skip", "tie"):
            turn = turn_of(opened)
            opened.click(f"[data-answer={answer}]")
            next_turn(opened, turn)
        turn = turn_of(opened)
        opened.focus("[data-answer=second]")
        opened.keyboard.press("Enter")
        next_turn(opened, turn)
        given = ["tie", "undone", "skip", "tie", "second"]
        assert answers_of(gridworld) == given
        events = map(json.loads, gridworld.session.learner.log.log_file.read_text().splitlines())
        assert all(event["seconds"] > 0 for event in events if event["event"] == "answered")


def test_how_often_the_clips_began_again_is_kept_with_the_answer(browser, gridworld):
    with tab(browser, gridworld) as opened:
        opened.keyboard.press(" ")  # they stand
        for times in (0, 2):
            for _ in range(times):
                opened.click(".bp-again")
            opened.focus(".bp-box")
            press(opened, "tie")
        opened.select_option(".bp-speed select", "4")
        opened.focus(".bp-box")
        opened.keyboard.press(" ")
        until(opened, lambda: int(opened.get_attribute("canvas >> nth=0", "data-frame")) >= 10)
        until(opened, lambda: int(opened.get_attribute("canvas >> nth=0", "data-frame")) < 10)  # looped once
        press(opened, "tie")
    lines = gridworld.session.learner.log.log_file.read_text().splitlines()
    replays = [event["replays"] for event in map(json.loads, lines) if event["event"] == "answered"]
    assert replays[:2] == [0, 2]
    assert replays[2] >= 1


def test_a_key_that_is_held_or_pressed_twice_answers_once(browser, gridworld):
    with tab(browser, gridworld) as opened:
        turn = turn_of(opened)
        opened.evaluate(
            "for (const repeat of [false, true, false, false])"
            " document.body.dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowLeft', repeat, bubbles: true}))"
        )
        next_turn(opened, turn)
        assert answers_of(gridworld) == ["first"]


def test_the_second_half_of_a_double_click_or_key_is_no_answer_to_the_next_question(browser, gridworld):
    again = """() => {
      const box = document.querySelector(".bp-box"), second = document.querySelector("[data-answer=second]");
      new MutationObserver((changes, observer) => {
        observer.disconnect();
        document.body.dispatchEvent(new KeyboardEvent("keydown", {key: "ArrowRight", bubbles: true}));
        second.dispatchEvent(new MouseEvent("click", {bubbles: true, detail: 1}));
      }).observe(box, {attributeFilter: ["data-turn"]});
    }"""
    with tab(browser, gridworld) as opened:
        opened.evaluate(again)  # as soon as the next question is there
        press(opened, "first")
        assert answers_of(gridworld) == ["first"]
        second = opened.locator("[data-answer=second]")
        second.dispatch_event("click", {"detail": 2})
        assert opened.is_visible(READY)
        press(opened, "tie")
        assert answers_of(gridworld) == ["first", "tie"]


@pytest.mark.parametrize("pressed", ["[data-answer=second]", ".bp-again", ".bp-scrub"])
def test_after_a_click_the_space_bar_pauses_and_presses_no_button(browser, gridworld, pressed):
    with tab(browser, gridworld) as opened:
        opened.wait_for_selector(READY)
        # the second click of a double one, which is no answer, but leaves the focus where it was
        opened.evaluate(
            """name => {
              const pressed = document.querySelector(name);
              pressed.focus();
              pressed.dispatchEvent(new MouseEvent("click", {bubbles: true, detail: 2}));
            }""",
            pressed,
        )
        playing = opened.get_attribute(".bp-play", "data-playing")
        opened.keyboard.press(" ")
        assert opened.get_attribute(".bp-play", "data-playing") != playing
        assert opened.is_visible(READY)
        assert answers_of(gridworld) == []


def test_after_the_mouse_has_moved_the_clips_keys_answer_and_the_next_clips_play(browser, gridworld):
    with tab(browser, gridworld) as opened:
        opened.click(".bp-scrub")
        assert opened.get_attribute(".bp-play", "data-playing") == "false"
        press(opened, "second")
        assert answers_of(gridworld) == ["second"]
        assert opened.get_attribute(".bp-play", "data-playing") == "true"


def test_a_reload_and_a_second_tab_show_the_same_question_and_count_no_answer_twice(browser, gridworld):
    with tab(browser, gridworld) as opened, tab(browser, gridworld) as other:
        press(opened, "first")
        turn = turn_of(opened)
        opened.reload()
        opened.wait_for_selector(READY)
        other.wait_for_selector(f"{READY}[data-turn='{turn}']")
        assert turn_of(opened) == turn
        held = {}

        def hold(route):  # both answer the same question before the server hears either; a slow one sends again
            held.setdefault(route.request.frame.page, []).append(route)
            for routes in held.values() if len(held) == 2 else ():
                while routes:
                    routes.pop(0).continue_()

        for each in (opened, other):
            each.route("**/answer", hold)
            each.keyboard.press("ArrowRight")
            each.wait_for_selector(f".bp-box[data-turn='{turn}'][data-locked=true]")
        next_turn(opened, turn)
        next_turn(other, turn)
        assert answers_of(gridworld) == ["first", "second"]
        notes = [each.locator(".bp-note") for each in (opened, other)]
        until(opened, lambda: sum("another window" in note.inner_text() for note in notes) == 1)


def test_a_key_that_was_held_before_the_question_came_answers_nothing(browser, gridworld):
    with tab(browser, gridworld) as opened:
        turn = turn_of(opened)
        opened.evaluate(
            "for (const key of ['ArrowLeft', 'ArrowRight', 's', 'u'])"
            " document.body.dispatchEvent(new KeyboardEvent('keydown', {key, repeat: true, bubbles: true}))"
        )
        assert opened.is_visible(READY)  # still unlocked
        press(opened, "tie")
        assert turn_of(opened) == turn + 1
        assert answers_of(gridworld) == ["tie"]


def test_what_the_learner_knows_of_an_answer_is_shown_and_that_one_can_stop(browser, gridworld, monkeypatch):
    said = {"sure": 0.987, "worth": 0.004, "advice": "You can stop here."}
    monkeypatch.setattr("bayespbrl.people.views.said_of", lambda query, state, answerer: (said, UNKNOWN))
    with tab(browser, gridworld) as opened:
        press(opened, "tie")  # what was drawn before says nothing
        press(opened, "tie")
        assert opened.inner_text(".bp-learner").strip() == (
            "The learner is 99 % sure what you will say. Your answer is worth about 0.00 bit, of 1 at most. "
            "You can stop here."
        )


def test_while_the_learner_computes_the_page_says_thinking(browser, gridworld):
    with tab(browser, gridworld) as opened:
        held = []
        opened.route("**/answer", lambda route: held.append(route))
        turn = turn_of(opened)
        opened.keyboard.press("ArrowLeft")
        opened.wait_for_selector(".bp-box[data-phase=thinking][data-locked=true]")
        assert opened.inner_text(".bp-ask") == "Thinking…"
        opened.keyboard.press("ArrowRight")
        until(opened, lambda: len(held) == 1)
        held[0].continue_()
        next_turn(opened, turn)
        assert answers_of(gridworld) == ["first"]


def broken_stream(page):
    """What routes requests of views: one view, then none until it is `back`; and the requests so far."""
    back, tried = threading.Event(), []

    def break_off(route):
        tried.append(route)
        if back.is_set():
            return route.continue_()
        if len(tried) > 1:
            return route.abort()
        body = f"data: {json.dumps(page.session.view)}\n\n"  # and then the stream ends
        return route.fulfill(body=body, content_type="text/event-stream")

    return break_off, back, tried


@contextmanager
def tab_without_views(browser, page, break_off, rate=1):
    """A tab that shows a question and hears no more, whose clock stood still until then: a busy machine may take long.

    Then the clock jumps by a second, past the moment in which a new question takes no answer, and runs at `rate`.
    """

    def before(opened):
        opened.add_init_script("performance.running = performance.now; performance.now = () => 0")
        opened.route("**/events", break_off)

    with tab(browser, page, before=before) as opened:
        opened.evaluate(
            """(rate) => {
              const start = performance.running();
              performance.now = () => 1000 + rate * (performance.running() - start);
            }""",
            rate,
        )
        yield opened


def test_a_page_that_hears_no_more_views_says_so_and_goes_on_when_it_hears_them_again(browser, gridworld):
    gridworld.session.wait(timeout=60)
    break_off, back, tried = broken_stream(gridworld)
    with tab_without_views(browser, gridworld, break_off) as opened:
        opened.wait_for_selector(".bp-note >> text=The connection is lost. Trying again…")
        until(opened, lambda: len(tried) >= 3)
        back.set()
        opened.wait_for_selector(".bp-note", state="hidden")
        press(opened, "second")
        assert answers_of(gridworld) == ["second"]


def test_a_page_that_is_not_answered_for_long_says_what_to_do_and_goes_on_when_it_is(browser, gridworld):
    gridworld.session.wait(timeout=60)
    break_off, back, _ = broken_stream(gridworld)
    with tab_without_views(browser, gridworld, break_off, rate=20) as opened:
        opened.wait_for_selector(".bp-note >> text=start it again")
        assert opened.get_attribute(".bp-box", "data-locked") == "true"
        opened.keyboard.press("ArrowLeft")
        back.set()
        opened.wait_for_selector(".bp-note", state="hidden")
        press(opened, "second")
        assert answers_of(gridworld) == ["second"]


def test_a_page_that_loses_its_program_after_all_answers_says_that_it_can_be_closed(browser, gridworld):
    gridworld.session.wait(timeout=60)
    seat = gridworld.session.seats[0]
    with seat.session.changed:
        seat.set({**seat.view, "all_given": True})
    break_off, back, _ = broken_stream(gridworld)
    with tab_without_views(browser, gridworld, break_off, rate=20) as opened:
        opened.wait_for_selector(".bp-note >> text=All answers are given and kept. You can close this page.")
        assert opened.get_attribute(".bp-box", "data-locked") == "true"
        back.set()
        opened.wait_for_selector(".bp-note", state="hidden")


def test_clips_that_a_dead_connection_was_to_bring_are_fetched_again(browser, gridworld):
    gridworld.session.wait(timeout=60)
    break_off, back, _ = broken_stream(gridworld)
    asked = []

    def before(opened):
        opened.route("**/events", break_off)
        opened.route("**/clip/**", lambda route: asked.append(route) or (len(asked) > 2 and route.continue_()))

    with tab(browser, gridworld, ready=".bp-note >> text=The connection is lost", before=before) as opened:
        until(opened, lambda: len(asked) == 2)  # which nobody answers
        back.set()
        opened.wait_for_selector(READY, timeout=30_000)


def test_views_of_one_turn_wait_for_the_same_clips(browser, gridworld):
    """Each answer of somebody else brings another view; on a slow line the clips then began anew each time."""
    gridworld.session.wait(timeout=60)
    seat, asked, held = gridworld.session.seats[0], [], []

    def hold(route):
        asked.append(route)
        if len(asked) > 2:
            return route.continue_()
        return held.append(route)

    def before(opened):
        opened.route("**/clip/**", hold)

    with tab(browser, gridworld, ready=".bp-box", before=before) as opened:
        until(opened, lambda: len(held) == 2)
        for others in range(1, 4):
            with seat.session.changed:
                seat.set({**seat.view, "answered": others})
            opened.wait_for_timeout(200)
        for route in held:
            route.continue_()
        opened.wait_for_selector(READY)
        assert opened.inner_text(".bp-count") == "3 answers"
        assert len(asked) == 2


def test_a_key_answers_no_question_whose_clips_are_not_on_the_screen_yet(browser, gridworld):
    slow = """() => {
      const decoded = window.createImageBitmap;
      window.createImageBitmap = async (...sheet) => {
        await new Promise((done) => setTimeout(done, window.delay ?? 0));
        return decoded(...sheet);
      };
    }"""
    with tab(browser, gridworld) as opened, tab(browser, gridworld) as other:
        opened.evaluate(slow)
        opened.evaluate("window.delay = 1500")
        turn = turn_of(opened)
        press(other, "second")
        opened.wait_for_selector(f".bp-box[data-locked=true][data-turn='{turn}']")  # the next question is on its way
        opened.keyboard.press("ArrowLeft")
        opened.wait_for_selector(f"{READY}[data-turn='{turn + 1}']")
        assert answers_of(gridworld) == ["second"]
        press(opened, "tie")
        assert answers_of(gridworld) == ["second", "tie"]


def test_a_connection_that_dies_without_a_word_is_opened_again(browser, gridworld, monkeypatch):
    monkeypatch.setattr("bayespbrl.people.page.HEARTBEAT", 0.1)
    asked = []

    def before(opened):
        opened.clock.install()
        opened.on("request", lambda request: asked.append(request.url) if request.url.endswith("events") else None)

    with tab(browser, gridworld, before=before) as opened:
        for _ in range(4):
            opened.clock.fast_forward(20_000)
            opened.wait_for_timeout(500)  # signs of life come meanwhile
        assert len(asked) == 1
        monkeypatch.setattr("bayespbrl.people.page.HEARTBEAT", 1000.0)
        opened.wait_for_timeout(500)
        opened.clock.fast_forward(26_000)
        until(opened, lambda: opened.clock.fast_forward(1000) or len(asked) == 2)
        opened.wait_for_selector(".bp-note", state="hidden")
        press(opened, "second")
        assert answers_of(gridworld) == ["second"]


def test_a_window_that_nobody_sees_takes_no_connection(browser, gridworld):
    """Six are all that a browser has."""
    hide = """(hidden) => {
      Object.defineProperty(document, "hidden", { get: () => hidden, configurable: true });
      document.dispatchEvent(new Event("visibilitychange"));
    }"""
    with tab(browser, gridworld) as opened:
        turn = turn_of(opened)
        others = [opened.context.new_page() for _ in range(7)]
        for other in others:
            other.add_init_script("Object.defineProperty(document, 'hidden', { get: () => true, configurable: true })")
            other.goto(gridworld.address)
        assert len(gridworld._server.streams) == 1
        press(opened, "first")
        opened.evaluate(hide, True)
        until(opened, lambda: not gridworld._server.streams)
        others[0].evaluate(hide, False)
        others[0].wait_for_selector(f"{READY}[data-turn='{turn + 1}']")
        press(others[0], "tie")
        opened.evaluate(hide, False)
        opened.wait_for_selector(f"{READY}[data-turn='{turn + 2}']")
        opened.evaluate(hide, False)  # seen all the time
        assert len(gridworld._server.streams) == 2
        assert answers_of(gridworld) == ["first", "tie"]


@pytest.mark.parametrize("heard", [False, True])
def test_an_answer_whose_connection_is_lost_is_sent_again_and_counts_once(browser, gridworld, heard):
    """The request is lost, or (`heard`) its reply."""
    posts = []

    def lose(route):
        posts.append(route.request.post_data)
        if len(posts) > 1:
            return route.continue_()
        if heard:
            route.fetch()
        return route.abort()

    with tab(browser, gridworld) as opened:
        opened.route("**/answer", lose)
        press(opened, "second")
        opened.wait_for_selector(READY)
        until(opened, lambda: len(posts) == 2)  # the next question may come before the reply is missed
        opened.wait_for_selector(".bp-note", state="hidden")
        assert posts[0] == posts[1]
        assert answers_of(gridworld) == ["second"]


def test_the_clips_stay_in_step_and_can_be_paused_scrubbed_and_sped_up(browser):
    with (
        served(bayespbrl.Learner("swing-up", expert="page", **QUICK | {"max_steps": None})) as page,
        tab(browser, page) as opened,
    ):
        watch = """async (seconds) => {
          const seen = [], until = performance.now() + 1000 * seconds;
          const canvases = [...document.querySelectorAll("canvas")];
          while (performance.now() < until) {
            await new Promise(requestAnimationFrame);
            seen.push(canvases.map((canvas) => Number(canvas.dataset.frame)));
          }
          return seen;
        }"""
        seen = np.array(opened.evaluate(watch, 1.0))
        assert abs(seen[:, 0] - seen[:, 1]).max() <= 1
        assert len(set(seen[:, 0])) >= 3  # it moves
        opened.keyboard.press(" ")
        assert len(set(map(tuple, opened.evaluate(watch, 0.2)))) == 1
        opened.fill(".bp-scrub", "500")
        assert opened.evaluate(watch, 0.1)[-1] == [30, 30]
        opened.click(".bp-again")
        assert opened.evaluate(watch, 0.1)[-1] == [0, 0]
        opened.select_option(".bp-speed select", "4")
        opened.focus(".bp-box")
        opened.keyboard.press(" ")
        assert np.array(opened.evaluate(watch, 0.5)).max() >= 15  # of 60 frames in three seconds at speed 1
        opened.select_option(".bp-speed select", "0.5")
        opened.click(".bp-again")
        assert 4 <= np.array(opened.evaluate(watch, 1.0)).max() <= 15  # 10 at half the speed
        assert page.session.learner.preferences.answers == 0


def test_it_can_be_used_with_reduced_motion_on_a_phone_and_by_a_screen_reader(browser, gridworld):
    phone = {"viewport": {"width": 360, "height": 700}, "reduced_motion": "reduce"}
    with tab(browser, gridworld, **phone) as opened:
        assert opened.get_attribute(".bp-play", "aria-label") == "Play"
        assert opened.evaluate("document.documentElement.scrollWidth") <= 360
        assert opened.get_attribute("canvas", "aria-label") == "First: 20 steps"
        assert "Which one is better?" in opened.inner_text("[aria-live=polite]")
        assert opened.locator("[aria-live], [role=status], [role=alert], [role=log], output").count() == 2  # that speak
        names = opened.evaluate(
            "[...document.querySelectorAll('button')].map((b) => b.ariaLabel ?? b.innerText.trim())"
        )
        assert all(names)
        targets = opened.evaluate(
            "[...document.querySelectorAll('button')].filter((b) => b.checkVisibility())"
            ".map((b) => b.getBoundingClientRect().height)"
        )
        assert len(targets) == len(names) - 1  # but for that of the instructions
        assert min(targets) >= 44


def test_a_new_person_gets_instructions_and_practises_by_keyboard_alone(browser, tmp_path):
    learner = bayespbrl.start("gridworld", tmp_path / "run", expert="page", **QUICK)
    instructions = ".bp-box[data-phase=instructions][data-locked=false]"
    with (
        served(learner, answerer="Ada", practice=True) as page,
        tab(browser, page, ready=instructions, viewport={"width": 360, "height": 700}) as opened,
    ):
        live, ask, quiet = ".bp-live", ".bp-ask", ".bp-learner"
        assert "press Enter" in opened.inner_text(live)
        text = opened.inner_text(".bp-intro")
        for said in (
            "under the name Ada",
            "count as one person",
            "Cannot tell",
            "Undo",
            "Practice answers are not kept",
        ):
            assert said in text
        assert opened.evaluate("document.documentElement.scrollWidth") <= 360
        assert opened.get_by_role("button").all_inner_texts() == ["Start the practice"]
        opened.keyboard.press("ArrowLeft")  # answers nothing here
        opened.keyboard.press("Enter")
        opened.wait_for_selector(READY)
        turn = turn_of(opened)
        assert "Practice 1 of 2: which one is better?" in opened.inner_text(ask)
        assert "your answer is not kept" in opened.inner_text(live)
        press(opened, "undo")  # back to the instructions
        opened.reload()
        opened.wait_for_selector(instructions)
        opened.keyboard.press("Enter")
        opened.wait_for_selector(READY)
        assert turn_of(opened) == turn + 2
        press(opened, "first")
        assert "Practice 2 of 2: which one is better?" in opened.inner_text(live)
        assert "your answer is not kept" in opened.inner_text(quiet)
        press(opened, "tie")
        assert opened.inner_text(ask) == "Which one is better?"
        assert "The practice is over" in opened.inner_text(quiet)
        assert answers_of(page) == []
        press(opened, "second")
        assert answers_of(page) == ["second"]
        assert "answered by Ada" in opened.inner_text(".bp-task")


def call(page, method, path, body=None, **headers):
    """Status and text of a request to a page."""
    with closing(http.client.HTTPConnection("127.0.0.1", page.port, timeout=20)) as connection:
        connection.request(method, path, body, headers)
        with connection.getresponse() as reply:
            return reply.status, reply.read().decode(errors="replace")


def test_nonsense_is_refused_and_changes_nothing(gridworld):
    gridworld.session.wait(timeout=60)
    token = f"/{gridworld.token}"
    turn = gridworld.session.view["turn"]
    good = json.dumps({"turn": turn, "answer": "first", "seconds": 1.0})
    before = gridworld.session.learner.log.log_file.read_bytes()
    foreign = {"Origin": "http://example.org"}
    for host in ("127.0.0.1", "LOCALHOST"):  # a name in any case
        assert call(gridworld, "GET", f"{token}/", Host=f"{host}:{gridworld.port}")[0] == 200
    for path in ("/", "/answer", "/events", "/wrong/", f"/{gridworld.token[:-1]}/", token[:-1]):
        assert call(gridworld, "GET", path)[0] == 403
    assert call(gridworld, "GET", token)[0] == 307  # to the address with its last slash
    assert call(gridworld, "GET", token, Host="example.org")[0] == 403
    assert call(gridworld, "POST", token, good)[0] == 403
    assert call(gridworld, "POST", "/wrong/answer", good)[0] == 403
    assert call(gridworld, "POST", f"{token}/answer", good, **foreign)[0] == 403
    assert call(gridworld, "POST", f"{token}/answer", good, Host="example.org")[0] == 403
    assert call(gridworld, "GET", f"{token}/answer")[0] == 405
    wrong = (
        "/secret",
        f"/clip/{turn}/2",
        f"/clip/{turn + 1}/0",
        f"/clip/{turn}/x",
        f"/clip/+{turn}/0",
        f"/clip/{'9' * 5000}/0",
        "/../page.py",
    )
    for path in wrong:
        assert call(gridworld, "GET", token + path)[0] == 404
    assert call(gridworld, "POST", f"{token}/answer", b" " * (LARGEST_BODY + 1))[0] == 413
    nonsense = [
        b"",
        b"\xff",
        b"[" * 3000,
        "null",
        '"first"',
        json.dumps({"turn": turn}),
        json.dumps({"turn": str(turn), "answer": "first"}),
        json.dumps({"turn": turn, "answer": "left"}),
        json.dumps({"turn": turn, "answer": "first", "seconds": -1}),
        json.dumps({"turn": turn, "answer": "first", "seconds": float("nan")}),
        json.dumps({"turn": turn, "answer": "first", "seconds": "long"}),
        json.dumps({"turn": turn, "answer": "first", "seconds": 10**400}),
        json.dumps({"turn": turn, "answer": "first", "replays": -1}),
        json.dumps({"turn": turn, "answer": "first", "replays": 1e9}),
        json.dumps({"turn": turn, "answer": "first", "more": 1}),
        json.dumps({"turn": turn, "answer": "undo"}),  # nothing to take back
    ]
    for body in nonsense:
        status, text = call(gridworld, "POST", f"{token}/answer", body)
        assert (status, text.count("\n")) == (400, 0), body
    for wrong in (turn - 1, turn + 1):
        assert call(gridworld, "POST", f"{token}/answer", json.dumps({"turn": wrong, "answer": "first"}))[0] == 409
    assert gridworld.session.learner.log.log_file.read_bytes() == before
    assert call(gridworld, "POST", f"{token}/answer", good)[0] == 204


def test_a_browser_that_hangs_up_and_one_that_wants_a_web_socket_leave_no_traceback(gridworld):
    gridworld.session.wait(timeout=60)
    records, handler = [], logging.Handler()
    handler.emit = records.append
    logger = logging.getLogger("uvicorn.error")
    logger.addHandler(handler)
    try:
        head = f"POST /{gridworld.token}/answer HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 100\r\n\r\n"
        with socket.create_connection(("127.0.0.1", gridworld.port)) as connection:
            connection.sendall(head.encode() + b'{"turn"')
        time.sleep(0.3)  # until it is noticed
        upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
        status, _ = call(gridworld, "GET", "/events", **upgrade, **{"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ=="})
        assert status == 403
        assert call(gridworld, "GET", f"/{gridworld.token}/")[0] == 200  # it has seen to the others by then
    finally:
        logger.removeHandler(handler)
    assert not [record.getMessage() for record in records if record.levelno >= logging.ERROR]


def test_a_message_that_is_sent_again_is_heard_once_and_one_of_another_window_is_refused(gridworld):
    gridworld.session.wait(timeout=60)
    body = json.dumps({"turn": gridworld.session.view["turn"], "answer": "first", "seconds": 1.0})
    sent = [
        call(gridworld, "POST", f"/{gridworld.token}/answer", body, **{"Idempotency-Key": key})[0] for key in "1121"
    ]
    assert sent == [204, 204, 409, 204]
    assert call(gridworld, "POST", f"/{gridworld.token}/answer", body)[0] == 409
    assert answers_of(gridworld) == ["first"]


def test_an_answer_that_the_disk_does_not_take_is_refused_in_one_line_and_counts_once_when_it_does(gridworld):
    gridworld.session.wait(timeout=60)
    body = json.dumps({"turn": gridworld.session.view["turn"], "answer": "first"})
    request = ("POST", f"/{gridworld.token}/answer", body)
    with mock.patch.object(gridworld.session.learner.log, "append", side_effect=OSError("No space left on device")):
        refused = call(gridworld, *request, **{"Idempotency-Key": "1"})
    assert refused == (400, "your answer was not kept: No space left on device")
    assert answers_of(gridworld) == []
    assert [call(gridworld, *request, **{"Idempotency-Key": key})[0] for key in "22"] == [204, 204]
    assert answers_of(gridworld) == ["first"]


class Snow(Slope):
    """Its pictures are noise, which compresses worst."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (gymnasium's interface)
    render_mode = "rgb_array"

    def render(self):
        return np.random.default_rng(self.life).integers(0, 255, (500, 900, 3), dtype=np.uint8)


def test_a_first_question_with_the_page_around_it_weighs_at_most_two_megabytes():
    page_itself = len(SHELL) + sum(len(files("bayespbrl.people").joinpath(name).read_bytes()) for name in KINDS)
    rest = 50_000  # of headers and views, which are a thousand bytes each
    assert page_itself + 2 * MOST_BYTES + rest <= 2_000_000
    with served(bayespbrl.Learner(Snow(), expert="other", **QUICK | {"max_steps": 60})) as page:
        turn = page.session.wait(timeout=60)["turn"]
        weight = len(json.dumps(page.session.view))
        for path in ("", *KINDS, f"clip/{turn}/0", f"clip/{turn}/1"):
            with closing(http.client.HTTPConnection("127.0.0.1", page.port, timeout=20)) as connection:
                connection.request("GET", f"/{page.token}/{path}")
                with connection.getresponse() as reply:
                    weight += len(reply.read()) + len(str(reply.headers))
        clips = [len(page.session.sheet(turn, side)) for side in (0, 1)]
    assert page_itself + sum(clips) < weight <= page_itself + sum(clips) + rest
    assert MOST_BYTES / 3 < max(clips) <= MOST_BYTES
    assert weight <= 2_000_000


def test_ten_megabytes_are_not_read(gridworld):
    with closing(http.client.HTTPConnection("127.0.0.1", gridworld.port, timeout=20)) as connection:
        connection.putrequest("POST", f"/{gridworld.token}/answer")
        connection.putheader("Content-Length", str(10_000_000))
        connection.endheaders()
        connection.send(b" " * 100_000)
        with connection.getresponse() as reply:
            assert reply.status == 413


def test_a_port_in_use_is_refused(gridworld):
    with pytest.raises(ValueError, match=f"expected an address to listen on, got '127.0.0.1' and {gridworld.port}"):
        Page(Session(bayespbrl.Learner("gridworld", **QUICK)), port=gridworld.port)


class WearsOut(Slope):
    """Fails at every step from the 250th of its life on, whichever answer it is stepped for."""

    def step(self, action):
        if self.life >= 250:
            raise RuntimeError("the motor is on fire")
        return super().step(action)


def test_an_environment_that_fails_while_a_person_answers_says_so(browser):
    learner = bayespbrl.Learner(WearsOut(), expert="other", **QUICK)
    with served(learner) as page, tab(browser, page) as opened:
        while opened.get_attribute(".bp-box", "data-phase") == "question":
            opened.keyboard.press("ArrowLeft")
            opened.wait_for_selector(f"{READY}, .bp-box[data-phase=failed]")
        assert "the motor is on fire" in opened.inner_text(".bp-ask")
        assert learner.preferences.answers >= 1


class Person:
    """Answers on a server that is killed again and again: first, second, first, … by the number of the answer."""

    def __init__(self, directory):
        self.directory, self.acknowledged = directory, []

    def sit(self, seconds):
        """Start the server and answer until it is over; kill it after so many seconds of answering, None for never.

        Returns whether the run is finished.
        """
        command = [sys.executable, "-m", "bayespbrl", "ask", str(self.directory), "--no-practice"]
        server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        try:
            lines = iter(server.stdout.readline, "")
            address = urlsplit(next(line.strip() for line in lines if line.startswith("http://")))
            killer = None
            for view in self._views(address):
                if killer is None and seconds is not None:
                    killer = threading.Timer(seconds, server.kill)
                    killer.start()
                if view["phase"] == "question":
                    self._answer(address, view)
                if view["phase"] == "finished":
                    return True
        except (OSError, http.client.HTTPException):
            return False
        finally:
            server.kill()
            server.wait()
            server.stdout.close()
        return False

    def _views(self, address):
        with closing(http.client.HTTPConnection(address.hostname, address.port, timeout=60)) as connection:
            connection.request("GET", address.path + "events")
            with connection.getresponse() as reply:
                while line := reply.readline():
                    if line.startswith(b"data: "):
                        yield json.loads(line[6:])

    def _answer(self, address, view):
        given = view["answered"], ("first", "second")[view["answered"] % 2]
        body = json.dumps({"turn": view["turn"], "answer": given[1], "seconds": 0.5})
        with closing(http.client.HTTPConnection(address.hostname, address.port, timeout=60)) as connection:
            connection.request("POST", address.path + "answer", body)
            with connection.getresponse() as reply:
                assert reply.status == 204
        self.acknowledged.append(given)


def test_ctrl_c_ends_a_sitting_with_its_status_and_the_same_command_goes_on(tmp_path):
    bayespbrl.start("gridworld", tmp_path / "run", expert="page", **QUICK)
    person = Person(tmp_path / "run")
    command = [*INTERRUPTIBLE, "ask", str(tmp_path / "run"), "--no-practice"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        try:
            lines = iter(server.stdout.readline, "")
            address = urlsplit(next(line.strip() for line in lines if line.startswith("http://")))
            views = person._views(address)  # they stay open, as in a browser
            for view in views:
                if view["phase"] == "question" and view["answered"] == 1:
                    break
                if view["phase"] == "question":
                    person._answer(address, view)
            server.send_signal(signal.SIGINT)
            said, errors = server.communicate(timeout=60)
        finally:
            server.kill()
    assert (server.returncode, errors) == (130, "")
    assert f"Stopped. Nothing is lost: bayespbrl ask {tmp_path / 'run'}" in said
    assert person.sit(None)
    assert person.acknowledged == [(0, "first"), (1, "second"), (2, "first"), (3, "second")]
    assert bayespbrl.load(tmp_path / "run").learner.finished


def test_an_interrupt_after_the_last_answer_on_a_page_says_how_to_get_the_pictures(capsys, tmp_path):
    learner = bayespbrl.start("gridworld", tmp_path / "run", expert="page", **QUICK)
    person, opened = Person(tmp_path / "run"), queue.SimpleQueue()
    with (
        mock.patch("bayespbrl.cli.display.somebody_looks", return_value=True),
        mock.patch("bayespbrl.cli.display.open_in_browser", side_effect=opened.put),
        mock.patch("bayespbrl.cli.display._film", side_effect=KeyboardInterrupt),
        ThreadPoolExecutor(1) as server,  # a thread of its own, as in `served`: a test's browser has an event loop here
    ):
        sitting = server.submit(ask_on_page, learner, tmp_path / "run", practice=False)
        address = urlsplit(opened.get(timeout=60))
        with closing(person._views(address)) as views:
            for view in views:
                if view["phase"] == "question":
                    person._answer(address, view)
                elif view["phase"] == "finished":
                    break
        with pytest.raises(KeyboardInterrupt):
            sitting.result(timeout=60)
    assert learner.finished
    assert f"Nothing is lost: bayespbrl resume {tmp_path / 'run'}" in capsys.readouterr().out.replace("\n", "")


def test_a_server_that_is_killed_at_any_moment_loses_no_answer_and_counts_none_twice(tmp_path):
    iterations = max(12, 4 * KILLS)
    options = QUICK | {"iterations": iterations}
    bayespbrl.start("gridworld", tmp_path / "run", expert="page", **options)
    person, rng = Person(tmp_path / "run"), random.Random(0)
    for _ in range(KILLS):
        assert not person.sit(rng.uniform(0.0, 0.6))
    while not person.sit(None):
        time.sleep(0.1)
    events = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    answered = [event for event in events if event["event"] == "answered"]
    assert [event["query"] for event in answered] == list(range(1, iterations + 2))
    kept = list(enumerate(event["answer"] for event in answered))
    assert set(person.acknowledged) <= set(kept)
    assert len(person.acknowledged) == len(set(person.acknowledged)) >= len(kept) - KILLS
    answers = iter([answer for _, answer in kept])
    learner = bayespbrl.Learner("gridworld", expert="other", **options).run(lambda first, second: next(answers))
    assert fingerprint(bayespbrl.load(tmp_path / "run").learner) == fingerprint(learner)
