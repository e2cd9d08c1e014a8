import numpy as np
import pytest
import xarray as xr
from arviz_stats import psense, psense_summary
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.stats import norm

from bayespbrl import infer_utility
from bayespbrl.diagnostics import plot_sensitivity, sensitivity
from bayespbrl.diagnostics.power_scaling import _quantities
from bayespbrl.models import sample_posterior
from bayespbrl.models.posterior_tree import restored, stored

SAMPLING = {"num_warmup": 100, "num_samples": 400, "max_samples": 400}
DIFFERENCES = np.array([[0.9, -0.4, 0.0], [0.5, 0.8, 0.0], [0.0, 0.0, 0.0]])


@pytest.fixture(scope="module")
def tree():
    """The posterior of eq. 8 given all differences."""
    return sample_posterior(DIFFERENCES, **SAMPLING)


def of_component(result, component):
    return result["sensitivity"].sel(component=component).values


def sensitivity_of_a_normal(low, high, alpha=1.01):
    """The cumulative Jensen-Shannon distance of N(0, 1) and N(0, 1/α) per log₂ α, by quadrature from low to high.

    Source: Kallioinen et al. (2024), eqs. 9-11.
    """
    x, step = np.linspace(low, high, 40001, retstep=True)
    p, q = norm.cdf(x), norm.cdf(x * np.sqrt(alpha))
    middle = (p + q) / 2
    divergence = np.sum(p * np.log2(p / middle) + q * np.log2(q / middle)) * step
    return np.sqrt(divergence / (np.sum(p + q) * step)) / np.log2(alpha)


def test_utility_that_no_answer_constrains_depends_on_the_prior_scale_alone(tree):
    result = sensitivity(tree, np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 0.001]]))
    assert np.all(of_component(result, "prior") > 0.06)
    assert np.all(of_component(result, "likelihood") < 0.03)
    assert list(result["diagnosis"].values) == ["prior", "prior"]
    # the unit of a utility does not matter
    np.testing.assert_allclose(*of_component(result, "prior"), rtol=1e-9)


def test_the_posterior_of_an_estimate_takes_features_too():
    utility = infer_utility(np.eye(3), [(0, 1), (1, 2)], steepness=5.0, lapse_rate=0.0)
    of_items = sensitivity(utility.posterior, np.eye(3) / utility.scales)
    assert of_items.sizes["quantity"] == 3


def test_arviz_says_the_same_of_the_posterior_as_it_is(tree):
    ours = sensitivity(tree)["sensitivity"].values[:, :2]
    moving = {"var_names": ["margins"], "coords": {"preference": [0, 1]}}  # the third is constant
    for group, of_margins in zip(("prior", "likelihood"), ours, strict=True):
        np.testing.assert_allclose(psense(tree, group=group, **moving)["margins"].values, of_margins)
    table = psense_summary(restored(stored(tree)), **moving)
    np.testing.assert_allclose(table["prior"], ours[0], atol=1e-3)


def test_features_have_no_side():
    """The same pair, shown on both sides: half the sum of both margins is the utility of its difference."""
    tree = sample_posterior(DIFFERENCES[[0, 0, 1]], shown_first=[1, -1, 1], likelihood="logistic", **SAMPLING)
    draws, _ = _quantities(tree, DIFFERENCES[:1], seed=0)
    margins = tree["posterior/margins"].values
    np.testing.assert_allclose(draws[..., 0], margins[..., :2].mean(axis=2), atol=1e-12)
    assert sensitivity(tree, DIFFERENCES[:1]).sizes["quantity"] == 1


@pytest.mark.slow
def test_the_posterior_is_insensitive_to_answers_without_information():
    tree = sample_posterior(DIFFERENCES, likelihood="logistic", steepness=1e-4, **SAMPLING)
    result = sensitivity(tree)
    assert np.all(of_component(result, "likelihood") < 0.01)
    assert np.all(of_component(result, "prior")[:2] > 0.06)


