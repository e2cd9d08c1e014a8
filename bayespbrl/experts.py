"""Experts: simulated ones and a person at a terminal, who answer which of two trajectories is better (paper, step 4).

An expert is any callable of two trajectories, in the order shown, that returns an `Answer` or its string. The answer
must depend on the two trajectories only: a resumed run may ask a question again.
"""

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from bayespbrl import checks
from bayespbrl.preferences import Answer, parse_answer
from bayespbrl.trajectories import Trajectory

TIE_TOLERANCE = 1e-9  # relative: rounding in another order of summation must not decide


class Expert(Protocol):
    """A callable that answers "which of these two is better?"."""

    def __call__(self, first: Trajectory, second: Trajectory, /) -> Answer | str: ...


class ReturnExpert:
    """The simulated expert of the paper: prefers the higher undiscounted sum of the hidden reward, without noise."""

    def __call__(self, first: Trajectory, second: Trajectory) -> Answer:
        difference = first.total_reward - second.total_reward
        if abs(difference) <= TIE_TOLERANCE * max(abs(first.total_reward), abs(second.total_reward)):
            return Answer.TIE
        return Answer.FIRST if difference > 0 else Answer.SECOND


@dataclass(frozen=True)
class NoisyExpert:
    """Another expert whose answers are reversed at random; ties and skips stay as they are.

    Whether an answer is reversed is a function of `seed` and the two trajectories, in either order.

    Attributes:
      expert: gives the right answers.
      wrong_answers: probability that an answer is reversed, in [0, 1].
      seed: a whole number >= 0.
    """

    expert: Expert
    wrong_answers: float
    seed: int = 0

    def __post_init__(self) -> None:
        checks.share("wrong_answers", self.wrong_answers)
        checks.whole("seed", self.seed, 0)

    def __call__(self, first: Trajectory, second: Trajectory) -> Answer:
        answer = parse_answer(self.expert(first, second))
        marks = sorted(zlib.crc32(t.actions.tobytes(), zlib.crc32(t.states.tobytes())) for t in (first, second))
        wrong = np.random.default_rng([self.seed, *marks]).random() < self.wrong_answers
        reversal = {Answer.FIRST: Answer.SECOND, Answer.SECOND: Answer.FIRST}
        return reversal.get(answer, answer) if wrong else answer


def simulated_expert(wrong_answers: float = 0.0, *, seed: int = 0) -> Expert:
    """`ReturnExpert`, as a `NoisyExpert` where `wrong_answers`, the probability of a wrong answer, is positive."""
    return NoisyExpert(ReturnExpert(), wrong_answers, seed) if wrong_answers else ReturnExpert()


PROMPT = "Which is better? [1] first  [2] second  [t] tie  [s] cannot tell  [u] undo  [q] stop here: "
KEYS = {"1": Answer.FIRST, "2": Answer.SECOND, "t": Answer.TIE, "s": Answer.SKIP, "u": Answer.UNDO}


@dataclass(frozen=True)
class TerminalExpert:
    """A person at a terminal, who looks at a picture of the two trajectories on disk.

    Attributes:
      draw: writes a picture of the two trajectories, in the order shown, to a path.
      folder: of the picture `query.png`, which is overwritten for each question.
      read: prompts for a line of text.
    """

    draw: Callable[[Trajectory, Trajectory, Path], None]
    folder: Path
    read: Callable[[str], str] = input

    def __call__(self, first: Trajectory, second: Trajectory) -> Answer:
        """The person's answer; raises `KeyboardInterrupt` where they stop or the input ends."""
        self.folder.mkdir(parents=True, exist_ok=True)
        picture = self.folder / "query.png"
        self.draw(first, second, picture)
        print(f"The two trajectories are in {picture}")
        while True:
            try:
                reply = self.read(PROMPT).strip().lower()
            except EOFError:
                raise KeyboardInterrupt from None
            if reply in ("q", "quit"):
                raise KeyboardInterrupt
            if reply in KEYS:
                return KEYS[reply]
            if reply in set(Answer):
                return Answer(reply)
            print(f"Expected one of {', '.join([*KEYS, 'q'])}, got {reply!r}.")
