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
from bayespbrl.features import (
    RadialBasisOptions,
    StateActionFeatures,
    checked_features,
    draw_state_action_features,
    draw_state_features,
)
from bayespbrl.improvement import schedules
from bayespbrl.improvement import update as improvement
from bayespbrl.policies.choice import initial_policy
from bayespbrl.preferences import Answer, Preferences, Query, parse_answer
from bayespbrl.settings import Settings, settings_for
from bayespbrl.trajectories import Trajectory, Transitions, transitions
from bayespbrl.utility import averaging
from bayespbrl.utility import estimate as utility
from bayespbrl.utility import hyperparameters as evidence

# Each random choice has a stream of its own, named by (seed, purpose, count): what is redone comes out the same.
COLLECT, CHOOSE, SHOW, FEATURES, FIT, IMPROVE, EVALUATE, VISITED = range(8)
# Posterior draws that a rule for questions looks at: enough to order ten candidates, in hundredths of a second.
QUERY_DRAWS = 500
# And a schedule, for which every draw costs a column of LSTD: the spread of a gain is known within a tenth of itself.
SCHEDULE_DRAWS = 100
# From this signal of the schedule `confidence` on, `information-when-unsure` asks as the paper does. Chosen on the
# SwingUp, seeds 100-119, all levers, always three updates an iteration, each with the spread fitted anew: the lower
# quartile is at 0.95 of the relative value at answer 8 with 0.75 and where information is asked for always, at 11 with
# 0.6. With the spread held, as it is now, and with one update only this one value was tried.
SURE_SIGNAL = 0.75
# From this signal on an iteration may ask nothing, as `unasked_iterations` says; chosen in RESULTS.md, "Asking less".
UNASKED_SIGNAL = 0.5


