"""Calibration of predicted preferences: each answer is predicted before it is used (prequentially) and scored.

The predicted event is that the trajectory *shown first* is preferred. Its outcome varies, as calibration needs.
"""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from scipy.optimize import isotonic_regression
from scipy.special import xlog1py, xlogy

from bayespbrl import checks
from bayespbrl.diagnostics import predictions
from bayespbrl.models import NOTHING_ELSE, Answers, PreferenceModel
from bayespbrl.models.posterior_tree import answers_of, check_posterior, number_of_preferences, settings_of


def prequential_predictions(
    differences: np.ndarray,
    first_preferred: np.ndarray,
    model: PreferenceModel | None = None,
    *,
    groups: np.ndarray | None = None,
    answers: Answers = NOTHING_ELSE,
    **sampling_options: int,
) -> np.ndarray:
    """Probability that the first shown is preferred, for each answer by an exact refit to the answers before it.

    Decision: eq. 8 keeps the K of all answers (see `predictions`), so that the log score is the model's log marginal
    likelihood.

    Args:
      differences: ψ(preferred) − ψ(dominated) in the order of the answers, shape (K, D) or (C, K, D).
      first_preferred: whether the preferred one was shown first, shape (K,) bool.
      model: prior and likelihood; the defaults of `PreferenceModel` when None.
      groups: the number of the answer that each row follows from, never decreasing, shape (K,): no row is used to
        predict another of its answer. Every row is an answer of its own by default.
      answers: ties, sides and answerers of the rows. The prediction is conditional on a preference being stated,
        ½ where the model rules that out.
      sampling_options: `seed`, `num_samples` and the like of `sample_posterior`; `number_of_preferences`, another K.

    Returns:
      shape (K,).
    """
    differences = np.asarray(differences, dtype=np.float64)
    number = settings_of(differences).shape[1]
    first_preferred = checks.flags("first_preferred", first_preferred, number)
    groups = predictions.answer_groups(groups, number)
    answers = answers.checked(number)
    model = PreferenceModel() if model is None else model
    predicted = np.empty(number)
    for group in np.unique(groups):
        asked = groups == group
        probabilities, _ = predictions.held_out_probabilities(
            differences, model, groups < group, asked, answers=answers, **sampling_options
        )
        column = np.where(first_preferred[asked], predictions.PREFERRED, predictions.DOMINATED)
        predicted[asked], _ = predictions.if_stated(probabilities, column)
    return predicted


def calibration(
    tree: xr.DataTree,
    first_preferred: np.ndarray | None = None,
    *,
    predicted: np.ndarray | None = None,
    groups: np.ndarray | None = None,
    seed: int = 0,
    **sampling_options: int,
) -> xr.Dataset:
    """Calibration of a model's predictions of its answers, each made before the answer was used.

    Args:
      tree: what `sample_posterior` returned for all K answers, in their order.
      first_preferred: whether the preferred one was shown first, shape (K,) bool. None: drawn by a fair coin from
        `seed`, and the attribute `order` is "drawn"; log score and Brier score do not depend on it.
      predicted: probabilities that the first shown is preferred, shape (K,), as recorded during a run; they need
        `first_preferred`. None: by exact refits, K − 1 of them.
      groups: the number of the answer that each row follows from, shape (K,), never decreasing. The pair that was asked
        about is the last row of its answer; only that row is scored. Every row is an answer of its own by default. Not
        so in a learner's run with ties: after a tie one answer states several pairs, and its posterior has the ties
        behind all pairs, so that each pair is predicted without them. Its report scores each answer once, by the
        posterior that the learner had.
      seed: of drawn orders and of the curve's band.
      sampling_options: `num_samples` and the like of the refits.

    Returns:
      what `score_predictions` returns; answers "no difference" are not scored.
    """
    check_posterior(tree)
    differences = np.asarray(tree["constant_data"]["differences"])
    number, tied = differences.shape[-2], predictions.tied_rows(tree)
    order = "drawn" if first_preferred is None else "given"
    if predicted is not None and first_preferred is None:
        raise ValueError("first_preferred: expected which were preferred of those that predicted is about, got None")
    if first_preferred is None:
        first_preferred = np.asarray(np.random.default_rng(seed).random(number) < 0.5)
    first_preferred = checks.flags("first_preferred", first_preferred, number)
    groups = predictions.answer_groups(groups, number)
    if predicted is None:
        options = {"seed": int(tree.attrs["seed"]), "number_of_preferences": number_of_preferences(tree)}
        options |= sampling_options
        predicted = prequential_predictions(
            differences,
            first_preferred,
            predictions.fitted_model(tree),
            groups=groups,
            answers=answers_of(tree),
            **options,
        )
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
      observed: whether the event happened, shape (n,) bool.
      level: coverage of the pointwise band for the curve of calibrated predictions.
      simulations: number of sets of answers drawn from the predictions, for the band.
      seed: of the simulations.

    Returns:
      `predicted`, `observed` (prediction); along `forecast`, the distinct predictions in order: `frequency`, the
      isotonic regression of the outcomes (pool-adjacent-violators), `band_lower`, `band_upper`; and the numbers
      `log_score` (summed log probability of the outcomes, nats, 0 is best) and `brier_score` (mean squared error, 0 is
      best), each with its expectation `…_expected` and standard deviation `…_sd` under the predictions themselves;
      `log_score_z`, the log score less its expectation in standard deviations: below −2 the predictions are
      overconfident; `miscalibration`, `discrimination`, `uncertainty`: brier_score = miscalibration − discrimination +
      uncertainty; `expected_calibration_error`: mean distance between confidence max(p, 1 − p) and the share of right
      predictions, over bins of width 0.1, with what calibrated predictions have by chance, `…_expected` and `…_sd`.
      Means over no predictions are NaN.

    Source: Dimitriadis, Gneiting & Jordan (2021), the curve of `arviz_plots.plot_ppc_pava`.
    """
    predicted = np.asarray(predicted, dtype=np.float64)
    if predicted.ndim != 1 or not np.all((predicted >= 0) & (predicted <= 1)):
        raise ValueError(f"predicted: expected probabilities of shape (n,), got {predicted}")
    observed = checks.flags("observed", observed, len(predicted))
    if not 0 < level < 1:
        raise ValueError(f"level: expected a number in (0, 1), got {level}")
    checks.whole("simulations", simulations)
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
            **_calibration_error(predicted, np.vstack([observed, draws])),
        },
        coords={"forecast": forecasts},
        attrs={"level": level},
    )


def plot_calibration(result: xr.Dataset, axes: Axes) -> Axes:
    """Reliability curve with the band of calibrated predictions; ticks: predictions, at the top if they came true."""
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
        ylabel="observed frequency",
        xlim=(0, 1),
        ylim=(-0.03, 1.03),
        title=scores,
    )
    axes.legend(loc="center right")
    return axes


def _isotonic(observed: np.ndarray, place: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Isotonic frequencies at the distinct forecasts; equal forecasts are one point."""
    if len(counts) == 0:
        return np.zeros(0)
    means = np.bincount(place, weights=observed, minlength=len(counts)) / counts
    return isotonic_regression(means, weights=counts).x


