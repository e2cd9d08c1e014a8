from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse

from bayespbrl.improvement.lstd import solve_lstd, transition_sums

NO_PENALTY = {"fixed_point_ridge": 0.0, "projection_ridge": 0.0}


def lstd(features, following, utilities, **options):
    return solve_lstd(transition_sums(features, following, utilities), **options)


def chain_features(length):
    """A chain 0 → 1 → … → length − 1, whose last state loops; one-hot features."""
    states = np.arange(length)
    return np.eye(length)[states], np.eye(length)[np.minimum(states + 1, length - 1)]


def test_lstd_on_a_chain_solves_the_bellman_equation():
    features, following = chain_features(6)
    rewards = np.array([0.5, -1.0, 2.0, 0.0, 3.0, 1.0])
    expected = np.linalg.solve(np.eye(6) - 0.9 * following, rewards)  # (I − γP)⁻¹ r
    np.testing.assert_allclose(lstd(features, following, rewards, discount=0.9, **NO_PENALTY), expected, atol=1e-9)


def test_a_terminal_successor_is_worth_nothing():
    features = np.eye(2)
    following = np.array([[0.0, 1.0], [0.0, 0.0]])
    weights = lstd(features, following, np.array([1.0, 4.0]), discount=0.5, **NO_PENALTY)
    np.testing.assert_allclose(weights, [3.0, 4.0])


def test_discount_zero_is_ridge_regression_on_the_projected_target():
    rng = np.random.default_rng(3)
    features, utilities = rng.normal(size=(40, 5)), rng.normal(size=40)
    following = rng.normal(size=(40, 5))
    gram = features.T @ features
    projected = features @ np.linalg.solve(gram + 0.7 * np.eye(5), features.T @ utilities)
    expected = np.linalg.solve(gram + 0.3 * np.eye(5), features.T @ projected)
    weights = lstd(features, following, utilities, discount=0.0, fixed_point_ridge=0.3, projection_ridge=0.7)
    np.testing.assert_allclose(weights, expected, atol=1e-12)


def test_penalised_weights_equal_the_formula_with_the_projection_written_out():
    rng = np.random.default_rng(4)
    features, following = rng.normal(size=(30, 4)), rng.normal(size=(30, 4))
    utilities = rng.normal(size=30)
    projection = np.linalg.solve(features.T @ features + 0.2 * np.eye(4), features.T)  # Σ, (4, 30)
    design = features - 0.8 * features @ projection @ following
    target = features @ projection @ utilities
    expected = np.linalg.solve(design.T @ design + 0.1 * np.eye(4), design.T @ target)
    weights = lstd(features, following, utilities, discount=0.8, fixed_point_ridge=0.1, projection_ridge=0.2)
    np.testing.assert_allclose(weights, expected, atol=1e-10)


def test_the_sums_of_two_blocks_are_those_of_all_transitions():
    rng = np.random.default_rng(6)
    features, following = rng.normal(size=(30, 4)), rng.normal(size=(30, 4))
    utilities = rng.normal(size=(30, 2))
    options = {"discount": 0.8, "fixed_point_ridge": 0.1, "projection_ridge": 0.2}
    first, second = (
        transition_sums(features[rows], following[rows], utilities[rows]) for rows in (slice(11), slice(11, None))
    )
    expected = lstd(features, following, utilities, **options)
    np.testing.assert_allclose(solve_lstd(first + second, **options), expected, atol=1e-12)
    assert np.abs(solve_lstd(first, **options) - expected).max() > 1e-3


@pytest.mark.parametrize("kind", [bool, np.uint8, np.int8])
def test_features_of_few_bits_are_summed_as_numbers(kind):
    rng = np.random.default_rng(0)
    features, following = rng.integers(0, 2, (2, 600, 3)).astype(kind)
    utilities, options = rng.normal(size=600), {"discount": 0.8, "fixed_point_ridge": 0.1, "projection_ridge": 0.1}
    expected = lstd(features.astype(float), following.astype(float), utilities, **options)
    np.testing.assert_array_equal(lstd(features, following, utilities, **options), expected)


def test_features_that_never_occur_get_weight_zero():
    features, following = chain_features(3)
    padded = [np.column_stack([block, np.zeros(3)]) for block in (features, following)]
    weights = lstd(*padded, np.ones(3), discount=0.5, **NO_PENALTY)
    np.testing.assert_allclose(weights, [2.0, 2.0, 2.0, 0.0], atol=1e-9)


