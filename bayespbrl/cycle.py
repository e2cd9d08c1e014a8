"""The cycle: the four steps in their order (paper, "Online Preference-Based Reinforcement Learning").

Each method takes what the learner knows and returns the next event; none changes anything.
"""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bayespbrl import events, queries, questions
from bayespbrl.collection import CHOOSE, CLIPS, FEATURES, FIT, IMPROVE, REPEAT, SHOW, VISITED, Collection
from bayespbrl.envs.stepping import step_limit
from bayespbrl.events import Entry, LearnerState, Restart
from bayespbrl.experts import SIMULATED
from bayespbrl.features import FeatureSource
from bayespbrl.improvement import schedules
from bayespbrl.improvement.check import CLEARLY, POSSIBLY, Check, checked, judged, median_differences, share_better
from bayespbrl.improvement.problem import UpdateProblem, quarters, recent, states_of_update, step_utilities
from bayespbrl.improvement.schedules import Bound, Situation
from bayespbrl.improvement.update import Improvement, apply_update, propose
from bayespbrl.models.threads import one_blas_thread
from bayespbrl.policies import greedy
from bayespbrl.preferences import Answer
from bayespbrl.queries import QuerySituation
from bayespbrl.questions import opponent_now, opponents_from_the_same_start, rivals
from bayespbrl.trajectories import Trajectory, clips_of, transitions
from bayespbrl.utility.comparisons import Comparisons
from bayespbrl.utility.estimate import UtilityEstimate
from bayespbrl.utility.inference import estimate

# Posterior draws that a schedule looks at. Each costs a column of LSTD; the spread of a gain is known to a tenth.
SCHEDULE_DRAWS = 100


