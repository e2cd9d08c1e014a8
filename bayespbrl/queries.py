"""Step 4: which trajectories to ask about, and the question "this one or the best so far?" (paper, step 4).

A query rule orders trajectories; the first is asked about, the next when that question is skipped or more are asked.
Three lines make one of your own, for `Learner(query=...)`:

    def newest(situation):
        return sorted(situation.new, reverse=True)
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from scipy.special import entr

from bayespbrl import checks
from bayespbrl.models.likelihoods import Likelihood, prob
from bayespbrl.preferences import Answer, PastQuestion, Preferences, Query
from bayespbrl.trajectories import Trajectory
from bayespbrl.utility.estimate import UtilityEstimate

# Posterior draws that a rule looks at: enough to order ten candidates, in hundredths of a second.
QUERY_DRAWS = 500
MOST_OLDER = 20  # their draws would soon cost more than all else
UNASKED_SIGNAL = 0.5  # from this signal on an iteration may ask nothing
# An answer that is expected to tell less is not asked for: it changes what is known about one question in a hundred.
LEAST_INFORMATION = 0.01 * math.log(2)
LEAST_BETWEEN = 3  # questions between one and its repetition, so that the answer is not remembered


@dataclass(frozen=True)
class Questions:
    """How many questions are asked, and about which trajectories.

    Attributes:
      query: the rule that orders the trajectories, a name of `QUERY_RULES`; `other` is a rule of the user's.
      queries_per_iteration, first_queries: M, in later iterations and in the first.
      unasked_iterations: most iterations in a row without a question, at most half the answers so far (ties count),
        once there is a preference. With a schedule that has a signal, only while the posterior has converged and the
        signal is at least `UNASKED_SIGNAL`. The paper's is 0.
      answers: the budget: most answers of the run, ties included; None for no limit.
      same_start: whether a newcomer is compared with a trajectory from the same start, where there is one: the better
        of two unlike starts says little about a policy. The paper compares it with the best of all.
      worthwhile: whether a question is left out whose answer is expected to tell less than `LEAST_INFORMATION`.
      repeats: share of the questions that are an earlier one with sides swapped. They are for people: the answers tell
        how consistent each is. They count for the budget of answers, and not as those of an iteration.
    """

    query: str = "highest-utility"
    queries_per_iteration: int = 1
    first_queries: int = 2
    unasked_iterations: int = 0
    answers: int | None = None
    same_start: bool = False
    worthwhile: bool = False
    repeats: float = 0.0

    def __post_init__(self) -> None:
        checks.one_of("query", self.query, (*QUERY_RULES, "other"))
        checks.whole("queries_per_iteration", self.queries_per_iteration)
        checks.whole("first_queries", self.first_queries)
        checks.whole("unasked_iterations", self.unasked_iterations, 0)
        checks.share("repeats", self.repeats, below_one=True)
        if self.answers is not None:
            checks.whole("answers", self.answers)
        for name in ("same_start", "worthwhile"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name}: expected true or false, got {getattr(self, name)!r}")

    def skips(self, preferences: Preferences, unasked: int, estimate: UtilityEstimate, signal: float | None) -> bool:
        """Whether the next iteration asks nothing, after `unasked` in a row that asked nothing.

        Decision: at most half the answers so far. Draws from two or three answers agree even where they are wrong.
        """
        if self.within_budget(1, preferences.answers) == 0:
            return True
        if unasked >= min(self.unasked_iterations, preferences.answers // 2) or not preferences.pairs:
            return False
        return signal is None or (estimate.quality.converged and signal >= UNASKED_SIGNAL)

    def within_budget(self, wanted: int, answers: int) -> int:
        """As many of `wanted` answers as the budget has left after so many."""
        return int(max(0, min(wanted, self.left(answers))))

    def left(self, answers: int) -> float:
        """How many answers the budget has left after so many."""
        return math.inf if self.answers is None else self.answers - answers


@dataclass(frozen=True)
class QuerySituation:
    """What a query rule may look at.

    Attributes:
      new: numbers of this iteration's trajectories.
      trajectories: all so far, by number, the new ones included.
      shown: numbers of those that some question has shown.
      incumbent: number of the newest undominated one.
      opponents: whom a trajectory would be compared with, by number; the incumbent where it names none.
      estimate: the utility estimate of the last iteration.
      signal: of the last iteration's bound; None where the schedule has none.
      rng: of everything random.
    """

    new: Sequence[int]
    trajectories: Sequence[Trajectory]
    shown: frozenset[int]
    incumbent: int
    estimate: UtilityEstimate
    signal: float | None
    rng: np.random.Generator
    opponents: Mapping[int, int] = field(default_factory=dict)

    def draws(self) -> tuple[Float[np.ndarray, "s n"], Float[np.ndarray, "s n"]]:
        """Posterior draws of the utility of each new trajectory and of its opponent."""
        against = [self.opponents.get(number, self.incumbent) for number in self.new]
        numbers = sorted({*self.new, *against})
        draws = self.estimate.trajectory_draws([self.trajectories[n] for n in numbers], number=QUERY_DRAWS)
        column = {number: position for position, number in enumerate(numbers)}
        return draws[:, [column[n] for n in self.new]], draws[:, [column[n] for n in against]]

    def information(self) -> Float[np.ndarray, " n"]:
        """The `expected_information` of a question about each new trajectory."""
        utilities, opponents = self.draws()
        return expected_information(utilities, opponents, likelihood=self.estimate.likelihood(QUERY_DRAWS))


QueryRule = Callable[[QuerySituation], Sequence[int]]


def highest_utility(situation: QuerySituation) -> list[int]:
    """The trajectory of highest expected utility wᵀψ(τ) first, equal ones in their order: the paper's rule."""
    new = [situation.trajectories[number] for number in situation.new]
    order = np.argsort(-situation.estimate.trajectory_utilities(new), kind="stable")
    return [situation.new[index] for index in order]


