"""The weighted samples (sᵢ, aᵢ, wᵢ) that a policy is fitted to (paper, eq. 14), checked."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped
from numpy.typing import ArrayLike

from bayespbrl.kernels import beyond_rounding


@dataclass(frozen=True)
class WeightedSamples:
    """Samples of a policy fit, with the base weights already multiplied in.

    Attributes:
      observations, actions: vectors, shape (N, S) or (N, A), or integers, shape (N,), where discrete.
      weights: N·Wᵢ·wᵢ with Σ Wᵢ = 1, i.e. wᵢ itself where the base weights are uniform; mean 1 if w has mean 1 under W.
        All positive: samples without weight are left out, so that they change nothing that is drawn at random.
    """

    observations: Shaped[np.ndarray, "n ..."]
    actions: Shaped[np.ndarray, "n ..."]
    weights: Float[np.ndarray, " n"]


def weighted_samples(
    observations: Shaped[np.ndarray, "_ ..."],
    actions: Shaped[np.ndarray, "_ ..."],
    sample_weights: ArrayLike,
    base_weights: ArrayLike | None,
) -> WeightedSamples:
    """Check the weights of `Policy.fit` and multiply them; observations and actions come checked.

    Raises:
      ValueError: lengths that differ, no samples, a weight out of range, or weights without any mass.
    """
    number = len(observations)
    if number == 0 or len(actions) != number:
        raise ValueError(
            f"actions: expected as many rows as observations, at least one, got {len(actions)} and {number}"
        )
    weights = _checked_weights("sample_weights", sample_weights, number)
    if base_weights is not None:
        base = _checked_weights("base_weights", base_weights, number)
        weights = weights * base * (number / base.sum())  # pᵢ = Wᵢwᵢ of eq. 14, times N
        if not weights.sum() > 0:
            raise ValueError(
                "sample_weights: expected a positive weight where base_weights are positive, got only zeros there"
            )
    kept = weights > 0
    return WeightedSamples(observations[kept], actions[kept], weights[kept])


def location_and_deviation(
    observations: Float[np.ndarray, "n s"], shares: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, " s"]]:
    """Weighted mean and standard deviation of each dimension; zero where it is constant but for rounding."""
    location = shares @ observations
    deviation = np.sqrt(shares @ np.square(observations - location))
    return location, beyond_rounding(deviation, observations)


def _checked_weights(name: str, weights: ArrayLike, number: int) -> Float[np.ndarray, " n"]:
    weights = np.asarray(weights, dtype=np.float64)
    if weights.shape != (number,):
        raise ValueError(f"{name}: expected shape ({number},), got {weights.shape}")
    if not np.isfinite(weights).all() or weights.min() < 0:
        raise ValueError(
            f"{name}: expected finite numbers >= 0, got {weights[~(np.isfinite(weights) & (weights >= 0))][0]}"
        )
    if not weights.sum() > 0:
        raise ValueError(f"{name}: expected at least one positive weight, got {number} zeros")
    return weights
