"""The baselines: PF's error model, planner, posterior and choice; EPMC's estimates and policy; both as cells."""

import itertools
import json

import gymnasium
import jax
import numpy as np
import pytest
from test_trials import without_processes
from toys import Push

import bayespbrl
from bayespbrl import rollouts
from bayespbrl.baselines import epmc, every_visit_preferences, pf, programming_by_feedback
from bayespbrl.diagnostics.report.write import write_report
from bayespbrl.envs.gridworld import DYNAMICS, REWARDS, START
from bayespbrl.envs.opening import open_environment
from bayespbrl.experts import MarginExpert, ReturnExpert
from bayespbrl.studies import Study
from bayespbrl.studies.baseline_trials import read_baseline
from bayespbrl.studies.declaration import parsed


def small_problem(seed=0, states=4, actions=2):
    rng = np.random.default_rng(seed)
    return rng.dirichlet(np.ones(states), (states, actions)), rng.normal(size=(3, states))


def test_the_error_model_is_the_experts_and_the_average_over_its_threshold():
    expert = MarginExpert(0.25)
    for margin in (0.01, 0.1, 0.2, 0.3):
        right = pf.preferred_probability(margin, 0.25)
        assert right == pytest.approx(1 - expert.error_probability(margin))
        assert pf.preferred_probability(-margin, 0.25) == pytest.approx(1 - right)
        thresholds = np.linspace(0, 0.25, 200_001)[1:]
        assert right == pytest.approx(np.mean(np.minimum(1, 0.5 + margin / thresholds / 2)), abs=1e-4)
    assert pf.preferred_probability(np.array([0.0, 1.0, -1.0])).tolist() == [0.5, 1.0, 0.0]


def test_the_planner_finds_the_best_of_all_policies():
    table, utilities = small_problem()
    states = np.arange(4)
    for found, utility in zip(pf.planned(table, utilities, 0.9), utilities, strict=True):

        def value(policy, utility=utility):
            moves = table[states, list(policy)]
            return np.linalg.solve(np.eye(4) - 0.9 * moves, moves @ utility)

        best = np.max([value(policy) for policy in itertools.product(range(2), repeat=4)], axis=0)
        np.testing.assert_allclose(value(found), best)


def test_the_planner_is_value_iteration_on_the_gridworld():
    table, reward = DYNAMICS.transition_table(), REWARDS.ravel()
    q = np.zeros((25, 5))
    for _ in range(2000):
        q = table @ (reward + 0.98 * q.max(axis=1))
    actions = pf.planned(table, reward[None])[0]
    np.testing.assert_allclose(q[np.arange(25), actions], q.max(axis=1))
    share = pf.expected_visits(table, actions[None], start=START, steps=300)[0]
    assert 300 * share @ reward == pytest.approx(DYNAMICS.optimal_return, rel=1e-3)
    assert share.sum() == pytest.approx(1.0)


def test_the_posterior_is_that_of_rejection_and_prefers_what_is_consistent():
    rng = np.random.default_rng(3)
    differences = np.array([[0.3, -0.1, 0.0], [0.05, 0.1, -0.1]])
    log_p = pf.log_likelihood(differences)
    points = pf.moved(rng.standard_normal((4000, 3)), log_p, rng, moves=20)
    prior = rng.standard_normal((60_000, 3))
    kept = prior[rng.uniform(size=len(prior)) < np.exp(log_p(prior))]
    for of in (pf.unit, lambda x: np.abs(pf.unit(x))):
        np.testing.assert_allclose(of(points).mean(axis=0), of(kept).mean(axis=0), atol=0.03)
    assert np.mean(points @ differences[0] > 0) > 0.9
    assert np.mean(prior @ differences[0] > 0) == pytest.approx(0.5, abs=0.02)


def test_the_question_has_the_highest_expected_utility_of_selection():
    table, weights = small_problem(5)
    best = np.array([0.4, 0.3, 0.2, 0.1])
    candidates = {tuple(policy) for policy in pf.planned(table, np.vstack([weights, weights.mean(axis=0)]))}
    assert len(candidates) > 1

    def expected(policy):
        share, now = np.zeros(4), np.eye(4)[0]
        for _ in range(50):
            now = now @ table[np.arange(4), list(policy)]
            share += now / 50
        total = 0.0
        for w in weights:
            wins = float(pf.preferred_probability(w @ (share - best)))
            total += wins * (w @ share) + (1 - wins) * (w @ best)
        return total

    found = pf.chosen(table, weights, best, start=0, steps=50)
    assert tuple(found) == max(candidates, key=expected)


