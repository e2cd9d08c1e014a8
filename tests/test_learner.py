"""The learner: its protocol, ask and tell, undo and skip, and continuing from any point."""

import dataclasses
import itertools
import json
from dataclasses import replace

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from threadpoolctl import threadpool_info, threadpool_limits
from toys import QUICK, Memory, Push, Slope, fingerprint

from bayespbrl import Answer, Learner, ReturnExpert, events, load, queries, questions, resume, rollouts, start
from bayespbrl import cycle as cycle_module
from bayespbrl.diagnostics.estimates import predicted_answer
from bayespbrl.envs.gridworld import REWARDS
from bayespbrl.events.state import LearnerState, NumberedPolicy, Restart
from bayespbrl.improvement.schedules import Bound
from bayespbrl.improvement.update import NEARLY
from bayespbrl.models import restored, stored
from bayespbrl.models.threads import one_blas_thread
from bayespbrl.policies import LinearGaussianPolicy, TabularPolicy
from bayespbrl.trajectories import transitions


def learner(entries=(), **changes):
    return Learner("gridworld", entries=entries, **(QUICK | changes))


def remembered(**changes):
    log = Memory()
    return learner(**changes).logged(log), log


@pytest.fixture(scope="module")
def straight():
    """The fingerprint of the run that was never stopped."""
    return fingerprint(learner().run(ReturnExpert()))


class Counting:
    """The simulated expert, and which questions it was asked."""

    def __init__(self):
        self.asked = []

    def __call__(self, first, second):
        self.asked.append((first.states.tobytes(), second.states.tobytes()))
        return ReturnExpert()(first, second)


@pytest.mark.slow
def test_twenty_five_iterations_take_twenty_six_answers():
    expert = Counting()
    run = learner(iterations=25, evaluation_episodes=1, max_steps=10).run(expert)
    assert [summary["answers"] for summary in run.iterations] == list(range(2, 27))
    assert [summary["iteration"] for summary in run.iterations] == list(range(1, 26))
    assert len(expert.asked) == run.preferences.answers == 26
    assert len(run.trajectories) == 250
    assert run.finished
    assert run.ask() == []


