"""Effective draws a second of our posterior and of blackjax's elliptical slice sampler on the same posterior.

    python benchmarks/elliptical_slice.py --differences differences.npy [--steepness 5] [--prior-scale 1]
    python benchmarks/elliptical_slice.py --scaling

The differences are divided by their largest absolute entry. Prints one JSON line. `--scaling` prints a table of seconds
to convergence against K and D instead, on differences of random smooth trajectories.
"""

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

import blackjax
import jax
import jax.numpy as jnp
import numpy as np

from bayespbrl.models import sample_posterior
from bayespbrl.models.convergence import chain_convergence
from bayespbrl.models.likelihoods import Mixed, total_log_prob

DRAWS = 1000  # of each chain, by one call of blackjax's compiled sampler


def report(margins: np.ndarray, seconds: float, compile_seconds: float) -> dict[str, Any]:
    """The figures of one sampler, from margins of shape (chain, draw, K)."""
    diagnosis = chain_convergence(margins)
    return {
        "draws": int(margins.shape[0] * margins.shape[1]),
        "seconds": seconds,
        "compile_seconds": compile_seconds,
        "min_effective_sample_size": diagnosis.effective_sample_size_min,
        "max_rhat": diagnosis.rhat_max,
        "effective_draws_per_second": diagnosis.effective_sample_size_min / seconds,
    }


def ours(differences: np.ndarray, *, seed: int, **settings: Any) -> dict[str, Any]:
    """The figures of `sample_posterior`, convergence checks included: the run of median speed among three."""

    def run(seed: int) -> tuple[np.ndarray, float]:
        begin = time.perf_counter()
        tree = sample_posterior(differences, seed=seed, **settings)
        return np.asarray(tree["posterior/margins"]), time.perf_counter() - begin

    _, first = run(seed)
    runs = [run(seed + i) for i in range(3)]
    reports = [report(margins, seconds, max(first - seconds, 0.0)) for margins, seconds in runs]
    return sorted(reports, key=lambda figures: figures["effective_draws_per_second"])[1]


