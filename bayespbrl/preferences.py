"""Preferences ζ: questions, answers, the ordered pairs and the undominated trajectories (paper, step 4)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayespbrl import checks
from bayespbrl.trajectories import Trajectory

Stated = tuple[tuple[tuple[int, int], ...], tuple[int, ...]]  # ordered pairs, and the undominated after them


class Answer(StrEnum):
    """An expert's answer about two trajectories, in the order in which they were shown."""

    FIRST = "first"
    SECOND = "second"
    TIE = "tie"
    SKIP = "skip"  # "cannot tell": kept, but it teaches nothing and does not count; another trajectory is asked about
    UNDO = "undo"  # takes the previous answer back, and its question is asked again


def parse_answer(answer: object) -> Answer:
    """`answer` as an `Answer`; `ValueError` where it is none."""
    try:
        return Answer(answer)  # type: ignore[arg-type]
    except ValueError:
        choices = ", ".join(repr(str(choice)) for choice in Answer)
        raise ValueError(f"answer: expected one of {choices}, got {answer!r}") from None


@dataclass(frozen=True)
class Query:
    """A question: which of two trajectories is better?

    Attributes:
      number: of the question in its run, from 1.
      first, second: numbers of the two trajectories in the order shown, which is drawn at random.
      newcomer: number of the new one; the other is its opponent.
      trajectories: the two trajectories, in the order shown.
      repeats: number of the earlier question about the same two, shown the other way round; None: it is a new one.
      rivals: the undominated trajectories that the newcomer competes with; None: all.
      answerer: who is asked, where several people answer at once; None: whoever answers.
      duel: whether it is about the two alone, as a repeated question: the undominated trajectories stay.
    """

    number: int
    first: int
    second: int
    newcomer: int
    trajectories: tuple[Trajectory, Trajectory]
    repeats: int | None = None
    rivals: tuple[int, ...] | None = None
    answerer: str | None = None
    duel: bool = False

    @property
    def incumbent(self) -> int:
        """The number of the trajectory that the newcomer is compared with."""
        return self.second if self.newcomer == self.first else self.first


class PastQuestion(NamedTuple):
    """A question with its answer.

    Attributes:
      number, first, second, newcomer, repeats: as in `Query`.
      answer: `FIRST`, `SECOND`, `TIE` or `SKIP`.
      answerer, seconds: who gave it, and how long they took; None: not known.
      session: of the sitting, the same for all its answers; None: not known.
      replays: how often the clips began again while the question was shown; None: not known.
    """

    number: int
    first: int
    second: int
    newcomer: int
    repeats: int | None
    answer: Answer
    answerer: str | None
    seconds: float | None
    session: str | None = None
    replays: int | None = None

    @property
    def preferred(self) -> int | None:
        """Number of the preferred trajectory; None where neither is."""
        return {Answer.FIRST: self.first, Answer.SECOND: self.second}.get(self.answer)


class Source(NamedTuple):
    """Where a pair or a tie comes from.

    Attributes:
      tied: whether it is a tie.
      number: of the pair, or of the tie, from 0.
      side: 1 where its first was shown first, −1 where its second was, 0 where it was not asked about itself.
      answerer: who answered; None: not known.
    """

    tied: bool
    number: int
    side: int
    answerer: str | None


