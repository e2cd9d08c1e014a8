"""The learner's state between two calls; the fold over the events makes each from the one before."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from bayespbrl.improvement.schedules import Bound
from bayespbrl.policies import Policy
from bayespbrl.preferences import PastQuestion, Preferences, Query
from bayespbrl.settings import Settings
from bayespbrl.trajectories import Trajectory, clips_of
from bayespbrl.utility.estimate import UtilityEstimate


@dataclass(frozen=True)
class NumberedPolicy:
    """A policy of the run.

    Attributes:
      number: of the iterations before it.
      policy: itself.
      tried: its trajectories without its noise, where updates are checked; () where there are none.
    """

    number: int
    policy: Policy
    tried: tuple[Trajectory, ...] = ()


@dataclass(frozen=True)
class Restart:
    """A restart of the policy.

    Attributes:
      iteration: iterations completed by then.
      kept: the policy that the run kept by then, or a restarted one that an answer confirmed since.
    """

    iteration: int
    kept: NumberedPolicy


@dataclass(frozen=True)
class LearnerState:
    """The learner's state between two calls.

    Attributes:
      first_policy: the one that a policy started anew begins with.
      newest: the policy that the next trajectories follow, unless the policy is started anew.
      best: where updates are checked, the policy that the posterior thinks best of those before the newest, since a
        restart if there was one; the first before the second update. The next update starts there after a step back.
      kept: the policy that the run keeps: the best or, if the posterior prefers it, the newest; after a restart that
        kept before it, unless one of these is clearly better.
      trust: share of the KL bound that the next update may use; it falls after a step back.
      restart: when the policy was started anew, and what was kept by then, or by an answer since; None: it was not.
      nominated: whether the newest policy, started anew, is to be asked about, because it may be better than that one.
      estimate: the last utility estimate; None before the first.
      bound: the last decision on the KL bound; None before the first.
      values: of each iteration's policy, by its number from 1, for reports alone.
      iteration: iterations completed.
      trajectories: all of them, by number.
      clips: first step and number of steps of the part of each that questions are about; () where they are about all.
      preferences: the answers so far.
      collected: whether the next iteration's trajectories are among them.
      candidates: trajectories to ask about in this iteration, best first.
      opponents: whom some of them are compared with; the newest undominated trajectory where it names none.
      information: what the answer about the first of them was expected to tell, nats; None where that is unknown.
      wanted: number of answers still wanted in this iteration.
      unasked: number of consecutive iterations, up to now, without a question.
      open: the questions that wait for an answer, in the order in which they were asked; where one person answers, one
        at most.
      queries: number of questions so far.
      past: the questions so far that were answered.
      shown: the trajectories that were shown in some question.
      summaries: one for each completed iteration.
      before: the states before the last answers, at most `MOST_UNDONE`, the newest last; they have none themselves.
    """

    first_policy: Policy
    newest: NumberedPolicy
    best: NumberedPolicy
    kept: NumberedPolicy
    trust: float = 1.0
    restart: Restart | None = None
    nominated: bool = False
    estimate: UtilityEstimate | None = None
    bound: Bound | None = None
    values: tuple[float, ...] = ()
    iteration: int = 0
    trajectories: tuple[Trajectory, ...] = ()
    clips: tuple[tuple[int, int], ...] = ()
    preferences: Preferences = field(default_factory=Preferences)
    collected: bool = False
    candidates: tuple[int, ...] = ()
    opponents: Mapping[int, int] = field(default_factory=dict)
    information: float | None = None
    wanted: int = 0
    unasked: int = 0
    open: tuple[Query, ...] = ()
    queries: int = 0
    past: tuple[PastQuestion, ...] = ()
    shown: frozenset[int] = frozenset()
    summaries: tuple[Mapping[str, Any], ...] = ()
    before: tuple["LearnerState", ...] = field(default=(), repr=False)

    @classmethod
    def begun(cls, policy: Policy) -> "LearnerState":
        """Before the first event, with the first policy."""
        first = NumberedPolicy(0, policy)
        return cls(policy, first, first, first)

    def finished(self, settings: Settings) -> bool:
        """Whether a run with these settings ends here: after an iteration, not within one.

        Decision: not before the nominated policy was asked about, if an answer is left; as often as answers are for it.
        """
        done, last = (self.iteration, self.preferences.answers, self.unasked), settings.last_iteration(self.started)
        waits = self.nominated and self.left(settings) > 0 and self.iteration < last + settings.confirmations
        return not self.collected and not waits and settings.finished(*done, self.started)

    def left(self, settings: Settings) -> float:
        """How many answers the budget of a run with these settings has left; infinity without one."""
        return settings.questions.left(self.preferences.answers)

    def in_last_iteration(self, settings: Settings) -> bool:
        """Whether no iteration follows the one that is begun or about to begin, unless a policy is nominated then."""
        return self.iteration + 1 >= settings.last_iteration(self.started)

    def restarts(self, settings: Settings) -> bool:
        """Whether the next trajectories follow the first policy again."""
        return self.restart is None and settings.restarts(self.iteration, self.preferences.answers, self.unasked)

    def may_answer(self, query: Query, person: str | None, settings: Settings) -> bool:
        """Whether a person, None without a name, may answer: a repeat is for whoever answered the question before.

        Someone without a name may answer each, and anybody where repeats are shared.
        """
        if query.repeats is None or person is None or settings.questions.shared_repeats:
            return True
        return any(past.number == query.repeats and past.answerer == person for past in self.past)

    def waiting(self, settings: Settings, person: str | None = None) -> list[Query]:
        """The open questions that a person may answer, no more than the budget has answers left; None: anybody."""
        left = 0 if self.finished(settings) else self.left(settings)
        theirs = [query for query in self.open if self.may_answer(query, person, settings)]
        return [query for place, query in enumerate(theirs) if place < left]

    def may_undo(self, person: str | None) -> bool:
        """Whether the last answer can be taken back, and is this person's, None without a name."""
        return bool(self.before) and self.past[-1].answerer == person

    @property
    def started(self) -> int:
        """Iterations completed when the present policy was started."""
        return 0 if self.restart is None else self.restart.iteration

    @property
    def to_beat(self) -> NumberedPolicy:
        """What the newest policy is compared with: the best before it, or what was kept when it was started anew."""
        return self.best if self.restart is None else self.restart.kept

    @property
    def query(self) -> Query | None:
        """The question that has waited longest for an answer; None if none does."""
        return self.open[0] if self.open else None

    @property
    def newcomers(self) -> list[int]:
        """The candidates that no open question compares with their opponents."""
        taken = [{query.first, query.second} for query in self.open]
        taken += [{past.first, past.second} for past in self.past if self.opponents]  # also of each other
        standing = self.preferences.undominated
        # an opponent of this iteration that is now undominated would compete with itself
        left = set(self.candidates).difference(standing, (query.newcomer for query in self.open))
        pairs = {number: {number, self.opponents.get(number, *standing[-1:])} for number in self.candidates}
        return [number for number, pair in pairs.items() if number in left and pair not in taken]

    @property
    def previous(self) -> "LearnerState | None":
        """The state before the last answer; None where no answer can be taken back."""
        return replace(self.before[-1], before=self.before[:-1]) if self.before else None

    @property
    def compared(self) -> tuple[Trajectory, ...]:
        """What questions are about, by the numbers of the trajectories: the trajectories, or a part of each."""
        return clips_of(self.trajectories, self.clips or None)
