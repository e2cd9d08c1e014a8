"""Preferences ζ: what was asked, what was answered, and which trajectories are undominated (paper, step 4)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from bayespbrl.trajectories import Trajectory


class Answer(StrEnum):
    """What an expert may say of two trajectories, in the order in which they were shown."""

    FIRST = "first"
    SECOND = "second"
    TIE = "tie"
    SKIP = "skip"  # cannot tell: not counted, another trajectory is asked about instead
    UNDO = "undo"  # takes the previous answer back; its question is asked again


def parse_answer(answer: object) -> Answer:
    """`answer` as an `Answer`; raises `ValueError` naming what the expert returned otherwise."""
    try:
        return Answer(answer)  # type: ignore[arg-type]
    except ValueError:
        choices = ", ".join(repr(str(choice)) for choice in Answer)
        raise ValueError(f"expert: expected one of {choices}, got {answer!r}") from None


@dataclass(frozen=True)
class Query:
    """One question: which of these two?

    Attributes:
      number: counts the questions of a run from 1.
      first, second: the numbers of the two trajectories in the order shown, which is drawn at random.
      newcomer: which of the two was not shown before; the other is the newest of the undominated.
      trajectories: the two themselves, in the order shown.
    """

    number: int
    first: int
    second: int
    newcomer: int
    trajectories: tuple[Trajectory, Trajectory]

    @property
    def incumbent(self) -> int:
        return self.second if self.newcomer == self.first else self.first


@dataclass(frozen=True)
class Preferences:
    """Ordered pairs and the set of undominated trajectories; trajectories are named by their numbers.

    Attributes:
      pairs: (preferred, dominated), one for each τᵢ ≻ τⱼ; their number is K of eq. 8.
      undominated: the best so far, which tie with each other; the newest last.
      answers: comparisons asked and answered, ties included.
    """

    pairs: tuple[tuple[int, int], ...] = ()
    undominated: tuple[int, ...] = ()
    answers: int = 0

    def start(self, trajectory: int) -> "Preferences":
        """The same with `trajectory` as the first undominated one, to compare others with."""
        return replace(self, undominated=(trajectory,))

    def add(self, newcomer: int, incumbent: int, *, preferred: int | None) -> "Preferences":
        """The preferences after one comparison of a newcomer with the newest undominated trajectory.

        Better: preferred over every undominated trajectory, and alone undominated. Worse: every one of them is
        preferred over it. Tie (`preferred=None`): it joins them and no ordered pair is stored (the authors'
        published implementation).

        Raises:
          ValueError: an incumbent that is not the newest undominated one, or a preferred that is neither of the two.
        """
        if not self.undominated or incumbent != self.undominated[-1]:
            raise ValueError(f"incumbent: expected the newest undominated of {self.undominated}, got {incumbent}")
        if preferred not in (None, newcomer, incumbent):
            raise ValueError(f"preferred: expected {newcomer}, {incumbent} or None, got {preferred}")
        answers = self.answers + 1
        if preferred is None:
            return Preferences(self.pairs, (*self.undominated, newcomer), answers)
        if preferred == newcomer:
            new_pairs = tuple((newcomer, member) for member in self.undominated)
            return Preferences(self.pairs + new_pairs, (newcomer,), answers)
        new_pairs = tuple((member, newcomer) for member in self.undominated)
        return Preferences(self.pairs + new_pairs, self.undominated, answers)

    def differences(self, trajectory_features: np.ndarray) -> np.ndarray:
        """ψ(preferred) − ψ(dominated) of eq. 5, shape (K, D), from ψ of all trajectories, shape (n, D)."""
        return pair_differences(self.pairs, trajectory_features)


def pair_differences(pairs: Sequence[tuple[int, int]], trajectory_features: np.ndarray) -> np.ndarray:
    """ψ(preferred) − ψ(dominated) for each of K pairs, shape (K, D).

    Raises:
      ValueError: a pair that names a trajectory there is not, or one trajectory twice.
    """
    numbers = np.asarray(pairs, dtype=np.int64).reshape(len(pairs), 2)
    if np.any(numbers < 0) or np.any(numbers >= len(trajectory_features)):
        raise ValueError(f"pairs: expected trajectory numbers in 0 … {len(trajectory_features) - 1}, got {pairs}")
    if np.any(numbers[:, 0] == numbers[:, 1]):
        raise ValueError(f"pairs: expected two different trajectories in each, got {pairs}")
    return trajectory_features[numbers[:, 0]] - trajectory_features[numbers[:, 1]]
