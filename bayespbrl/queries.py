"""Step 4: which trajectories to ask about, and the question "this one or the best so far?" (paper, step 4).

A query rule orders trajectories; the first is asked about, the next when that question is skipped or more are asked.
Before it comes a policy without its noise that the posterior doubts (`QuerySituation.doubted`), or of which it matters
whether it is better than the one that is kept (`QuerySituation.at_stake`).
Undominated trajectories in the order, as the incumbent, are left out: they are what the others are compared with.

Three lines make one of your own, for `Learner(query=...)`:

    def newest(situation):
        return sorted(situation.new, reverse=True)
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from scipy.special import entr

from bayespbrl import checks
from bayespbrl.models.likelihoods import Likelihood, prob, with_threshold
from bayespbrl.preferences import Query
from bayespbrl.trajectories import Trajectory
from bayespbrl.utility.estimate import UtilityEstimate

# Posterior draws that a rule looks at: enough to order ten candidates, in hundredths of a second.
QUERY_DRAWS = 500
MOST_OLDER = 20  # their draws would soon cost more than all else
# Answers of which all are ties: from so many on it counts as information whether the next is one too.
ONLY_TIES = 4
STAKE = 0.02  # of the spread of the utilities of what was shown
DOUBT = 0.25  # nats that an answer is expected to tell: of draws that are sure each, less than 0.93 agree


@dataclass(frozen=True)
class QuerySituation:
    """The information available to a query rule.

    Attributes:
      new: numbers of this iteration's trajectories.
      trajectories: all so far, by number, the new ones included.
      shown: numbers of those that some question has shown.
      incumbent: number of the newest undominated one.
      opponents: whom a trajectory would be compared with, by number; the incumbent where it names none.
      undominated: numbers of all that no answer puts below another, about which no question is asked.
      noise_free: number of the new one without the policy's noise; None where all have it.
      only_ties: number of answers so far where all are ties and ties are informative; else 0.
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
    undominated: Sequence[int] = ()
    noise_free: int | None = None
    only_ties: int = 0

    def draws(self) -> tuple[Float[np.ndarray, "s n"], Float[np.ndarray, "s n"]]:
        """Posterior draws of the utility of each new trajectory and of its opponent."""
        against = [self.opponents.get(number, self.incumbent) for number in self.new]
        numbers = sorted({*self.new, *against})
        draws = self.estimate.trajectory_draws([self.trajectories[n] for n in numbers], number=QUERY_DRAWS)
        column = {number: position for position, number in enumerate(numbers)}
        return draws[:, [column[n] for n in self.new]], draws[:, [column[n] for n in against]]

    def doubted(self) -> tuple[int, ...]:
        """The trajectory without noise, where the answer about it would tell at least `DOUBT`; else none.

        Decision: it is asked about then, whatever the rule. Without its noise a policy may stay where no trajectory
        with it does (FrozenLake-v1 that does not slip), and a run keeps policies without.
        """
        if self.noise_free is None or self.estimate.posterior is None:
            return ()
        return (self.noise_free,) if self.told_by(self.noise_free) >= DOUBT else ()

    def at_stake(self) -> tuple[int, ...]:
        """The trajectory without noise, where it is worth `STAKE` to know whether its opponent is better; else none.

        That is worth the expected utility of the better one less that of the one chosen now, E max(u, u') −
        max(E u, E u'), as a share of the standard deviation of the utilities of what was shown.

        Decision: this, and not information, where the two are policies of which the run keeps one. Two that hardly act
        differ little, but an answer about them tells as much as any.
        """
        if self.noise_free is None or self.estimate.posterior is None:
            return ()
        opponent = self.opponents.get(self.noise_free, self.incumbent)
        numbers = [self.noise_free, opponent, *sorted(self.shown)]
        draws = self.estimate.trajectory_draws([self.trajectories[n] for n in numbers], number=QUERY_DRAWS)
        worth = draws[:, :2].max(axis=1).mean() - draws[:, :2].mean(axis=0).max()
        return (self.noise_free,) if worth > 0 and worth >= STAKE * draws[:, 2:].std(axis=1).mean() else ()

    def told_by(self, number: int) -> float:
        """What the answer to the question about one trajectory is expected to tell, in nats."""
        return float(replace(self, new=[number]).information()[0])

    def information(self) -> Float[np.ndarray, " n"]:
        """The `expected_information` of a question about each new trajectory."""
        return self.informed()[1]

    def informed(self) -> tuple[Float[np.ndarray, "s n"], Float[np.ndarray, " n"]]:
        """`draws` of the new trajectories, and `information`.

        Decision: a tie counts as an answer only after `ONLY_TIES` and nothing else. Where goals are seldom reached, as
        on FrozenLake-v1, it is what tells a trajectory that reached one from all others.
        """
        utilities, opponents = self.draws()
        thresholds = self.estimate.tie_thresholds(QUERY_DRAWS) if self.only_ties >= ONLY_TIES else None
        likelihood = self.estimate.likelihood(QUERY_DRAWS)
        return utilities, expected_information(utilities, opponents, likelihood=likelihood, tie_thresholds=thresholds)


