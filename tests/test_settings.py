"""Settings: every bad value is refused with its name, what was expected and what came."""

import json
from dataclasses import replace

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete

from bayespbrl.envs import SHORT_NAMES
from bayespbrl.events import LearnerState, NumberedPolicy, Restart
from bayespbrl.settings import OPTIONS, Settings, settings_for
from bayespbrl.settings.presets import DEFAULT, IDS, PAPER, TASKS
from bayespbrl.settings.tasks import Task

NAN, INFINITY = float("nan"), float("inf")
BAD = {
    "utility": ["posterior", "", None, 3],
    "likelihood": ["eq8", None],
    "policy": ["neural", None],
    "features": ["mine"],
    "environment": ["mine"],
    "query": ["entropy", "", None, 1],
    "expert": ["oracle"],
    "iterations": [0, -3, 2.0, True, "25", None, NAN],
    "kl_bound": [0, 0.0, -0.1, NAN, INFINITY, True, "0.3", None],
    "prior_scale": [0, -1.0, NAN, INFINITY, False],
    "steepness": [0, -5, NAN, -INFINITY],
    "bandwidth_factor": [0, NAN],
    "initial_action_scale": [0, -0.5, NAN],
    "fixed_point_ridge": [-1e-8, NAN, True],
    "projection_ridge": [-1e-8, INFINITY],
    "lapse_rate": [-0.1, 1.0, NAN, True],
    "discount": [1.0, -0.5, NAN, "0.98"],
    "trajectory_discount": [1.01, -0.5, NAN, "1", True],
    "wrong_answers": [-0.1, 1.1, NAN, True],
    "seed": [-1, 1.0, True, NAN, None],
    "trajectories_per_iteration": [0, 1, 2.5],
    "queries_per_iteration": [0, 11, True],
    "first_queries": [0, 10, 1.5],
    "evaluation_episodes": [0, NAN],
    "centres": [0, -300, 1.5],
    "update_states": [0, -1, 2.5],
    "max_steps": [0, -1, True, 10.0, 10**13],
    "recent_iterations": [0, -4, True, 2.0],
    "updates_per_iteration": [0, -1, True, 1.5, None],
    "unasked_iterations": [-1, True, 1.5, None],
    "exploration_hold": [0, -1, True, 2.0],
    "schedule": ["bold", None],
    "hyperparameters": ["chosen", None],
    "utility_bandwidth_factor": [0, -1.0, NAN],
    "normalised_utility": [None, 1, "yes"],
    "constant_utility": [None, 1, "yes"],
    "diffusion_utility": [None, 1, "yes"],
    "standardised_utility": [None, 1, "yes"],
    "informative_ties": [None, 1, "yes"],
    "noise_free": [None, 1, "yes"],
    "against_kept": [None, 1, "yes"],
    "preset": ["fast", "", None],
    "answers": [0, -1, 2.5, True],
    "same_start": [None, 1, "yes"],
    "clip_steps": [0, 1.5, "all"],
    "worthwhile": [None, 1, "yes"],
    "plain_draws": [0, 15, 200.0, True],
    "repeats": [None, 1, -0.1, "all"],
    "shared_repeats": [None, 1, "yes"],
    "checked": [None, 1, "yes"],
    "check_episodes": [None, 1, 2.5, True],
    "restart_iterations": [None, -1, 2.5, True],
    "effort_utility": [None, 1, "yes"],
    "critic_iterations": [0, -4, True, 2.0],
}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in BAD.items() for value in values])
def test_a_bad_value_is_refused_with_name_expected_and_got(name, value):
    with pytest.raises(ValueError, match=rf"^{name}: expected .*, got ") as refusal:
        Settings.from_options("gridworld", {name: value})
    assert repr(value)[:20] in str(refusal.value)


@pytest.mark.parametrize("utility", ["linear-program", "known-reward"])
@pytest.mark.parametrize("query", ["probably-better", "thompson", "information", "disagreement", "eubo"])
def test_a_query_rule_that_needs_a_posterior_is_refused_without_one(utility, query):
    message = f"^query: expected highest-utility with {utility}, which has no posterior, got '{query}'$"
    with pytest.raises(ValueError, match=message):
        settings_for("gridworld", utility=utility, query=query)
    assert settings_for("gridworld", utility=utility).questions.query == "highest-utility"
    assert settings_for("gridworld", utility="posterior-draw", query=query).questions.query == query


