"""The questions after each likely answer and their clips, computed before the answer is given.

A learner's state never changes and each event follows from it alone, so what is computed early is what would be
computed late, bit for bit. Nothing reaches the log before the answer does.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from bayespbrl import events
from bayespbrl.cycle import Cycle
from bayespbrl.events import Entry, LearnerState
from bayespbrl.people.views import Shown
from bayespbrl.preferences import Answer, Query

LIKELY = 2  # answers after which two answers are foreseen, each


class Drawn(NamedTuple):
    """What is shown of a question.

    Attributes:
      number: of the question.
      shown: to whoever looks at it.
      likely: the answers to it, the likeliest first.
    """

    number: int
    shown: Shown
    likely: tuple[Answer, ...]


@dataclass
class Moment:
    """The learner from one answer to the next question, as far as it is computed.

    Attributes:
      state: what the learner knows.
      holders: who looks at which open question, by its number.
      entries: the events since the answer.
      settled: whether everybody has a question, or there is none for those without.
      drawn: the questions that are drawn, by their number.
      after: what follows an answer to a question.
      failed: whether computing it raised; then it is computed again when the answer is there.
    """

    state: LearnerState
    holders: Mapping[int, str | None] = field(default_factory=dict)
    entries: list[Entry] = field(default_factory=list)
    settled: bool = False
    drawn: dict[int, Drawn] = field(default_factory=dict)
    after: dict[tuple[int, Answer], "Moment"] = field(default_factory=dict)
    failed: bool = False

    @property
    def unseen(self) -> Query | None:
        """A question due to be shown that is not drawn yet; None if all are."""
        return next((q for q in self.state.open if q.number in self.holders and q.number not in self.drawn), None)

    @property
    def complete(self) -> bool:
        """Whether everybody can be shown what comes next."""
        return self.settled and self.unseen is None


class Foresight:
    """The moments from the present one on, and which piece of them is computed next.

    Args:
      cycle: of the learner.
      show: what is shown of a question in a state to a person, and the answers to it, the likeliest first.
      people: who are here; (None,) is one person without a name. Each gets a question of their own.
      several: whether there may be others than these.
      most: answers of the run after which the sitting is over.
    """

    def __init__(
        self,
        cycle: Cycle,
        state: LearnerState,
        show: Callable[[LearnerState, Query, str | None], tuple[Shown, tuple[Answer, ...]]],
        people: Sequence[str | None] = (None,),
        *,
        several: bool = False,
        most: int | None = None,
    ):
        self.cycle, self.show, self.several, self.most = cycle, show, several, most
        self.people = tuple(people)
        self.present = self._following(Moment(state), state, {})

    def pending(self) -> Moment | None:
        """The moment to compute a piece of next; None where there is nothing left to do."""
        if not self.present.complete:
            return None if self.present.failed else self.present
        return next((moment for moment in self._ahead() if not (moment.complete or moment.failed)), None)

    def compute(self, moment: Moment) -> Entry | Drawn | None:
        """One piece of a moment: an event, what is shown of a question, or that nothing follows (None).

        Changes nothing: answers may come meanwhile.
        """
        if (query := moment.unseen) is not None:
            return Drawn(query.number, *self.show(moment.state, query, moment.holders[query.number]))
        return self._next(moment)

    def _next(self, moment: Moment) -> Entry | None:
        if not self.several and moment.state.open and not moment.holders:  # repeats that wait for somebody else
            return self.cycle.next(moment.state, self.people[0], others=0)
        if not self.several:
            return self.cycle.next(moment.state)
        held, left = len(moment.holders), self._left(moment)
        if not held and left <= 0:  # what follows the last answer needs nobody
            return self.cycle.next(moment.state, None, others=0)
        free = [name for name in self.people if name not in moment.holders.values()]
        if not free or (self.most is not None and 0 < held >= self.most - moment.state.preferences.answers):
            return None
        return self.cycle.next(moment.state, free[0], others=held)

    def keep(self, moment: Moment, piece: Entry | Drawn | None) -> None:
        """Add what `compute` returned."""
        if piece is None:
            moment.settled = True
        elif isinstance(piece, Drawn):
            moment.drawn[piece.number] = piece
        else:
            moment.state = events.apply(moment.state, piece)
            moment.holders = self._holders(moment.state, moment.holders)
            moment.entries.append(piece)

    def current(self, moment: Moment, piece: Entry | Drawn | None) -> Moment:
        """The moment that a piece is of which was computed for `moment`.

        It is the present one where no more has changed meanwhile than who is here, and the event is the same for all:
        nobody waits again because another came or left.
        """
        if not isinstance(piece, Entry) or moment.state is not self.present.state:
            return moment
        last = moment.state.in_last_iteration(self.cycle.settings)  # it ends when all have answered
        same = piece.event["event"] == "collected" or (piece.event["event"] == "improved" and not last)
        return self.present if same else moment

    def again(self, state: LearnerState) -> None:
        """Go on from a state: what was to follow was not all kept."""
        self.present = self._following(self.present, state, self.present.holders)

    def move(self, number: int, answer: Answer, state: LearnerState) -> Moment:
        """Go to the moment after an answer, with what is computed of it.

        Args:
          number: of the question that was answered.
          state: what the learner knows right after it.
        """
        ahead = self.present.after.get((number, answer))
        if ahead is None or ahead.failed:
            ahead = self._following(self.present, state, self.present.holders)
        self.present = ahead
        return ahead

    def back(self, number: int, state: LearnerState, person: str | None) -> Moment:
        """Go to the state after an undo, in which this person looks at question `number` again."""
        others = {held: who for held, who in self.present.holders.items() if who != person}
        self.present = self._following(self.present, state, {**others, number: person})
        return self.present

    def gather(self, people: Sequence[str | None]) -> None:
        """Set who is present; questions of the others can be taken."""
        if self.people != (now := tuple(people)):
            self.people = now
            if not self.present.failed:
                self.present = self._following(self.present, self.present.state, self.present.holders)

    def _following(self, moment: Moment, state: LearnerState, holders: Mapping[int, str | None]) -> Moment:
        """A moment with that state, and with what is known of the questions of `moment` that are still open."""
        still = self._holders(state, holders)
        same = [number for number, _ in still.items() & moment.holders.items() if number in moment.drawn]
        return Moment(state, still, drawn={number: moment.drawn[number] for number in same})

    def _holders(self, state: LearnerState, before: Mapping[int, str | None]) -> dict[int, str | None]:
        """Who looks at which open question: whoever did before, then who was asked, then anybody who has none.

        A repeated question is left to those who may answer it. No more are looked at than the budget has answers left,
        or the sitting: once the budget is spent nobody looks at any, and one that somebody has left open stays open.
        """
        settings = self.cycle.settings
        left = state.left(settings)
        if state.finished(settings) or left <= 0:
            return {}
        if self.most is not None:
            left = min(left, max(1, self.most - state.preferences.answers))
        waiting = {query.number: query for query in state.open}
        holders = {number: who for number, who in before.items() if number in waiting and who in self.people}
        for query in sorted(state.open, key=lambda query: query.answerer not in self.people):
            free = [who for who in self.people if who not in holders.values()]
            free = [who for who in free if state.may_answer(query, who, settings)]
            if free and query.number not in holders and len(holders) < left:
                holders[query.number] = query.answerer if query.answerer in free else free[0]
        return holders

    def _left(self, moment: Moment) -> float:
        """Number of answers left in the budget."""
        return moment.state.left(self.cycle.settings)

    def _ahead(self) -> Iterator[Moment]:
        """The moments after each answer, and those after two likely ones.

        Not what follows the last answer of the budget, which no question waits for: that is the most of all.
        The last answer is a tie where the run has none yet. It comes at the end then: seconds of compilation follow.
        """
        following, questions = list(self._after(self.present, len(Answer))), len(self.present.holders)
        soon = len(following) if self.present.state.preferences.ties else (LIKELY + 1) * questions
        yield from following[:soon]
        for moment in following[: LIKELY * questions]:
            yield from self._after(moment, LIKELY)
        yield from following[soon:]

    def _after(self, moment: Moment, most: int) -> Iterator[Moment]:
        if not moment.complete:
            return
        answers = ((n, who, answer) for n, who in moment.holders.items() for answer in moment.drawn[n].likely[:most])
        for number, who, answer in sorted(answers, key=lambda each: moment.drawn[each[0]].likely.index(each[2])):
            if (number, answer) not in moment.after:
                state = events.apply(moment.state, events.answered(number, answer, answerer=who))
                moment.after[number, answer] = self._following(moment, state, moment.holders)
            if self._left(moment.after[number, answer]) > 0:
                yield moment.after[number, answer]
