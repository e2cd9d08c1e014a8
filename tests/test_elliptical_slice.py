import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from arviz_base import from_numpyro
from numpyro.contrib.control_flow import scan
from numpyro.infer import MCMC, NUTS, Gibbs
from scipy import stats

from bayespbrl.models import EllipticalSlice, preference_model
from bayespbrl.models.convergence import chain_convergence
from bayespbrl.models.elliptical_slice import BATCHES_AHEAD, Ellipse, elliptical_moves
from bayespbrl.models.likelihoods import Logistic, Mixed

pytestmark = pytest.mark.empties_caches


@pytest.fixture(autouse=True, scope="module")
def quick_compilation():
    """Without most of the compiler's optimisations: it would take longer than what it compiles, which runs once."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
    jax.clear_caches()


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def regression(x, y):
    """Two sites of different shape with nonzero means; the posterior is Gaussian and known."""
    slope = numpyro.sample("slope", dist.Normal(1.0, 2.0).expand([2]).to_event(1))
    offset = numpyro.sample("offset", dist.MultivariateNormal(jnp.array([-1.0]), jnp.array([[0.25]])))
    mean = numpyro.deterministic("mean", x @ slope + offset[0])
    numpyro.sample("y", dist.Normal(mean, 0.5), obs=y)


X = np.array([[1.0, 0.2], [0.3, -1.0], [2.0, 1.0]])
Y = np.array([0.5, 1.0, 3.0])


def regression_posterior():
    # sites in sorted order: offset, slope
    design = np.column_stack([np.ones(3), X])
    precision = np.diag([1 / 0.25, 1 / 4, 1 / 4])
    covariance = np.linalg.inv(precision + design.T @ design / 0.25)
    return covariance @ (precision @ np.array([-1.0, 1.0, 1.0]) + design.T @ Y / 0.25), covariance


def run(kernel, *args, chain_method="vectorized", num_warmup=200, num_samples=2000, num_chains=4, seed=0, **kwargs):
    mcmc = MCMC(
        kernel,
        num_warmup=num_warmup,
        num_samples=num_samples,
        num_chains=num_chains,
        chain_method=chain_method,
        progress_bar=False,
    )
    mcmc.run(jax.random.key(seed), *args, **kwargs)
    return mcmc


@pytest.mark.slow
@pytest.mark.parametrize(
    "reference", [None, (np.array([0.0, 1.0, 0.0]), np.diag([0.3, 0.5, 0.4]))], ids=["prior", "reference"]
)
def test_posterior_of_a_linear_regression_is_the_known_gaussian(reference):
    mcmc = run(EllipticalSlice(regression, moves=4, reference=reference), X, Y)
    z = mcmc.get_samples(group_by_chain=True)
    draws = np.concatenate([z["offset"], z["slope"]], axis=2)
    mean, covariance = regression_posterior()
    report = chain_convergence(draws)
    assert report.rhat_max < 1.02
    assert np.all(np.abs(draws.mean((0, 1)) - mean) < 4 * report.monte_carlo_error)
    np.testing.assert_allclose(np.cov(draws.reshape(-1, 3).T), covariance, atol=0.15 * covariance.max())


def exact_draws(key, number, *, steepness, scale, likelihood=None):
    """Independent draws of w in one dimension under two answers in favour and one against, by inverting its CDF."""
    likelihood = likelihood or Mixed(steepness, 3.0)
    # dense round 0, where the likelihood jumps and, steep, has all its mass
    w = 9 * scale * np.sinh(25 * np.linspace(-1, 1, 400_001)) / np.sinh(25)
    margins = w[:, None] * np.array([1.0, 0.4, -0.2])
    exponent, ratio = likelihood.factor(margins)
    log_density = np.sum(np.asarray(exponent) + np.log(np.asarray(ratio)), axis=1) - 0.5 * (w / scale) ** 2
    density = np.exp(log_density - log_density.max())
    cdf = np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(w))
    cdf = np.concatenate([[0.0], cdf]) / cdf[-1]
    return np.interp(np.asarray(jax.random.uniform(key, (number,))), cdf, w), lambda x: np.interp(x, w, cdf)


def mover(*, moves=1, batch=4):
    """What moves draws of w by the kernel as it is at the first call; to compile once for all laws and references."""

    def move(key, w, steepness, scale, reference):
        kernel = EllipticalSlice(preference_model, batch=batch, reference=reference)
        args = jnp.array([[1.0], [0.4], [-0.2]]), Mixed(steepness, 3.0)
        state = kernel.init(key, 0, {"utility_weights": w[None]}, args, {"prior_scale": scale})
        state = jax.lax.fori_loop(0, moves, lambda _, s: kernel.sample(s, args, {"prior_scale": scale}), state)
        return state.z["utility_weights"][0]

    moves_of_all = jax.vmap(move, in_axes=(0, 0, None, None, None))
    return jax.jit(moves_of_all, compiler_options={"xla_backend_optimization_level": 1})


@pytest.fixture(scope="module")
def one_step():
    return mover()


def p_value_after(move, *, steepness=5.0, scale=1.0, reference=None, model_scale=None, number=100_000):
    """p of the Kolmogorov–Smirnov test that exact draws, moved, still follow the exact law."""
    start, cdf = exact_draws(jax.random.key(1), number, steepness=steepness, scale=scale)
    keys = jax.random.split(jax.random.key(2), number)
    moved = np.asarray(move(keys, jnp.asarray(start), steepness, model_scale or scale, reference))
    assert np.mean(moved != start) > 0.99
    return stats.kstest(moved, cdf).pvalue


WIDE = (np.array([0.3]), np.array([[0.6]]))


@pytest.mark.slow
@pytest.mark.parametrize("reference", [None, WIDE], ids=["prior", "reference"])
@pytest.mark.parametrize(("steepness", "scale"), [(5.0, 1.0), (0.3, 7.0), (60.0, 0.2), (1e4, 1.0)])
def test_one_step_leaves_the_exact_law_as_it_is(one_step, reference, steepness, scale):
    if reference is not None:
        reference = (reference[0] * scale, reference[1] * scale**2)
    assert p_value_after(one_step, steepness=steepness, scale=scale, reference=reference) > 1e-3


def one_candidate_at_a_time(key, v, noise, log_density, *, moves, batch, max_candidates):
    """Elliptical slice sampling as Murray, Adams and MacKay (2010) write it down, from the kernel's random numbers."""
    ahead = min(BATCHES_AHEAD, -(-max_candidates // batch))
    key_noise, key_uniform, key_more = jax.random.split(key, 3)
    fresh = np.asarray(noise(key_noise, moves))
    uniforms = np.asarray(jax.random.uniform(key_uniform, (moves, ahead * batch + 1)))
    tried, stuck = [], []
    for move, more in enumerate(jax.random.split(key_more, moves)):
        level, drawn = log_density(v) + np.log(uniforms[move, 0]), list(uniforms[move, 1:])
        angle = 2 * np.pi * drawn[0]
        low, high = angle - 2 * np.pi, angle
        candidate = v * np.cos(angle) + fresh[move] * np.sin(angle)
        count = 1
        while log_density(candidate) <= level and count < -(-max_candidates // batch) * batch:
            low, high = (angle, high) if angle < 0 else (low, angle)
            if count == len(drawn):
                drawn += list(np.asarray(jax.random.uniform(jax.random.fold_in(more, count), (batch,))))
            angle = low + (high - low) * drawn[count]
            candidate = v * np.cos(angle) + fresh[move] * np.sin(angle)
            count += 1
        stuck.append(not log_density(candidate) > level)
        tried.append(count)
        v = v if stuck[-1] else candidate
    return v, tried, stuck


@pytest.mark.parametrize(
    ("batch", "max_candidates"),
    [
        (4, 1000),
        *(pytest.param(*pair, marks=pytest.mark.slow) for pair in ((1, 1000), (3, 10), (1, 6), (8, 8))),
    ],
)
def test_many_moves_in_one_loop_are_the_moves_of_the_textbook_one_by_one(batch, max_candidates):
    moves, centre, width = 12, np.array([0.7, -0.4]), 0.003

    def noise(key, number):
        return jax.random.normal(key, (number, 2))

    def residual(points):
        return -0.5 * jnp.sum(((points - centre) / width) ** 2, axis=-1)

    ellipse = Ellipse(lambda x: x, noise, residual, lambda v: v)
    options = {"moves": moves, "batch": batch, "max_candidates": max_candidates}
    walk = jax.jit(jax.vmap(lambda key: elliptical_moves(key, jnp.asarray(centre), ellipse, **options)))
    keys = jax.random.split(jax.random.key(0), 8)
    counted, given_up = [], []
    for key, x, tried, stuck in zip(keys, *map(np.asarray, walk(keys)), strict=True):
        expected, counts, failures = one_candidate_at_a_time(
            key, centre, noise, lambda v: -0.5 * np.sum(((v - centre) / width) ** 2), **options
        )
        np.testing.assert_allclose(x, expected, atol=1e-12)
        assert (tried, stuck) == (sum(counts), any(failures))
        counted += counts
        given_up.append(sum(failures))
    # what is to be tested happens: moves that go beyond what was drawn ahead, or that are given up amid others
    if max_candidates == 1000:
        assert max(counted) > BATCHES_AHEAD * batch
    else:
        assert any(0 < number < moves for number in given_up)


@pytest.mark.slow
def test_batched_candidates_leave_the_law_of_a_draw_as_it_is():
    assert p_value_after(mover(batch=1)) > 1e-3
    assert p_value_after(mover(batch=16)) > 1e-3


@pytest.mark.slow
def test_a_kernel_with_the_prior_scale_five_percent_off_is_rejected():
    assert p_value_after(mover(moves=10), model_scale=1.05, number=50_000) < 1e-6


@pytest.mark.slow
def test_a_kernel_that_shrinks_to_the_wrong_side_is_rejected(monkeypatch):
    from bayespbrl.models import elliptical_slice

    right = elliptical_slice.shrink

    def wrong(angle, low, high, uniforms):
        # the bracket closes round 1 radian instead of round the current point
        angles, low, high = right(angle - 1.0, low - 1.0, high - 1.0, uniforms)
        return angles + 1.0, low + 1.0, high + 1.0

    monkeypatch.setattr(elliptical_slice, "shrink", wrong)
    assert p_value_after(mover(moves=3), number=30_000) < 1e-6


@pytest.mark.slow
def test_a_kernel_that_uses_a_key_twice_is_rejected(monkeypatch):
    from bayespbrl.models import elliptical_slice, elliptical_slice_kernel

    class Reused:
        def __getattr__(self, name):
            return getattr(jax.random, name)

        def split(self, key, number=2):
            return jnp.stack([key] * number)

    for module in (elliptical_slice, elliptical_slice_kernel):
        monkeypatch.setattr(module, "random", Reused())
    assert p_value_after(mover(), number=20_000) < 1e-6


@pytest.mark.slow
def test_a_reference_without_its_correction_is_rejected(monkeypatch):
    def uncorrected(self, x, unravel, key, model_args, model_kwargs):
        ellipses = right(self, x, unravel, key, model_args, model_kwargs)
        first, moves = ellipses[0]
        log_likelihood = jax.vmap(lambda v: self._log_probs(unravel(first.lower(v)), model_args, model_kwargs)[1])
        return [(first._replace(residual=log_likelihood), moves)]

    right = EllipticalSlice._model_ellipses
    monkeypatch.setattr(EllipticalSlice, "_model_ellipses", uncorrected)
    assert p_value_after(mover(moves=3), reference=WIDE, number=50_000) < 1e-6


def ten_dimensions():
    rng = np.random.default_rng(3)
    differences = rng.normal(size=(12, 10)) / 3
    return jnp.asarray(differences * np.sign(differences @ rng.normal(size=10))[:, None])


@pytest.mark.slow
def test_ten_dimensions_agree_with_nuts_where_the_likelihood_is_smooth():
    args = (ten_dimensions(), Logistic(5.0))
    ours = run(EllipticalSlice(preference_model, moves=8), *args, num_samples=4000)
    theirs = run(NUTS(preference_model), *args, num_warmup=500, num_samples=2000)
    a, b = (m.get_samples(group_by_chain=True)["margins"] for m in (ours, theirs))
    error = np.hypot(chain_convergence(a).monte_carlo_error, chain_convergence(b).monte_carlo_error)
    assert np.all(np.abs(a.mean((0, 1)) - b.mean((0, 1))) < 4.5 * error)
    np.testing.assert_allclose(a.std((0, 1)), b.std((0, 1)), rtol=0.1)


@pytest.mark.slow
def test_ten_dimensions_agree_with_importance_sampling_under_the_discontinuous_likelihood():
    differences, likelihood = ten_dimensions(), Mixed(5.0, 12.0)
    w = np.random.default_rng(0).standard_normal((1_000_000, 10))
    exponent, ratio = likelihood.factor(w @ np.asarray(differences).T)
    log_weights = np.sum(np.asarray(exponent) + np.log(np.asarray(ratio)), axis=1)
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.sum()
    expected = weights @ w
    expected_error = np.sqrt(weights**2 @ (w - expected) ** 2)
    draws = run(EllipticalSlice(preference_model, moves=8), differences, likelihood, num_samples=4000)
    z = draws.get_samples(group_by_chain=True)["utility_weights"]
    error = np.hypot(chain_convergence(z).monte_carlo_error, expected_error)
    assert np.all(np.abs(z.mean((0, 1)) - expected) < 4.5 * error)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:There are not enough devices")
def test_chain_methods_give_the_same_draws():
    draws = {}
    for method in ("sequential", "parallel", "vectorized"):
        mcmc = run(EllipticalSlice(regression), X, Y, chain_method=method, num_chains=2, num_warmup=5, num_samples=20)
        draws[method] = mcmc.get_samples(group_by_chain=True)["slope"]
    np.testing.assert_allclose(draws["sequential"], draws["vectorized"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(draws["parallel"], draws["vectorized"], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_run_continued_equals_one_long_run():
    long = run(EllipticalSlice(regression), X, Y, num_warmup=10, num_samples=40)
    short = run(EllipticalSlice(regression), X, Y, num_warmup=10, num_samples=20)
    first = short.get_samples(group_by_chain=True)["slope"]
    short.post_warmup_state = short.last_state
    short.run(short.last_state.rng_key, X, Y)
    both = np.concatenate([first, short.get_samples(group_by_chain=True)["slope"]], axis=1)
    np.testing.assert_allclose(both, long.get_samples(group_by_chain=True)["slope"], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_arviz_reads_sites_deterministics_and_extra_fields():
    mcmc = run(EllipticalSlice(regression), X, Y, num_samples=50, extra_fields=("candidates", "stuck"))
    tree = from_numpyro(mcmc)
    assert set(tree["posterior"].data_vars) == {"slope", "offset", "mean"}
    assert tree["posterior/slope"].shape == (4, 50, 2)
    assert tree["observed_data/y"].shape == (3,)
    assert not mcmc.get_extra_fields()["stuck"].any()


def hierarchical(differences, answers):
    scale = numpyro.sample("scale", dist.LogNormal(0.0, 0.5))
    steepness = numpyro.sample("steepness", dist.LogNormal(1.0, 0.5))
    w = numpyro.sample("w", dist.Normal(0, scale).expand([2]).to_event(1))
    with numpyro.plate("preference", len(answers)):
        numpyro.sample("answers", dist.Bernoulli(logits=steepness * differences @ w), obs=answers)


@pytest.mark.slow
def test_scale_and_steepness_are_inferred_beside_w_by_gibbs_as_by_nuts_alone():
    rng = np.random.default_rng(0)
    differences = rng.normal(size=(15, 2))
    answers = (rng.uniform(size=15) < 1 / (1 + np.exp(-3 * differences @ np.array([1.0, -0.5])))).astype(int)
    blocks = [(EllipticalSlice(hierarchical, moves=3), ["w"]), (NUTS(hierarchical), ["scale", "steepness"])]
    ours = run(
        Gibbs(blocks), differences, answers, chain_method="sequential", num_warmup=300, num_samples=2000, num_chains=2
    )
    alone = run(NUTS(hierarchical), differences, answers, num_warmup=300, num_samples=1500)
    for site in ("scale", "steepness", "w"):
        a, b = (m.get_samples(group_by_chain=True)[site] for m in (ours, alone))
        error = np.hypot(chain_convergence(a).monte_carlo_error, chain_convergence(b).monte_carlo_error)
        assert np.all(np.abs(a.mean((0, 1)) - b.mean((0, 1))) < 4.5 * error), site


@pytest.mark.slow
def test_a_start_where_the_likelihood_is_zero_or_nan_is_left():
    def model():
        x = numpyro.sample("x", dist.Normal(0, 1))
        numpyro.factor("wall", jnp.where(x > 1, jnp.nan, jnp.where(x < -1, -jnp.inf, 0.0)))

    for start in (3.0, -3.0):
        mcmc = run(
            EllipticalSlice(model), num_chains=1, num_samples=100, num_warmup=5, init_params={"x": jnp.array(start)}
        )
        assert np.all(np.abs(mcmc.get_samples()["x"]) <= 1)


@pytest.mark.slow
def test_a_move_without_an_acceptable_candidate_stays_and_says_so():
    def model():
        x = numpyro.sample("x", dist.Normal(0, 1).expand([2]).to_event(1))
        numpyro.factor("nowhere", jnp.where(jnp.all(x == 0.25), 0.0, -jnp.inf))

    start = {"x": jnp.full(2, 0.25)}
    mcmc = run(
        EllipticalSlice(model, max_candidates=16),
        num_chains=1,
        num_warmup=0,
        num_samples=3,
        init_params=start,
        extra_fields=("stuck",),
    )
    assert np.all(mcmc.get_extra_fields()["stuck"])
    np.testing.assert_array_equal(mcmc.get_samples()["x"], np.full((3, 2), 0.25))


@pytest.mark.parametrize("nowhere", [(True, False), (False, True), (False, False)])
def test_a_draw_is_stuck_where_the_moves_round_any_of_its_ellipses_were(nowhere):
    def model():
        numpyro.sample("x", dist.Normal(0, 1).expand([2]).to_event(1))

    def ellipse(height):
        def noise(key, moves):
            return jax.random.normal(key, (moves, 2))

        return Ellipse(lambda x: x, noise, lambda v: jnp.full(len(v), height), lambda v: v)

    ellipses = [(ellipse(-jnp.inf if impossible else 0.0), 1) for impossible in nowhere]
    kernel = EllipticalSlice(model, max_candidates=16, ellipses=lambda *_: ellipses)
    state = kernel.init(jax.random.key(0), 0, None)
    assert kernel.sample(state).stuck == any(nowhere)


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (lambda: numpyro.sample("x", dist.Gamma(1.0, 1.0)), "Gamma at site 'x'"),
        (lambda: numpyro.sample("x", dist.LogNormal(0.0, 1.0)), "LogNormal at site 'x'"),
        (lambda: None, "at least one latent"),
        (lambda: numpyro.sample("x", dist.Normal(numpyro.sample("m", dist.Normal(0, 1)), 1)), "depending on"),
    ],
)
def test_a_model_without_independent_gaussian_sites_is_refused(prior, message):
    def model():
        prior()
        numpyro.sample("y", dist.Normal(0, 1), obs=0.5)

    with pytest.raises(ValueError, match=message):
        EllipticalSlice(model).init(jax.random.key(0), 0, None, (), {})


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="moves: expected"):
        EllipticalSlice(regression, moves=0)
    with pytest.raises(ValueError, match="init_params: expected names"):
        EllipticalSlice(regression).init(jax.random.key(0), 0, {"nope": jnp.zeros(2)}, (X, Y), {})


@pytest.mark.slow
def test_single_precision_programs_keep_their_precision():
    with jax.enable_x64(False):
        mcmc = run(EllipticalSlice(regression), X.astype(np.float32), Y.astype(np.float32), num_samples=10)
        assert mcmc.get_samples()["slope"].dtype == jnp.float32


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ((np.zeros(3), np.diag([1.0, 1.0, -1e-3])), "a symmetric positive definite covariance, got .* is -0.001"),
        ((np.zeros(3), np.zeros((3, 3))), "a symmetric positive definite covariance"),
        ((np.zeros(3), np.triu(np.ones((3, 3)))), "a symmetric positive definite covariance"),
        ((np.zeros(3), np.eye(2)), r"shapes \(n,\) and \(n, n\), got \(3,\) and \(2, 2\)"),
        ((np.zeros(3), np.full((3, 3), np.nan)), "finite entries"),
        ((np.full(3, np.inf), np.eye(3)), "finite entries"),
    ],
)
def test_a_reference_that_is_no_gaussian_is_refused(reference, message):
    with pytest.raises(ValueError, match=f"^reference: expected {message}"):
        EllipticalSlice(regression, reference=reference)


def test_a_reference_of_another_size_than_the_model_is_refused():
    kernel = EllipticalSlice(regression, reference=(np.zeros(2), np.eye(2)))
    with pytest.raises(ValueError, match="reference: expected a mean of the model's 3 values, got 2"):
        kernel.init(jax.random.key(0), 0, None, (X, Y))


@pytest.mark.slow
def test_a_likelihood_that_is_impossible_everywhere_is_flagged_where_arviz_looks():
    def impossible(value):
        numpyro.sample("x", dist.Normal(0.0, 1.0))
        numpyro.factor("never", value)

    for value in (jnp.nan, -jnp.inf):
        stats_group = from_numpyro(run(EllipticalSlice(impossible), value, num_warmup=0, num_samples=5))["sample_stats"]
        assert stats_group["diverging"].values.all()
    regular = from_numpyro(run(EllipticalSlice(regression), X, Y, num_warmup=0, num_samples=5))["sample_stats"]
    assert not regular["diverging"].values.any()


@pytest.mark.slow
def test_a_subsampled_plate_is_refused():
    def subsampled(y):
        x = numpyro.sample("x", dist.Normal(0.0, 1.0))
        with numpyro.plate("rows", 6, subsample_size=2) as rows:
            numpyro.sample("y", dist.Normal(x, 1.0), obs=y[rows])

    with pytest.raises(ValueError, match="model: expected whole plates, got 2 of 6 rows in plate 'rows'"):
        run(EllipticalSlice(subsampled), jnp.arange(6.0), num_samples=5)


def scanned(prior_of):
    """Five steps, each with a latent `x` whose prior `prior_of` makes of the step before; their sums are observed."""

    def step(total, _):
        x = numpyro.sample("x", prior_of(total))
        return total + x, total + x

    _, sums = scan(step, 0.0, None, length=5)
    numpyro.sample("y", dist.Normal(sums, 0.5), obs=jnp.arange(1.0, 6.0))


@pytest.mark.parametrize("chain_method", ["sequential", "vectorized"])
def test_steps_of_a_scan_may_not_depend_on_earlier_ones_and_independent_ones_are_sampled_exactly(chain_method):
    def mcmc(prior_of):
        return MCMC(
            EllipticalSlice(lambda: scanned(prior_of)),
            num_warmup=300,
            num_samples=2000,
            num_chains=2,
            chain_method=chain_method,
            progress_bar=False,
        )

    with pytest.raises(
        ValueError, match=r"independent a priori, got 'x', whose prior changes with the draw; in a scan"
    ):
        mcmc(lambda total: dist.Normal(total, 1.0)).run(jax.random.key(1))
    steps = mcmc(lambda total: dist.Normal(0.0, 1.0))
    steps.run(jax.random.key(1))
    design = np.tril(np.ones((5, 5)))  # y = design @ x + noise
    exact = np.linalg.solve(np.eye(5) + design.T @ design / 0.25, design.T @ np.arange(1.0, 6.0) / 0.25)
    np.testing.assert_allclose(np.asarray(steps.get_samples()["x"]).mean(axis=0), exact, atol=0.08)
