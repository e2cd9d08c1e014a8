"""Step 1 on small cases: three discrete states, one-hot features, so that ψ can be written down."""

import itertools

import jax
import numpy as np
import pytest
import scipy.optimize

from bayespbrl.features import OneHot, RadialBasis
from bayespbrl.models import PreferenceModel
from bayespbrl.models.likelihoods import Mixed, WithLapses, log_prob
from bayespbrl.trajectories import Trajectory, trajectory_features, transitions
from bayespbrl.utility import KnownReward, infer_utility, inference
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
    options = inference.Estimation(utility=method)
    return inference.estimate(comparisons, features, options, PreferenceModel(), seed=seed)


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


@pytest.mark.parametrize("tie", [(0, 1), (1, 0)])
def test_a_tie_is_no_pair_that_the_utility_could_satisfy(tie):
    comparisons = Comparisons.among(TRAJECTORIES, PAIRS[:1], ties=[tie], discount=0.9)
    estimate = inference.estimate(comparisons, ONE_HOT, inference.Estimation(), PreferenceModel(), seed=0)
    assert (estimate.quality.pairs, estimate.quality.pairs_satisfied) == (1, 1)


@pytest.mark.parametrize("method", METHODS)
def test_a_trajectorys_utility_is_the_discounted_sum_of_its_steps(method):
    estimate = estimate_utility(TRAJECTORIES, PAIRS, ONE_HOT, method=method, discount=0.9)
    sums = [0.9 ** np.arange(len(t)) @ estimate.step_utilities(transitions([t])) for t in TRAJECTORIES]
    np.testing.assert_allclose(estimate.trajectory_utilities(TRAJECTORIES), sums, rtol=1e-12)


def test_the_utility_of_a_step_is_that_of_its_next_state():
    steps = transitions([Trajectory(np.array([0, 2, 1]), np.zeros(2, dtype=int), np.zeros(2))])
    estimate = estimate_utility(TRAJECTORIES, PAIRS, ONE_HOT, method="linear-program", discount=0.9)
    np.testing.assert_array_equal(estimate.step_utilities(steps), np.ravel(estimate.weights)[[2, 1]])


@pytest.mark.parametrize("method", METHODS)
def test_no_states_have_no_utilities(method):
    estimate = estimate_utility(TRAJECTORIES, PAIRS, ONE_HOT, method=method, discount=0.9)
    assert estimate.utilities(np.arange(0)).shape == (0,)


