"""Weighted sparse Gaussian process regression: FITC with the noise σ²/wᵢ of each sample.

FITC: Snelson and Ghahramani (2006), Sparse Gaussian processes using pseudo-inputs. Weights: Kober, Oztop and Peters
(2010), Reinforcement learning to adjust robot movements to new situations. Everything is written in v(x) = L⁻¹r(x),
with r = k/s² the correlations of x with the M inducing points, s² the signal variance and LLᵀ = R_M:

  Λᵢᵢ = s²(1 − |vᵢ|²) + σ²/wᵢ ;  B/s² = L(I + s² VΛ⁻¹Vᵀ)Lᵀ ;  mean = s² vᵀ(I + s² VΛ⁻¹Vᵀ)⁻¹VΛ⁻¹y

which inverts nothing worse conditioned than L, and needs no sample's noise to be finite (wᵢ = 0 drops out). Only
NumPy's linear algebra is used: SciPy brings a second BLAS, whose idle threads slow small matrices down.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from bayespbrl.kernels import squared_exponential

JITTER = 1e-8  # relative to the signal variance; the kernel's rounding errors are near 1e-14
CANDIDATES = 2000  # rows among which the inducing points are chosen
PerSample = Float[np.ndarray, " n"]  # one number per sample


@dataclass(frozen=True, eq=False)
class SparseRegression:
    """The posterior of one output at any x, from the correlations r(x) with the inducing points.

    Attributes:
      mean_weights: mean(x) = r(x)ᵀ mean_weights.
      reduction: var(x) = s²(1 − |reduction · r(x)|²) + σ², and the norm stays below one.
    """

    mean_weights: Float[np.ndarray, " m"]
    reduction: Float[np.ndarray, "m m"]


def precisions(
    whitened: Float[np.ndarray, "m n"], weights: PerSample, *, signal_variance: float, noise_variance: float
) -> PerSample:
    """Λ⁻¹ (Snelson and Ghahramani 2006) with the noise σ²/w (Kober et al. 2010), as w/(w s²(1 − |v|²) + σ²)."""
    unexplained = np.maximum(1.0 - np.einsum("mn,mn->n", whitened, whitened), 0.0)
    return weights / (weights * (signal_variance * unexplained) + noise_variance)


def fit_sparse_regression(
    correlations: Float[np.ndarray, "m n"],
    inducing_correlations: Float[np.ndarray, "m m"],
    targets: PerSample,
    weights: PerSample,
    *,
    signal_variance: float,
    noise_variance: float,
) -> SparseRegression:
    """FITC posterior for a prior of mean zero. Cost O(NM²).

    Args:
      correlations: r(zₘ, xᵢ).
      inducing_correlations: r(zₘ, zₙ).
      targets, weights: yᵢ and wᵢ ≥ 0; a weight of two counts as two samples where Z is the data.
      signal_variance, noise_variance: s² and σ², > 0, in the square of the target's units.
    """
    inverse_lower = steady_inverse_factor(inducing_correlations)
    whitened = inverse_lower @ correlations
    precision = precisions(whitened, weights, signal_variance=signal_variance, noise_variance=noise_variance)
    scaled = whitened * precision
    information, rotation = np.linalg.eigh(signal_variance * (scaled @ whitened.T))  # UλUᵀ = s² VΛ⁻¹Vᵀ
    information = np.maximum(information, 0.0)
    back = inverse_lower.T @ rotation  # L⁻ᵀU
    projected = rotation.T @ (scaled @ targets)
    # Snelson and Ghahramani (2006), predictive mean: B⁻¹K_MN Λ⁻¹y
    mean_weights = signal_variance * (back @ (projected / (1.0 + information)))
    # Snelson and Ghahramani (2006), predictive variance: K_M⁻¹ − B⁻¹ = L⁻ᵀ(I − (I + UλUᵀ)⁻¹)L⁻¹/s², written as a
    # square, so that the variance cannot come out negative
    reduction = np.sqrt(information / (1.0 + information))[:, None] * back.T
    return SparseRegression(mean_weights, reduction)


def inducing_rows(
    points: Float[np.ndarray, "n e"], weights: PerSample, number: int, *, rng: np.random.Generator
) -> Int[np.ndarray, " m"]:
    """Rows of `points` as inducing points: where the weight lies, and no two where one would do.

    Randomly pivoted Cholesky (Chen, Epperly, Tropp and Webber 2023): each next row is drawn in proportion to the prior
    variance that the rows before it leave unexplained, among `CANDIDATES` rows drawn in proportion to their weight.

    Args:
      points: scaled kernel coordinates.
      weights: > 0.
      number: M; fewer rows come back where they already explain every candidate.
    """
    # Kool, van Hoof & Welling (2019): the largest keys are a draw by weight without replacement
    keys = np.log(weights) + rng.gumbel(size=len(weights))
    size = min(CANDIDATES, len(points))
    chosen = np.sort(np.argpartition(-keys, size - 1)[:size])
    pool = points[chosen]
    unexplained = np.ones(size)
    factors = np.empty((min(number, size), size))
    pivots: list[int] = []
    while len(pivots) < len(factors) and unexplained.max() > JITTER:
        rank = len(pivots)
        cumulative = np.cumsum(unexplained)
        # Chen et al. (2023): a pivot drawn by the residual diagonal, then a column of the partial Cholesky factor
        pivot = int(np.searchsorted(cumulative, rng.random() * cumulative[-1], side="right"))
        pivot = min(pivot, size - 1)
        column = squared_exponential(pool, pool[pivot : pivot + 1])[:, 0]
        column -= factors[:rank, pivot] @ factors[:rank]
        if column[pivot] <= JITTER:  # rounding: this row is explained already
            unexplained[pivot] = 0.0
            continue
        factors[rank] = column / np.sqrt(column[pivot])
        unexplained = np.maximum(unexplained - np.square(factors[rank]), 0.0)
        unexplained[pivot] = 0.0
        pivots.append(pivot)
    return chosen[pivots]


def inverse_factor(inducing_correlations: Float[np.ndarray, "m m"], jitter: float = JITTER) -> Float[np.ndarray, "m m"]:
    """L⁻¹ with LLᵀ = R_M + jitter; the usual jitter bounds the condition of L by about 1e5."""
    jittered = inducing_correlations + jitter * np.eye(len(inducing_correlations))
    return np.linalg.inv(np.linalg.cholesky(jittered))


def steady_inverse_factor(inducing_correlations: Float[np.ndarray, "m m"]) -> Float[np.ndarray, "m m"]:
    """`inverse_factor` with as much jitter as rounding asks for.

    The squared distance of two points thousands of bandwidths from the others is rounded by more than `JITTER`.
    """
    jitter = JITTER
    while jitter < 1.0:
        try:
            return inverse_factor(inducing_correlations, jitter)
        except np.linalg.LinAlgError:
            jitter *= 10.0
    return inverse_factor(inducing_correlations, 1.0)
