import jax
import numpy as np
import pytest
from scipy import integrate

from bayespbrl.models import PreferenceModel
from bayespbrl.models.expectation_propagation import expectation_propagation, same_margins, tilted_moments
from bayespbrl.models.likelihoods import (
    Logistic,
    Mixed,
    Probit,
    WithLapses,
    WithTies,
    log_prob,
)
from bayespbrl.utility import infer_utility

LIKELIHOODS = [Mixed(5.0, 3.0), Mixed(200.0, 41.0), Mixed(0.01, 2.0), Logistic(3.0), WithLapses(Mixed(5.0, 3.0), 0.2)]


@pytest.mark.parametrize("likelihood", LIKELIHOODS)
@pytest.mark.parametrize(("mean", "deviation"), [(0.4, 1.0), (-2.0, 0.7), (0.3, 0.001), (30.0, 20.0)])
def test_tilted_moments_agree_with_quadrature_at_any_steepness(likelihood, mean, deviation):
    def density(t):
        with jax.enable_x64(True):
            p = np.exp(np.asarray(log_prob(likelihood, t)))
        return p * np.exp(-0.5 * ((t - mean) / deviation) ** 2) / np.sqrt(2 * np.pi) / deviation

    # panels that end at the jump and shrink towards it
    near = np.geomspace(1e-7, 1, 60) * (abs(mean) + 12 * deviation)
    edges = np.unique(np.concatenate([-near, [0.0], near, mean + deviation * np.linspace(-12, 12, 97)]))
    nodes, weights = np.polynomial.legendre.leggauss(12)
    t = (edges[:-1, None] + edges[1:, None]) / 2 + np.diff(edges)[:, None] / 2 * nodes
    values = density(t.ravel()) * (np.diff(edges)[:, None] / 2 * weights).ravel()
    t = t.ravel()
    total = values.sum()
    first = values @ t / total
    second = values @ (t - first) ** 2 / total
    log_z, tilted_mean, variance = tilted_moments(
        np.array([mean]), np.array([deviation**2]), likelihood.probit_mixture()
    )
    np.testing.assert_allclose(log_z, np.log(total), atol=1e-9)
    np.testing.assert_allclose(tilted_mean, first, atol=1e-8 * deviation)
    np.testing.assert_allclose(variance, second, rtol=1e-6)


@pytest.mark.parametrize("mean", [-36.0, -40.0, -1000.0])
def test_of_an_answer_that_only_a_lapse_explains_the_probability_is_that_of_a_lapse(mean):
    mixture = WithLapses(Probit(1e9), 0.2).probit_mixture()
    log_z, tilted_mean, variance = tilted_moments(np.array([mean]), np.ones(1), mixture)
    np.testing.assert_allclose([log_z[0], tilted_mean[0], variance[0]], [np.log(0.1), mean, 1.0], rtol=1e-6)


def test_two_items_that_hardly_differ_may_be_ordered_and_others_tied():
    items = [[0, 0], [1, 0], [0, 1], [1.004, 0.003]]
    estimate = infer_utility(items, [(1, 0), (3, 1)], ties=[(2, 0)], likelihood="probit", steepness=100.0)
    utilities = estimate.utilities(np.array(items))
    assert np.all(np.isfinite(utilities))
    assert utilities[1] > utilities[0]


@pytest.mark.parametrize("likelihood", LIKELIHOODS)
def test_one_answer_is_exact(likelihood):
    loadings = np.array([[0.8]])
    fit = expectation_propagation(loadings, likelihood.probit_mixture(), prior_scale=2.0)
    log_z, mean, variance = tilted_moments(np.zeros(1), np.array([1.6**2]), likelihood.probit_mixture())
    assert fit.converged
    np.testing.assert_allclose(fit.log_evidence, log_z[0], atol=1e-10)
    np.testing.assert_allclose(fit.mean * 0.8, mean, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(fit.covariance[0] * 0.64, variance, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("likelihood", "tolerance"), [(Mixed(5.0, 3.0), 0.2), (Probit(2.0), 0.02), (Logistic(5.0), 0.05)]
)
def test_evidence_and_mean_agree_with_quadrature_for_three_answers(likelihood, tolerance):
    loadings = np.array([[1.0, 0.3], [0.5, -1.0], [-0.2, 0.4]])
    grid = np.linspace(-6, 6, 1201)
    z = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)
    with jax.enable_x64(True):
        log_joint = np.asarray(log_prob(likelihood, z @ loadings.T)).sum(axis=1) - 0.5 * np.sum(z**2, axis=1)
    weights = np.exp(log_joint) / (2 * np.pi) * (grid[1] - grid[0]) ** 2
    fit = expectation_propagation(loadings, likelihood.probit_mixture(), prior_scale=1.0)
    assert fit.converged
    assert abs(fit.log_evidence - np.log(weights.sum())) < tolerance
    np.testing.assert_allclose(fit.mean, weights @ z / weights.sum(), atol=tolerance)


