"""Convergence of Markov chains: R̂, effective sample size and Monte Carlo error of many quantities at once.

The rank-normalised R̂ and bulk effective sample size are those of Vehtari et al. (2021), by ArviZ. It diagnoses one
quantity after the other, and hundreds of margins would take longer to diagnose than to sample: then the same formulas
are evaluated here for all at once, with the same numbers.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from arviz_stats.base import array_stats
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import ndtri
from scipy.stats import rankdata

ONE_BY_ONE = 100  # quantities up to which ArviZ's time does not matter
RHAT_LIMIT, SIZE_LIMIT = 1.01, 400.0  # of every quantity of chains that have converged (Vehtari et al. 2021)
AT_ONCE = 1_000_000  # numbers that are ranked at once, for the sake of memory


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

    def converged(self) -> bool:
        """Whether every quantity meets both limits; NaN meets none."""
        return self.rhat_max <= RHAT_LIMIT and self.effective_sample_size_min >= SIZE_LIMIT


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
    size_of_one = flat.shape[0] * flat.shape[1]
    size = np.full(flat.shape[2], float(size_of_one))
    error = np.zeros(flat.shape[2])
    # a NaN is not constant: it must reach the diagnostics and fail there
    varies = ~np.all(flat == flat[:1, :1], axis=(0, 1))
    columns = np.flatnonzero(varies)
    diagnosed = _by_arviz if len(columns) <= ONE_BY_ONE else _at_once
    for part in np.array_split(columns, -(-len(columns) * size_of_one // AT_ONCE) or 1) if len(columns) else ():
        with np.errstate(divide="ignore", invalid="ignore"):  # chains that stay each at another number: R̂ is no number
            rhat[part], size[part], error[part] = diagnosed(flat[:, :, part])
    shape = draws.shape[2:]
    return Convergence(rhat.reshape(shape), size.reshape(shape), error.reshape(shape))


def _by_arviz(draws: Float[np.ndarray, "chain draw q"]) -> tuple[Float[np.ndarray, " q"], ...]:
    """R̂, effective sample size and error of the mean of each of Q quantities; NaN where a draw is not finite."""
    statistics: Any = array_stats  # untyped
    axes = {"chain_axis": 0, "draw_axis": 1}
    rhat, size = statistics.rhat(draws, **axes), statistics.ess(draws, method="bulk", **axes)
    return rhat, size, statistics.mcse(draws, method="mean", **axes)


def _at_once(draws: Float[np.ndarray, "chain draw q"]) -> tuple[Float[np.ndarray, " q"], ...]:
    """R̂, effective sample size and error of the mean of each of Q quantities; NaN where a draw is not finite."""
    half = draws.shape[1] // 2
    split = np.concatenate([draws[:, :half], draws[:, -half:]])
    normal = _rank_normalised(split)
    folded = _rank_normalised(np.abs(split - np.median(split, axis=(0, 1))))
    rhat = np.fmax(_split_rhat(normal), _split_rhat(folded))  # folded draws of two values may all be equal
    error = np.std(draws, axis=(0, 1), ddof=1) / np.sqrt(_effective_sample_size(split))
    finite = np.all(np.isfinite(draws), axis=(0, 1))
    return tuple(np.where(finite, each, np.nan) for each in (rhat, _effective_sample_size(normal), error))


def _rank_normalised(split: Float[np.ndarray, "m n q"]) -> Float[np.ndarray, "m n q"]:
    """Normal scores of the ranks (Vehtari et al. 2021, eq. 14)."""
    ranks = rankdata(split.reshape(-1, split.shape[2]), axis=0)
    return np.asarray(ndtri((ranks - 3 / 8) / (len(ranks) + 1 / 4))).reshape(split.shape)  # Vehtari et al., eq. 14


def _split_rhat(split: Float[np.ndarray, "m n q"]) -> Float[np.ndarray, " q"]:
    """R̂ (Vehtari et al. 2021, eqs. 1-4)."""
    number = split.shape[1]
    # Vehtari et al. (2021), eqs. 1-2: B/N and W
    between, within = np.var(split.mean(axis=1), axis=0, ddof=1), np.mean(np.var(split, axis=1, ddof=1), axis=0)
    return np.asarray(np.sqrt(between / within + (number - 1) / number))  # Vehtari et al., eqs. 3-4


def _effective_sample_size(split: Float[np.ndarray, "m n q"]) -> Float[np.ndarray, " q"]:
    """By Geyer's initial monotone sequence (Vehtari et al. 2021, eqs. 10-13)."""
    chains, number, quantities = split.shape
    centred = split - split.mean(axis=1, keepdims=True)
    power = np.abs(rfft(centred, next_fast_len(2 * number), axis=1)) ** 2
    covariance = irfft(power, next_fast_len(2 * number), axis=1)[:, :number].mean(axis=0) / number
    variance = covariance[0] + np.var(split.mean(axis=1), axis=0, ddof=1)  # Vehtari et al., eq. 3
    # Vehtari et al., eq. 10: autocorrelations of all chains together
    rho = 1 - (covariance[0] * number / (number - 1) - covariance) / variance
    rho[0] = 1.0
    last = max(0, (number - 3) // 2)  # the last pair of lags that is looked at
    pairs = rho[0 : 2 * last + 2].reshape(last + 1, 2, quantities).sum(axis=1)
    negative = pairs <= 0
    first = np.where(negative.any(axis=0), np.argmax(negative, axis=0), last)
    monotone = np.minimum.accumulate(pairs, axis=0)
    kept = np.sum(np.where(np.arange(last + 1)[:, None] < first, monotone, 0.0), axis=0)
    beyond = rho[2 * first, np.arange(quantities)]
    beyond = np.where(negative.any(axis=0), np.maximum(beyond, 0.0), beyond)
    total = chains * number
    return np.asarray(total / np.maximum(-1 + 2 * kept + beyond, 1 / np.log10(total)))  # Vehtari et al., eqs. 11-13
