"""The notebook's host of the front end: an anywidget whose messages go to a session, whose views come back.

Answers are taken and questions computed in the background, so that cells stay free while a person thinks.
"""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import anywidget
import traitlets

from bayespbrl import checks
from bayespbrl.learner import Learner
from bayespbrl.people.session import Session, answer_of, checked_options
from bayespbrl.people.views import QUESTION
from bayespbrl.runs.directory import RunDirectory
from bayespbrl.runs.lock import continuing

FOLDER = Path(__file__).parent


class ComparisonWidget(anywidget.AnyWidget):
    """Asks a person the questions of a learner, in a notebook. `Learner.widget` makes one.

    While it is open it holds the run directory, as the command line does. A second widget on the same learner, or on
    the same directory, closes the first: a cell may be run again.

    Attributes:
      session: which `close` ends.
    """

    session: Session
    _esm = (FOLDER / "front.js").read_text(encoding="utf-8")
    _css = (FOLDER / "front.css").read_text(encoding="utf-8")
    view = traitlets.Dict().tag(sync=True)
    first = traitlets.Bytes().tag(sync=True)
    second = traitlets.Bytes().tag(sync=True)
    _opened = False
    whole_page = traitlets.Bool(False).tag(sync=True)

    def __init__(self, learner: Learner, **options: Any):
        """`options` are those of `Session`, for one person."""
        checks.optional(checks.short_name, "answerer", options.get("answerer"))
        checked_options(learner, **options)  # what is refused leaves an earlier widget open
        open_before = [widget for widget in OPEN if _same_run(widget.session.learner, learner)]
        writing = any(widget.session.learner is learner for widget in open_before)
        if isinstance(learner.log, RunDirectory) and not writing:
            learner.log.check_newest()
        for earlier in open_before:
            earlier.close()
        with ExitStack() as held:  # let go of where anything is refused
            if isinstance(learner.log, RunDirectory):
                held.enter_context(continuing(learner.log.path))
                learner.log.check_newest()
            self.session = Session(learner, **options)
            super().__init__()
            self.view = dict(self.session.view)
            self.on_msg(self._hear)
            self._deaf = self.session.listen(self._update)
            self.session.open()
            self._held, self._opened = held.pop_all(), True
            OPEN.append(self)

    def close(self) -> None:
        """End the session and the widget; the learner can be used again."""
        if self._opened:  # it is also called where a bad option was refused
            self._opened = False
            OPEN.remove(self)
            self._deaf()
            self.session.close()
            self._held.close()
        super().close()

    def _update(self) -> None:
        view = self.session.view
        with self.hold_sync():  # one message
            if view["phase"] == QUESTION:
                self.first, self.second = (self.session.sheet(view["turn"], side) for side in (0, 1))
            self.view = dict(view)

    def _hear(self, _: Any, message: Any, buffers: Any) -> None:
        turn = message.get("turn") if isinstance(message, dict) else None
        try:
            self.session.answer(*answer_of(message))
        except ValueError as error:
            self.send({"refused": turn, "say": str(error)})


OPEN: list[ComparisonWidget] = []  # of this process


def _same_run(one: Learner, other: Learner) -> bool:
    """Whether both are one learner, or keep their events in one directory."""
    logs = [learner.log for learner in (one, other)]
    paths = [log.path.resolve() for log in logs if isinstance(log, RunDirectory)]
    return one is other or (len(paths) == 2 and paths[0] == paths[1])
