from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from numpyro.infer import MCMC
from scipy import stats
from scipy.special import logsumexp

from bayespbrl.models import (
    EllipticalSlice,
    PreferenceModel,
    fit_gaussian,
    posterior,
    restored,
    sample_posterior,
    stored,
)
from bayespbrl.models.chains import CHUNK, KERNEL, Chains, _ellipses, draw_chunk
from bayespbrl.models.convergence import Convergence, chain_convergence
from bayespbrl.models.evidence import _bridged
from bayespbrl.models.gibbs import conditional
from bayespbrl.models.likelihoods import Mixed, log_prob
from bayespbrl.models.low_rank import low_rank
from bayespbrl.models.preference_problem import low_rank_model, padded_problem


def consistent(number, dimension, seed=0):
    rng = np.random.default_rng(seed)
    differences = rng.normal(size=(number, dimension)) / np.sqrt(dimension)
    return differences * np.sign(differences @ rng.normal(size=dimension))[:, None]


@pytest.fixture(scope="module")
def tree():
    return sample_posterior(consistent(6, 9), seed=3)


def test_low_rank_keeps_zero_rows_at_zero_and_small_rows_at_their_size():
    differences = consistent(6, 9)
    differences[2] = 0
    differences[3] *= 1e-12
    differences[5] = differences[4]
    factors = low_rank(differences)
    assert factors.loadings.shape == (6, 4)
    assert np.all(factors.loadings[2] == 0)
    np.testing.assert_allclose(factors.basis.T @ factors.basis, np.eye(4), atol=1e-13)
    np.testing.assert_allclose(factors.loadings @ factors.basis.T, differences, rtol=0, atol=1e-13)
    np.testing.assert_allclose(factors.loadings[3] @ factors.basis.T, differences[3], rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("number", [9, 26])
def test_answers_that_contradict_each_other_about_the_same_margin_are_sampled_exactly(number):
    # 5 for and 3 against a margin, beside one about another: the steps of eq. 8, which have no scale, decide; with
    # K = 26 expectation propagation would follow them to infinite precision
    differences = np.array([[0.01, 0.0]] * 5 + [[-0.01, 0.0]] * 3 + [[0.3, 0.9]])
    grid = np.linspace(-6, 6, 601) + 0.005
    w = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)
    with jax.enable_x64(True):
        log_likelihood = np.asarray(log_prob(Mixed(5.0, number), w @ differences.T)).sum(axis=1)
    density = np.exp(log_likelihood - log_likelihood.max() - 0.5 * np.sum(w**2, axis=1))
    mean = density @ w / density.sum()
    tree = sample_posterior(differences, number_of_preferences=number, num_samples=2000, seed=1)
    margins = tree["posterior/margins"].values
    assert tree.attrs["converged"]
    error = chain_convergence(margins).monte_carlo_error
    assert np.all(np.abs(margins.mean(axis=(0, 1)) - differences @ mean) < 4 * error)


def test_answers_that_contradict_each_other_without_lapses_have_chains_that_start_apart_and_their_evidence():
    rng = np.random.default_rng(0)
    differences = rng.normal(size=(30, 2))
    differences *= np.sign(differences @ [1, 0.5] + 0.7 * rng.normal(size=30))[:, None]
    fit = fit_gaussian(differences, PreferenceModel())
    tree = sample_posterior(differences, seed=1)
    drawn = tree["posterior/coordinates"].values
    assert np.all(np.sqrt(np.diag(fit.approximation.covariance)) > 0.3 * drawn.std(axis=(0, 1)))
    grid = np.linspace(-5, 5, 1201) + 0.004  # not at zero, where all margins are
    w = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)
    with jax.enable_x64(True):
        log_p = np.asarray(log_prob(Mixed(5.0, 30.0), w @ differences.T)).sum(axis=1)
    log_p += np.sum(stats.norm.logpdf(w), axis=1) + 2 * np.log(grid[1] - grid[0])
    assert abs(tree.attrs["log_evidence"] - logsumexp(log_p)) < 4 * tree.attrs["log_evidence_error"]
    assert tree.attrs["log_evidence_error"] < 0.3