def test_every_option_is_checked():
    assert set(OPTIONS) == set(BAD)


def test_the_paper_preset_is_the_papers_protocol():
    settings = settings_for("gridworld", preset="paper")
    assert (settings.iterations, settings.rollouts.trajectories_per_iteration) == (25, 10)
    assert Settings("any").critic.discount == 0.98
    assert settings.critic.discount == 0.995  # the one departure, argued beside the preset
    assert settings.trajectory_discount == 0.995
    questions = settings.questions  # 26 answers in 25 iterations
    assert (questions.first_queries, questions.queries_per_iteration) == (2, 1)
    assert (settings.estimation.utility, settings.model.likelihood) == ("posterior-mean", "mixed")
    assert settings.rollouts.evaluation_episodes == 100
    assert (questions.answers, questions.query, settings.update.schedule) == (None, "highest-utility", "constant")
    assert (settings.update.updates_per_iteration, settings.update.checked, questions.same_start) == (1, False, False)


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_of_two_trajectories_there_is_one_question(preset):
    two = settings_for("SomebodysEnv-v3", task=TASK, preset=preset, trajectories_per_iteration=2)
    assert two.questions.first_queries == 1
    with pytest.raises(ValueError, match="first_queries: expected at most 1 with 2 trajectories, got 2"):
        settings_for("SomebodysEnv-v3", preset=preset, trajectories_per_iteration=2, first_queries=2)


def test_an_unknown_option_is_refused_by_name():
    with pytest.raises(ValueError, match=r"settings: expected options among .*steepness.*, got kl_bond"):
        settings_for("gridworld", kl_bond=0.3)


def test_changes_win_over_presets_none_too():
    assert settings_for("gridworld", answers=None, iterations=40).questions.answers is None
    with pytest.raises(ValueError, match=r"kl_bound: expected .* got None"):
        settings_for("gridworld", kl_bound=None)
    assert settings_for("gridworld", iterations=7).iterations == 7
    chosen = {"hyperparameters": "inferred", "trajectory_discount": 1.0}
    paper = settings_for("SomebodysEnv-v3", preset="paper", **chosen)
    assert paper == Settings("SomebodysEnv-v3", preset="paper")
    assert settings_for("SomebodysEnv-v3") == Settings.from_options("SomebodysEnv-v3", DEFAULT)


def test_the_papers_protocol_discounts_trajectories_as_q():
    """Eq. 1 has one discount; three tasks were measured with another."""
    discounts = {
        name: (settings := settings_for(name, preset="paper")).trajectory_discount / settings.critic.discount
        for name in ("gridworld", "bicycle", "acrobot", "SomebodysEnv-v3", "swing-up", "Pendulum-v1", "CartPole-v1")
    }
    assert [name for name, ratio in discounts.items() if ratio != 1] == ["swing-up", "Pendulum-v1", "CartPole-v1"]


COMPARED = {"against_kept": True, "noise_free": True}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seed": 2**63}, "seed: expected at most 9223372036854775807"),
        ({"wrong_answers": 0.3, "expert": "page"}, "wrong_answers: expected 0 with the expert page, got 0.3"),
        ({"against_kept": True}, "against_kept: expected false unless noise_free and checked, got true"),
        (
            {"against_kept": True, "noise_free": True, "checked": False},
            "against_kept: expected false unless noise_free",
        ),
        (
            COMPARED | {"trajectories_per_iteration": 2, "first_queries": 1},
            "expected at least 3 with against_kept, got 2",
        ),
        (
            COMPARED | {"utility": "linear-program"},
            "against_kept: expected false with linear-program, which has no post",
        ),
        (
            COMPARED | {"clip_steps": 20},
            "against_kept: expected false with clip_steps, because clips begin at any step",
        ),
    ],
)
def test_options_that_could_have_no_effect_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        settings_for("gridworld", **options)


def test_steepness_and_lapse_rate_are_inferred_unless_they_or_all_hyperparameters_are_given():
    model = settings_for("gridworld").model
    assert (model.steepness, model.lapse_rate) == (None, None)
    model = settings_for("gridworld", hyperparameters="given").model
    assert (model.steepness, model.lapse_rate) == (5.0, 0.0)
    model = settings_for("gridworld", steepness=3.0).model
    assert (model.steepness, model.lapse_rate) == (3.0, None)
    model = settings_for("gridworld", hyperparameters="given", lapse_rate=0.2).model
    assert (model.steepness, model.lapse_rate) == (5.0, 0.2)