def probably_better(situation: QuerySituation) -> list[int]:
    """The trajectory that is most probably better than its opponent first."""
    utilities, opponents = situation.draws()
    return _ordered(situation, utilities, probability_better(utilities, opponents))


def thompson(situation: QuerySituation) -> list[int]:
    """The trajectory of highest utility in one posterior draw first (Thompson 1933)."""
    utilities, _ = situation.draws()
    return _ordered(situation, utilities, utilities[situation.rng.integers(len(utilities))])


def information(situation: QuerySituation) -> list[int]:
    """The comparison whose answer has the highest `expected_information` first."""
    utilities, opponents = situation.draws()
    scores = expected_information(utilities, opponents, likelihood=situation.estimate.likelihood(QUERY_DRAWS))
    return _ordered(situation, utilities, scores)


def disagreement(situation: QuerySituation) -> list[int]:
    """The comparison that the draws disagree on most first: the variance of which is better."""
    utilities, opponents = situation.draws()
    better = probability_better(utilities, opponents)
    return _ordered(situation, utilities, better * (1 - better))


@dataclass(frozen=True)
class InformationWhenUnsure:
    """`highest_utility` while the signal is at least `sure`; else `information` about any trajectory never shown.

    Of older iterations' it looks at `MOST_OLDER`, drawn at random.
    """

    sure: float = 0.75

    def __call__(self, situation: QuerySituation) -> list[int]:
        if (situation.signal or 0.0) >= self.sure:
            return highest_utility(situation)
        never = [number for number in range(len(situation.trajectories)) if number not in situation.shown]
        older = [number for number in never if number not in situation.new]
        some = situation.rng.permutation(older)[:MOST_OLDER].tolist()
        return information(replace(situation, new=[n for n in never if n in situation.new or n in some]))


QUERY_RULES: dict[str, QueryRule] = {
    "highest-utility": highest_utility,
    "probably-better": probably_better,
    "thompson": thompson,
    "information": information,
    "disagreement": disagreement,
    "information-when-unsure": InformationWhenUnsure(),
}


def candidates(rule: QueryRule, situation: QuerySituation) -> tuple[int, ...]:
    """The order of `rule`, checked, and cut to as many trajectories as are new.

    Raises:
      ValueError: no order, or one that names a trajectory that does not exist or names it twice.
    """
    order, known = rule(situation), len(situation.trajectories)
    try:
        numbers = [checks.whole("trajectory", number, 0) for number in order]
    except (TypeError, ValueError):
        numbers = []
    if not numbers or len(set(numbers)) < len(numbers) or max(numbers) >= known:
        name = getattr(rule, "__name__", type(rule).__name__)
        raise ValueError(f"query rule {name}: expected different trajectory numbers below {known}, got {order!r}")
    return tuple(numbers[: len(situation.new)])


def random_candidates(numbers: Sequence[int], *, rng: np.random.Generator) -> tuple[int, ...]:
    """`numbers` in random order: the first iteration, before there is an estimate to choose by (paper, step 4)."""
    return tuple(int(number) for number in rng.permutation(np.asarray(numbers)))


@dataclass(frozen=True)
class Chosen:
    """Which questions an iteration asks.

    Attributes:
      wanted: how many answers.
      candidates: trajectories to ask about, best first.
      opponents: whom each is compared with; None: the newest undominated one.
      information: what the answer to the first question is expected to tell, nats; None where that was not asked.
    """

    wanted: int = 0
    candidates: tuple[int, ...] = ()
    opponents: tuple[int, ...] | None = None
    information: float | None = None


def first_questions(
    new: Sequence[int], opponents: Mapping[int, int], options: Questions, *, rng: np.random.Generator
) -> Chosen:
    """Random ones, before there is an estimate to choose by (paper, step 4); with opponents, each pair once."""
    wanted = options.within_budget(options.first_queries, 0)
    pairs = [number for number in new if opponents.get(number, number) < number]
    candidates = random_candidates(pairs or new, rng=rng)
    return Chosen(wanted, candidates, tuple(opponents[n] for n in candidates) if pairs else None)