class Learner:
    """Learns a policy from answers to "which of these two trajectories is better?".

    `ask()` returns the questions that wait for an answer, `tell(answers)` moves on; `run(expert)` is a loop over the
    two. Whatever happens is appended to a log first, and the state is a fold over that log.

    Args:
      env: a short name (`gridworld`, …), a gymnasium id, or an environment.
      features: φ of your own, from observations (N, S) to (N, D); drawn by the settings when None.
      policy: a kind of policy by name, as of `Settings`, or a first policy of your own.
      schedule: of the KL bound by name, as of `Settings`, or one of your own (`bayespbrl.improvement.schedules`).
      entries: events of a run to continue.
      kept: the settings of that run, which hold then as they are.
      **settings: options of `Settings`, over the preset of the environment.

    Raises:
      ValueError: an unknown environment or option, a value out of range, or no time limit known.
    """

    def __init__(
        self,
        env: Any,
        *,
        features: utility.StateFeatures | None = None,
        policy: Any = None,
        schedule: schedules.Schedule | str | None = None,
        entries: Iterable[Entry] = (),
        kept: Settings | None = None,
        **settings: Any,
    ):
        self.environment = rollouts.open_environment(env)
        self.given = env if isinstance(env, gymnasium.Env) else as_given(self.environment)
        if "environment" in settings:
            raise ValueError("settings: expected env alone to say which environment, got environment too")
        own_policy = None if policy is None or isinstance(policy, str) else policy
        self.settings: Settings = kept or settings_for(
            env if isinstance(env, str) else environment_name(self.environment),
            policy=policy if own_policy is None else "other",
            features="drawn" if features is None else "other",
            environment="named" if given_by_name(env) else "other",
            schedule="other" if callable(schedule) else schedule,
            **settings,
        )
        rollouts.step_limit(self.environment, self.settings.max_steps)  # or an error now, and not after the first step
        self.features = features
        self.schedule = schedule if callable(schedule) else _schedule(self.settings.schedule)
        self.log: Log | None = None
        if own_policy is None:
            own_policy = initial_policy(
                self.settings.policy,
                self.environment.observation_space,
                self.environment.action_space,
                action_scale=self.settings.initial_action_scale,
                period=self._period,
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
    def estimate(self) -> Any:
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
        state, settings = self.state, self.settings
        began = time.perf_counter()
        collected = rollouts.rollout(
            self.environment,
            state.policy,
            key=self._key(COLLECT, state.iteration),
            episodes=settings.trajectories_per_iteration,
            max_steps=settings.max_steps,
            hold=settings.exploration_hold,
        )
        numbers = range(len(state.trajectories), len(state.trajectories) + len(collected))
        if state.estimate is None:
            wanted = settings.first_queries
            candidates = queries.random_candidates(numbers, rng=self._rng(CHOOSE, state.iteration))
        elif self._can_do_without():
            wanted, candidates = 0, ()
        else:
            wanted = settings.queries_per_iteration
            candidates = self._candidates(numbers, collected)
        event = {
            "event": "collected",
            "iteration": state.iteration + 1,
            "candidates": list(candidates),
            "wanted": wanted,
            "seconds": time.perf_counter() - began,
        }
        self._record(event, trajectories=collected)

    def _can_do_without(self) -> bool:
        """Whether an iteration asks nothing: `unasked_iterations` allows it, and what is known is enough to go on.

        Where the schedule records no signal there is nothing to go by, and the setting alone decides.
        """
        state, last = self.state, self.state.summaries[-1]
        # Decision: no more in a row than half the answers. What two or three of them say holds for a step or two; a
        # policy that goes on by it narrows on what is wrong (RESULTS.md, "Asking little").
        most = min(self.settings.unasked_iterations, state.preferences.answers // 2)
        if state.unasked >= most or not state.preferences.pairs:
            return False
        if "signal" not in last["schedule"]:
            return True
        signal = last["schedule"]["signal"]  # of a schedule of the user's own it may be anything
        return isinstance(signal, int | float) and bool(last["utility_converged"]) and signal >= UNASKED_SIGNAL

    def _candidates(self, numbers: Sequence[int], collected: Sequence[Trajectory]) -> tuple[int, ...]:
        """As many trajectories as are new, in the order in which to ask about them."""
        state, rule, number = self.state, self.settings.query, len(collected)
        if rule == "information-when-unsure":
            sure = state.summaries[-1]["schedule"].get("signal", 0.0) >= SURE_SIGNAL
            rule = "highest-utility" if sure else "information"
            if not sure:
                everything = [*state.trajectories, *collected]
                numbers = [i for i in range(len(everything)) if i not in state.shown]
                collected = [everything[i] for i in numbers]
        if rule == "highest-utility":
            return queries.highest_utility_candidates(numbers, state.estimate.trajectory_utilities(collected))
        shown = [*collected, state.trajectories[state.preferences.undominated[-1]]]
        draws = state.estimate.trajectory_draws(shown, number=QUERY_DRAWS)
        candidates = queries.posterior_candidates(
            rule,
            numbers,
            draws[:, :-1],
            draws[:, -1],
            likelihood=state.estimate.likelihood,
            rng=self._rng(CHOOSE, state.iteration),
        )
        return candidates[:number]

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
        state, settings = self.state, self.settings
        clock = [time.perf_counter()]
        estimate, choice = self._estimate()
        clock.append(time.perf_counter())
        steps = transitions(state.trajectories)
        update, bound = self._update(estimate, steps)
        clock.append(time.perf_counter())
        evaluated = rollouts.returns(
            self.environment,
            update.policy,
            key=self._key(EVALUATE, 0),
            episodes=settings.evaluation_episodes,
            max_steps=settings.max_steps,
        )
        clock.append(time.perf_counter())
        seconds = dict(zip(("utility", "improvement", "evaluation"), np.diff(clock).tolist(), strict=True))
        summary = _summary(state, estimate, update, evaluated, seconds)
        summary["schedule"] = {"reason": bound.reason, **bound.statistics}
        summary["hyperparameters"] = None if choice is None else choice.summary()
        size = settings.trajectories_per_iteration
        self._record(
            {"event": "improved", "iteration": state.iteration + 1, "summary": summary},
            trajectories=state.trajectories[-size:],
            policy=update.policy,
            estimate=estimate,
        )

    def _estimate(self) -> tuple[Any, evidence.HyperparameterChoice | None]:
        """Step 1, after the answers have said which length scales they speak for."""
        settings, state = self.settings, self.state
        pairs = state.preferences.pairs
        features = self._state_features(
            self._rng(FEATURES, 2 * state.iteration),
            bandwidth_factor=settings.utility_bandwidth_factor,
            normalised=settings.normalised_utility,
        )
        model: dict[str, Any] = {name: getattr(settings, name) for name in ("steepness", "lapse_rate")}
        fixed: dict[str, Any] = {name: getattr(settings, name) for name in ("prior_scale", "likelihood")}
        fixed["discount"] = settings.psi_discount
        seed = int(self._rng(FIT, state.iteration).integers(2**31))
        given, choice = {"features": features, **model}, None
        if settings.hyperparameters != "given" and settings.utility != "known-reward":
            choice = evidence.choose_hyperparameters(state.trajectories, pairs, features, **model, **fixed)
            features = choice.features
            model = {"steepness": choice.steepness, "lapse_rate": choice.lapse_rate}
        estimate: Any = utility.estimate_utility(
            state.trajectories,
            pairs,
            features,
            method=settings.utility,
            seed=seed,
            **model,
            **fixed,
        )
        if settings.hyperparameters == "averaged" and pairs:
            estimate = averaging.average_utility(estimate, state.trajectories, pairs, seed=seed, **given, **fixed)
        return estimate, choice

    def _update(self, estimate: Any, steps: Any) -> tuple[improvement.Improvement, schedules.Bound]:
        """Step 2, by as much as the schedule allows once it has seen what an update would do."""
        settings, iteration = self.settings, self.state.iteration
        rng = self._rng(FEATURES, 2 * iteration + 1)
        state_action_features = self.state_action_features(steps, rng=rng)
        utilities, utility_draws = self._step_utilities(estimate, steps)
        decision: list[schedules.Bound] = []

        def decide(update: improvement.ProposedUpdate) -> float:
            situation = schedules.Situation(
                iteration + 1, self.state.preferences.answers, settings.kl_bound, estimate, update
            )
            decision.append(schedules.decided(self.schedule, situation))
            return decision[0].kl_bound

        improved = improvement.improve(
            self.state.policy,
            steps,
            utilities,
            key=self._key(IMPROVE, iteration),
            rng=self._rng(IMPROVE, iteration),
            action_space=self.environment.action_space,
            state_features=self._state_features(rng, bandwidth_factor=settings.bandwidth_factor),
            state_action_features=state_action_features,
            kl_bound=decide,
            updates=settings.updates_per_iteration,
            discount=settings.discount,
            fixed_point_ridge=settings.fixed_point_ridge,
            projection_ridge=settings.projection_ridge,
            visited=self._visited_states(),
            utility_draws=utility_draws,
        )
        return improved, decision[0]

    def state_action_features(self, steps: Transitions, *, rng: np.random.Generator) -> StateActionFeatures:
        """φ(s, a) of Q, drawn at observed transitions as the settings say."""
        return draw_state_action_features(
            self.environment.observation_space,
            self.environment.action_space,
            steps.states,
            steps.actions,
            RadialBasisOptions(self.settings.centres, self.settings.bandwidth_factor, self._period),
            rng=rng,
        )

    def _step_utilities(self, estimate: Any, steps: Transitions) -> tuple[np.ndarray, np.ndarray | None]:
        """uᵢ of each step, (N,), and under posterior draws, (N, S); None where no schedule asks or there are none."""
        if isinstance(self.schedule, schedules.ConstantBound) or getattr(estimate, "posterior", None) is None:
            return estimate.step_utilities(steps), None
        utilities, draws = estimate.utilities_and_draws(steps.next_states, number=SCHEDULE_DRAWS)
        return utilities, draws.T

    def _visited_states(self) -> np.ndarray:
        """States in which the last iterations acted: those of the policy update, and no more than the settings say."""
        recent, size = self.settings.recent_iterations, self.settings.trajectories_per_iteration
        trajectories = self.state.trajectories if recent is None else self.state.trajectories[-recent * size :]
        states = np.concatenate([trajectory.states[:-1] for trajectory in trajectories])
        if states.ndim == 1 or len(states) <= self.settings.update_states:
            return states  # discrete ones are counted, not repeated
        chosen = self._rng(VISITED, self.state.iteration).choice(
            len(states), self.settings.update_states, replace=False
        )
        return states[np.sort(chosen)]

    def _state_features(
        self, rng: np.random.Generator, *, bandwidth_factor: float, normalised: bool = False
    ) -> utility.StateFeatures:
        """φ(s): the user's, or drawn anew at states observed so far."""
        if self.features is not None:
            features = self.features
            return lambda states: checked_features(features, states)
        observed = np.concatenate([trajectory.states for trajectory in self.state.trajectories])
        return draw_state_features(
            self.environment.observation_space,
            observed,
            RadialBasisOptions(self.settings.centres, bandwidth_factor, self._period, normalised),
            rng=rng,
        )

    @property
    def _period(self) -> Any:
        return environment_attribute(self.environment, "observation_period")

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


def _schedule(name: str) -> schedules.Schedule:
    if name not in schedules.SCHEDULES:
        raise ValueError(f"schedule: expected a function of the user's own beside {name!r}, got none")
    return schedules.SCHEDULES[name]


def _summary(
    state: LearnerState,
    estimate: Any,
    update: improvement.Improvement,
    evaluated: rollouts.Returns,
    seconds: dict[str, float],
) -> dict[str, Any]:
    """What an iteration reports, as plain data."""
    quality, reps = estimate.quality, update.reps
    return {
        "iteration": state.iteration + 1,
        "answers": state.preferences.answers,
        "pairs": quality.pairs,
        "pairs_satisfied": quality.pairs_satisfied,
        "value": float(evaluated.total.mean()),
        "terminated": float(evaluated.terminated.mean()),  # a share of the episodes
        "kl_bound": reps.kl_bound,
        "bound_active": reps.bound_active,
        "kl": reps.kl,
        "updates": update.updates,
        "kl_fitted_policy": update.kl_fitted_policy,
        "feature_gap": reps.feature_gap,
        "feature_gap_raw": reps.feature_gap_raw,
        "rank_kept": reps.rank_kept,
        "effective_samples": reps.effective_samples,
        "temperature": reps.temperature,
        "reps_converged": reps.converged,
        "entropy": update.entropy,
        "action_standard_deviation": update.action_standard_deviation,
        "rhat_max": quality.rhat_max,
        "effective_sample_size_min": quality.effective_sample_size_min,
        "utility_converged": quality.converged,
        "utility_status": quality.status,
        "log_evidence": quality.log_evidence,
        "seconds": seconds,
    }
