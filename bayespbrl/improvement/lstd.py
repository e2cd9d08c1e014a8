"""Least-squares temporal differences (Boyan 1999), ℓ2–ℓ2 regularised (paper, step 2: estimating the Q-function)."""

from contextlib import suppress
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.sparse.linalg import splu

from bayespbrl import checks

Targets = Float[np.ndarray, " q"] | Float[np.ndarray, "q n"]  # of one utility, or of n side by side
SparseArray = Any  # a `scipy.sparse.csr_array`, which has no types
Gram = Float[np.ndarray, "q q"] | SparseArray
# From so many features on, sums that are nearly all zero are kept as sparse arrays: those of the pairs of a large table
# of states and actions, whose dense algebra takes ten seconds a solution with 3000 pairs. Where next states are few and
# near, as on a grid, a sparse solution takes a tenth of that; where they are drawn at random, about as long.
WIDE = 1000
MOST_FILLED = 0.02  # share of the entries that are not zero
LEAST_RIDGE = 1e-13  # in the largest number of occurrences; with less the sparse solution is rounding


@dataclass(frozen=True, eq=False)
class TransitionSums:
    """Sufficient statistics of transitions for LSTD; those of two blocks add up.

    Attributes:
      gram: ΦᵀΦ.
      cross: ΦᵀΦ′.
      target: Φᵀu.
    """

    gram: Gram
    cross: Gram
    target: Targets

    def __add__(self, other: "TransitionSums") -> "TransitionSums":
        return TransitionSums(self.gram + other.gram, self.cross + other.cross, self.target + other.target)


def transition_sums(features: ArrayLike, next_features: ArrayLike, utilities: ArrayLike) -> TransitionSums:
    """The sums over N transitions.

    Args:
      features: φ(sᵢ, aᵢ), shape (N, Q).
      next_features: φ(sᵢ′, aᵢ′) with aᵢ′ from the current policy; zero where sᵢ′ is terminal. Shape (N, Q).
      utilities: uᵢ, shape (N,); or n of them a transition, (N, n), which one solution serves: θ is linear in u.

    Raises:
      ValueError: shapes that do not fit.
    """
    given = (features, next_features, utilities)
    features, next_features, utilities = (np.asarray(each, dtype=np.float64) for each in given)  # sums of bytes wrap
    if (
        features.shape != next_features.shape
        or utilities.shape[:1] != features.shape[:1]
        or utilities.ndim not in (1, 2)
    ):
        raise ValueError(
            "transitions: expected features and next_features (N, Q) and utilities (N,) or (N, n), got "
            f"{features.shape}, {next_features.shape} and {utilities.shape}"
        )
    if _wide_and_empty(features) and _wide_and_empty(next_features):
        rows, next_rows = sparse.csr_array(features), sparse.csr_array(next_features)
        gram, cross = (rows.T @ rows).tocsr(), (rows.T @ next_rows).tocsr()
        if gram.nnz + cross.nnz <= MOST_FILLED * features.shape[1] ** 2:
            return TransitionSums(gram, cross, rows.T @ utilities)
    return TransitionSums(features.T @ features, features.T @ next_features, features.T @ utilities)


def _wide_and_empty(features: Float[np.ndarray, "n q"]) -> bool:
    return features.shape[1] >= WIDE and bool(np.count_nonzero(features) <= MOST_FILLED * features.size)