def test_the_error_of_an_evidence_without_overlap_is_infinite():
    rng = np.random.default_rng(0)
    near, far = _bridged(rng.normal(0.5, 1, 1000), rng.normal(-0.5, 1, 1000), 1.0), rng.normal(-40, 9, 1000)
    assert near[0] == pytest.approx(0, abs=4 * near[1])  # normal log ratios whose means differ by their variance
    assert _bridged(rng.normal(40, 9, 1000), far, 1.0)[1] == np.inf


def test_the_evidence_counts_draws_that_repeat_each_other_once():
    rng = np.random.default_rng(0)
    posterior, proposal = rng.normal(0.5, 1, 500), rng.normal(-0.5, 1, 1000)
    once, four_times = _bridged(posterior, proposal, 1.0), _bridged(np.repeat(posterior, 4), proposal, 0.25)
    assert four_times == pytest.approx(once, rel=1e-6)
    assert four_times[1] > 1.2 * _bridged(np.repeat(posterior, 4), proposal, 1.0)[1]


def test_no_preferences_give_the_prior():
    tree = sample_posterior(np.zeros((0, 3)), prior_scale=2.0, num_samples=500)
    w = tree["posterior/utility_weights"].values
    assert tree.attrs["log_evidence"] == 0
    assert tree.attrs["converged"]
    assert stats.kstest(w.ravel(), stats.norm(scale=2).cdf).pvalue > 1e-3
    assert np.all(tree["utility_weights_mean"].values == 0)


def test_one_preference_gives_the_sigmoid():
    # in one dimension: p(w) ∝ N(w; 0, σ²) sigmoid(m d w)
    tree = sample_posterior(np.array([[0.7]]), prior_scale=1.5, steepness=2.0)
    w = np.linspace(-12, 12, 100_001)
    density = np.exp(-0.5 * (w / 1.5) ** 2) / (1 + np.exp(-2 * 0.7 * w))
    cdf = np.cumsum(density) / density.sum()
    draws = tree["posterior/utility_weights"].values.ravel()
    assert stats.kstest(draws[::4], lambda x: np.interp(x, w, cdf)).pvalue > 1e-3
    assert abs(tree.attrs["log_evidence"] - np.log(0.5)) < 4 * tree.attrs["log_evidence_error"]


@pytest.mark.slow
def test_two_dimensions_agree_with_quadrature():
    differences = np.array([[1.0, 0.3], [0.5, -1.0], [-0.2, 0.4], [1.0, 0.3]])
    tree = sample_posterior(differences, prior_scale=1.3, steepness=4.0, num_samples=4000)
    grid = np.linspace(-8, 8, 1601)
    w = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)
    with jax.enable_x64(True):
        log_p = np.asarray(log_prob(Mixed(4.0, 4.0), w @ differences.T)).sum(axis=1)
    log_p -= 0.5 * np.sum(w**2, axis=1) / 1.3**2
    p = np.exp(log_p - logsumexp(log_p))
    margins = tree["posterior/margins"].values
    report = chain_convergence(margins)
    # half the grid's spacing for the sums across the jumps
    np.testing.assert_array_less(
        np.abs(margins.mean((0, 1)) - p @ (w @ differences.T)), 4.5 * report.monte_carlo_error + 2e-3
    )
    expected = np.mean(tree["posterior/margins"].values > 0, axis=(0, 1))
    np.testing.assert_allclose(p @ (w @ differences.T > 0), expected, atol=0.02)


def test_zero_rows_have_margin_zero_and_factor_one_half():
    differences = np.concatenate([consistent(3, 4), np.zeros((2, 4))])
    tree = sample_posterior(differences, num_samples=200, max_samples=200)
    assert np.all(tree["posterior/margins"].values[:, :, 3:] == 0)
    np.testing.assert_allclose(tree["log_likelihood/answers"].values[:, :, 3:], np.log(0.5))
    only = sample_posterior(np.zeros((2, 4)), num_samples=100)
    np.testing.assert_allclose(only.attrs["log_evidence"], 2 * np.log(0.5))
    assert only.attrs["converged"]


