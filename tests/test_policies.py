"""The contract of all policies, and what is particular to the tabular, linear-Gaussian and softmax ones."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from scipy.integrate import quad
from scipy.stats import multivariate_normal

from bayespbrl.policies import (
    GaussianProcessPolicy,
    LinearGaussianPolicy,
    Policy,
    SoftmaxPolicy,
    TabularPolicy,
    batch,
    entropies,
    greedy,
    log_probabilities,
    sample_actions,
    softmax,
)
from bayespbrl.policies.choice import fitting
from bayespbrl.policies.samples import location_and_deviation
from bayespbrl.policies.spaces import centre_and_range

CONTINUOUS = Box(-np.inf, np.inf, (2,))
TORQUES = Box(np.array([-2.0, 0.0]), np.array([2.0, 10.0]), dtype=np.float64)
TORQUE = Box(-2.0, 2.0, (1,))
KINDS = {
    "tabular": (TabularPolicy, Discrete(4), Discrete(3), {}, {}),
    "softmax": (SoftmaxPolicy, CONTINUOUS, Discrete(3), {"number_of_centres": 20, "period": (2.0, np.inf)}, {}),
    "linear": (LinearGaussianPolicy, CONTINUOUS, TORQUES, {}, {}),
    "process": (
        GaussianProcessPolicy,
        CONTINUOUS,
        TORQUES,
        {"number_of_inducing_points": 40, "period": (2.0, np.inf)},
        {"evaluations": 60},
    ),
}


@pytest.fixture(params=KINDS, name="kind")
def a_kind(request):
    return request.param


def initial(kind):
    policy_class, observations, actions, options, _ = KINDS[kind]
    return policy_class.initial(observations, actions, **options)


def some_observations(kind, number, rng):
    if kind == "tabular":
        return rng.integers(4, size=number)
    return np.column_stack([rng.uniform(-1, 1, number), 3 * rng.normal(size=number) + 5])


def preferred_actions(kind, observations, rng):
    """Actions that depend on the observation, with noise."""
    number = len(observations)
    if kind == "tabular":
        return np.where(rng.random(number) < 0.7, observations % 3, rng.integers(3, size=number))
    if kind == "softmax":
        return np.where(rng.random(number) < 0.8, (observations[:, 1] > 5) + 0, rng.integers(3, size=number))
    mean = np.column_stack([0.4 * (observations[:, 1] - 5), 5 - observations[:, 1] / 2])
    noise = rng.normal(size=(number, 2)) @ np.array([[0.5, 1.0], [0.0, 1.0]])
    return mean + noise


def fit(policy, kind, observations, actions, weights, seed=0, **options):
    rng = np.random.default_rng(seed)
    return policy.fit(observations, actions, weights, rng=rng, **(KINDS[kind][4] | options))


@pytest.fixture(name="fitted")
def a_fitted_policy(kind):
    rng = np.random.default_rng(1)
    observations = some_observations(kind, 400, rng)
    return fit(initial(kind), kind, observations, preferred_actions(kind, observations, rng), np.ones(400))


@pytest.mark.parametrize("bound", [1.0, 1e30, float(np.finfo(np.float64).max), np.inf])
def test_a_policy_fits_spaces_however_wide(bound):
    wide = Box(-bound, bound, (2,), np.float64)
    policy = LinearGaussianPolicy.initial(wide, TORQUE)
    assert fitting(policy, wide, TORQUE) is policy


def test_every_policy_is_a_policy():
    assert [kind for kind in KINDS if not isinstance(initial(kind), Policy)] == []


def test_sampled_actions_have_the_spaces_shape_and_type(kind, fitted):
    observations = some_observations(kind, 5, np.random.default_rng(2))
    actions = sample_actions(fitted, jax.random.key(0), observations)
    if kind in ("tabular", "softmax"):
        assert actions.shape == (5,)
        assert actions.dtype == np.int64
        assert fitted.probabilities(observations).shape == (5, 3)
        np.testing.assert_allclose(fitted.probabilities(observations).sum(axis=1), 1)
    else:
        assert actions.shape == (5, 2)
        assert actions.dtype == np.float64
        assert fitted.action_standard_deviation(observations).shape == (5, 2)


def test_sampled_actions_follow_log_prob(kind, fitted):
    """The mean of −log π(a|s) over samples is the entropy, within its standard error: shape and scale are right."""
    observation = some_observations(kind, 1, np.random.default_rng(3))
    observations = np.repeat(observation, 20_000, axis=0)
    actions = sample_actions(fitted, jax.random.key(1), observations)
    logarithms = log_probabilities(fitted, observations, actions)
    error = logarithms.std() / np.sqrt(len(actions)) + 1e-12
    assert abs(-logarithms.mean() - entropies(fitted, observation)[0]) < 4 * error
    if kind in ("tabular", "softmax"):
        shares = np.bincount(actions, minlength=3) / len(actions)
        np.testing.assert_allclose(shares, fitted.probabilities(observation)[0], atol=0.02)
        expected = np.log(fitted.probabilities(observations)[np.arange(20_000), actions])
        np.testing.assert_allclose(logarithms, expected, rtol=1e-9)
    else:
        deviation = fitted.action_standard_deviation(observation)[0]
        np.testing.assert_allclose(actions.std(axis=0), deviation, rtol=0.03)


def test_the_mode_is_the_most_probable_action(kind, fitted):
    observations = some_observations(kind, 5, np.random.default_rng(3))
    chosen = sample_actions(greedy(fitted), jax.random.key(0), observations)
    np.testing.assert_array_equal(chosen, sample_actions(greedy(fitted), jax.random.key(1), observations))
    highest = log_probabilities(fitted, observations, chosen)
    for key in range(20):
        others = sample_actions(fitted, jax.random.key(key), observations)
        assert np.all(log_probabilities(fitted, observations, others) <= highest + 1e-9)


def test_a_row_depends_on_the_key_and_its_number_alone(kind, fitted):
    observations = some_observations(kind, batch.CHUNK + 10, np.random.default_rng(4))
    many = sample_actions(fitted, jax.random.key(2), observations)
    np.testing.assert_array_equal(many[:7], sample_actions(fitted, jax.random.key(2), observations[:7]))
    assert not np.array_equal(many[:7], sample_actions(fitted, jax.random.key(3), observations[:7]))


@pytest.mark.slow
def test_neither_the_number_of_observations_nor_a_new_fit_compiles_anything(kind):
    rng = np.random.default_rng(5)
    policy, sizes = initial(kind), []
    for number in (3, 200, batch.CHUNK + 1):
        observations = some_observations(kind, number, rng)
        actions = sample_actions(policy, jax.random.key(0), observations)
        log_probabilities(policy, observations, actions)
        entropies(policy, observations)
        policy = fit(policy, kind, observations, actions, np.ones(number))
        functions = (batch._sample_chunk, batch._log_prob_chunk, batch._entropy_chunk)
        sizes.append([function._cache_size() for function in functions])
    assert sizes[0] == sizes[1] == sizes[2]


@pytest.mark.parametrize("kind", ["linear", "process"], indirect=True)
def test_a_fit_of_the_mean_holds_the_spread_and_follows_the_weights(kind, fitted):
    rng = np.random.default_rng(6)
    observations = some_observations(kind, 400, rng)
    actions = sample_actions(fitted, jax.random.key(4), observations)
    weights = np.exp(actions[:, 0])  # the larger, the better
    weights /= weights.mean()
    moved = fitted.fit_mean(observations, actions, weights, rng=np.random.default_rng(7))
    held = ("factor",) if kind != "process" else ("noise_variance", "signal_variance", "bandwidths")
    for name in held:
        np.testing.assert_array_equal(getattr(moved, name), getattr(fitted, name))
    after = sample_actions(moved, jax.random.key(5), observations)
    before = sample_actions(fitted, jax.random.key(5), observations)
    assert after[:, 0].mean() > before[:, 0].mean() + 0.1
    deviations = [policy.action_standard_deviation(observations).mean(axis=0) for policy in (moved, fitted)]
    np.testing.assert_allclose(*deviations, rtol=0.1)


def test_a_policy_is_a_pytree(kind, fitted):
    leaves, structure = jax.tree.flatten(fitted)
    again = jax.tree.unflatten(structure, leaves)
    observations = some_observations(kind, 4, np.random.default_rng(6))
    np.testing.assert_array_equal(again.kl_divergence(fitted, observations), fitted.kl_divergence(fitted, observations))
    assert jax.tree.structure(initial(kind)) == structure
    assert [np.shape(leaf) for leaf in leaves] == [np.shape(leaf) for leaf in jax.tree.leaves(initial(kind))]
    assert [np.asarray(x).dtype for x in leaves] == [np.asarray(x).dtype for x in jax.tree.leaves(initial(kind))]


def test_kl_divergence_is_zero_to_itself_and_positive_to_another(kind, fitted):
    observations = some_observations(kind, 50, np.random.default_rng(7))
    np.testing.assert_allclose(fitted.kl_divergence(fitted, observations), 0, atol=1e-12)
    divergence = fitted.kl_divergence(initial(kind), observations)
    assert divergence.shape == (50,)
    assert np.all(divergence >= 0)
    assert divergence.max() > 0.05


def test_kl_divergence_is_the_expected_difference_of_log_probabilities(kind, fitted):
    rng = np.random.default_rng(8)
    observation = some_observations(kind, 1, rng)
    if kind == "tabular":
        other = TabularPolicy(rng.dirichlet(np.ones(3), size=4))
    else:
        observations = some_observations(kind, 300, rng)
        other = fit(initial(kind), kind, observations, preferred_actions(kind, observations, rng), rng.random(300))
    observations = np.repeat(observation, 20_000, axis=0)
    actions = sample_actions(fitted, jax.random.key(4), observations)
    differences = log_probabilities(fitted, observations, actions) - log_probabilities(other, observations, actions)
    error = 4 * differences.std() / np.sqrt(len(actions)) + 1e-6
    assert abs(differences.mean() - fitted.kl_divergence(other, observation)[0]) < error


def test_equal_weights_on_its_own_samples_return_the_policy(kind, fitted):
    observations = some_observations(kind, 3000, np.random.default_rng(9))
    actions = sample_actions(fitted, jax.random.key(5), observations)
    again = fit(fitted, kind, observations, actions, np.ones(3000))
    assert again.kl_divergence(fitted, observations).mean() < 0.02


def test_weights_shift_the_policy_towards_the_heavy_samples(kind, fitted):
    rng = np.random.default_rng(10)
    observations = some_observations(kind, 2000, rng)
    actions = sample_actions(fitted, jax.random.key(6), observations)
    wanted = actions == 1 if actions.ndim == 1 else actions[:, 1] > np.median(actions[:, 1])
    weights = np.where(wanted, 1.5, 0.5) / np.where(wanted, 1.5, 0.5).mean()
    shifted = fit(fitted, kind, observations, actions, weights)
    before = log_probabilities(fitted, observations, actions)
    after = log_probabilities(shifted, observations, actions)
    assert weights @ after > weights @ before
    assert (after - before)[wanted].mean() > (after - before)[~wanted].mean()


def test_an_integer_weight_equals_a_repeated_sample(kind):
    rng = np.random.default_rng(11)
    observations = some_observations(kind, 30, rng)
    actions = preferred_actions(kind, observations, rng)
    weights = rng.integers(1, 4, size=30)
    rows = np.repeat(np.arange(30), weights)
    # which centres and hyper-parameters are drawn depends on the rows: keep all of them, and the old parameters
    options = {"evaluations": 0} if kind == "process" else {}
    policy = initial(kind)
    if kind == "process":
        policy = replace(policy, bandwidths=np.full((2, 2), 1.5))
    if kind == "softmax":
        policy = SoftmaxPolicy.initial(CONTINUOUS, Discrete(3), number_of_centres=30)
        observations[:, 1] = observations[:, 0]  # one length scale for all draws of pairs, to within the tolerance
    once = fit(policy, kind, observations, actions, weights.astype(float), **options)
    repeated = fit(policy, kind, observations[rows], actions[rows], np.ones(len(rows)), **options)
    tolerance = {"softmax": 0.02, "process": 1e-6}.get(kind, 1e-9)
    assert once.kl_divergence(repeated, observations).max() < tolerance


def test_a_softmax_policy_of_many_actions_has_fewer_centres():
    centres = [len(SoftmaxPolicy.initial(CONTINUOUS, Discrete(number)).centres) for number in (2, 20, 40, 200)]
    assert centres == [50, 50, 25, 10]


def test_base_weights_multiply_sample_weights(kind):
    rng = np.random.default_rng(12)
    observations = some_observations(kind, 200, rng)
    actions = preferred_actions(kind, observations, rng)
    base, weights = rng.random(200), rng.random(200)
    one = fit(initial(kind), kind, observations, actions, weights, base_weights=7 * base)
    two = fit(initial(kind), kind, observations, actions, weights * base / base.mean())
    assert one.kl_divergence(two, observations).max() < 1e-8


def test_samples_without_weight_are_ignored(kind):
    rng = np.random.default_rng(13)
    observations = some_observations(kind, 200, rng)
    actions = preferred_actions(kind, observations, rng)
    weights = rng.random(200) * (rng.random(200) < 0.5)
    kept = weights > 0
    one = fit(initial(kind), kind, observations, actions, weights)
    two = fit(initial(kind), kind, observations[kept], actions[kept], weights[kept])
    np.testing.assert_array_equal(one.kl_divergence(two, observations), two.kl_divergence(two, observations))


def test_the_same_generator_gives_the_same_fit(kind):
    rng = np.random.default_rng(14)
    observations = some_observations(kind, 100, rng)
    actions = preferred_actions(kind, observations, rng)
    one, two = (fit(initial(kind), kind, observations, actions, np.ones(100), seed=3) for _ in "ab")
    for left, right in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_array_equal(left, right)


def test_one_sample_is_enough(kind):
    observation = some_observations(kind, 1, np.random.default_rng(15))
    action = preferred_actions(kind, observation, np.random.default_rng(16))
    policy = fit(initial(kind), kind, observation, action, np.ones(1))
    assert np.isfinite(log_probabilities(policy, observation, action)).all()
    before = log_probabilities(initial(kind), observation, action)
    assert log_probabilities(policy, observation, action)[0] > before[0]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda s, a, w: (s, a, np.append(w[1:], np.nan)), "sample_weights: expected finite"),
        (lambda s, a, w: (s, a, np.append(w[1:], -1.0)), "sample_weights: expected finite"),
        (lambda s, a, w: (s, a, np.zeros_like(w)), "sample_weights: expected at least one positive"),
        (lambda s, a, w: (s, a, w[1:]), r"sample_weights: expected shape \(9,\), got \(8,\)"),
        (lambda s, a, w: (s[1:], a, w), "actions: expected as many rows as observations, at least one, got 9 and 8"),
        (
            lambda s, a, w: (s[:0], a[:0], w[:0]),
            "actions: expected as many rows as observations, at least one, got 0 and 0",
        ),
        (lambda s, a, w: (s * np.nan, a, w), "observations: expected"),
        (lambda s, a, w: (s, a * np.nan, w), "actions: expected"),
        (lambda s, a, w: (s[:, None], a, w), "observations: expected"),
        (lambda s, a, w: (s, a[:, None], w), "actions: expected"),
    ],
)
def test_bad_samples_are_named(spoil, message):
    for kind in KINDS:
        rng = np.random.default_rng(17)
        observations = some_observations(kind, 9, rng)
        actions = preferred_actions(kind, observations, rng)
        with pytest.raises(ValueError, match=message):
            fit(initial(kind), kind, *spoil(observations, actions, np.ones(9)))


def test_base_weights_without_mass_under_the_weights_are_refused():
    with pytest.raises(ValueError, match="sample_weights: expected a positive weight where"):
        initial("tabular").fit(np.array([0, 1]), np.array([0, 1]), np.array([1.0, 0]), base_weights=np.array([0, 1.0]))


@pytest.mark.parametrize(
    ("policy_class", "observations", "actions", "name"),
    [
        (TabularPolicy, CONTINUOUS, Discrete(2), "observation_space"),
        (TabularPolicy, Discrete(2), TORQUE, "action_space"),
        (TabularPolicy, Discrete(2), Discrete(3, start=1), "action_space"),
        (SoftmaxPolicy, Discrete(2), Discrete(2), "observation_space"),
        (SoftmaxPolicy, CONTINUOUS, TORQUE, "action_space"),
        (LinearGaussianPolicy, CONTINUOUS, Discrete(2), "action_space"),
        (LinearGaussianPolicy, Box(0, 1, (2, 2)), TORQUE, "observation_space"),
        (GaussianProcessPolicy, Discrete(3), TORQUE, "observation_space"),
        (GaussianProcessPolicy, CONTINUOUS, Box(1.0, 1.0, (1,)), "action_space: expected low < high"),
    ],
)
def test_spaces_that_do_not_suit_are_named(policy_class, observations, actions, name):
    with pytest.raises(ValueError, match=name):
        policy_class.initial(observations, actions)


def test_a_linear_fit_to_few_samples_holds_the_noise_and_stays_near_the_old_mean():
    rng = np.random.default_rng(0)
    wide = Box(-1, 1, (48,), np.float64)
    states = rng.normal(size=(400, 48))
    policy = LinearGaussianPolicy.initial(wide, TORQUE)
    many = policy.fit(states, np.sin(states[:, :1]) + rng.normal(size=(400, 1)), np.ones(400))
    drawn = sample_actions(many, jax.random.key(0), states[:40])
    few = many.fit(states[:40], drawn, np.ones(40))
    np.testing.assert_array_equal(few.factor, many.factor)
    assert np.mean(few.kl_divergence(many, states[:40])) < 0.3  # interpolated it would be 0.5
    towards = many.fit(states[:40], many._means(states[:40]), np.ones(40))
    np.testing.assert_allclose(towards._means(states), many._means(states), atol=1e-9)


@pytest.mark.parametrize(("number", "held"), [(5, True), (7, False)])
def test_a_linear_fit_has_the_noise_of_twice_as_many_samples_as_an_action_has_coefficients(number, held):
    rng = np.random.default_rng(1)
    policy = LinearGaussianPolicy.initial(Box(-1, 1, (2,), np.float64), TORQUE)
    states, actions = rng.normal(size=(number, 2)), rng.normal(size=(number, 1))
    fitted = policy.fit(states, actions, np.ones(number))
    assert np.array_equal(fitted.factor, policy.factor) is held


def test_a_dimension_that_is_constant_but_for_rounding_has_no_deviation():
    rng = np.random.default_rng(2)
    observations = np.column_stack([np.full(300, 1e6 + 0.1), 1e6 + 0.1 * rng.normal(size=300)])
    weights = rng.random(300)
    location, deviation = location_and_deviation(observations, weights / weights.sum())
    assert location[0] == pytest.approx(1e6 + 0.1)
    assert deviation[0] == 0
    assert deviation[1] == pytest.approx(0.1, rel=0.2)


def test_no_observation_is_refused():
    with pytest.raises(ValueError, match="at least one row"):
        sample_actions(initial("tabular"), jax.random.key(0), np.zeros(0, int))


def test_an_infinite_bound_counts_as_the_unit_interval():
    centre, width = centre_and_range(
        "action_space", Box(np.array([-np.inf, 1.0]), np.array([np.inf, 4.0]), dtype=float)
    )
    np.testing.assert_array_equal(centre, [0.0, 2.5])
    np.testing.assert_array_equal(width, [2.0, 3.0])


def test_where_one_bound_is_infinite_the_centre_is_beside_the_other():
    space = Box(np.array([3.0, -np.inf]), np.array([np.inf, -8.0]), dtype=float)
    centre, width = centre_and_range("action_space", space)
    np.testing.assert_array_equal(centre, [4.0, -9.0])
    np.testing.assert_array_equal(width, [2.0, 2.0])


def test_the_tabular_fit_is_the_share_of_the_weight_and_keeps_unvisited_rows():
    policy = TabularPolicy(np.array([[0.5, 0.5], [0.25, 0.75], [0.1, 0.9]]))
    new = policy.fit(np.array([0, 0, 0, 2]), np.array([0, 1, 1, 1]), np.array([1.0, 2.0, 1.0, 5.0]))
    np.testing.assert_allclose(new.table, [[0.25, 0.75], [0.25, 0.75], [0.0, 1.0]])


def test_the_tabular_fit_to_all_actions_reproduces_the_target():
    # every action of every visited state with base weight q(a|s)·visits and weight p/W, as REPS hands them over
    rng = np.random.default_rng(18)
    policy = TabularPolicy(rng.dirichlet(np.ones(3), size=4))
    visits, tilt = np.array([3.0, 1.0, 0.0, 2.0]), np.exp(rng.normal(size=(4, 3)))
    states, actions = np.repeat(np.arange(4), 3), np.tile(np.arange(3), 4)
    base = (visits[:, None] * policy.table).ravel()
    new = policy.fit(states, actions, tilt.ravel(), base_weights=base / base.sum())
    target = policy.table * tilt / (policy.table * tilt).sum(axis=1, keepdims=True)
    np.testing.assert_allclose(new.table, np.where(visits[:, None] > 0, target, policy.table))


def test_kl_to_a_table_that_excludes_an_action_is_infinite():
    new, old = TabularPolicy(np.array([[0.5, 0.5]])), TabularPolicy(np.array([[1.0, 0.0]]))
    assert new.kl_divergence(old, np.array([0]))[0] == np.inf
    assert old.kl_divergence(new, np.array([0]))[0] == pytest.approx(np.log(2))


def test_the_linear_fit_is_weighted_least_squares():
    rng = np.random.default_rng(19)
    observations = rng.normal(size=(60, 2)) * [1, 100] + [0, 1000]
    actions, weights = rng.normal(size=(60, 2)) + observations[:, :1], rng.random(60)
    policy = initial("linear").fit(observations, actions, weights)
    design = np.column_stack([np.ones(60), observations])
    slopes = np.linalg.lstsq(design * np.sqrt(weights)[:, None], actions * np.sqrt(weights)[:, None], rcond=None)[0]
    with jax.enable_x64(True):
        means = jax.vmap(policy.mean)(observations)
    np.testing.assert_allclose(means, design @ slopes, rtol=1e-5, atol=1e-6)
    residuals = actions - design @ slopes
    covariance = (residuals * weights[:, None]).T @ residuals / weights.sum()
    np.testing.assert_allclose(policy.factor @ policy.factor.T, covariance, rtol=1e-6)
    expected = [multivariate_normal(m, covariance).logpdf(a) for m, a in zip(design @ slopes, actions, strict=True)]
    np.testing.assert_allclose(log_probabilities(policy, observations, actions), expected, rtol=1e-5)


def test_the_linear_fit_does_not_depend_on_the_unit_of_observations():
    rng = np.random.default_rng(20)
    observations = rng.normal(size=(60, 2))
    actions = observations + 0.1 * rng.normal(size=(60, 2))
    plain, small = (initial("linear").fit(unit * observations, actions, np.ones(60)) for unit in (1.0, 1e-15))
    with jax.enable_x64(True):
        means = [jax.vmap(policy.mean)(unit * observations) for policy, unit in ((plain, 1.0), (small, 1e-15))]
    np.testing.assert_allclose(means[1], means[0], atol=1e-6)


def test_the_linear_noise_keeps_to_its_floor():
    observations = np.random.default_rng(21).normal(size=(20, 2))
    policy = LinearGaussianPolicy.initial(CONTINUOUS, TORQUES, minimum_noise=0.02)
    policy = policy.fit(observations, observations @ np.ones((2, 2)), np.ones(20))
    np.testing.assert_allclose(policy.action_standard_deviation(observations)[0], 0.02 * np.array([4.0, 10.0]))


@pytest.mark.slow
def test_gaussian_kl_divergence_agrees_with_quadrature():
    def policy(mean, deviation):
        return replace(
            LinearGaussianPolicy.initial(CONTINUOUS, TORQUE),
            coefficients=np.array([[mean, 0.0, 0.0]]),
            factor=np.array([[deviation]]),
        )

    new, old = policy(1.0, 0.5), policy(0.2, 1.3)
    observation = np.array([[3.0, -1.0]])

    def integrand(action):
        pair = [log_probabilities(p, observation, np.array([[action]]))[0] for p in (new, old)]
        return np.exp(pair[0]) * (pair[0] - pair[1])

    assert new.kl_divergence(old, observation)[0] == pytest.approx(quad(integrand, -4, 6)[0], abs=1e-7)


def test_the_softmax_recovers_probabilities_it_can_represent():
    rng = np.random.default_rng(22)
    observations = rng.normal(size=(2000, 2)) * [0.1, 10]
    logits = np.column_stack([20 * observations[:, 0], 0.1 * observations[:, 1], np.zeros(2000)])
    target = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    policy = SoftmaxPolicy.initial(CONTINUOUS, Discrete(3), number_of_centres=10)
    states, actions = np.repeat(observations, 3, axis=0), np.tile(np.arange(3), 2000)
    policy = policy.fit(states, actions, target.ravel() * 3, rng=rng)
    assert policy.converged
    assert policy.newton_decrement < 1e-12
    np.testing.assert_allclose(policy.probabilities(observations), target, atol=2e-3)


def test_the_softmax_is_at_the_optimum_of_its_penalised_likelihood():
    # one constant state: only intercepts, one equal to the other by symmetry; the kernel feature of one centre is a
    # second intercept, so the logit difference is that of a logistic regression with the sum of two prior variances
    states, actions = np.ones((4, 2)), np.array([0, 1, 1, 1])
    policy = SoftmaxPolicy.initial(CONTINUOUS, Discrete(2), prior_scale=0.7)
    policy = policy.fit(states, actions, np.ones(4), rng=np.random.default_rng(0))
    probability = policy.probabilities(states)[0, 1]
    difference = np.log(probability / (1 - probability))
    # d/dΔ [3Δ − 4 log(1 + e^Δ) − Δ²/(2 · 2 · 2 · 0.49)] = 0 at the optimum
    assert 3 - 4 * probability == pytest.approx(difference / (4 * 0.49), abs=1e-5)


def test_the_softmax_says_when_its_iterations_did_not_suffice(monkeypatch):
    rng = np.random.default_rng(23)
    observations = some_observations("softmax", 300, rng)
    actions = (observations[:, 1] > 5).astype(int)
    separated = initial("softmax").fit(observations, actions, np.ones(300), rng=rng)
    assert separated.converged
    assert np.isfinite(separated.probabilities(observations * 100)).all()
    monkeypatch.setattr(softmax, "NEWTON_STEPS", 1)
    assert not initial("softmax").fit(observations, actions, np.ones(300), rng=rng).converged


def test_a_tabular_fit_keeps_the_minimum_probability_of_every_action():
    policy = TabularPolicy.initial(Discrete(2), Discrete(4), minimum_probability=0.01)
    fitted = policy.fit(np.array([0, 0]), np.array([1, 2]), np.array([3.0, 1.0]))
    np.testing.assert_allclose(fitted.table[0], [0.01, 0.01 + 0.96 * 0.75, 0.01 + 0.96 * 0.25, 0.01])
    np.testing.assert_allclose(fitted.table[1], 0.25)
    assert fitted.fit(np.array([0]), np.array([0]), np.array([1.0])).table[0, 1] == pytest.approx(0.01)
    with pytest.raises(ValueError, match="minimum_probability"):
        TabularPolicy.initial(Discrete(2), Discrete(4), minimum_probability=0.25)
