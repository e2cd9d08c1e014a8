"""From draws of the weights to returns, rankings, Q and greedy actions: on cases that can be written down."""

import itertools
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import jax
import matplotlib.pyplot
import numpy as np
import pytest
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bayespbrl import Learner, ReturnExpert, load
from bayespbrl.diagnostics.uncertainty import (
    greedy_probabilities,
    plot_greedy,
    plot_ranking,
    plot_returns,
    q_draws,
    ranking_probabilities,
    return_draws,
    thinned,
)
from bayespbrl.features import OneHot
from bayespbrl.improvement.q_function import CriticData, estimate_q
from bayespbrl.models import PreferenceModel
from bayespbrl.trajectories import Trajectory, trajectory_features, transitions
from bayespbrl.utility.comparisons import Comparisons
from bayespbrl.utility.inference import Estimation, estimate


def staying(state, steps=4):
    return Trajectory(np.full(steps + 1, state), np.zeros(steps, dtype=int), np.zeros(steps))


TRAJECTORIES = [staying(0), staying(1), staying(2)]


@cache
def fitted(method="posterior-mean"):
    """The estimate from one answer, 2 ≻ 1."""
    comparisons = Comparisons.among(TRAJECTORIES, [(2, 1)], discount=0.9)
    return estimate(comparisons, OneHot(3), Estimation(utility=method), PreferenceModel(), seed=0)


def given_returns(values):
    """Draws (S, n) as two chains of a data set."""
    draws = np.reshape(values, (2, -1, np.shape(values)[1]))
    return xr.Dataset({"returns": (("chain", "draw", "trajectory"), draws)}, {"trajectory": range(draws.shape[2])})


def given_q(values):
    """Draws (S, states, actions) as one chain of a data set."""
    return xr.Dataset(
        {"q": (("chain", "draw", "state", "action"), np.asarray(values, dtype=float)[None])},
        {"action": [10, 20, 30]},
        {"converged": 0},
    )


# Draws.


def test_draws_of_returns_are_draws_of_the_weights_times_feature_sums():
    utility = fitted()
    sums = trajectory_features(TRAJECTORIES, OneHot(3), discount=0.9)
    weights = utility.posterior["posterior"]["utility_weights"].values / utility.scales[0]
    all_of_them = return_draws(utility, TRAJECTORIES, number=10**9)["returns"]
    np.testing.assert_allclose(all_of_them, weights @ sums.T, rtol=1e-12)
    some = return_draws(utility, TRAJECTORIES, number=100)
    assert some["returns"].sizes["chain"] * some["returns"].sizes["draw"] <= 100
    assert np.isin(some["returns"].values, all_of_them.values).all()
    assert (some.attrs["converged"], some.attrs["rhat_max"]) == (1, utility.quality.rhat_max)


def test_the_probability_to_be_better_matches_quadrature_over_the_only_margin():
    # One answer, 2 ≻ 1: with the difference scaled to length 1 and K = 1 the margin is z ~ N(0, 1), and the posterior
    # density of z ∝ N(z) sigmoid(5 z).
    z = np.linspace(-10, 10, 20001)
    density = np.exp(-0.5 * z**2) / (1 + np.exp(-5 * z))
    exact = density[z > 0].sum() / density.sum()
    ranking = ranking_probabilities(return_draws(fitted(), TRAJECTORIES, number=4000))
    assert float(ranking["better_probability"][2, 1]) == pytest.approx(exact, abs=0.02)
    # 0 was never compared, and w → −w with 1 and 2 exchanged leaves the posterior as it is
    assert float(ranking["better_probability"][0, 1] + ranking["better_probability"][0, 2]) == pytest.approx(
        1.0, abs=0.05
    )


def test_a_thinned_posterior_has_the_draws_that_fewer_draws_are():
    utility = fitted()
    some = thinned(utility.posterior, 40)
    sizes = some["posterior"].sizes
    assert some["sample_stats"].sizes["draw"] == sizes["draw"] == 40 / sizes["chain"]
    draws = replace(utility, posterior=some).trajectory_draws(TRAJECTORIES)
    np.testing.assert_array_equal(draws, utility.trajectory_draws(TRAJECTORIES, number=40))
    with pytest.raises(ValueError, match="number: expected a whole number >= 1, got 0"):
        thinned(utility.posterior, 0)


# Rankings.


def test_the_ranking_counts_draws():
    ranking = ranking_probabilities(given_returns([[3, 2, 1], [3, 1, 2], [1, 2, 3], [9, 8, -7]]))
    np.testing.assert_allclose(ranking["rank_probability"], [[0.75, 0, 0.25], [0, 0.75, 0.25], [0.25, 0.25, 0.5]])
    np.testing.assert_allclose(ranking["best_probability"], [0.75, 0, 0.25])
    np.testing.assert_allclose(ranking["expected_rank"], [1.5, 2.25, 2.25])
    np.testing.assert_allclose(ranking["better_probability"], [[0.5, 0.75, 0.75], [0.25, 0.5, 0.5], [0.25, 0.5, 0.5]])
    assert ranking["rank"].values.tolist() == [1, 2, 3]


