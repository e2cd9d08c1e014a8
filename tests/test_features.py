"""Features: one-hot, radial basis functions, their products with actions, and the checks of a user's own."""

from dataclasses import fields, is_dataclass, replace

import jax
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
from gymnasium.spaces import Box, Discrete

from bayespbrl.features import (
    DiffusionBasis,
    FeatureSource,
    JointRadialBasis,
    OneHot,
    OwnFeatures,
    RadialBasis,
    RadialBasisOptions,
    StateActionProduct,
    checked_features,
    diffusion_basis,
    draw_state_action_features,
    draw_state_features,
)
from bayespbrl.features.drawn import EFFORT
from bayespbrl.kernels import ROWS_AT_A_TIME, median_bandwidths, radial_basis_row
from bayespbrl.trajectories import Trajectory, trajectory_features
from bayespbrl.utility import infer_utility
from bayespbrl.utility.length_scales import bandwidth_multiples, sums_under, values_under

PERIOD = (2 * np.pi, np.inf)
STATES = Box(-np.inf, np.inf, (2,))
TORQUE = Box(-30.0, 30.0, (1,))


def swinging_states(number, rng):
    return np.column_stack([rng.uniform(-np.pi, np.pi, number), 5 * rng.normal(size=number) + 3])


def test_one_hot_marks_the_state():
    np.testing.assert_array_equal(OneHot(3)(np.array([2, 0])), [[0, 0, 1], [1, 0, 0]])


def test_standardised_features_vary_alike_between_trajectories():
    rng = np.random.default_rng(0)
    paths = [np.array([0, *rng.integers(3, size=rng.integers(1, 9)), *[3] * (n == 5)]) for n in range(20)]
    walks = [Trajectory(path, path[1:], np.zeros(len(path) - 1), terminated=True) for path in paths]
    options = RadialBasisOptions(10, standardised=True)
    features = FeatureSource(Discrete(5), Discrete(3)).of_states(walks, options, rng=rng)
    sums = trajectory_features(walks, features, discount=1.0)
    np.testing.assert_allclose(sums[:, :3].std(axis=0), 1.0)
    # the goal, which one of twenty reaches; another state, which none has reached, as if one had
    np.testing.assert_allclose(features(np.array([3, 4])).sum(axis=1), np.sqrt(20))
    assert sums[5, 3] == pytest.approx(np.sqrt(20))


def walk(*states, number=4):
    """The diffusion basis of one trajectory through these of so many states."""
    steps = len(states) - 1
    trajectory = Trajectory(np.array(states), np.zeros(steps, int), np.zeros(steps), terminated=False)
    return diffusion_basis([trajectory], number)


def test_the_diffusion_basis_is_a_root_of_the_matrix_exponential_of_the_laplacian():
    features = walk(0, 1, 2, 1, 1).rescaled([3.0])  # a length scale of one step; nothing is known of state 3
    laplacian = np.array([[1, -1, 0, 0], [-1, 2, -1, 0], [0, -1, 1, 0], [0, 0, 0, 0]])
    kernel = scipy.linalg.expm(-0.5 * laplacian)
    deviations = np.sqrt(np.diag(kernel))
    basis = features(np.arange(4))
    np.testing.assert_allclose(basis @ basis.T, kernel / np.outer(deviations, deviations), atol=1e-12)


def test_without_a_length_scale_the_states_of_a_diffusion_basis_are_independent():
    basis = walk(0, 1, 2, 3).rescaled([0.0])(np.array([3, 1, 0]))
    np.testing.assert_allclose(basis @ basis.T, np.eye(3), atol=1e-12)


def test_states_many_steps_apart_have_less_to_do_with_each_other_and_more_under_a_longer_scale():
    basis = walk(0, 1, 2, 3)
    near, far = ((lambda b: b @ b[0])(basis.rescaled([m])(np.arange(4))) for m in (3.0, 9.0))
    assert np.all(np.diff(near) < 0)
    assert np.all(far[1:] > near[1:])


