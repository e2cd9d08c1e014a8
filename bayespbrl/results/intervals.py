"""Estimates with their intervals: medians, differences, answers needed, failed trials, performance profiles, p values.

All intervals are 95 % intervals. Bootstrap intervals are percentile intervals (Efron & Tibshirani 1993) over the
trials, from 10 000 resamples of a fixed stream (2000 of the profiles), so that the same data give the same table.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

LEVEL = 0.95
RESAMPLES = 10_000
PROFILE_RESAMPLES = 2_000
PARTS = 50  # in which resamples are evaluated: those of many trials at once need a gigabyte


class Interval(NamedTuple):
    """An estimate and its 95 % interval."""

    estimate: float
    low: float
    high: float


def resamples(number: int, *, samples: int = RESAMPLES, seed: int = 0) -> np.ndarray:
    """Bootstrap rows, the same for the same number of trials and seed, shape (samples, number)."""
    return np.random.default_rng(seed).integers(number, size=(samples, number))


def median_interval(values: np.ndarray) -> Interval:
    """The median of values of shape (S,) with its bootstrap interval; NaN bounds for one value or among NaN."""
    values = np.asarray(values, dtype=np.float64)
    estimate = float(np.median(values))
    if len(values) < 2 or np.isnan(estimate):
        return Interval(estimate, np.nan, np.nan)
    if np.ptp(values) == 0:
        return Interval(estimate, estimate, estimate)
    found = stats.bootstrap(
        (values,),
        np.median,
        confidence_level=LEVEL,
        n_resamples=RESAMPLES,
        method="percentile",
        random_state=np.random.default_rng(0),
    ).confidence_interval
    return Interval(estimate, float(found.low), float(found.high))


def paired_difference(values: np.ndarray, reference: np.ndarray) -> tuple[Interval, float]:
    """Median difference of paired trials with its interval, and the p value of Wilcoxon's signed-rank test.

    Args:
      values, reference: of the same seeds, shape (S,).
    """
    values, reference = np.asarray(values, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    differences = values - reference
    if np.any(np.isnan(differences)):
        return median_interval(differences), np.nan
    # of six digits each: what is less than the last, is rounding, and would tell equal differences apart
    unit = 1e-9 * max(np.max(np.abs(values)), np.max(np.abs(reference)), np.finfo(float).tiny)
    return median_interval(differences), signed_rank_test(np.rint(differences / unit))


def signed_rank_test(differences: np.ndarray) -> float:
    """The exact two-sided p value of Wilcoxon's signed-rank test of differences of shape (S,).

    Differences of zero have ranks but no sign. Where many are zero, a normal approximation gives p values that are too
    small: three of twenty differences, all positive, have p = 0.25 and not 0.08.

    Source: Wilcoxon (1945); differences of zero as by Pratt (1959); the distribution by summation over the signs.
    """
    sizes = np.abs(differences) / (np.max(np.abs(differences), initial=0) or 1)
    ranks = np.rint(2 * stats.rankdata(np.round(sizes, 12))).astype(int)  # doubled: those of equal ones may be halves
    signed, positive = ranks[sizes > 0], ranks[np.asarray(differences) > 0].sum()
    probabilities = np.zeros(signed.sum() + 1)
    probabilities[0] = 1.0
    for rank in signed:  # plus or minus, equally probable
        probabilities[rank:] = probabilities[rank:] + probabilities[: len(probabilities) - rank]
        probabilities /= 2
    sums = 2 * np.arange(len(probabilities)) - signed.sum()
    return float(min(probabilities[np.abs(sums) >= abs(2 * positive - signed.sum())].sum(), 1.0))


def sign_test(less: int, more: int) -> float:
    """The two-sided p value of the sign test: pairs of which one side is less, and more; equal ones do not count.

    Source: Dixon & Mood (1946).
    """
    return float(stats.binomtest(less, less + more).pvalue) if less + more else 1.0


def failed_trials(failed: int, trials: int) -> Interval:
    """The share of failed trials with its exact interval (Clopper & Pearson 1934)."""
    bounds = stats.binomtest(failed, trials).proportion_ci(LEVEL, method="exact")
    return Interval(failed / trials, float(bounds.low), float(bounds.high))


def answers_for_good(answers: np.ndarray, values: np.ndarray, level: float) -> Interval:
    """Number of answers after which the median over the trials stays at or above `level`.

    Args:
      answers: numbers of answers, shape (n,), increasing.
      values: of each trial's last policy with no more answers, shape (S, n).
      level: of the value.

    Returns:
      infinity where the median is below `level` at the end, as bounds too.
    """

    def needed(values: np.ndarray) -> np.ndarray:
        reached = np.median(values, axis=-2) >= level
        for_good = np.flip(np.logical_and.accumulate(np.flip(reached, -1), axis=-1), -1)
        return np.where(for_good[..., -1], answers[for_good.argmax(axis=-1)], np.inf)

    if len(values) < 2:
        return Interval(float(needed(values)), np.nan, np.nan)
    tail = (1 - LEVEL) / 2
    drawn = np.concatenate([needed(values[rows]) for rows in np.array_split(resamples(len(values)), PARTS)])
    low, high = np.quantile(drawn, [tail, 1 - tail], method="inverted_cdf")
    return Interval(float(needed(values)), float(low), float(high))


def holm(p: Sequence[float]) -> np.ndarray:
    """p values adjusted to control the family-wise error rate (Holm 1979), in the given order."""
    values = np.asarray(p, dtype=np.float64)
    order = np.argsort(values, kind="stable")
    adjusted = np.minimum(np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1)), 1.0)  # Holm (1979)
    result = np.empty_like(values)
    result[order] = adjusted
    return result


def benjamini_hochberg(p: Sequence[float]) -> np.ndarray:
    """p values adjusted to control the false discovery rate (Benjamini & Hochberg 1995)."""
    return np.asarray(stats.false_discovery_control(np.asarray(p, dtype=np.float64))) if len(p) else np.empty(0)


class Profile(NamedTuple):
    """A performance profile: share of runs above each level, with the pointwise interval; shapes (n,)."""

    levels: np.ndarray
    share: np.ndarray
    low: np.ndarray
    high: np.ndarray


def performance_profile(relative: Mapping[str, np.ndarray], levels: np.ndarray) -> Profile:
    """The share of runs whose relative value is above each level, averaged over tasks.

    Args:
      relative: final relative values of each task's trials, shape (S,) each.
      levels: shape (n,).

    Returns:
      the profile with its stratified bootstrap interval: trials are drawn anew within each task.

    Source: Agarwal, Schwarzer, Castro, Courville & Bellemare (2021), "Deep reinforcement learning at the edge of the
    statistical precipice", section 4.2, eq. 2.
    """
    shares, samples = [], []
    for stratum, values in enumerate(relative.values()):
        above = np.asarray(values, dtype=np.float64)[:, None] > levels  # Agarwal et al. (2021), eq. 2
        shares.append(above.mean(axis=0))
        samples.append(above[resamples(len(values), samples=PROFILE_RESAMPLES, seed=stratum)].mean(axis=1))
    tail = (1 - LEVEL) / 2
    low, high = np.quantile(np.mean(samples, axis=0), [tail, 1 - tail], axis=0)
    return Profile(levels, np.mean(shares, axis=0), low, high)