def solve_lstd(sums: TransitionSums, *, discount: float, fixed_point_ridge: float, projection_ridge: float) -> Targets:
    """Weights θ of Q(s, a) = φ(s, a)ᵀθ by regularised least-squares temporal differences, O(Q³) where not sparse.

    With G = ΦᵀΦ and P = (G + β₂I)⁻¹ the projection is Σ = PΦᵀ, so that X = Φ − γΦΣΦ′ = ΦM with
    M = I − γPΦᵀΦ′, and everything follows from two Gram matrices: nothing N × N is formed.

    Args:
      sums: of all transitions.
      discount: γ in [0, 1).
      fixed_point_ridge: β₁ ≥ 0, the penalty on θ.
      projection_ridge: β₂ ≥ 0, the penalty on the projection. β₁ = β₂ = 0 is ordinary LSTD.

    Raises:
      ValueError: an option out of its range, or sums that are not finite.

    Source: Hoffman, Lazaric, Ghavamzadeh and Munos (2012), "Regularized least squares temporal difference learning
    with nested ℓ2 and ℓ1 penalization", the ℓ2–ℓ2 case; paper, step 2.
    """
    checks.share("discount", discount, below_one=True)
    checks.non_negative("fixed_point_ridge", fixed_point_ridge)
    checks.non_negative("projection_ridge", projection_ridge)
    gram, cross, target = sums.gram, sums.cross, sums.target
    known = [each.data if sparse.issparse(each) else each for each in (gram, cross, target)]
    if not all(np.all(np.isfinite(each)) for each in known):
        raise ValueError("transitions: expected finite features and utilities, got NaN or infinity")
    ridge = min(fixed_point_ridge, projection_ridge)
    if sparse.issparse(gram) and sparse.issparse(cross) and ridge > LEAST_RIDGE * gram.diagonal().max():
        with suppress(RuntimeError):  # singular, as SuperLU sees it
            return _solve_sparse(gram, discount * cross, target, fixed_point_ridge, projection_ridge)
    gram, cross = _dense(gram), _dense(cross)
    size = len(gram)
    # Hoffman et al. (2012), ℓ2–ℓ2, with Σ = PΦᵀ: P[ΦᵀΦ′, Φᵀu]
    projected = _solve_symmetric(gram, projection_ridge, np.column_stack([cross, target]))
    mixing = np.eye(size) - discount * projected[:, :size]  # M: X = Φ − γΦΣΦ′ = ΦM (Hoffman et al. 2012)
    normal = mixing.T @ gram @ mixing  # XᵀX
    projected_target = projected[:, size] if target.ndim == 1 else projected[:, size:]
    # Hoffman et al. (2012), ℓ2–ℓ2: θ = (XᵀX + β₁I)⁻¹XᵀΦΣu
    return _solve_symmetric(normal, fixed_point_ridge, mixing.T @ (gram @ projected_target))


def _dense(matrix: Gram) -> Float[np.ndarray, "q q"]:
    return np.asarray(cast(SparseArray, matrix).toarray() if sparse.issparse(matrix) else matrix)


def _solve_sparse(
    gram: SparseArray, discounted: SparseArray, target: Targets, fixed_point_ridge: float, ridge: float
) -> Targets:
    """The same θ as the minimum of ½‖Φ(θ − w)‖² + ½β₁‖θ‖² with (G + β₂I)w = Φᵀu + γΦᵀΦ′θ, all of it sparse.

    With multipliers λ of the constraint the conditions for the minimum are linear in (θ, w, λ).
    """
    size = gram.shape[0]
    eye = sparse.eye_array(size)
    projecting = gram + ridge * eye
    conditions = [
        [gram + fixed_point_ridge * eye, -gram, -discounted.T],
        [-gram, gram, projecting],
        [-discounted, projecting, None],
    ]
    factors = splu(sparse.block_array(conditions).tocsc())
    weights: Targets = factors.solve(np.concatenate([np.zeros((2 * size, *target.shape[1:])), target]))[:size]
    return weights


def _solve_symmetric(matrix: Float[np.ndarray, "q q"], ridge: float, right: Targets) -> Targets:
    """Solve (matrix + ridge·I) x = right for a positive semi-definite matrix; of few directions where it is singular.

    Where rounding hides that it is singular, the solution may be longer than the one of least norm. Its Q is the same.

    By NumPy and not with SciPy's Cholesky factor: SciPy brings a second BLAS, whose idle threads spin and slow down all
    that follows.
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
