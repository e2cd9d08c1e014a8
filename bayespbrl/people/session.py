"""One sitting: a learner, the people who answer, and a thread that computes.

A turn is one state of the run as one person sees it, and takes one answer or one undo: question → answer → thinking →
question. The answer is in the log, flushed, before `answer` returns. While people look, the thread computes what
follows (`foresight`) and draws it. A person who is new to the run may first get instructions and practice (`practice`),
whose turns record nothing.

Several people answer at once, each a question of their own (`seat`). After an answer the run goes on while the others
look at theirs, so that nobody waits for another; an answer may then be to a question of an earlier iteration.
"""

import secrets
import threading
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from bayespbrl import checks, events
from bayespbrl.events import Entry, LearnerState
from bayespbrl.learner import Learner
from bayespbrl.people import views
from bayespbrl.people.clips import Clips
from bayespbrl.people.foresight import Drawn, Foresight, Moment
from bayespbrl.people.practice import Introduction
from bayespbrl.people.seat import Seat, Stale
from bayespbrl.people.views import (
    FAILED,
    FINISHED,
    INSTRUCTIONS,
    NOTHING_SAID,
    QUESTION,
    THINKING,
    WAITING,
    Shown,
    View,
)
from bayespbrl.preferences import Answer, Query, parse_answer

GATHER = 1.0  # seconds between two looks at who is here, where there are several


Names = str | Sequence[str] | None  # of one person, of several, or none


def checked_options(
    learner: Learner, *, most_answers: int | None = None, answerer: Names = None, practice: bool = False
) -> list[str | None]:
    """The names of those who answer; `ValueError` for options that a `Session` does not take."""
    if learner.finished:
        raise ValueError("learner: expected a run with questions left, got a finished run")
    checks.optional(checks.whole, "answers", most_answers)
    checks.boolean("practice", practice)
    names: list[str | None] = [answerer] if answerer is None or isinstance(answerer, str) else list(answerer)
    for name in names:
        checks.optional(checks.short_name, "answerer", name)
    if not names or len(set(names)) < len(names):
        raise ValueError(f"answerer: expected a different name for each person, got {names}")
    return names


