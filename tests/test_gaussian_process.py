"""The Gaussian process policy: the sparse posterior against the full one, and the search for its hyper-parameters."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from gymnasium.spaces import Box

from bayespbrl.kernels import coordinates, inverse_bandwidths, radial_basis, squared_exponential
from bayespbrl.policies import GaussianProcessPolicy, hyperparameter_search, sample_actions
from bayespbrl.policies.greedy import greedy
from bayespbrl.policies.hyperparameter_search import FAILED, Hyperparameters, OutputSamples, search
from bayespbrl.policies.sparse_regression import fit_sparse_regression, inducing_rows, inverse_factor, precisions

STATES = Box(-np.inf, np.inf, (2,))
TORQUE = Box(-20.0, 40.0, (1,))
PERIOD = np.array([2 * np.pi, np.inf])
BANDWIDTHS = np.array([0.9, 2.5])
SIGNAL, NOISE = 70.0, 4.0


def full_process(points, targets, weights, queries, signal=SIGNAL, noise=NOISE):
    """Mean and variance of a new observation of weight one, by the textbook's formula with noise σ²/wᵢ."""
    kernel = signal * radial_basis(points, points, BANDWIDTHS, PERIOD) + np.diag(noise / weights)
    cross = signal * radial_basis(queries, points, BANDWIDTHS, PERIOD)
    mean = cross @ np.linalg.solve(kernel, targets)
    return mean, signal - np.einsum("ij,ji->i", cross, np.linalg.solve(kernel, cross.T)) + noise


def sparse_process(inducing, points, targets, weights, queries, signal=SIGNAL, noise=NOISE):
    regression = fit_sparse_regression(
        radial_basis(inducing, points, BANDWIDTHS, PERIOD),
        radial_basis(inducing, inducing, BANDWIDTHS, PERIOD),
        targets,
        weights,
        signal_variance=signal,
        noise_variance=noise,
    )
    cross = radial_basis(queries, inducing, BANDWIDTHS, PERIOD)
    variance = signal * (1 - np.square(cross @ regression.reduction.T).sum(axis=1)) + noise
    return cross @ regression.mean_weights, variance


def some_samples(number, rng):
    points = np.column_stack([rng.uniform(-np.pi, np.pi, number), 4 * rng.normal(size=number) + 2])
    targets = 12 * np.sin(points[:, 0]) + points[:, 1] + 3 * rng.normal(size=number)
    return points, targets, rng.gamma(1.0, size=number) + 0.01


def policy_with_hyperparameters(number_of_inducing_points=60, **options):
    policy = GaussianProcessPolicy.initial(
        STATES, TORQUE, period=PERIOD, number_of_inducing_points=number_of_inducing_points, **options
    )
    return replace(
        policy,
        bandwidths=BANDWIDTHS[None],
        signal_variance=np.array([SIGNAL]),
        noise_variance=np.array([NOISE]),
    )


