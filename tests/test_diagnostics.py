import matplotlib.pyplot
import numpy as np
import pytest
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import bayespbrl
from bayespbrl import diagnostics
from bayespbrl.diagnostics import convergence, plot_convergence, plot_ranks
from bayespbrl.diagnostics.plots import trials_figure
from bayespbrl.envs.opening import open_environment


def tree_of(margins):
    return xr.DataTree.from_dict({"/posterior": xr.Dataset({"margins": (("chain", "draw", "preference"), margins)})})


@pytest.fixture
def draws():
    """Independent draws of three margins; one chain of the second is elsewhere, the third is always zero."""
    margins = np.random.default_rng(0).normal(2.0, 3.0, size=(4, 500, 3))
    margins[1, :, 1] += 6.0
    margins[:, :, 2] = 0.0
    return margins


def test_what_is_no_posterior_is_refused_with_a_word_where_one_is():
    inferred = bayespbrl.infer_utility(np.eye(3), [(0, 1)], steepness=5.0, lapse_rate=0.0)
    for diagnose in (
        convergence,
        diagnostics.influence,
        diagnostics.sensitivity,
        diagnostics.predictive_checks,
        diagnostics.calibration,
        lambda tree: diagnostics.answer_probabilities(tree, np.eye(3)),
        lambda tree: diagnostics.plot_ranks(tree, Figure().subplots()),
    ):
        with pytest.raises(
            ValueError, match=r"tree: expected a posterior, .*, got PosteriorUtility; its .posterior is"
        ):
            diagnose(inferred)
        with pytest.raises(ValueError, match=r"tree: expected a posterior, as sample_posterior returns it, got NoneT"):
            diagnose(None)


def test_every_exported_name_is_there():
    assert all(callable(getattr(diagnostics, name)) for name in diagnostics.__all__)


def test_convergence_names_the_margin_whose_chains_disagree(draws):
    result = convergence(tree_of(draws))
    np.testing.assert_array_equal(result["converged"], [True, False, True])
    assert result.attrs["converged"] == 0
    assert result.attrs["rhat_max"] == float(result["rhat"][1]) > 1.2
    assert 1200 < float(result["effective_sample_size"][0]) < 2800
    assert 500 < float(result["effective_sample_size_tail"][0]) < 2800
    assert float(result["monte_carlo_error"][0]) == pytest.approx(3 / np.sqrt(2000), rel=0.2)


def test_a_margin_that_is_zero_in_every_draw_has_converged(draws):
    last = convergence(tree_of(draws)).isel(preference=2)
    assert [float(last[name]) for name in ("rhat", "effective_sample_size", "monte_carlo_error")] == [1, 2000, 0]
    assert float(last["effective_sample_size_tail"]) == 2000


def test_the_limits_are_those_given(draws):
    good = tree_of(draws[:, :, [0]])
    assert convergence(good).attrs["converged"] == 1
    assert convergence(good, effective_sample_size_min=1e5).attrs["converged"] == 0
    assert convergence(good, rhat_max=0.9).attrs["converged"] == 0


def test_a_draw_that_is_no_number_has_not_converged(draws):
    draws[0, 0, 0] = np.nan
    assert not bool(convergence(tree_of(draws))["converged"][0])


def test_without_answers_everything_has_converged():
    result = convergence(tree_of(np.zeros((4, 100, 0))))
    assert result.sizes["preference"] == 0
    assert result.attrs["converged"] == 1
    axes = Figure().subplots()
    assert plot_convergence(result, axes) is axes


def test_figures_are_drawn_on_the_axes_given_and_on_no_other(draws):
    figure = Figure()
    sizes, ranks, untouched = figure.subplots(1, 3)
    assert plot_convergence(convergence(tree_of(draws)), sizes) is sizes
    assert plot_ranks(tree_of(draws), ranks) is ranks
    FigureCanvasAgg(figure).draw()
    assert sizes.get_title().startswith("not converged")
    assert [text.get_text()[:2] for text in sizes.texts] == ["R̂"]
    assert not untouched.has_data()
    assert matplotlib.pyplot.get_fignums() == []


def test_ranks_are_level_where_chains_agree_and_pile_up_where_one_does_not(draws):
    def heights(preference):
        axes = plot_ranks(tree_of(draws), Figure().subplots(), preference=preference)
        return np.array([patch.get_data().values for patch in axes.patches])

    assert heights(0).shape == (4, 20)
    np.testing.assert_allclose(heights(0).mean(axis=1), 1.0)
    assert heights(0).max() < 2
    assert heights(None)[1, -1] > 3  # the worst by default: the chain that is elsewhere has the highest ranks


def test_ranks_are_level_where_all_draws_are_equal():
    axes = plot_ranks(tree_of(np.zeros((4, 1000, 1))), Figure().subplots(), bins=4)
    np.testing.assert_allclose([patch.get_data().values for patch in axes.patches], 1.0, atol=0.25)


@pytest.mark.parametrize("preference", [-1, 3])
def test_an_unknown_preference_is_refused(draws, preference):
    with pytest.raises(ValueError, match=r"preference: expected a number in 0 … 2, got -?\d"):
        plot_ranks(tree_of(draws), Figure().subplots(), preference=preference)


def test_the_curve_over_trials_shows_median_quartiles_and_published_levels():
    curve = xr.Dataset(
        {
            "answers": ("iteration", [2.0, 3.0]),
            "lower_quartile": ("iteration", [-3.0, -2.0]),
            "median": ("iteration", [-2.0, -1.0]),
            "upper_quartile": ("iteration", [-1.0, -0.5]),
        },
        {"iteration": [1, 2]},
    )
    environment = open_environment("acrobot")
    (axes,) = trials_figure(curve, environment, "acrobot").axes
    median, *levels = axes.lines
    np.testing.assert_array_equal(median.get_xydata(), [[2, -2], [3, -1]])
    assert [line.get_ydata()[0] for line in levels] == [-211.3, -385.2]
    band = axes.collections[0].get_paths()[0].get_extents()
    assert (band.y0, band.y1) == (-3.0, -0.5)
    (axes,) = trials_figure(curve, open_environment("gridworld"), "gridworld").axes
    assert axes.lines[1].get_ydata()[0] == 294.8125