@pytest.mark.parametrize("unseen", [0, 2])  # features that never occur make the Gram matrix singular
def test_utilities_side_by_side_give_the_weights_of_each_alone(unseen):
    rng = np.random.default_rng(5)
    features, following = (np.pad(rng.normal(size=(30, 4)), [(0, 0), (0, unseen)]) for _ in range(2))
    utilities = rng.normal(size=(30, 3))
    options = {"discount": 0.8, "fixed_point_ridge": 0.0, "projection_ridge": 0.0}
    together = lstd(features, following, utilities, **options)
    alone = [lstd(features, following, column, **options) for column in utilities.T]
    assert together.shape == (4 + unseen, 3)
    np.testing.assert_allclose(together, np.column_stack(alone), atol=1e-10)
    mixture = np.array([0.5, -2.0, 1.0])
    np.testing.assert_allclose(
        together @ mixture, lstd(features, following, utilities @ mixture, **options), atol=1e-10
    )


def test_the_weights_of_one_hot_utilities_on_a_chain_are_the_discounted_visits_to_come():
    features, following = chain_features(5)
    visits = lstd(features, following, np.eye(5), discount=0.9, **NO_PENALTY)
    np.testing.assert_allclose(visits, np.linalg.inv(np.eye(5) - 0.9 * following), atol=1e-9)  # (I − γP)⁻¹


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"discount": 1.0}, "discount"),
        ({"projection_ridge": -1.0}, "ridge"),
        ({"utilities": np.ones(4)}, "utilities"),
        ({"utilities": np.ones((4, 2))}, r"utilities \(N,\) or \(N, n\), got .* and \(4, 2\)"),
        ({"utilities": np.ones((3, 2, 2))}, "utilities"),
        ({"utilities": np.full((3, 2), np.nan)}, "finite"),
        ({"utilities": np.array([1.0, np.nan, 0.0])}, "finite"),
    ],
)
def test_bad_input_is_named(changes, message):
    features, following = chain_features(3)
    arguments = {"utilities": np.ones(3), "discount": 0.5, **NO_PENALTY} | changes
    with pytest.raises(ValueError, match=message):
        lstd(features, following, **arguments)


@pytest.mark.slow
def test_the_sparse_sums_of_a_large_table_have_the_weights_of_the_dense_ones():
    rng = np.random.default_rng(1)
    pairs, tried = 1200, 900  # the other pairs are never tried, but their values are those of next states
    rows, successors = rng.integers(tried, size=3000), rng.integers(pairs, size=(3000, 2))
    features, following = np.zeros((3000, pairs + 1)), np.zeros((3000, pairs + 1))
    features[np.arange(3000), rows] = 1.0
    for column, chance in zip(successors.T, (0.7, 0.3), strict=True):
        following[np.arange(3000), column] += chance
    features[:, -1] = following[:, -1] = 1.0  # the bias
    following[rng.random(3000) < 0.01] = 0.0
    utilities = np.column_stack([rng.normal(size=pairs)[rows], rng.normal(size=3000)])
    sums = transition_sums(features, following, utilities)
    assert scipy.sparse.issparse(sums.gram)
    dense = replace(sums, gram=features.T @ features, cross=features.T @ following)
    np.testing.assert_allclose(sums.gram.toarray(), dense.gram)
    options = {"discount": 0.98, "fixed_point_ridge": 1e-3, "projection_ridge": 1e-3}
    expected = solve_lstd(dense, **options)
    np.testing.assert_allclose(solve_lstd(sums, **options), expected, atol=1e-6 * np.abs(expected).max())
    halves = [
        transition_sums(features[part], following[part], utilities[part]) for part in (slice(1500), slice(1500, None))
    ]
    np.testing.assert_allclose(solve_lstd(halves[0] + halves[1], **options), solve_lstd(sums, **options), atol=1e-7)
    mixed = halves[0] + transition_sums(np.eye(5, pairs + 1), np.eye(5, pairs + 1), np.ones((5, 2)))
    together = halves[0].gram.toarray() + np.diag(np.arange(pairs + 1) < 5)
    np.testing.assert_allclose(mixed.gram.toarray() if scipy.sparse.issparse(mixed.gram) else mixed.gram, together)
    for ridge in (0.0, 1e-20):  # too small for the sparse solution
        barely = {"discount": 0.98, "fixed_point_ridge": ridge, "projection_ridge": 1e-3}
        np.testing.assert_allclose(solve_lstd(sums, **barely), solve_lstd(dense, **barely), rtol=1e-9)


@pytest.mark.parametrize("filled", [1.0, 0.015])  # of the second the sums are not sparse
def test_wide_features_whose_sums_are_not_sparse_are_summed_as_they_are(filled):
    rng = np.random.default_rng(2)
    features = rng.normal(size=(800, 1000)) * (rng.random((800, 1000)) < filled)
    sums = transition_sums(features, features, np.ones(800))
    np.testing.assert_array_equal(sums.gram, features.T @ features)


def test_sums_that_are_singular_are_solved_as_dense_ones():
    features = np.zeros((1, 1000))
    sums = transition_sums(features, features, np.ones(1))
    assert scipy.sparse.issparse(sums.gram)
    np.testing.assert_array_equal(
        solve_lstd(sums, discount=0.0, fixed_point_ridge=1e-320, projection_ridge=1e-320), 0.0
    )
