"""Least-squares temporal differences with ℓ2–ℓ2 regularisation (paper, step 2: estimating the Q-function)."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class TransitionSums:
    """All that LSTD asks of N transitions: sums over them, which add up over blocks.

    Attributes:
      gram: ΦᵀΦ, shape (Q, Q).
      cross: ΦᵀΦ′, shape (Q, Q).
      target: Φᵀu, shape (Q,), or (Q, n) for n utilities side by side.
    """

    gram: np.ndarray
    cross: np.ndarray
    target: np.ndarray

    def __add__(self, other: "TransitionSums") -> "TransitionSums":
        return TransitionSums(self.gram + other.gram, self.cross + other.cross, self.target + other.target)


def transition_sums(features: np.ndarray, next_features: np.ndarray, utilities: np.ndarray) -> TransitionSums:
    """The sums of some transitions; arguments, and errors about their shapes, as of `lstd_q`."""
    if (
        features.shape != next_features.shape
        or utilities.shape[:1] != features.shape[:1]
        or utilities.ndim not in (1, 2)
    ):
        raise ValueError(
            "transitions: expected features and next_features (N, Q) and utilities (N,) or (N, n), got "
            f"{features.shape}, {next_features.shape} and {utilities.shape}"
        )
    return TransitionSums(features.T @ features, features.T @ next_features, features.T @ utilities)


def lstd_q(
    features: np.ndarray,
    next_features: np.ndarray,
    utilities: np.ndarray,
    *,
    discount: float,
    fixed_point_ridge: float,
    projection_ridge: float,
) -> np.ndarray:
    """Weights θ of Q(s, a) = φ(s, a)ᵀθ by regularised least-squares temporal differences.

    For transitions whose features are in memory at once; the learner adds up `transition_sums` block by block.

    Args:
      features: φ(sᵢ, aᵢ), shape (N, Q).
      next_features: φ(sᵢ′, aᵢ′) with aᵢ′ from the current policy; zero where sᵢ′ is terminal. Shape (N, Q).
      utilities: uᵢ, shape (N,); or n of them a transition, (N, n), which one solution serves: θ is linear in u.
      discount, fixed_point_ridge, projection_ridge: as of `solve_lstd`, which has the source too.

    Returns:
      θ, shape (Q,), or (Q, n).

    Raises:
      ValueError: shapes that do not fit, a discount outside [0, 1), a negative penalty, an entry that is not finite.
    """
    return solve_lstd(
        transition_sums(features, next_features, utilities),
        discount=discount,
        fixed_point_ridge=fixed_point_ridge,
        projection_ridge=projection_ridge,
    )


def solve_lstd(
    sums: TransitionSums, *, discount: float, fixed_point_ridge: float, projection_ridge: float
) -> np.ndarray:
    """`lstd_q` from the sums over the transitions, however many there are. Cost O(Q³).

    With G = ΦᵀΦ and P = (G + β₂I)⁻¹ the projection is Σ = PΦᵀ, so that X = Φ − γΦΣΦ′ = ΦM with
    M = I − γPΦᵀΦ′, and everything follows from two Gram matrices: nothing N × N is formed.

    Args:
      sums: of all transitions.
      discount: γ in [0, 1).
      fixed_point_ridge: β₁ ≥ 0, the penalty on θ.
      projection_ridge: β₂ ≥ 0, the penalty on the projection. β₁ = β₂ = 0 is ordinary LSTD.

    Source: Hoffman, Lazaric, Ghavamzadeh and Munos (2012), "Regularized least squares temporal difference learning
    with nested ℓ2 and ℓ1 penalization", the ℓ2–ℓ2 case; paper, step 2.
    """
    if not 0 <= discount < 1:
        raise ValueError(f"discount: expected a number in [0, 1), got {discount}")
    if fixed_point_ridge < 0 or projection_ridge < 0:
        raise ValueError(f"ridge: expected penalties >= 0, got {fixed_point_ridge} and {projection_ridge}")
    gram, cross, target = sums.gram, sums.cross, sums.target
    if not (np.all(np.isfinite(gram)) and np.all(np.isfinite(cross)) and np.all(np.isfinite(target))):
        raise ValueError("transitions: expected finite features and utilities, got NaN or infinity")
    size = len(gram)
    projected = _solve_symmetric(gram, projection_ridge, np.column_stack([cross, target]))
    mixing = np.eye(size) - discount * projected[:, :size]  # M: X = ΦM
    normal = mixing.T @ gram @ mixing  # XᵀX
    projected_target = projected[:, size] if target.ndim == 1 else projected[:, size:]
    return _solve_symmetric(normal, fixed_point_ridge, mixing.T @ (gram @ projected_target))


def _solve_symmetric(matrix: np.ndarray, ridge: float, right: np.ndarray) -> np.ndarray:
    """Solve (matrix + ridge·I) x = right for a positive semi-definite matrix; least norm where it is singular.

    By NumPy, though SciPy would solve it with its Cholesky factor: SciPy brings a second BLAS, whose idle threads spin
    and slow down all that follows (a Bicycle run, two cores: 34.7 s with it, 30.7 s without).
    """
    ridged = matrix + ridge * np.eye(len(matrix))
    try:
        np.linalg.cholesky(ridged)  # an error where it is not positive definite
        return np.linalg.solve(ridged, right)
    except np.linalg.LinAlgError:
        # features that never occurred leave zero rows, and rounding can make a tiny eigenvalue negative
        values, vectors = np.linalg.eigh(ridged)
        keep = values > 1e-12 * max(values[-1], np.finfo(float).tiny)
        return vectors[:, keep] @ ((vectors[:, keep].T @ right) / values[keep].reshape(-1, *[1] * (right.ndim - 1)))
