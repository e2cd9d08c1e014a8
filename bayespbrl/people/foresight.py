"""What follows each likely answer, computed before it is given: the questions after it and their clips.

A learner's state never changes and each event follows from it alone, so what is computed early is what would be
computed late, bit for bit. Nothing reaches the log before the answer does.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from bayespbrl import events
from bayespbrl.cycle import Cycle
from bayespbrl.events import Entry, LearnerState
from bayespbrl.preferences import Answer

LIKELY = 2  # answers after which two answers are foreseen, each


@dataclass
class Moment:
    """The learner from one answer to the next question, as far as it is computed.

    Attributes:
      state: what the learner knows.
      entries: the events since the answer.
      settled: whether a question waits in `state`, or the run is finished.
      shown: what a person is shown of the question; None until it is drawn.
      likely: the answers to it, the likeliest first and a tie last; () until it is drawn.
      after: what follows an answer.
      failed: whether computing it raised; then it is computed again when the answer is there.
    """

    state: LearnerState
    entries: list[Entry] = field(default_factory=list)
    settled: bool = False
    shown: Any = None
    likely: tuple[Answer, ...] = ()
    after: dict[Answer, "Moment"] = field(default_factory=dict)
    failed: bool = False

    @property
    def complete(self) -> bool:
        """Whether a person can be shown what comes next."""
        return self.settled and (self.state.query is None or self.shown is not None)


class Foresight:
    """The moments from the present one on, and which piece of them is computed next.

    Args:
      cycle: of the learner.
      show: what a person is shown in a state with a question, and the answers to it: the likeliest first, a tie last.
      answerer: who is going to answer; None where that is not known.
    """

    def __init__(
        self,
        cycle: Cycle,
        state: LearnerState,
        show: Callable[[LearnerState], tuple[Any, tuple[Answer, ...]]],
        answerer: str | None = None,
    ):
        self.cycle, self.show, self.answerer = cycle, show, answerer
        self.present = Moment(state)

    def pending(self) -> Moment | None:
        """The moment to compute a piece of next; None where there is nothing left to do."""
        if not self.present.complete:
            return None if self.present.failed else self.present
        return next((moment for moment in self._ahead() if not (moment.complete or moment.failed)), None)

    def compute(self, moment: Moment) -> Entry | None:
        """One piece of a moment: the event returned, or what is shown of its question (None). Changes nothing else."""
        if moment.settled:
            moment.shown, moment.likely = self.show(moment.state)
            return None
        entry = self.cycle.next(moment.state)
        if entry is None:
            moment.settled = True
        return entry

    @staticmethod
    def keep(moment: Moment, entry: Entry) -> None:
        """Add an event that `compute` returned."""
        moment.state = events.apply(moment.state, entry)
        moment.entries.append(entry)

    def move(self, answer: Answer, state: LearnerState) -> Moment:
        """Go to the moment after an answer, with what is computed of it.

        Args:
          answer: to the present question.
          state: what the learner knows right after it.
        """
        ahead = self.present.after.get(answer)
        self.present = Moment(state) if ahead is None or ahead.failed else ahead
        return self.present

    def back(self, state: LearnerState) -> Moment:
        """Go to the state after an undo."""
        self.present = Moment(state, settled=True)
        return self.present

    def _ahead(self) -> Iterator[Moment]:
        """The moments after each answer, and those after two likely ones.

        A tie comes last where the run has none yet: an iteration follows it, which takes seconds.
        """
        following = list(self._after(self.present, len(Answer)))
        soon = len(following) if self.present.state.preferences.ties else LIKELY + 1
        yield from following[:soon]
        for moment in following[:LIKELY]:
            yield from self._after(moment, LIKELY)
        yield from following[soon:]

    def _after(self, moment: Moment, most: int) -> Iterator[Moment]:
        query = moment.state.query
        if query is None or not moment.complete:
            return
        for answer in moment.likely[:most]:
            if answer not in moment.after:
                entry = events.answered(query.number, answer, answerer=self.answerer)
                moment.after[answer] = Moment(events.apply(moment.state, entry))
            yield moment.after[answer]