@dataclass(frozen=True)
class Cycle(Collection):
    """The parts that stay the same over a run.

    Attributes:
      feature_source: draws the features.
      schedule, query_rule: of the KL bound, and of the questions.
    """

    feature_source: FeatureSource
    schedule: schedules.Schedule
    query_rule: queries.QueryRule

    def __post_init__(self) -> None:
        steps, options = self.settings.questions.clip_steps, self.settings.rollouts
        if steps is not None and steps > (limit := step_limit(self.environment, options.max_steps)):
            raise ValueError(f"clip_steps: expected at most {limit}, the steps of an episode, got {steps}")
        self.feature_source.check(self.settings.features.of_utility)

    @one_blas_thread()
    def next(self, state: LearnerState, answerer: str | None = None, *, others: int | None = None) -> Entry | None:
        """What happens next without an answer; None where a question waits for one, or the run is finished.

        Where several people answer at once, each answer is followed by what would follow it if nobody else were there:
        the iteration goes on while the others look at their questions, so that nobody waits for another.

        Args:
          answerer: of several people, one without a question, who is asked next.
          others: at how many questions the others are looking; None: only one person answers. No more is asked than
            the budget has left, and in the last iteration no more than it wants, which ends when they have answered.
            Then the result is None too.
        """
        left = state.left(self.settings)
        if state.finished(self.settings) or (others is None and state.open and left > 0):
            return None
        if not state.collected:
            return self.collect(state)
        newcomers = state.newcomers
        last = state.in_last_iteration(self.settings)
        if not state.wanted or left <= 0 or not (newcomers or others):
            return None if last and others else self.improve(state)
        if others and (not newcomers or others >= (min(left, state.wanted) if last else left)):
            return None
        return self.show(state, answerer)

    def collect(self, state: LearnerState) -> Entry:
        """Steps 3 and 4: new trajectories, and which of them to ask about; `collected`."""
        began, restarted = time.perf_counter(), state.restarts(self.settings)
        collected = self._collected(state, state.first_policy if restarted else state.newest.policy)
        clips = self.settings.questions.clips(collected, rng=self._rng(CLIPS, state.iteration))
        known = (*state.compared, *clips_of(collected, clips))
        chosen = self._chosen_questions(state, known)
        event = {
            "event": "collected",
            "iteration": state.iteration + 1,
            **{name: value for name, value in vars(chosen).items() if value is not None},
            **({} if clips is None else {"clips": clips}),
            **({"restarted": True} if restarted else {}),
            "seconds": time.perf_counter() - began,
        }
        return _entry(event, trajectories=collected)

    def _chosen_questions(self, state: LearnerState, known: Sequence[Trajectory]) -> questions.Chosen:
        options, rng = self.settings.questions, self._rng(CHOOSE, state.iteration)
        favourite = self._favourite(state)
        new, best = range(len(state.trajectories), len(known)), self._of_iteration(favourite)
        opponents = opponents_from_the_same_start(known, state.preferences, best) if options.same_start else {}
        standing = state.preferences.undominated
        if state.estimate is None or not standing:  # none: all were skipped
            return questions.first_questions(new, opponents, options, rng=rng)
        signal = None if state.bound is None else state.bound.signal
        silent = self._without_noise(state) and not state.restarts(self.settings)
        if options.against_kept and silent and favourite > 0:  # the first policy without noise does the same everywhere
            opponents |= {new[-1]: new[-2]}
        given = QuerySituation(
            new,
            known,
            state.shown,
            standing[-1],
            state.estimate,
            signal,
            rng,
            opponents,
            standing,
            noise_free=new[-1] if silent else None,
        )
        if self._nominated(state):
            return questions.confirmation(given, options, state.preferences)
        if options.answers is not None:
            options = replace(options, answers=options.answers - self.settings.confirmations)
        return questions.later_questions(self.query_rule, given, options, state.preferences, unasked=state.unasked)

    def _duels(self, state: LearnerState) -> bool:
        """Whether the last two trajectories of the iteration are of two policies that are compared without noise."""
        compared = self.settings.questions.against_kept and self.settings.rollouts.noise_free
        return compared and state.iteration > state.started and self._favourite(state) > 0

    def _nominated(self, state: LearnerState) -> bool:
        """Whether the restarted policy is to be asked about now: it may be better than the kept one.

        Decision: late, because it still learns: with two answers left in the last four iterations, with one in two.
        """
        remaining = self.settings.last_iteration(state.started) - state.iteration
        return state.nominated and remaining <= 2 * state.left(self.settings)

    def _favourite(self, state: LearnerState) -> int:
        """The iteration that followed the policy to beat; of one that was replaced at a restart, the last before."""
        number = state.to_beat.number
        return number - 1 if state.restart is not None and number == state.started else number

    def _of_iteration(self, number: int) -> range:
        """The numbers of the trajectories of an iteration, from 0."""
        each = self.settings.rollouts.trajectories_per_iteration
        return range(number * each, (number + 1) * each)

    def show(self, state: LearnerState, answerer: str | None = None) -> Entry:
        """Step 4: the next question, the best candidate against its opponent, or a repeated one; `asked`."""
        number, newcomer, options = state.queries + 1, state.newcomers[0], self.settings.questions
        left = options.left(state.preferences.answers + state.wanted + len(state.open))
        rng, who = self._rng(REPEAT, number), {} if answerer is None else {"answerer": answerer}
        waiting = [each.repeats for each in state.open]
        again = questions.repeated(state.past, number, options, left=left, rng=rng, answerer=answerer, waiting=waiting)
        if again is not None:
            shown = {"first": again.second, "second": again.first, "newcomer": again.newcomer}
            return _entry({"event": "asked", "query": number, **shown, "repeats": again.number, **who})
        preferences = state.preferences
        duel = self._duels(state) and state.opponents.get(newcomer) == newcomer - 1 == len(state.trajectories) - 2
        given = state.opponents if options.same_start or duel else {}
        incumbent = given[newcomer] if duel else opponent_now(newcomer, given, state.trajectories, preferences)
        query = queries.show(number, newcomer, incumbent, state.compared, rng=self._rng(SHOW, number))
        shown = {"first": query.first, "second": query.second, "newcomer": newcomer}
        event = {"event": "asked", "query": number, **shown, **who, **({"duel": True} if duel else {})}
        if options.same_start and not duel:
            tied = preferences.tied_with(incumbent)
            event["rivals"] = [each for each in rivals(query, state.trajectories, preferences) if each in tied]
        return _entry(event)

    def improve(self, state: LearnerState) -> Entry:
        """Steps 1 and 2, and the value of the new policy, which the learner does not see; `improved`."""
        options = self.settings.rollouts
        clock = [time.perf_counter()]
        utility = self.estimate(state)
        clock.append(time.perf_counter())
        check, of_best = self._check(state, utility) if self.settings.update.checked else (None, None)
        improved, bound = self.update(state, utility, check)
        tried, newest = self._tried(improved.policy), state.iteration + 1
        if state.restart is not None and self.settings.confirmations:
            kept, marks = self._confirmed(state, state.restart, utility, tried)
        else:
            kept, marks = self._kept(state, utility, check, of_best, tried), {}
        clock.append(time.perf_counter())
        evaluated = self.evaluated(improved.policy if check is None else greedy(improved.policy))
        value = float(evaluated.total.mean())
        clock.append(time.perf_counter())
        seconds = dict(zip(("utility", "improvement", "evaluation"), np.diff(clock).tolist(), strict=True))
        result = None if check is None else asdict(check)
        summary = {
            "iteration": newest,
            "answers": state.preferences.answers,
            "value": value if kept == newest else state.values[kept - 1],
            "value_newest": value,
            "kept": kept,
            **({} if result is None else {"check": result}),
            **({} if state.restart is None else {"restarted": state.started}),
            "terminated": float(evaluated.terminated.mean()),  # a share of the episodes
            **utility.quality.summary(),
            **improved.summary(),
            "seconds": seconds,
            "schedule": bound.summary(),
            "hyperparameters": utility.hyperparameters(),
        }
        event = {"check": result, "kept": kept, "bound": asdict(bound), "value": value, "summary": summary, **marks}
        return _entry(
            {"event": "improved", "iteration": newest, **event},
            trajectories=state.trajectories[-options.trajectories_per_iteration :],
            tried=tried,
            policy=improved.policy,
            estimate=utility,
        )

    def _check(self, state: LearnerState, utility: UtilityEstimate) -> tuple[Check, Float[np.ndarray, "s n"] | None]:
        """Whether the newest policy is better than the best before it, now that there are more answers.

        With it come the utilities of the better one's trajectories; None of the first policy, which is not tried. What
        an earlier version did not try is tried now.
        """
        if state.iteration == state.started:
            return Check(state.iteration, state.trust), None
        newest = self._judged(utility, state.newest.tried or self._tried(state.newest.policy))
        if state.best.number == state.started:
            return Check(state.iteration, state.trust), newest
        best, number = self._judged(utility, state.best.tried or self._tried(state.best.policy)), state.best.number
        check = checked(median_differences(newest, best), newest=state.iteration, best=number, trust=state.trust)
        return check, newest if check.best == state.iteration else best

    def _judged(self, utility: UtilityEstimate, tried: Sequence[Trajectory]) -> Float[np.ndarray, "s n"]:
        """Utilities of a policy's trajectories: under each draw where policies are compared, else in the mean."""
        return judged(utility, tried, by_draws=self.settings.questions.against_kept)

    def _kept(
        self,
        state: LearnerState,
        utility: UtilityEstimate,
        check: Check | None,
        of_best: Float[np.ndarray, "s n"] | None,
        tried: tuple[Trajectory, ...],
    ) -> int:
        """The number of the policy that the run keeps now, by the trajectories `tried` of the newest, and of others."""
        newest = state.iteration + 1
        if check is None:
            return newest
        better = of_best is None or share_better(self._judged(utility, tried), of_best) >= CLEARLY
        kept = newest if better else check.best
        if state.restart is None:
            return kept
        if not better:
            tried = (state.newest if check.best == state.iteration else state.best).tried
        clearly = share_better(judged(utility, tried), judged(utility, state.restart.kept.tried)) >= CLEARLY
        return kept if clearly else state.restart.kept.number

    def _confirmed(
        self, state: LearnerState, restart: Restart, utility: UtilityEstimate, tried: tuple[Trajectory, ...]
    ) -> tuple[int, dict[str, bool]]:
        """As `_kept` where answers are left for a restarted policy, and the marks of the event: of those that hold.

        It is kept once it was asked about and still is clearly better. The newest is to be asked about if it may be.
        """
        answered = {past.newcomer for past in state.past if past.answer is not Answer.SKIP}
        asked = state.iteration > state.started and len(state.trajectories) - 1 in answered
        kept, rival = restart.kept.number, judged(utility, restart.kept.tried)
        marks = {}
        if asked and share_better(of_asked := judged(utility, state.newest.tried), rival) >= CLEARLY:
            kept, rival, marks["confirmed"] = state.iteration, of_asked, True
        if share_better(judged(utility, tried), rival) >= POSSIBLY:
            marks["nominated"] = True
        return kept, marks

    def estimate(self, state: LearnerState) -> UtilityEstimate:
        """Step 1, the utility from all answers so far."""
        settings = self.settings
        rng = self._rng(FEATURES, 2 * state.iteration)
        known, rows = state.preferences, state.preferences.rows()
        # Decision: a person may favour a side. The simulated expert does not, and each unknown costs answers.
        sides = None if settings.expert in SIMULATED else [row.side for row in rows]
        return estimate(
            Comparisons.among(
                state.compared,
                known.pairs,
                ties=known.ties,
                sides=sides,
                answered_by=[row.answerer or "" for row in rows],
                discount=settings.trajectory_discount,
            ),
            self.feature_source.of_states(state.trajectories, settings.features.of_utility, rng=rng),
            settings.estimation,
            settings.model,
            seed=int(self._rng(FIT, state.iteration).integers(2**31)),
        )

    def update(self, state: LearnerState, utility: UtilityEstimate, check: Check | None) -> tuple[Improvement, Bound]:
        """Step 2: an update is proposed, the schedule decides on its bound, the update is applied."""
        settings, iteration, number = self.settings, state.iteration, self.settings.rollouts.trajectories_per_iteration
        since_start = state.trajectories[number * state.started :]
        taken = recent(since_start, settings.update, an_iteration=number)
        steps = transitions(taken)
        rng, key = self._rng(FEATURES, 2 * iteration + 1), self._key(IMPROVE, iteration)
        state_action_features = self.feature_source.of_steps(steps, settings.features.of_critic, rng=rng)
        needs_draws = getattr(self.schedule, "needs_draws", True)
        utilities, draws = step_utilities(utility, steps, draws=SCHEDULE_DRAWS if needs_draws else 0)
        problem = UpdateProblem(
            steps,
            utilities,
            states_of_update(since_start, settings.update, an_iteration=number, rng=self._rng(VISITED, iteration)),
            settings.critic,
            state_action_features,
            self.feature_source.of_states(state.trajectories, settings.features.of_critic, rng=rng),
            self.environment.action_space,
            quarters(taken) if needs_draws else None,
        )
        policy = (state.best if check is not None and check.stepped_back else state.newest).policy
        proposed = propose(policy, problem, key=key, utility_draws=draws)
        usual, answers = settings.update.kl_bound, state.preferences.answers
        bound = schedules.decide(self.schedule, Situation(iteration + 1, answers, usual, utility, proposed))
        improved = apply_update(
            proposed,
            bound.kl_bound * (1.0 if check is None else check.trust),
            key=key,  # which the first proposal split: its half is the parent of the next proposal's
            rng=self._rng(IMPROVE, iteration),
            updates=settings.update.updates_per_iteration,
        )
        return improved, bound


def _entry(event: dict[str, Any], **parts: Any) -> Entry:
    return Entry(events.plain(event), parts)