@pytest.mark.slow
@pytest.mark.parametrize("likelihood", ["mixed", "logistic", "probit"])
def test_duplicate_and_contradictory_answers_are_fine(likelihood):
    row = consistent(1, 5)
    differences = np.concatenate([row, row, -row, -row])
    tree = sample_posterior(differences, likelihood=likelihood, lapse_rate=0.1)
    margin = tree["posterior/margins"].values[:, :, 0]
    np.testing.assert_allclose(tree["posterior/margins"].values[:, :, 3], -margin, atol=1e-12)
    assert abs(margin.mean()) < 5 * chain_convergence(margin[:, :, None]).monte_carlo_error[0]
    assert tree.attrs["converged"]


@pytest.mark.slow
def test_ties_pull_the_margin_to_zero():
    differences = np.array([[1.0, 0.0], [0.0, 1.0]])
    tree = sample_posterior(differences, tie_threshold=0.2, indifferent=np.array([False, True]), likelihood="logistic")
    spread = tree["posterior/margins"].values.std((0, 1))
    assert spread[1] < 0.6 * spread[0]
    np.testing.assert_array_equal(tree["observed_data/answers"], [1, 0])


def test_draws_of_w_have_their_margins_and_the_priors_noise_elsewhere(tree):
    differences = tree["constant_data/differences"].values
    w = tree["posterior/utility_weights"].isel(draw=slice(0, 500)).values
    np.testing.assert_allclose(w @ differences.T, tree["posterior/margins"].values[:, :500], atol=1e-12)
    basis = low_rank(differences).basis
    complement = w - (w @ basis) @ basis.T
    # three dimensions are left of nine: the squared norm is χ²₃
    assert stats.kstest(np.sum(complement**2, axis=2).ravel(), stats.chi2(3).cdf).pvalue > 1e-3


def test_weights_are_the_same_however_they_are_indexed(tree):
    weights = tree["posterior/utility_weights"]
    some = weights.values
    np.testing.assert_array_equal(weights.isel(chain=1, draw=7).values, some[1, 7])
    np.testing.assert_array_equal(weights.isel(draw=[5, 2], feature=slice(1, 8, 3)).values, some[:, [5, 2], 1:8:3])
    np.testing.assert_array_equal(weights.isel(chain=0, draw=-1, feature=4).values, some[0, -1, 4])
    np.testing.assert_array_equal(weights.isel(chain=0, feature=[0, 2]).values, some[0][:, [0, 2]])
    np.testing.assert_array_equal(weights.isel(draw=3, feature=[0, 2]).values, some[:, 3, [0, 2]])
    np.testing.assert_array_equal(weights.isel(chain=[1], feature=[2, 0]).values, some[1:2][..., [2, 0]])


def test_mean_lies_in_the_row_space_and_most_likely_is_the_best_draw(tree):
    differences = tree["constant_data/differences"].values
    margins = tree["posterior/margins"].values
    np.testing.assert_allclose(differences @ tree["utility_weights_mean"].values, margins.mean((0, 1)), atol=1e-12)
    best = margins.reshape(-1, 6)[np.argmax(tree["sample_stats/lp"].values.ravel())]
    np.testing.assert_allclose(differences @ tree["utility_weights_most_likely"].values, best, atol=1e-12)
    basis = low_rank(differences).basis
    for name in ("utility_weights_mean", "utility_weights_most_likely"):
        w = tree[name].values
        np.testing.assert_allclose(basis @ (basis.T @ w), w, atol=1e-12)


def test_a_tree_on_disk_comes_back_whole(tree, tmp_path):
    assert "utility_weights" not in stored(tree)["posterior"]
    stored(tree).to_netcdf(tmp_path / "posterior.nc", engine="h5netcdf")
    with xr.open_datatree(tmp_path / "posterior.nc", engine="h5netcdf") as opened:
        back = restored(opened.load())
    xr.testing.assert_identical(back["posterior/margins"], tree["posterior/margins"])
    np.testing.assert_array_equal(
        back["posterior/utility_weights"].isel(draw=3).values, tree["posterior/utility_weights"].isel(draw=3).values
    )
    assert {k: v for k, v in back.attrs.items() if v == v} == {k: v for k, v in tree.attrs.items() if v == v}