QueryRule = Callable[[QuerySituation], Sequence[int]]


def highest_utility(situation: QuerySituation) -> list[int]:
    """The trajectory of highest expected utility wᵀψ(τ) first, equal ones in their order: the paper's rule."""
    new = [situation.trajectories[number] for number in situation.new]
    # paper, step 4: the highest expected utility first
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
    return _ordered(situation, *situation.informed())


def disagreement(situation: QuerySituation) -> list[int]:
    """The comparison that the draws disagree on most first: the variance of which is better."""
    utilities, opponents = situation.draws()
    return _ordered(situation, utilities, np.sign(utilities - opponents).var(axis=0))


def eubo(situation: QuerySituation) -> list[int]:
    """The comparison with the highest expected utility of the best option (EUBO) first: E max(u(τ), u(opponent)).

    Source: Lin, Astudillo, Frazier & Bakshy (2022), "Preference exploration for efficient Bayesian optimization with
    multiple outcomes", section 4; Astudillo, Lin, Bakshy & Frazier (2023), "qEUBO", eq. 2, with q = 2.
    """
    utilities, opponents = situation.draws()
    return _ordered(situation, utilities, np.maximum(utilities, opponents).mean(axis=0))


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
    "eubo": eubo,
    "information-when-unsure": InformationWhenUnsure(),
}
WITHOUT_DRAWS = ("highest-utility",)  # the rules that a point estimate can follow
BY_SIGNAL = ("information-when-unsure",)  # those that need a schedule with a signal


def candidates(rule: QueryRule, situation: QuerySituation) -> tuple[int, ...]:
    """The order of `rule`, checked, without undominated trajectories, and cut to as many trajectories as are new.

    Raises:
      ValueError: no order, or one that names a trajectory that does not exist, names one twice, or names undominated
        ones only.
    """
    order, known = rule(situation), len(situation.trajectories)
    try:
        numbers = [checks.whole("trajectory", number, 0) for number in order]
    except (TypeError, ValueError):
        numbers = []
    name = getattr(rule, "__name__", type(rule).__name__)
    if not numbers or len(set(numbers)) < len(numbers) or max(numbers) >= known:
        raise ValueError(f"query rule {name}: expected different trajectory numbers below {known}, got {order!r}")
    standing = {situation.incumbent, *situation.undominated}
    # compared with itself, or with its rivals of which it is one, a trajectory would be preferred over itself
    left = [number for number in numbers if number not in standing]
    if not left:
        raise ValueError(
            f"query rule {name}: expected a trajectory other than the undominated {sorted(standing)}, got {order!r}"
        )
    return tuple(left[: len(situation.new)])


def random_candidates(numbers: Sequence[int], *, rng: np.random.Generator) -> tuple[int, ...]:
    """`numbers` in random order: the first iteration, before there is an estimate to choose by (paper, step 4)."""
    return tuple(int(number) for number in rng.permutation(np.asarray(numbers)))


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
    tie_thresholds: Float[np.ndarray, "s 1"] | None = None,
) -> Float[np.ndarray, " n"]:
    """Expected information gain of each comparison, in nats, at most log 2, or log 3 with ties.

    The mutual information of answer and weights, H(E p) − E H(p), with p the likelihood of the one answer at each draw
    and H the entropy of the answer: it is large where the draws are each sure and do not agree. What no weights could
    predict, as the coin tosses of a lapse rate, does not count.

    Args:
      utilities, opponents: posterior draws, shapes (S, n), and (S, n) or (S,) for one opponent of all.
      likelihood: of an answer given its margin, the difference of the two utilities; its parameters are numbers, or
        have shape (S, 1), one for each draw.
      tie_thresholds: of each draw, where "no difference" counts as an answer; None: it is left out of account.

    Returns:
      shape (n,).

    Source: Houlsby, Huszár, Ghahramani and Lengyel (2011), "Bayesian active learning for classification and preference
    learning", eq. 2.
    """
    utilities, opponents = _fitting_draws(utilities, opponents)
    margins = utilities - opponents
    if tie_thresholds is None:
        answers = [prob(likelihood, margins)]
    else:
        ordered = with_threshold(likelihood, tie_thresholds, np.zeros(margins.shape[1], bool))
        answers = [prob(ordered, margins), prob(ordered, -margins)]
    # Houlsby et al. (2011), eq. 2; the estimate from the same draws is never negative but for rounding
    return np.maximum(_entropy([p.mean(axis=0) for p in answers]) - _entropy(answers).mean(axis=0), 0.0)


def _entropy(probabilities: Sequence[np.ndarray]) -> np.ndarray:
    """Entropy of an answer with these probabilities, and one more answer with what they leave, in nats."""
    return np.asarray(sum(entr(p) for p in probabilities) + entr(np.maximum(1 - sum(probabilities), 0.0)))


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
    """The question "newcomer or incumbent?", with the order of the two drawn at random."""
    first, second = (newcomer, incumbent) if rng.random() < 0.5 else (incumbent, newcomer)
    return Query(number, first, second, newcomer, (trajectories[first], trajectories[second]))