class Session:
    """A sitting over a learner, safe to call from any thread.

    `view`, `sheet`, `listen`, `wait` and `answer` are those of the first or only person.

    Args:
      learner: it must not be used elsewhere while the session is open.
      most_answers: of this sitting, after which it is finished; None: as many as the run takes.
      answerer: name of who answers, or names of several who answer at once; kept beside the answers. A person can take
        back only an answer of their own. Of several, those are asked whose view somebody listens to.
      practice: whether instructions and practice come first for those who have not answered in this run.

    Attributes:
      seats: one for each person.
      name: of this sitting, kept with each of its answers; it influences nothing.
      changed: locked while anything changes.

    Raises:
      ValueError: a finished run, a bad number, a bad name or one twice.
    """

    def __init__(
        self, learner: Learner, *, most_answers: int | None = None, answerer: Names = None, practice: bool = False
    ):
        names = checked_options(learner, most_answers=most_answers, answerer=answerer, practice=practice)
        self.learner, self.most_answers = learner, most_answers
        self.name = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{secrets.token_hex(2)}"
        self.changed = threading.Condition(threading.RLock())
        known = {past.answerer for past in learner.state.past}
        self.seats = tuple(
            Seat(self, name, turn, Introduction() if practice and name not in known else None)
            for turn, name in enumerate(names, start=1)
        )
        self._turns, self._closing = len(names), False
        self._before, self._past = learner.preferences.answers, len(learner.state.past)  # of earlier sittings
        self._clips = Clips(learner)
        most = None if most_answers is None else self._before + most_answers
        self._foresight = Foresight(
            learner.cycle, learner.state, self._show, self._here(), several=self._several, most=most
        )
        first = self.seats[0]
        self.sheet, self.listen, self.wait, self.answer = first.sheet, first.listen, first.wait, first.answer
        for seat in self.seats:
            seat.view = self._described(seat, THINKING)
        self._thread = threading.Thread(target=self._think, name="bayespbrl-session", daemon=True)

    def open(self) -> "Session":
        """Start the computing thread; returns the session."""
        with self.changed:
            self._settle()
        self._thread.start()
        return self

    def close(self) -> None:
        """Stop after the step of the cycle that is being computed, which may be computed again. No answer is lost."""
        with self.changed:
            self._closing = True
            self.changed.notify_all()
        if self._thread.is_alive():
            self._thread.join()

    @property
    def view(self) -> View:
        """The view of the first or only person."""
        return self.seats[0].view

    @property
    def over(self) -> bool:
        """Whether the sitting is finished, or has failed."""
        return self.view["phase"] in (FINISHED, FAILED)

    @property
    def idle(self) -> bool:
        """Whether everybody is shown something and all that may follow is computed."""
        with self.changed:
            return all(seat.view["phase"] != THINKING for seat in self.seats) and self._pending() is None

    @property
    def _several(self) -> bool:
        return len(self.seats) > 1

    def _here(self) -> list[str | None]:
        return [seat.answerer for seat in self.seats if seat.here or not self._several]

    def gather(self) -> None:
        """See who is here; the questions of those who left can be taken by others."""
        if not self._several:
            return
        with self.changed:
            before = self._foresight.present
            if not self.over:
                self._foresight.gather(self._here())
            if self._foresight.present is not before:
                self._settle()

    def take(self, seat: Seat, turn: int, answer: str, seconds: float | None, replays: int | None) -> None:
        """What `Seat.answer` does."""
        with self.changed:
            if self._closing:
                raise Stale("session: expected an open one, got one that is closed")
            if turn != seat.turn:
                raise Stale(f"turn: expected {seat.turn}, got {turn}")
            if (phase := seat.view["phase"]) not in (INSTRUCTIONS, QUESTION):
                raise Stale(f"turn {turn}: expected a question that waits, got none ({phase})")
            known = self.learner.state
            try:
                if (introduction := self._introducing(seat)) is not None:
                    introduction.answer(answer)
                    self._turn(seat)
                elif answer == Answer.UNDO:
                    self._undo(seat)
                else:
                    self._take(seat, answer, seconds, replays)
                self._settle()
            except BaseException as error:
                if self.learner.state is not known or not isinstance(error, Exception):  # what is kept holds
                    self._foresight.again(self.learner.state)
                    self._settle()
                raise

    def _turn(self, seat: Seat) -> None:
        """The next turn of one person."""
        self._turns += 1
        seat.turn, seat.number = self._turns, None

    def _undo(self, seat: Seat) -> None:
        if not seat.view["undo"]:
            raise ValueError("undo: expected an answer by the same person to take back, got none")
        number = self.learner.state.past[-1].number
        self._record(events.undone(seat.answerer))
        self._turn(seat)
        self._foresight.back(number, self.learner.state, seat.answerer)

    def _take(self, seat: Seat, answer: str, seconds: float | None, replays: int | None) -> None:
        number, given = seat.number, parse_answer(answer)
        assert number is not None
        who = {"answerer": seat.answerer, "session": self.name}
        self._record(events.answered(number, given, seconds=seconds, replays=replays, **who))
        self._turn(seat)
        moment = self._foresight.move(number, given, self.learner.state)
        try:
            if moment.complete:  # the next question can be looked at while its events are written
                self._settle()
            for entry in moment.entries:
                self.learner.record(entry)
        except Exception as error:  # a full disk, or another learner in the run: this answer is kept all the same
            self._failed(moment, error)

    def _record(self, entry: Entry) -> None:
        """Keep what a person said; `ValueError` where the disk is full or read-only. Nothing has happened then."""
        try:
            self.learner.record(entry)
        except OSError as error:
            raise ValueError(f"your answer was not kept: {checks.reason(error)}") from error

    # The thread that thinks.

    def _think(self) -> None:
        while True:
            with self.changed:
                self.changed.wait_for(lambda: self._closing or self._pending(), GATHER if self._several else None)
                self.gather()
                moment = self._pending()
            if self._closing:
                return
            if moment is None:
                continue
            try:
                piece = self._foresight.compute(moment)
                with self.changed:
                    # computed again in the same way, unless the environment goes by its earlier episodes
                    if not self._closing or self.learner.comparable_starts is False:
                        self._keep(moment, piece)
            except Exception as error:  # the environment's, or a full disk
                with self.changed:
                    self._failed(moment, error)

    def _pending(self) -> Moment | None:
        known = self._foresight.present.complete
        # an environment that goes by its earlier episodes must not have any that the learner does not learn from
        alone = known and self.learner.comparable_starts is False
        return None if self.over or alone else self._foresight.pending()

    def _keep(self, moment: Moment, piece: Entry | Drawn | None) -> None:
        moment = self._foresight.current(moment, piece)
        if isinstance(piece, Entry) and moment is self._foresight.present:
            self.learner.record(piece)
        self._foresight.keep(moment, piece)
        if moment is self._foresight.present:
            self._settle()
        self.changed.notify_all()

    def _failed(self, moment: Moment, error: Exception) -> None:
        moment.failed = True
        if moment is self._foresight.present:
            reason = checks.reason(error)
            for seat in self.seats:
                seat.set(self._described(seat, FAILED) | {"say": f"Stopped: {reason} Your answers are kept."})

    def _settle(self) -> None:
        """Update all views to the present moment, and wake the thread."""
        if self._foresight.present.failed:
            return
        for seat in self.seats:
            self._publish(seat, self._foresight.present)
        self.changed.notify_all()

    # What is shown.

    def _show(self, state: LearnerState, query: Query, who: str | None) -> tuple[Shown, tuple[Answer, ...]]:
        """What a person is shown of a question that waits, and the answers to it, the likeliest first."""
        for seat in self.seats:
            if seat.introduction is not None and seat.introduction.clips is None:
                seat.introduction.draw(self._clips, state)
        said, likely = views.said_of(query, state, who)
        return Shown(self._clips.of(query, state), said), likely

    def _described(self, seat: Seat, phase: str, state: LearnerState | None = None) -> dict[str, Any]:
        state = state or self.learner.state
        view = views.described(self.learner, state, phase, turn=seat.turn, answerer=seat.answerer)
        if view["undo"] and self._several:  # not where it takes a question away that another looks at
            open_before = {query.number for query in state.before[-1].open}
            others = {number for number, who in self._foresight.present.holders.items() if who != seat.answerer}
            view["undo"] = others <= open_before
        return view

    def _introducing(self, seat: Seat) -> Introduction | None:
        """What comes before the first question, while it lasts; None where there is none, or no question to come."""
        introduction = seat.introduction
        moment = self._foresight.present
        spent = moment.state.left(self.learner.settings) <= 0
        if introduction is None or introduction.over or spent or self._done(moment):
            return None
        return introduction

    def _done(self, moment: Moment) -> bool:
        """Whether no question follows this moment."""
        state, most = moment.state, self.most_answers
        given = state.preferences.answers - self._before
        return moment.complete and (state.finished(self.learner.settings) or (most is not None and given >= most))

    def _publish(self, seat: Seat, moment: Moment) -> None:
        state = moment.state
        number = next((held for held, who in moment.holders.items() if who == seat.answerer), None)
        if seat.number not in (None, number):
            self._turn(seat)  # another has taken the question
        if self._done(moment):
            given = state.preferences.answers - self._before
            seat.set(self._described(seat, FINISHED, state) | {"say": views.ending(self.learner, state, given)})
        elif (introduction := self._introducing(seat)) is not None:
            self._introduce(seat, introduction)
        elif number in moment.drawn and (moment.complete or self._several):
            seat.number = number
            mine = [past for past in state.past[self._past :] if past.answerer == seat.answerer]
            given = sum(past.answer is not Answer.SKIP for past in mine)
            notice = views.notice(given, practised=seat.introduction is not None)
            self._ask(seat, self._described(seat, QUESTION, state) | {"notice": notice}, moment.drawn[number].shown)
        elif moment.complete and self._several:
            seat.set(self._described(seat, WAITING, state) | {"say": views.NOTHING_LEFT})
        else:
            seat.set(self._described(seat, THINKING))

    def _introduce(self, seat: Seat, introduction: Introduction) -> None:
        if introduction.place == 0:
            seat.set(self._described(seat, INSTRUCTIONS))
        elif introduction.clips is None:
            seat.set(self._described(seat, THINKING))
        else:
            place, number = introduction.place, len(introduction.clips)
            notice = "This is practice: your answer is not kept."
            view = self._described(seat, QUESTION) | {"practice": (place, number), "notice": notice, "undo": True}
            self._ask(seat, view, Shown(introduction.clips[place - 1], NOTHING_SAID))

    def _ask(self, seat: Seat, view: View, shown: Shown) -> None:
        seat.sheets = seat.turn, shown.clips
        seat.set(views.with_question(view, shown, self._clips.rate(shown.clips)))


def answer_of(message: Any) -> tuple[int, str, float | None, int | None]:
    """Turn, answer, seconds and replays of a message of the front end; `ValueError` where it is none."""
    names = ("turn", "answer", "seconds", "replays")
    if not isinstance(message, dict) or not set(message) <= set(names):
        raise ValueError(f"answer: expected turn, answer, seconds and replays, got {message!r}"[:200])
    turn, answer, seconds, replays = (message.get(name) for name in names)
    if type(turn) is not int or not isinstance(answer, str):
        raise ValueError(f"answer: expected the number of a turn and an answer, got {turn!r} and {answer!r}"[:200])
    checks.optional(checks.number, "seconds", seconds)
    if replays is not None and (type(replays) is not int or not 0 <= replays <= events.MOST_REPLAYS):
        raise ValueError(f"replays: expected a whole number from 0 to {events.MOST_REPLAYS}, got {replays!r}"[:200])
    return turn, answer, seconds, replays
