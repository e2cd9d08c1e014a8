"""Are the predicted preferences calibrated? Each answer predicted before it was used, scored, and a reliability curve.

Predicted is that the *first shown* is preferred: of the preferred one it would always turn out true.
"""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from scipy.optimize import isotonic_regression
from scipy.special import xlog1py, xlogy

from bayespbrl.diagnostics.predictions import (
    DOMINATED,
    PREFERRED,
    checked_bool,
    checked_differences,
    checked_groups,
    held_out_probabilities,
    model_options,
    tied_rows,
)


def prequential_predictions(
    differences: np.ndarray,
    first_preferred: np.ndarray,
    *,
    groups: np.ndarray | None = None,
    indifferent: np.ndarray | None = None,
    **posterior_options: Any,
) -> np.ndarray:
    """Probability that the first shown is preferred, for each answer by an exact refit to the answers before it.

    Decision: eq. 8 keeps the K of all answers (see `predictions`), so that the log score is the model's log evidence.
    `number_of_preferences` among the options sets another.

    Args:
      differences: ψ(preferred) − ψ(dominated) in the order of the answers, shape (K, D).
      first_preferred: whether the preferred one was shown first, shape (K,) bool.
      groups: the number of the answer that each row follows from, never decreasing, shape (K,): no row is used to
        predict another of its answer. Every row is an answer of its own by default.
      indifferent: which rows were answered "no difference", shape (K,) bool. The prediction is conditional on a
        preference being stated.
      posterior_options: of `sample_posterior`.

    Returns:
      shape (K,).

    Raises:
      ValueError: an argument of another shape, named with what came.
    """
    differences = checked_differences(differences)
    number = len(differences)
    first_preferred = checked_bool("first_preferred", first_preferred, number)
    groups = checked_groups(groups, number)
    if indifferent is not None:
        indifferent = checked_bool("indifferent", indifferent, number)
    predicted = np.empty(number)
    for group in np.unique(groups):
        asked = groups == group
        probabilities, _ = held_out_probabilities(
            differences, groups < group, asked, indifferent=indifferent, **posterior_options
        )
        stated = probabilities[:, PREFERRED] + probabilities[:, DOMINATED]
        column = np.where(first_preferred[asked], PREFERRED, DOMINATED)
        predicted[asked] = np.take_along_axis(probabilities, column[:, None], axis=1)[:, 0] / stated
    return predicted


def calibration(
    tree: xr.DataTree,
    first_preferred: np.ndarray | None = None,
    *,
    predicted: np.ndarray | None = None,
    groups: np.ndarray | None = None,
    seed: int = 0,
    **sampling_options: Any,
) -> xr.Dataset:
    """Calibration of the predictions that a posterior's model made of its answers, each before it was used.

    Args:
      tree: what `sample_posterior` returned for all K answers, in their order.
      first_preferred: whether the preferred one was shown first, shape (K,) bool. None: drawn by a fair coin from
        `seed` (the scores do not depend on it, the reliability curve does), and the attribute `order` says "drawn".
      predicted: probabilities that the first shown is preferred, shape (K,), as a run recorded them from the posterior
        it had at the time. None: by exact refits, K − 1 of them.
      groups: the number of the answer that each row follows from, shape (K,), never decreasing; the pair that was asked
        about is the last of its rows, and the only one scored.
      seed: of drawn orders and of the curve's band.
      sampling_options: `num_samples` and the like of the refits.

    Returns:
      what `score_predictions` returns; answers of "no difference" are not scored.
    """
    differences = np.asarray(tree["constant_data"]["differences"])
    number, tied = len(differences), tied_rows(tree)
    order = "drawn" if first_preferred is None else "given"
    if first_preferred is None:
        first_preferred = np.random.default_rng(seed).random(number) < 0.5
    first_preferred = checked_bool("first_preferred", first_preferred, number)
    groups = checked_groups(groups, number)
    if predicted is None:
        options = {"seed": int(tree.attrs["seed"]), **model_options(tree), **sampling_options}
        predicted = prequential_predictions(differences, first_preferred, groups=groups, indifferent=tied, **options)
    predicted = np.asarray(predicted, dtype=np.float64)
    if predicted.shape != (number,):
        raise ValueError(f"predicted: expected shape ({number},), got {predicted.shape}")
    scored = ~tied & np.append(groups[1:] != groups[:-1], True)[:number]
    return score_predictions(predicted[scored], first_preferred[scored], seed=seed).assign_attrs(order=order)