def test_equal_returns_share_their_ranks():
    ranking = ranking_probabilities(given_returns([[5, 5, 1, 5], [2, 0, 0, 3]]))
    np.testing.assert_allclose(ranking["rank_probability"][0], np.array([1 / 3, 1 / 3 + 1, 1 / 3, 0]) / 2)
    np.testing.assert_allclose(ranking["rank_probability"][2], np.array([0, 0, 1 / 2, 1 + 1 / 2]) / 2)
    np.testing.assert_allclose(ranking["expected_rank"], [2, 2.75, 3.75, 1.5])
    np.testing.assert_allclose(ranking["better_probability"][0], [0.5, 0.75, 1.0, 0.25])


def test_ranks_of_random_draws_agree_with_sorting_and_every_row_and_column_is_a_distribution():
    draws = np.random.default_rng(2).normal(size=(500, 6)) + np.linspace(0, 1, 6)
    ranking = ranking_probabilities(given_returns(draws))
    places = np.argsort(np.argsort(-draws, axis=1), axis=1)
    table = ranking["rank_probability"].values
    for trajectory, rank in itertools.product(range(6), repeat=2):
        assert table[trajectory, rank] == pytest.approx(np.mean(places[:, trajectory] == rank), abs=1e-12)
    np.testing.assert_allclose(table.sum(axis=0), 1)
    np.testing.assert_allclose(table.sum(axis=1), 1)
    pairs = ranking["better_probability"].values
    np.testing.assert_allclose(pairs + pairs.T, 1)
    np.testing.assert_allclose(ranking["expected_rank"], 1 + (1 - pairs).sum(axis=1) - 0.5)  # how many are better


# Q.


@pytest.fixture(scope="module")
def grid():
    """Thirty trajectories of a uniform policy and the policy that follows from two answers."""
    learner = Learner(
        "gridworld", preset="paper", iterations=1, trajectories_per_iteration=30, evaluation_episodes=1, seed=3
    )
    return learner.run(ReturnExpert())


@pytest.mark.slow
def test_draws_of_q_are_the_utilities_of_the_discounted_visits_to_come_under_the_observed_frequencies(grid):
    steps, table, discount = transitions(grid.trajectories), grid.policy.table, grid.settings.critic.discount
    counts = np.zeros((125, 25))
    np.add.at(counts, (steps.states * 5 + steps.actions, steps.next_states), 1)
    assert (counts.sum(axis=1) > 0).all()
    frequencies = counts / counts.sum(axis=1, keepdims=True)  # P̂(s′|s, a)
    following = (frequencies[:, :, None] * table).reshape(125, 125)
    visits = np.linalg.solve(np.eye(125) - discount * following, frequencies)
    q = q_draws(grid, np.arange(25), np.arange(5), number=10**9)["q"]
    assert q.dims == ("chain", "draw", "state", "action")
    _, utilities = grid.estimate.utilities_and_draws(np.arange(25))
    expected = utilities @ visits.T
    np.testing.assert_allclose(q.values.reshape(expected.shape), expected, atol=1e-5 * np.abs(expected).max())