def _scores(predicted: np.ndarray, observed: np.ndarray, recalibrated: np.ndarray) -> dict[str, float]:
    number = len(predicted)
    if number == 0:
        sums, brier = ("log_score", "log_score_expected", "log_score_sd"), ("", "_expected", "_sd")
        means = (*(f"brier_score{end}" for end in brier), "miscalibration", "discrimination", "uncertainty")
        means += ("log_score_z",)
        return dict.fromkeys(sums, 0.0) | dict.fromkeys(means, np.nan)
    variance = predicted * (1 - predicted)
    # a prediction of 0 or 1 has infinite log odds and adds no variance
    log_odds = np.log(predicted, where=variance > 0, out=np.zeros(number))
    log_odds -= np.log1p(-predicted, where=variance > 0, out=np.zeros(number))
    brier = np.mean((predicted - observed) ** 2)
    uncertainty = np.mean(observed) * (1 - np.mean(observed))
    after = np.mean((recalibrated - observed) ** 2)
    score = np.sum(xlogy(observed, predicted) + xlog1py(~observed, -predicted))
    expected = np.sum(xlogy(predicted, predicted) + xlog1py(1 - predicted, -predicted))
    deviation = np.sqrt(np.sum(variance * log_odds**2))
    return {
        "log_score": score,
        "log_score_expected": expected,
        "log_score_sd": deviation,
        "log_score_z": (score - expected) / deviation if deviation > 0 else np.nan,
        "brier_score": brier,
        "brier_score_expected": np.mean(variance),
        "brier_score_sd": np.sqrt(np.sum(variance * (1 - 2 * predicted) ** 2)) / number,
        # the decomposition of Dimitriadis, Gneiting & Jordan (2021)
        "miscalibration": brier - after,
        "discrimination": uncertainty - after,
        "uncertainty": uncertainty,
    }


def _calibration_error(predicted: np.ndarray, outcomes: np.ndarray) -> dict[str, float]:
    """Expected calibration error (Guo et al. 2017) of the first row of outcomes; mean and deviation of the others."""
    name = "expected_calibration_error"
    if len(predicted) == 0:
        return dict.fromkeys((name, f"{name}_expected", f"{name}_sd"), np.nan)
    confidence, right = (
        np.maximum(predicted, 1 - predicted),
        np.where(predicted > 0.5, outcomes, ~outcomes).astype(float),
    )
    right[:, predicted == 0.5] = 0.5  # a coin is neither right nor wrong
    one_hot = np.minimum((confidence * 10).astype(int), 9)[:, None] == np.arange(10)
    errors = np.sum(np.abs((right - confidence) @ one_hot), axis=1) / len(predicted)
    return {name: errors[0], f"{name}_expected": np.mean(errors[1:]), f"{name}_sd": np.std(errors[1:])}
