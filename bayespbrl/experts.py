"""Experts: simulated ones and a person at a terminal, who answer which of two trajectories is better (paper, step 4).

An expert is any callable of two trajectories, in the order shown, that returns an `Answer` or its string. The answer
must depend on the two trajectories only: a resumed run may ask a question again.
"""

import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from numbers import Real
from pathlib import Path
from typing import Protocol

import numpy as np
from scipy.special import expit

from bayespbrl import checks
from bayespbrl.preferences import Answer, parse_answer
from bayespbrl.trajectories import Trajectory

# Of the sum of the absolute rewards: rounding in another order of summation must not decide.
TIE_TOLERANCE = 1e-9
# Ends of the seeds, so that one expert within another with the same seed errs independently. `NoisyExpert` has none.
TEACHER, MARGIN, NESTED = 1, 2, 3


class Expert(Protocol):
    """A callable that answers "which of these two is better?"."""

    def __call__(self, first: Trajectory, second: Trajectory, /) -> Answer | str: ...


class ReturnExpert:
    """The simulated expert of the paper: prefers the higher undiscounted sum of the hidden reward, without noise."""

    def __call__(self, first: Trajectory, second: Trajectory) -> Answer:
        return _preferred(first, second, (first.total_reward, second.total_reward))


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
        checks.function("expert", self.expert, " of two trajectories")
        checks.share("wrong_answers", self.wrong_answers)
        checks.seed(self.seed)

    def __call__(self, first: Trajectory, second: Trajectory) -> Answer:
        answer = parse_answer(self.expert(first, second))
        within = (
            (NESTED, self._depth) if self._depth else ()
        )  # each has a stream of its own; a single one is as it ever was
        return _reversed(answer) if _chance(self.seed, first, second, *within) < self.wrong_answers else answer

    @property
    def _depth(self) -> int:
        return self.expert._depth + 1 if isinstance(self.expert, NoisyExpert) else 0


@dataclass(frozen=True)
class Teacher:
    """B-Pref's simulated teacher; each of its five irrational teachers has one parameter that is not the default.

    In this order: it skips a question where neither trajectory is good, calls two of nearly equal return equal, prefers
    by a discounted return, rationally or as a Boltzmann-rational (Bradley-Terry) chooser, and makes mistakes. What it
    answers is a function of `seed` and the two trajectories, in either order.

    Attributes:
      rationality: β, per unit of return: the better one is preferred with probability 1 / (1 + exp(−β |ΔR|)). Infinity,
        the default, is rational; the *stochastic* teacher has β = 1.
      discount: γ in (0, 1]: rewards n steps before the last count γⁿ. The *myopic* teacher has γ = 0.9.
      least_return: both trajectories below it are skipped (the *skipping* teacher).
      equal_within: returns that differ by less are answered with a tie (the *equal* teacher).
      mistakes: probability that a preference is reversed. The *mistaken* teacher has 0.1.
      seed: a whole number >= 0.

    Source: Lee, Smith, Dragan & Abbeel (2021), "B-Pref: Benchmarking preference-based reinforcement learning",
    section 3 and algorithm 1. Both thresholds are theirs as they are, without their multiple of the current policy's
    return, on which an expert who sees two trajectories cannot depend. (By name, `skipping` skips what is below the
    mean return of the first policy; their scripts take a tenth of the current policy's, which means little where
    returns are negative.)
    """

    rationality: float = np.inf
    discount: float = 1.0
    least_return: float = -np.inf
    equal_within: float = 0.0
    mistakes: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not (isinstance(self.rationality, Real) and self.rationality > 0):
            raise ValueError(f"rationality: expected a number > 0, infinity included, got {self.rationality!r}")
        if checks.share("discount", self.discount) == 0:
            raise ValueError(f"discount: expected a number in (0, 1], got {self.discount!r}")
        if not isinstance(self.least_return, Real) or np.isnan(self.least_return):
            raise ValueError(f"least_return: expected a number, got {self.least_return!r}")
        checks.non_negative("equal_within", self.equal_within)
        checks.share("mistakes", self.mistakes)
        checks.seed(self.seed)

    def __call__(self, first: Trajectory, second: Trajectory) -> Answer:
        returns = first.total_reward, second.total_reward
        if max(returns) < self.least_return:
            return Answer.SKIP
        if abs(returns[0] - returns[1]) < self.equal_within:
            return Answer.TIE
        seen = [_discounted_from_the_end(each.rewards, self.discount) for each in (first, second)]
        answer = _preferred(first, second, seen)
        # Lee et al. (2021), section 3: Bradley & Terry (1952) with β
        wrong = 0.0 if np.isinf(self.rationality) else expit(-self.rationality * abs(seen[0] - seen[1]))
        # wrong either by chance or by mistake; both at once are right
        wrong = wrong * (1 - self.mistakes) + (1 - wrong) * self.mistakes
        return _reversed(answer) if _chance(self.seed, first, second, TEACHER) < wrong else answer


