"""The posterior's margins by another algorithm: tempered sequential Monte Carlo in NumPy (Del Moral et al. 2006).

    python benchmarks/reference_posterior.py --differences differences.npy [--steepness 5] [--prior-scale 1]

Particles from the prior pass through likelihood powers 0 → 1, chosen so that half of them survive each resampling.
Random-walk steps with the particles' own covariance move them. Independent runs give the Monte Carlo error. Nothing of
the sampler under test is used: no ellipse, no low-rank factorisation, no expectation propagation.

Prints one JSON line: the distance between the posterior means of the margins by `sample_posterior` and by the
reference, in Monte Carlo errors, and the log marginal likelihood by both.
"""

import argparse
import json
from typing import Any

import numpy as np
from scipy.special import log_expit, logsumexp

from bayespbrl.models import sample_posterior
from bayespbrl.models.convergence import chain_convergence


def log_likelihood(margins: np.ndarray, *, steepness: float) -> np.ndarray:
    """Σ_k log p_k by eq. 8, written independently of the package; margins of shape (N, K)."""
    number = margins.shape[1]
    smooth = log_expit(steepness * margins)
    step = np.where(margins > 0, np.log(max(number - 1, 1e-300)), -np.inf)
    log_p = np.logaddexp(step, smooth) - np.log(number)  # eq. 8
    return np.sum(np.where(margins == 0, np.log(0.5), log_p), axis=1)


def tempered(
    loadings: np.ndarray, *, steepness: float, prior_scale: float, particles: int, moves: int, seed: int
) -> tuple[np.ndarray, float]:
    """Posterior means of t = L z, shape (K,), and the log marginal likelihood, of one run."""
    rng = np.random.default_rng(seed)
    z = prior_scale * rng.standard_normal((particles, loadings.shape[1]))
    value = log_likelihood(z @ loadings.T, steepness=steepness)
    power, evidence, step = 0.0, 0.0, 0.5
    while power < 1:
        new = next_power(value, power)
        weights = (new - power) * value
        evidence += logsumexp(weights) - np.log(particles)  # Del Moral et al. (2006): ratio of normalising constants
        weights = np.exp(weights - logsumexp(weights))
        chosen = np.searchsorted(np.cumsum(weights), (np.arange(particles) + rng.uniform()) / particles)
        z, value = z[np.minimum(chosen, particles - 1)], value[np.minimum(chosen, particles - 1)]
        power = new
        for move in range(moves * (5 if power == 1 else 1)):
            if move % 10 == 0:
                root = np.linalg.cholesky(np.atleast_2d(np.cov(z.T)) + 1e-14 * np.eye(z.shape[1]))
            proposal = z + step * rng.standard_normal(z.shape) @ root.T
            proposed = log_likelihood(proposal @ loadings.T, steepness=steepness)
            prior = 0.5 * (np.sum(z**2, axis=1) - np.sum(proposal**2, axis=1)) / prior_scale**2
            accept = np.log(rng.uniform(size=particles)) < power * (proposed - value) + prior
            z[accept], value[accept] = proposal[accept], proposed[accept]
            step *= np.exp(0.3 * (np.mean(accept) - 0.25))
    return (z @ loadings.T).mean(axis=0), float(evidence)


def next_power(value: np.ndarray, power: float) -> float:
    """The power at which half of the particles survive, at most 1, by bisection; `value` is their log likelihood."""
    low, high = power, 1.0
    for _ in range(50):
        middle = (low + high) / 2
        weights = (middle - power) * value
        survivors = np.exp(2 * logsumexp(weights) - logsumexp(2 * weights))  # effective sample size (Kish 1965)
        low, high = (middle, high) if survivors > len(value) / 2 else (low, middle)
    return 1.0 if high > 1 - 1e-6 else low


def row_space(differences: np.ndarray) -> np.ndarray:
    """The differences in an orthonormal basis of their row space, shape (K, rank); zero rows stay exactly zero."""
    used = np.any(differences != 0, axis=1)
    basis = np.linalg.qr(differences[used].T)[0]
    loadings = np.zeros((len(differences), basis.shape[1]))
    loadings[used] = differences[used] @ basis
    return loadings


def compared(differences: np.ndarray, runs: list[tuple[np.ndarray, float]], **settings: Any) -> dict[str, Any]:
    """Our posterior beside runs of the reference, as in the JSON line."""
    means, evidence = np.array([run[0] for run in runs]), np.array([run[1] for run in runs])
    tree = sample_posterior(differences, num_samples=4000, **settings)
    margins = np.asarray(tree["posterior/margins"])
    error = np.hypot(means.std(axis=0, ddof=1) / np.sqrt(len(runs)), chain_convergence(margins).monte_carlo_error)
    difference = np.abs(margins.mean(axis=(0, 1)) - means.mean(axis=0))
    distance = difference / np.where(error > 0, error, 1.0)
    deviations = difference / np.maximum(margins.std(axis=(0, 1)), 1e-300)
    return {
        "largest_distance_in_errors": float(distance.max()),
        "root_mean_square_distance": float(np.sqrt(np.mean(distance**2))),
        "largest_distance_in_standard_deviations": float(np.max(deviations)),
        "within_4": bool(distance.max() < 4),
        "log_evidence_reference": float(evidence.mean()),
        "log_evidence_reference_error": float(evidence.std(ddof=1) / np.sqrt(len(runs))),
        "log_evidence_ours": tree.attrs["log_evidence"],
    }


def main() -> None:
    """Run both, then print one JSON line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--differences", required=True, help="NumPy file, shape (K, D)")
    parser.add_argument("--steepness", type=float, default=5.0)
    parser.add_argument("--prior-scale", type=float, default=1.0)
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--moves", type=int, default=150)
    parser.add_argument("--runs", type=int, default=12)
    options = parser.parse_args()
    differences = np.load(options.differences)
    differences = differences / np.abs(differences).max()
    settings = {"steepness": options.steepness, "prior_scale": options.prior_scale}
    sizes = {"particles": options.particles, "moves": options.moves}
    runs = [tempered(row_space(differences), **settings, **sizes, seed=seed) for seed in range(options.runs)]
    print(json.dumps(compared(differences, runs, **settings)))


if __name__ == "__main__":
    main()