def test_a_source_draws_the_diffusion_basis_of_discrete_states_where_it_is_asked_for():
    trajectory = Trajectory(np.array([0, 1, 2]), np.zeros(2, int), np.zeros(2), terminated=False)
    source, rng = FeatureSource(Discrete(3), Discrete(2)), np.random.default_rng(0)
    for diffusion, kind in ((True, DiffusionBasis), (False, OneHot)):
        options = RadialBasisOptions(10, diffusion=diffusion)
        assert isinstance(source.of_states([trajectory], options, rng=rng), kind)
    large = FeatureSource(Discrete(2000), Discrete(2))
    with pytest.raises(ValueError, match=r"^diffusion_utility: expected at most 1000 states, got 2000$"):
        large.of_states([trajectory], RadialBasisOptions(10, diffusion=True), rng=rng)


def test_one_hot_of_state_and_action_numbers_the_actions_within_a_state():
    features = StateActionProduct(OneHot(2), 3)(np.array([0, 1]), np.array([2, 1]))
    np.testing.assert_array_equal(features, [[0, 0, 1, 0, 0, 0], [0, 0, 0, 0, 1, 0]])


def test_radial_basis_is_the_gaussian_of_the_scaled_distance():
    features = RadialBasis(np.array([[1.0, -2.0], [4.0, 0.0]]), np.array([2.0, 0.5]), np.array([np.inf, np.inf]))
    # first centre: (2/2)² + (1/0.5)² = 5; second: (−1/2)² + (−1/0.5)² = 4.25
    np.testing.assert_allclose(features(np.array([[3.0, -1.0]])), np.exp([[-2.5, -2.125]]), rtol=1e-14)


def test_periodic_kernel_is_the_kernel_over_cosine_and_sine():
    rng = np.random.default_rng(0)
    points, centres = rng.uniform(-9, 9, (40, 1)), rng.uniform(-9, 9, (7, 1))
    periodic = RadialBasis(centres, np.array([0.4]), np.array([2 * np.pi]))(points)

    def circle(x):
        return np.hstack([np.cos(x), np.sin(x)])

    plain = RadialBasis(circle(centres), np.array([0.4, 0.4]), np.array([np.inf, np.inf]))(circle(points))
    np.testing.assert_allclose(periodic, plain, atol=1e-14)
    np.testing.assert_allclose(
        periodic, RadialBasis(centres, np.array([0.4]), np.array([2 * np.pi]))(points + 4 * np.pi)
    )


def test_a_long_period_is_no_period():
    points, centres = np.array([[0.3], [2.0]]), np.array([[-0.5], [0.7]])
    long = RadialBasis(centres, np.array([0.8]), np.array([1e4]))(points)
    np.testing.assert_allclose(long, RadialBasis(centres, np.array([0.8]), np.array([np.inf]))(points), rtol=1e-5)


def test_matrix_product_loses_no_accuracy_far_from_the_origin():
    rng = np.random.default_rng(1)
    points, centres = 1e6 + rng.normal(size=(50, 3)), 1e6 + rng.normal(size=(9, 3))
    bandwidths = np.array([0.5, 1.0, 2.0])
    direct = np.exp(-0.5 * (np.square(points[:, None] - centres) / bandwidths**2).sum(axis=2))
    np.testing.assert_allclose(RadialBasis(centres, bandwidths, np.full(3, np.inf))(points), direct, rtol=1e-12)


def test_normalised_functions_are_the_plain_ones_over_their_sum_and_go_on_beyond_the_centres():
    rng = np.random.default_rng(0)
    plain = RadialBasis(rng.normal(size=(7, 2)), np.array([0.5, 2.0]), np.array([np.inf, 3.0]))
    normalised = replace(plain, normalised=True)
    points = rng.normal(size=(2500, 2))
    np.testing.assert_allclose(normalised(points), plain(points) / plain(points).sum(axis=1, keepdims=True), rtol=1e-9)
    far = np.array([[1e3, 0.0], [-1e3, 0.0]])
    assert np.all(plain(far) == 0)
    expected = np.eye(7)[[np.argmax(plain.centres[:, 0]), np.argmin(plain.centres[:, 0])]]
    np.testing.assert_allclose(normalised(far), expected, atol=1e-12)
    assert normalised.rescaled(2.0).normalised


