"""Preferences ζ: questions, answers, the ordered pairs and the undominated trajectories (paper, step 4)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Float

from bayespbrl.trajectories import Trajectory


class Answer(StrEnum):
    """An expert's answer about two trajectories, in the order in which they were shown."""

    FIRST = "first"
    SECOND = "second"
    TIE = "tie"
    SKIP = "skip"  # no answer: the question does not count, and another trajectory is asked about
    UNDO = "undo"  # takes the previous answer back, and its question is asked again


def parse_answer(answer: object) -> Answer:
    """`answer` as an `Answer`; `ValueError` where it is none."""
    try:
        return Answer(answer)  # type: ignore[arg-type]
    except ValueError:
        choices = ", ".join(repr(str(choice)) for choice in Answer)
        raise ValueError(f"expert: expected one of {choices}, got {answer!r}") from None


@dataclass(frozen=True)
class Query:
    """A question: which of two trajectories is better?

    Attributes:
      number: of the question in its run, from 1.
      first, second: numbers of the two trajectories in the order shown, which is drawn at random.
      newcomer: number of the new one; the other is the newest undominated trajectory.
      trajectories: the two trajectories, in the order shown.
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
    """The ordered pairs and the undominated trajectories, by the numbers of the trajectories.

    Attributes:
      pairs: (preferred, dominated) for each τᵢ ≻ τⱼ.
      ties: pairs that were answered with "no difference". There are K pairs and ties (eq. 8).
      undominated: the best so far, which tie with each other; the newest last.
      answers: number of answered questions, ties included.
    """

    pairs: tuple[tuple[int, int], ...] = ()
    undominated: tuple[int, ...] = ()
    answers: int = 0
    ties: tuple[tuple[int, int], ...] = ()

    def start(self, trajectory: int) -> "Preferences":
        """The same preferences with `trajectory` as the first undominated one."""
        return replace(self, undominated=(trajectory,))

    def add(self, newcomer: int, incumbent: int, *, preferred: int | None) -> "Preferences":
        """The preferences after one comparison of a newcomer with the newest undominated trajectory.

        A better newcomer is preferred over every undominated trajectory and replaces them. Over a worse one, every
        undominated trajectory is preferred. In a tie (`preferred=None`) the newcomer joins them, and the pair is a tie.

        Raises:
          ValueError: an incumbent that is not the newest undominated one, or a preferred that is neither of the two.
        """
        if not self.undominated or incumbent != self.undominated[-1]:
            raise ValueError(f"incumbent: expected the newest undominated of {self.undominated}, got {incumbent}")
        if preferred not in (None, newcomer, incumbent):
            raise ValueError(f"preferred: expected {newcomer}, {incumbent} or None, got {preferred}")
        answers = self.answers + 1
        if preferred is None:
            tie = (newcomer, incumbent)
            return Preferences(self.pairs, (*self.undominated, newcomer), answers, (*self.ties, tie))
        if preferred == newcomer:
            new_pairs = tuple((newcomer, member) for member in self.undominated)
            return Preferences(self.pairs + new_pairs, (newcomer,), answers, self.ties)
        new_pairs = tuple((member, newcomer) for member in self.undominated)
        return Preferences(self.pairs + new_pairs, self.undominated, answers, self.ties)

    def differences(self, trajectory_features: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "k d"]:
        """ψ(preferred) − ψ(dominated) for each pair (eq. 5), from ψ of all trajectories."""
        return pair_differences(self.pairs, trajectory_features)


def pair_differences(
    pairs: Sequence[tuple[int, int]], trajectory_features: Float[np.ndarray, "n d"]
) -> Float[np.ndarray, "k d"]:
    """ψ(preferred) − ψ(dominated) for each of K pairs (eq. 5).

    Raises:
      ValueError: a pair with an unknown trajectory, or with the same one twice.
    """
    numbers = np.asarray(pairs, dtype=np.int64).reshape(len(pairs), 2)
    if np.any(numbers < 0) or np.any(numbers >= len(trajectory_features)):
        raise ValueError(f"pairs: expected trajectory numbers in 0 … {len(trajectory_features) - 1}, got {pairs}")
    if np.any(numbers[:, 0] == numbers[:, 1]):
        raise ValueError(f"pairs: expected two different trajectories in each, got {pairs}")
    return trajectory_features[numbers[:, 0]] - trajectory_features[numbers[:, 1]]