def theirs(
    differences: np.ndarray, *, steepness: float, prior_scale: float, num_chains: int, seed: int, max_seconds: float
) -> dict[str, Any]:
    """The figures of blackjax in the space of w, jitted, chains vectorised, until 100 effective draws.

    Args:
      differences: shape (K, D).
      steepness, prior_scale, num_chains, seed: as of `sample_posterior`.
      max_seconds: give up after so long.
    """
    number, dimension = differences.shape
    likelihood, used = Mixed(steepness, float(number)), jnp.any(differences != 0, axis=1)
    matrix = jnp.asarray(differences)
    kernel = blackjax.elliptical_slice(
        lambda w: total_log_prob(likelihood, matrix @ w, used),
        mean=jnp.zeros(dimension),
        cov=prior_scale**2 * jnp.ones(dimension),
    )

    @jax.jit
    def advance(key: jax.Array, states: Any) -> tuple[Any, jax.Array]:
        """DRAWS draws of each chain: the last states and the margins."""

        def chain(key: jax.Array, state: Any) -> tuple[Any, jax.Array]:
            def step(state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
                state, _ = kernel.step(key, state)
                return state, matrix @ state.position

            return jax.lax.scan(step, state, jax.random.split(key, DRAWS))

        return jax.vmap(chain)(jax.random.split(key, num_chains), states)

    key_start, key_compile, key_run = jax.random.split(jax.random.key(seed), 3)
    start = prior_scale * jax.random.normal(key_start, (num_chains, dimension))
    states = jax.vmap(kernel.init)(start)
    begin = time.perf_counter()
    jax.block_until_ready(advance(key_compile, states))
    first = time.perf_counter() - begin
    margins, seconds, chunks = until_effective(advance, states, key_run, max_seconds=max_seconds)
    return report(margins, seconds, max(first - seconds / chunks, 0.0))


def until_effective(
    advance: Callable[[jax.Array, Any], tuple[Any, jax.Array]], states: Any, key: jax.Array, *, max_seconds: float
) -> tuple[np.ndarray, float, int]:
    """Call `advance` until the smallest effective sample size is 100; checked after 2, 3, 5, 9, … calls.

    Returns:
      margins (chain, draw, K) of all calls but the first, which is the burn-in; seconds and number of all calls.
    """
    drawn: list[np.ndarray] = []
    seconds, check = 0.0, 1
    while True:
        begin = time.perf_counter()
        states, margins = jax.block_until_ready(advance(jax.random.fold_in(key, len(drawn)), states))
        seconds += time.perf_counter() - begin
        drawn.append(np.asarray(margins))
        if len(drawn) > check:
            check *= 2
            kept = np.concatenate(drawn[1:], axis=1)
            if chain_convergence(kept).effective_sample_size_min >= 100 or seconds > max_seconds:
                return kept, seconds, len(drawn)


def smooth_differences(number: int, dimension: int, *, seed: int, answers: bool = True) -> np.ndarray:
    """Differences of discounted radial basis features of random smooth trajectories on a circle × a line, shape (K, D).

    Args:
      number: K.
      dimension: D.
      seed: of everything random.
      answers: whether a smooth utility orders each pair, so that the rows are consistent answers.
    """
    rng = np.random.default_rng(seed)
    steps = np.arange(61)
    frequencies = rng.uniform(0.02, 0.3, (2 * number, 4, 1))
    amplitudes = rng.normal(0, 1.2, (2 * number, 4, 1))
    phase = rng.uniform(0, 2 * np.pi, (2 * number, 4, 1))
    waves = amplitudes * np.sin(frequencies * steps + phase)
    angle, speed = np.pi + waves[:, :2].sum(axis=1), waves[:, 2:].sum(axis=1)
    pick = rng.integers(0, angle.size, dimension)
    centre_angle, centre_speed = angle.ravel()[pick], speed.ravel()[pick]
    features = np.zeros((2 * number, dimension))
    for t in range(1, 61):
        circle = (np.cos(angle[:, t, None] - centre_angle) - 1) / 0.4**2
        features += 0.98**t * np.exp(circle - 0.5 * ((speed[:, t, None] - centre_speed) / 0.4) ** 2)
    utility = np.cos(centre_angle) - 0.1 * centre_speed**2
    differences = features[:number] - features[number:]
    signs = np.sign(differences @ utility) if answers else 1.0
    differences *= np.reshape(signs, (-1, 1))
    return differences / np.abs(differences).max()


def timed(differences: np.ndarray, draws: int, **arguments: Any) -> float:
    """Seconds of `sample_posterior` for a fixed number of draws a chain, converged or not."""
    begin = time.perf_counter()
    sample_posterior(differences, num_samples=draws, max_samples=draws, **arguments)
    return time.perf_counter() - begin


def scaling(*, seed: int, **settings: Any) -> None:
    """Print seconds to convergence, compilation excluded, against K at D = 700 and D at K = 41, and the cost of a draw.

    The cost of a draw is the time of 3000 further draws of each chain, divided by all of them.
    """
    print("|    K |     D | seconds | draws | effective |  R̂ | converged | µs a draw |")
    print("|-----:|------:|--------:|------:|----------:|----:|:----------|----------:|")
    sizes = [(k, 700) for k in (5, 10, 20, 41, 80, 160, 320)] + [(41, d) for d in (100, 2000, 20_000)]
    for number, dimension in sizes:
        differences = smooth_differences(number, dimension, seed=seed)
        sample_posterior(differences, num_samples=1000, num_warmup=0, max_samples=1000, **settings)
        begin = time.perf_counter()
        tree = sample_posterior(differences, seed=seed, **settings)
        seconds = time.perf_counter() - begin
        short, long = (timed(differences, draws, seed=seed, **settings) for draws in (1000, 4000))
        a = tree.attrs
        print(
            f"| {number:4d} | {dimension:5d} | {seconds:7.2f} | {tree['posterior'].sizes['draw']:5d} "
            f"| {a['effective_sample_size_min']:9.0f} | {a['rhat_max']:.3f} | {bool(a['converged'])!s:9} "
            f"| {(long - short) / 3000 / settings['num_chains'] * 1e6:9.1f} |",
            flush=True,
        )


def main() -> None:
    """Print one JSON line, or the scaling table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--differences", help="NumPy file, shape (K, D)")
    parser.add_argument("--steepness", type=float, default=5.0)
    parser.add_argument("--prior-scale", type=float, default=1.0)
    parser.add_argument("--chains", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--max-seconds", type=float, default=600.0, help="give up on blackjax after this long")
    parser.add_argument("--scaling", action="store_true", help="print the scaling table instead")
    options = parser.parse_args()
    if not options.scaling and not options.differences:
        parser.error("expected --differences FILE or --scaling")
    settings = {
        "steepness": options.steepness,
        "prior_scale": options.prior_scale,
        "num_chains": options.chains,
        "seed": options.seed,
    }
    if options.scaling:
        scaling(**settings)
        return
    differences = np.load(options.differences)
    differences = differences / np.abs(differences).max()
    with jax.enable_x64(True):
        mine = ours(differences, **settings)
        other = theirs(differences, **settings, max_seconds=options.max_seconds)
    ratio = mine["effective_draws_per_second"] / other["effective_draws_per_second"]
    print(json.dumps({"ours": mine, "blackjax": other, "ratio": ratio}))


if __name__ == "__main__":
    main()
