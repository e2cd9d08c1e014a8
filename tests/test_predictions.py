import numpy as np
import pytest
import xarray as xr
from scipy.special import expit, ndtr

from bayespbrl.diagnostics import answer_probabilities, prequential_predictions
from bayespbrl.diagnostics.predictions import held_out_probabilities, refit
from bayespbrl.models import Answers, PreferenceModel, posterior_draws, sample_posterior
from bayespbrl.models.low_rank import low_rank
from bayespbrl.models.posterior import SamplerOptions
from bayespbrl.models.posterior_tree import next_lapse_rates

SAMPLING = {"num_warmup": 100, "num_samples": 400, "max_samples": 400}
SAMPLE = ("chain", "draw")
KNOWN = np.array([[0.8, -0.3, 0.0], [0.2, 0.9, 0.0]])
ASKED = np.array([[1.0, 0.4, 0.7], [-0.3, 0.5, 0.0], [0.0, 0.0, 1.3], [0.0, 0.0, 0.0], [0.8, -0.3, 0.0]])


def prior_grid(scale):
    """Points w (n, 3) and their prior weights: the trapezoidal rule on a grid that has no point on a jump."""
    line = np.linspace(-6.03, 6.07, 121)
    w = scale * np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    weights = np.exp(-np.sum((w / scale) ** 2, axis=1) / 2)
    return w, weights / weights.sum()


MODELS = {
    "mixed": (
        {"likelihood": "mixed", "steepness": 3.0, "prior_scale": 0.7},
        lambda t: ((t > 0) + expit(3 * t)) / 2,
    ),
    "probit with lapses": (
        {"likelihood": "probit", "steepness": 2.0, "lapse_rate": 0.2, "prior_scale": 1.5},
        lambda t: 0.1 + 0.8 * ndtr(2 * t),
    ),
    "logistic with ties": (
        {"likelihood": "logistic", "steepness": 4.0, "tie_threshold": 0.3},
        lambda t: expit(4 * (t - 0.3)),
    ),
    "probit with lapses and ties": (
        {"likelihood": "probit", "steepness": 4.0, "lapse_rate": 0.3, "tie_threshold": 0.3},
        lambda t: 0.1 + 0.7 * ndtr(4 * (t - 0.3)),
    ),
}


@pytest.mark.parametrize(
    "name", ["mixed", *(pytest.param(name, marks=pytest.mark.slow) for name in MODELS if name != "mixed")]
)
def test_predictions_agree_with_quadrature_over_all_utility_weights(name):
    options, p = MODELS[name]
    tree = sample_posterior(KNOWN, **options, **SAMPLING, seed=1)
    w, weights = prior_grid(options.get("prior_scale", 1.0))
    weights = weights * np.prod(p(w @ KNOWN.T), axis=1)
    weights /= weights.sum()
    margins = w @ ASKED.T
    # exactly ½ at a jump: no point of the grid is there but for the row of zeros
    expected = np.stack([weights @ p(margins), weights @ p(-margins)], axis=1)
    if name == "mixed":
        expected[3] = 0.5
    got = answer_probabilities(tree, ASKED)
    np.testing.assert_allclose(got[:, :2], expected, atol=0.02)
    np.testing.assert_allclose(got.sum(axis=1), 1.0, atol=1e-9)
    assert np.all(got[:, 2] > 0.1) if "ties" in name else np.all(got[:, 2] == 0)
    if "ties" not in name:  # by symmetry, in every draw: nothing is known of the third feature
        np.testing.assert_allclose(got[2:4, :2], 0.5, atol=1e-12)


