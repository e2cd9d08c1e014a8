"""Step 1 on small cases: three discrete states, one-hot features, so that ψ can be written down."""

import itertools
from dataclasses import replace

import jax
import numpy as np
import pytest
import scipy.optimize

from bayespbrl.features import OneHot
from bayespbrl.models import PreferenceModel
from bayespbrl.models.likelihoods import Logistic, Mixed, WithLapses, log_prob
from bayespbrl.trajectories import Trajectory, trajectory_features, transitions
from bayespbrl.utility import KnownReward, inference
from bayespbrl.utility.comparisons import Comparisons

METHODS = ("posterior-mean", "most-likely", "posterior-draw", "linear-program")


def staying(state, steps=4, reward=0.0):
    return Trajectory(np.full(steps + 1, state), np.zeros(steps, dtype=int), np.full(steps, reward))


# 0 is the worst state, 2 the best; trajectory 3 is shorter.
TRAJECTORIES = [staying(0, reward=-1.0), staying(1, reward=0.5), staying(2, reward=2.0), staying(2, 2, reward=2.0)]
PAIRS = [(1, 0), (2, 1)]
ONE_HOT = OneHot(3)


def estimate_utility(trajectories, pairs, features, *, method, discount=0.9, seed=0):
    comparisons = Comparisons.among(trajectories, pairs, discount=discount)
    return inference.estimate_utility(comparisons, features, PreferenceModel(), method=method, seed=seed)


@pytest.mark.parametrize("method", METHODS)
def test_the_answers_are_explained(method):
    estimate = estimate_utility(TRAJECTORIES, PAIRS, ONE_HOT, method=method, discount=0.9)
    utilities = estimate.utilities(np.arange(3))
    if method != "posterior-draw":  # eq. 8 leaves a single draw some chance to contradict an answer
        assert utilities[0] < utilities[2]
    if method in ("posterior-mean", "most-likely"):  # the program's solution is one of many optimal corners
        assert utilities[0] < utilities[1] < utilities[2]
    assert estimate.quality.pairs == 2
    assert estimate.quality.pairs_satisfied == sum(
        estimate.utilities(np.array([i]))[0] > estimate.utilities(np.array([j]))[0] for i, j in PAIRS
    )
    assert estimate.quality.converged


@pytest.mark.parametrize("method", METHODS)
def test_a_trajectorys_utility_is_the_discounted_sum_of_its_steps(method):
    estimate = estimate_utility(TRAJECTORIES, PAIRS, ONE_HOT, method=method, discount=0.9)
    sums = [0.9 ** np.arange(len(t)) @ estimate.step_utilities(transitions([t])) for t in TRAJECTORIES]
    np.testing.assert_allclose(estimate.trajectory_utilities(TRAJECTORIES), sums, rtol=1e-12)


def test_the_utility_of_a_step_is_that_of_its_next_state():
    steps = transitions([Trajectory(np.array([0, 2, 1]), np.zeros(2, dtype=int), np.zeros(2))])
    estimate = estimate_utility(TRAJECTORIES, PAIRS, ONE_HOT, method="linear-program", discount=0.9)
    np.testing.assert_array_equal(estimate.step_utilities(steps), estimate.weights[[2, 1]])