@dataclass(frozen=True)
class Preferences:
    """The ordered pairs and the undominated trajectories, by the numbers of the trajectories.

    Attributes:
      pairs: (preferred, dominated) for each τᵢ ≻ τⱼ.
      ties: pairs that were answered with "no difference". There are K pairs and ties (eq. 8).
      undominated: those of the shown that no answer puts below another of their start, the newest last. Where all
        are compared with one another, they are the best so far and tie.
      answers: number of answered questions, ties included.
      sources: of the pairs and ties of which anything is known, in the order of the answers.
    """

    pairs: tuple[tuple[int, int], ...] = ()
    undominated: tuple[int, ...] = ()
    answers: int = 0
    ties: tuple[tuple[int, int], ...] = ()
    sources: tuple[Source, ...] = ()

    @property
    def answerers(self) -> tuple[str | None, ...]:
        """All who answered, each once, in the order of their first answers; None stands for those without a name."""
        return tuple(dict.fromkeys(source.answerer for source in self.sources)) or (None,) * bool(self.answers)

    def rows(self) -> list[Source]:
        """The source of each pair, then of each tie."""
        known = {(source.tied, source.number): source for source in self.sources}
        keys = [(False, number) for number in range(len(self.pairs))]
        keys += [(True, number) for number in range(len(self.ties))]
        return [known.get(key, Source(*key, 0, None)) for key in keys]

    def start(self, trajectory: int) -> "Preferences":
        """The same preferences with `trajectory` as the first undominated one."""
        return replace(self, undominated=(trajectory,))

    def add(
        self,
        newcomer: int,
        incumbent: int,
        *,
        preferred: int | None,
        rivals: Sequence[int] | None = None,
        shown_first: int | None = None,
        answerer: str | None = None,
    ) -> "Preferences":
        """The preferences after one comparison of a newcomer with an incumbent.

        A better newcomer is preferred over every rival and replaces them. Over a worse one, every rival is preferred.
        In a tie (`preferred=None`) the newcomer joins them, and the pair is a tie. So ties count as equal, and after
        some of them one answer states several pairs, of which only one was shown.

        Where several people answer at once, or an iteration has several questions, either may have been compared
        meanwhile. Where one has become dominated, the answer is about the two alone: it does not become undominated
        again, nor by a tie with it the other one.

        Args:
          rivals: the undominated trajectories that the newcomer is compared with, the incumbent among them unless it
            was never shown; None: all.
          shown_first: which of the two was; None: not known.
          answerer: who answered; None: not known.

        Raises:
          ValueError: without `rivals`, an incumbent that is not the newest undominated one; a preferred that is neither
            of the two.
        """
        if rivals is None and (not self.undominated or incumbent != self.undominated[-1]):
            raise ValueError(f"incumbent: expected the last of the undominated {self.undominated}, got {incumbent}")
        if newcomer == incumbent:
            raise ValueError(f"newcomer: expected another trajectory than the incumbent, got {newcomer}")
        if preferred not in (None, newcomer, incumbent):
            raise ValueError(f"preferred: expected {newcomer}, {incumbent} or None, got {preferred}")
        asked = (incumbent, newcomer) if preferred == incumbent else (newcomer, incumbent)
        if rivals is not None and (self.has_fallen(newcomer) or self.has_fallen(incumbent)):
            pairs, standing = self._of_two_alone(newcomer, incumbent, preferred)
        else:
            pairs, standing = self._of_all_rivals(newcomer, incumbent, preferred, rivals)
        ties = self.ties if preferred is not None else (*self.ties, asked)
        standing = standing or self.undominated  # answers in a circle leave none
        after = Preferences(self.pairs + pairs, standing, self.answers + 1, ties, self.sources)
        return after._with_sources(self, asked, shown_first, answerer)

    def _of_two_alone(self, newcomer: int, incumbent: int, preferred: int | None) -> Stated:
        """The ordered pair that an answer about two of which one has fallen states, and who is undominated then."""
        if preferred is None:
            return (), self.undominated
        worse = incumbent if preferred == newcomer else newcomer
        rises = () if preferred == incumbent or self.has_fallen(newcomer) else (newcomer,)
        return ((preferred, worse),), (*(each for each in self.undominated if each not in (worse, newcomer)), *rises)

    def _of_all_rivals(
        self, newcomer: int, incumbent: int, preferred: int | None, rivals: Sequence[int] | None
    ) -> Stated:
        """The ordered pairs of a newcomer with all its rivals, and who is undominated then."""
        among = self.undominated if rivals is None else rivals
        beside = [each for each in among if each in self.undominated and each != newcomer]
        beside += [] if incumbent in beside else [incumbent]
        others = [each for each in self.undominated if each not in (*beside, newcomer)]
        if preferred is None:
            return (), (*others, *beside, newcomer)
        if preferred == newcomer:
            return tuple((newcomer, each) for each in beside), (*others, newcomer)
        return tuple((each, newcomer) for each in beside), (*others, *beside)

    def has_fallen(self, trajectory: int) -> bool:
        """Whether it was compared, and is undominated no longer."""
        return trajectory not in self.undominated and any(trajectory == worse for _, worse in self.pairs)

    def tied_with(self, trajectory: int) -> tuple[int, ...]:
        """The undominated trajectories that tie with one of them, itself among them, in their order.

        Those that no ties connect were never compared: several people answered at once.
        """
        together, before = {trajectory} & set(self.undominated), set[int]()
        while together != before:
            before = set(together)
            together |= {each for tie in self.ties if together & set(tie) for each in tie if each in self.undominated}
        return tuple(each for each in self.undominated if each in together)

    def add_repeated(
        self, first: int, second: int, *, preferred: int | None, answerer: str | None = None
    ) -> "Preferences":
        """The preferences after a repeated question, with the first shown first: one more pair or tie.

        Decision: the undominated trajectories stay. Answers that contradict each other are for the posterior to weigh.
        """
        if preferred not in (None, first, second):
            raise ValueError(f"preferred: expected {first}, {second} or None, got {preferred}")
        other = second if preferred == first else first
        pairs, ties = self.pairs, self.ties
        asked = (first, second) if preferred is None else (preferred, other)
        if preferred is None:
            ties = (*ties, asked)
        else:
            pairs = (*pairs, asked)
        after = replace(self, pairs=pairs, ties=ties, answers=self.answers + 1)
        return after._with_sources(self, asked, first, answerer)

    def without(self, answerer: str | None) -> "Preferences":
        """The preferences without one person's answers; the undominated trajectories stay.

        Answers are counted by the side that was shown first, which has to be known of each.

        Raises:
          ValueError: a name that nobody who answered has.
        """
        if answerer not in self.answerers:
            names = ", ".join(repr(name) for name in self.answerers)
            raise ValueError(f"answerer: expected one of {names or 'those who answered, nobody yet'}, got {answerer!r}")
        pairs, ties, sources = list[tuple[int, int]](), list[tuple[int, int]](), list[Source]()
        for pair, source in zip((*self.pairs, *self.ties), self.rows(), strict=True):
            if source.answerer != answerer:
                left = ties if source.tied else pairs
                sources.append(source._replace(number=len(left)))
                left.append(pair)
        answers = sum(source.side != 0 for source in sources)  # what was asked has a side
        return replace(self, pairs=tuple(pairs), ties=tuple(ties), answers=answers, sources=tuple(sources))

    def _with_sources(
        self, before: "Preferences", asked: tuple[int, int], shown_first: int | None, answerer: str | None
    ) -> "Preferences":
        """The same with the sources of the pairs and ties that were not there before."""
        if shown_first is None and answerer is None:
            return self
        side = 0 if shown_first is None else side_of(asked, shown_first)
        new = [
            Source(tied, number, side if every[number] == asked else 0, answerer)
            for tied, every, first in ((False, self.pairs, len(before.pairs)), (True, self.ties, len(before.ties)))
            for number in range(first, len(every))
        ]
        return replace(self, sources=(*self.sources, *new))


