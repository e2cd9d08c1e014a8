"""The features of REPS' constraint on the state distribution (eq. 11), whitened, and the regression of Q on them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bayespbrl import checks

MANY_FEATURES = 1000  # from here on, columns that are zero everywhere, as of states never seen, are left out first
RANK_TOLERANCE = 1e-3  # share of the largest singular value
PerSample = Float[np.ndarray, " n"]  # one number per sample


@dataclass(frozen=True)
class WhitenedFeatures:
    """Features of the constraint, centred and of unit variance under W. They do not depend on the bound.

    Attributes:
      features: those that are kept.
      mapping: from the centred features as given to these.
    """

    features: Float[np.ndarray, "n r"]
    mapping: Float[np.ndarray, "d r"]


def whitened(
    state_features: Float[np.ndarray, "n d"], base_weights: PerSample, *, most: int | None = None
) -> WhitenedFeatures:
    """Features whitened under W, without directions below `RANK_TOLERANCE` of the largest singular value.

    None are kept where only rounding tells the samples apart.

    Args:
      state_features, base_weights: as in `reps_weights`.
      most: of the directions that are kept, those of the largest singular values; None: all.

    Raises:
      ValueError: entries that are not finite.
    """
    checks.finite("state_features", state_features)
    if state_features.shape[1] > MANY_FEATURES and 0 < np.sum(used := np.any(state_features, axis=0)) < len(used):
        few = whitened(state_features[:, used], base_weights, most=most)
        mapping = np.zeros((len(used), few.mapping.shape[1]))
        mapping[used] = few.mapping
        return WhitenedFeatures(few.features, mapping)
    centred = state_features - base_weights @ state_features  # φ − φ̂ of eq. 11
    covariance = centred.T @ (centred * base_weights[:, None])
    values, vectors = np.linalg.eigh(covariance)  # D × D, not the N × D singular values
    keep = values > max(values[-1], 0.0) * RANK_TOLERANCE**2
    rounding = (1e-12 * np.max(np.abs(state_features), initial=0.0)) ** 2
    if not np.any(keep) or values[-1] <= rounding:
        return WhitenedFeatures(np.zeros((len(centred), 0)), np.zeros((centred.shape[1], 0)))
    leading = slice(None if most is None else -most, None)  # the eigenvalues ascend
    mapping = (vectors[:, keep] / np.sqrt(values[keep]))[:, leading]
    return WhitenedFeatures(centred @ mapping, mapping)


def regressed(
    q_values: PerSample, features: Float[np.ndarray, "n r"], base_weights: PerSample
) -> tuple[PerSample, Float[np.ndarray, " r"], PerSample]:
    """Q centred, the weights of its regression on whitened features under W, and what that leaves."""
    centred = q_values - base_weights @ q_values
    of_states = features.T @ (base_weights * centred)
    return centred, of_states, centred - features @ of_states
