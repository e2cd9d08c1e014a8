"""Step 1, Bayesian PBIRL: draws from p(w | preferences) that have converged, or say that they have not (eqs. 7-8)."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from xarray.core import indexing

from bayespbrl.diagnostics.convergence import Convergence, convergence
from bayespbrl.models.expectation_propagation import expectation_propagation
from bayespbrl.models.likelihoods import preference_likelihood
from bayespbrl.models.low_rank import UtilityWeights, low_rank


@partial(jax.jit, static_argnames=("draws", "moves"))
def _chain(key, z, loadings, mask, likelihood, prior_scale, mean, root, inverse_root, *, draws, moves):
    def residual(z, y):
        log_lik = jnp.sum(jnp.where(mask, likelihood.log_prob(loadings @ z), 0.0))
        return log_lik - 0.5 * jnp.sum(z**2) / prior_scale**2 + 0.5 * jnp.sum(y**2)

    def move(z, key, plain):
        m = jnp.where(plain, 0.0, mean)
        a = jnp.where(plain, prior_scale * jnp.eye(len(mean)), root)
        b = jnp.where(plain, jnp.eye(len(mean)) / prior_scale, inverse_root)
        k1, k2, k3, k4 = jax.random.split(key, 4)
        y, xi = b @ (z - m), jax.random.normal(k1, z.shape)
        level = residual(z, y) + jnp.log(jax.random.uniform(k2))
        angle = jax.random.uniform(k3, maxval=2 * jnp.pi)
        at = lambda angle: y * jnp.cos(angle) + xi * jnp.sin(angle)  # noqa: E731
        value = lambda angle: residual(m + a @ at(angle), at(angle))  # noqa: E731

        def shrink(c):
            angle, low, high, key, n = c
            low, high = jnp.where(angle < 0, angle, low), jnp.where(angle < 0, high, angle)
            key, sub = jax.random.split(key)
            return jax.random.uniform(sub, minval=low, maxval=high), low, high, key, n + 1

        c = jax.lax.while_loop(
            lambda c: ~(value(c[0]) > level) & (c[4] < 200), shrink, (angle, angle - 2 * jnp.pi, angle, k4, 0)
        )
        return jnp.where(c[4] < 200, m + a @ at(c[0]), z)

    def draw(z, key):
        for i, sub in enumerate(jax.random.split(key, moves)):
            z = move(z, sub, i % 2 == 1)
        return z, z

    return jax.lax.scan(draw, z, jax.random.split(key, draws))


def sample_posterior(
    differences: np.ndarray,
    *,
    prior_scale: float = 1.0,
    steepness: float = 5.0,
    lapse_rate: float = 0.0,
    likelihood: str = "mixed",
    num_warmup: int = 200,
    num_samples: int = 1000,
    num_chains: int = 4,
    seed: int = 0,
) -> xr.DataTree:
    """Draw from the posterior of the utility weights w ~ N(0, σ²I) given preferences (eqs. 7-8)."""
    differences = np.asarray(differences, dtype=float)
    if differences.ndim != 2 or not np.all(np.isfinite(differences)):
        raise ValueError(f"differences: expected a finite matrix (K, D), got shape {differences.shape} or NaN/infinity")
    if not (np.isfinite(prior_scale) and prior_scale > 0):
        raise ValueError(f"prior_scale: expected a finite number > 0, got {prior_scale}")
    number = len(differences)
    model = preference_likelihood(likelihood, steepness=steepness, number_of_preferences=number, lapse_rate=lapse_rate)
    factors = low_rank(differences)
    rank = factors.loadings.shape[1]
    used = np.any(factors.loadings != 0, axis=1)
    gaussian = expectation_propagation(factors.loadings[used], model.probit_mixture(), prior_scale=prior_scale)
    capacity = max(8, 1 << (max(number, 1) - 1).bit_length())
    pad = capacity - rank
    with jax.enable_x64(True):
        loadings = np.zeros((capacity, capacity))
        loadings[:number, :rank] = factors.loadings
        mask = np.zeros(capacity, bool)
        mask[:number] = used
        root = np.eye(capacity) * prior_scale
        root[:rank, :rank] = np.linalg.cholesky(1.3 * gaussian.covariance)
        mean = np.pad(gaussian.mean, (0, pad))
        key = jax.random.key(seed)
        run = jax.vmap(
            partial(_chain, draws=num_samples, moves=8),
            in_axes=(0, 0, None, None, None, None, None, None, None),
        )
        start = mean + np.random.default_rng(seed).standard_normal((num_chains, capacity)) @ root.T
        arguments = (loadings, mask, model, prior_scale, mean, root, np.linalg.inv(root))
        state, _ = run(jax.random.split(jax.random.fold_in(key, 0), num_chains), start, *arguments)
        draws = np.zeros((num_chains, 0, rank))
        for attempt in range(5):
            for chunk in range(1 if attempt == 0 else 2 ** (attempt - 1)):
                sub = jax.random.fold_in(jax.random.fold_in(key, 1 + attempt), chunk)
                state, more = run(jax.random.split(sub, num_chains), state, *arguments)
                draws = np.concatenate([draws, np.asarray(more)[:, :, :rank]], axis=1)
            margins = draws @ factors.loadings.T
            report = convergence(margins)
            if report.converged():
                break
        log_likelihood = np.asarray(model.log_prob(margins)) if number else np.zeros(margins.shape)
    return _tree(
        differences, factors, draws, margins, log_likelihood, report, gaussian.log_evidence + np.log(0.5) * np.sum(~used),
        {"prior_scale": prior_scale, "steepness": steepness, "lapse_rate": lapse_rate, "seed": seed,
         "likelihood": likelihood},
    )  # fmt: skip


def _tree(differences, factors, draws, margins, log_likelihood, report: Convergence, log_evidence, settings):
    number = len(differences)
    sample = ("chain", "draw")
    coordinates = {"chain": np.arange(draws.shape[0]), "draw": np.arange(draws.shape[1])}
    lazy = UtilityWeights(draws, factors.basis, prior_scale=settings["prior_scale"], seed=settings["seed"])
    posterior = xr.Dataset(
        {
            "margins": ((*sample, "preference"), margins),
            "coordinates": ((*sample, "coordinate"), draws),
            "utility_weights": xr.Variable((*sample, "feature"), indexing.LazilyIndexedArray(lazy)),
        },
        coordinates,
    )
    total = log_likelihood.sum(axis=2)
    best = np.unravel_index(np.argmax(total), total.shape)
    root = xr.Dataset(
        {
            "utility_weights_mean": ("feature", factors.basis @ draws.mean(axis=(0, 1))),
            "utility_weights_most_likely": ("feature", factors.basis @ draws[best]),
        },
        attrs={
            "log_evidence": float(log_evidence),
            "rhat_max": report.rhat_max,
            "effective_sample_size_min": min(report.effective_sample_size_min, float(total.size)),
            "converged": int(report.converged()),
            **settings,
        },
    )
    return xr.DataTree.from_dict(
        {
            "/": root,
            "/posterior": posterior,
            "/sample_stats": xr.Dataset({"log_likelihood_sum": (sample, total)}, coordinates),
            "/log_likelihood": xr.Dataset({"answers": ((*sample, "preference"), log_likelihood)}, coordinates),
            "/observed_data": xr.Dataset({"answers": ("preference", np.ones(number, dtype=np.int8))}),
            "/constant_data": xr.Dataset({"differences": (("preference", "feature"), differences)}),
        }
    )


def stored(tree: xr.DataTree) -> xr.DataTree:
    """The tree without the lazy `posterior["utility_weights"]`, for `to_netcdf`; `restored` brings it back."""
    small = tree.copy()
    small["posterior"] = xr.DataTree(tree["posterior"].to_dataset().drop_vars("utility_weights", errors="ignore"))
    return small


def restored(tree: xr.DataTree) -> xr.DataTree:
    """A tree read back from disk, with its lazy `posterior["utility_weights"]` again."""
    whole = tree.copy()
    factors = low_rank(tree["constant_data"]["differences"].values)
    posterior = tree["posterior"].to_dataset()
    lazy = UtilityWeights(
        posterior["coordinates"].values,
        factors.basis,
        prior_scale=float(tree.attrs["prior_scale"]),
        seed=int(tree.attrs["seed"]),
    )
    posterior["utility_weights"] = xr.Variable(("chain", "draw", "feature"), indexing.LazilyIndexedArray(lazy))
    whole["posterior"] = xr.DataTree(posterior)
    return whole