def test_a_constant_feature_has_the_variance_of_the_others_where_lengths_differ():
    rng = np.random.default_rng(1)
    options, source = RadialBasisOptions(8, normalised=True, constant=True), FeatureSource(STATES, TORQUE)

    def walk(length, terminated):
        return Trajectory(rng.normal(size=(length + 1, 2)), np.zeros((length, 1)), np.zeros(length), terminated)

    assert source.of_states([walk(30, False)] * 2, options, rng=rng).constant == 0
    assert source.of_states([walk(30, False), walk(12, False)], options, rng=rng).constant > 0  # cut early
    features = source.of_states([walk(30, False), walk(12, True)], options, rng=rng)
    others = replace(features, constant=0.0)
    columns = features.rescaled(3.0)(walk(30, False).states)
    np.testing.assert_array_equal(columns[:, 8], features.constant)
    np.testing.assert_allclose(features.constant**2, np.mean(np.sum(others(features.centres) ** 2, axis=1)))
    # preferring the longer one each time says of two never seen that the longer is better
    lengths = np.array([5, 20, 40, 60])
    walks = [walk(length, True) for length in lengths]
    sums = trajectory_features(walks, features, discount=1.0)
    utility = infer_utility(sums, [(3, 2), (2, 1), (1, 0)], features=features, discount=1.0)
    longer, shorter = walk(80, False), walk(10, True)
    assert np.mean(utility.trajectory_draws([longer, shorter]) @ [1, -1] > 0) > 0.95


def test_effort_is_the_mean_square_of_an_action_in_shares_of_the_largest():
    rng = np.random.default_rng(1)
    source = FeatureSource(STATES, Box(np.array([-2.0, 0.0, -np.inf]), np.array([1.0, 4.0, np.inf]), dtype=np.float64))
    actions = np.array([[-2.0, 2.0, 3.0], [1.0, 4.0, -3.0]])
    walk = Trajectory(rng.normal(size=(3, 2)), actions, np.zeros(2))
    features = source.of_states([walk], RadialBasisOptions(8, effort=True), rng=rng)
    columns = features.of_steps(walk.states[1:], actions)
    raw = np.array([(1 + 0.25 + 1) / 3, (0.25 + 1 + 1) / 3])
    np.testing.assert_allclose(columns[:, -1] / columns[0, -1], raw / raw[0])
    states = np.mean(np.sum(features(features.centres) ** 2, axis=1))
    np.testing.assert_allclose(np.mean(columns[:, -1] ** 2), EFFORT * states)  # of the prior variance
    np.testing.assert_array_equal(features(walk.states[1:])[:, -1], 0)  # of a state alone
    np.testing.assert_array_equal(columns[:, :-1], features(walk.states[1:])[:, :-1])
    assert not source.of_states([walk], RadialBasisOptions(8), rng=rng).effort
    still = Trajectory(walk.states, np.zeros((2, 3)), np.zeros(2))
    assert not source.of_states([still], RadialBasisOptions(8, effort=True), rng=rng).effort
    discrete = Trajectory(walk.states, np.zeros(2, int), np.zeros(2))
    assert (
        not FeatureSource(STATES, Discrete(2)).of_states([discrete], RadialBasisOptions(8, effort=True), rng=rng).effort
    )


def test_the_traceable_row_equals_the_matrix():
    rng = np.random.default_rng(2)
    points, centres, bandwidths = swinging_states(30, rng), swinging_states(11, rng), np.array([0.7, 0.0])
    with jax.enable_x64(True):
        rows = jax.vmap(lambda x: radial_basis_row(x, centres, bandwidths, np.array(PERIOD)))(points)
    np.testing.assert_allclose(rows, RadialBasis(centres, bandwidths, np.array(PERIOD))(points), rtol=1e-12)


