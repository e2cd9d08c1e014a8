"""The learner: asks, takes answers, and moves through the cycle in between."""

import time
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from bayespbrl import checks, events, questions
from bayespbrl.cycle import Cycle
from bayespbrl.envs import opening
from bayespbrl.envs.opening import AnyEnvironment
from bayespbrl.events import Entry, LearnerState, Log
from bayespbrl.experts import Expert
from bayespbrl.features import FeatureSource, StateFeatures
from bayespbrl.improvement import schedules
from bayespbrl.policies import Policy, Sampler, greedy, has_mode
from bayespbrl.policies.actor import Actor
from bayespbrl.policies.choice import expected_policy, fitting, initial_policy
from bayespbrl.preferences import Answer, Preferences, Query, parse_answer
from bayespbrl.queries import QUERY_RULES, QueryRule
from bayespbrl.settings import Settings, Task, settings_for
from bayespbrl.trajectories import Trajectory, same_starts
from bayespbrl.utility.estimate import UtilityEstimate

if TYPE_CHECKING:
    from bayespbrl.people.widget import ComparisonWidget

VAIN_UNDOS = 10  # in a row: a person may press the key twice, a function would go on for ever


class Learner:
    """Learns a policy from answers to "which of these two trajectories is better?".

    `ask()` returns the questions that wait for an answer, `tell(answers)` moves on; `run(expert)` is a loop over the
    two. Every event is appended to a log first, and the state is a fold over that log.

    Args:
      env: a short name (`gridworld`, …) or a gymnasium id, with arguments (`FrozenLake-v1,is_slippery=False`) or
        without, or an environment.
      features: φ of your own, from observations (N, S) to (N, D), in any units; None: drawn as the settings say.
      policy: a kind of policy by name, or a first policy of your own, where the updates start; it is not kept itself.
      schedule: of the KL bound by name, or one of your own (`bayespbrl.improvement.schedules`).
      query: the rule for questions by name, or one of your own (`bayespbrl.queries`).
      entries: events of a run to continue.
      kept: the settings of that run, which hold then as they are.
      **options: any option of `Settings` or its parts by its own name, such as `answers=12`; the preset gives the
        others, and None is a value like any other. `learner.settings.options()` has all of them with their values.

    Raises:
      ValueError: an unknown environment or option, a value out of range, or no time limit known.
    """

    def __init__(
        self,
        env: AnyEnvironment,
        *,
        features: StateFeatures | None = None,
        policy: Policy | str | None = None,
        schedule: schedules.Schedule | str | None = None,
        query: QueryRule | str | None = None,
        entries: Iterable[Entry] = (),
        kept: Settings | None = None,
        **options: Any,
    ):
        self.environment = opening.open_environment(env)
        self.given = env if isinstance(env, gymnasium.Env) else opening.as_given(self.environment)
        for name, given in (("features", features), ("schedule", schedule), ("query", query)):
            if given is not None and (name == "features" or not isinstance(given, str)):
                checks.function(name, given, "" if name == "features" else " or a name")
        if policy is not None and (isinstance(policy, type) or not isinstance(policy, str | Policy)):
            raise ValueError(f"policy: expected {expected_policy(policy)}")
        if "environment" in options:
            raise ValueError(
                f"environment: expected the environment as env only, got environment={options['environment']!r} too"
            )
        own_policy = None if policy is None or isinstance(policy, str) else policy
        how = "named" if kept is not None else opening.reopened(env)
        own = {
            "policy": policy if own_policy is None else "other",
            "features": None if features is None else "other",
            "environment": None if how == "named" else how,
            "schedule": "other" if callable(schedule) else schedule,
            "query": "other" if callable(query) else query,
            "noise_free": None if own_policy is None or has_mode(own_policy) else False,
        }
        self.settings: Settings = kept or settings_for(
            env if isinstance(env, str) else opening.environment_name(self.environment),
            task=Task.of(self.environment, options.get("max_steps")),
            **{name: value for name, value in own.items() if value is not None} | options,
        )
        self.features = features
        period = opening.environment_attribute(self.environment, "observation_period")
        spaces = (self.environment.observation_space, self.environment.action_space)
        self.cycle = Cycle(
            self.settings,
            self.environment,
            FeatureSource(*spaces, period, features),
            checks.function_or_name("schedule", schedule, self.settings.update.schedule, schedules.SCHEDULES),
            checks.function_or_name("query", query, self.settings.questions.query, QUERY_RULES),
        )
        self.log: Log | None = None
        noise_free = kept is None and self.settings.rollouts.noise_free
        self.own_policy = None if own_policy is None else fitting(own_policy, *spaces, noise_free=noise_free)
        first, rollouts = self.own_policy, self.settings.rollouts
        if first is None:  # a random one
            first = initial_policy(rollouts.policy, *spaces, action_scale=rollouts.initial_action_scale, period=period)
        self.state = events.replay(LearnerState.begun(first), entries)

    def logged(self, log: Log) -> "Learner":
        """The same learner, with each further event appended to `log`."""
        self.log = log
        return self

    # What a user reads off.

    @property
    def finished(self) -> bool:
        """Whether the run has ended: all iterations are completed, or further ones are not expected to help."""
        return self.state.finished(self.settings)

    @property
    def policy(self) -> Sampler:
        """The best policy by the posterior, without its noise; the newest, with it, where updates are not checked.

        It takes and gives plain rows of numbers, as all policies do; `actor` acts in the environment.
        One that was started anew replaces the policy before it only where it is clearly better.
        """
        tried, kept = self.state.newest.tried or self.state.restart is not None, self.state.kept.policy
        return greedy(kept) if tried else kept

    @property
    def last_policy(self) -> Policy:
        """The newest policy, which the next trajectories follow."""
        return self.state.newest.policy

    def actor(self, policy: Sampler | None = None) -> Actor:
        """`policy`, or None: `self.policy`, in the environment as it was given: `learner.actor().act(observation)`."""
        chosen, given = self.policy if policy is None else policy, self.given
        return Actor(chosen, given.observation_space, given.action_space, np.random.default_rng())

    @property
    def worth_asking(self) -> float | None:
        """What the answer to the best question of the last iteration was expected to tell, in bits: at most one.

        Near zero, this answer would change little. Ties are left out of account, except with `informative_ties` while
        all answers are (at most log₂ 3). None before an estimate, without a posterior, and with no answer left.
        """
        return None if self.state.information is None else self.state.information / np.log(2)

    @property
    def comparable_starts(self) -> bool | None:
        """Whether resets with equal seeds start alike, so that trajectories from one start can be compared.

        None before the first trajectories, and where the run does not compare by start.
        """
        number = self.settings.rollouts.trajectories_per_iteration
        if not self.settings.questions.same_start or not self.state.trajectories:
            return None
        return len(same_starts(self.state.trajectories[:number])) < number

    @property
    def estimate(self) -> UtilityEstimate | None:
        """The last utility estimate; None before the first."""
        return self.state.estimate

    @property
    def preferences(self) -> Preferences:
        """All answers so far, as ordered pairs and ties."""
        return self.state.preferences

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """All trajectories so far, by their numbers."""
        return self.state.trajectories

    @property
    def iterations(self) -> list[dict[str, Any]]:
        """One summary for each completed iteration."""
        return [dict(summary) for summary in self.state.summaries]

    # Ask and tell.

    def ask(self, *, answerer: str | None = None) -> list[Query]:
        """The question that waits for an answer, after doing whatever comes before it; empty when finished.

        There is one at a time: each answer may decide what the next trajectory is compared with. Where several
        people answered at once, all questions that they left wait, as far as the budget goes. With `answerer`,
        the name of who answers next, it is one that they may answer: another person's repeated question stays open.
        """
        if answerer is not None:
            query = self._question_for(checks.short_name("answerer", answerer))
            return [] if query is None else [query]
        self._advance()
        return self.state.waiting(self.settings)

    def tell(
        self,
        answers: Sequence[Answer | str],
        *,
        queries: Sequence[Query] | None = None,
        answerer: str | None = None,
        seconds: float | None = None,
    ) -> None:
        """Take in the answer to the question that waits, and move on as far as possible without another.

        Args:
          answers: one, to the question that `ask` returned.
          queries: the questions that are answered, as `ask` returned them; None: those that wait now, which nobody need
            have seen. Where several people or programs answer, these keep an answer from another's question.
          answerer: name of who gave it, whom `ask` was told; at most 64 characters. Each of several has a lapse rate.
          seconds: how long they took, which is kept beside the answer.

        Raises:
          ValueError: an answer that is none, not as many answers as questions, a question that no longer waits, or a
            bad name or time; nothing has happened then. Or what follows the answer fails, as the environment may: the
            answer is kept, and `ask` tries again.
        """
        answered = self.state.waiting(self.settings, answerer)
        if queries is not None:
            answered = questions.still_waiting(queries, answered)
        elif answerer is not None and isinstance(answers, Sequence) and len(answers) == 1:
            answered = answered[:1]
        self._take_in(answered, answers, answerer, seconds)
        self._advance()

    def _take_in(
        self, waiting: Sequence[Query], answers: Sequence[Answer | str], answerer: str | None, seconds: float | None
    ) -> None:
        if isinstance(answers, str) or not isinstance(answers, Sequence) or len(answers) != len(waiting):
            by = "ask()" if answerer is None else f"ask(answerer={answerer!r})"
            none = "" if waiting else " (no question waits)"
            expected = f"a list of {len(waiting)} answers, one to each of {by}{none}"
            raise ValueError(f"tell: expected {expected}, got {answers!r}")
        parsed = [parse_answer(answer) for answer in answers]
        if Answer.UNDO in parsed and len(parsed) > 1:
            raise ValueError(
                f"tell: expected undo() while several questions wait, got an undo among the answers {answers!r}"
            )
        entries = [
            events.answered(query.number, answer, answerer=answerer, seconds=seconds)
            for query, answer in zip(waiting, parsed, strict=True)
        ]
        for entry, answer in zip(entries, parsed, strict=True):
            if answer is Answer.UNDO:
                self.undo(answerer=answerer)
            else:
                self.record(entry)

    def undo(self, *, answerer: str | None = None) -> None:
        """Take the last answer back, whoever gave it, and what followed from it; its question waits again.

        Args:
          answerer: who takes it back, which is kept.

        Raises:
          ValueError: nothing has been answered yet, the last 50 answers were taken back already, or a bad name.
        """
        self.record(events.undone(answerer))

    def run(
        self,
        expert: Expert,
        *,
        answerer: str | None = None,
        progress: Callable[["Learner"], None] | None = None,
    ) -> "Learner":
        """Answer all questions by `expert` until the run ends.

        Args:
          expert: called with the two trajectories in the order shown. Where it returns an undo, the last answer is
            taken back if it is the same person's.
          answerer: the name of a person who answers; how long each answer took is then kept too, `expert.seconds` where
            there is such an attribute. A repeated question that waits for another person is left open.
          progress: called after each iteration, those that ask nothing among them.
        """
        checks.function("expert", expert, " of two trajectories")
        checks.optional(checks.function, "progress", progress, of=" of the learner")
        checks.optional(checks.short_name, "answerer", answerer)
        self._advance(progress)
        vain = 0
        while (query := self._question_for(answerer, progress)) is not None:
            began = time.perf_counter()
            answer = parse_answer(expert(*query.trajectories))
            elapsed, own = time.perf_counter() - began, getattr(expert, "seconds", None)
            seconds = None if answerer is None else own if isinstance(own, float) else elapsed
            vain = vain + 1 if answer is Answer.UNDO and not self.state.may_undo(answerer) else 0
            if vain == VAIN_UNDOS:
                raise ValueError(f"expert: expected an answer, because there is none to take back, got {vain} undos")
            if not vain:  # else the same question again
                self._take_in([query], [answer], answerer, seconds)
                self._advance(progress)
        return self

    def _question_for(self, answerer: str | None, progress: Callable[["Learner"], None] | None = None) -> Query | None:
        """The question for a person, asked if need be; None when finished."""
        while not self.finished:
            if waiting := self.state.waiting(self.settings, answerer):
                return waiting[0]
            entry = self.cycle.next(self.state, answerer, others=0)  # past the questions of others
            if entry is None:
                return None
            self._append(entry, progress)
        return None

    def widget(
        self, *, answers: int | None = None, answerer: str | None = None, practice: bool = True
    ) -> "ComparisonWidget":
        """A notebook widget that asks a person the learner's questions; needs the extra `people`.

        Answers are told and questions asked in the background: cells stay free. `widget.close()` ends it; until then
        the learner must not be told anything else, and no other process can continue the run. A second call closes
        the widget of the first.

        Args:
          answers: most answers of this sitting; None: as many as the run takes.
          answerer: the person's name, kept beside the answers.
          practice: whether instructions and two practice questions come first, for a person new to this run.

        Raises:
          ValueError: the extra is not installed; a bad number or name; a finished run, one that another process
            continues, or one to which another learner has written.
        """
        try:
            from bayespbrl.people.widget import ComparisonWidget  # here, since people stand above the learner
        except ImportError as error:
            raise ValueError(f"widget: expected the extra people (pip install '.[people]'), got {error}") from error
        return ComparisonWidget(self, most_answers=answers, answerer=answerer, practice=practice)

    def _advance(self, progress: Callable[["Learner"], None] | None = None) -> None:
        """Do what can be done without an answer; `progress` is called after each iteration."""
        while (entry := self.cycle.next(self.state)) is not None:
            self._append(entry, progress)

    def _append(self, entry: Entry, progress: Callable[["Learner"], None] | None) -> None:
        self.record(entry)
        if progress is not None and entry.event["event"] == "improved":
            progress(self)

    def record(self, entry: Entry) -> None:
        """Append an event to the log first, then move on: what the learner knows is never ahead of what is kept.

        Raises:
          ValueError: an event that cannot follow; nothing has happened then.
        """
        state = events.apply(self.state, entry)
        if self.log is not None:
            self.log.append(entry, state)
        self.state = state