@pytest.mark.parametrize("settings", [KNOWN, np.array([KNOWN, 3.0 * KNOWN[:, ::-1]])], ids=["one setting", "two"])
def test_the_opposite_question_has_the_opposite_answer(settings):
    rng, shape = np.random.default_rng(0), (2, 50)
    number = rng.integers(1 if settings.ndim == 2 else 2, size=shape)
    bases = [low_rank(rows).basis for rows in settings.reshape(-1, *KNOWN.shape)]
    weights = rng.normal([1.0, 0.5, 0.0], 0.3, size=(*shape, 3))
    drawn = {
        "coordinates": ((*SAMPLE, "coordinate"), np.einsum("cdf,cdfr->cdr", weights, np.array(bases)[number])),
        "setting": (SAMPLE, number),
        "steepness": (SAMPLE, rng.uniform(2, 6, size=shape)),
        "lapse_rate": ((*SAMPLE, "answerer"), rng.uniform(0, 0.3, size=(*shape, 1))),
        "tie_threshold": (SAMPLE, rng.uniform(0.1, 0.3, size=shape)),
    }
    attributes = vars(PreferenceModel(1.3, 4.0, 0.1, "mixed", 0.2)) | {"number_of_preferences": 2}
    dimensions = ("setting", "preference", "feature")[3 - settings.ndim :]
    tree = xr.DataTree.from_dict(
        {
            "/": xr.Dataset(attrs=attributes),
            "/posterior": xr.Dataset(drawn),
            "/observed_data": xr.Dataset({"answers": ("preference", np.array([1, 0]))}),
            "/constant_data": xr.Dataset({"differences": (dimensions, settings)}),
        }
    )
    asked = np.broadcast_to(ASKED, (*settings.shape[:-2], *ASKED.shape))
    forth, back = answer_probabilities(tree, asked), answer_probabilities(tree, -asked)
    np.testing.assert_allclose(forth[:, [1, 0, 2]], back, atol=1e-12)
    np.testing.assert_allclose(forth.sum(axis=1), 1.0, atol=1e-12)
    assert abs(forth[0, 0] - forth[0, 1]) > 0.1


@pytest.mark.slow
def test_each_draw_predicts_by_its_own_setting_steepness_and_lapse_rate():
    settings = np.array([KNOWN, 3.0 * KNOWN[:, ::-1]])
    more = {"num_samples": 1000, "max_samples": 1000}  # so many that every second draw suffices
    tree = sample_posterior(settings, steepness=None, lapse_rate=None, likelihood="logistic", **more)
    asked = np.array([ASKED, 3.0 * ASKED[:, ::-1]])[:, -1:]  # the first answer again, without any part outside
    drawn = tree["posterior"].dataset.isel(draw=slice(None, None, 2))
    margins = drawn["margins"].values[:, :, 0]
    lapse_rate = drawn["lapse_rate"].values[:, :, 0]
    p = lapse_rate / 2 + (1 - lapse_rate) * expit(drawn["steepness"].values * margins)
    assert len(np.unique(drawn["setting"])) == 2
    np.testing.assert_allclose(answer_probabilities(tree, asked)[0], [p.mean(), 1 - p.mean(), 0], atol=1e-6)


@pytest.mark.slow
def test_where_the_model_rules_out_every_order_neither_is_likelier():
    differences, first = np.array([[1.0, 0.0], [0.5, 1.0]]), np.array([True, False])
    model = PreferenceModel(tie_threshold=200.0)
    predicted = prequential_predictions(differences, first, model, answers=Answers(np.array([True, True])))
    np.testing.assert_array_equal(predicted, 0.5)


def test_without_answers_the_prior_predicts():
    nothing, everything = np.zeros(5, dtype=bool), np.ones(5, dtype=bool)
    model = PreferenceModel(steepness=2.0, tie_threshold=0.4, likelihood="probit", prior_scale=0.7)
    got, converged = held_out_probabilities(ASKED, model, nothing, everything)
    width = np.sqrt(0.25 + 0.49 * np.sum(ASKED**2, axis=1))  # w·d + noise of a probit is normal
    np.testing.assert_allclose(got[:, 0], ndtr(-0.4 / width), rtol=1e-12)
    np.testing.assert_allclose(got.sum(axis=1), 1.0, rtol=1e-12)
    assert converged


@pytest.mark.slow
def test_a_refit_without_some_answers_keeps_the_full_number_of_preferences_and_the_model():
    tree = sample_posterior(KNOWN, steepness=3.0, prior_scale=0.7, seed=4, **SAMPLING)
    others = refit(tree, np.array([True, False]), **SAMPLING)
    direct = sample_posterior(KNOWN[:1], steepness=3.0, prior_scale=0.7, seed=4, number_of_preferences=2, **SAMPLING)
    np.testing.assert_array_equal(others["posterior"]["margins"], direct["posterior"]["margins"])
    # what it predicts is by eq. 8 with K = 2 as well: more sure than the sigmoid of K = 1
    by_two = answer_probabilities(others, KNOWN[1:])
    model = PreferenceModel(steepness=3.0, prior_scale=0.7)
    held_out, _ = held_out_probabilities(KNOWN, model, np.array([0]), np.array([1]), seed=4, **SAMPLING)
    np.testing.assert_array_equal(by_two, held_out)
    direct.attrs["number_of_preferences"] = 1
    assert abs(answer_probabilities(direct, KNOWN[1:])[0, 0] - 0.5) < abs(by_two[0, 0] - 0.5)