@pytest.mark.parametrize("method", METHODS)
def test_features_in_other_units_give_the_same_utilities(method):
    plain = estimate_utility(TRAJECTORIES, PAIRS, ONE_HOT, method=method, discount=0.9)
    scaled = estimate_utility(TRAJECTORIES, PAIRS, lambda s: 1024.0 * ONE_HOT(s), method=method, discount=0.9)
    np.testing.assert_allclose(scaled.utilities(np.arange(3)), plain.utilities(np.arange(3)), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(1024.0 * scaled.weights, plain.weights, rtol=1e-9, atol=1e-12)


def test_without_pairs_the_posterior_mean_is_the_priors_zero_and_nothing_is_claimed():
    estimate = estimate_utility(TRAJECTORIES, [], ONE_HOT, method="posterior-mean", discount=0.9)
    np.testing.assert_array_equal(estimate.weights, np.zeros((1, 3)))
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
    # K = 1 leaves the sigmoid: w = z·d with density ∝ N(z; 0, 1) sigmoid(m z), d scaled to (0, −1, 1)/√2.
    estimate = estimate_utility(TRAJECTORIES, [(2, 1)], ONE_HOT, method="posterior-mean", discount=0.9)
    scale = np.sqrt(2) * np.sum(0.9 ** np.arange(4))
    z = np.linspace(-10, 10, 20001)
    density = np.exp(-0.5 * z**2) / (1 + np.exp(-5 * z))
    mean = z @ density / density.sum() / np.sqrt(2)
    np.testing.assert_allclose(scale * estimate.weights, [[0, -mean, mean]], atol=0.04)
    assert estimate.weights[0, 0] == 0
    evidence = np.log(density.sum() * (z[1] - z[0]) / np.sqrt(2 * np.pi))
    assert estimate.quality.log_evidence == pytest.approx(
        evidence, abs=4 * estimate.posterior.attrs["log_evidence_error"]
    )


def test_most_likely_explains_the_answers_at_least_as_well_as_the_mean():
    means, likeliest = (
        estimate_utility(TRAJECTORIES, PAIRS, ONE_HOT, method=method, discount=0.9, seed=3) for method in METHODS[:2]
    )
    features = trajectory_features(TRAJECTORIES, ONE_HOT, discount=0.9)
    differences = np.array([features[i] - features[j] for i, j in PAIRS])
    margins = {e: differences @ w[0] for e, w in (("mean", means.weights), ("most", likeliest.weights))}
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
    (weights,) = estimate.weights
    assert weights[0] == 0  # never compared
    assert weights[1] == -weights[2]  # only their difference was
    _, draws = estimate.utilities_and_draws(np.arange(3))
    assert np.isclose(draws[:, 2] - draws[:, 1], weights[2] - weights[1], rtol=1e-12).sum() == 1


def test_posterior_draws_of_many_seeds_are_spread_as_the_posterior_is():
    estimate = estimate_utility(TRAJECTORIES, [(2, 1)], ONE_HOT, method="posterior-mean", discount=0.9)
    drawn = [inference._parts(estimate.posterior, "posterior-draw", seed)[0] for seed in range(400)]
    margins = np.array(drawn) @ [0, -1, 1] / estimate.scales[0]
    _, utilities = estimate.utilities_and_draws(np.arange(3))
    draws = utilities[:, 2] - utilities[:, 1]
    assert np.std(margins) == pytest.approx(draws.std(), rel=0.15)
    assert abs(np.mean(margins) - draws.mean()) < 4 * draws.std() / np.sqrt(400)


@pytest.fixture(scope="module")
def walked():
    """An estimate over 9 settings of the length scales in the plane, and the trajectories behind it."""
    rng = np.random.default_rng(5)
    walks = [
        Trajectory(np.clip(np.cumsum(rng.normal(0, 0.4, (7, 2)), axis=0), -1, 1), np.zeros((6, 1)), np.zeros(6))
        for _ in range(6)
    ]
    centres = rng.uniform(-1, 1, (8, 2))
    features = RadialBasis(centres, np.array([0.4, 0.6]), np.full(2, np.inf), normalised=True)
    comparisons = Comparisons.among(walks, [(0, 1), (2, 3), (0, 4), (2, 5)], discount=0.9)
    model = PreferenceModel(steepness=None, lapse_rate=None, likelihood="logistic")
    return inference.estimate(comparisons, features, inference.Estimation(), model, seed=2), walks


def test_fewer_draws_are_some_of_all_evenly_spaced(walked):
    estimate, walks = walked
    states = walks[0].states
    _, every = estimate.utilities_and_draws(states)
    chains, length = estimate.posterior["posterior"]["setting"].shape
    every = every.reshape(chains, length, len(states))
    for number, apart in ((chains * length, 1), (100, length * chains // 100), (1, chains * length)):
        mean, draws = estimate.utilities_and_draws(states, number=number)
        np.testing.assert_allclose(mean, estimate.utilities(states), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(draws, every[:, ::apart].reshape(-1, len(states)), rtol=1e-9, atol=1e-12)
    with pytest.raises(ValueError, match="number: expected a whole number >= 1, got 0"):
        estimate.utilities_and_draws(states, number=0)


def test_a_trajectory_is_worth_the_discounted_sum_of_its_states_in_the_mean_and_in_every_draw(walked):
    estimate, walks = walked
    mean, draws = estimate.utilities_and_draws(np.concatenate([walk.states[1:] for walk in walks]), number=40)
    powers = 0.9 ** np.arange(6)
    np.testing.assert_allclose(estimate.trajectory_utilities(walks), mean.reshape(6, 6) @ powers, atol=1e-10)
    of_trajectories = estimate.trajectory_draws(walks, number=40)
    np.testing.assert_allclose(of_trajectories, draws.reshape(-1, 6, 6) @ powers, atol=1e-10)


def test_the_mean_is_the_mean_of_the_draws_over_all_settings(walked):
    estimate, walks = walked
    assert len(np.unique(estimate.posterior["posterior"]["setting"])) > 5  # four answers leave nearly all open
    mean, draws = estimate.utilities_and_draws(walks[0].states)
    # but for the directions that no answer touches, which are drawn from the prior
    np.testing.assert_allclose(mean, draws.mean(axis=0), atol=5 * draws.std(axis=0).max() / np.sqrt(len(draws)))
    np.testing.assert_allclose(
        estimate.trajectory_utilities(walks[:2]) @ [1, -1], (estimate.trajectory_draws(walks[:2]) @ [1, -1]).mean()
    )
    np.testing.assert_allclose(
        estimate.trajectory_draws(walks[:2]) @ [1, -1],
        estimate.posterior["posterior"]["margins"].values[:, :, 0].ravel(),
        rtol=1e-9,
        atol=1e-12,
    )


def test_the_prior_deviation_of_a_state_is_that_of_all_settings_together(walked):
    estimate, walks = walked
    states = walks[1].states
    settings = zip(estimate.multiples, estimate.scales, strict=True)
    each = np.array([estimate.features.rescaled(multiples)(states) / scale for multiples, scale in settings])
    variances = np.sum(each**2, axis=2).mean(axis=0)  # means of zero: the variance of the mixture is the mean
    np.testing.assert_allclose(estimate.prior_deviations(states), np.sqrt(variances))
    wide = infer_utility(np.eye(2), [(0, 1)], prior_scale=3.0, features=OneHot(2))
    np.testing.assert_allclose(wide.prior_deviations(np.arange(2)), 3 / np.sqrt(2))  # of differences of length √2


def test_each_draw_is_of_the_features_of_its_own_setting(walked):
    estimate, walks = walked
    states = walks[1].states
    _, draws = estimate.utilities_and_draws(states)
    drawn = estimate.posterior["posterior"]
    numbers = drawn["setting"].values
    weights = drawn["utility_weights"].values.reshape(numbers.size, -1)
    for draw in (0, 333, 777):
        number = numbers.ravel()[draw]
        features = estimate.features.rescaled(estimate.multiples[number])(states)
        np.testing.assert_allclose(draws[draw], features @ weights[draw] / estimate.scales[number], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e200, 1e-200])
def test_features_of_any_scale_count(scale):
    sums = np.array([[1.0, 0.0], [0.0, 1.0], [0.5, 0.25]])
    plain, scaled = (infer_utility(factor * sums, [(0, 1), (2, 1)]) for factor in (1.0, scale))
    np.testing.assert_allclose(scaled.weights * scale, plain.weights, rtol=1e-6)
    assert np.all(plain.weights != 0)


def test_features_that_differ_by_less_than_a_number_can_be_divided_by_say_nothing():
    estimate = infer_utility(1e-310 * np.eye(2), [(0, 1)])
    assert np.all(estimate.weights == 0)


def test_nobody_and_no_tie_among_no_answers_may_be_empty_lists():
    none = infer_utility(np.eye(2), [], answerers=[], shown_first=[], ties=[])
    assert np.all(none.weights == 0)


def test_a_setting_of_a_very_different_scale_counts_by_its_probability_alone():
    # the features of the second setting are those of the first, times 1000: nothing can tell the settings apart
    one = inference.estimate(
        Comparisons.among(TRAJECTORIES, PAIRS, discount=0.9), ONE_HOT, inference.Estimation(), PreferenceModel(), seed=1
    )
    sums = trajectory_features(TRAJECTORIES, ONE_HOT, discount=0.9)
    comparisons = Comparisons.among(TRAJECTORIES, PAIRS, discount=0.9)
    two = inference._by_posterior(
        [sums[:3], 1000 * sums[:3]], np.ones((2, 0)), comparisons, ONE_HOT, "posterior-mean", PreferenceModel(), 1
    )
    assert two.scales[1] == pytest.approx(1000 * two.scales[0])
    numbers = two.posterior["posterior"]["setting"].values
    assert np.mean(numbers) == pytest.approx(0.5, abs=0.06)
    by_setting = [two.weights[0] @ np.eye(3), 1000 * two.weights[1] @ np.eye(3)]
    for part, share in zip(by_setting, (np.mean(numbers == 0), np.mean(numbers == 1)), strict=True):
        np.testing.assert_allclose(part, share * one.weights[0], atol=0.06 * np.abs(one.weights).max())


def test_the_likelihood_of_the_next_answer_has_the_steepness_and_lapse_rate_of_each_draw(walked):
    estimate, walks = walked
    for number in (None, 40):
        margins = np.stack(
            [
                estimate.trajectory_draws([walks[i], walks[j]], number=number) @ [1, -1]
                for i, j in ((0, 1), (2, 3), (0, 4), (2, 5))
            ],
            axis=-1,
        )
        with jax.enable_x64(True):
            answers = np.asarray(log_prob(estimate.likelihood(number), margins))
        kept = estimate.posterior["log_likelihood"]["answers"].values
        apart = 1 if number is None else kept.shape[0] * kept.shape[1] // 40
        np.testing.assert_allclose(answers, kept[:, ::apart].reshape(answers.shape), atol=1e-9)
    drawn = estimate.posterior["posterior"]
    assert len(np.unique(drawn["steepness"])) > 1
    assert len(np.unique(drawn["lapse_rate"])) > 1


@pytest.mark.slow
def test_the_likelihood_has_what_was_given_in_every_draw():
    comparisons = Comparisons.among(TRAJECTORIES, PAIRS, discount=0.9)
    model = PreferenceModel(steepness=3.0, lapse_rate=0.25)
    estimate = inference.estimate(comparisons, ONE_HOT, inference.Estimation(), model, seed=0)
    with jax.enable_x64(True):
        found = np.asarray(log_prob(estimate.likelihood(4), np.full((4, 1), 0.3)))
        expected = np.asarray(log_prob(WithLapses(Mixed(3.0, 2.0), 0.25), np.array([0.3])))
    np.testing.assert_allclose(found, np.full((4, 1), expected[0]), rtol=1e-12)


def test_what_was_inferred_is_summed_up_by_mean_and_interval(walked):
    estimate, _ = walked
    found, drawn = estimate.hyperparameters(), estimate.posterior["posterior"]
    for name in ("steepness", "lapse_rate"):
        values = drawn[name].values.ravel()
        assert found[name] == pytest.approx(values.mean())
        assert found[f"{name} lower"] <= found[name] <= found[f"{name} upper"]
    multiples = estimate.multiples[drawn["setting"].values.ravel()]
    np.testing.assert_allclose(found["bandwidth_multiples"], np.exp(np.log(multiples).mean(axis=0)))
    assert 1 / 9 < found["most probable length scales"] < 1


@pytest.mark.slow
def test_ties_bring_equal_utilities_and_an_inferred_threshold():
    tied, stated = (
        inference.infer_utility(np.eye(3), pairs, ties=ties, likelihood="logistic", seed=0)
        for pairs, ties in (([(2, 0)], [(1, 0)] * 4), ([(2, 0), *[(1, 0)] * 4], []))
    )
    assert "tie_threshold" in tied.posterior["posterior"]
    assert "tie_threshold" not in stated.posterior["posterior"]
    margins = [fit.weights[0] * fit.scales[0] for fit in (tied, stated)]
    assert abs(margins[0][1] - margins[0][0]) < 0.3 * (margins[1][1] - margins[1][0])
    assert (tied.quality.pairs, stated.quality.pairs) == (1, 5)


def test_without_a_posterior_there_are_no_draws_and_no_likelihood():
    estimate = estimate_utility(TRAJECTORIES, PAIRS, ONE_HOT, method="linear-program", discount=0.9)
    assert estimate.posterior is None
    assert estimate.hyperparameters() is None
    one, other = TRAJECTORIES[:2]
    for name, arguments in {
        "likelihood": (),
        "trajectory_draws": ([one],),
        "tie_thresholds": (),
        "differences": ([one, other],),
        "mean_utilities": (np.arange(3),),
        "prior_deviations": (np.arange(3),),
        "utilities_and_draws": (np.arange(3),),
    }.items():
        with pytest.raises(ValueError, match=f"{name}: expected an estimate with a posterior, got Linear"):
            getattr(estimate, name)(*arguments)
    assert estimate.thinned(2) is estimate


def test_the_linear_program_reaches_the_optimum_that_scipy_finds():
    rng = np.random.default_rng(8)
    features = rng.normal(size=(6, 4))
    trajectories = [staying(number, steps=1) for number in range(6)]  # ψ of trajectory i is row i
    pairs = [(int(i), int(j)) for i, j in itertools.combinations(rng.permutation(6), 2)]
    estimate = estimate_utility(trajectories, pairs, lambda s: features[s], method="linear-program", discount=0.9)
    differences = np.array([features[i] - features[j] for i, j in pairs])
    scale = np.sqrt(np.mean(np.sum(differences**2, axis=1)))
    differences /= scale
    rows, columns = differences.shape
    oracle = scipy.optimize.linprog(
        np.concatenate([np.zeros(columns), -np.ones(rows)]),
        A_ub=np.block([[-differences, np.eye(rows)], [-2 * differences, np.eye(rows)]]),
        b_ub=np.zeros(2 * rows),
        bounds=[(-1, 1)] * columns + [(None, None)] * rows,
    )
    margins = differences @ (scale * estimate.weights)
    assert np.sum(np.minimum(margins, 2 * margins)) == pytest.approx(-oracle.fun, rel=1e-7)
    assert np.abs(scale * estimate.weights).max() <= 1 + 1e-9
    assert estimate.quality.converged
    assert np.isnan(estimate.quality.rhat_max)


def test_the_known_reward_is_the_hidden_reward_itself():
    estimate = estimate_utility(TRAJECTORIES, [(2, 0), (0, 1)], ONE_HOT, method="known-reward", discount=0.9)
    assert isinstance(estimate, KnownReward)
    assert (estimate.features, estimate.number_of_features) == (None, 0)
    with pytest.raises(ValueError, match="utilities: expected a utility of states, got KnownReward"):
        estimate.utilities(np.arange(3))
    np.testing.assert_array_equal(estimate.step_utilities(transitions(TRAJECTORIES[:2])), [-1] * 4 + [0.5] * 4)
    np.testing.assert_array_equal(estimate.trajectory_utilities(TRAJECTORIES), [-4, 2, 8, 4])
    assert (estimate.quality.pairs, estimate.quality.pairs_satisfied) == (2, 1)


def test_features_that_are_not_finite_are_refused():
    for method in METHODS:
        with pytest.raises(ValueError, match="finite"):
            estimate_utility(TRAJECTORIES, PAIRS, lambda s: ONE_HOT(s) * np.nan, method=method, discount=0.9)


def test_an_evidence_that_cannot_be_told_is_none():
    estimate = infer_utility([[1.0], [0.0]], [(0, 1), (1, 0)], steepness=1e6, lapse_rate=0.0)
    assert estimate.posterior.attrs["log_evidence_error"] == np.inf
    assert np.isnan(estimate.quality.log_evidence)


ITEMS = np.array([[2.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
BAD_ARGUMENTS = [
    ({"feature_sums": [{1: 2}]}, "feature_sums: expected rows of numbers"),
    ({"feature_sums": None}, "feature_sums: expected "),
    ({"feature_sums": "abc"}, "feature_sums: expected rows of numbers"),
    ({"feature_sums": [[1.0], [1.0, 2.0]]}, "feature_sums: expected rows of numbers"),
    ({"feature_sums": np.zeros((3, 0))}, r"feature_sums: expected shape \(n, D >= 1\), got \(3, 0\)"),
    ({"feature_sums": [[1e308], [-1e308], [0.0]]}, "feature_sums: differences: expected finite"),
    ({"pairs": None}, "pairs: expected pairs of integers, got None"),
    ({"pairs": [(0.5, 1.7)]}, r"pairs: expected pairs of integers, got \[\(0.5, 1.7\)\]"),
    ({"pairs": [(0, 1, 2)]}, "pairs: expected pairs of integers"),
    ({"pairs": [(0, 1), (1,)]}, "pairs: expected pairs of integers"),
    ({"pairs": [("a", "b")]}, "pairs: expected pairs of integers"),
    ({"pairs": [0, 1]}, "pairs: expected pairs of integers"),
    ({"pairs": [(0, 3)]}, r"pairs: expected numbers in 0 … 2, got \(0, 3\) as number 0"),
    ({"ties": [(0, 3)]}, r"ties: expected numbers in 0 … 2, got \(0, 3\) as number 0"),
    ({"ties": [(1, 1)]}, "ties: expected two different numbers in each"),
    ({"ties": None}, "ties: expected pairs of integers"),
    ({"ties": [(0.0, 1.0)]}, "ties: expected pairs of integers"),
    ({"discount": "x"}, r"discount: expected a number in \[0, 1\], got 'x'"),
    ({"discount": 5}, r"discount: expected a number in \[0, 1\], got 5"),
    ({"features": 3}, "features: expected a function of states"),
    ({"seed": "x"}, "seed: expected a whole number >= 0"),
    ({"feature_sums": np.ma.masked_less(ITEMS, 1)}, "feature_sums: expected real numbers, got masked or complex"),
    ({"feature_sums": np.asarray(ITEMS) * 1j}, "feature_sums: expected real numbers, got masked or complex"),
    ({"feature_sums": np.zeros((3, 1), "datetime64[D]")}, "feature_sums: expected real numbers, got dates or times"),
    ({"prior_scale": 10**400}, "prior_scale: expected"),
    ({"answerers": ["a", "b"]}, "answerers: expected 1 names, one for each answer"),
    ({"answerers": [None]}, "answerers: expected 1 whole numbers"),
    ({"answerers": [-1]}, "answerers: expected 1 whole numbers"),
    ({"shown_first": [7]}, "shown_first: expected 1 whole numbers in -1 … 1"),
    ({"lapse_rate": 7}, "lapse_rate: expected a number"),
    ({"prior_scale": -1.0}, "prior_scale: expected a positive"),
    ({"prior_scale": 1e-155}, "prior_scale: expected a number from 1e-30 to 1e[+]30, got 1e-155"),
    ({"prior_scale": 1e155}, "prior_scale: expected a number from 1e-30 to 1e[+]30, got 1e[+]155"),
    ({"tie_threshold": 1e20}, "tie_threshold: expected .* have a prior standard deviation of .*, got 1e[+]20"),
    ({"tie_threshold": 1e-20}, "tie_threshold: expected .* have a prior standard deviation of .*, got 1e-20"),
]


@pytest.mark.parametrize("method", ["posterior-mean", "linear-program"])
@pytest.mark.parametrize(("bad", "message"), BAD_ARGUMENTS, ids=[str(bad) for bad, _ in BAD_ARGUMENTS])
def test_every_bad_argument_is_refused_by_name_whatever_the_method(method, bad, message):
    arguments = {"feature_sums": ITEMS, "pairs": [(0, 1)]} | bad
    with pytest.raises(ValueError, match=message):
        infer_utility(arguments.pop("feature_sums"), arguments.pop("pairs"), method=method, **arguments)


def test_pairs_may_be_an_array_and_states_and_features_may_be_lists():
    given = infer_utility(ITEMS, [(0, 1), (2, 1)], method="linear-program")
    as_array = infer_utility(ITEMS, np.array([[0, 1], [2, 1]], dtype=np.uint8), method="linear-program")
    np.testing.assert_array_equal(as_array.weights, given.weights)
    np.testing.assert_array_equal(given.utilities(ITEMS.tolist()), given.utilities(ITEMS))
    own = infer_utility(ITEMS, [(0, 1), (2, 1)], method="linear-program", features=lambda states: states.tolist())
    np.testing.assert_array_equal(own.utilities(ITEMS.tolist()), given.utilities(ITEMS))


@pytest.mark.parametrize(
    ("states", "message"),
    [
        (np.ones(2), r"states: expected shape \(N, D\), got \(2,\)"),
        (np.full((1, 2), np.nan), "states: expected finite entries"),
        (np.ones((1, 3)), "features: expected 2 for each state, as before, got 3"),
        (None, "states: expected "),
    ],
)
def test_states_that_are_no_feature_rows_are_refused(states, message):
    estimate = infer_utility(ITEMS, [(0, 1)], method="linear-program")
    with pytest.raises(ValueError, match=message):
        estimate.utilities(states)


def test_an_unknown_method_is_refused():
    with pytest.raises(ValueError, match=r"utility: expected .*posterior-mean.*got 'median'"):
        estimate_utility(TRAJECTORIES, PAIRS, ONE_HOT, method="median", discount=0.9)
    with pytest.raises(ValueError, match=r"method: expected .*posterior-mean.*got 'median'"):
        inference.infer_utility(np.eye(3), [(1, 0)], method="median")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("bandwidth", [1.0, 0.0])
def test_answers_that_only_effort_explains_are_explained_by_it(method, bandwidth):
    """Random walks, of which the one with less effort is preferred; without states that tell anything if 0."""
    rng = np.random.default_rng(2)
    walks = [
        Trajectory(rng.normal(size=(21, 2)), rng.uniform(-1, 1, size=(20, 1)) * rng.uniform(0.2, 1), np.zeros(20))
        for _ in range(24)
    ]
    efforts = np.array([np.sum(walk.actions**2) for walk in walks])
    pairs = [
        (i, j) if efforts[i] < efforts[j] else (j, i) for i, j in zip(range(0, 16, 2), range(1, 16, 2), strict=True)
    ]
    features = RadialBasis(rng.normal(size=(6, 2)), np.full(2, bandwidth), np.full(2, np.inf), True, 0.0, (1.0,))
    estimate = estimate_utility(walks, pairs, features, method=method, discount=1.0)
    utilities = estimate.trajectory_utilities(walks)
    if method != "linear-program" or not bandwidth:  # whose weights are bounded
        assert estimate.quality.pairs_satisfied == len(pairs)
    if method == "posterior-mean":
        assert np.corrcoef(utilities[16:], -efforts[16:])[0, 1] > 0.6  # of walks that nobody judged
        found = estimate.hyperparameters()
        assert found["effort counts"] > 0.7
        assert found["effort upper"] < 0
        lengths = estimate.multiples[estimate.posterior["posterior"]["setting"].values.ravel(), :-1]
        np.testing.assert_allclose(found["bandwidth_multiples"], np.exp(np.log(lengths).mean(axis=0)))
        times = np.unique(lengths, axis=0, return_counts=True)[1]
        assert found["most probable length scales"] == pytest.approx(times.max() / len(lengths))
    steps = transitions(walks[:1])
    assert np.sum(estimate.step_utilities(steps)) == pytest.approx(utilities[0])
    # a state alone is worth what a step there without any effort is
    still = estimate.utilities(steps.next_states, actions=np.zeros((20, 1)))
    np.testing.assert_allclose(estimate.utilities(steps.next_states), still)


def test_twenty_answers_find_the_one_of_eight_dimensions_that_matters():
    rng = np.random.default_rng(5)
    walks = np.cumsum(rng.normal(size=(70, 26, 8)), axis=1) + 3 * rng.normal(size=(70, 1, 8))
    paths = [Trajectory(walk, np.zeros((25, 1)), walk[1:, 3]) for walk in walks]
    features = RadialBasis(walks[:, ::5].reshape(-1, 8)[:200], np.full(8, 5.0), np.full(8, np.inf), normalised=True)
    returns = np.array([path.total_reward for path in paths])
    pairs = [(i, i + 1) if returns[i] > returns[i + 1] else (i + 1, i) for i in range(0, 40, 2)]
    estimate = estimate_utility(paths, pairs, features, method="posterior-mean", discount=1.0)
    unseen = paths[40:]
    assert np.corrcoef(estimate.trajectory_utilities(unseen), returns[40:])[0, 1] > 0.98


@pytest.mark.parametrize("method", ["posterior-mean", "linear-program"])
def test_scaled_columns_are_understood_in_any_units(method):
    rng = np.random.default_rng(0)
    sums = rng.normal(size=(30, 3))
    returns = sums.sum(axis=1)
    pairs = [(i, j) if returns[i] > returns[j] else (j, i) for i, j in rng.choice(30, (12, 2)).tolist() if i != j]
    plain, scaled = (
        infer_utility(sums * units, pairs, scaled=True, method=method) for units in (np.ones(3), [1, 4096, 2**-12])
    )
    np.testing.assert_array_equal(plain.weights, scaled.weights)
    np.testing.assert_array_equal(plain.utilities(sums), scaled.utilities(sums * [1, 4096, 2**-12]))
    assert np.corrcoef(plain.utilities(sums), returns)[0, 1] > 0.9
    raw = infer_utility(sums * [1, 4096, 2**-12], pairs, method=method)
    assert np.corrcoef(raw.utilities(sums * [1, 4096, 2**-12]), returns)[0, 1] < 0.8


def test_scaled_columns_without_rows_or_answers():
    assert infer_utility(np.zeros((0, 2)), [], scaled=True).weights.tolist() == [[0, 0]]
    with pytest.raises(ValueError, match="scaled: expected true or false, got 1"):
        infer_utility(np.eye(2), [(0, 1)], scaled=1)
    drawn = RadialBasis(np.zeros((1, 1)), np.ones(1), np.full(1, np.inf))
    with pytest.raises(ValueError, match="scaled: expected false with RadialBasis"):
        infer_utility(np.ones((2, 1)), [(0, 1)], features=drawn, scaled=True)