@dataclass(frozen=True)
class MarginExpert:
    """The simulated expert of "Programming by Feedback" (PF), who errs where two returns differ by less than a width.

    With z = |ΔR| and a threshold δ ~ U(0, `width`), the preference is reversed with probability max(0, ½ (1 − z/δ));
    over δ that is ½ − z/2M − (z/2M) log(M/z) for z < M = `width`, and 0 beyond. Whether it is reversed is a function of
    `seed` and the two trajectories, in either order.

    Attributes:
      width: M > 0, in units of the return.
      seed: a whole number >= 0.

    Source: Akrour, Schoenauer, Sebag & Souplet (2014), "Programming by feedback", section 3.2.
    """

    width: float
    seed: int = 0

    def __post_init__(self) -> None:
        checks.positive("width", self.width)
        checks.seed(self.seed)

    def error_probability(self, difference: float) -> float:
        """Probability of a wrong answer where the returns differ by `difference`."""
        share = min(abs(difference) / self.width, 1.0)
        # Akrour et al. (2014), section 3.2
        return 0.5 - share / 2 * (1 - np.log(share)) if share else 0.5

    def __call__(self, first: Trajectory, second: Trajectory) -> Answer:
        answer = ReturnExpert()(first, second)
        wrong = self.error_probability(first.total_reward - second.total_reward)
        return _reversed(answer) if _chance(self.seed, first, second, MARGIN) < wrong else answer


def _preferred(first: Trajectory, second: Trajectory, returns: Sequence[float]) -> Answer:
    """The answer by the returns of both; a tie where they are equal but for rounding."""
    difference = returns[0] - returns[1]
    if abs(difference) <= TIE_TOLERANCE * max(float(np.sum(np.abs(each.rewards))) for each in (first, second)):
        return Answer.TIE
    return Answer.FIRST if difference > 0 else Answer.SECOND


def _reversed(answer: Answer) -> Answer:
    """The opposite preference; ties and skips stay as they are."""
    return {Answer.FIRST: Answer.SECOND, Answer.SECOND: Answer.FIRST}.get(answer, answer)


def _chance(seed: int, first: Trajectory, second: Trajectory, *stream: int) -> float:
    """A uniform number in [0, 1), the same for the same two trajectories in either order; each stream has its own."""
    marks = sorted(zlib.crc32(t.actions.tobytes(), zlib.crc32(t.states.tobytes())) for t in (first, second))
    return float(np.random.default_rng([seed, *marks, *stream]).random())


def _discounted_from_the_end(rewards: np.ndarray, discount: float) -> float:
    return float(np.sum(rewards * discount ** np.arange(len(rewards) - 1, -1, -1.0)))


# Names of the experts that need no person: the rational one, B-Pref's five teachers, and that of PF.
SIMULATED = ("return", "stochastic", "myopic", "skipping", "equal", "mistaken", "margin")


def named_expert(name: str, *, mean: float = 0.0, scale: float = 1.0, seed: int = 0) -> Expert:
    """One of `SIMULATED` with the parameters that its source reports.

    Args:
      name: one of `SIMULATED`.
      mean, scale: mean and standard deviation of the return of a task's first policy, in whose units the thresholds
        and β are. Decision: the sources measure in returns of the current policy, which an expert does not know.
      seed: of its errors.

    Raises:
      ValueError: an unknown name, or a scale that is not positive.
    """
    experts: dict[str, Expert] = {
        "return": ReturnExpert(),
        "stochastic": Teacher(rationality=1.0 / checks.positive("scale", scale), seed=seed),
        "myopic": Teacher(discount=0.9),
        "skipping": Teacher(least_return=mean),
        "equal": Teacher(equal_within=0.1 * scale),
        "mistaken": Teacher(mistakes=0.1, seed=seed),
        "margin": MarginExpert(scale, seed=seed),
    }
    return experts[checks.one_of("expert", name, SIMULATED)]


PROMPT = "Which is better? [1] first  [2] second  [t] tie  [s] cannot tell  [u] undo  [q] stop here: "
KEYS = {"1": Answer.FIRST, "2": Answer.SECOND, "t": Answer.TIE, "s": Answer.SKIP, "u": Answer.UNDO}


@dataclass
class TerminalExpert:
    """A person at a terminal, who looks at a picture of the two trajectories on disk.

    Attributes:
      draw: writes a picture of the two trajectories, in the order shown, to a path.
      folder: of the picture `query.png`, which is overwritten for each question.
      read: prompts for a line of text.
      seconds: from the first prompt to the last answer: to draw the picture takes a while too. None before.
    """

    draw: Callable[[Trajectory, Trajectory, Path], None]
    folder: Path
    read: Callable[[str], str] = input
    seconds: float | None = field(default=None, init=False)

    def __call__(self, first: Trajectory, second: Trajectory) -> Answer:
        """The person's answer; raises `KeyboardInterrupt` where they stop or the input ends."""
        self.folder.mkdir(parents=True, exist_ok=True)
        picture = self.folder / "query.png"
        self.draw(first, second, picture)
        print(f"The two trajectories are in {picture}")
        began = time.perf_counter()
        answer = self._asked()
        self.seconds = time.perf_counter() - began
        return answer

    def _asked(self) -> Answer:
        while True:
            try:
                reply = self.read(PROMPT).strip().lower()
            except (EOFError, RuntimeError):  # the latter without standard input
                raise KeyboardInterrupt from None
            if reply in ("q", "quit"):
                raise KeyboardInterrupt
            if reply in KEYS:
                return KEYS[reply]
            if reply in set(Answer):
                return Answer(reply)
            print(f"Expected one of {', '.join([*KEYS, 'q'])}, got {reply!r}.")