@pytest.mark.parametrize("bad", [np.zeros(3), np.zeros((2, 4)), np.array([[0.0, np.nan, 1.0]])])
def test_differences_that_do_not_fit_are_refused(bad):
    tree = sample_posterior(np.zeros((0, 3)), num_warmup=25, num_samples=25, max_samples=25)
    with pytest.raises(ValueError, match=r"differences: expected .* got"):
        answer_probabilities(tree, bad)


@pytest.mark.parametrize("sides", [[0.5, np.nan], [5, -7], [1], [1, -1, 1]])
def test_sides_that_are_none_are_refused(sides):
    tree = sample_posterior(np.eye(3)[:2], shown_first=[1, -1], num_warmup=25, num_samples=25, max_samples=25)
    with pytest.raises(ValueError, match="shown_first: expected"):
        answer_probabilities(tree, np.ones((2, 3)), Answers(shown_first=sides))


def test_who_is_asked_and_which_side_is_shown_count_by_hand():
    rows = np.array([[1.0], [0.6], [-0.5], [0.8], [-0.9], [0.3]])
    sides, who = np.array([1, -1, 1, 1, 1, -1]), ["Ada", "Bob", "Bob", "Ada", "Bob", "Ada"]
    tree = sample_posterior(rows, lapse_rate=None, likelihood="logistic", shown_first=sides, answerers=who)
    drawn = tree["posterior"].dataset
    asked = np.array([[0.4], [0.4], [-0.2]])

    def by_hand(rate, bias):
        margins = drawn["utility_weights"].values @ asked.T + bias
        p = rate / 2 + (1 - rate) / (1 + np.exp(-5.0 * margins))
        return p.mean(axis=(0, 1))

    rates, biases = drawn["lapse_rate"].values, drawn["side_bias"].values
    got = answer_probabilities(tree, asked, Answers(None, np.array([1, -1, 1]), ["Ada", "Bob", "Bob"]))
    chosen = by_hand(rates[:, :, [0, 1, 1]], biases[:, :, [0, 1, 1]] * np.array([1, -1, 1]))
    np.testing.assert_allclose(got[:, 0], chosen, atol=1e-9)
    np.testing.assert_allclose(got.sum(axis=1), 1)
    whoever = answer_probabilities(tree, asked)  # each answered three times
    np.testing.assert_allclose(whoever[:, 0], by_hand(rates.mean(axis=2, keepdims=True), 0.0), atol=1e-9)
    with pytest.raises(ValueError, match="answerers: expected names among Ada, Bob, got Eve"):
        answer_probabilities(tree, asked, Answers(answerers=["Ada", "Bob", "Eve"]))


def test_answers_with_sides_are_predicted_one_after_the_other():
    rows, sides = np.array([[1.0], [0.6], [0.5]]), np.array([1, -1, 1])
    answers = Answers(None, sides, ["Ada", "Bob", "Ada"])
    first = sides > 0
    predicted = prequential_predictions(rows, first, PreferenceModel(lapse_rate=None), answers=answers, num_samples=100)
    assert predicted[0] == pytest.approx(0.5, abs=0.02)  # nothing is known yet
    assert predicted[1] < 0.45  # the second shown is the better one, as Ada said
    assert predicted[2] > 0.55


def test_the_next_answer_is_by_anybody_in_proportion_to_their_answers_so_far():
    rows, who = np.random.default_rng(0).normal(size=(5, 2)), np.array([0, 1, 1, 1, 1])
    model, few = PreferenceModel(lapse_rate=None), SamplerOptions(25, 25, 25)
    tree = posterior_draws(rows, model, seed=0, answers=Answers(answerers=who), sampler=few)
    rates = tree["posterior/lapse_rate"].values
    np.testing.assert_allclose(next_lapse_rates(tree), 0.2 * rates[..., 0] + 0.8 * rates[..., 1])