def test_the_first_iteration_compares_three_of_the_new_trajectories_and_later_ones_the_best():
    run = learner()
    shown = []
    while questions := run.ask():
        assert len(questions) == 1
        shown.append(questions[0])
        if run.state.iteration:
            new = run.trajectories[-10:]
            best = np.argmax(run.estimate.trajectory_utilities(new))
            assert questions[0].newcomer == len(run.trajectories) - 10 + best
        assert questions[0].incumbent == run.preferences.undominated[-1]
        run.tell([ReturnExpert()(*questions[0].trajectories)])
    assert [query.number for query in shown] == [1, 2, 3, 4]
    first_three = {shown[0].first, shown[0].second, shown[1].newcomer}
    assert len(first_three) == 3
    assert max(first_three) < 10
    assert [query.newcomer // 10 for query in shown] == [0, 0, 1, 2]


DRAWS = {"utility": "posterior-mean", "hyperparameters": "given", "iterations": 2}
POSTERIOR_RULES = ("probably-better", "thompson", "information", "disagreement", "eubo")


@pytest.mark.parametrize("query", POSTERIOR_RULES)
def test_a_query_rule_orders_all_new_trajectories_by_the_posterior(query):
    run, log = remembered(**DRAWS, query=query)
    run.run(ReturnExpert())
    first, *later = [entry.event for entry in log.entries if entry.event["event"] == "collected"]
    plain, plain_log = remembered()
    plain.ask()
    assert first == plain_log.entries[0].event | {"seconds": first["seconds"]}  # nothing to look at yet
    for number, event in enumerate(later, start=1):
        assert sorted(event["candidates"]) == list(range(10 * number, 10 * number + 10))


def test_the_rules_ask_about_the_trajectory_whose_score_is_highest():
    for query, score in (
        ("probably-better", queries.probability_better),
        ("information", None),
    ):
        run = learner(**DRAWS, query=query)
        while questions := run.ask():
            if run.state.iteration:
                new, (question,) = run.trajectories[-10:], questions
                draws = run.estimate.trajectory_draws([*new, run.trajectories[question.incumbent]], number=500)
                if score is None:
                    likelihood = run.estimate.likelihood(500)
                    scores = queries.expected_information(draws[:, :-1], draws[:, -1], likelihood=likelihood)
                else:
                    scores = score(draws[:, :-1], draws[:, -1])
                assert scores[question.newcomer % 10] == scores.max()
            run.tell([ReturnExpert()(*questions[0].trajectories)])


@pytest.mark.parametrize(
    "options",
    [
        {"query": "thompson"},
        pytest.param({"query": "information", "utility": "posterior-draw"}, marks=pytest.mark.slow),
    ],
)
def test_a_learner_that_looks_at_draws_continues_as_if_never_stopped(options):
    options = DRAWS | options
    straight, log = remembered(**options)
    straight.run(ReturnExpert())
    for length in (5, 6, 7):  # before the first fit, after it, and after the candidates that follow from it
        continued = learner(log.entries[:length], **options)
        assert fingerprint(continued.run(ReturnExpert())) == fingerprint(straight)


def test_more_questions_an_iteration_are_asked_one_after_the_other():
    run = learner(first_queries=4, queries_per_iteration=3).run(ReturnExpert())
    assert [summary["answers"] for summary in run.iterations] == [4, 7, 10]


@pytest.mark.slow
def test_without_a_signal_as_many_iterations_ask_nothing_as_is_allowed_but_no_more_than_half_the_answers():
    run, log = remembered(iterations=8, unasked_iterations=2)
    run.run(ReturnExpert())
    assert [summary["answers"] for summary in run.iterations] == [2, 2, 3, 3, 4, 4, 4, 5]
    assert len(run.trajectories) == 80
    many = learner(iterations=16, unasked_iterations=9).run(ReturnExpert())
    assert [summary["answers"] for summary in many.iterations] == [2, 2, 3, 3, 4, 4, 4, 5, 5, 5, 6, 6, 6, 6, 7, 7]
    for length in range(4, len(log.entries), 3):
        continued = learner(log.entries[:length], iterations=8, unasked_iterations=2)
        assert fingerprint(continued.run(ReturnExpert())) == fingerprint(run)


def test_as_long_as_there_is_no_preference_every_iteration_asks():
    run = learner(iterations=4, unasked_iterations=3)
    while questions := run.ask():
        run.tell(["tie" if run.state.iteration < 2 else ReturnExpert()(*questions[0].trajectories)])
    assert [summary["answers"] for summary in run.iterations] == [2, 3, 4, 4]


def test_undoing_goes_back_over_iterations_that_asked_nothing():
    run = learner(iterations=6, unasked_iterations=2)
    first = run.ask()
    run.tell(["tie"])
    second = run.ask()
    run.tell([ReturnExpert()(*second[0].trajectories)])
    assert run.state.iteration == 2
    run.undo()
    assert (run.state.iteration, run.ask()[0].number) == (0, second[0].number)
    run.undo()
    assert run.ask()[0].number == first[0].number


@pytest.mark.parametrize(
    ("signal", "converged", "asks"),
    [(0.5, True, False), (0.49, True, True), (0.9, False, True), (None, True, False), (None, False, False)],
)
def test_what_the_schedule_said_decides_whether_to_ask(signal, converged, asks):
    run = learner(iterations=2, unasked_iterations=1)
    while run.state.iteration < 1:
        questions = run.ask()
        last = run.state
        run.tell([ReturnExpert()(*questions[0].trajectories)])
    quality = dataclasses.replace(run.estimate.quality, converged=converged)
    again = learner(iterations=2, unasked_iterations=1)
    again.state = dataclasses.replace(
        run.state,
        estimate=dataclasses.replace(run.estimate, quality=quality),
        bound=Bound(0.3, signal=signal),
        collected=False,
        iteration=1,
        unasked=0,
    )
    assert last.preferences.answers == 1
    assert bool(again.ask()) == asks


def test_bound_question_and_prediction_are_all_of_the_runs_one_posterior():
    run, log = remembered(schedule="confidence", query="probably-better", utility="posterior-mean", iterations=3)
    while run.state.iteration < 2:
        run.tell([ReturnExpert()(*query.trajectories) for query in run.ask()])
    (question,) = run.ask()
    kept = run.estimate
    tree = stored(kept.posterior)
    for name in ("coordinates", "margins"):
        tree["posterior"][name] = -tree["posterior"][name]
    turned = replace(kept, posterior=restored(tree))  # every draw says the opposite, all else is as it was

    new = range(len(run.trajectories) - 10, len(run.trajectories))
    bounds, orders, predicted = [], [], []
    for estimate in (kept, turned):
        bounds.append(run.cycle.update(run.state, estimate, None)[1])
        incumbent = run.preferences.undominated[-1]
        shown = run.state.shown - {question.newcomer}
        situation = queries.QuerySituation(
            new, run.trajectories, shown, incumbent, estimate, None, run.cycle._rng(1, 2)
        )
        orders.append(queries.candidates(run.cycle.query_rule, situation))
        predicted.append(predicted_answer(estimate, *question.trajectories)[0])
    assert bounds[0].statistics["agreement"] > 0.5 > bounds[1].statistics["agreement"]
    collected = [entry.event for entry in log.entries if entry.event["event"] == "collected"]
    assert list(orders[0]) == collected[-1]["candidates"]
    assert orders[1] != orders[0]
    assert predicted[1] == pytest.approx(1 - predicted[0], abs=1e-9)
    assert abs(predicted[0] - 0.5) > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("threshold", [0.0, 0.5, 1.1])
def test_a_learner_that_is_sure_asks_nothing(threshold, monkeypatch):
    monkeypatch.setattr(questions, "UNASKED_SIGNAL", threshold)
    options = {
        "preset": "paper",
        "utility": "posterior-mean",
        "schedule": "confidence",
        "unasked_iterations": 2,
        "iterations": 9,
    }
    run = learner(**options).run(ReturnExpert())
    unasked = 0
    for last, summary in itertools.pairwise(run.iterations):
        few = unasked >= min(2, last["answers"] // 2)
        sure = last["utility_converged"] and last["schedule"]["signal"] >= threshold and not few
        unasked = unasked + 1 if sure else 0
        assert summary["answers"] == last["answers"] + (not sure)
    answers = run.iterations[-1]["answers"]
    assert answers == {0.0: 5, 1.1: 10}.get(threshold, answers)


def threads():
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


class Threads(Slope):
    """Notes how many threads the linear algebra has while an iteration is computed."""

    def step(self, action):
        self.seen = threads()
        return super().step(action)


def test_an_iteration_has_one_thread_of_linear_algebra_and_gives_the_others_back():
    with threadpool_limits(2, user_api="blas"):
        before = threadpool_info()
        learner = Learner(env := Threads(), **QUICK)
        learner.ask()
        assert env.seen == {1}
        assert threadpool_info() == before


def test_one_thread_of_linear_algebra_is_wanted_until_the_last_leaves():
    with threadpool_limits(2, user_api="blas"):
        first, second = one_blas_thread(), one_blas_thread()
        with first:
            second.__enter__()
        assert threads() == {1}
        second.__exit__(None, None, None)
        assert threads() == {2}


def test_asking_again_changes_nothing():
    run, log = remembered()
    question = run.ask()
    length, state = len(log.entries), run.state
    assert run.ask() == question
    assert run.state is state
    assert len(log.entries) == length


@pytest.mark.parametrize(
    "answers", [[], ["first", "second"], "first", Answer.FIRST, ["both"], [None], [3], None, 5, iter(["first"])]
)
def test_what_is_no_answer_is_refused_and_nothing_has_happened(answers):
    run, log = remembered()
    run.ask()
    state, length = run.state, len(log.entries)
    with pytest.raises(ValueError, match=r"tell: expected a list of 1|answer: expected one of"):
        run.tell(answers)
    assert run.state is state
    assert len(log.entries) == length
    with pytest.raises(
        ValueError, match=r"tell: expected a list of 0 answers, one to each of ask\(\) \(no question waits\)"
    ):
        learner().tell(["first"])  # nothing has been asked yet


def test_an_expert_that_answers_nonsense_is_named_and_can_be_replaced(straight):
    run = learner()
    with pytest.raises(ValueError, match=r"answer: expected one of 'first', .*, got 'perhaps'"):
        run.run(lambda first, second: "perhaps")
    assert fingerprint(run.run(ReturnExpert())) == straight


def test_the_expert_sees_the_two_in_the_order_shown():
    seen = []
    run = learner()

    def expert(first, second):
        (query,) = run.ask()
        assert (first, second) == query.trajectories
        seen.append(query.number)
        return "tie"

    run.run(expert)
    assert seen == [1, 2, 3, 4]


@pytest.mark.parametrize("unasked", [0, 1])
def test_progress_follows_each_iteration_also_one_that_asks_nothing(unasked):
    progress = []
    run = learner(iterations=3, unasked_iterations=unasked)
    run.run(ReturnExpert(), progress=lambda run: progress.append((run.state.iteration, run.preferences.answers)))
    assert progress == [(1, 2), (2, 2 if unasked else 3), (3, 3 if unasked else 4)]


@pytest.mark.parametrize("answers_before", [1, 2, 3, 4])
@pytest.mark.parametrize("undone", [1, 2, 3])
def test_undoing_and_answering_the_same_gives_the_run_that_was_never_undone(straight, answers_before, undone):
    run = learner()
    for _ in range(answers_before):
        run.tell([ReturnExpert()(*run.ask()[0].trajectories)])
    for _ in range(min(undone, answers_before)):
        run.undo()
    assert run.preferences.answers == max(0, answers_before - undone)
    assert fingerprint(run.run(ReturnExpert())) == straight


def test_undo_as_an_answer_takes_the_previous_one_back_and_asks_it_again():
    run = learner()
    first = run.ask()
    run.tell(["first"])
    assert run.ask() != first
    run.tell(["undo"])
    assert run.ask() == first
    assert run.preferences.answers == 0


def test_a_person_takes_no_answer_of_another_back():
    run, given = learner(), []

    def bob(first, second):
        given.append("undo" if len(given) < 2 else "first")
        return given[-1]

    run.ask()
    run.tell(["first"], answerer="Ada")
    run.run(bob, answerer="Bob")
    assert given[:3] == ["undo", "undo", "first"]
    assert [past.answerer for past in run.state.past][:2] == ["Ada", "Bob"]


def test_an_answer_to_a_question_that_no_longer_waits_is_refused_and_to_one_that_does_is_taken_in():
    run = learner()
    (seen,) = run.ask()
    run.tell(["first"], queries=[seen], answerer="Ada")
    (present,) = run.ask()
    with pytest.raises(ValueError, match=f"got number {seen.number}, where {present.number} waits"):
        run.tell(["second"], queries=[seen], answerer="Bob")
    with pytest.raises(ValueError, match="each once"):
        run.tell(["first", "first"], queries=[present, present])
    with pytest.raises(ValueError, match="expected questions as ask"):
        run.tell(["first"], queries=["first"])
    for one in (present, 1):
        with pytest.raises(ValueError, match="queries: expected a list of questions as ask"):
            run.tell(["first"], queries=one)
    run.tell(["second"], queries=[present], answerer="Bob")
    assert [(past.number, past.answerer) for past in run.state.past] == [(seen.number, "Ada"), (present.number, "Bob")]


def test_a_bad_name_is_refused_before_a_person_is_asked():
    run, asked = learner(), []
    with pytest.raises(ValueError, match="answerer: expected"):
        run.run(lambda *shown: asked.append(shown) or "first", answerer="Ada ")
    assert (asked, run.trajectories) == ([], ())


def test_a_question_whose_number_was_given_to_another_after_an_undo_is_refused():
    run = learner(first_queries=2)
    run.ask()
    run.tell(["first"])
    (stale,) = run.ask()
    run.undo()
    run.tell(["second"])
    (present,) = run.ask()
    assert present.number == stale.number
    assert (present.first, present.second) != (stale.first, stale.second)
    with pytest.raises(ValueError, match="expected questions that wait"):
        run.tell(["first"], queries=[stale])


def test_the_last_answers_can_be_undone_and_no_more_are_held_in_memory(monkeypatch):
    monkeypatch.setattr(events.fold, "MOST_UNDONE", 2)
    run = learner(first_queries=5)
    for _ in range(4):
        run.tell(["tie"] * len(run.ask()))
    assert len(run.state.before) == 2
    run.undo()
    run.undo()
    assert run.preferences.answers == 2
    with pytest.raises(ValueError, match="undo: expected an answer to take back, got 2 undone"):
        run.undo()
    assert run.preferences.answers == 2


def test_nothing_can_be_undone_before_the_first_answer():
    run = learner()
    run.ask()
    with pytest.raises(ValueError, match="undo: expected an answer to take back, got none yet"):
        run.undo()
    with pytest.raises(ValueError, match="undo"):
        run.tell(["undo"])
    replies = iter(["undo", "undo", "tie", "tie", "tie", "tie"])
    assert run.run(lambda first, second: next(replies)).preferences.answers == 4


def test_an_expert_who_only_undoes_is_refused():
    asked = []
    with pytest.raises(
        ValueError, match="expert: expected an answer, because there is none to take back, got 10 undos"
    ):
        learner().run(lambda first, second: asked.append(1) or "undo" if len(asked) < 100 else "tie")


def test_another_answer_after_undoing_leads_elsewhere():
    run = learner()
    run.ask()
    run.tell(["first"])
    before = run.preferences
    run.undo()
    run.tell(["second"])
    assert run.preferences.answers == 1
    assert run.preferences != before


def test_a_skipped_question_is_followed_by_one_about_the_next_candidate():
    run = learner()
    (question,) = run.ask()
    following = run.state.candidates[1]
    run.tell(["skip"])
    (after,) = run.ask()
    assert (question.number, after.number) == (1, 2)
    assert (after.newcomer, after.incumbent) == (following, question.incumbent)
    assert run.preferences.answers == 0


def test_a_run_in_which_all_is_skipped_moves_on_and_learns_nothing():
    asked = []
    run = learner(iterations=2).run(lambda first, second: asked.append(1) or "skip")
    assert run.finished
    assert len(asked) == 9 + 10  # in the first iteration one of the ten is what the others are compared with
    assert [summary["answers"] for summary in run.iterations] == [0, 0]
    np.testing.assert_allclose(run.policy.table, 0.2, atol=1e-6)


def test_a_run_of_ties_counts_its_answers_and_learns_nothing():
    run = learner().run(lambda first, second: "tie")
    assert [(s["answers"], s["pairs"], s["bound_active"]) for s in run.iterations] == [(2, 0, False), *run_of_ties()]
    assert len(run.preferences.undominated) == 5
    np.testing.assert_allclose(run.policy.table, 0.2, atol=1e-6)


def run_of_ties():
    return [(3, 0, False), (4, 0, False)]


def test_a_learner_continued_from_any_point_of_its_log_is_the_one_that_was_never_stopped():
    straight, log = remembered()
    expert = Counting()
    straight.run(expert)
    for length in range(len(log.entries)):
        rest = Counting()
        continued = learner(log.entries[:length])
        assert fingerprint(continued.run(rest)) == fingerprint(straight)
        answered = sum(entry.event["event"] == "answered" for entry in log.entries[:length])
        assert rest.asked == expert.asked[answered:]  # never asked again what was answered


def test_the_same_seed_gives_the_same_run_and_another_seed_another():
    one, same, other = (fingerprint(learner(seed=seed).run(ReturnExpert())) for seed in (1, 1, 2))
    assert one == same
    assert one["trajectories"] != other["trajectories"]


def test_what_cannot_be_logged_has_not_happened():
    class Full(Memory):
        def append(self, entry, state):
            if len(self.entries) == 3:
                raise OSError("no space left on device")
            super().append(entry, state)

    log = Full()
    run = learner().logged(log)
    run.ask()
    with pytest.raises(OSError, match="no space"):
        run.tell(["first"])  # the answer is kept, the next question is not
    assert [entry.event["event"] for entry in log.entries] == ["collected", "asked", "answered"]
    assert (run.preferences.answers, run.state.query) == (1, None)
    log.__class__ = Memory  # there is space again
    assert fingerprint(run.run(lambda a, b: "first")) == fingerprint(learner().run(lambda a, b: "first"))


def test_the_value_is_the_mean_return_of_the_new_policy_on_fixed_episodes():
    run = learner().run(ReturnExpert())
    key = jax.random.key(int(np.random.default_rng([7, 6, 0]).integers(2**31)))
    returns = rollouts.returns("gridworld", run.policy, key=key, episodes=3, max_steps=20)
    assert run.iterations[-1]["value"] == returns.total.mean()
    assert run.iterations[-1]["terminated"] == returns.terminated.mean() == 0


def test_a_summary_says_how_the_iteration_went():
    for summary in learner().run(ReturnExpert()).iterations:
        assert summary["kl"] == pytest.approx(0.3, rel=0.01)
        # a little less than the weights' own: the policy keeps a least probability of every action
        assert 0.95 * 0.3 < summary["kl_fitted_policy"] < 0.3 * 1.001
        assert summary["updates"] == 1
        assert summary["bound_active"]
        assert summary["feature_gap"] < 1e-6
        assert 0 < summary["rank_kept"] <= 25
        assert summary["pairs_satisfied"] <= summary["pairs"]
        assert summary["rhat_max"] is None  # a linear program draws nothing
        assert set(summary["seconds"]) == {"utility", "improvement", "evaluation"}
        assert all(seconds > 0 for seconds in summary["seconds"].values())


@pytest.mark.slow
def test_the_learner_follows_the_expert_and_not_the_hidden_reward():
    # This expert wants the bottom left corner, where the environment's reward is smallest.
    wish = REWARDS[::-1, ::-1].ravel()

    def expert(first, second):
        return "first" if wish[first.states[1:]].sum() > wish[second.states[1:]].sum() else "second"

    run = learner(iterations=8, max_steps=60, kl_bound=0.6).run(expert)
    wishes = [wish[trajectory.states[1:]].sum() for trajectory in run.trajectories]
    assert np.mean(wishes[-10:]) > 2 * np.mean(wishes[:10])
    assert run.iterations[-1]["value"] < run.iterations[0]["value"]


def test_features_of_the_users_own_are_used():
    def corner(states):
        return np.column_stack([states == 4, states == 20]).astype(float)

    run = learner(features=corner, iterations=2).run(ReturnExpert())
    assert run.settings.features.features == "other"
    assert run.estimate.weights.shape == (2,)


def test_features_of_the_users_own_learn_the_same_in_any_units():
    def learned(unit):
        def features(states):
            return np.column_stack([states[:, 0], states[:, 0] ** 2, unit * states[:, 1], np.full(len(states), unit)])

        options = QUICK | {"utility": "posterior-mean", "hyperparameters": "inferred"}
        return Learner(Slope(), features=features, **options).run(ReturnExpert())

    run, other = learned(1.0), learned(1024.0)  # a power of two: rounding is the same
    assert fingerprint(run) == fingerprint(other)
    assert [each["value"] for each in run.iterations] == [each["value"] for each in other.iterations]
    np.testing.assert_array_equal(run.estimate.weights, other.estimate.weights)
    assert np.ptp(run.estimate.features(run.trajectories[0].states)[:, 0]) <= 1


def test_a_learner_acts_in_the_environment_as_it_was_given():
    class Shifted(gymnasium.Env):
        """Counts from 3, with actions from -1."""

        observation_space, action_space = Discrete(4, start=3), Discrete(3, start=-1)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.state = 3
            return self.state, {}

        def step(self, action):
            assert action in (-1, 0, 1)
            self.state = int(np.clip(self.state + action, 3, 6))
            return self.state, float(self.state), False, False, {}

    learned = Learner(Shifted(), **QUICK).run(ReturnExpert())
    assert {learned.actor().act(state) for state in (3, 4, 5, 6) for _ in range(20)} <= {-1, 0, 1}
    assert {learned.actor(learned.state.first_policy).act(3) for _ in range(50)} == {-1, 0, 1}
    with pytest.raises(ValueError, match="observation"):
        learned.actor().act(9)


def test_features_of_the_users_own_that_are_not_finite_are_refused_and_the_answers_kept():
    run, log = remembered(features=lambda states: np.full((len(states), 2), np.nan))
    with pytest.raises(ValueError, match="features <lambda>: expected finite numbers"):
        run.run(ReturnExpert())
    assert run.preferences.answers == 2
    continued = learner(log.entries, features=lambda states: np.eye(25)[states])
    assert continued.run(ReturnExpert()).preferences.answers == 4


def test_a_first_policy_of_the_users_own_is_where_learning_starts():
    right = np.full((25, 5), 0.01)
    right[:, 3] = 0.96
    run = learner(policy=TabularPolicy(right))
    run.ask()
    assert run.settings.rollouts.policy == "other"
    assert np.mean(np.concatenate([t.actions for t in run.trajectories]) == 3) > 0.9


@pytest.mark.parametrize(
    ("env", "options", "message"),
    [
        ("gridwrld", {}, "environment: expected gridworld, .* got 'gridwrld'"),
        ("gridworld", {"utility": "median"}, "utility: expected one of posterior-mean"),
        ("gridworld", {"kl_bound": float("nan")}, "kl_bound: expected a positive finite number, got nan"),
        ("gridworld", {"kl_bund": 0.3}, "settings: expected options among"),
        ("gridworld", {"policy": "gaussian-process"}, "space"),
        (42, {}, "environment: expected a short name"),
    ],
)
def test_bad_options_are_refused(env, options, message):
    with pytest.raises(ValueError, match=message):
        Learner(env, **options)


SLOPE = {
    "preset": "paper",
    "utility": "linear-program",
    "iterations": 2,
    "max_steps": 5,
    "evaluation_episodes": 4,
    "centres": 20,
}


def test_continuous_actions_and_an_ordinary_environment_are_learned_alike():
    policy = LinearGaussianPolicy.initial(Slope.observation_space, Slope.action_space, initial_scale=0.3)
    changes = {"utility": "known-reward", "iterations": 6, "evaluation_episodes": 20}
    run = Learner(Slope(), policy=policy, **(SLOPE | changes)).run(ReturnExpert())
    assert run.iterations[-1]["value"] > run.iterations[0]["value"]
    assert run.trajectories[0].states.shape == (6, 2)
    assert all(np.abs(t.actions).max() <= 1 for t in run.trajectories)
    deviations = [summary["action_standard_deviation"] for summary in run.iterations]
    assert all(len(deviation) == 1 and 0 < deviation[0] < 0.7 for deviation in deviations)


@pytest.mark.parametrize(("break_at", "answers"), [(3, 0), (60, 2), (90, 2)])
def test_a_reward_that_is_not_a_number_is_refused_and_the_run_goes_on_without_loss(break_at, answers):
    # 50 steps are collected, then 20 of evaluation, and so on.
    policy = LinearGaussianPolicy.initial(Slope.observation_space, Slope.action_space, initial_scale=0.3)
    log = Memory()
    broken = Learner(Slope("reward", break_at), policy=policy, **SLOPE).logged(log)
    with pytest.raises(ValueError, match=r"environment Slope: expected finite .*NaN or infinity at step"):
        broken.run(ReturnExpert())
    assert broken.preferences.answers == answers
    whole = Learner(Slope(), policy=policy, **SLOPE).run(ReturnExpert())
    mended = Learner(Slope(), policy=policy, entries=log.entries, **SLOPE).run(ReturnExpert())
    assert fingerprint(mended) == fingerprint(whole)
    assert fingerprint(broken.run(ReturnExpert())) == fingerprint(whole)  # it broke only once


@pytest.mark.slow
def test_discrete_actions_in_continuous_states_are_learned():
    run = Learner("CartPole-v1", utility="linear-program", iterations=2, centres=20, evaluation_episodes=2)
    assert isinstance(run.environment.action_space, Discrete)
    run.run(ReturnExpert())
    assert run.preferences.answers == 3
    assert all(summary["kl_fitted_policy"] < 0.6 for summary in run.iterations)
    assert all(summary["terminated"] == 1 for summary in run.iterations)  # every pole fell


def compilations_after(run, iteration):
    """Programs that JAX compiled after the given iteration, until the end."""
    count = []

    def listen(event, seconds, **details):
        if event == "/jax/core/compile/backend_compile_duration" and run.state.iteration >= iteration:
            count.append(seconds)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        run.run(ReturnExpert())
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    return len(count)


SHORT = {"preset": "paper", "iterations": 3, "max_steps": 12, "centres": 20, "evaluation_episodes": 2}


def seen_problems(monkeypatch):
    """The problem of each update from now on."""
    seen, real = [], cycle_module.propose

    def propose(policy, problem, **options):
        seen.append(problem)
        return real(policy, problem, **options)

    monkeypatch.setattr(cycle_module, "propose", propose)
    return seen


def test_answers_have_a_discount_of_their_own(monkeypatch):
    seen = seen_problems(monkeypatch)
    run = learner(iterations=1, discount=0.9, trajectory_discount=1.0).run(ReturnExpert())
    assert [problem.critic.discount for problem in seen] == [0.9]
    trajectory = run.trajectories[3]
    whole = run.estimate.step_utilities(transitions([trajectory])).sum()
    np.testing.assert_allclose(run.estimate.trajectory_utilities([trajectory]), [whole], rtol=1e-12)
    assert learner(iterations=1, discount=0.9).run(ReturnExpert()).estimate.discount == 0.9


@pytest.mark.slow
def test_the_policy_update_takes_the_states_that_the_settings_allow(monkeypatch):
    problems = seen_problems(monkeypatch)
    options = SHORT | {"utility": "linear-program"}
    run = Learner("swing-up", seed=3, update_states=150, recent_iterations=2, **options).run(ReturnExpert())
    acted = [{tuple(state) for state in trajectory.states[:-1]} for trajectory in run.trajectories]
    seen = [problem.states for problem in problems]
    assert [len(states) for states in seen] == [120, 150, 150]
    recent = set().union(*acted[10:])  # of the two last iterations' 240
    assert {tuple(state) for state in seen[2]} < recent
    assert len(np.unique(seen[2], axis=0)) == 150
    again = Learner("swing-up", seed=3, update_states=150, recent_iterations=2, **options).run(ReturnExpert())
    assert fingerprint(again) == fingerprint(run)
    problems.clear()
    learner(iterations=1, update_states=150).run(ReturnExpert())
    assert [problem.states.shape for problem in problems] == [(200,)]  # discrete: all


@pytest.mark.slow
def test_the_bound_of_an_iteration_is_decided_once_and_followed_by_several_updates():
    asked = []

    def cautious(situation):
        asked.append((situation.iteration, situation.update.q_draws.shape[1]))
        return 0.2

    options = SHORT | {"hyperparameters": "given"}
    once, often, again = (
        Learner("swing-up", seed=3, schedule=cautious, updates_per_iteration=number, **options).run(ReturnExpert())
        for number in (1, 3, 3)
    )
    assert asked == 3 * [(1, 100), (2, 100), (3, 100)]
    assert [summary["updates"] for summary in once.iterations] == [1, 1, 1]
    assert max(summary["updates"] for summary in often.iterations) > 1
    for summary in often.iterations:
        assert summary["updates"] == 3 or summary["kl_fitted_policy"] >= NEARLY * 0.2
    assert fingerprint(again) == fingerprint(often)


@pytest.mark.slow
def test_compilations_do_not_grow_with_the_iterations():
    assert compilations_after(learner(iterations=1, max_steps=11), 0) > 0  # the counter counts
    assert compilations_after(learner(iterations=7, max_steps=11), 3) == 0


@pytest.mark.slow
@pytest.mark.empties_caches
def test_compilations_of_the_sampler_grow_with_its_capacity_only():
    # 11 answers an iteration: the third takes them beyond 32, the first capacity
    jax.clear_caches()  # or what other tests compiled would not be counted here
    many = {"trajectories_per_iteration": 12, "first_queries": 11, "queries_per_iteration": 11}
    run = learner(utility="posterior-mean", iterations=3, **many)
    assert 0 < compilations_after(run, 2) <= 9  # eight for the chains, one for the evidence
    assert len(run.preferences.pairs) > 32
    few = learner(utility="posterior-mean", iterations=4, trajectories_per_iteration=12)
    assert compilations_after(few, 0) == 0


@pytest.mark.slow
def test_a_continued_run_draws_the_same_posterior():
    changes = {"utility": "posterior-mean", "iterations": 4}
    straight, log = remembered(**changes)
    straight.run(ReturnExpert())
    assert fingerprint(straight)["draws"] is not None
    for length in range(2, len(log.entries), 5):
        assert fingerprint(learner(log.entries[:length], **changes).run(ReturnExpert())) == fingerprint(straight)


@pytest.mark.slow
def test_the_gridworld_is_learned_from_preferences():
    run = Learner("gridworld", preset="paper", iterations=7, seed=1000, evaluation_episodes=50).run(ReturnExpert())
    assert run.iterations[-1]["value"] > 3 * 44.34  # of the uniform policy
    assert all(summary["rhat_max"] < 1.01 for summary in run.iterations if summary["utility_converged"])


def newest_first(situation):
    return sorted(situation.new, reverse=True)


def test_a_run_follows_a_query_rule_of_the_users_own_and_goes_on_with_it(tmp_path):
    begun = start("gridworld", tmp_path / "run", query=newest_first, **QUICK)
    while len(begun.iterations) < 2:
        begun.tell([ReturnExpert()(*query.trajectories) for query in begun.ask()])
    with pytest.raises(ValueError, match=r"expected query= again, which the run was started with, got None"):
        resume(tmp_path / "run")
    with pytest.raises(ValueError, match=r"query: expected a function, because the settings say 'other', got 'eubo'"):
        resume(tmp_path / "run", query="eubo")
    whole = resume(tmp_path / "run", query=newest_first).run(ReturnExpert())
    asked = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    newcomers = [event["newcomer"] for event in asked if event["event"] == "asked"]
    assert newcomers[2:] == [19, 29]
    assert load(tmp_path / "run").iterations == whole.iterations  # reading needs no rule
    with pytest.raises(ValueError, match="query: expected a function, because the settings say 'other', got none"):
        Learner("gridworld", query="other")


@pytest.mark.parametrize("informative", [True, False])
def test_a_rule_is_told_of_answers_that_are_all_ties_where_ties_are_informative(informative):
    seen = []

    def rule(situation):
        seen.append(situation.only_ties)
        return newest_first(situation)

    answers = iter(["tie", "tie", "tie", "first", "tie"])
    run = learner(**(DRAWS | {"iterations": 4}), query=rule, informative_ties=informative)
    run.run(lambda first, second: next(answers))
    assert seen == ([2, 3, 0] if informative else [0, 0, 0])


@pytest.mark.parametrize("same_start", [False, True])
def test_the_last_trajectory_of_an_updated_policy_is_without_its_noise(same_start):
    options = QUICK | {"max_steps": 30, "answers": 4, "trajectories_per_iteration": 4, "same_start": same_start}
    log = Memory()
    run = Learner("CartPole-v1", noise_free=True, **(options | {"iterations": 3})).logged(log)
    run.run(ReturnExpert())
    policies = [entry.parts["policy"] for entry in log.entries if entry.event["event"] == "improved"]

    def as_most_probable(policy, trajectory):
        return np.array_equal([policy.mode(state) for state in trajectory.states[:-1]], trajectory.actions)

    for iteration, policy in zip((1, 2), policies, strict=False):
        *noisy, last = run.trajectories[4 * iteration : 4 * iteration + 4]
        assert as_most_probable(policy, last)
        assert not all(as_most_probable(policy, each) for each in noisy)
    assert not all(as_most_probable(run.state.first_policy, each) for each in run.trajectories[:4])
    environment = gymnasium.make("CartPole-v1")
    for number, trajectory in enumerate(run.trajectories):  # as a person sees it again
        observation, _ = environment.reset(seed=run.cycle.reset_seed(number))
        np.testing.assert_array_equal(observation, trajectory.states[0].astype(np.float32))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class WithoutMode(LinearGaussianPolicy):
    """A policy of a user's that does not know its most probable action."""

    mode = None


def test_the_trajectories_of_a_policy_without_a_mode_are_not_shown_as_if_they_had_no_noise():
    spaces = gymnasium.make("Pendulum-v1").observation_space, gymnasium.make("Pendulum-v1").action_space
    for kind, expected in ((LinearGaussianPolicy, True), (WithoutMode, False)):
        settings = Learner("Pendulum-v1", policy=kind.initial(*spaces, initial_scale=0.5)).settings
        assert (settings.rollouts.noise_free, settings.questions.against_kept) == (expected, expected)
    with pytest.raises(ValueError, match="policy: expected one with a mode because of noise_free, got a WithoutMode"):
        Learner("Pendulum-v1", policy=WithoutMode.initial(*spaces), noise_free=True)


@pytest.mark.parametrize(
    ("started", "kept", "followed"), [(None, 5, 5), (8, 3, 3), (8, 8, 7), (8, 12, 12)], ids=lambda number: str(number)
)
def test_the_favourite_of_a_start_is_of_the_iteration_that_followed_the_kept_policy(started, kept, followed):
    # at a restart after eight iterations the eighth policy was followed by none; one since then may be confirmed
    policy, best = NumberedPolicy(kept, "policy"), NumberedPolicy(9, "policy")
    restart = None if started is None else Restart(started, policy)
    state = LearnerState("policy", best, policy if restart is None else best, policy, restart=restart)
    assert learner().cycle._favourite(state) == followed


def everything(situation):
    return [situation.incumbent, *range(len(situation.trajectories) - 1, situation.incumbent, -1)]


def by_themselves(situation):
    return [situation.incumbent]


@pytest.mark.parametrize("same_start", [False, True])
def test_a_rule_may_name_the_incumbent_and_no_trajectory_is_compared_with_itself(same_start):
    answers = itertools.cycle(["first", "tie", "second"])
    options = {"same_start": same_start, "queries_per_iteration": 3, "query": everything}
    run = learner(**options).run(lambda first, second: next(answers))
    assert run.preferences.answers == 2 + 2 * 3
    assert all(first != second for first, second in (*run.preferences.pairs, *run.preferences.ties))
    assert len(set(run.preferences.undominated)) == len(run.preferences.undominated)


def test_a_rule_that_names_the_incumbent_alone_is_refused_before_anything_is_logged():
    run, log = remembered(query=by_themselves)
    run.ask()
    run.tell(["first"])
    with pytest.raises(ValueError, match="query rule by_themselves: expected a trajectory other than the undominated"):
        run.tell(["second"])
    assert [entry.event["event"] for entry in log.entries][-2:] == ["answered", "improved"]
    assert fingerprint(learner(log.entries).run(ReturnExpert()))["summaries"]  # another rule goes on


def test_a_run_compared_by_start_asks_as_at_first_while_all_is_skipped():
    run = learner(iterations=2, same_start=True).run(lambda first, second: "skip")
    assert (run.finished, run.preferences.answers, run.state.queries) == (True, 0, 9 + 9)
    told = learner(iterations=3, same_start=True)
    while questions := told.ask():
        told.tell(["skip" if told.state.iteration == 0 else ReturnExpert()(*questions[0].trajectories)])
    assert [summary["answers"] for summary in told.iterations] == [0, 2, 3]


def test_exploration_is_held_for_as_many_steps_as_the_settings_say(monkeypatch):
    held, rollout = [], rollouts.rollout
    monkeypatch.setattr(
        rollouts, "rollout", lambda *a, **options: held.append(options["hold"]) or rollout(*a, **options)
    )
    learner(iterations=2, exploration_hold=4).run(ReturnExpert())
    assert held == [4, 4]


@pytest.mark.slow
def test_exploration_is_held_for_a_share_of_the_first_episodes_where_they_end_early(monkeypatch):
    held, rollout = [], rollouts.rollout

    def watched(*arguments, **options):
        held.extend([options["hold"]] if "hold" in options else [])  # without, a policy is tried without its noise
        return rollout(*arguments, **options)

    monkeypatch.setattr(rollouts, "rollout", watched)

    options = {"centres": 10, "evaluation_episodes": 2, "trajectories_per_iteration": 3, "seed": 1}
    Learner(gymnasium.wrappers.TimeLimit(Push(80, ends=True), 400), iterations=2, **options).run(ReturnExpert())
    assert held == [10, 2]


class Ordinary:
    """A policy of five actions that cannot be compiled."""

    def sample(self, key, observation):
        return 2

    def probabilities(self, observations):
        return np.full((len(observations), 5), 0.2)

    def entropy(self, observation):
        return np.log(5)

    def kl_divergence(self, old, observations):
        return np.zeros(len(observations))

    def fit(self, observations, actions, sample_weights, *, rng, base_weights=None):
        return self


class WithoutEntropy:
    """All of a policy but its entropy."""

    sample, kl_divergence, fit = (None,) * 3


@pytest.mark.parametrize(
    ("policy", "expected"),
    [
        (TabularPolicy, "policy: expected a policy, an object, got the class TabularPolicy"),
        (WithoutEntropy(), "policy: expected a policy .*, got a WithoutEntropy without entropy"),
        (3, "policy: expected a policy .* or a kind by name, got 3"),
    ],
)
def test_what_a_policy_lacks_is_named(policy, expected):
    with pytest.raises(ValueError, match=expected):
        Learner("gridworld", policy=policy)


@pytest.mark.parametrize(
    ("env", "policy"),
    [
        ("gridworld", TabularPolicy.initial(Discrete(25), Discrete(3))),
        ("gridworld", TabularPolicy.initial(Discrete(10), Discrete(5))),
        ("gridworld", LinearGaussianPolicy.initial(Box(-1, 1, (2,)), Box(-1, 1, (1,)))),
        ("swing-up", LinearGaussianPolicy.initial(Box(-1, 1, (3,)), Box(-1, 1, (1,)))),
        ("swing-up", LinearGaussianPolicy.initial(Box(-1, 1, (2,)), Box(-1, 1, (2,)))),
        ("swing-up", TabularPolicy.initial(Discrete(25), Discrete(3))),
        ("gridworld", Ordinary()),
        ("gridworld", TabularPolicy(np.ones((25, 5)))),
    ],
)
def test_a_policy_that_does_not_suit_the_environment_is_refused(env, policy):
    with pytest.raises(ValueError, match=r"policy: expected one from .* to .*, got "):
        Learner(env, policy=policy)
