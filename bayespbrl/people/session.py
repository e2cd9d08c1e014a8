"""One sitting: a learner, the person or people who answer, and a thread that thinks.

A turn is one state of the run, and each turn takes one answer or one undo: question → answer → thinking → question. The
answer is in the log, flushed, before `answer` returns. While a person looks, the thread computes what follows
(`foresight`) and draws it. A person who is new to the run may first get instructions and practice (`practice`), whose
turns record nothing.
"""

import threading
from collections.abc import Callable
from typing import Any

from bayespbrl import checks, events
from bayespbrl.events import Entry, LearnerState
from bayespbrl.learner import Learner
from bayespbrl.people import views
from bayespbrl.people.clips import Clip, Clips
from bayespbrl.people.foresight import Foresight, Moment
from bayespbrl.people.practice import Introduction
from bayespbrl.people.views import FAILED, FINISHED, INSTRUCTIONS, NOTHING_SAID, QUESTION, THINKING, Shown, View
from bayespbrl.preferences import Answer, parse_answer


class Stale(ValueError):
    """An answer to a turn that is over, as from a second window."""


class Session:
    """A sitting over a learner, safe to call from any thread.

    Args:
      learner: it must not be used elsewhere while the session is open.
      most_answers: of this sitting, after which it is finished; None: as many as the run takes.
      answerer: name of who answers, kept beside the answers. Only their own answers can be taken back.
      practice: whether instructions and practice come first, unless that person has already answered in this run.

    Raises:
      ValueError: a finished run, a bad number or a bad name.
    """

    def __init__(
        self,
        learner: Learner,
        *,
        most_answers: int | None = None,
        answerer: str | None = None,
        practice: bool = False,
    ):
        if learner.finished:
            raise ValueError("learner: expected one with questions left, got a finished run")
        if most_answers is not None:
            checks.whole("answers", most_answers)
        if answerer is not None:
            checks.short_name("answerer", answerer)
        self.learner, self.most_answers, self.answerer = learner, most_answers, answerer
        new = all(past.answerer != answerer for past in learner.state.past)
        self._introduction = Introduction() if practice and new else None
        self._clips = Clips(learner)
        self._foresight = Foresight(learner.cycle, learner.state, self._show, answerer)
        self._changed = threading.Condition(threading.RLock())
        self._turn, self._closing = 1, False
        self._before = learner.preferences.answers  # given in earlier sittings
        self._listeners: list[Callable[[], None]] = []
        self._view: View = self._described(THINKING)
        self._sheets: tuple[int, tuple[Clip, Clip]] | None = None
        self._thread = threading.Thread(target=self._think, name="bayespbrl-session", daemon=True)

    def open(self) -> "Session":
        """Start to think; returns the session."""
        with self._changed:
            self._settle()
        self._thread.start()
        return self

    def close(self) -> None:
        """Stop after the step of the cycle that is being computed. Nothing is lost."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join()

    @property
    def view(self) -> View:
        """What a page or widget shows now, as plain data; never changed, only replaced."""
        return self._view

    @property
    def over(self) -> bool:
        """Whether the sitting is finished, or has failed."""
        return self._view["phase"] in (FINISHED, FAILED)

    @property
    def idle(self) -> bool:
        """Whether a person is shown something and all that may follow is computed."""
        with self._changed:
            return self._view["phase"] != THINKING and self._pending() is None

    def sheet(self, turn: int, side: int) -> bytes:
        """The sprite sheet of a clip of the question of a turn, side 0 or 1; `Stale` where the turn is over."""
        sheets = self._sheets
        if sheets is None or sheets[0] != turn:
            raise Stale(f"turn: expected one with a question, got {turn}")
        return sheets[1][side].sheet

    def listen(self, callback: Callable[[], None]) -> Callable[[], None]:
        """Call `callback`, from any thread, whenever `view` is another; returns what ends that."""
        self._listeners.append(callback)
        return lambda: self._listeners.remove(callback)

    def wait(self, phases: tuple[str, ...] = (QUESTION, FINISHED, FAILED), timeout: float | None = None) -> View:
        """The view, once it is in one of `phases`."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._view["phase"] in phases, timeout):
                raise TimeoutError(f"expected {' or '.join(phases)}, still {self._view['phase']}")
            return self._view

    def answer(self, turn: int, answer: str, seconds: float | None = None) -> None:
        """Take the answer to the question of `turn`, or an undo there; it is on the disk when this returns.

        The instructions are answered with "begin". What is answered to them and in practice is not kept.

        Raises:
          Stale: the turn is over, or its question is not there yet; nothing has happened.
          ValueError: no answer, a bad time, or nothing to take back; nothing has happened.
        """
        with self._changed:
            if turn != self._turn or self._view["phase"] not in (INSTRUCTIONS, QUESTION):
                raise Stale(f"turn: expected {self._turn}, got {turn}")
            if self._introducing is not None:
                self._introducing.answer(answer)
                self._turn += 1
            elif answer == Answer.UNDO:
                self._undo()
            else:
                self._take(answer, seconds)
            self._settle()

    def _undo(self) -> None:
        if not self._view["undo"]:
            raise ValueError("undo: expected an answer of the same person's to take back, got none")
        self.learner.undo()
        self._turn += 1
        self._foresight.back(self.learner.state)

    def _take(self, answer: str, seconds: float | None) -> None:
        query = self.learner.state.query
        assert query is not None
        given = parse_answer(answer)
        self.learner.record(events.answered(query.number, given, answerer=self.answerer, seconds=seconds))
        self._turn += 1
        moment = self._foresight.move(given, self.learner.state)
        try:
            if moment.complete:  # the next question can be looked at while its events are written
                self._publish(moment)
            for entry in moment.entries:
                self.learner.record(entry)
        except Exception as error:  # a full disk, or another learner in the run: this answer is kept all the same
            self._failed(moment, error)

    # The thread that thinks.

    def _think(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closing or self._pending() is not None)
                moment = self._pending()
            if self._closing or moment is None:
                return
            try:
                entry = self._foresight.compute(moment)
                with self._changed:
                    self._keep(moment, entry)
            except Exception as error:  # the environment's, or a full disk
                with self._changed:
                    self._failed(moment, error)

    def _pending(self) -> Moment | None:
        return None if self.over else self._foresight.pending()

    def _keep(self, moment: Moment, entry: Entry | None) -> None:
        if entry is not None:
            if moment is self._foresight.present:
                self.learner.record(entry)
            self._foresight.keep(moment, entry)
        if moment is self._foresight.present:
            self._settle()
        self._changed.notify_all()

    def _failed(self, moment: Moment, error: Exception) -> None:
        moment.failed = True
        if moment is self._foresight.present:
            reason = " ".join(str(error).split()) or type(error).__name__
            self._set(self._described(FAILED) | {"say": f"Stopped: {reason} Your answers are kept."})

    def _settle(self) -> None:
        """Bring the view up to date with the present moment, and the thread to work."""
        present = self._foresight.present
        if present.failed:
            return
        if (introduction := self._introducing) is not None:
            self._introduce(introduction)
        elif present.complete:
            self._publish(present)
        else:
            self._set(self._described(THINKING))
        self._changed.notify_all()

    # What is shown.

    def _show(self, state: LearnerState) -> tuple[Shown, tuple[Answer, ...]]:
        """What a person is shown of the question that waits, and the answers to it, the likeliest first."""
        query = state.query
        assert query is not None
        if self._introduction is not None and self._introduction.clips is None:
            self._introduction.draw(self._clips, state)
        said, likely = views.said_of(query, state)
        return Shown(self._clips.of(query, state), said), likely

    def _described(self, phase: str, state: LearnerState | None = None) -> dict[str, Any]:
        state = state or self.learner.state
        return views.described(self.learner, state, phase, turn=self._turn, answerer=self.answerer)

    @property
    def _introducing(self) -> Introduction | None:
        """What comes before the first question, while it lasts; None where there is none, or no question to come."""
        introduction, present = self._introduction, self._foresight.present
        if introduction is None or introduction.over or (present.complete and present.state.query is None):
            return None
        return introduction

    def _introduce(self, introduction: Introduction) -> None:
        if introduction.place == 0:
            self._set(self._described(INSTRUCTIONS))
        elif introduction.clips is None:
            self._set(self._described(THINKING))
        else:
            place, number = introduction.place, len(introduction.clips)
            notice = "This is practice: your answer is not kept."
            view = self._described(QUESTION) | {"practice": (place, number), "notice": notice, "undo": True}
            self._ask(view, Shown(introduction.clips[place - 1], NOTHING_SAID))

    def _publish(self, moment: Moment) -> None:
        state = moment.state
        given = state.preferences.answers - self._before
        done = self.most_answers is not None and given >= self.most_answers
        if state.query is None or done:
            self._set(self._described(FINISHED, state) | {"say": views.ending(self.learner, state, given)})
            return
        notice = views.notice(given, practised=self._introduction is not None)
        self._ask(self._described(QUESTION, state) | {"notice": notice}, moment.shown)

    def _ask(self, view: View, shown: Shown) -> None:
        self._sheets = self._turn, shown.clips
        self._set(views.with_question(view, shown, self._clips.rate(shown.clips)))

    def _set(self, view: View) -> None:
        if view == self._view:
            return
        self._view = view
        self._changed.notify_all()
        for callback in list(self._listeners):
            callback()


def answer_of(message: Any) -> tuple[int, str, float | None]:
    """Turn, answer and seconds of a message of the front end; `ValueError` where it is none."""
    if not isinstance(message, dict) or not set(message) <= {"turn", "answer", "seconds"}:
        raise ValueError("answer: expected turn, answer and seconds")
    turn, answer, seconds = (message.get(name) for name in ("turn", "answer", "seconds"))
    if type(turn) is not int or not isinstance(answer, str):
        raise ValueError(f"answer: expected the number of a turn and an answer, got {turn!r} and {answer!r}"[:200])
    if seconds is not None and (isinstance(seconds, bool) or not isinstance(seconds, int | float)):
        raise ValueError("seconds: expected a number")
    return turn, answer, seconds