@pytest.mark.slow
def test_pf_learns_from_the_answers_and_not_without_them(monkeypatch):
    monkeypatch.setattr(pf, "DRAWS", 40)
    monkeypatch.setattr(pf, "MOVES", 15)
    environment = open_environment("gridworld")

    def value(expert, seed):
        *_, last = programming_by_feedback(environment, expert, answers=8, seed=seed, max_steps=100)
        assert last.answers == 8
        assert last.pairs <= 8
        policy = np.asarray(last.policy.table).argmax(axis=1)
        share = pf.expected_visits(DYNAMICS.transition_table(), policy[None], start=START, steps=100)[0]
        return share @ REWARDS.ravel()

    honest = [value(ReturnExpert(), seed) for seed in (1, 2, 3)]
    contrary = [value(lambda a, b: ReturnExpert()(b, a), seed) for seed in (1, 2, 3)]
    assert np.median(honest) > 0.4 > 0.1 > np.median(contrary)
    assert value(ReturnExpert(), 1) == honest[0]
    assert next(programming_by_feedback("gridworld", lambda a, b: "tie", answers=1, seed=1)).pairs == 0


def test_baselines_refuse_tasks_that_are_not_theirs():
    with pytest.raises(ValueError, match="baseline pf: expected a task with a known transition_table"):
        next(programming_by_feedback("swing-up", ReturnExpert(), answers=1, seed=0))
    with pytest.raises(ValueError, match="baseline epmc: expected observations in a bounded Box"):
        next(every_visit_preferences("gridworld", ReturnExpert(), answers=1, seed=0))
    twelve = Push(1)
    twelve.observation_space = gymnasium.spaces.Box(-1, 1, (12,))  # two billion cells
    with pytest.raises(ValueError, match="observations of at most 8 dimensions, as each has 6 cells, got 12"):
        epmc.GridPolicy.initial(twelve)


def test_a_preference_says_the_more_the_fewer_states_both_visited():
    before = np.full((3, 2, 2), 0.5)
    one = epmc.sampled(([0], [1]), ([0], [0]), before)
    assert one[0].tolist() == [[0.5, 0.0], [1.0, 0.5]]
    assert one[1:].tolist() == before[1:].tolist()
    two = epmc.sampled(([0, 1], [1, 1]), ([0, 1], [0, 1]), before)
    assert two[0].tolist() == [[0.5, 0.25], [0.75, 0.5]]
    assert two[1].tolist() == before[1].tolist()  # the same action says nothing
    # visits that contradict each other are averaged: twice for the action 1, once against it
    both = epmc.sampled(([0, 0], [1, 1]), ([0, 0, 0], [0, 0, 1]), before)
    assert both[0, 1, 0] == 1.0
    mixed = epmc.sampled(([0, 0, 0], [1, 1, 0]), ([0, 0], [0, 1]), before)
    assert mixed[0, 1, 0] == pytest.approx(0.5 + (2 - 1) / 3 / 2)
    assert mixed[0, 0, 1] == pytest.approx(1 - mixed[0, 1, 0])


def test_the_better_of_two_arms_is_found_in_spite_of_wrong_answers():
    rng, better, gains = np.random.default_rng(0), np.full((1, 2, 2), 0.5), np.zeros((1, 2))
    for _ in range(300):
        arms = rng.choice(2, size=2, p=epmc.exp3(gains)[0])
        order = arms if (arms[0] > arms[1]) == (rng.uniform() < 0.8) else arms[::-1]
        found = epmc.sampled(([0], [order[0]]), ([0], [order[1]]), better)
        better = better + 0.05 * (found - better)
        gains += epmc.action_values(better)
    assert better[0, 1, 0] == pytest.approx(0.8, abs=0.15)
    assert epmc.best_actions(better).tolist() == [[0.0, 1.0]]
    assert epmc.exp3(gains)[0, 1] > 0.6
    assert epmc.exp3(gains).sum() == pytest.approx(1)
    assert epmc.exp3(gains).min() >= epmc.EXPLORATION / 2


def test_values_of_actions_are_those_of_pairwise_coupling():
    strengths = np.array([0.2, 0.3, 0.5])
    better = (strengths[:, None] / (strengths[:, None] + strengths))[None]  # Bradley and Terry's: coupling is exact
    np.testing.assert_allclose(epmc.action_values(better), [strengths])
    assert epmc.best_actions(np.full((1, 3, 3), 0.5)).tolist() == [[1 / 3] * 3]


@pytest.mark.slow
def test_epmc_learns_which_action_is_the_best():
    *_, last = every_visit_preferences(Push(4), ReturnExpert(), answers=40, seed=4, max_steps=4)
    assert last.answers == 40
    assert 15 < last.pairs <= 40
    table = np.asarray(last.policy.table)
    visited = np.asarray(last.policy.cells(np.array([[0.0], [0.25], [0.5], [0.75]])))
    assert np.asarray(last.policy.actions)[:, 0].tolist() == [-1, 0, 1]
    assert table[visited].argmax(axis=1).tolist().count(2) >= 3
    assert next(every_visit_preferences(Push(4), lambda a, b: "tie", answers=1, seed=0, max_steps=4)).pairs == 0