def score_predictions(
    predicted: np.ndarray, observed: np.ndarray, *, level: float = 0.9, simulations: int = 1000, seed: int = 0
) -> xr.Dataset:
    """Scores and reliability curve of n predicted probabilities.

    Args:
      predicted: in [0, 1], shape (n,).
      observed: whether it came true, shape (n,) bool.
      level: of the band in which the curve of calibrated predictions lies, at each forecast by itself.
      simulations: sets of answers drawn from the predictions, for the band.
      seed: of these.

    Returns:
      `predicted`, `observed` (prediction); along `forecast`, the distinct predictions in order: `frequency`, the
      isotonic regression of what came true (pool-adjacent-violators), `band_lower`, `band_upper`; and the numbers
      `log_score` (log probability of what came true, nats, summed, 0 is best) and `brier_score` (mean square, 0 is
      best), each with what it would be on average, `…_expected`, and its standard deviation, `…_sd`, if each
      prediction were the truth;
      `miscalibration`, `discrimination`, `uncertainty`: brier_score = miscalibration − discrimination + uncertainty.
      Means over no predictions are NaN.

    Source: Dimitriadis, Gneiting & Jordan (2021), the curve of `arviz_plots.plot_ppc_pava`.
    """
    predicted, observed = np.asarray(predicted, dtype=np.float64), np.asarray(observed)
    if predicted.ndim != 1 or not np.all((predicted >= 0) & (predicted <= 1)):
        raise ValueError(f"predicted: expected probabilities of shape (n,), got {predicted}")
    observed = checked_bool("observed", observed, len(predicted))
    if not 0 < level < 1:
        raise ValueError(f"level: expected a number in (0, 1), got {level}")
    forecasts, place, counts = np.unique(predicted, return_inverse=True, return_counts=True)
    frequency = _isotonic(observed, place, counts)
    draws = np.random.default_rng(seed).random((simulations, len(predicted))) < predicted
    curves = np.array([_isotonic(draw, place, counts) for draw in draws])
    band = np.quantile(curves, [(1 - level) / 2, (1 + level) / 2], axis=0) if len(forecasts) else np.zeros((2, 0))
    return xr.Dataset(
        {
            "predicted": ("prediction", predicted),
            "observed": ("prediction", observed),
            "frequency": ("forecast", frequency),
            "band_lower": ("forecast", band[0]),
            "band_upper": ("forecast", band[1]),
            **_scores(predicted, observed, frequency[place]),
        },
        coords={"forecast": forecasts},
        attrs={"level": level},
    )


def plot_calibration(result: xr.Dataset, axes: Axes) -> Axes:
    """The reliability curve with the band of calibrated predictions, the predictions as ticks above and below."""
    axes.plot([0, 1], [0, 1], color="0.5", linestyle="--", linewidth=1)
    label = f"{result.attrs['level']:.0%} band if calibrated"
    axes.fill_between(
        result["forecast"], result["band_lower"], result["band_upper"], alpha=0.25, linewidth=0, label=label
    )
    axes.plot(result["forecast"], result["frequency"], marker="o", markersize=3, label="answers")
    happened = result["observed"].values
    axes.plot(result["predicted"].values[happened], np.ones(happened.sum()), "|", color="0.3")
    axes.plot(result["predicted"].values[~happened], np.zeros((~happened).sum()), "|", color="0.3")
    number = result.sizes["prediction"]
    scores = f"log score {float(result['log_score']):.2f}, Brier {float(result['brier_score']):.3f}, {number} answers"
    axes.set(
        xlabel="predicted probability that the first shown is preferred",
        ylabel="how often it was",
        xlim=(0, 1),
        ylim=(-0.03, 1.03),
        title=scores,
    )
    axes.legend(loc="center right")
    return axes


def _isotonic(observed: np.ndarray, place: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Isotonic frequencies at the distinct forecasts: equal forecasts are one point, in whatever order they come."""
    if len(counts) == 0:
        return np.zeros(0)
    means = np.bincount(place, weights=observed, minlength=len(counts)) / counts
    return isotonic_regression(means, weights=counts).x


def _scores(predicted: np.ndarray, observed: np.ndarray, recalibrated: np.ndarray) -> dict[str, float]:
    number = len(predicted)
    if number == 0:
        named = (
            "brier_score",
            "brier_score_expected",
            "brier_score_sd",
            "miscalibration",
            "discrimination",
            "uncertainty",
        )
        return dict.fromkeys(("log_score", "log_score_expected", "log_score_sd"), 0.0) | dict.fromkeys(named, np.nan)
    variance = predicted * (1 - predicted)
    # a sure prediction has no spread, and log odds that are infinite
    log_odds = np.log(predicted, where=variance > 0, out=np.zeros(number))
    log_odds -= np.log1p(-predicted, where=variance > 0, out=np.zeros(number))
    brier = np.mean((predicted - observed) ** 2)
    uncertainty = np.mean(observed) * (1 - np.mean(observed))
    after = np.mean((recalibrated - observed) ** 2)
    return {
        "log_score": np.sum(xlogy(observed, predicted) + xlog1py(~observed, -predicted)),
        "log_score_expected": np.sum(xlogy(predicted, predicted) + xlog1py(1 - predicted, -predicted)),
        "log_score_sd": np.sqrt(np.sum(variance * log_odds**2)),
        "brier_score": brier,
        "brier_score_expected": np.mean(variance),
        "brier_score_sd": np.sqrt(np.sum(variance * (1 - 2 * predicted) ** 2)) / number,
        "miscalibration": brier - after,
        "discrimination": uncertainty - after,
        "uncertainty": uncertainty,
    }
