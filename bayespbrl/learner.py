"""The learner: orders the four steps of the cycle (paper, "Online Preference-Based Reinforcement Learning")."""

import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import gymnasium
import jax
import numpy as np

from bayespbrl import events, queries, rollouts
from bayespbrl.envs.opening import as_given, environment_attribute, environment_name, given_by_name
from bayespbrl.events import Entry, LearnerState, Log
from bayespbrl.experts import Expert
from bayespbrl.features import FeatureSource, StateFeatures
from bayespbrl.improvement import schedules
from bayespbrl.improvement.problem import UpdateProblem, states_of_update, step_utilities
from bayespbrl.improvement.schedules import Bound, Situation
from bayespbrl.improvement.update import Improvement, apply_update, propose
from bayespbrl.policies.choice import initial_policy
from bayespbrl.preferences import Answer, Preferences, Query, parse_answer
from bayespbrl.queries import QuerySituation
from bayespbrl.settings import Settings, settings_for
from bayespbrl.trajectories import Trajectory, Transitions, transitions
from bayespbrl.utility.comparisons import Comparisons
from bayespbrl.utility.estimate import UtilityEstimate
from bayespbrl.utility.inference import estimate

# Each random choice has a stream of its own, named by (seed, purpose, count): what is redone comes out the same.
COLLECT, CHOOSE, SHOW, FEATURES, FIT, IMPROVE, EVALUATE, VISITED = range(8)
# Posterior draws that a schedule looks at. Each costs a column of LSTD; the spread of a gain is known to a tenth.
SCHEDULE_DRAWS = 100