def test_what_an_action_was_taken_in_is_the_cell_that_the_policy_acted_by():
    environment = open_environment("swing-up")  # it starts with speed 0, on the border of two cells
    policy = epmc.GridPolicy.initial(environment)
    best = np.random.default_rng(0).integers(3, size=len(policy.table))
    certain = policy.with_table(np.eye(3)[best])
    for trajectory in rollouts.rollout(environment, certain, key=jax.random.key(0), episodes=3):
        cells, numbers = certain.visited(trajectory)
        assert numbers.tolist() == best[cells].tolist()


def test_a_dimension_that_never_varies_has_one_cell():
    flat = Push(1)
    flat.observation_space = gymnasium.spaces.Box(np.array([0.0, 1.0]), np.array([1.0, 1.0]), dtype=np.float64)
    policy = epmc.GridPolicy.initial(flat)
    assert np.asarray(policy.cells(np.array([[0.5, 1.0], [0.99, 1.0]]))).tolist() == [3, 5]


@pytest.mark.parametrize("ask", [every_visit_preferences, programming_by_feedback])
@pytest.mark.parametrize("wrong", [{"answers": 0}, {"answers": True}, {"answers": 1.5}, {"seed": -1}])
def test_baselines_refuse_answers_and_seeds_that_are_no_whole_numbers(ask, wrong):
    (name,) = wrong
    with pytest.raises(ValueError, match=f"{name}: expected a whole number >= {int(name == 'answers')}, got"):
        next(ask("swing-up", ReturnExpert(), **{"answers": 1, "seed": 0} | wrong))


@pytest.mark.parametrize("ask", [every_visit_preferences, programming_by_feedback])
def test_a_question_that_is_skipped_takes_no_answer_of_the_budget(ask):
    task = {every_visit_preferences: Push(4), programming_by_feedback: "gridworld"}[ask]
    said = iter(["skip", "first", "skip", "tie", "skip", "second"] + ["skip"] * 99)
    steps = list(ask(task, lambda first, second: next(said), answers=3, seed=0, max_steps=4))
    assert [(step.answers, step.pairs) for step in steps] == [(1, 1), (2, 1), (3, 2)]
    assert not list(ask(task, lambda first, second: "skip", answers=2, seed=0, max_steps=4))


DECLARATION = """
seed = 2985
trials = 1
[options]
preset = "paper"
iterations = 2
max_steps = 20
evaluation_episodes = 2
[tasks.gridworld]
[methods.pf]
baseline = "pf"
"""


@pytest.mark.parametrize(("baseline", "task"), [("pf", "swing-up"), ("epmc", "gridworld")])
def test_a_baseline_on_a_task_that_is_not_its_own_is_refused_before_anything_runs(tmp_path, baseline, task):
    text = DECLARATION.replace('"pf"', f'"{baseline}"').replace("tasks.gridworld", f"tasks.{task}")
    with pytest.raises(ValueError, match=f"study tiny, {task}/pf: baseline {baseline}: expected"):
        Study.prepare(parsed(text, "tiny"), tmp_path / "tiny")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_baseline_is_a_cell_of_a_study_with_a_line_for_each_answer(tmp_path, monkeypatch):
    monkeypatch.setattr(pf, "DRAWS", 20)
    without_processes(monkeypatch)
    study = Study.prepare(parsed(DECLARATION, "tiny"), tmp_path / "tiny")
    assert study.run() == []
    lines = (tmp_path / "tiny" / "iterations.csv").read_text().splitlines()
    assert [line.split(",")[6] for line in lines[1:]] == ["1", "2", "3"]  # two answers first, then one an iteration
    again = Study.prepare(parsed(DECLARATION, "tiny"), tmp_path / "tiny")
    assert again.finished == 1
    for read in (write_report, bayespbrl.load, bayespbrl.resume):
        with pytest.raises(ValueError, match=r"expected a run of the learner, got a trial of a baseline: see its base"):
            read(tmp_path / "tiny/gridworld/pf/seed-2985")
    file = tmp_path / "tiny/gridworld/pf/seed-2985/baseline.json"
    whole = json.loads(file.read_text())
    without_value = [entry | {"value": "much"} for entry in whole["iterations"]]
    for damage, told in (
        ("", "expected the values of a baseline"),
        ("[]", "expected at least one iteration"),
        ({"iterations": []}, "expected at least one iteration"),
        ({"iterations": "abc"}, "expected at least one iteration"),
        ({"iterations": [1]}, "expected answers and value in iteration 1"),
        (whole | {"iterations": without_value}, "expected answers and value in iteration 1"),
        ({"iterations": whole["iterations"]}, "expected seed, env and utility"),
        (whole | {"iterations": [whole["iterations"][0] | {"seconds": None}]}, "expected a number as seconds_utility"),
    ):
        file.write_text(damage if isinstance(damage, str) else json.dumps(damage))
        with pytest.raises(ValueError, match=told):
            read_baseline(file.parent)
        assert list(Study.prepare(parsed(DECLARATION, "tiny"), tmp_path / "tiny").rows[0].damaged) == [2985]
    with pytest.raises(ValueError, match=r"methods\.pf, baseline: expected one of pf, epmc"):
        parsed(DECLARATION.replace('baseline = "pf"', 'baseline = "dqn"'), "tiny")
