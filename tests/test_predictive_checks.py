"""Posterior predictive checks and the calibration of the schedule."""

import numpy as np
import pytest

from bayespbrl.diagnostics import gain_calibration, predictive_checks
from bayespbrl.models import sample_posterior

ITEMS = np.random.default_rng(0).normal(size=(7, 3))
PAIRS = [(i, j) for i in range(7) for j in range(i)]
OPTIONS = {"num_samples": 100, "max_samples": 100, "seed": 1}


def differences(signs):
    return np.array([(ITEMS[i] - ITEMS[j]) * sign for (i, j), sign in zip(PAIRS, signs, strict=True)])


@pytest.mark.slow
def test_answers_that_a_utility_explains_pass_and_random_answers_without_lapses_do_not():
    margins = np.array([(ITEMS[i] - ITEMS[j]) @ [1.0, -0.5, 0.3] for i, j in PAIRS])
    explained = predictive_checks(sample_posterior(differences(np.sign(margins)), **OPTIONS))
    assert explained["observed"].sel(check="cycles") == 0
    assert np.all((explained["p_value"].values[:2] > 0.05) & (explained["p_value"].values[:2] < 0.99))
    assert np.isnan(explained["p_value"].sel(check="ties"))
    tossed = np.random.default_rng(3).choice([-1.0, 1.0], len(PAIRS))
    random = predictive_checks(sample_posterior(differences(tossed), **OPTIONS))
    assert random["possible"].sel(check="cycles") == 35  # every triad of seven things
    assert random["observed"].sel(check="cycles") > 3
    assert random["p_value"].sel(check="surprises") < 0.01
    assert random["p_value"].sel(check="cycles") < 0.01
    # with lapses the same answers are no surprise
    lapses = predictive_checks(sample_posterior(differences(tossed), lapse_rate=None, **OPTIONS))
    assert lapses["p_value"].sel(check="surprises") > 0.01


@pytest.mark.slow
def test_ties_are_counted_where_they_are_possible_and_a_pair_asked_twice_can_contradict_itself():
    rows = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    tied = np.array([False, False, True, False])
    result = predictive_checks(sample_posterior(rows, indifferent=tied, lapse_rate=None, **OPTIONS))
    assert result["observed"].sel(check="ties") == 1
    assert 0.05 < result["p_value"].sel(check="ties") < 0.95
    assert result["possible"].sel(check="ties") == 4
    # the first two contradict each other; the tie states no order, so that the triad of the others is no cycle
    assert result["observed"].sel(check="cycles") == 1


def test_an_answer_about_two_equal_things_cannot_surprise():
    result = predictive_checks(sample_posterior(np.array([[1.0, 0.0], [0.0, 0.0]]), **OPTIONS))
    assert result["possible"].sel(check="surprises") == 1
    nothing = predictive_checks(sample_posterior(np.zeros((2, 2)), **OPTIONS))
    assert np.isnan(nothing["p_value"].sel(check="surprises"))


def test_no_answer_leaves_nothing_to_check():
    result = predictive_checks(sample_posterior(np.zeros((0, 2)), **OPTIONS))
    assert np.all(result["possible"] == 0)
    assert np.all(np.isnan(result["p_value"]))


def test_gains_are_counted_by_what_the_schedule_said():
    def run(*pairs):
        return [{"value_newest": value, "schedule": {"agreement": said} if said else None} for value, said in pairs]

    runs = [run((0, 0.95), (1, 0.95), (2, 0.3), (1, 0.97)), run((5, None), (6, 0.3), (7, None)), run((1, 0.3))]
    result = gain_calibration(runs, edges=(0, 0.5, 1))
    np.testing.assert_allclose(result["updates"], [2, 2])
    np.testing.assert_allclose(result["gained"], [1.0, 0.5])
    np.testing.assert_allclose(result["stated"], [0.3, 0.96])
    part = gain_calibration(runs, edges=(0.5, 0.96))  # 0.3 and 0.97 are in no bin
    np.testing.assert_allclose([part["updates"], part["stated"], part["gained"]], [[1], [0.95], [1.0]])
    back = run((3, 0.3), (-1, 0.3), (2, 0.3))
    back[2]["check"] = {"stepped_back": True, "best": 1}  # from 3 to 2
    np.testing.assert_allclose(gain_calibration([back], edges=(0, 0.5, 1))["gained"][0], 0.0)
    at_edges = gain_calibration([run((0, None), (1, 0.25), (2, 0.5), (1, 1.0))], edges=(0.25, 0.5, 1))
    np.testing.assert_allclose(
        [at_edges["updates"], at_edges["stated"], at_edges["gained"]], [[1, 2], [0.25, 0.75], [1, 0.5]]
    )
    assert np.all(gain_calibration([], "signal")["updates"] == 0)
    with pytest.raises(ValueError, match="edges: expected"):
        gain_calibration(runs, edges=(1, 0))
    with pytest.raises(ValueError, match="runs: expected the iterations of several runs"):
        gain_calibration(runs[0])
    with pytest.raises(ValueError, match="runs: expected the iterations of several runs"):
        gain_calibration([7])
    with pytest.raises(ValueError, match="edges: expected at least two increasing numbers"):
        gain_calibration(runs, edges=(0, np.nan, 1))
    with pytest.raises(ValueError, match="statistic: expected one that the runs' schedule reported, got 'nonsense'"):
        gain_calibration(runs, "nonsense")
    restarted = [
        {"iteration": 1, "value_newest": 5.0},
        {"iteration": 2, "value_newest": 1.0, "schedule": {"agreement": 0.99}, "restarted": 1},  # no update of the last
        {"iteration": 3, "value_newest": 2.0, "schedule": {"agreement": 0.98}, "restarted": 1},
    ]
    result = gain_calibration([restarted], edges=(0, 1))
    np.testing.assert_allclose([result["updates"], result["gained"], result["stated"]], [[1], [1.0], [0.98]])
