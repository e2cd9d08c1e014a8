"""The weighted samples (sᵢ, aᵢ, wᵢ) that a policy is fitted to (eq. 14), checked."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class WeightedSamples:
    """Samples of a policy fit, with the base weights already multiplied in.

    Attributes:
      observations: shape (N, S) float64, or (N,) int64 where discrete.
      actions: shape (N, A) float64, or (N,) int64 where discrete.
      weights: N·Wᵢ·wᵢ with Σ Wᵢ = 1, i.e. wᵢ itself where the base weights are uniform; mean 1 if w has mean 1 under W.
        All positive: samples without weight are left out, so that they cannot even change what is drawn at random.
    """

    observations: np.ndarray
    actions: np.ndarray
    weights: np.ndarray


def weighted_samples(
    observations: np.ndarray,
    actions: np.ndarray,
    sample_weights: np.ndarray,
    base_weights: np.ndarray | None,
    *,
    number_of_states: int | None = None,
    number_of_actions: int | None = None,
    observation_dimension: int | None = None,
    action_dimension: int | None = None,
) -> WeightedSamples:
    """Check the arguments of `Policy.fit` and multiply base and sample weights.

    Give `number_of_states` for discrete observations and `observation_dimension` for continuous ones; likewise actions.

    Raises:
      ValueError: naming the argument whose shape, range or finiteness is wrong, or weights without any mass.
    """
    observations = _checked("observations", observations, number_of_states, observation_dimension)
    actions = _checked("actions", actions, number_of_actions, action_dimension)
    number = len(observations)
    if number == 0 or len(actions) != number:
        raise ValueError(
            f"actions: expected one row for each of at least one observation, got {len(actions)} actions "
            f"for {number} observations"
        )
    weights = _checked_weights("sample_weights", sample_weights, number)
    if base_weights is not None:
        base = _checked_weights("base_weights", base_weights, number)
        weights = weights * base * (number / base.sum())
        if not weights.sum() > 0:
            raise ValueError("sample_weights: expected some mass where base_weights have some, got none")
    kept = weights > 0
    return WeightedSamples(observations[kept], actions[kept], weights[kept])


def _checked(name: str, values: np.ndarray, count: int | None, dimension: int | None) -> np.ndarray:
    values = np.asarray(values)
    if count is not None:
        if values.ndim != 1 or not np.issubdtype(values.dtype, np.integer):
            raise ValueError(f"{name}: expected integers of shape (N,), got {values.dtype} of shape {values.shape}")
        if values.size and (values.min() < 0 or values.max() >= count):
            raise ValueError(f"{name}: expected values in 0 … {count - 1}, got {values.min()} … {values.max()}")
        return values.astype(np.int64)
    if values.ndim != 2 or (dimension is not None and values.shape[1] != dimension):
        raise ValueError(f"{name}: expected shape (N, {dimension}), got {values.shape}")
    values = values.astype(np.float64)
    if not np.isfinite(values).all():
        raise ValueError(f"{name}: expected finite numbers, got NaN or infinity")
    return values


def _checked_weights(name: str, weights: np.ndarray, number: int) -> np.ndarray:
    weights = np.asarray(weights, dtype=np.float64)
    if weights.shape != (number,):
        raise ValueError(f"{name}: expected shape ({number},), got {weights.shape}")
    if not np.isfinite(weights).all() or weights.min() < 0:
        raise ValueError(f"{name}: expected finite numbers ≥ 0, got NaN, infinity or a negative weight")
    if not weights.sum() > 0:
        raise ValueError(f"{name}: expected at least one positive weight, got none")
    return weights
