"""One person of a sitting: who they are, what they are shown, and at which turn they are."""

import threading
import time
from collections.abc import Callable
from typing import Protocol

from bayespbrl.people.clips import Clip
from bayespbrl.people.practice import Introduction
from bayespbrl.people.views import FAILED, FINISHED, QUESTION, THINKING, View

AWAY = 20.0  # seconds after the last window is closed until the question can be taken by another; a reload takes less


class Stale(ValueError):
    """An answer to a turn that is over, as from a second window."""


class Sitting(Protocol):
    """The session (`people.session`) as a person's seat sees it."""

    changed: threading.Condition

    def gather(self) -> None:
        """Update who is present."""
        ...

    def take(self, seat: "Seat", turn: int, answer: str, seconds: float | None, replays: int | None) -> None:
        """What `Seat.answer` does."""
        ...


class Seat:
    """What one person sees and answers, in all their windows; safe to use from any thread.

    Attributes:
      session: of all who answer.
      answerer: the person's name; None: not known.
      turn: the number of the question, instruction or wait that they see; no two of a sitting have the same.
      number: of the question that they see; None where they see none.
      introduction: what comes before their first question; None where nothing does.
      view: what a page or widget shows now, as plain data; never changed, only replaced.
    """

    def __init__(self, session: Sitting, answerer: str | None, turn: int, introduction: Introduction | None):
        self.session, self.answerer, self.introduction = session, answerer, introduction
        self.turn = turn
        self.number: int | None = None
        self.view: View = {"phase": THINKING, "turn": turn}
        self.sheets: tuple[int, tuple[Clip, Clip]] | None = None
        self._listeners: list[Callable[[], None]] = []
        self._left = -AWAY

    @property
    def here(self) -> bool:
        """Whether a window of theirs is open, or was a moment ago."""
        return bool(self._listeners) or time.monotonic() - self._left < AWAY

    def sheet(self, turn: int, side: int) -> bytes:
        """The sprite sheet of a clip of the question of a turn, side 0 or 1; `Stale` where the turn is over."""
        sheets = self.sheets
        if sheets is None or sheets[0] != turn:
            raise Stale(f"turn: expected one with a question, got {turn}")
        return sheets[1][side].sheet

    def listen(self, callback: Callable[[], None]) -> Callable[[], None]:
        """Call `callback`, from any thread, whenever `view` is another; returns what ends that."""
        self._listeners.append(callback)
        self.session.gather()

        def end() -> None:
            self._left = time.monotonic()
            self._listeners.remove(callback)

        return end

    def wait(self, phases: tuple[str, ...] = (QUESTION, FINISHED, FAILED), timeout: float | None = None) -> View:
        """The view, once it is in one of `phases`."""
        changed = self.session.changed
        with changed:
            if not changed.wait_for(lambda: self.view["phase"] in phases, timeout):
                raise TimeoutError(f"expected {' or '.join(phases)}, still {self.view['phase']}")
            return self.view

    def answer(self, turn: int, answer: str, seconds: float | None = None, replays: int | None = None) -> None:
        """Take the answer to the question of `turn`, or an undo there; it is on the disk when this returns.

        The instructions are answered with "begin". What is answered to them and in practice is not kept. `seconds` is
        how long the person took, and `replays` how often the clips began again.

        Raises:
          Stale: the turn or the session is over, or the question is not there yet; nothing has happened.
          ValueError: no answer, a bad time or number of replays, nothing to take back, or a log that cannot be written;
            nothing has happened.
        """
        self.session.take(self, turn, answer, seconds, replays)

    def set(self, view: View) -> None:
        """Show another view, and tell those who listen."""
        if view == self.view:
            return
        self.view = view
        self.session.changed.notify_all()
        for callback in list(self._listeners):
            callback()
