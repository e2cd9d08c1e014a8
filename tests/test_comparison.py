import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.special import expit

from bayespbrl.diagnostics import compare_likelihoods, plot_comparison, predictions
from bayespbrl.diagnostics import comparison as comparison_module
from bayespbrl.models import Answers, PreferenceModel, posterior_draws

SAMPLING = {"num_warmup": 50, "num_samples": 250, "max_samples": 250}
FEW = {"num_warmup": 25, "num_samples": 25, "max_samples": 25}  # where any draws will do
# one pair asked about five times; one answer contradicts the others
ROWS = np.array([[0.5], [0.5], [-0.5], [0.5], [0.5]])
CANDIDATES = {
    "sure": PreferenceModel(likelihood="logistic", steepness=60.0),
    "fitting": PreferenceModel(likelihood="logistic", steepness=2.0),
    "eq. 8": PreferenceModel(likelihood="mixed", steepness=5.0),
}


def left_out(rows, likelihood):
    """log p(answer | all others) by quadrature over w, no point at a jump."""
    w = np.linspace(-9.003, 9.001, 20001)
    p = likelihood(rows * w)
    prior = np.exp(-(w**2) / 2)
    without = [prior * np.delete(p, k, axis=0).prod(axis=0) for k in range(len(rows))]
    return np.array([np.log(p[k] @ weights / weights.sum()) for k, weights in enumerate(without)])


@pytest.fixture(scope="module")
def comparison():
    return compare_likelihoods(ROWS, CANDIDATES, folds=5, **SAMPLING)


@pytest.mark.slow
def test_leaving_out_one_at_a_time_agrees_with_quadrature_and_eq_8_keeps_the_full_number_of_preferences(comparison):
    likelihoods = {
        "sure": lambda t: expit(60 * t),
        "fitting": lambda t: expit(2 * t),
        "eq. 8": lambda t: (4 * (t > 0) + expit(5 * t)) / 5,
    }
    for name, likelihood in likelihoods.items():
        got = comparison["log_probability"].sel(candidate=name)
        np.testing.assert_allclose(got, left_out(ROWS, likelihood), atol=0.15, rtol=0.05)


@pytest.mark.slow
def test_an_overconfident_likelihood_loses_and_the_best_comes_first(comparison):
    elpd = comparison["elpd"]
    assert comparison["candidate"].values[0] == "fitting"
    assert np.all(np.diff(elpd) <= 0)
    assert float(elpd.sel(candidate="sure")) < float(elpd.sel(candidate="fitting")) - 0.5
    assert float(comparison["difference"][0]) == float(comparison["difference_error"][0]) == 0


@pytest.mark.slow
def test_standard_errors_are_those_of_a_sum_of_independent_terms(comparison):
    values = comparison["log_probability"].values
    np.testing.assert_allclose(comparison["elpd"], values.sum(axis=1))
    np.testing.assert_allclose(comparison["standard_error"], np.sqrt(5) * values.std(axis=1, ddof=1))
    behind = values[1] - values[0]
    np.testing.assert_allclose(comparison["difference"][1], behind.sum())
    np.testing.assert_allclose(comparison["difference_error"][1], np.sqrt(5) * behind.std(ddof=1))


def test_folds_are_as_equal_as_they_can_be_and_the_same_for_all_candidates(monkeypatch):
    asked = []

    def listening(differences, model, **options):
        asked.append((differences, options["number_of_preferences"]))
        return posterior_draws(differences, model, **options)

    monkeypatch.setattr(predictions, "posterior_draws", listening)
    rows = np.arange(1.0, 6.0)[:, None]
    candidates = {"a": PreferenceModel(), "b": PreferenceModel(steepness=1.0)}
    result = compare_likelihoods(rows, candidates, folds=2, seed=5, **FEW)
    assert sorted(np.bincount(result["fold"])) == [2, 3]
    assert {number for _, number in asked} == {5}
    for (first, _), (second, _) in zip(asked[:2], asked[2:], strict=True):
        np.testing.assert_array_equal(first, second)
    other = compare_likelihoods(rows, {"a": PreferenceModel()}, folds=2, seed=6, **FEW)
    assert not np.array_equal(other["fold"], result["fold"])