@pytest.mark.parametrize("method", METHODS)
def test_features_in_other_units_give_the_same_utilities(method):
    plain = estimate_utility(TRAJECTORIES, PAIRS, ONE_HOT, method=method, discount=0.9)
    scaled = estimate_utility(TRAJECTORIES, PAIRS, lambda s: 1024.0 * ONE_HOT(s), method=method, discount=0.9)
    np.testing.assert_allclose(scaled.utilities(np.arange(3)), plain.utilities(np.arange(3)), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(1024.0 * scaled.weights, plain.weights, rtol=1e-9, atol=1e-12)


def test_without_pairs_the_posterior_mean_is_the_priors_zero_and_nothing_is_claimed():
    estimate = estimate_utility(TRAJECTORIES, [], ONE_HOT, method="posterior-mean", discount=0.9)
    np.testing.assert_array_equal(estimate.weights, np.zeros(3))
    assert (estimate.quality.pairs, estimate.quality.pairs_satisfied) == (0, 0)
    assert estimate.quality.log_evidence == pytest.approx(0.0, abs=1e-12)


def test_without_pairs_every_estimate_is_finite():
    for method in METHODS:
        estimate = estimate_utility(TRAJECTORIES, [], ONE_HOT, method=method, discount=0.9)
        assert np.isfinite(estimate.trajectory_utilities(TRAJECTORIES)).all()


def test_a_pair_that_the_features_cannot_tell_apart_is_survived_and_counted_as_unsatisfied():
    twins = [*TRAJECTORIES, staying(1)]
    for method in METHODS:
        estimate = estimate_utility(twins, [(1, 4), (2, 0)], ONE_HOT, method=method, discount=0.9)
        assert (estimate.quality.pairs, estimate.quality.pairs_satisfied) == (2, 1)


def test_with_one_pair_the_posterior_mean_is_along_its_difference_and_matches_quadrature():
    # K = 1 leaves the sigmoid: w = z·d/|d| with density ∝ N(z; 0, 1) sigmoid(m |d| z), d scaled to (0, −1, 1).
    estimate = estimate_utility(TRAJECTORIES, [(2, 1)], ONE_HOT, method="posterior-mean", discount=0.9)
    scale = np.sum(0.9 ** np.arange(4))
    z = np.linspace(-10, 10, 20001)
    density = np.exp(-0.5 * z**2) / (1 + np.exp(-5 * np.sqrt(2) * z))
    mean = z @ density / density.sum() / np.sqrt(2)
    np.testing.assert_allclose(scale * estimate.weights, [0, -mean, mean], atol=0.04)
    assert estimate.weights[0] == 0
    evidence = np.log(density.sum() * (z[1] - z[0]) / np.sqrt(2 * np.pi))
    assert estimate.quality.log_evidence == pytest.approx(evidence, abs=0.02)


def test_most_likely_explains_the_answers_at_least_as_well_as_the_mean():
    means, likeliest = (
        estimate_utility(TRAJECTORIES, PAIRS, ONE_HOT, method=method, discount=0.9, seed=3) for method in METHODS[:2]
    )
    features = trajectory_features(TRAJECTORIES, ONE_HOT, discount=0.9)
    differences = np.array([features[i] - features[j] for i, j in PAIRS])
    margins = {e: differences @ w for e, w in (("mean", means.weights), ("most", likeliest.weights))}
    assert np.sum(np.log1p(np.exp(-5 * margins["most"]))) <= np.sum(np.log1p(np.exp(-5 * margins["mean"])))


def test_the_same_seed_gives_the_same_draws_and_another_gives_others():
    one, same, other = (
        estimate_utility(TRAJECTORIES, PAIRS, ONE_HOT, method="posterior-mean", discount=0.9, seed=seed)
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one.weights, same.weights)
    assert not np.array_equal(one.weights, other.weights)


def test_a_posterior_draw_is_a_draw_without_what_the_answers_do_not_touch():
    estimate = estimate_utility(TRAJECTORIES, [(2, 1)], ONE_HOT, method="posterior-draw", discount=0.9, seed=4)
    assert estimate.weights[0] == 0  # never compared
    assert estimate.weights[1] == -estimate.weights[2]  # only their difference was
    draws = estimate.draws(np.array([[0.0, -1.0, 1.0]]))
    assert np.isclose(draws, estimate.weights[2] - estimate.weights[1], rtol=1e-12).sum() == 1


def test_posterior_draws_of_many_seeds_are_spread_as_the_posterior_is():
    estimate = estimate_utility(TRAJECTORIES, [(2, 1)], ONE_HOT, method="posterior-mean", discount=0.9)
    drawn = [inference._weights(estimate.posterior, "posterior-draw", seed) for seed in range(400)]
    margins = np.array(drawn) @ [0, -1, 1] / estimate.scale
    draws = estimate.draws(np.array([[0.0, -1.0, 1.0]]))
    assert np.std(margins) == pytest.approx(draws.std(), rel=0.15)
    assert abs(np.mean(margins) - draws.mean()) < 4 * draws.std() / np.sqrt(400)


def test_fewer_draws_are_some_of_all_evenly_spaced():
    estimate = estimate_utility(TRAJECTORIES, PAIRS, ONE_HOT, method="posterior-mean", discount=0.9)
    every = estimate.draws(np.eye(3))
    chains, length = every.shape[:2]
    np.testing.assert_array_equal(estimate.draws(np.eye(3), number=chains * length), every)
    np.testing.assert_allclose(estimate.draws(np.eye(3), number=100), every[:, :: length * chains // 100], rtol=1e-12)
    np.testing.assert_allclose(estimate.draws(np.eye(3), number=1), every[:, :1], rtol=1e-12)
    with pytest.raises(ValueError, match="number: expected a whole number >= 1, got 0"):
        estimate.draws(np.eye(3), number=0)


def test_draws_of_a_trajectory_are_those_of_its_feature_sum():
    estimate = estimate_utility(TRAJECTORIES, PAIRS, ONE_HOT, method="posterior-mean", discount=0.9)
    sums = trajectory_features(TRAJECTORIES, ONE_HOT, discount=0.9)
    draws = estimate.trajectory_draws(TRAJECTORIES, number=40)
    np.testing.assert_allclose(draws, estimate.draws(sums, number=40).reshape(40, 4), rtol=1e-12)
    # trajectory 3 stays where trajectory 2 does, half as long
    np.testing.assert_allclose(draws[:, 3] / draws[:, 2], (1 + 0.9) / np.sum(0.9 ** np.arange(4)), rtol=1e-12)


def test_the_likelihood_of_the_next_answer_is_that_of_the_fit():
    estimate = estimate_utility(TRAJECTORIES, PAIRS, ONE_HOT, method="posterior-mean", discount=0.9)
    assert estimate.likelihood == Mixed(5.0, 2.0)
    for options, expected in (
        ({"steepness": 3.0, "likelihood": "logistic"}, Logistic(3.0)),
        ({"lapse_rate": 0.25}, WithLapses(Mixed(5.0, 2.0), 0.25)),
    ):
        fit = estimate.posterior.copy()
        fit.attrs |= options
        assert replace(estimate, posterior=fit).likelihood == expected


def test_the_likelihood_takes_differences_of_utilities_as_they_are():
    def twenty_fold(states):
        return 20 * ONE_HOT(states)

    estimate = estimate_utility(TRAJECTORIES, PAIRS, twenty_fold, method="posterior-mean", discount=0.9)
    assert estimate.scale > 20
    draws = estimate.draws(trajectory_features(TRAJECTORIES, twenty_fold, discount=0.9))
    margins = np.stack([draws[..., i] - draws[..., j] for i, j in PAIRS], axis=-1)
    with jax.enable_x64(True):
        answers = log_prob(estimate.likelihood, margins)
    np.testing.assert_allclose(answers, estimate.posterior["log_likelihood"]["answers"], atol=1e-10)


def test_without_a_posterior_there_are_no_draws_and_no_likelihood():
    estimate = estimate_utility(TRAJECTORIES, PAIRS, ONE_HOT, method="linear-program", discount=0.9)
    assert estimate.sampled is None
    with pytest.raises(ValueError, match="likelihood: expected an estimate with a posterior"):
        _ = estimate.likelihood
    one, other = TRAJECTORIES[:2]
    for name, arguments in {
        "trajectory_draws": ([one],),
        "margin_draws": (one, other),
        "utilities_and_draws": (np.arange(3),),
    }.items():
        with pytest.raises(ValueError, match=f"{name}: expected an estimate with a posterior, got Linear"):
            getattr(estimate, name)(*arguments)


def test_the_linear_program_reaches_the_optimum_that_scipy_finds():
    rng = np.random.default_rng(8)
    features = rng.normal(size=(6, 4))
    trajectories = [staying(number, steps=1) for number in range(6)]  # ψ of trajectory i is row i
    pairs = [(int(i), int(j)) for i, j in itertools.combinations(rng.permutation(6), 2)]
    estimate = estimate_utility(trajectories, pairs, lambda s: features[s], method="linear-program", discount=0.9)
    differences = np.array([features[i] - features[j] for i, j in pairs])
    differences /= np.abs(differences).max()
    rows, columns = differences.shape
    oracle = scipy.optimize.linprog(
        np.concatenate([np.zeros(columns), -np.ones(rows)]),
        A_ub=np.block([[-differences, np.eye(rows)], [-2 * differences, np.eye(rows)]]),
        b_ub=np.zeros(2 * rows),
        bounds=[(-1, 1)] * columns + [(None, None)] * rows,
    )
    scale = np.abs(np.array([features[i] - features[j] for i, j in pairs])).max()
    margins = differences @ (scale * estimate.weights)
    assert np.sum(np.minimum(margins, 2 * margins)) == pytest.approx(-oracle.fun, rel=1e-7)
    assert np.abs(scale * estimate.weights).max() <= 1 + 1e-9
    assert estimate.quality.converged
    assert np.isnan(estimate.quality.rhat_max)


def test_the_known_reward_is_the_hidden_reward_itself():
    estimate = estimate_utility(TRAJECTORIES, [(2, 0), (0, 1)], ONE_HOT, method="known-reward", discount=0.9)
    assert isinstance(estimate, KnownReward)
    np.testing.assert_array_equal(estimate.step_utilities(transitions(TRAJECTORIES[:2])), [-1] * 4 + [0.5] * 4)
    np.testing.assert_array_equal(estimate.trajectory_utilities(TRAJECTORIES), [-4, 2, 8, 4])
    assert (estimate.quality.pairs, estimate.quality.pairs_satisfied) == (2, 1)


def test_features_that_are_not_finite_are_refused():
    for method in METHODS:
        with pytest.raises(ValueError, match="finite"):
            estimate_utility(TRAJECTORIES, PAIRS, lambda s: ONE_HOT(s) * np.nan, method=method, discount=0.9)


def test_an_unknown_method_is_refused():
    with pytest.raises(ValueError, match=r"method: expected .*posterior-mean.*got 'median'"):
        estimate_utility(TRAJECTORIES, PAIRS, ONE_HOT, method="median", discount=0.9)
