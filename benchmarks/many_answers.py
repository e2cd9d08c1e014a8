"""Effective draws a second of our posterior and of numpyro's NUTS on the same model, against K and D; or ours alone.

    python benchmarks/many_answers.py --seed 3104 --out benchmarks/results/many-answers-nuts.csv
    python benchmarks/many_answers.py --alone --answers 300 1000 --features 20 0 --tosses 0 0.2 --out FILE.csv

Logistic answers (steepness 5, prior scale 1) to pairs of a thousand items with Gaussian features. Both samplers run in
one process, first with compilation and then without; a figure is the smallest effective sample size of all margins over
the seconds of everything, warm-up and diagnosis included. Sizes that are padded to the same share what is compiled of
ours, so that only the first of them compiles. Prints and writes a table, one line for each K and D.

With `--alone`, the seconds until our posterior converges, of a likelihood that NUTS cannot follow: eq. 8, steepness and
lapse rate inferred, a share `--tosses` of the answers given at random. D = 0 stands for one-hot features of the items.
"""

import argparse
import csv
import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpyro.infer import MCMC, NUTS

from bayespbrl.models import preference_model, sample_posterior
from bayespbrl.models.convergence import chain_convergence
from bayespbrl.models.likelihoods import Logistic
from bayespbrl.utility.comparisons import normalised

STEEPNESS, ITEMS, CHAINS = 5.0, 1000, 4


def answers(number: int, dimension: int, *, seed: int) -> np.ndarray:
    """Differences of the features of random pairs, the preferred item first, shape (K, D); margins of unit variance."""
    rng = np.random.default_rng([seed, number, dimension])
    items, weights = rng.normal(size=(ITEMS, dimension)), rng.normal(size=dimension)
    first = rng.integers(0, ITEMS, number)
    differences = items[first] - items[(first + rng.integers(1, ITEMS, number)) % ITEMS]
    differences /= np.sqrt(2 * dimension)
    right = rng.random(number) < 1 / (1 + np.exp(-STEEPNESS * differences @ weights))
    return differences * np.where(right, 1, -1)[:, None]


def tossed_answers(number: int, dimension: int, tosses: float, *, seed: int) -> np.ndarray:
    """As `answers`, but wrong by coin tosses alone, and the differences as the learner makes them; D = 0: one-hot."""
    rng = np.random.default_rng([seed, number, dimension])
    items = rng.normal(size=(ITEMS, dimension)) if dimension else np.eye(ITEMS)
    first = rng.integers(0, ITEMS, number)
    differences, _ = normalised(items[first] - items[(first + rng.integers(1, ITEMS, number)) % ITEMS])
    margins = differences @ rng.normal(size=items.shape[1])
    right = np.where(rng.random(number) < tosses, rng.random(number) < 0.5, True)
    return differences * np.where(right, np.sign(margins), -np.sign(margins))[:, None]


def ours(differences: np.ndarray, seed: int) -> np.ndarray:
    """Margins (chain, draw, K) of `sample_posterior`."""
    tree = sample_posterior(differences, steepness=STEEPNESS, likelihood="logistic", num_chains=CHAINS, seed=seed)
    return np.asarray(tree["posterior/margins"])


def theirs(*, draws: int) -> Callable[[np.ndarray, int], np.ndarray]:
    """NUTS in the space of w, as many draws of warm-up as of each chain; the compiled sampler is kept."""
    mcmc = MCMC(
        NUTS(preference_model),
        num_warmup=draws,
        num_samples=draws,
        num_chains=CHAINS,
        chain_method="vectorized",
        progress_bar=False,
    )
    likelihood = Logistic(STEEPNESS)

    def run(differences: np.ndarray, seed: int) -> np.ndarray:
        with jax.enable_x64(True):
            mcmc.run(jax.random.key(seed), differences, likelihood)
            return np.asarray(mcmc.get_samples(group_by_chain=True)["margins"])

    return run


def measured(run: Callable[[np.ndarray, int], np.ndarray], differences: np.ndarray, seed: int) -> dict[str, float]:
    """Figures of one sampler: with compilation, and of a second run without."""
    figures: dict[str, float] = {}
    for number, name in enumerate(("compiling", "compiled")):
        begin, cpu = time.perf_counter(), time.process_time()
        margins = run(differences, seed + number)
        report = chain_convergence(margins)
        seconds = time.perf_counter() - begin
        figures |= {
            f"seconds_{name}": seconds,
            f"cpu_seconds_{name}": time.process_time() - cpu,
            f"effective_per_second_{name}": report.effective_sample_size_min / seconds,
            "effective": report.effective_sample_size_min,
            "rhat": report.rhat_max,
        }
    return figures


def row(number: int, dimension: int, *, seed: int, draws: int) -> dict[str, Any]:
    """The line of one K and D."""
    differences = answers(number, dimension, seed=seed)
    samplers = {"ours": ours, "nuts": theirs(draws=draws)}
    line: dict[str, Any] = {"seed": seed, "answers": number, "features": dimension}
    for name, run in samplers.items():
        figures = measured(run, differences, seed)
        line |= {f"{name}_{key}": float(f"{value:.4g}") for key, value in figures.items()}
    for key in ("compiled", "compiling"):
        of = [line[f"{name}_effective_per_second_{key}"] for name in samplers]
        line[f"ratio_{key}"] = float(f"{of[0] / of[1]:.3g}")
    return line


def row_alone(number: int, dimension: int, tosses: float, *, seed: int) -> dict[str, Any]:
    """The line of one K, D and share of tosses: until all that is inferred has converged, in two runs."""
    differences = tossed_answers(number, dimension, tosses, seed=seed)
    line: dict[str, Any] = {"seed": seed, "answers": number, "features": dimension or "one-hot", "tosses": tosses}
    for run, name in enumerate(("compiling", "compiled")):
        begin, cpu = time.perf_counter(), time.process_time()
        tree = sample_posterior(differences, steepness=None, lapse_rate=None, num_chains=CHAINS, seed=seed + run)
        line |= {
            f"seconds_{name}": float(f"{time.perf_counter() - begin:.4g}"),
            f"cpu_seconds_{name}": float(f"{time.process_time() - cpu:.4g}"),
            f"converged_{name}": int(tree.attrs["converged"]),
            f"rhat_{name}": float(f"{tree.attrs['rhat_max']:.4g}"),
            f"effective_{name}": float(f"{tree.attrs['effective_sample_size_min']:.4g}"),
            f"draws_{name}": tree["posterior"].sizes["draw"],
        }
    return line


def main() -> None:
    """Print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--answers", type=int, nargs="+", default=[30, 300, 3000])
    parser.add_argument("--features", type=int, nargs="+", default=[5, 20, 100])
    parser.add_argument("--draws", type=int, default=500, help="of NUTS, a chain")
    parser.add_argument("--alone", action="store_true", help="ours, until it converges")
    parser.add_argument("--tosses", type=float, nargs="+", default=[0.0], help="shares, with --alone")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True, help="CSV file")
    options = parser.parse_args()
    with options.out.open("w", newline="") as file:
        writer = None
        for number, dimension, tosses in itertools.product(options.answers, options.features, options.tosses):
            if options.alone:
                line = row_alone(number, dimension, tosses, seed=options.seed)
            else:
                line = row(number, dimension, seed=options.seed, draws=options.draws)
            if writer is None:
                writer = csv.DictWriter(file, list(line), lineterminator="\n")
                writer.writeheader()
            writer.writerow(line)
            file.flush()
            print(line, flush=True)


if __name__ == "__main__":
    main()