def side_of(pair: tuple[int, int], shown_first: int) -> int:
    """1 where the first of the pair was shown first, else −1."""
    return 1 if pair[0] == shown_first else -1


def pair_differences(
    pairs: Sequence[tuple[int, int]], trajectory_features: Float[np.ndarray, "n d"]
) -> Float[np.ndarray, "k d"]:
    """ψ(preferred) − ψ(dominated) for each of K pairs (eq. 5).

    Raises:
      ValueError: no pairs of integers; a pair with an unknown trajectory, or with the same one twice.
    """
    numbers = known_pairs("pairs", pairs, len(trajectory_features))
    return trajectory_features[numbers[:, 0]] - trajectory_features[numbers[:, 1]]  # eq. 5


def known_pairs(name: str, pairs: Sequence[tuple[int, int]], known: int) -> Int[np.ndarray, "k 2"]:
    """`pairs` as an array, where each has two different numbers below `known`; `ValueError` by `name` otherwise."""
    numbers = checks.pairs(name, pairs)
    for expected, bad in (
        (f"numbers in 0 … {known - 1}", np.any((numbers < 0) | (numbers >= known), axis=1)),
        ("two different numbers in each", numbers[:, 0] == numbers[:, 1]),
    ):
        if bad.any():
            got = tuple(numbers[bad][0].tolist())
            raise ValueError(f"{name}: expected {expected}, got {got} as number {bad.argmax()}")
    return numbers