def test_all_points_inducing_is_the_full_heteroscedastic_process():
    rng = np.random.default_rng(0)
    points, targets, weights = some_samples(40, rng)
    queries = some_samples(25, rng)[0]
    mean, variance = sparse_process(points, points, targets, weights, queries)
    full_mean, full_variance = full_process(points, targets, weights, queries)
    np.testing.assert_allclose(mean, full_mean, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(variance, full_variance, rtol=1e-6)


def test_few_points_inducing_follow_the_printed_equations():
    # B = K_M + K_MN Λ⁻¹ K_NM; mean = kᵀB⁻¹K_MN Λ⁻¹y; var = k(x,x) − kᵀ(K_M⁻¹ − B⁻¹)k + σ²
    rng = np.random.default_rng(1)
    points, targets, weights = some_samples(50, rng)
    inducing, queries = points[:8] + 0.1, some_samples(10, rng)[0]
    k_m = SIGNAL * (radial_basis(inducing, inducing, BANDWIDTHS, PERIOD) + 1e-8 * np.eye(8))
    k_mn = SIGNAL * radial_basis(inducing, points, BANDWIDTHS, PERIOD)
    k_x = SIGNAL * radial_basis(inducing, queries, BANDWIDTHS, PERIOD)
    diagonal = SIGNAL - np.einsum("mn,mn->n", k_mn, np.linalg.solve(k_m, k_mn)) + NOISE / weights
    b = k_m + (k_mn / diagonal) @ k_mn.T
    expected_mean = k_x.T @ np.linalg.solve(b, k_mn @ (targets / diagonal))
    reduction = np.linalg.inv(k_m) - np.linalg.inv(b)
    expected_variance = SIGNAL - np.einsum("mn,mk,kn->n", k_x, reduction, k_x) + NOISE
    mean, variance = sparse_process(inducing, points, targets, weights, queries)
    np.testing.assert_allclose(mean, expected_mean, rtol=1e-8)
    np.testing.assert_allclose(variance, expected_variance, rtol=1e-8)


def test_an_integer_weight_equals_a_repeated_sample():
    rng = np.random.default_rng(2)
    points, targets, _ = some_samples(30, rng)
    weights = rng.integers(1, 4, size=30)
    queries = some_samples(10, rng)[0]
    rows = np.repeat(np.arange(30), weights)
    once = sparse_process(points, points, targets, weights.astype(float), queries)
    repeated = sparse_process(points, points[rows], targets[rows], np.ones(len(rows)), queries)
    np.testing.assert_allclose(once, repeated, rtol=1e-6, atol=1e-6)


def test_a_sample_of_no_weight_has_no_precision():
    assert precisions(np.zeros((2, 1)), np.zeros(1), signal_variance=2.0, noise_variance=1.0)[0] == 0.0


def test_repeated_inducing_points_leave_the_posterior_finite_and_the_same():
    rng = np.random.default_rng(3)
    points, targets, weights = some_samples(20, rng)
    twice = sparse_process(np.repeat(points, 2, axis=0), points, targets, weights, points)
    once = sparse_process(points, points, targets, weights, points)
    np.testing.assert_allclose(twice, once, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_two_clusters_far_apart_in_their_own_width_are_fitted(seed):
    rng = np.random.default_rng(seed)
    side = rng.random(1500) < 0.3
    states, actions = (side + 4e-6 * rng.normal(size=1500))[:, None], np.where(side, 1.0, -1.0)[:, None]
    space = Box(-np.inf, np.inf, (1,), np.float64)
    policy = GaussianProcessPolicy.initial(space, Box(-2, 2, (1,), np.float64))
    fitted = policy.fit(states, actions, np.ones(1500), rng=rng)
    means = np.array([greedy(fitted).sample(jax.random.key(0), np.array([place])) for place in (0.0, 1.0)])
    # the cluster at 1 is some thirty steps of single precision wide: processors round its mean by up to 0.2 apart
    np.testing.assert_allclose(means.ravel(), [-1, 1], atol=0.4)


def test_inducing_points_explain_more_than_random_ones():
    rng = np.random.default_rng(4)
    points = coordinates(some_samples(1500, rng)[0], PERIOD) * inverse_bandwidths(BANDWIDTHS, PERIOD)

    def unexplained(rows):
        centres = points[rows]
        whitened = inverse_factor(squared_exponential(centres, centres)) @ squared_exponential(centres, points)
        return 1 - np.square(whitened).sum(axis=0)

    chosen = np.array([unexplained(inducing_rows(points, np.ones(1500), 60, rng=rng)) for _ in range(20)])
    random = np.array([unexplained(rng.choice(1500, 60, replace=False)) for _ in range(20)])
    assert chosen.mean() < 0.7 * random.mean()
    assert np.quantile(chosen, 0.99) < 0.5 * np.quantile(random, 0.99)  # the rare states above all


def test_inducing_points_lie_where_the_weight_is():
    rng = np.random.default_rng(5)
    points = rng.uniform(0, 10, (10_000, 1))
    weights = np.where(points[:, 0] < 3, 1.0, 1e-9)
    assert points[inducing_rows(points, weights, 20, rng=rng)].max() < 3


def test_inducing_points_stop_where_they_explain_everything():
    points = np.repeat(np.array([[0.0], [1.0], [5.0]]), 50, axis=0)
    rows = inducing_rows(points, np.ones(150), 20, rng=np.random.default_rng(6))
    assert sorted(points[rows, 0]) == [0, 1, 5]


def test_the_policy_is_the_full_process_about_the_centre_of_the_action_range():
    rng = np.random.default_rng(7)
    points, targets, weights = some_samples(40, rng)
    policy = policy_with_hyperparameters().fit(points, 10 + targets[:, None], weights, rng=rng, evaluations=0)
    queries = some_samples(20, rng)[0]
    mean, variance = policy.mean_and_variance(queries)
    full_mean, full_variance = full_process(points, targets, weights, queries)
    np.testing.assert_allclose(mean[:, 0], 10 + full_mean, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(variance[:, 0], full_variance, rtol=1e-5)


@pytest.mark.parametrize("number", [5, 12])
def test_the_layout_of_the_arrays_in_memory_does_not_matter(number):
    rng = np.random.default_rng(7)
    points, targets, weights = some_samples(100, rng)
    policy = policy_with_hyperparameters().fit(points, targets[:, None], weights, rng=rng, evaluations=0)
    read = replace(policy, reduction=np.ascontiguousarray(policy.reduction))
    assert read.reduction.strides != policy.reduction.strides
    np.testing.assert_array_equal(read.mean_and_variance(points[:number]), policy.mean_and_variance(points[:number]))


@pytest.mark.slow
def test_traceable_moments_equal_the_matrix_products():
    rng = np.random.default_rng(8)
    points, targets, weights = some_samples(300, rng)
    policy = GaussianProcessPolicy.initial(STATES, Box(-1, np.array([1.0, 5.0]), (2,), np.float64), period=PERIOD)
    policy = policy.fit(points, np.column_stack([targets, points[:, 1]]), weights, rng=rng, evaluations=30)
    with jax.enable_x64(True):
        traced = jax.vmap(policy.moments)(points)
    np.testing.assert_allclose(traced, policy.mean_and_variance(points), rtol=1e-8, atol=1e-8)


def test_far_from_all_samples_the_policy_is_the_prior():
    rng = np.random.default_rng(9)
    points, targets, weights = some_samples(200, rng)
    policy = policy_with_hyperparameters().fit(points, targets[:, None], weights, rng=rng, evaluations=0)
    mean, variance = policy.mean_and_variance(np.array([[0.0, 1e4]]))
    np.testing.assert_allclose((mean[0, 0], variance[0, 0]), (10.0, SIGNAL + NOISE), rtol=1e-12)


def test_the_policy_is_periodic_where_the_observation_is():
    rng = np.random.default_rng(10)
    points, targets, weights = some_samples(200, rng)
    policy = policy_with_hyperparameters().fit(points, targets[:, None], weights, rng=rng, evaluations=0)
    turned = points + np.array([2 * np.pi, 0.0])
    np.testing.assert_allclose(policy.mean_and_variance(points), policy.mean_and_variance(turned), rtol=1e-9)


def test_the_variance_stays_above_the_noise_among_thousands_of_samples():
    rng = np.random.default_rng(11)
    points, targets, weights = some_samples(5000, rng)
    policy = policy_with_hyperparameters(100).fit(points, targets[:, None], weights, rng=rng, evaluations=0)
    variance = policy.mean_and_variance(points)[1]
    assert variance.min() >= NOISE
    assert np.median(variance) < 1.1 * NOISE


def test_the_initial_policy_is_one_normal_distribution():
    policy = GaussianProcessPolicy.initial(STATES, TORQUE, initial_scale=0.9)
    states = np.random.default_rng(12).normal(size=(5, 2))
    np.testing.assert_allclose(policy.action_standard_deviation(states), 0.9 * 60)
    np.testing.assert_allclose(policy.mean_and_variance(states)[0], 10.0)


@pytest.mark.slow
def test_the_search_finds_the_noise_and_a_good_length_scale():
    rng = np.random.default_rng(13)
    points = rng.uniform(-4, 4, (2000, 2))
    actions = 10 * np.sin(points[:, :1]) + 3 * rng.normal(size=(2000, 1))
    policy = GaussianProcessPolicy.initial(STATES, Box(-20, 20, (1,))).fit(points, actions, np.ones(2000), rng=rng)
    assert np.sqrt(policy.noise_variance[0]) == pytest.approx(3.0, rel=0.1)
    mean = policy.mean_and_variance(points)[0]
    assert np.sqrt(np.square(mean - 10 * np.sin(points[:, :1])).mean()) < 0.7
    assert policy.bandwidths[0, 1] > 3 * policy.bandwidths[0, 0]  # the second dimension does not matter
    assert not policy.noise_at_bound[0]


def found(evaluations, samples=None, start=None, rule=2 * BANDWIDTHS, step_size=0.5, seed=0):
    """Where the search ends."""
    return search(
        OutputSamples(*(samples or some_samples(300, np.random.default_rng(14))), PERIOD),
        start=start or Hyperparameters(BANDWIDTHS, SIGNAL, NOISE),
        rule=rule,
        minimum_noise_variance=1.0,
        step_size=step_size,
        evaluations=evaluations,
        rng=np.random.default_rng(seed),
    )


@pytest.fixture(name="asked")
def candidates_asked_for(monkeypatch):
    """All candidates of CMA-ES."""
    asked = []

    class Recorded(hyperparameter_search.CMA):
        def ask(self):
            asked.append(super().ask())
            return asked[-1]

    monkeypatch.setattr(hyperparameter_search, "CMA", Recorded)
    return asked


def test_the_search_never_returns_worse_than_its_start_and_repeats_itself(asked):
    start, one = found(1), found(100)
    assert 80 < len(asked) < 100
    assert one.objective > start.objective
    np.testing.assert_array_equal(one.hyperparameters.logarithms, found(100).hyperparameters.logarithms)
    expected = Hyperparameters(BANDWIDTHS, SIGNAL, NOISE).logarithms
    np.testing.assert_allclose(start.hyperparameters.logarithms, expected)


@pytest.mark.parametrize(
    ("changes", "converged"),
    [
        ({}, True),
        ({"objective": np.array([-FAILED])}, False),
        ({"objective": np.array([-2.0]), "noise_at_bound": np.array([True])}, False),
    ],
)
def test_a_fit_has_converged_where_its_search_found_something_within_the_bounds(changes, converged):
    policy = GaussianProcessPolicy.initial(Box(-1, 1, (2,)), Box(-1, 1, (1,)))
    assert replace(policy, **changes).converged is converged


def test_the_search_keeps_a_good_start_that_one_bold_generation_cannot_beat(asked):
    good = found(200).hyperparameters
    start, before = found(1, start=good, seed=1), len(asked)
    bold = found(10, start=good, step_size=2.0, seed=1)
    assert len(asked) > before
    assert bold.objective == start.objective
    np.testing.assert_allclose(bold.hyperparameters.logarithms, good.logarithms)


def test_the_search_begins_with_half_of_the_weighted_mean_square():
    points = some_samples(40, np.random.default_rng(16))[0]
    targets, weights = np.tile([2.0, 20.0], 20), np.tile([3.0, 1.0], 20)  # (3·4 + 400)/4 = 103
    begun = search(
        OutputSamples(points, targets, weights, PERIOD),
        start=None,
        rule=BANDWIDTHS,
        minimum_noise_variance=1.0,
        step_size=0.5,
        evaluations=1,
        rng=np.random.default_rng(0),
    ).hyperparameters
    assert (begun.signal_variance, begun.noise_variance) == pytest.approx((51.5, 51.5))
    np.testing.assert_allclose(begun.bandwidths, BANDWIDTHS)


def test_held_out_objective_is_the_full_process_on_the_other_half():
    points, targets, weights = some_samples(30, np.random.default_rng(15))
    result = found(1, samples=(points, targets, weights), rule=BANDWIDTHS)
    # the same draws as the search's: subsample, inducing points, halves
    again = np.random.default_rng(0)
    order = again.choice(30, size=30, replace=False)
    x, y, w = points[order], targets[order], weights[order]
    inducing_rows(coordinates(x, PERIOD) * inverse_bandwidths(BANDWIDTHS, PERIOD), w, 30, rng=again)
    half = np.isin(np.arange(30), again.permutation(30)[:15])
    total = 0.0
    for train in (half, ~half):
        mean, variance = full_process(x[train], y[train], w[train], x[~train])
        densities = -0.5 * (np.square(y[~train] - mean) / variance + np.log(2 * np.pi * variance))
        total += w[~train] @ densities
    assert result.objective == pytest.approx(total / w.sum(), rel=1e-5)


def test_noise_keeps_to_its_floor_where_the_actions_do_not_vary():
    rng = np.random.default_rng(17)
    points = some_samples(100, rng)[0]
    policy = GaussianProcessPolicy.initial(STATES, TORQUE, minimum_noise=0.02)
    for _ in range(3):
        policy = policy.fit(points, np.full((100, 1), 13.0), np.ones(100), rng=rng, evaluations=60)
    assert np.all(policy.action_standard_deviation(points) >= 0.02 * 60)
    assert np.all(policy.action_standard_deviation(points) < 0.1 * 60)
    np.testing.assert_allclose(policy.mean_and_variance(points)[0], 13.0, atol=0.5)


def test_a_constant_observation_dimension_changes_nothing():
    rng = np.random.default_rng(18)
    points, targets, weights = some_samples(150, rng)
    points[:, 1] = 4.0
    policy = GaussianProcessPolicy.initial(STATES, TORQUE, period=PERIOD)
    policy = policy.fit(points, targets[:, None], weights, rng=rng, evaluations=60)
    assert policy.bandwidths[0, 1] == 0.0
    elsewhere = points + np.array([0.0, 9.0])
    np.testing.assert_array_equal(policy.mean_and_variance(points), policy.mean_and_variance(elsewhere))


@pytest.mark.slow
def test_repeated_fits_to_own_samples_neither_lose_nor_gain_exploration():
    rng = np.random.default_rng(19)
    states = some_samples(1000, rng)[0]
    policy = GaussianProcessPolicy.initial(STATES, TORQUE, period=PERIOD, initial_scale=0.4)
    for turn in range(8):
        actions = sample_actions(policy, jax.random.key(turn), states)
        policy = policy.fit(states, actions, np.ones(1000), rng=rng)
    assert policy.action_standard_deviation(states).mean() == pytest.approx(0.4 * 60, rel=0.15)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"initial_scale": 0.0}, "initial_scale"),
        ({"initial_scale": np.nan}, "initial_scale"),
        ({"minimum_noise": -1.0}, "minimum_noise"),
        ({"number_of_inducing_points": 0}, "number_of_inducing_points"),
        ({"period": (1.0,)}, "period: expected 2"),
    ],
)
def test_bad_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        GaussianProcessPolicy.initial(STATES, TORQUE, **options)


def test_a_negative_number_of_evaluations_is_named():
    policy = GaussianProcessPolicy.initial(STATES, TORQUE)
    with pytest.raises(ValueError, match="evaluations: expected a whole number >= 0, got -1"):
        policy.fit(np.ones((3, 2)), np.ones((3, 1)), np.ones(3), rng=np.random.default_rng(0), evaluations=-1)