def test_draws_in_the_coordinates_of_another_processor_keep_their_margins():
    """Where a question was repeated, rounding turns the later coordinates: differently on each processor."""
    differences = consistent(6, 9)
    differences = np.stack([differences, differences[:, ::-1]])
    differences[:, 1] = differences[:, 0]
    here = sample_posterior(differences, num_samples=50, max_samples=50)
    there, turn = stored(here), np.linalg.qr(np.random.default_rng(0).normal(size=(5, 5)))[0]
    there["posterior"]["coordinates"] = (
        there["posterior"]["coordinates"]
        .dot(xr.DataArray(turn, dims=("coordinate", "turned")))
        .rename(turned="coordinate")
    )
    back = restored(there)
    for name in ("posterior/utility_weights", "utility_weights_mean"):
        np.testing.assert_allclose(back[name].values, here[name].values, atol=1e-12)
    assert np.array_equal(restored(stored(here))["posterior/coordinates"], here["posterior/coordinates"])


def test_the_same_seed_gives_the_same_draws(tree):
    again = sample_posterior(consistent(6, 9), seed=3)
    np.testing.assert_array_equal(again["posterior/margins"], tree["posterior/margins"])
    other = sample_posterior(consistent(6, 9), seed=4)
    assert not np.any(other["posterior/margins"].values == tree["posterior/margins"].values)


@pytest.mark.slow
def test_what_does_not_converge_says_so():
    tree = sample_posterior(consistent(40, 60), num_samples=CHUNK, max_samples=2 * CHUNK, num_warmup=0)
    assert not tree.attrs["converged"]
    assert tree["posterior"].sizes["draw"] == 2 * CHUNK


def test_results_are_float64_and_the_global_flag_is_left_alone(tree):
    assert not jax.config.jax_enable_x64
    assert tree["posterior/margins"].dtype == np.float64
    assert np.abs(tree["posterior/margins"].values.astype(np.float32) - tree["posterior/margins"].values).max() > 0


@pytest.mark.slow
def test_ellipses_of_the_low_rank_problem_have_the_models_density():
    differences = consistent(6, 9)
    fit = fit_gaussian(differences, PreferenceModel(prior_scale=1.7))
    with jax.enable_x64(True):
        problem = padded_problem(
            fit.factors.loadings,
            Mixed(5.0, 6.0),
            prior_scale=1.7,
            mean=np.arange(6.0),
            site_precisions=1 + np.arange(6.0),
        )
        kernel = EllipticalSlice(low_rank_model)
        z = np.random.default_rng(0).standard_normal((20, len(problem.centre)))
        log_probs = jax.vmap(lambda x: jnp.stack(kernel._log_probs({"utility_weights": x}, (problem,), {})))
        prior_density, likelihood = np.asarray(jax.jit(log_probs)(z)).T
        joint = prior_density + likelihood
        (reference, _), (prior, _) = _ellipses((problem,), {})
        residual = np.asarray(reference.residual(jax.vmap(reference.lift)(z)))
        inside = stats.multivariate_normal(problem.centre, problem.root @ problem.root.T).logpdf(z)
        np.testing.assert_allclose(np.diff(residual), np.diff(joint - inside), rtol=1e-9)
        np.testing.assert_allclose(jax.vmap(lambda x: reference.lower(reference.lift(x)))(z), z, atol=1e-12)
        np.testing.assert_allclose(
            np.diff(prior.residual(jax.vmap(prior.lift)(z))), np.diff(likelihood), rtol=1e-9, atol=1e-12
        )