def test_a_constant_dimension_is_left_out():
    rng = np.random.default_rng(3)
    states = np.column_stack([rng.normal(size=200), np.full(200, 7.0)])
    features = draw_state_features(STATES, states, RadialBasisOptions(20), rng=rng)
    assert features.bandwidths[1] == 0.0
    moved = states + np.array([0.0, 1.0])
    np.testing.assert_array_equal(features(states), features(moved))
    assert np.ptp(features(states)) > 0.5


def test_median_rule_is_the_median_over_all_pairs():
    rng = np.random.default_rng(4)
    points = rng.normal(size=(200, 1)) * 3 + 10
    exact = np.sqrt(np.median(np.square(points - points.T)[np.triu_indices(200, 1)]))
    estimate = median_bandwidths(points, factor=0.5, rng=rng, number_of_pairs=200_000)
    np.testing.assert_allclose(estimate, 0.5 * exact, rtol=0.01)


def test_median_rule_wraps_periodic_differences():
    points = np.array([[-np.pi + 0.1], [np.pi - 0.1]])
    wrapped = median_bandwidths(points, period=(2 * np.pi,), rng=np.random.default_rng(0))
    np.testing.assert_allclose(wrapped, 0.2)


def test_median_rule_of_a_mostly_constant_dimension_is_not_zero():
    points = np.zeros((1000, 1))
    points[:50] = 1.0
    assert median_bandwidths(points, rng=np.random.default_rng(0))[0] == pytest.approx(
        np.sqrt(2 * 0.05 * 0.95), rel=0.2
    )


def test_median_rule_finds_a_value_so_rare_that_hardly_a_pair_has_it():
    points = np.zeros((20_000, 2))
    points[[7, 9000]] = (1.0, 2 * np.pi - 0.5)
    exact = np.sqrt(2 * points[:, 0].var(ddof=1)) * np.array([1, 0.5])
    found = [median_bandwidths(points, period=(np.inf, 2 * np.pi), rng=np.random.default_rng(s)) for s in range(8)]
    assert np.all(np.array(found) > 0)
    assert np.any(np.all(np.isclose(found, exact), axis=1))  # no pair had it
    assert not median_bandwidths(np.full((50, 2), 0.1), rng=np.random.default_rng(0)).any()


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_a_dimension_that_is_constant_but_for_rounding_has_no_bandwidth(scale):
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, 500)
    points = scale * np.column_stack([angles, np.cos(angles) ** 2 + np.sin(angles) ** 2])
    assert points[:, 1].std() > 0
    bandwidths = median_bandwidths(points, rng=np.random.default_rng(0))
    assert bandwidths[0] > scale
    assert bandwidths[1] == 0


@pytest.mark.parametrize("normalised", [False, True])
def test_states_beside_a_few_that_are_very_far_keep_their_features(normalised):
    rng = np.random.default_rng(7)
    states = np.column_stack([rng.uniform(0, 10, 300), rng.normal(size=300)])
    states[::10, 0] = 1e10  # what some sensors give for "nothing"
    space = Box(-np.inf, np.inf, (2,))
    features = draw_state_features(space, states, RadialBasisOptions(40, normalised=normalised), rng=rng)
    scaled, centres = states / features.bandwidths, features.centres / features.bandwidths
    exact = np.exp(-0.5 * np.square(scaled[:, None] - centres).sum(axis=2))
    exact /= exact.sum(axis=1, keepdims=True) if normalised else 1
    np.testing.assert_allclose(features(states), exact, atol=1e-6)


def test_sparse_features_of_the_users_are_taken():
    found = checked_features(lambda states: scipy.sparse.csr_array(np.eye(3)[states]), np.array([2, 0]))
    np.testing.assert_array_equal(found, np.eye(3)[[2, 0]])


def test_centres_are_observed_states_without_repetition():
    rng = np.random.default_rng(5)
    states = swinging_states(100, rng)
    features = draw_state_features(STATES, states, RadialBasisOptions(60, period=PERIOD), rng=rng)
    assert len(np.unique(features.centres, axis=0)) == 60
    assert {tuple(c) for c in features.centres} <= {tuple(s) for s in states}
    assert draw_state_features(STATES, states, RadialBasisOptions(700), rng=rng).centres.shape == (100, 2)


