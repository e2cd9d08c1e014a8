import numpy as np
import pytest
from arviz_base import from_dict
from arviz_stats.helper_stats import isotonic_fit
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.special import expit, logit

from bayespbrl.diagnostics import (
    calibration,
    plot_calibration,
    predictions,
    prequential_predictions,
    score_predictions,
)
from bayespbrl.models import PreferenceModel, posterior_draws, sample_posterior
from bayespbrl.models.posterior import SamplerOptions

SAMPLING = {"num_warmup": 100, "num_samples": 400, "max_samples": 400}
FEW = {"num_warmup": 25, "num_samples": 25, "max_samples": 25}  # where any draws will do
DIFFERENCES = np.array([[0.9, -0.4], [0.5, 0.8], [-0.2, 0.7]])


@pytest.fixture(scope="module")
def tree():
    """A posterior of eq. 8 given all differences."""
    return sample_posterior(DIFFERENCES, **FEW)


def forecasts_and_answers(number, seed=0):
    """Forecasts spread over (0, 1), and answers that come true exactly that often."""
    rng = np.random.default_rng(seed)
    forecasts = rng.beta(0.8, 0.8, size=number)
    return forecasts, rng.random(number) < forecasts


def log_marginal_likelihood(differences, likelihood):
    """By the trapezoidal rule over w in the plane, no point of the grid at a jump."""
    line = np.linspace(-7.003, 7.001, 1501)
    x, y = np.meshgrid(line, line, indexing="ij")
    prior = np.exp(-(x**2 + y**2) / 2)
    values = prior * np.prod([likelihood(x * dx + y * dy) for dx, dy in differences], axis=0)
    return np.log(values.sum() / prior.sum())


def test_scores_of_two_predictions_by_hand():
    result = score_predictions(np.array([0.8, 0.3]), np.array([True, True]))
    assert float(result["log_score"]) == pytest.approx(np.log(0.8) + np.log(0.3))
    assert float(result["brier_score"]) == pytest.approx((0.04 + 0.49) / 2)
    assert float(result["log_score_expected"]) == pytest.approx(
        0.8 * np.log(0.8) + 0.2 * np.log(0.2) + 0.3 * np.log(0.3) + 0.7 * np.log(0.7)
    )
    assert float(result["brier_score_expected"]) == pytest.approx((0.16 + 0.21) / 2)
    # said 0.8 and was right, said 0.7 for the other side and was wrong: two bins of one prediction each
    assert float(result["expected_calibration_error"]) == pytest.approx((0.2 + 0.7) / 2)
    # by chance: misses of 0.2 or 0.8, and of 0.3 or 0.7
    by_chance = [float(result[f"expected_calibration_error_{end}"]) for end in ("expected", "sd")]
    assert by_chance == pytest.approx([(0.32 + 0.42) / 2, np.sqrt(0.6**2 * 0.16 + 0.4**2 * 0.21) / 2], abs=0.02)
    sd = np.sqrt(0.8 * 0.2 * np.log(4) ** 2 + 0.3 * 0.7 * np.log(7 / 3) ** 2)
    assert float(result["log_score_z"]) == pytest.approx(float(result["log_score"] - result["log_score_expected"]) / sd)
    np.testing.assert_allclose(result["frequency"], [1, 1])
    assert float(result["uncertainty"]) == 0
    assert float(result["miscalibration"]) == pytest.approx(0.265)


def test_at_least_one_set_of_answers_is_simulated():
    with pytest.raises(ValueError, match="simulations: expected a whole number >= 1, got 0"):
        score_predictions(np.array([0.8]), np.array([True]), simulations=0)


@pytest.mark.slow
def test_expected_scores_and_their_spread_are_those_of_answers_drawn_from_the_predictions():
    predicted = np.array([0.05, 0.3, 0.6, 0.98])
    rng = np.random.default_rng(2)
    results = [score_predictions(predicted, rng.random(4) < predicted, simulations=1) for _ in range(2000)]
    for score in ("log_score", "brier_score"):
        drawn = np.array([float(result[score]) for result in results])
        sd = float(results[0][f"{score}_sd"])
        assert abs(drawn.mean() - float(results[0][f"{score}_expected"])) < 4 * sd / np.sqrt(2000)
        assert drawn.std() == pytest.approx(sd, rel=0.12)


def test_calibrated_predictions_are_found_calibrated_and_overconfident_ones_are_not():
    forecasts, answers = forecasts_and_answers(400)
    good, bold = (score_predictions(expit(sharpness * logit(forecasts)), answers) for sharpness in (1.0, 3.0))

    def outside(result):
        below, above = (result["frequency"] < result["band_lower"]), (result["frequency"] > result["band_upper"])
        return float((below | above).mean())

    assert outside(good) < 0.2
    assert outside(bold) > 0.5
    assert abs(float(good["log_score"] - good["log_score_expected"])) < 3 * float(good["log_score_sd"])
    assert float(bold["log_score"]) < float(bold["log_score_expected"]) - 5 * float(bold["log_score_sd"])
    assert float(bold["log_score"]) < float(good["log_score"]) - 10
    assert float(bold["log_score_z"]) < -5 < -3 < float(good["log_score_z"])
    assert float(bold["expected_calibration_error"]) > 2 * float(good["expected_calibration_error"])
    assert float(bold["brier_score"]) > float(good["brier_score"])
    assert float(bold["miscalibration"]) > 3 * float(good["miscalibration"])
    # sharpening does not change the order of the forecasts, and so not what they discriminate
    np.testing.assert_allclose(bold["discrimination"], good["discrimination"], atol=1e-12)