TASK = Task(Box(-1.0, 1.0, (3,)), Box(-1.0, 1.0, (1,)), horizon=200)


@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize("env", [*PAPER, "SomebodysEnv-v3"])
def test_every_preset_is_valid_and_survives_json(env, preset):
    settings = settings_for(env, seed=5, preset=preset, task=TASK)
    assert settings.preset == preset
    assert Settings.from_options(env, json.loads(json.dumps(settings.options()))) == settings


@pytest.mark.parametrize(("short", "name"), SHORT_NAMES.items())
@pytest.mark.parametrize("preset", ["default", "paper"])
def test_a_preset_is_found_by_short_name_and_by_id(short, name, preset):
    assert IDS[name] == short
    assert settings_for(name, preset=preset).options() == settings_for(short, preset=preset).options()
    assert TASKS[short].items() <= settings_for(short).options().items()


def test_the_default_derives_from_spaces_and_horizon_what_tasks_differ_in():
    def derived(task):
        settings = settings_for("SomebodysEnv-v3", task=task)
        return settings.critic.discount, settings.rollouts.exploration_hold, settings.features.bandwidth_factor

    assert derived(TASK) == (0.98, None, 0.5)
    assert derived(Task(Box(-1.0, 1.0, (4,)), Discrete(2), horizon=500)) == (0.992, 1, 1.0)
    assert derived(Task(Box(-1.0, 1.0, (17,)), Box(-1.0, 1.0, (6,)), horizon=1000)) == (0.995, None, 2.0)
    assert settings_for("SomebodysEnv-v3", task=TASK, discount=0.9).critic.discount == 0.9


def test_where_states_are_discrete_goals_may_be_rare():
    def options(env, task):
        settings = settings_for(env, task=task)
        number, critic = settings.rollouts.trajectories_per_iteration, settings.update.critic_iterations
        rare = (settings.features.standardised_utility, settings.questions.informative_ties)
        assert settings.rollouts.noise_free == rare[0]
        return rare, critic, settings.update.restart_iterations, number

    short = [np.zeros(9)] * 2
    table = Task(Discrete(16), Discrete(4), horizon=100, random_episodes=lambda most, hold: short)
    assert options("SomebodysEnv-v3", table) == ((True, True), None, 0, 100)
    longer = replace(table, random_episodes=lambda most, hold: [np.zeros(min(most, 50) + 1)])
    assert options("SomebodysEnv-v3", longer) == ((True, True), None, 0, 20)
    assert options("SomebodysEnv-v3", replace(table, observation_space=Box(-1.0, 1.0, (2,)))) == (
        (False, False),
        4,
        8,
        20,
    )
    assert options("SomebodysEnv-v3", replace(longer, horizon=10)) == ((True, True), None, 0, 80)
    assert not settings_for("SomebodysEnv-v3", task=table, checked=False).rollouts.noise_free  # it keeps the newest
    assert options("gridworld", table) == ((False, False), 4, 0, 10)  # as its figures were measured


def test_continuous_actions_have_effort_and_their_policies_are_compared_without_noise():
    def options(env="SomebodysEnv-v3", **chosen):
        settings = settings_for(env, task=TASK, **chosen)
        return settings.features.effort_utility, settings.rollouts.noise_free, settings.questions.against_kept

    assert options() == (True, True, True)
    assert options(expert="page") == (False, False, False)  # people see states, and would wait
    for measured_without in ("swing-up", "bicycle", "acrobot"):
        assert options(measured_without) == (False, False, False)
    assert options(preset="paper") == (False, False, False)
    for without in ({"noise_free": False}, {"checked": False}):
        assert options(**without) == (True, False, False)
    for without in (
        {"clip_steps": 20},
        {"utility": "linear-program"},
        {"utility": "known-reward"},
        {"trajectories_per_iteration": 2},
    ):
        assert options(**without) == (True, True, False)
    discrete = replace(TASK, action_space=Discrete(2))
    assert not settings_for("SomebodysEnv-v3", task=discrete).questions.against_kept