def test_fewer_draws_of_q_are_some_of_all(gridworld_run):
    learner = load(gridworld_run).learner
    states, actions = np.array([0, 12, 24]), np.arange(5)
    every, some = (q_draws(learner, states, actions, number=number)["q"].values for number in (10**9, 40))
    assert some.shape == (4, 10, 3, 5)
    np.testing.assert_allclose(some, every[:, :: every.shape[1] // 10], rtol=1e-9, atol=1e-9)


CONTINUOUS = {
    "preset": "paper",
    "hyperparameters": "inferred",
    "iterations": 1,
    "max_steps": 10,
    "trajectories_per_iteration": 4,
    "evaluation_episodes": 2,
    "centres": 15,
    "policy": "linear-gaussian",
}


@pytest.mark.slow
def test_q_of_each_draw_is_what_lstd_gives_for_its_utilities_alone():
    learner = Learner("swing-up", **CONTINUOUS, seed=5).run(ReturnExpert())
    steps = transitions(learner.trajectories)
    forces = np.linspace(-30, 30, 7)[:, None]
    q = q_draws(learner, steps.states[:3], forces, number=200, seed=2)
    assert q["q"].shape == (4, 50, 3, 7)
    np.testing.assert_array_equal(q["action"], forces[:, 0])
    _, utilities = learner.estimate.utilities_and_draws(steps.next_states, number=200)
    assert len(np.unique(learner.estimate.posterior["posterior"]["setting"])) > 1
    for number in (0, 77, 199):
        alone = estimate_q(
            learner.policy,
            CriticData(steps, utilities[number]),
            key=jax.random.key(2),
            action_space=learner.environment.action_space,
            features=learner.cycle.feature_source.of_steps(
                steps, learner.settings.features.of_critic, rng=np.random.default_rng(2)
            ),
            critic=learner.settings.critic,
        )
        expected = alone(np.repeat(steps.states[:3], 7, axis=0), np.tile(forces, (3, 1)))
        found = q["q"].values.reshape(200, 21)[number]
        np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
    greedy = greedy_probabilities(q)
    np.testing.assert_allclose(greedy["greedy_probability"].sum("action"), 1)
    assert np.isin(greedy["greedy_of_mean"], forces).all()


def test_the_greedy_action_is_counted_over_draws_and_equal_ones_share():
    # Two states, four draws. The mean of the first is greedy for the third action, which is the best in one draw only.
    first = [[1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 9]]
    second = [[2, 2, 0], [2, 2, 0], [2, 2, 0], [0, 0, 0]]
    greedy = greedy_probabilities(given_q(np.stack([first, second], axis=1)))
    np.testing.assert_allclose(greedy["greedy_probability"][0], [0.5, 0.25, 0.25])
    np.testing.assert_allclose(greedy["greedy_probability"][1], np.array([3 / 2, 3 / 2, 0]) / 4 + 1 / 12)
    assert greedy["greedy_of_mean"].values.tolist() == [30, 10]
    np.testing.assert_allclose(greedy["expected_loss"], [(1 + 1 + 1 + 0) / 4, 0])
    assert greedy.attrs["converged"] == 0


# Figures.


def test_figures_are_drawn_on_the_axes_given_and_on_no_other():
    figure = Figure()
    axes = figure.subplots(1, 4)
    returns = given_returns([[3, 2, 1], [3, 1, 2], [1, 2, 3], [9, 8, -7]])
    q = given_q(np.random.default_rng(0).normal(size=(20, 2, 3)))
    assert plot_returns(returns, axes[0]) is axes[0]
    assert plot_ranking(ranking_probabilities(returns), axes[1]) is axes[1]
    assert plot_greedy(greedy_probabilities(q), axes[2]) is axes[2]
    FigureCanvasAgg(figure).draw()
    assert not axes[3].has_data()
    assert axes[2].get_title() == "Best action (the fit has not converged)"
    assert axes[0].get_title() == "Returns"
    assert [label.get_text() for label in axes[1].get_yticklabels()] == ["0 (75%)", "1 (0%)", "2 (25%)"]
    assert [label.get_text() for label in axes[2].get_xticklabels()] == ["10", "20", "30"]
    assert matplotlib.pyplot.get_fignums() == []


def test_a_level_that_all_have_in_common_is_left_out_of_the_figures():
    # the returns of each draw differ by 1 and 2, whatever the level, so all intervals are points
    levels = np.random.default_rng(0).normal(scale=100, size=(10, 1))
    axes = plot_returns(given_returns(levels + np.array([0.0, 2.0, 1.0])), Figure().subplots())
    lines = [segment[:, 0] for collection in axes.collections for segment in collection.get_segments()]
    np.testing.assert_allclose(np.ptp(lines, axis=1), 0, atol=1e-12)
    assert [label.get_text() for label in axes.get_yticklabels()] == ["0", "2", "1"]  # from the bottom upwards


# Bad input.


@pytest.mark.parametrize("method", ["linear-program", "known-reward"])
def test_an_estimate_without_a_posterior_is_refused(method):
    utility = fitted(method=method)
    with pytest.raises(ValueError, match=r"estimate: expected a utility estimate with a posterior, got \w+"):
        return_draws(utility, TRAJECTORIES)
    with pytest.raises(ValueError, match="estimate: expected a utility estimate with a posterior"):
        q_draws(SimpleNamespace(estimate=utility), np.arange(2), np.arange(2))


def test_a_learner_before_its_first_iteration_has_no_draws_of_q():
    with pytest.raises(ValueError, match="estimate: expected a utility estimate with a posterior, got NoneType"):
        q_draws(Learner("gridworld"), np.arange(2), np.arange(2))


@pytest.mark.parametrize(("states", "actions"), [([], [1]), ([1], []), (1, [1]), ([1], 1)])
def test_no_states_or_no_actions_are_refused(states, actions):
    with pytest.raises(ValueError, match="states, actions: expected at least one row each"):
        q_draws(SimpleNamespace(estimate=fitted()), states, actions)


def test_no_trajectories_and_no_draws_are_refused():
    with pytest.raises(ValueError, match="trajectory_features: expected at least one trajectory"):
        return_draws(fitted(), [])
    with pytest.raises(ValueError, match="number: expected a whole number >= 1, got 0"):
        return_draws(fitted(), TRAJECTORIES, number=0)