def test_brier_score_is_miscalibration_minus_discrimination_plus_uncertainty():
    forecasts, answers = forecasts_and_answers(60)
    result = score_predictions(np.round(forecasts, 1), answers)
    parts = result["miscalibration"] - result["discrimination"] + result["uncertainty"]
    np.testing.assert_allclose(result["brier_score"], parts, atol=1e-12)
    assert float(result["miscalibration"]) >= 0
    assert float(result["discrimination"]) >= 0


def test_the_reliability_curve_and_its_band_are_those_that_arviz_draws():
    rng = np.random.default_rng(5)
    forecasts = rng.permutation(np.arange(1, 40) / 40)
    answers = rng.random(39) < forecasts
    # as many ones as the forecast says, so that the means of the draws are the forecasts and keep their order
    draws = rng.permuted(np.arange(4000)[:, None] < 4000 * forecasts, axis=0).reshape(4, 1000, 39)
    groups = {"posterior_predictive": {"answer": draws.astype(int)}, "observed_data": {"answer": answers.astype(int)}}
    theirs = isotonic_fit(from_dict(groups), None, "posterior_predictive", 0.9)["answer"]
    ours = score_predictions(forecasts, answers, level=0.9, simulations=4000)
    np.testing.assert_allclose(ours["forecast"], theirs.sel(plot_axis="x"), atol=1e-12)
    np.testing.assert_allclose(ours["frequency"], theirs.sel(plot_axis="y"), atol=1e-12)
    np.testing.assert_allclose(ours["band_lower"], theirs.sel(plot_axis="y_bottom"), atol=0.04)
    np.testing.assert_allclose(ours["band_upper"], theirs.sel(plot_axis="y_top"), atol=0.04)


def test_equal_forecasts_are_one_point_of_the_curve_in_whatever_order_they_come():
    predicted = np.array([0.5, 0.5, 0.5, 0.9])
    for answers in ([True, False, False, True], [False, False, True, True]):
        result = score_predictions(predicted, np.array(answers))
        np.testing.assert_allclose(result["frequency"], [1 / 3, 1])
        np.testing.assert_allclose(result["forecast"], [0.5, 0.9])
    pooled = score_predictions(predicted, np.array([True, True, False, False]))
    np.testing.assert_allclose(pooled["frequency"], [0.5, 0.5])  # of four answers, not of two forecasts


def test_a_certain_prediction_scores_zero_if_right_and_minus_infinity_if_wrong():
    held, failed = (score_predictions(np.array([1.0, 0.0]), np.array([held, False])) for held in (True, False))
    assert float(held["log_score"]) == 0
    assert float(held["log_score_sd"]) == 0
    assert float(failed["log_score"]) == -np.inf


@pytest.mark.parametrize(
    ("likelihood", "p"),
    [
        ("mixed", lambda t: (2 * (t > 0) + expit(5 * t)) / 3),
        pytest.param("logistic", lambda t: expit(5 * t), marks=pytest.mark.slow),
    ],
    ids=["eq. 8", "logistic"],
)
def test_log_scores_of_the_answers_in_turn_sum_to_the_log_marginal_likelihood(likelihood, p):
    first = np.array([True, False, False])
    predicted = prequential_predictions(DIFFERENCES, first, PreferenceModel(likelihood=likelihood), **SAMPLING)
    assert predicted[0] == pytest.approx(0.5, abs=1e-12)
    score = float(score_predictions(predicted, first)["log_score"])
    assert score == pytest.approx(log_marginal_likelihood(DIFFERENCES, p), abs=0.03)


def test_calibration_of_a_posterior_predicts_with_its_own_model_by_refits():
    model = PreferenceModel(likelihood="mixed", steepness=2.0, prior_scale=1.7)
    first = np.array([True, False, False])
    tree = posterior_draws(DIFFERENCES, model, seed=3, sampler=SamplerOptions(**FEW))
    result = calibration(tree, first, **FEW)
    direct = prequential_predictions(DIFFERENCES, first, model, seed=3, **FEW)
    np.testing.assert_array_equal(result["predicted"], direct)
    np.testing.assert_array_equal(result["observed"], first)
    assert result.attrs["order"] == "given"
    drawn = calibration(tree, **FEW)
    assert drawn.attrs["order"] == "drawn"
    assert float(drawn["log_score"]) == pytest.approx(float(result["log_score"]), abs=1e-9)
    assert float(drawn["brier_score"]) == pytest.approx(float(result["brier_score"]), abs=1e-9)