@pytest.mark.slow
def test_numpyros_mcmc_gives_the_same_draws_as_the_compiled_loop():
    fit = fit_gaussian(consistent(6, 9), PreferenceModel())
    with jax.enable_x64(True):
        chains = Chains.start([fit], num_chains=4, chunk=CHUNK, seed=0)
        options = {"num_chains": 4, "chain_method": "vectorized", "progress_bar": False}
        mcmc = MCMC(KERNEL, num_warmup=0, num_samples=5, **options)
        mcmc.post_warmup_state = chains.state
        # the loop splits each key once more, for the moves of what is unknown; here nothing is
        keys = jax.vmap(jax.random.split)(chains.state.rng_key)
        mcmc.post_warmup_state = chains.state._replace(rng_key=keys[:, 0])
        mcmc.run(keys[:, 0], conditional(chains.problem, jax.tree.map(lambda x: x[0], chains.unknowns)))
        z = mcmc.get_samples(group_by_chain=True)
        margins = chains.extended(1).collected("coordinates", 1) @ fit.factors.loadings.T
        np.testing.assert_allclose(z["margins"][:, :1, :6], margins, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_chains_started_in_the_far_tail_forget_it():
    differences = consistent(20, 40)
    fit = fit_gaussian(differences, PreferenceModel())
    with jax.enable_x64(True):
        chains = Chains.start([fit], num_chains=4, chunk=CHUNK, seed=0)
        far = chains.state.z["utility_weights"] * 0 + jnp.array([[30.0], [-30.0], [8.0], [-8.0]])
        chains = replace(chains, state=chains.state._replace(z={"utility_weights": far}))
        chains = replace(chains.extended(100), draws=()).extended(1000)
    margins = chains.collected("coordinates", 1000) @ fit.factors.loadings.T
    expected = sample_posterior(differences, num_samples=4000)["posterior/margins"].values
    error = np.hypot(chain_convergence(margins).monte_carlo_error, chain_convergence(expected).monte_carlo_error)
    assert chain_convergence(margins).rhat_max < 1.02
    assert np.all(np.abs(margins.mean((0, 1)) - expected.mean((0, 1))) < 4.5 * error)


@pytest.mark.slow
def test_forty_iterations_compile_the_sampler_at_most_five_times():
    before = draw_chunk._cache_size()
    differences = consistent(41, 60)
    for number in range(2, 42):
        sample_posterior(differences[:number], num_samples=CHUNK, max_samples=CHUNK, num_warmup=0)
    assert draw_chunk._cache_size() - before <= 5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "dimension", "scale", "steepness"),
    [
        (1, 4, 0.2, 20.0),
        (8, 20, 3.0, 0.7),
        (26, 25, 1.0, 5.0),
        (41, 100, 5.0, 0.5),
    ],
)
def test_simulation_based_calibration_of_the_margins(number, dimension, scale, steepness, monkeypatch):
    # the chains' diagnosis and the evidence take two thirds of the time and change no draw
    fine = Convergence(np.ones(1), np.full(1, 1e3), np.ones(1))
    monkeypatch.setattr(posterior, "chain_convergence", lambda draws: fine)
    monkeypatch.setattr(posterior, "log_evidence", lambda chains, length, *, seed: (0.0, 0.0))
    rng = np.random.default_rng(number)
    ranks = []
    for trial in range(120):
        differences = rng.normal(size=(number, dimension)) / np.sqrt(dimension)
        w = scale * rng.normal(size=dimension)
        with jax.enable_x64(True):
            p = np.exp(np.asarray(log_prob(Mixed(steepness, float(number)), differences @ w)))
        answered = differences * np.where(rng.uniform(size=number) < p, 1.0, -1.0)[:, None]
        tree = sample_posterior(
            answered,
            prior_scale=scale,
            steepness=steepness,
            num_samples=25,
            max_samples=25,
            seed=trial,
        )
        # A fixed direction of w: margins flipped by their own answer would be no function of w alone. Its ranks are
        # uniform under draws of the prior too; those of the answers' likelihood, which depends on them, are not.
        drawn = tree["posterior/utility_weights"][:, :, 0].values.ravel()
        with jax.enable_x64(True):
            margins = np.vstack([answered @ w, tree["posterior/margins"].values.reshape(-1, number)])
            true, *those = np.asarray(log_prob(Mixed(steepness, float(number)), margins)).sum(axis=1)
        ranks.append((np.sum(drawn < w[0]), np.sum(np.array(those) < true)))
    expected = 120 * np.diff(np.ceil(np.linspace(-0.5, 100.5, 6))) / 101
    for each in np.transpose(ranks):
        counts, _ = np.histogram(each, bins=np.linspace(-0.5, 100.5, 6))
        assert stats.chisquare(counts, expected).pvalue > 1e-3


