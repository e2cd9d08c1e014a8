import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.special import expit

from bayespbrl.diagnostics import influence, plot_influence, predictions
from bayespbrl.models import posterior_draws, sample_posterior

SAMPLING = {"num_warmup": 100, "num_samples": 400, "max_samples": 400}
FEW = {"num_warmup": 25, "num_samples": 25, "max_samples": 25}  # where any draws will do
# six answers that agree, and one, the fifth, that contradicts them
CONTRADICTED = np.array([[0.5, 0.1], [0.4, 0.0], [0.6, -0.1], [0.5, 0.0], [-0.55, 0.05], [0.45, 0.1], [0.5, -0.05]])


@pytest.fixture(scope="module")
def steep():
    """Eq. 8 at a steepness where its step rules out nearly all draws of one half: few weights count for much."""
    return sample_posterior(CONTRADICTED, steepness=40.0, **SAMPLING)


@pytest.mark.slow
def test_the_answer_that_contradicts_the_others_is_the_most_influential_and_the_least_probable():
    tree = sample_posterior(CONTRADICTED, likelihood="logistic", **SAMPLING)
    every = influence(tree, refits=None, **SAMPLING)
    assert bool(every["refitted"].all())
    assert np.argmax(every["change"].values) == np.argmax(every["change_estimated"].values) == 4
    # twice the weight of an answer is not half as bad as none: the estimate must weigh it down
    assert float(every["change_estimated"][4]) == pytest.approx(float(every["change"][4]), rel=0.2)
    assert np.argmin(every["probability"].values) == 4
    assert float(every["probability"][4]) < 0.2
    one = influence(tree, refits=1, **SAMPLING)
    np.testing.assert_array_equal(np.flatnonzero(one["refitted"]), [4])
    assert float(one["change"][4]) == float(every["change"][4])
    # without it, the others' margins grow
    means = one["margin_means"][4] - one["margin_mean"]
    assert np.all(np.delete(means.values, 4) > 0)


def test_rows_of_one_answer_are_left_out_together():
    tree = sample_posterior(CONTRADICTED, likelihood="logistic", **FEW)
    groups = np.array([0, 1, 1, 1, 2, 3, 4])
    result = influence(tree, refits=2, groups=groups, **FEW)
    for name in ("pareto_k", "change_estimated", "change", "refitted"):
        assert all(len(set(map(str, result[name].values[groups == group]))) == 1 for group in groups)
    assert len(set(groups[result["refitted"].values])) == 2
    alone = influence(tree, refits=0, **FEW)["change_estimated"].values
    np.testing.assert_array_equal(result["change_estimated"].values[[0, 4]], alone[[0, 4]])
    assert result["change_estimated"].values[1] > alone[1:4].max()


@pytest.mark.slow
def test_without_an_answer_the_means_are_those_by_quadrature():
    rows = np.array([[0.7], [-0.4], [0.9]])
    tree = sample_posterior(rows, likelihood="logistic", prior_scale=1.5, **SAMPLING)
    result = influence(tree, refits=None, **SAMPLING)
    w = np.linspace(-12, 12, 4001)
    p = expit(5 * rows * w)
    prior = np.exp(-((w / 1.5) ** 2) / 2)

    def mean(values, weights):
        return values @ weights / weights.sum()

    everything, length = mean(w, prior * p.prod(axis=0)), np.sqrt(np.mean(rows**2))
    for k in range(3):
        weights = prior * np.delete(p, k, axis=0).prod(axis=0)
        assert float(result["change"][k]) == pytest.approx(length * abs(everything - mean(w, weights)), abs=0.06)
        assert float(result["probability"][k]) == pytest.approx(mean(p[k], weights), abs=0.03)
        np.testing.assert_allclose(result["margin_means"][k], rows[:, 0] * mean(w, weights), atol=0.08)


@pytest.mark.slow
def test_importance_weights_and_refits_agree_where_k_hat_is_low():
    tree = sample_posterior(CONTRADICTED[:4], likelihood="logistic", steepness=2.0, **SAMPLING)
    result = influence(tree, refits=None, **SAMPLING)
    assert np.all(result["pareto_k"] < 0.7)
    np.testing.assert_allclose(result["change_estimated"], result["change"], atol=0.08)