@pytest.mark.slow
def test_rows_of_one_answer_are_left_out_together():
    groups = np.array([0, 0, 2, 3, 3])
    candidates = {"a": PreferenceModel(likelihood="logistic")}
    fold = compare_likelihoods(ROWS, candidates, folds=2, groups=groups, **FEW)["fold"].values
    assert all(len(set(fold[groups == group])) == 1 for group in groups)
    assert set(fold) == {0, 1}


def test_rows_of_one_answer_are_one_summand_of_the_standard_error():
    one = np.array([[0.1, -2.0, 0.7]])
    alone = comparison_module._error_of_sum(one, np.arange(3))
    together = comparison_module._error_of_sum(np.repeat(one, 2, axis=1) / 2, np.repeat(np.arange(3), 2))
    np.testing.assert_allclose(together, alone)


@pytest.mark.parametrize("number", [0, 1])
def test_with_no_answer_or_one_the_prior_predicts(number):
    result = compare_likelihoods(ROWS[:number], CANDIDATES, **SAMPLING)
    assert dict(result.sizes) == {"candidate": 3, "preference": number}
    np.testing.assert_allclose(result["elpd"], number * np.log(0.5))
    assert np.all(np.isnan(result["standard_error"]))
    axes = Figure().subplots()
    assert plot_comparison(result, axes) is axes


@pytest.mark.slow
def test_answers_of_no_difference_are_predicted_as_such():
    rows, tied = np.array([[0.6], [0.05], [0.5], [-0.04]]), np.array([False, True, False, True])
    candidates = {
        name: PreferenceModel(likelihood="logistic", steepness=8.0, tie_threshold=threshold)
        for name, threshold in (("narrow", 0.001), ("wide", 0.2))
    }
    result = compare_likelihoods(rows, candidates, folds=4, answers=Answers(tied), **SAMPLING)
    assert list(result["candidate"].values) == ["wide", "narrow"]
    assert np.all(result["log_probability"].sel(candidate="narrow")[tied] < np.log(0.1))
    assert np.all(result["log_probability"].sel(candidate="wide")[tied] > np.log(0.3))


@pytest.mark.slow
def test_what_a_candidate_leaves_open_is_inferred_with_sides_under_each_setting_of_the_features():
    rows = np.array([[0.6], [0.05], [0.5], [-0.04]])
    answers = Answers(np.array([False, True, False, True]), shown_first=np.array([1, 1, -1, 1]))
    inferred = PreferenceModel(steepness=None, lapse_rate=None)
    result = compare_likelihoods(
        np.stack([rows, np.sqrt(np.abs(rows))]), {"inferred": inferred}, folds=4, answers=answers, **SAMPLING
    )
    asked = np.arange(4) == 0
    alone, _ = predictions.held_out_probabilities(
        np.stack([rows, np.sqrt(np.abs(rows))]), inferred, ~asked, asked, answers=answers, seed=0, **SAMPLING
    )
    assert result["log_probability"].values[0, 0] == pytest.approx(np.log(alone[0, 0]), abs=1e-12)
    assert np.all(result["log_probability"] < 0)


@pytest.mark.slow
def test_the_figure_names_each_candidate_on_the_axes_given(comparison):
    figure = Figure()
    left, right = figure.subplots(1, 2)
    assert plot_comparison(comparison, right) is right
    FigureCanvasAgg(figure).draw()
    assert not left.has_data()
    assert [label.get_text().split(" (")[0] for label in right.get_yticklabels()] == list(
        comparison["candidate"].values
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"differences": np.zeros(3)}, r"differences: expected shape \(N, D\), got \(3,\)"),
        ({"differences": np.full((2, 1), np.nan)}, "differences: expected finite entries, got NaN"),
        ({"candidates": {}}, "candidates: expected at least one, got none"),
        ({"folds": 1}, "folds: expected a whole number >= 2, got 1"),
        ({"folds": 2.0}, "folds: expected a whole number >= 2, got 2.0"),
        ({"answers": Answers(np.ones(3, dtype=bool))}, r"indifferent: expected bool of shape \(5,\)"),
        ({"groups": np.arange(3)}, "groups: expected 5 integers"),
    ],
)
def test_arguments_out_of_range_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        compare_likelihoods(**{"differences": ROWS, "candidates": CANDIDATES, **arguments})