def test_the_same_generator_draws_the_same_features():
    states = swinging_states(100, np.random.default_rng(6))
    one, two = (
        draw_state_features(STATES, states, RadialBasisOptions(9), rng=np.random.default_rng(7))(states) for _ in "ab"
    )
    np.testing.assert_array_equal(one, two)


def test_joint_features_are_the_product_of_a_state_and_an_action_kernel():
    rng = np.random.default_rng(8)
    states, actions = swinging_states(300, rng), rng.uniform(-30, 30, (300, 1))
    joint = draw_state_action_features(STATES, TORQUE, states, actions, RadialBasisOptions(25, period=PERIOD), rng=rng)
    assert isinstance(joint, JointRadialBasis)
    # half of the range of 60 is a bandwidth of 30
    action_kernel = np.exp(-0.5 * np.square((actions - joint.action_centres.T) / 30))
    np.testing.assert_allclose(joint(states, actions), joint.states(states) * action_kernel, rtol=1e-11)


def test_joint_features_clip_actions_as_the_environment_does():
    rng = np.random.default_rng(9)
    states, actions = swinging_states(50, rng), 100 * rng.normal(size=(50, 1))
    joint = draw_state_action_features(STATES, TORQUE, states, actions, RadialBasisOptions(10), rng=rng)
    assert np.abs(joint.action_centres).max() <= 30
    np.testing.assert_array_equal(joint(states, actions), joint(states, np.clip(actions, -30, 30)))


def test_joint_features_of_an_unbounded_action_follow_its_observed_spread():
    rng = np.random.default_rng(10)
    states, actions = swinging_states(500, rng), 7 * rng.normal(size=(500, 1))
    joint = draw_state_action_features(
        STATES, Box(-np.inf, np.inf, (1,)), states, actions, RadialBasisOptions(10), rng=rng
    )
    assert joint.action_range[0] == pytest.approx(28, rel=0.1)


@pytest.mark.parametrize(
    ("observation_space", "action_space"),
    [(STATES, TORQUE), (STATES, Discrete(3)), (Discrete(6), Discrete(3))],
)
def test_features_are_dataclasses_of_arrays_and_numbers(observation_space, action_space):
    rng = np.random.default_rng(11)
    discrete = isinstance(observation_space, Discrete)
    states = rng.integers(6, size=40) if discrete else swinging_states(40, rng)
    actions = rng.integers(3, size=40) if isinstance(action_space, Discrete) else rng.normal(size=(40, 1))
    features = draw_state_action_features(
        observation_space, action_space, states, actions, RadialBasisOptions(8), rng=rng
    )
    assert features(states, actions).shape == {"Box": (40, 8)}.get(
        type(action_space).__name__, (40, 18 if discrete else 24)
    )

    def check(value):
        if is_dataclass(value):
            for field in fields(value):
                check(getattr(value, field.name))
        else:
            assert isinstance(value, np.ndarray | int | float | tuple)

    check(features)


def test_many_discrete_actions_have_fewer_functions_each():
    rng = np.random.default_rng(12)
    states = swinging_states(400, rng)
    for number, functions in ((2, 200), (20, 2000), (40, 2000), (250, 2500)):
        actions = rng.integers(number, size=400)
        options = RadialBasisOptions(100)
        features = draw_state_action_features(STATES, Discrete(number), states, actions, options, rng=rng)
        assert features(states[:5], actions[:5]).shape == (5, functions)
    tables = draw_state_action_features(Discrete(30), Discrete(150), actions, actions, RadialBasisOptions(8), rng=rng)
    assert tables.state_features.number_of_states == 30


def test_features_of_more_states_than_a_block_are_those_of_each():
    rng = np.random.default_rng(12)
    states = swinging_states(3 * ROWS_AT_A_TIME + 7, rng)
    features = draw_state_features(STATES, states, RadialBasisOptions(70, period=PERIOD), rng=rng)
    found = features(states)
    for row in (0, ROWS_AT_A_TIME - 1, ROWS_AT_A_TIME, 3 * ROWS_AT_A_TIME, len(states) - 1):
        np.testing.assert_allclose(found[row], features(states[row : row + 1])[0], rtol=1e-12)