@pytest.mark.slow
def test_the_posterior_finds_the_length_scale_that_ordered_the_pairs():
    rng = np.random.default_rng(1)
    points, centres = rng.uniform(-3, 3, (120, 1)), np.linspace(-3, 3, 60)
    features = {s: np.exp(-0.5 * ((points - centres) / s) ** 2) for s in (0.05, 0.7, 20.0)}
    utility = features[0.7] @ rng.normal(size=60)
    settings = np.array([rows[:60] - rows[60:] for rows in features.values()])
    settings *= np.sign(utility[:60] - utility[60:])[:, None]
    settings /= np.sqrt(np.mean(np.sum(settings**2, axis=2), axis=1))[:, None, None]
    tree = sample_posterior(settings, num_samples=100, max_samples=100)
    assert np.mean(tree["posterior/setting"] == 1) > 0.9
    evidence = [fit_gaussian(each, PreferenceModel()).log_evidence for each in settings]
    assert tree.attrs["log_evidence"] == pytest.approx(logsumexp(evidence) - np.log(3), abs=0.5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"differences": np.ones(3)}, "differences: expected shape"),
        ({"differences": np.array([[1.0, np.nan]])}, "differences: expected finite"),
        ({"prior_scale": 0.0}, "prior_scale: expected"),
        ({"prior_scale": np.inf}, "prior_scale: expected"),
        ({"steepness": -1.0}, "steepness: expected"),
        ({"lapse_rate": 1.0}, "lapse_rate: expected"),
        ({"likelihood": "other"}, "likelihood: expected"),
        ({"num_chains": 1}, "num_chains: expected"),
        ({"num_samples": 0}, "num_samples: expected"),
        ({"max_samples": 10, "num_samples": 20}, "max_samples: expected"),
        ({"seed": -1}, "seed: expected"),
        ({"seed": 2**63}, "seed: expected at most"),
        ({"number_of_preferences": -3}, "number_of_preferences: expected a whole number >= 0"),
        ({"number_of_preferences": 2.5}, "number_of_preferences: expected a whole number >= 0"),
        ({"shown_first": np.array([2, 0])}, "shown_first: expected 2 whole numbers in -1 … 1"),
        ({"answerers": np.array([0])}, "answerers: expected 2 whole numbers"),
        ({"differences": np.ones((0, 2, 3))}, "differences: expected shape"),
        ({"differences": [[1.0], [1.0, 2.0]]}, "differences: expected rows of numbers"),
        ({"differences": "abc"}, "differences: expected rows of numbers"),
        ({"differences": [[1e50], [-1.0]]}, r"differences: expected the largest between 1e-30 and 1e\+30, got 1e\+50"),
        ({"differences": [[-1e-50]]}, "differences: expected the largest between .* got 1e-50; divide"),
        ({"differences": {1: 2}}, "differences: expected rows of numbers"),
        ({"differences": np.ones((2, 1, 2), complex)}, "differences: expected"),
        ({"differences": np.ma.masked_array(np.ones((2, 1, 2)), mask=True)}, "differences: expected"),
        ({"indifferent": np.array([True]), "tie_threshold": 0.1}, "indifferent: expected"),
        ({"tie_threshold": 0.0}, "tie_threshold: expected"),
        ({"tie_threshold": 1e-17}, "tie_threshold: expected 1.*e-12 to 1"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        sample_posterior(**{"differences": np.ones((2, 3)), **arguments})


def test_differences_may_have_names():
    tree = sample_posterior(np.array([[[1.0, 0.2]], [[0.3, -1.0]]]), num_samples=20, max_samples=20)
    again = sample_posterior(tree["constant_data"]["differences"], num_samples=20, max_samples=20)
    np.testing.assert_array_equal(again["posterior"]["coordinates"], tree["posterior"]["coordinates"])


def test_a_tie_threshold_is_in_units_of_the_margins_whatever_those_of_the_features():
    rows, tied = np.array([[1.0, 0.2], [0.3, -1.0], [0.1, 0.1]]), np.array([False, False, True])
    options = {"indifferent": tied, "steepness": None, "lapse_rate": None, "num_samples": 50, "max_samples": 50}
    here = sample_posterior(rows, **options)["posterior"]["tie_threshold"]
    far = sample_posterior(rows * 1e7, prior_scale=1e-7, **options)["posterior"]["tie_threshold"]
    assert 0.5 < float(far.mean() / here.mean()) < 2
    sample_posterior(rows * 1e7, prior_scale=1e-7, **options | {"tie_threshold": 0.2})
