"""Step 4: the questions of an iteration: how many, about which trajectories, against which, or an earlier one again.

In which order trajectories are worth asking about is a query rule's matter (`queries`).
"""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayespbrl import checks
from bayespbrl.preferences import Answer, PastQuestion, Preferences, Query
from bayespbrl.queries import QUERY_RULES, QueryRule, QuerySituation, candidates, random_candidates
from bayespbrl.trajectories import Trajectory, same_starts
from bayespbrl.utility.estimate import UtilityEstimate

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
      informative_ties: whether, while all answers are ties, it counts as information whether the next is one
        (`queries.ONLY_TIES`).
      worthwhile: whether a question is left out whose answer is expected to tell less than `LEAST_INFORMATION`.
      against_kept: whether a policy without its noise (`noise_free`) is compared with the one that is kept, without its
        noise too. The best trajectory so far is a lucky one: a loss against it says little about which of two policies
        is better. Which of two policies is better is then what most draws say, and not their mean; the newest is kept
        where three quarters say so. A tenth of the answers is left for a restarted policy, which is asked about,
        wherever a quarter prefer it, before it is kept.
      clip_steps: length of the part of each trajectory, drawn at random, that questions are about; None: all of it. A
        person sees a part in seconds.
      repeats: share of the questions that are an earlier one with sides swapped. They are for people: the answers tell
        how consistent each is. They count for the budget of answers, and not as those of an iteration.
      shared_repeats: whether a repeated question may be one that somebody else answered: the answers then also tell how
        well people agree.
    """

    query: str = "highest-utility"
    queries_per_iteration: int = 1
    first_queries: int = 2
    unasked_iterations: int = 0
    answers: int | None = None
    same_start: bool = False
    informative_ties: bool = False
    worthwhile: bool = False
    clip_steps: int | None = None
    against_kept: bool = False
    repeats: float = 0.0
    shared_repeats: bool = False

    def __post_init__(self) -> None:
        checks.one_of("query", self.query, (*QUERY_RULES, "other"))
        checks.whole("queries_per_iteration", self.queries_per_iteration)
        checks.whole("first_queries", self.first_queries)
        checks.whole("unasked_iterations", self.unasked_iterations, 0)
        checks.share("repeats", self.repeats, below_one=True)
        checks.optional(checks.whole, "answers", self.answers)
        checks.optional(checks.whole, "clip_steps", self.clip_steps)
        for name in ("same_start", "informative_ties", "worthwhile", "against_kept", "shared_repeats"):
            checks.boolean(name, getattr(self, name))
        if self.shared_repeats and not self.repeats:
            raise ValueError("shared_repeats: expected false without repeats, got true")
        if self.same_start and self.clip_steps is not None:
            raise ValueError("same_start: expected false with clip_steps, because clips begin at any step, got true")
        if self.against_kept and self.clip_steps is not None:
            raise ValueError("against_kept: expected false with clip_steps, because clips begin at any step, got true")

    def clips(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> list[list[int]] | None:
        """First step and number of steps of the part of each trajectory that is compared; None: all of it."""
        if self.clip_steps is None:
            return None
        lengths = [min(self.clip_steps, len(trajectory)) for trajectory in trajectories]
        firsts = [rng.integers(len(each) - steps + 1) for each, steps in zip(trajectories, lengths, strict=True)]
        return [[int(first), steps] for first, steps in zip(firsts, lengths, strict=True)]

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
        """`wanted`, or what the budget has left after `answers` if that is less."""
        return int(max(0, min(wanted, self.left(answers))))

    def left(self, answers: int) -> float:
        """How many answers the budget has left after `answers`."""
        return math.inf if self.answers is None else self.answers - answers


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
    """Random questions, before there is an estimate to choose by (paper, step 4); with opponents, each pair once."""
    wanted = options.within_budget(options.first_queries, 0)
    pairs = [number for number in new if opponents.get(number, number) < number]
    candidates = random_candidates(pairs or new, rng=rng)
    return Chosen(wanted, candidates, tuple(opponents[n] for n in candidates) if pairs else None)


def later_questions(
    rule: QueryRule, situation: QuerySituation, options: Questions, preferences: Preferences, *, unasked: int
) -> Chosen:
    """The questions that `rule` chooses, after `unasked` iterations in a row without any.

    None where the iteration skips them, or the best is not worth asking once an answer stated an order. From then on
    the policy without its noise comes first where the posterior is in doubt about it, or where it matters whether it is
    better than the kept one, alone if the iteration would have been skipped.
    """
    if options.informative_ties and not preferences.pairs:
        situation = replace(situation, only_ties=preferences.answers)
    doubted, kept = _without_noise(situation, options, preferences), tuple[int, ...]()
    if options.against_kept and set(doubted) & set(situation.opponents):
        kept = (situation.opponents[doubted[0]],)
    elif not options.same_start:
        situation = replace(situation, opponents={})  # the policy without noise is compared like any other
    skipped = options.skips(preferences, unasked, situation.estimate, situation.signal)
    if skipped and not doubted:
        return Chosen()
    others = () if skipped else (n for n in candidates(rule, situation) if n not in (*doubted, *kept))
    order, opponents, information = (*doubted, *others), None, None
    if options.same_start or situation.opponents:
        opponents = tuple(situation.opponents.get(number, situation.incumbent) for number in order)
    if situation.estimate.posterior is not None:
        information = situation.told_by(order[0])
    worth = not (options.worthwhile and preferences.pairs) or information is None or information >= LEAST_INFORMATION
    wanted = options.within_budget(options.queries_per_iteration, preferences.answers) if worth else 0
    return Chosen(wanted, order, opponents, information)


def _without_noise(situation: QuerySituation, options: Questions, preferences: Preferences) -> tuple[int, ...]:
    """The trajectory without noise, where a question is to be about it whatever the rule; else none."""
    if not preferences.pairs or options.left(preferences.answers) <= 0:
        return ()
    if not options.against_kept:
        return situation.doubted()
    if not options.worthwhile:
        return situation.at_stake()
    return tuple(number for number in situation.at_stake() if situation.told_by(number) >= LEAST_INFORMATION)


def confirmation(situation: QuerySituation, options: Questions, preferences: Preferences) -> Chosen:
    """The question about the policy without its noise, whatever the posterior expects, where it was restarted.

    Decision: where the run would keep it. It was made from a posterior that has seen no trajectory of it, so that it
    is better by what was learned, or by what the posterior has wrong.
    """
    wanted = options.within_budget(1, preferences.answers)
    if situation.noise_free is None or not wanted:
        return Chosen()
    number = situation.noise_free
    information = None if situation.estimate.posterior is None else situation.told_by(number)
    return Chosen(wanted, (number,), (situation.opponents.get(number, situation.incumbent),), information)


def repeated(
    past: Sequence[PastQuestion],
    number: int,
    options: Questions,
    *,
    left: float,
    rng: np.random.Generator,
    answerer: str | None = None,
    waiting: Collection[int | None] = (),
) -> PastQuestion | None:
    """The earlier question that question `number` repeats; None where a new one is due.

    Args:
      past: the questions so far that were answered.
      left: answers of the budget that nothing else is wanted for.
      rng: chooses among one person's that have not been repeated, without the last few of all and of that person; among
        all people's where repeats are shared.
      answerer: who is asked, since only who answered a question can be consistent; None: whoever answered last.
      waiting: the numbers of the questions that those repeat which wait for other people.
    """
    done = {question.repeats for question in past} | set(waiting)
    if len(done - {None}) >= int(options.repeats * number + 1e-9) or left < 1:
        return None
    person = past[-1].answerer if past and answerer is None else answerer
    seen = [each.number for each in past if each.answerer == person]
    recent = {*seen[-LEAST_BETWEEN:], *(each.number for each in past[-LEAST_BETWEEN:])}
    suitable = [
        each
        for each in past
        if each.repeats is None and each.answer is not Answer.SKIP and each.number not in done | recent
        if options.shared_repeats or each.answerer == person
    ]
    return suitable[rng.integers(len(suitable))] if suitable else None


def still_waiting(queries: Sequence[Query], waiting: Sequence[Query]) -> list[Query]:
    """Those of the `waiting` questions that are the given ones, in the order of these.

    Raises:
      ValueError: one that is no question, is given twice, or does not wait: it was answered, or taken back.
    """
    if isinstance(queries, Query) or not isinstance(queries, Iterable):
        raise ValueError(f"queries: expected a list of questions as ask() returned it, got {queries!r}"[:200])
    known = {(query.number, query.first, query.second): query for query in waiting}
    found = []
    for query in queries:
        if not isinstance(query, Query):
            raise ValueError(f"queries: expected questions as ask() returned them, got {query!r}"[:200])
        same = known.pop((query.number, query.first, query.second), None)
        if same is None:
            raise ValueError(
                f"queries: expected questions that wait for an answer, each once, got number {query.number}, "
                f"where {', '.join(str(other.number) for other in waiting) or 'none'} waits"
            )
        found.append(same)
    return found


def opponents_from_the_same_start(
    trajectories: Sequence[Trajectory], preferences: Preferences, favourites: Sequence[int]
) -> dict[int, int]:
    """The opponent of each trajectory: another from the same start; no entry where there is none.

    That is the newest undominated one that was shown, else one of `favourites`, else the first.
    """
    chosen, standing = {}, preferences.undominated
    for group in same_starts(trajectories):
        members = set(group)
        ranked = [
            *(number for number in reversed(standing) if number in members),
            *(number for number in favourites if number in members),
            *group[:2],
        ]
        for number in group:
            rivals = [other for other in ranked if other != number]
            if rivals:
                chosen[number] = rivals[0]
    return chosen


def opponent_now(
    newcomer: int, opponents: Mapping[int, int], trajectories: Sequence[Trajectory], preferences: Preferences
) -> int:
    """The newcomer's opponent, the newest undominated trajectory where there are no `opponents`.

    One that another question of the iteration has beaten gives way to who is undominated from its start by then.
    """
    opponent = opponents[newcomer] if opponents else preferences.undominated[-1]
    if not preferences.has_fallen(opponent):
        return opponent
    group = next(group for group in same_starts(trajectories) if opponent in group)
    return next((each for each in reversed(preferences.undominated) if each in group and each != newcomer), opponent)


def rivals(query: Query, trajectories: Sequence[Trajectory], preferences: Preferences) -> list[int]:
    """The undominated trajectories from the start of both, which the newcomer competes with; else all of them."""
    both = {query.newcomer, query.incumbent}
    together = [group for group in same_starts(trajectories) if both <= set(group)]
    return [number for number in preferences.undominated if not together or number in together[0]]
