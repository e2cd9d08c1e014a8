"""Before a person's first question: instructions, and practice questions whose answers are not kept."""

from itertools import combinations

from bayespbrl.events import LearnerState
from bayespbrl.people.clips import Clip, Clips
from bayespbrl.preferences import Answer, Query, parse_answer

BEGIN = "begin"  # what is answered to the instructions
QUESTIONS = 2
AMONG = 12  # the first trajectories of the run, which follow its first policy


def practice_queries(state: LearnerState) -> list[Query]:
    """At most `QUESTIONS` pairs of the run's first trajectories, if possible none that a waiting question shows.

    Neighbours come first: where a run compares by start, the first trajectories start alike in twos.
    """
    compared = state.compared
    shown = {number for waiting in state.open for number in (waiting.first, waiting.second)}

    def unsuitable(pair: tuple[int, int]) -> tuple[int, bool]:
        return len(shown & set(pair)), pair[0] % 2 == 1 or pair[1] > pair[0] + 1

    pairs = sorted(combinations(range(min(len(compared), AMONG)), 2), key=unsuitable)
    return [Query(0, *pair, pair[1], (compared[pair[0]], compared[pair[1]])) for pair in pairs[:QUESTIONS]]


class Introduction:
    """One person's way through the instructions and the practice questions.

    Attributes:
      place: 0 at the instructions, then the number of the practice question.
      clips: of the practice questions; None until they are drawn.
    """

    def __init__(self) -> None:
        self.place = 0
        self.clips: tuple[tuple[Clip, Clip], ...] | None = None

    def draw(self, clips: Clips, state: LearnerState) -> None:
        """Draw the practice questions, from the trajectories of a state."""
        self.clips = tuple(clips.of(query, state) for query in practice_queries(state))

    @property
    def over(self) -> bool:
        """Whether the last practice question is answered."""
        return self.clips is not None and self.place > len(self.clips)

    def answer(self, answer: str) -> None:
        """Go on, or with `undo` back, by one place; `ValueError` where it is no answer."""
        if self.place == 0:
            if answer != BEGIN:
                raise ValueError(f"answer: expected {BEGIN!r} to the instructions, got {answer!r}")
            self.place = 1
        else:
            self.place += -1 if parse_answer(answer) is Answer.UNDO else 1