@pytest.mark.parametrize(("answers", "left"), [(4, 0), (5, 1), (14, 1), (15, 2), (20, 2), (50, 5)])
def test_a_tenth_of_the_answers_is_left_for_a_policy_that_is_started_anew(answers, left):
    settings = settings_for("SomebodysEnv-v3", task=TASK, answers=answers)
    assert settings.confirmations == settings.with_confirmations - settings.most_iterations == left
    assert settings.restarts(iteration=5, answers=answers - left, unasked=0)
    assert not settings.restarts(iteration=5, answers=answers - left - 1, unasked=0)
    assert settings_for("SomebodysEnv-v3", task=TASK, answers=answers, iterations=9).confirmations == 0
    assert settings_for("SomebodysEnv-v3", task=TASK, answers=answers, restart_iterations=0).confirmations == 0
    # beyond its last iteration a run goes on while its newest policy is to be asked about and an answer is left for it
    last = settings.last_iteration(20)
    state = replace(LearnerState.begun("policy"), restart=Restart(20, NumberedPolicy(15, "policy")), nominated=True)
    for beyond in range(-1, 8):
        reached = replace(state, iteration=last + beyond)
        assert reached.left(settings) == answers
        assert reached.finished(settings) == (beyond >= left)
        assert replace(reached, nominated=False).finished(settings) == (beyond >= 0)


def test_discrete_states_have_one_kind_of_features():
    table = Task(Discrete(16), Discrete(4), horizon=100)
    features = settings_for("SomebodysEnv-v3", task=table, diffusion_utility=True).features
    assert (features.diffusion_utility, features.standardised_utility) == (True, False)
    with pytest.raises(ValueError, match="standardised_utility: expected false with diffusion_utility, got true"):
        settings_for("SomebodysEnv-v3", diffusion_utility=True, standardised_utility=True)


def measured(spreads, steps=100, actions=None):
    """A task of 100 steps, whose states have the given deviations where actions are repeated for so many steps."""

    def episodes(limit, hold):
        signs = np.where(np.arange(min(steps, limit) + 1) % 2, 1.0, -1.0)
        return [signs[:, None] * np.array(spreads.get(hold, (0.0, 0.0)))]

    return Task(Box(-1.0, 1.0, (2,)), actions or Discrete(2), horizon=100, random_episodes=episodes)


def test_random_actions_are_repeated_for_as_many_steps_as_spread_all_dimensions_most():
    spreads = {1: (1000.0, 0.1), 2: (900.0, 1.0), 4: (100.0, 0.9)}  # shares of 0.55, 0.95 and 0.5
    assert measured(spreads).longer_hold() == {"exploration_hold": 2}
    assert measured(spreads, steps=91).longer_hold() == {"exploration_hold": 2}
    assert measured(spreads, steps=89).longer_hold() == {}  # random actions end episodes
    assert measured(spreads, actions=Box(-1.0, 1.0, (1,))).longer_hold() == {}
    # an episode has ten different actions at least
    assert measured(spreads | {8: (2000.0, 2.0)}).longer_hold() == {"exploration_hold": 8}
    assert measured(spreads | {16: (2000.0, 2.0)}).longer_hold() == {"exploration_hold": 2}
    assert measured({}).longer_hold() == {"exploration_hold": 1}


@pytest.mark.parametrize(
    ("steps", "task", "options", "number"),
    [
        (40, {}, {}, 10),
        (39.5, {}, {}, 11),
        (8, {}, {}, 50),
        (1, {}, {}, 100),
        (8, {"action_space": Discrete(2)}, {}, 20),
        (8, {"horizon": 40}, {}, 10),  # no longer than that if nothing ends it
        (8, {}, {"trajectories_per_iteration": 12}, 12),
        (8, {}, {"preset": "paper"}, 10),
    ],
)
def test_where_episodes_end_at_once_an_iteration_takes_more_of_them(steps, task, options, number):
    def random_episodes(most, hold):  # two, of this mean
        return [np.zeros((1 + int(min(length, most)), 3)) for length in (steps - steps % 1, steps + steps % 1)]

    task = replace(TASK, random_episodes=random_episodes, **task)
    assert settings_for("SomebodysEnv-v3", task=task, **options).rollouts.trajectories_per_iteration == number
    assert settings_for("swing-up", task=task).rollouts.trajectories_per_iteration == 10  # its own


