"""The part of the utility that the answers determine: Ψ = L Qᵀ, w = Q z + complement (thin factorisation).

The likelihood depends on w only through the margins t = Ψ w = L z with z = Qᵀ w ~ N(0, σ²I_r), r = rank Ψ ≤ K. What is
orthogonal to Q keeps its prior: its draws are exact prior noise and its posterior mean is exactly zero.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from xarray.backends import BackendArray
from xarray.core import indexing


@dataclass(frozen=True)
class LowRank:
    """Ψ = L Qᵀ.

    Attributes:
      loadings: L. Rows of zero differences are exactly zero.
      basis: Q with orthonormal columns, such that L is lower triangular as far as its rank allows: coordinate k is what
        answer k says that no answer before it did. So coordinates mean alike under different features.
    """

    loadings: Float[np.ndarray, "k r"]
    basis: Float[np.ndarray, "d r"]


def low_rank(differences: Float[np.ndarray, "k d"]) -> LowRank:
    """Factorise Ψ independently of the scale of each row.

    Rows are scaled to unit length before the factorisation, so that a small row keeps its sign, and exactly zero rows
    are set aside: rounding would otherwise turn them into hard constraints. The rank counts the singular values above
    max(K, D) ε times the largest.
    """
    lengths = np.linalg.norm(differences, axis=1)
    used = lengths > 0
    loadings, basis = np.zeros((len(differences), 0)), np.zeros((differences.shape[1], 0))
    if not used.any():
        return LowRank(loadings, basis)
    # QR first: its cost in D is that of one matrix product, and the decomposition that finds the rank is only (K, K)
    directions, triangle = np.linalg.qr((differences[used] / lengths[used, None]).T)
    left, values, right = np.linalg.svd(triangle.T, full_matrices=False)
    rank = int(np.sum(values > values[0] * max(differences.shape) * np.finfo(float).eps))
    rotation, triangle = np.linalg.qr((left[:, :rank] * values[:rank]).T)
    rotation *= np.where(np.diag(triangle) < 0, -1.0, 1.0)
    loadings = np.zeros((len(differences), rank))
    loadings[used] = lengths[used, None] * (left[:, :rank] * values[:rank] @ rotation)
    return LowRank(loadings, directions @ right[:rank].T @ rotation)


def used_rows(loadings: Float[np.ndarray, "k r"]) -> Bool[np.ndarray, " k"]:
    """Which answers carry information: the rows of L that are not exactly zero."""
    return np.asarray(np.any(loadings != 0, axis=1))


class UtilityWeights(BackendArray):
    """Draws of w = Q z + σ (I − QQᵀ) ε, of shape (chain, draw, feature), with the Q of each draw's setting.

    They are computed where they are indexed, and multiplied by a unit.

    ε comes from a counter-based generator keyed by the seed, the chain and the draw, so that a draw is the same array
    however it is indexed.
    """

    def __init__(
        self,
        coordinates: Float[np.ndarray, "chain draw r"],
        bases: Sequence[Float[np.ndarray, "d _"]],
        settings: Int[np.ndarray, "chain draw"],
        *,
        prior_scale: float,
        seed: int,
        unit: float = 1.0,
    ) -> None:
        self.coordinates, self.bases, self.settings = coordinates, bases, settings
        self.prior_scale, self.seed, self.unit = prior_scale, seed, unit
        self.shape = (*coordinates.shape[:2], len(bases[0]))
        self.dtype = np.dtype(np.float64)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Float[np.ndarray, "..."] | np.float64:
        draws: Float[np.ndarray, "*n"] | np.float64 = indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.OUTER, self._outer
        )
        return draws

    def _outer(self, key: tuple[Any, ...]) -> Float[np.ndarray, "..."] | np.float64:
        chains, draws = (np.atleast_1d(np.arange(n)[k]) for n, k in zip(self.shape[:2], key[:2], strict=True))
        weights = np.empty((len(chains), len(draws), self.shape[2]))
        for i, chain in enumerate(chains):
            for j, draw in enumerate(draws):
                weights[i, j] = self.unit * self.draw(int(chain), int(draw))
        keep = tuple(0 if np.ndim(k) == 0 and not isinstance(k, slice) else slice(None) for k in key[:2])
        return weights[:, :, key[2]][keep]  # at once, an array would move its axis to the front

    def draw(self, chain: int, draw: int) -> Float[np.ndarray, " d"]:
        """One draw of w."""
        basis = self.bases[self.settings[chain, draw]]
        generator = np.random.Generator(np.random.Philox(key=self.seed, counter=[0, 0, chain, draw]))
        noise = self.prior_scale * generator.standard_normal(self.shape[2])
        # twice: one projection leaves a rounding error of the size of the margins' smallest directions
        for _ in range(2):
            noise -= basis @ (basis.T @ noise)
        return np.asarray(basis @ self.coordinates[chain, draw, : basis.shape[1]] + noise)