def later_questions(rule: QueryRule, situation: QuerySituation, options: Questions, *, answers: int) -> Chosen:
    """Those of `rule`, after so many answers; none where the best is not worth asking."""
    order, opponents, information = candidates(rule, situation), None, None
    if options.same_start:
        opponents = tuple(situation.opponents.get(number, situation.incumbent) for number in order)
    if options.worthwhile and situation.estimate.posterior is not None:
        information = float(replace(situation, new=order[:1]).information()[0])
    worth = information is None or information >= LEAST_INFORMATION
    wanted = options.within_budget(options.queries_per_iteration, answers) if worth else 0
    return Chosen(wanted, order, opponents, information)


def repeated(
    past: Sequence[PastQuestion], number: int, options: Questions, *, left: float, rng: np.random.Generator
) -> PastQuestion | None:
    """The earlier question that question `number` repeats; None where a new one is due.

    Args:
      past: the questions so far that were answered.
      left: answers of the budget that nothing else is wanted for.
      rng: chooses among the last answerer's that have not been repeated, without the last few.
    """
    done = {question.repeats for question in past}
    if len(done - {None}) >= int(options.repeats * number + 1e-9) or left < 1:
        return None
    new = [each for each in past[:-LEAST_BETWEEN] if each.repeats is None and each.answer is not Answer.SKIP]
    suitable = [each for each in new if each.number not in done and each.answerer == past[-1].answerer]
    return suitable[rng.integers(len(suitable))] if suitable else None


def _ordered(
    situation: QuerySituation, utilities: Float[np.ndarray, "s n"], scores: Float[np.ndarray, " n"]
) -> list[int]:
    """The trajectories by score, equal ones by their mean utility."""
    return [situation.new[index] for index in np.lexsort((-utilities.mean(axis=0), -scores))]


def probability_better(
    utilities: Float[np.ndarray, "s n"], opponents: Float[np.ndarray, "s n"] | Float[np.ndarray, " s"]
) -> Float[np.ndarray, " n"]:
    """Posterior probability that each of n trajectories is better than its opponent; equal utilities count half.

    Args:
      utilities, opponents: posterior draws, shapes (S, n), and (S, n) or (S,) for one opponent of all.

    Returns:
      shape (n,).
    """
    utilities, opponents = _fitting_draws(utilities, opponents)
    return np.mean((1 + np.sign(utilities - opponents)) / 2, axis=0)


def expected_information(
    utilities: Float[np.ndarray, "s n"],
    opponents: Float[np.ndarray, "s n"] | Float[np.ndarray, " s"],
    *,
    likelihood: Likelihood,
) -> Float[np.ndarray, " n"]:
    """What the answer to "this one or its opponent?" is expected to tell about the utility, in nats, ≤ log 2.

    The mutual information of answer and weights, H(E p) − E H(p), with p the likelihood of the one answer at each draw
    and H the entropy of a coin: it is large where the draws are each sure and do not agree. What no weights could
    predict, as the coin tosses of a lapse rate, does not count.

    Args:
      utilities, opponents: posterior draws, shapes (S, n), and (S, n) or (S,) for one opponent of all.
      likelihood: of an answer given its margin, the difference of the two utilities; its parameters are numbers, or
        have shape (S, 1), one for each draw.

    Returns:
      shape (n,).

    Source: Houlsby, Huszár, Ghahramani and Lengyel (2011), "Bayesian active learning for classification and preference
    learning", eq. 2.
    """
    utilities, opponents = _fitting_draws(utilities, opponents)
    p = prob(likelihood, utilities - opponents)
    # the estimate from the same draws is never negative but for rounding
    return np.maximum(_entropy(p.mean(axis=0)) - _entropy(p).mean(axis=0), 0.0)


def _entropy(p: np.ndarray) -> np.ndarray:
    """Of a coin, nats."""
    return entr(p) + entr(np.maximum(1 - p, 0.0))


def _fitting_draws(utilities: np.ndarray, opponents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    utilities, opponents = np.asarray(utilities, dtype=np.float64), np.asarray(opponents, dtype=np.float64)
    fits = opponents.shape in (utilities.shape, utilities.shape[:1])
    if utilities.ndim != 2 or len(utilities) == 0 or not fits:
        raise ValueError(
            "utilities: expected draws of shape (S, n), and of shape (S, n) or (S,) of the opponents, "
            f"got {utilities.shape} and {opponents.shape}"
        )
    if not (np.isfinite(utilities).all() and np.isfinite(opponents).all()):
        raise ValueError("utilities: expected finite draws, got NaN or infinity")
    return utilities, opponents.reshape(len(opponents), -1)


def show(
    number: int, newcomer: int, incumbent: int, trajectories: Sequence[Trajectory], *, rng: np.random.Generator
) -> Query:
    """The question "newcomer or incumbent?", in an order drawn at random, so that no side is favoured."""
    first, second = (newcomer, incumbent) if rng.random() < 0.5 else (incumbent, newcomer)
    return Query(number, first, second, newcomer, (trajectories[first], trajectories[second]))
