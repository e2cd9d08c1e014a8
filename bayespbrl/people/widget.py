"""The notebook's host of the front end: an anywidget whose messages go to a session, whose views come back.

Answers are taken and questions computed in the background, so that cells stay free while a person thinks.
"""

from pathlib import Path
from typing import Any

import anywidget
import traitlets

from bayespbrl.learner import Learner
from bayespbrl.people.session import Session, answer_of
from bayespbrl.people.views import QUESTION

FOLDER = Path(__file__).parent


class ComparisonWidget(anywidget.AnyWidget):
    """Asks a person the questions of a learner, in a notebook. `Learner.widget` makes one.

    Attributes:
      session: which `close` ends.
    """

    _esm = (FOLDER / "front.js").read_text()
    _css = (FOLDER / "front.css").read_text()
    view = traitlets.Dict().tag(sync=True)
    first = traitlets.Bytes().tag(sync=True)
    second = traitlets.Bytes().tag(sync=True)
    _opened = False
    whole_page = traitlets.Bool(False).tag(sync=True)

    def __init__(self, learner: Learner, *, most_answers: int | None = None, answerer: str | None = None):
        self.session = Session(learner, most_answers=most_answers, answerer=answerer)
        super().__init__()
        self.view = dict(self.session.view)
        self.on_msg(self._hear)
        self._deaf = self.session.listen(self._update)
        self.session.open()
        self._opened = True

    def close(self) -> None:
        """End the session and the widget; the learner can be used again."""
        if self._opened:  # it is also called where a bad option was refused
            self._deaf()
            self.session.close()
            self._opened = False
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