@pytest.mark.parametrize(
    ("widest", "steps", "task", "options", "hold"),
    [
        (8, 200, {}, {}, 8),
        (1, 200, {}, {}, 1),
        (64, 200, {}, {}, 16),  # ten actions an episode at least
        (8, 20, {"horizon": 20}, {}, 2),
        (8, 3, {"horizon": 3}, {}, 1),
        (8, 170, {}, {}, 1),  # episodes end: to stay is what counts
        (8, 200, {"action_space": Box(-1.0, 1.0, (1,))}, {}, None),
        (8, 200, {"observation_space": Discrete(4)}, {}, 1),
        (8, 200, {}, {"exploration_hold": 3}, 3),
        (8, 200, {}, {"preset": "paper"}, 1),
    ],
)
def test_where_random_actions_end_no_episode_those_are_repeated_that_spread_the_states_most(
    widest, steps, task, options, hold
):
    def random_episodes(most, held):  # one dimension that is much wider than the other, and one that never varies
        width = 1 / (1 + abs(np.log2(held / widest)))
        line = np.linspace(0, 1, min(steps, most) + 1)
        return [np.stack([1000 * width * line, width * line, 0 * line], axis=1)] * 2

    task = replace(TASK, **{"action_space": Discrete(3), "random_episodes": random_episodes} | task)
    assert settings_for("SomebodysEnv-v3", task=task, **options).rollouts.exploration_hold == hold
    assert settings_for("gridworld", task=task).rollouts.exploration_hold == 3  # its own


def test_iterations_follow_from_the_budget_of_answers():
    settings = settings_for("SomebodysEnv-v3", answers=6, restart_iterations=0)
    assert (settings.iterations, settings.most_iterations) == (None, 14)
    assert not settings.finished(iteration=6, answers=5, unasked=4)
    assert not settings.finished(iteration=9, answers=6, unasked=4)
    assert settings.finished(iteration=9, answers=6, unasked=5)  # the policy has caught up with the last answer
    assert settings.finished(iteration=13, answers=3, unasked=10)  # nothing was worth asking
    assert settings.finished(iteration=14, answers=5, unasked=0)
    assert not settings.restarts(iteration=13, answers=6, unasked=4)

    restarted = settings_for("SomebodysEnv-v3", answers=6)
    assert restarted.most_iterations == 17
    restarts = [restarted.restarts(8, 5, 9), restarted.restarts(5, 6, 0), restarted.restarts(8, 3, 10)]
    assert (*restarts, restarted.restarts(9, 5, 0)) == (False, True, True, True)
    assert not restarted.restarts(4, 6, 1)
    few = settings_for("SomebodysEnv-v3", answers=1)
    assert (few.most_iterations, few.restarts(4, 1, 3), few.restarts(5, 1, 4)) == (13, False, True)
    assert not restarted.finished(iteration=9, answers=6, unasked=5)
    assert not restarted.finished(iteration=9, answers=6, unasked=9, started=2)
    assert restarted.finished(iteration=10, answers=6, unasked=9, started=2)
    assert restarted.finished(iteration=17, answers=5, unasked=0, started=10)
    assert [restarted.last_iteration(started) for started in (0, 2, 9, 12)] == [17, 10, 17, 17]

    given = settings_for("SomebodysEnv-v3", answers=6, iterations=20)  # as many iterations as the user said
    assert not given.restarts(iteration=12, answers=6, unasked=4)
    assert given.finished(iteration=12, answers=6, unasked=5)
    table = settings_for("SomebodysEnv-v3", task=Task(Discrete(5), Discrete(2), horizon=10), answers=6)
    assert not table.restarts(iteration=9, answers=6, unasked=5)

    paper = settings_for("gridworld", preset="paper")
    assert not paper.finished(iteration=24, answers=99, unasked=20)
    assert paper.finished(iteration=25, answers=0, unasked=0)


@pytest.mark.parametrize(
    ("options", "query"),
    [
        ({"utility": "known-reward"}, "highest-utility"),
        ({"schedule": "constant"}, "highest-utility"),
        ({"schedule": "constant", "query": "thompson"}, "thompson"),
    ],
)
def test_a_choice_that_rules_out_the_default_question_takes_the_papers(options, query):
    assert settings_for("SomebodysEnv-v3", **options).questions.query == query


@pytest.mark.parametrize("value", [1e-6, 1, np.float64(0.3)])
def test_whole_numbers_and_numpy_floats_are_numbers(value):
    assert settings_for("gridworld", kl_bound=value).update.kl_bound == value


def test_each_option_is_read_by_one_part_and_every_part_keeps_its_own_defaults():
    settings, given = Settings("any"), Settings.from_options("any", Settings("any").options())
    assert settings == given
    assert settings.own_parts == ()
    assert settings_for("any", schedule="other", expert="other").own_parts == ("expert", "schedule")
