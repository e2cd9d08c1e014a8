import numpy as np
import pytest
from arviz_stats.base import array_stats

from bayespbrl.models.convergence import ONE_BY_ONE, chain_convergence


def test_independent_draws_are_worth_themselves():
    report = chain_convergence(np.random.default_rng(0).standard_normal((4, 1000, 3)))
    assert report.converged()
    np.testing.assert_allclose(report.effective_sample_size, 4000, rtol=0.1)
    np.testing.assert_allclose(report.monte_carlo_error, 1 / np.sqrt(4000), rtol=0.1)


def test_an_autoregressive_chain_is_worth_its_known_share():
    # x' = ρx + noise is worth (1 − ρ)/(1 + ρ) of its draws
    rng, rho = np.random.default_rng(1), 0.8
    draws = np.zeros((4, 5000))
    draws[:, 0] = rng.standard_normal(4)
    for i in range(1, 5000):
        draws[:, i] = rho * draws[:, i - 1] + np.sqrt(1 - rho**2) * rng.standard_normal(4)
    assert chain_convergence(draws).effective_sample_size_min == pytest.approx(20_000 * 0.2 / 1.8, rel=0.15)


def test_chains_in_different_places_have_not_converged():
    draws = np.random.default_rng(0).standard_normal((4, 500, 2))
    draws[0, :, 1] += 3
    report = chain_convergence(draws)
    assert report.rhat[0] < 1.01 < 1.2 < report.rhat[1]
    assert not report.converged()


def test_a_constant_needs_no_draws_and_nan_meets_no_limit():
    draws = np.random.default_rng(0).standard_normal((2, 2000, 2))
    draws[..., 1] = 0.0
    assert chain_convergence(draws).converged()
    draws[0, 7, 1] = np.nan
    assert not chain_convergence(draws).converged()


def test_nothing_to_estimate_has_converged():
    assert chain_convergence(np.zeros((4, 100, 0))).converged()


def test_too_few_draws_are_named():
    with pytest.raises(ValueError, match="draws: expected shape"):
        chain_convergence(np.zeros(5))


def test_the_numbers_of_many_quantities_at_once_are_those_of_arviz():
    rng, number = np.random.default_rng(3), ONE_BY_ONE + 1
    for chains, length in ((4, 250), (2, 25), (3, 7)):
        draws, keep = np.zeros((chains, length, number)), rng.uniform(-0.9, 0.99, number)
        for step in range(1, length):
            draws[:, step] = keep * draws[:, step - 1] + rng.standard_normal((chains, number))
        draws[..., -4:] = np.round(draws[..., -4:])  # ties
        halves = np.arange(chains * length) % 2  # two values, as many of each where the number is even
        draws[..., -5] = rng.permutation(halves).reshape(chains, length)
        report, axes = chain_convergence(draws), {"chain_axis": 0, "draw_axis": 1}
        with np.errstate(invalid="ignore"):
            rhat = array_stats.rhat(draws, **axes)
        np.testing.assert_allclose(report.rhat, rhat, rtol=1e-10)
        bulk = array_stats.ess(draws, method="bulk", **axes)
        np.testing.assert_allclose(report.effective_sample_size, bulk, rtol=1e-10)
        error = array_stats.mcse(draws, method="mean", **axes)
        np.testing.assert_allclose(report.monte_carlo_error, error, rtol=1e-10)