@pytest.mark.slow
def test_refits_are_of_the_answers_with_the_largest_estimated_change(steep):
    assert np.any(influence(steep, refits=0)["pareto_k"] > 0.7)
    some = influence(steep, refits=3, **SAMPLING)
    assert some["refitted"].sum() == 3
    estimated, refitted = some["change_estimated"].values, some["refitted"].values
    assert estimated[refitted].min() >= estimated[~refitted].max()
    for name in ("change", "probability"):
        np.testing.assert_array_equal(np.isfinite(some[name]), refitted)
    np.testing.assert_array_equal(some["converged"], refitted)


@pytest.mark.slow
def test_the_change_is_of_the_margins_with_the_side_bias_in_them():
    sides = np.array([1, 1, -1])
    tree = sample_posterior(CONTRADICTED[:3], shown_first=sides, likelihood="logistic", **SAMPLING)
    result = influence(tree, refits=1, **SAMPLING)
    k = int(np.flatnonzero(result["refitted"])[0])
    # without answer k, the mean of its own margin is that of the prior in what the others do not touch
    others = predictions.refit(tree, np.arange(3) != k, **SAMPLING)
    np.testing.assert_allclose(
        np.delete(result["margin_means"][k].values, k),
        others["posterior"]["margins"].mean(("chain", "draw")),
        atol=1e-9,
    )


@pytest.mark.slow
def test_a_row_of_zeros_has_no_influence():
    rows = np.vstack([CONTRADICTED[:2], np.zeros((1, 2))])
    tree = sample_posterior(rows, **SAMPLING)
    result = influence(tree, refits=None, **SAMPLING)
    assert float(result["pareto_k"][2]) == float(result["change_estimated"][2]) == 0
    assert float(result["change"][2]) < 0.06
    assert float(result["probability"][2]) == 0.5


def test_the_refits_of_eq_8_keep_the_full_number_of_preferences(monkeypatch):
    asked = []

    def listening(differences, model, **options):
        asked.append((len(differences), options["number_of_preferences"], options["seed"], model.prior_scale))
        return posterior_draws(differences, model, **options)

    tree = sample_posterior(CONTRADICTED[:3], seed=7, prior_scale=0.8, **FEW)
    monkeypatch.setattr(predictions, "posterior_draws", listening)
    influence(tree, refits=2, **FEW)
    assert asked == [(2, 3, 7, 0.8)] * 2


def test_without_the_only_answer_the_prior_is_left():
    tree = sample_posterior(CONTRADICTED[:1], **SAMPLING)
    result = influence(tree, **SAMPLING)
    mean = np.linalg.norm(tree["utility_weights_mean"])
    assert float(result["change"][0]) == pytest.approx(mean * np.linalg.norm(CONTRADICTED[0]), rel=1e-12)
    assert float(result["probability"][0]) == pytest.approx(0.5, abs=1e-12)
    assert float(result["margin_means"][0, 0]) == 0


def test_without_answers_there_is_none_to_leave_out():
    result = influence(sample_posterior(np.zeros((0, 2)), **FEW), refits=None)
    assert result.sizes["preference"] == 0
    axes = Figure().subplots()
    assert plot_influence(result, axes) is axes


@pytest.mark.slow
def test_the_figure_shows_every_answer_and_the_k_hat_of_those_above_the_limit(steep):
    result = influence(steep, refits=2, **FEW)
    figure = Figure()
    left, right = figure.subplots(1, 2)
    assert plot_influence(result, right) is right
    FigureCanvasAgg(figure).draw()
    assert not left.has_data()
    estimated, exact = right.lines
    np.testing.assert_array_equal(estimated.get_ydata(), result["change_estimated"])
    np.testing.assert_array_equal(np.isfinite(exact.get_ydata()), result["refitted"])
    assert len(right.texts) == int((result["pareto_k"] > 0.7).sum()) > 0


def test_a_negative_number_of_refits_is_refused():
    tree = sample_posterior(CONTRADICTED[:1], **FEW)
    with pytest.raises(ValueError, match="refits: expected a whole number >= 0, got -1"):
        influence(tree, refits=-1)