def test_predictions_that_a_run_made_are_scored_as_they_are(monkeypatch, tree):
    monkeypatch.setattr(predictions, "posterior_draws", None)
    predicted, first = np.array([0.5, 0.2, 0.9]), np.array([True, False, True])
    with pytest.raises(ValueError, match="first_preferred: expected which were preferred"):
        calibration(tree, predicted=predicted)
    result = calibration(tree, first, predicted=predicted)
    assert float(result["log_score"]) == pytest.approx(np.log(0.5 * 0.8 * 0.9))


def test_rows_of_one_answer_do_not_predict_each_other_and_only_the_pair_asked_about_is_scored():
    rows = np.array([[0.9, -0.4], [0.9, -0.4], [0.9, -0.4], [0.5, 0.8]])
    first, groups = np.array([True, True, False, True]), np.array([0, 0, 0, 4])
    predicted = prequential_predictions(rows, first, groups=groups, **FEW)
    np.testing.assert_allclose(predicted[:3], 0.5, atol=1e-12)
    tree = sample_posterior(rows, **FEW)
    result = calibration(tree, first, groups=groups, **FEW)
    np.testing.assert_array_equal(result["predicted"], predicted[2:])
    np.testing.assert_array_equal(result["observed"], [False, True])


@pytest.mark.slow
def test_answers_of_no_difference_are_used_but_not_scored():
    tied = np.array([False, True, False])
    tree = sample_posterior(DIFFERENCES, indifferent=tied, tie_threshold=0.2, likelihood="logistic", **SAMPLING)
    result = calibration(tree, np.array([True, True, False]), **SAMPLING)
    assert result.sizes["prediction"] == 2
    assert float(result["predicted"][0]) == pytest.approx(0.5, abs=1e-12)
    model = PreferenceModel(tie_threshold=0.2, likelihood="logistic")
    without = prequential_predictions(DIFFERENCES[~tied], np.array([True, False]), model, **SAMPLING)
    assert abs(float(result["predicted"][1]) - without[1]) > 0.01


@pytest.mark.parametrize("number", [0, 1])
def test_with_no_answer_or_one_there_is_a_result_of_that_size(number):
    tree = sample_posterior(DIFFERENCES[:number], **FEW)
    result = calibration(tree, np.ones(number, dtype=bool), **FEW)
    assert result.sizes == {"prediction": number, "forecast": number}
    assert float(result["log_score"]) == pytest.approx(number * np.log(0.5))
    axes = Figure().subplots()
    assert plot_calibration(result, axes) is axes


def test_the_figure_is_drawn_on_the_axes_given():
    forecasts, answers = forecasts_and_answers(50)
    figure = Figure()
    left, right = figure.subplots(1, 2)
    assert plot_calibration(score_predictions(forecasts, answers), right) is right
    FigureCanvasAgg(figure).draw()
    assert not left.has_data()
    curve = next(line for line in right.lines if line.get_label() == "answers")
    np.testing.assert_array_equal(curve.get_xdata(), np.sort(forecasts))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"predicted": np.array([0.2, 1.2]), "observed": np.ones(2, dtype=bool)}, "predicted: expected .* got"),
        ({"predicted": np.array([0.2, np.nan]), "observed": np.ones(2, dtype=bool)}, "predicted: expected .* got"),
        ({"predicted": np.full((2, 1), 0.5), "observed": np.ones(2, dtype=bool)}, "predicted: expected .* got"),
        ({"predicted": np.full(2, 0.5), "observed": np.ones(2)}, "observed: expected bool .* got float64"),
        ({"predicted": np.full(2, 0.5), "observed": np.ones(3, dtype=bool)}, r"observed: expected .* got .*\(3,\)"),
        (
            {"predicted": np.full(2, 0.5), "observed": np.ones(2, dtype=bool), "level": 1.0},
            "level: expected .* got 1.0",
        ),
    ],
)
def test_invalid_predictions_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        score_predictions(**arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"first_preferred": np.array([1, 0, 1])}, "first_preferred: expected bool"),
        ({"first_preferred": np.ones(2, dtype=bool)}, r"first_preferred: expected .* got .*\(2,\)"),
        (
            {"predicted": np.full(2, 0.5), "first_preferred": np.ones(3, bool)},
            r"predicted: expected shape \(3,\), got \(2,\)",
        ),
        ({"groups": np.array([0, 1, 0])}, "groups: expected 3 integers that never decrease, got"),
        ({"groups": np.array([0.0, 1.0, 2.0])}, "groups: expected"),
    ],
)
def test_arguments_that_do_not_fit_the_posterior_are_refused(tree, arguments, message):
    with pytest.raises(ValueError, match=message):
        calibration(tree, **arguments)


def test_the_error_that_calibrated_predictions_are_expected_to_have_is_of_simulated_answers_alone():
    predicted = np.full(4, 0.9)
    scores = score_predictions(predicted, np.zeros(4, bool), simulations=1, seed=0)
    drawn = np.random.default_rng(0).random((1, 4)) < predicted
    assert scores["expected_calibration_error_expected"] == pytest.approx(abs(drawn.mean() - 0.9))