class Learner:
    """Learns a policy from answers to "which of these two trajectories is better?".

    `ask()` returns the questions that wait for an answer, `tell(answers)` moves on; `run(expert)` is a loop over the
    two. Every event is appended to a log first, and the state is a fold over that log.

    Args:
      env: a short name (`gridworld`, …), a gymnasium id, or an environment.
      features: φ of your own, from observations (N, S) to (N, D); None: drawn as the settings say.
      policy: a kind of policy by name, or a first policy of your own.
      schedule: of the KL bound by name, or one of your own (`bayespbrl.improvement.schedules`).
      query: the rule for questions by name, or one of your own (`bayespbrl.queries`).
      entries: events of a run to continue.
      kept: the settings of that run, which hold then as they are.
      **options: those of `Settings`, named alone, over the preset of the environment.

    Raises:
      ValueError: an unknown environment or option, a value out of range, or no time limit known.
    """

    def __init__(
        self,
        env: Any,
        *,
        features: StateFeatures | None = None,
        policy: Any = None,
        schedule: schedules.Schedule | str | None = None,
        query: queries.QueryRule | str | None = None,
        entries: Iterable[Entry] = (),
        kept: Settings | None = None,
        **options: Any,
    ):
        self.environment = rollouts.open_environment(env)
        self.given = env if isinstance(env, gymnasium.Env) else as_given(self.environment)
        if "environment" in options:
            raise ValueError("settings: expected env alone to say which environment, got environment too")
        own_policy = None if policy is None or isinstance(policy, str) else policy
        self.settings: Settings = kept or settings_for(
            env if isinstance(env, str) else environment_name(self.environment),
            policy=policy if own_policy is None else "other",
            features=None if features is None else "other",
            environment=None if given_by_name(env) else "other",
            schedule="other" if callable(schedule) else schedule,
            query="other" if callable(query) else query,
            **options,
        )
        rollouts.step_limit(self.environment, self.settings.rollouts.max_steps)  # an error now, not at the first step
        self.features = features
        period = environment_attribute(self.environment, "observation_period")
        spaces = (self.environment.observation_space, self.environment.action_space)
        self.feature_source = FeatureSource(*spaces, period, features)
        self.schedule = _chosen("schedule", schedule, self.settings.update.schedule, schedules.SCHEDULES)
        self.query_rule = _chosen("query", query, self.settings.questions.query, queries.QUERY_RULES)
        self.log: Log | None = None
        if own_policy is None:
            own_policy = initial_policy(
                self.settings.rollouts.policy,
                *spaces,
                action_scale=self.settings.rollouts.initial_action_scale,
                period=period,
            )
        self.state = events.replay(LearnerState(own_policy), entries)

    def logged(self, log: Log) -> "Learner":
        """The same learner, which from now on appends what happens to `log`."""
        self.log = log
        return self

    # What a user reads off.

    @property
    def finished(self) -> bool:
        """Whether all iterations are completed."""
        return self.state.iteration >= self.settings.iterations

    @property
    def policy(self) -> Any:
        return self.state.policy

    @property
    def estimate(self) -> UtilityEstimate | None:
        """The last utility estimate; None before the first."""
        return self.state.estimate

    @property
    def preferences(self) -> Preferences:
        return self.state.preferences

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        return self.state.trajectories

    @property
    def iterations(self) -> list[dict[str, Any]]:
        """One summary for each completed iteration."""
        return [dict(summary) for summary in self.state.summaries]

    # Ask and tell.

    def ask(self) -> list[Query]:
        """The question that waits for an answer, after doing whatever comes before it; empty when finished.

        Each new trajectory is compared with the best of all before it, so there is one question at a time.
        """
        self._advance()
        return self._waiting()

    def tell(self, answers: Sequence[Answer | str]) -> None:
        """Take in the answer to the question that waits, and move on as far as possible without another.

        Raises:
          ValueError: an answer that is none, or not as many answers as questions; nothing has happened then.
        """
        self._take_in(answers)
        self._advance()

    def _take_in(self, answers: Sequence[Answer | str]) -> None:
        waiting = self._waiting()
        if isinstance(answers, str) or not isinstance(answers, Sequence) or len(answers) != len(waiting):
            raise ValueError(f"tell: expected a list of {len(waiting)} answers, one a question, got {answers!r}")
        for query, answer in zip(waiting, map(parse_answer, answers), strict=True):
            if answer is Answer.UNDO:
                self.undo()
            else:
                self._record({"event": "answered", "query": query.number, "answer": str(answer)})

    def undo(self) -> None:
        """Take the last answer back, and what followed from it; its question waits again.

        Raises:
          ValueError: nothing has been answered yet.
        """
        self._record({"event": "undone"})

    def run(self, expert: Expert, *, progress: Callable[["Learner"], None] | None = None) -> "Learner":
        """Ask `expert` until all iterations are completed.

        Args:
          expert: called with the two trajectories in the order shown.
          progress: called after each iteration, those that ask nothing among them.
        """
        self._advance(progress)
        while questions := self._waiting():
            answers = [parse_answer(expert(*query.trajectories)) for query in questions]
            if answers == [Answer.UNDO] and self.state.previous is None:
                continue  # nothing to take back: the same question again
            self._take_in(answers)
            self._advance(progress)
        return self

    def _waiting(self) -> list[Query]:
        return [] if self.state.query is None else [self.state.query]

    # The four steps.

    def _advance(self, progress: Callable[["Learner"], None] | None = None) -> None:
        """Do what can be done without an answer; `progress` is called after each iteration."""
        while self.state.query is None and not self.finished:
            if not self.state.collected:
                self._collect()
            elif self.state.wanted and self.state.candidates:
                self._show()
            else:
                self._improve()
                if progress is not None:
                    progress(self)

    def _collect(self) -> None:
        """Steps 3 and 4: new trajectories, and which of them to ask about."""
        state, options, questions = self.state, self.settings.rollouts, self.settings.questions
        began = time.perf_counter()
        collected = rollouts.rollout(
            self.environment,
            state.policy,
            key=self._key(COLLECT, state.iteration),
            episodes=options.trajectories_per_iteration,
            max_steps=options.max_steps,
            hold=options.exploration_hold,
        )
        new = range(len(state.trajectories), len(state.trajectories) + len(collected))
        signal = None if state.bound is None else state.bound.signal
        rng = self._rng(CHOOSE, state.iteration)
        wanted, candidates = 0, tuple[int, ...]()
        if state.estimate is None:
            wanted, candidates = questions.first_queries, queries.random_candidates(new, rng=rng)
        elif not questions.skips(state.preferences, state.unasked, state.estimate, signal):
            known, best = (*state.trajectories, *collected), state.preferences.undominated[-1]
            situation = QuerySituation(new, known, state.shown, best, state.estimate, signal, rng)
            wanted, candidates = questions.queries_per_iteration, queries.candidates(self.query_rule, situation)
        event = {
            "event": "collected",
            "iteration": state.iteration + 1,
            "candidates": list(candidates),
            "wanted": wanted,
            "seconds": time.perf_counter() - began,
        }
        self._record(event, trajectories=collected)

    def _show(self) -> None:
        """Step 4: the next question, the best candidate against the newest of the undominated."""
        state = self.state
        number = state.queries + 1
        newcomer, incumbent = state.candidates[0], state.preferences.undominated[-1]
        query = queries.show(number, newcomer, incumbent, state.trajectories, rng=self._rng(SHOW, number))
        self._record(
            {"event": "asked", "query": number, "first": query.first, "second": query.second, "newcomer": newcomer}
        )

    def _improve(self) -> None:
        """Steps 1 and 2, and the value of the new policy, which the learner does not see."""
        state, options = self.state, self.settings.rollouts
        clock = [time.perf_counter()]
        utility = self._estimate()
        clock.append(time.perf_counter())
        improved, bound = self._update(utility, transitions(state.trajectories))
        clock.append(time.perf_counter())
        evaluated = rollouts.returns(
            self.environment,
            improved.policy,
            key=self._key(EVALUATE, 0),
            episodes=options.evaluation_episodes,
            max_steps=options.max_steps,
        )
        clock.append(time.perf_counter())
        seconds = dict(zip(("utility", "improvement", "evaluation"), np.diff(clock).tolist(), strict=True))
        summary = {
            "iteration": state.iteration + 1,
            "answers": state.preferences.answers,
            "value": float(evaluated.total.mean()),
            "terminated": float(evaluated.terminated.mean()),  # a share of the episodes
            **utility.quality.summary(),
            **improved.summary(),
            "seconds": seconds,
            "schedule": bound.summary(),
            "hyperparameters": utility.hyperparameters(),
        }
        self._record(
            {"event": "improved", "iteration": state.iteration + 1, "summary": summary},
            trajectories=state.trajectories[-options.trajectories_per_iteration :],
            policy=improved.policy,
            estimate=utility,
        )

    def _estimate(self) -> UtilityEstimate:
        """Step 1."""
        state, settings = self.state, self.settings
        rng = self._rng(FEATURES, 2 * state.iteration)
        pairs, ties = state.preferences.pairs, state.preferences.ties
        return estimate(
            Comparisons.among(state.trajectories, pairs, ties=ties, discount=settings.trajectory_discount),
            self.feature_source.of_states(state.trajectories, settings.features.of_utility, rng=rng),
            settings.estimation,
            settings.model,
            seed=int(self._rng(FIT, state.iteration).integers(2**31)),
        )

    def _update(self, utility: UtilityEstimate, steps: Transitions) -> tuple[Improvement, Bound]:
        """Step 2: an update is proposed, the schedule decides on its bound, the update is applied."""
        settings, iteration = self.settings, self.state.iteration
        rng, key = self._rng(FEATURES, 2 * iteration + 1), self._key(IMPROVE, iteration)
        state_action_features = self.feature_source.of_steps(steps, settings.features.of_critic, rng=rng)
        constant = isinstance(self.schedule, schedules.ConstantBound)  # looks at no draws
        utilities, draws = step_utilities(utility, steps, draws=0 if constant else SCHEDULE_DRAWS)
        problem = UpdateProblem(
            steps,
            utilities,
            states_of_update(
                self.state.trajectories,
                settings.update,
                an_iteration=settings.rollouts.trajectories_per_iteration,
                rng=self._rng(VISITED, iteration),
            ),
            settings.critic,
            state_action_features,
            self.feature_source.of_states(self.state.trajectories, settings.features.of_critic, rng=rng),
            self.environment.action_space,
        )
        proposed = propose(self.state.policy, problem, key=key, utility_draws=draws)
        usual, answers = settings.update.kl_bound, self.state.preferences.answers
        bound = schedules.decide(self.schedule, Situation(iteration + 1, answers, usual, utility, proposed))
        improved = apply_update(
            proposed,
            bound.kl_bound,
            key=key,
            rng=self._rng(IMPROVE, iteration),
            updates=settings.update.updates_per_iteration,
        )
        return improved, bound

    # Memory and chance.

    def _record(self, event: dict[str, Any], **parts: Any) -> None:
        """Append to the log first, then move on: what the learner knows is never ahead of what is kept."""
        entry = Entry(events.plain(event), parts)
        state = events.apply(self.state, entry)
        if self.log is not None:
            self.log.append(entry, state)
        self.state = state

    def _rng(self, purpose: int, count: int) -> np.random.Generator:
        return np.random.default_rng([self.settings.seed, purpose, count])

    def _key(self, purpose: int, count: int) -> jax.Array:
        return jax.random.key(int(self._rng(purpose, count).integers(2**31)))


def _chosen(option: str, given: Any, name: str, known: Any) -> Any:
    """The schedule or query rule: the user's own, or the known one of that name."""
    if callable(given):
        return given
    if name not in known:
        raise ValueError(f"{option}: expected a function of the user's own beside {name!r}, got none")
    return known[name]