def test_contradictory_answers_leave_a_proper_gaussian():
    loadings = np.array([[1.0], [-1.0], [1.0], [-1.0]]) * 3
    for likelihood in LIKELIHOODS:
        fit = expectation_propagation(loadings, likelihood.probit_mixture(), prior_scale=1.0)
        assert np.all(np.linalg.eigvalsh(fit.covariance) > 0)
        np.testing.assert_allclose(fit.mean, 0, atol=1e-6)


def test_answers_that_contradict_each_other_about_nearly_the_same_margin_do_not_run_away():
    # 8 for and 5 against, beside one about another: the steps alone, which have no scale, decide
    loadings = np.array([[1.0, 0.0, 0.0]] * 8 + [[-1.0, 0.0, 0.0]] * 5 + [[0.3, 0.9, 0.1]])
    loadings[:13, 1:] += 1e-4 * np.random.default_rng(0).normal(size=(13, 2))
    fit = expectation_propagation(loadings, Mixed(5.0, 14.0).probit_mixture(), prior_scale=1.0)
    assert not fit.converged  # not every answer has a part in it
    assert np.any(fit.site_precisions[:13] == 0)
    assert fit.site_precisions[13] > 0
    assert np.all(np.linalg.eigvalsh(fit.covariance) > 1e-6)


@pytest.mark.parametrize(("first", "second"), [(12, 4), (6, 2), (2, 1), (20, 0)])
@pytest.mark.parametrize(("steepness", "lapse_rate"), [(5.0, 0.0), (1.0, 0.0), (5.0, 0.1)])
def test_answers_about_one_margin_are_one_factor_and_so_exact(first, second, steepness, lapse_rate):
    ratios = np.where(np.arange(first + second) % 3, 1.0, 0.2) * np.repeat([1.0, -1.0], [first, second])
    likelihood = PreferenceModel(steepness=steepness, lapse_rate=lapse_rate).answer_likelihood(len(ratios))
    loadings = ratios[:, None] * [0.6, 0.8]
    fit = expectation_propagation(loadings, likelihood.probit_mixture(), prior_scale=1.0)
    t = np.linspace(-8, 8, 200_000)  # none at the step, where it is one half
    log_density = sum(np.log(_probability(likelihood, ratio * t)) for ratio in ratios) - 0.5 * t**2
    density = np.exp(log_density) / np.sqrt(2 * np.pi)
    exact = integrate.trapezoid(density, t)
    mean = integrate.trapezoid(t * density, t) / exact
    variance = integrate.trapezoid((t - mean) ** 2 * density, t) / exact
    assert fit.converged
    assert abs(fit.log_evidence - np.log(exact)) < 1e-6
    np.testing.assert_allclose(fit.mean, mean * np.array([0.6, 0.8]), atol=1e-6)
    np.testing.assert_allclose(np.linalg.eigvalsh(fit.covariance), [variance, 1.0], atol=1e-6)
    assert np.count_nonzero(fit.site_precisions) == 1


