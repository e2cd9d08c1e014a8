"""Convergence of Markov chains: R̂, effective sample size and Monte Carlo error, by ArviZ on arrays.

The rank-normalised R̂ and bulk effective sample size are those of Vehtari et al. (2021).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from arviz_stats.base import array_stats
from jaxtyping import Float
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class Convergence:
    """R̂, effective sample size and Monte Carlo error of each quantity.

    A quantity that is the same number in every draw has R̂ 1, as many effective draws as draws, and no error.

    Attributes:
      rhat: rank-normalised split R̂.
      effective_sample_size: bulk.
      monte_carlo_error: standard error of the mean.
    """

    rhat: Float[np.ndarray, "*quantities"]
    effective_sample_size: Float[np.ndarray, "*quantities"]
    monte_carlo_error: Float[np.ndarray, "*quantities"]

    @property
    def rhat_max(self) -> float:
        """The worst R̂; 1 where there is nothing to estimate."""
        return float(np.max(self.rhat, initial=1.0))

    @property
    def effective_sample_size_min(self) -> float:
        """The smallest effective sample size; infinite where there is nothing to estimate."""
        return float(np.min(self.effective_sample_size, initial=np.inf))

    def converged(self, *, rhat_max: float = 1.01, effective_sample_size_min: float = 400.0) -> bool:
        """Whether every quantity meets both limits; NaN meets none."""
        return self.rhat_max <= rhat_max and self.effective_sample_size_min >= effective_sample_size_min


def chain_convergence(draws: ArrayLike) -> Convergence:
    """Diagnose `draws` of shape (chain, draw, *quantities).

    Raises:
      ValueError: fewer than two dimensions or four draws.
    """
    draws = np.asarray(draws, dtype=float)
    if draws.ndim < 2 or draws.shape[1] < 4:
        raise ValueError(f"draws: expected shape (chain, draw >= 4, ...), got {draws.shape}")
    flat = draws.reshape(*draws.shape[:2], -1)
    rhat = np.ones(flat.shape[2])
    size = np.full(flat.shape[2], float(flat.shape[0] * flat.shape[1]))
    error = np.zeros(flat.shape[2])
    # a NaN is not constant: it must reach the diagnostics and fail there
    varies = ~np.all(flat == flat[:1, :1], axis=(0, 1))
    if varies.any():
        statistics: Any = array_stats  # untyped
        axes = {"chain_axis": 0, "draw_axis": 1}
        with np.errstate(divide="ignore", invalid="ignore"):  # chains that stay each at another number: R̂ is no number
            rhat[varies] = statistics.rhat(flat[:, :, varies], **axes)
            size[varies] = statistics.ess(flat[:, :, varies], method="bulk", **axes)
            error[varies] = statistics.mcse(flat[:, :, varies], method="mean", **axes)
    shape = draws.shape[2:]
    return Convergence(rhat.reshape(shape), size.reshape(shape), error.reshape(shape))
