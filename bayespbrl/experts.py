"""Experts: whoever says which of two trajectories is better (paper, step 4).

An expert is any callable of two trajectories, in the order shown, that returns an `Answer` or its string. It must
not remember: the same two trajectories get the same answer, so that a run that was stopped continues as if it had
not been.
"""

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from bayespbrl.preferences import Answer, parse_answer
from bayespbrl.trajectories import Trajectory

TIE_TOLERANCE = 1e-9  # relative: sums in another order must not decide


class Expert(Protocol):
    """Anything that answers "which of these two is better?"."""

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
    """An expert who errs: turns a share of another expert's decided answers round.

    Which answers are wrong is a fixed function of `seed` and the two trajectories, whichever is shown first.

    Attributes:
      expert: whose answers to spoil.
      wrong_answers: probability of a wrong answer, in [0, 1].
      seed: a non-negative integer.
    """

    expert: Expert
    wrong_answers: float
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.wrong_answers <= 1:
            raise ValueError(f"wrong_answers: expected a share in [0, 1], got {self.wrong_answers}")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < 0:
            raise ValueError(f"seed: expected a whole number >= 0, got {self.seed!r}")

    def __call__(self, first: Trajectory, second: Trajectory) -> Answer:
        answer = parse_answer(self.expert(first, second))
        marks = sorted(zlib.crc32(t.actions.tobytes(), zlib.crc32(t.states.tobytes())) for t in (first, second))
        wrong = np.random.default_rng([self.seed, *marks]).random() < self.wrong_answers
        reversal = {Answer.FIRST: Answer.SECOND, Answer.SECOND: Answer.FIRST}
        return reversal.get(answer, answer) if wrong else answer


def simulated_expert(wrong_answers: float = 0.0, *, seed: int = 0) -> Expert:
    """`ReturnExpert`, or a `NoisyExpert` over it where some answers are to be wrong."""
    return NoisyExpert(ReturnExpert(), wrong_answers, seed) if wrong_answers else ReturnExpert()


PROMPT = "Which is better? [1] first  [2] second  [t] tie  [s] skip  [u] undo  [q] stop here: "
KEYS = {"1": Answer.FIRST, "2": Answer.SECOND, "t": Answer.TIE, "s": Answer.SKIP, "u": Answer.UNDO}


@dataclass(frozen=True)
class TerminalExpert:
    """A person at the prompt, who looks at a picture of the two trajectories on disk.

    Attributes:
      draw: writes a picture of the two trajectories, in the order shown, to a path.
      folder: where the picture `query.png` is written anew for each question.
      read: asks for a line of text; `input` unless told.
    """

    draw: Callable[[Trajectory, Trajectory, Path], None]
    folder: Path
    read: Callable[[str], str] = input

    def __call__(self, first: Trajectory, second: Trajectory) -> Answer:
        """The person's answer; raises `KeyboardInterrupt` when they want to stop (also at the end of input)."""
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