def test_ties_and_orders_about_one_margin_are_one_factor():
    likelihood = WithTies(Logistic(5.0), 0.2, np.array([True, False, False, False]))
    ratios = np.array([1.0, -2.0, 1.0, 1.0])
    fit = expectation_propagation(ratios[:, None], likelihood.probit_mixture(), prior_scale=1.0)
    p = lambda x: 1 / (1 + np.exp(-5 * x))  # noqa: E731
    t = np.linspace(-8, 8, 200_001)
    density = (p(t + 0.2) - p(t - 0.2)) * p(-2 * t - 0.2) * p(t - 0.2) ** 2 * np.exp(-0.5 * t**2) / np.sqrt(2 * np.pi)
    exact = integrate.trapezoid(density, t)
    np.testing.assert_allclose(fit.log_evidence, np.log(exact), atol=1e-6)
    np.testing.assert_allclose(fit.mean, integrate.trapezoid(t * density, t) / exact, atol=1e-6)


@pytest.mark.parametrize("steepness", [1e3, 1e6, 1e9, 1e12])
def test_answers_about_one_margin_are_one_factor_at_any_steepness(steepness):
    likelihood = Logistic(steepness)
    fit = expectation_propagation(np.array([[1.0]] * 3 + [[-1.0]] * 2), likelihood.probit_mixture(), prior_scale=1.0)
    t = np.linspace(-60, 60, 400_001) / steepness  # beyond, two answers at least are all but impossible
    p = 1 / (1 + np.exp(-steepness * t))
    exact = integrate.trapezoid(p**3 * (1 - p) ** 2 * np.exp(-0.5 * t**2) / np.sqrt(2 * np.pi), t)
    assert fit.converged
    np.testing.assert_allclose(fit.log_evidence, np.log(exact), atol=1e-3)


def _probability(likelihood, margins):
    with jax.enable_x64(True):
        return np.exp(np.asarray(log_prob(likelihood, margins)))


def test_no_answers_leave_the_prior():
    fit = expectation_propagation(np.zeros((0, 2)), Mixed(5.0, 1.0).probit_mixture(), prior_scale=3.0)
    np.testing.assert_allclose(fit.covariance, 9 * np.eye(2))
    assert fit.log_evidence == 0
    assert fit.converged


def test_a_tie_pulls_the_margin_to_zero():
    likelihood = WithTies(Logistic(20.0), 0.1, np.array([True]))
    fit = expectation_propagation(np.ones((1, 1)), likelihood.probit_mixture(), prior_scale=1.0)
    expected, _ = integrate.quad(
        lambda t: np.exp(-0.5 * t**2) / np.sqrt(2 * np.pi) * _tie(20.0, 0.1, t), -8, 8, points=[-0.1, 0.1]
    )
    np.testing.assert_allclose(fit.log_evidence, np.log(expected), atol=1e-8)
    np.testing.assert_allclose(fit.mean, 0, atol=1e-9)
    assert fit.covariance[0, 0] < 0.05


@pytest.mark.parametrize("steepness", [0.5, 5.0, 20.0])
def test_a_tie_far_from_zero_has_finite_moments_that_mirror_each_other(steepness):
    tie = WithTies(Mixed(steepness, 5.0), 0.1, np.array([True])).probit_mixture()
    for mean in (0.3, 1.0, 3.0, 10.0, 100.0, 1000.0):
        above, below = (tilted_moments(np.array([sign * mean]), np.array([0.01]), tie) for sign in (1, -1))
        np.testing.assert_allclose(above[0], below[0], rtol=1e-6)
        np.testing.assert_allclose(above[1], -below[1], rtol=1e-6)
        np.testing.assert_allclose(above[2], below[2], rtol=1e-6)
        assert 0 <= above[1][0] <= mean + 1e-9
        assert 0 < above[2][0] < 0.02


def test_parallel_rows_are_one_group_and_a_row_of_zeros_is_its_own():
    groups = same_margins(np.array([[1.0, 2.0], [0.0, 0.0], [-2.0, -4.0], [2.0, -1.0], [0.0, 0.0]]))
    assert [(rows.tolist(), ratios.tolist()) for rows, ratios in groups] == [
        ([0, 2], [1.0, -2.0]),
        ([1], [0.0]),
        ([3], [1.0]),
        ([4], [0.0]),
    ]


def _tie(steepness, threshold, t):
    return 1 / (1 + np.exp(-steepness * (t + threshold))) - 1 / (1 + np.exp(-steepness * (t - threshold)))