@pytest.mark.parametrize(
    ("features", "message"),
    [
        (lambda s: s[:, 0], r"<lambda>: expected shape \(5, D\), got \(5,\)"),
        (lambda s: s[:3], r"expected shape \(5, D\), got \(3, 2\)"),
        (lambda s: s / np.where(np.arange(5) == 3, np.nan, 1.0)[:, None], "NaN or infinity for state"),
        (lambda s: s.astype(str), "expected real numbers"),
        (lambda s: s[:, :0], r"got \(5, 0\)"),
    ],
)
def test_bad_user_features_are_named(features, message):
    with pytest.raises(ValueError, match=message):
        checked_features(features, np.ones((5, 2)))


def test_good_user_features_pass_as_float64():
    values = checked_features(lambda s: s > 0, np.array([[1.0], [-1.0]]))
    assert values.dtype == np.float64
    np.testing.assert_array_equal(values, [[1], [0]])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda r: OneHot(3)(np.array([3])), "expected numbers in 0 … 2"),
        (lambda r: OneHot(3)(np.array([0.5])), "expected integers"),
        (lambda r: draw_state_features(STATES, np.ones((4, 3)), RadialBasisOptions(2), rng=r), r"shape \(N, 2\)"),
        (lambda r: draw_state_features(STATES, np.full((4, 2), np.nan), RadialBasisOptions(2), rng=r), "NaN"),
        (lambda r: draw_state_features(STATES, np.ones((0, 2)), RadialBasisOptions(2), rng=r), "states: .* got none"),
        (lambda r: RadialBasisOptions(0), "centres: expected a whole number >= 1, got 0"),
        (lambda r: RadialBasisOptions(3, bandwidth_factor=0.0), "bandwidth_factor: expected a positive .* got 0.0"),
        (
            lambda r: draw_state_action_features(
                STATES, TORQUE, np.ones((4, 2)), np.ones((4, 1)), RadialBasisOptions(2, normalised=True), rng=r
            ),
            "normalised: expected False",
        ),
        (
            lambda r: draw_state_features(Box(0, 1, (2, 2)), np.ones((4, 2)), RadialBasisOptions(1), rng=r),
            "Box of shape",
        ),
        (lambda r: median_bandwidths(np.ones((4, 2)), factor=0.0, rng=r), "factor"),
        (lambda r: median_bandwidths(np.ones((4, 2)), period=(1.0,), rng=r), "period: expected 2"),
        (lambda r: median_bandwidths(np.ones((4, 1)), period=(-1.0,), rng=r), "period: expected 1"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(np.random.default_rng(0))


@pytest.mark.parametrize(
    ("normalised", "constant", "effort"),
    [(False, 0.0, ()), (True, 0.0, ()), (True, 0.3, ()), (True, 0.0, (0.2,)), (True, 0.3, (0.2,))],
)
@pytest.mark.parametrize("dimensions", [1, 3, 5])
def test_all_multiples_of_the_bandwidths_at_once_are_each_alone(normalised, constant, effort, dimensions):
    rng = np.random.default_rng(dimensions)
    period, bandwidths = np.full(dimensions, np.inf), rng.uniform(0.3, 2.0, dimensions)
    period[dimensions // 2], bandwidths[-1] = 2.0, 0.0  # one dimension is a circle, one is left out
    bandwidths[0] = 0.7
    features = RadialBasis(rng.normal(size=(20, dimensions)), bandwidths, period, normalised, constant, effort)
    states = rng.normal(size=(300, dimensions))
    states[:2] *= 1e4  # far from all centres, where every exponential is zero
    multiples = bandwidth_multiples(features, inferred=True, rng=rng)
    number_of_features = 20 + (constant > 0) + len(effort)
    weights = [rng.normal(size=(number_of_features, 1 + number % 3)) for number in range(len(multiples))]
    actions = rng.normal(size=(299, 1))
    values = values_under(features, multiples, states, weights)
    of_steps = values_under(features, multiples, states[1:], weights, actions=actions)
    path = Trajectory(states, actions, np.zeros(299), False)
    sums = sums_under(features, multiples, [path, path], discount=0.9)
    for row, columns, value, of_step, total in zip(multiples, weights, values, of_steps, sums, strict=True):
        alone = features.rescaled(row)
        np.testing.assert_allclose(value, alone(states) @ columns, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(of_step, alone.of_steps(states[1:], actions) @ columns, rtol=1e-9, atol=1e-11)
        (single,) = values_under(features, row[None], states[1:], [columns], actions=actions)
        np.testing.assert_allclose(single, of_step, rtol=1e-9, atol=1e-11)
        expected = trajectory_features([path, path], alone, discount=0.9)
        np.testing.assert_allclose(total, expected, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("dimensions", [1, 3, 5, 8])
def test_effort_counts_in_half_of_the_settings_whatever_the_length_scales(dimensions):
    unlike = RadialBasis(np.zeros((3, dimensions)), np.ones(dimensions), np.full(dimensions, np.inf))
    features = replace(unlike, effort=(0.2, 0.3))
    without, multiples = (
        bandwidth_multiples(each, inferred=True, rng=np.random.default_rng(0)) for each in (unlike, features)
    )
    counts = features.effort_multiples(multiples)
    for row in (0.0, 1.0):
        np.testing.assert_array_equal(multiples[counts == row, :-1], without)
    given = bandwidth_multiples(features, inferred=False, rng=np.random.default_rng(0))
    np.testing.assert_array_equal(given, np.ones((1, dimensions + 1)))
    assert features.rescaled(multiples[0]).efforts([[1.0, 2.0]]) == 0.0
    assert features.rescaled(multiples[1]).efforts([[1.0, 2.0]]) == pytest.approx(1.4)
    # an estimate of an earlier version says nothing of the effort, which then counts
    np.testing.assert_array_equal(features.effort_multiples(without), np.ones(len(without)))
    assert features.rescaled(without[0]).effort == features.rescaled(3.0).effort == (0.2, 0.3)


def test_values_and_sums_are_the_same_to_the_last_bit_in_any_number_of_threads(monkeypatch):
    rng = np.random.default_rng(6)
    features = RadialBasis(rng.normal(size=(100, 2)), np.ones(2), np.full(2, np.inf), True, 0.1)
    multiples = bandwidth_multiples(features, inferred=True, rng=rng)
    paths = [Trajectory(rng.normal(size=(n, 2)), np.zeros((n - 1, 1)), np.zeros(n - 1), False) for n in (2, 300, 700)]
    weights = [rng.normal(size=(101, 2)) for _ in multiples]
    found = []
    for threads in (1, 3):
        monkeypatch.setattr("bayespbrl.models.threads.most_threads", lambda threads=threads: threads)
        values = values_under(features, multiples, paths[2].states, weights)
        found.append([*values, *sums_under(features, multiples, paths, discount=0.9)])
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(("dimensions", "alone"), [(8, 16), (12, 24), (17, 24), (40, 24)])
def test_in_many_dimensions_the_settings_of_the_prior_are_as_many_and_let_one_matter_alone(dimensions, alone):
    features = RadialBasis(np.zeros((3, dimensions)), np.ones(dimensions), np.full(dimensions, np.inf))
    multiples = bandwidth_multiples(features, inferred=True, rng=np.random.default_rng(0))
    assert len(multiples) == len(np.unique(multiples, axis=0)) == 27
    assert {tuple(row) for row in multiples} >= {(multiple,) * dimensions for multiple in (1.0, 3.0, 9.0)}
    mattering = np.sum(multiples < 9.0, axis=1)
    assert np.sum(mattering == 1) == alone
    if dimensions <= 24:  # each dimension in some setting
        assert np.all(np.any(multiples[mattering == 1] < 9.0, axis=0))


@pytest.mark.parametrize(
    ("features", "message"),
    [
        (lambda s: np.ma.masked_array(s, s > 0.5), "features <lambda>: expected numbers, got masked entries"),
        (lambda s: [[1.0]] + [[1.0, 2.0]] * 4, "features <lambda>: expected rows of numbers, all equally long, got"),
    ],
)
def test_masked_entries_and_rows_of_different_lengths_are_named(features, message):
    with pytest.raises(ValueError, match=message):
        checked_features(features, np.ones((5, 2)))


@pytest.mark.parametrize("actions", [[1], [0, 1, 2], np.zeros(2), [0, 3]])
def test_each_state_has_an_action_of_those_there_are(actions):
    with pytest.raises(ValueError, match=r"^actions: expected"):
        StateActionProduct(OneHot(2), 3)(np.array([0, 1]), actions)


def test_features_of_the_users_own_are_divided_by_their_ranges():
    def features(states):
        return np.column_stack([states[:, 0], 5 + 2 * states[:, 0], np.full(len(states), -3.0), 0 * states[:, 0]])

    states = np.array([[-1.0], [0.0], [3.0]])
    own = OwnFeatures.in_any_units(features, states, of_equal_lengths=True)
    assert own.units == (4, 8, 3, 1)
    np.testing.assert_array_equal(own(states), features(states) / [4, 8, 3, 1])
    np.testing.assert_array_equal(OwnFeatures(features)(states), features(states))
    assert OwnFeatures.in_any_units(features, states, of_equal_lengths=False).units == (3, 11, 3, 1)
    corners = np.eye(5)[[0, 1, 4, 0, 0]]
    for alike in (True, False):
        cells = OwnFeatures.in_any_units(lambda s: corners[s], np.arange(5), of_equal_lengths=alike)
        np.testing.assert_array_equal(cells(np.arange(5)), corners)
    with pytest.raises(ValueError, match="features: expected 4 for each state, as before, got 1"):
        OwnFeatures(lambda s: s, own.units)(states)
    with pytest.raises(ValueError, match="features: ranges: expected finite entries"):
        OwnFeatures.in_any_units(lambda s: s, np.array([[-1.7e308], [1.7e308]]), of_equal_lengths=True)


def test_features_of_the_users_own_are_divided_by_ranges_where_lengths_are_equal_however_trajectories_end():
    source = FeatureSource(STATES, TORQUE, own=lambda states: 290 + 10 * states)
    for lengths, units in (((2, 2), (10, 10)), ((2, 3), (300, 300))):
        walks = [
            Trajectory(np.linspace([0, 0], [1, 1], length + 1), np.zeros((length, 1)), np.zeros(length), ended)
            for length, ended in zip(lengths, (True, False), strict=True)
        ]
        assert source.of_states(walks, RadialBasisOptions(8), rng=np.random.default_rng(0)).units == units


@pytest.mark.parametrize("equal", [True, False])
@pytest.mark.parametrize("change", [1e-7, 1e-3, 0.1])
def test_a_feature_of_the_users_own_that_hardly_changes_does_no_harm(change, equal):
    """As the square of a cosine and of a sine in single precision together, or a height that has settled."""
    rng = np.random.default_rng(0)
    lengths = np.full(60, 100) if equal else rng.integers(50, 200, 60)
    walks = [rng.normal(rng.normal(0, 0.3), 1, (length + 1, 2)) for length in lengths]
    trajectories = [Trajectory(walk, np.zeros((len(walk) - 1, 1)), np.zeros(len(walk) - 1)) for walk in walks]
    returns = np.array([walk[1:, 0].sum() for walk in walks])

    def features(states):
        return np.column_stack([1000 * states[:, 0], 1 + change * np.tanh(states[:, 1])])

    source = FeatureSource(Box(-9, 9, (2,)), Box(-1, 1, (1,)), own=features)
    own = source.of_states(trajectories, RadialBasisOptions(10), rng=rng)
    sums = trajectory_features(trajectories, own, discount=1.0)
    pairs = [(i, j) if returns[i] > returns[j] else (j, i) for i, j in zip(range(12), range(12, 24), strict=True)]
    utility = infer_utility(sums, pairs)
    assert np.corrcoef(utility.utilities(sums[24:]), returns[24:])[0, 1] > 0.9
