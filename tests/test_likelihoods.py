import jax
import numpy as np
import pytest
from scipy.special import expit, log_ndtr, ndtr

from bayespbrl.models import PreferenceModel
from bayespbrl.models.likelihoods import (
    Likelihood,
    Logistic,
    Mixed,
    Probit,
    WithLapses,
    WithTies,
    likelihood_of,
    log_prob,
    smoothed_probability,
    ties_of,
    total_log_prob,
    with_threshold,
)
from bayespbrl.models.priors import LAPSE_RATE, STEEPNESS, TIE_THRESHOLD

ALL = [
    Mixed(5.0, 7.0),
    Mixed(0.3, 1.0),
    Mixed(80.0, 320.0),
    Logistic(2.0),
    Probit(3.0),
    WithLapses(Mixed(5.0, 7.0), 0.4),
]
MARGINS = np.concatenate([np.linspace(-4, 4, 201), [1e-9, -1e-9]])


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def probability(likelihood, margins=MARGINS):
    return np.exp(np.asarray(log_prob(likelihood, margins)))


def test_mixed_is_equation_8():
    k, m = 7.0, 5.0
    expected = ((k - 1) * np.where(MARGINS == 0, 0.5, MARGINS > 0) + expit(m * MARGINS)) / k
    np.testing.assert_allclose(probability(Mixed(m, k)), expected, rtol=1e-13)


def test_one_preference_leaves_the_sigmoid():
    np.testing.assert_allclose(probability(Mixed(5.0, 1.0)), expit(5 * MARGINS), rtol=1e-13)


def test_probit_and_logistic_are_their_distribution_functions():
    np.testing.assert_allclose(probability(Probit(3.0)), ndtr(3 * MARGINS), rtol=1e-12)
    np.testing.assert_allclose(probability(Logistic(3.0)), expit(3 * MARGINS), rtol=1e-12)


def test_lapses_are_a_share_of_coin_tosses():
    base = Mixed(5.0, 7.0)
    np.testing.assert_allclose(probability(WithLapses(base, 0.4)), 0.2 + 0.6 * probability(base), rtol=1e-13)


@pytest.mark.parametrize("tied", [False, True])
def test_where_ties_are_possible_a_lapse_is_one_of_three_answers(tied):
    answers = WithTies(Mixed(5.0, 7.0), 0.3, np.full(len(MARGINS), tied))
    np.testing.assert_allclose(probability(WithLapses(answers, 0.3)), 0.1 + 0.7 * probability(answers), rtol=1e-13)


def test_a_tie_far_from_a_tie_is_a_lapse():
    tie = WithLapses(WithTies(Logistic(50.0), 0.1, np.array([True])), 0.3)
    np.testing.assert_allclose(log_prob(tie, np.array([1e3])), np.log(0.1), rtol=1e-12)


@pytest.mark.parametrize("likelihood", ALL)
def test_both_answers_sum_to_one_and_a_zero_margin_is_a_coin_toss(likelihood):
    np.testing.assert_allclose(probability(likelihood) + probability(likelihood, -MARGINS), 1, rtol=1e-12)
    np.testing.assert_allclose(probability(likelihood, np.zeros(1)), 0.5, rtol=1e-15)


@pytest.mark.parametrize("likelihood", ALL)
def test_two_orders_and_a_tie_sum_to_one(likelihood):
    ordered = with_threshold(likelihood, 0.3, np.zeros(len(MARGINS), dtype=bool))
    tie = with_threshold(likelihood, 0.3, np.ones(len(MARGINS), dtype=bool))
    np.testing.assert_allclose(probability(ordered) + probability(ordered, -MARGINS) + probability(tie), 1, rtol=1e-11)


def test_ties_vanish_as_the_threshold_does():
    likelihood, none = Logistic(5.0), np.zeros(len(MARGINS), dtype=bool)
    np.testing.assert_allclose(probability(WithTies(likelihood, 1e-12, none)), probability(likelihood), rtol=1e-9)


SOME_TIES = WithTies(Logistic(4.0), 0.2, np.arange(len(MARGINS)) % 2 == 0)