@pytest.mark.parametrize("steepness", [pytest.param(1e-14, marks=pytest.mark.slow), 1e-8])
def test_the_posterior_is_insensitive_to_answers_equally_likely_but_for_rounding(steepness):
    tree = sample_posterior(DIFFERENCES, steepness=steepness, likelihood="logistic", **SAMPLING)
    assert np.ptp(tree["log_likelihood"]["answers"].values) > 0
    np.testing.assert_array_equal(of_component(sensitivity(tree), "likelihood"), 0)


def test_answers_that_determine_a_utility_reduce_the_sensitivity_to_the_prior():
    # six answers against two of the same pair: at steepness 20 the utility is known to a tenth of its prior spread
    rows = np.array([[0.4, 0.1]] * 6 + [[-0.4, -0.1]] * 2)
    vague, sharp = (
        sensitivity(sample_posterior(rows, likelihood="logistic", steepness=m, **SAMPLING)) for m in (0.5, 20)
    )
    assert of_component(sharp, "prior")[0] < of_component(vague, "prior")[0] / 3
    assert of_component(sharp, "likelihood")[0] > 3 * of_component(sharp, "prior")[0]


def test_features_that_are_the_differences_have_the_sensitivity_of_the_margins():
    rows = np.array([[0.31, -0.47, 0.11, 0.83], [0.57, 0.29, -0.71, 0.13], [0.19, 0.23, 0.41, -0.61]])
    tree = sample_posterior(rows, **SAMPLING)
    margins, utilities = sensitivity(tree), sensitivity(tree, rows)
    np.testing.assert_allclose(utilities["sensitivity"], margins["sensitivity"], rtol=1e-6)


def test_a_row_of_zeros_is_insensitive(tree):
    result = sensitivity(tree)
    np.testing.assert_array_equal(result["sensitivity"][:, 2], 0)
    assert result["diagnosis"].values[2] == "neither"
    assert np.all(result["sensitivity"][:, :2] > 0)


def test_scaling_the_power_of_the_prior_is_scaling_its_spread():
    scale = 2.5
    z = scale * np.random.default_rng(0).standard_normal((4, 2000, 1))
    tree = xr.DataTree.from_dict(
        {
            "/": xr.Dataset(attrs={"prior_scale": scale}),
            "/posterior": xr.Dataset(
                {"margins": (("chain", "draw", "preference"), z), "coordinates": (("chain", "draw", "coordinate"), z)}
            ),
            "/log_likelihood": xr.Dataset({"answers": (("chain", "draw", "preference"), np.zeros((4, 2000, 1)))}),
        }
    )
    result = sensitivity(tree)
    assert of_component(result, "likelihood")[0] == 0
    assert of_component(result, "prior")[0] == pytest.approx(
        sensitivity_of_a_normal(z.min() / scale, z.max() / scale), rel=0.05
    )


@pytest.mark.parametrize("number", [0, 1])
def test_with_no_answer_or_one_there_is_a_result_of_that_size(number):
    tree = sample_posterior(DIFFERENCES[:number], **SAMPLING)
    result = sensitivity(tree)
    assert dict(result.sizes) == {"component": 2, "quantity": number}
    unseen = sensitivity(tree, np.array([[0.0, 0.0, 1.0]]))
    assert of_component(unseen, "likelihood")[0] < 0.03 < of_component(unseen, "prior")[0]
    axes = Figure().subplots()
    assert plot_sensitivity(result, axes) is axes


def test_the_figure_has_two_bars_a_quantity_on_the_axes_given(tree):
    figure = Figure()
    left, right = figure.subplots(1, 2)
    result = sensitivity(tree)
    assert plot_sensitivity(result, right) is right
    FigureCanvasAgg(figure).draw()
    assert not left.has_data()
    heights = [bar.get_height() for bar in right.patches]
    np.testing.assert_allclose(heights, result["sensitivity"].values.ravel())


@pytest.mark.parametrize("features", [np.zeros(3), np.zeros((2, 2)), np.array([[np.inf, 0.0, 0.0]])])
def test_features_that_do_not_fit_are_refused(tree, features):
    with pytest.raises(ValueError, match=r"features: expected .* got"):
        sensitivity(tree, features)