@pytest.mark.parametrize("likelihood", [*ALL, SOME_TIES, WithLapses(SOME_TIES, 0.3)])
def test_the_mixture_of_probits_is_the_likelihood(likelihood):
    constant, weights, offsets, scales = likelihood.probit_mixture()
    away = np.where(MARGINS[:, None] > offsets, np.inf, np.where(MARGINS[:, None] < offsets, -np.inf, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        x = np.where(scales > 0, (MARGINS[:, None] - offsets) / scales, away)
    mixture = constant + np.sum(weights * ndtr(x), axis=1)
    np.testing.assert_allclose(mixture, probability(likelihood), rtol=0, atol=1e-12)


@pytest.mark.parametrize("likelihood", ALL)
def test_the_total_is_the_sum_over_used_answers(likelihood):
    margins = np.random.default_rng(0).normal(size=(3, 71)) * 3
    used = np.arange(71) % 3 > 0
    expected = np.sum(np.asarray(log_prob(likelihood, margins))[:, used], axis=1)
    np.testing.assert_allclose(total_log_prob(likelihood, margins, used), expected, rtol=1e-12)


def test_far_tails_are_finite_and_nan_stays_nan():
    values = np.asarray(log_prob(Mixed(5.0, 40.0), np.array([-1e6, 1e6, np.nan])))
    np.testing.assert_allclose(values[:2], [-5e6 - np.log(40), 0], rtol=1e-12)
    assert np.isnan(values[2])
    np.testing.assert_allclose(log_prob(Probit(1.0), np.array([-30.0])), log_ndtr(-30.0), rtol=1e-10)


def test_all_meet_the_protocol_and_bad_settings_are_named():
    assert all(isinstance(likelihood, Likelihood) for likelihood in ALL)
    for settings, message in (
        ({"prior_scale": 0.0}, "prior_scale"),
        ({"steepness": 0.0}, "steepness"),
        ({"steepness": np.nan}, "steepness"),
        ({"lapse_rate": 1.0}, "lapse_rate"),
        ({"lapse_rate": -0.1}, "lapse_rate"),
        ({"likelihood": "nonsense"}, "likelihood"),
        ({"tie_threshold": 0.0}, "tie_threshold"),
    ):
        with pytest.raises(ValueError, match=f"^{message}: expected"):
            PreferenceModel(**settings)


def test_ties_without_which_answers_they_are_and_twice_a_threshold_are_refused():
    with pytest.raises(ValueError, match="indifferent: expected which answers were ties"):
        likelihood_of("logistic", 2, steepness=1.0, tie_threshold=0.2)
    tied = WithTies(Logistic(1.0), 0.2, np.array([True]))
    with pytest.raises(ValueError, match="likelihood: expected one without ties, got WithTies"):
        with_threshold(tied, 0.2, np.array([True]))
    with pytest.raises(ValueError, match="likelihood: expected one of this module, got object"):
        smoothed_probability(object(), np.zeros(1), np.zeros(1))


def test_a_preference_model_names_its_likelihood():
    tied = np.array([True, False])
    assert PreferenceModel(steepness=3).answer_likelihood(2) == Mixed(3.0, 2.0)
    assert PreferenceModel().answer_likelihood(0) == Mixed(5.0, 1.0)
    assert PreferenceModel(likelihood="logistic").answer_likelihood(2) == Logistic(5.0)
    lapsing = PreferenceModel(likelihood="probit", lapse_rate=0.1, tie_threshold=0.2)
    with_ties = lapsing.answer_likelihood(2, tied)
    ties = ties_of(with_ties)
    assert (with_ties.lapse_rate, ties.ordered, ties.threshold) == (0.1, Probit(5.0), 0.2)
    np.testing.assert_array_equal(ties.indifferent, tied)
    np.testing.assert_array_equal(ties_of(lapsing.answer_likelihood(3)).indifferent, np.zeros(3, dtype=bool))
    assert ties_of(PreferenceModel(lapse_rate=0.1).answer_likelihood(2)) is None
    # what is not given is at its prior's mean
    inferred = PreferenceModel(steepness=None, lapse_rate=None).answer_likelihood(2, tied)
    assert ties_of(inferred).threshold == pytest.approx(TIE_THRESHOLD.mean)
    assert (ties_of(inferred).ordered.steepness, inferred.lapse_rate) == (STEEPNESS.mean, LAPSE_RATE.mean)
    with pytest.raises(ValueError, match=r"indifferent: expected bool of shape \(K,\)"):
        lapsing.answer_likelihood(2, np.zeros(2))


def test_many_ties_at_a_tiny_threshold_do_not_overflow():
    tied = with_threshold(Mixed(5.0, 32), 1e-12, np.ones(32, dtype=bool))
    assert float(total_log_prob(tied, np.zeros(32))) == pytest.approx(float(log_prob(tied, np.zeros(32)).sum()))
