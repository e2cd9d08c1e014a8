"""The check of an update: the newest policy beside the best by the utility of their trajectories."""

from types import SimpleNamespace

import numpy as np
import pytest

from bayespbrl.cycle import Cycle
from bayespbrl.events.state import NumberedPolicy, Restart
from bayespbrl.improvement.check import (
    CLEARLY,
    LEAST_TRUST,
    POSSIBLY,
    Check,
    checked,
    judged,
    median_differences,
    share_better,
)
from bayespbrl.preferences import Answer

NOISE = np.array([-1.0, 1.0, -0.5, 0.5])


@pytest.mark.parametrize(
    ("gain", "trust", "expected"),
    [
        (0.2, 0.5, (7, 1.0, False)),  # a step forward
        (0.2, 0.05, (7, 0.1, False)),
        (-0.2, 0.5, (3, 0.5, False)),  # within the error: it goes on, and the best stays
        (-0.4, 0.5, (3, 0.5, False)),
        (-0.6, 0.5, (3, 0.25, True)),  # the standard error is 0.46
        (0.0, 0.5, (3, 0.5, False)),
        (-2.0, 0.5, (3, 0.25, True)),  # a step back
        (-2.0, 0.06, (3, LEAST_TRUST, True)),
    ],
)
def test_a_step_forward_is_kept_and_a_step_back_is_taken_back(gain, trust, expected):
    check = checked(NOISE + gain, newest=7, best=3, trust=trust)
    assert (check.best, check.trust, check.stepped_back) == expected
    assert check.gain == pytest.approx(gain)
    assert check.standard_error == pytest.approx(np.std(NOISE, ddof=1) / 2)


def test_equal_trajectories_change_nothing():
    assert checked(np.zeros(4), newest=7, best=3, trust=0.5) == Check(3, 0.5)


def test_most_draws_decide_and_not_a_few_of_large_utilities():
    newest = np.array([[50.0, 50.0], [-1.0, -1.0], [-1.0, -2.0]])  # three draws, two starts
    assert np.mean(newest) > 0
    np.testing.assert_array_equal(median_differences(newest, np.zeros((3, 2))), [-1, -1])
    np.testing.assert_array_equal(median_differences(newest[:1], np.ones((1, 2))), [49, 49])  # the mean alone


@pytest.mark.parametrize(("newest", "share"), [([[3, -1]], 1), ([[1, -1]], 0), ([[9, 9], [-1, 0], [2, -1]], 2 / 3)])
def test_a_draw_prefers_what_is_better_in_the_mean_over_the_starts(newest, share):
    assert share_better(np.array(newest, dtype=float), np.zeros((len(newest), 2))) == share


class Posterior:
    """Draws of a utility, and their mean, whatever the trajectories; a trajectory is its own row of draws."""

    posterior = "some"

    def trajectory_draws(self, trajectories):
        return np.array(trajectories).T

    def trajectory_utilities(self, trajectories):
        return np.mean(trajectories, axis=1)


@pytest.mark.parametrize(
    ("worse", "kept", "asked_about"),
    [(0, True, True), (2, True, True), (3, False, True), (6, False, True), (7,) + 2 * (False,)],
)
def test_three_in_four_draws_keep_a_policy_and_one_in_four_asks_about_it(worse, kept, asked_about):
    draws = np.r_[np.full(worse, -1.0), np.full(8 - worse, 100.0)]
    tried = [draws + 2.0, draws - 2.0]  # two starts, of which the mean counts
    share = share_better(judged(Posterior(), tried), judged(Posterior(), np.zeros((2, 8))))
    assert (share >= CLEARLY) == kept
    assert (share >= POSSIBLY) == asked_about


def test_without_a_posterior_the_estimate_decides():
    estimate = Posterior()
    estimate.posterior = None
    equal = judged(estimate, np.zeros((1, 3)))
    assert share_better(judged(estimate, [np.r_[-1.0, -1.0, 3.0]]), equal) >= CLEARLY
    assert share_better(equal, equal) < POSSIBLY
    posterior = judged(Posterior(), [np.r_[-1.0, -1.0, 3.0]], by_draws=False)
    np.testing.assert_array_equal(posterior, [[1 / 3]])


def test_the_median_over_the_draws_is_that_of_the_differences():
    newest, best = np.array([[1.0], [2.0], [9.0]]), np.array([[0.0], [5.0], [7.0]])  # 1, -3, 2; of each alone 2 and 5
    np.testing.assert_array_equal(median_differences(newest, best), [1])


@pytest.mark.parametrize(("newest", "best", "better"), [(5.0, 1.0, 7), (1.0, 5.0, 3)])
def test_the_utilities_that_come_with_a_check_are_of_the_better_policy(newest, best, better):
    state = SimpleNamespace(
        iteration=7,
        started=0,
        trust=1.0,
        newest=NumberedPolicy(7, None, (newest, newest + 1)),
        best=NumberedPolicy(3, None, (best, best + 1)),
    )
    cycle = SimpleNamespace(_judged=lambda utility, tried: np.array([tried]))
    check, of_best = Cycle._check(cycle, state, None)
    assert check.best == better
    np.testing.assert_array_equal(of_best, [[5, 6]])


@pytest.mark.parametrize(
    ("answer", "newest", "kept", "marks"),
    [
        (Answer.FIRST, 3.0, 9, {"confirmed": True, "nominated": True}),
        (Answer.FIRST, 1.0, 9, {"confirmed": True}),  # better than what was kept, but not than what is now
        (Answer.SKIP, 1.0, 5, {"nominated": True}),
    ],
)
def test_a_restarted_policy_is_kept_once_asked_about_and_the_next_one_has_to_be_better_than_it(
    answer, newest, kept, marks
):
    def tried(utility):
        return np.full(4, utility), np.full(4, utility)

    utility = SimpleNamespace(posterior="drawn", trajectory_draws=lambda tried: np.array(tried).T)
    restart = Restart(5, NumberedPolicy(5, None, tried(0.0)))
    state = SimpleNamespace(
        past=(SimpleNamespace(newcomer=19, answer=answer),),
        iteration=9,
        started=5,
        trajectories=range(20),
        newest=NumberedPolicy(9, None, tried(2.0)),
    )
    assert Cycle._confirmed(None, state, restart, utility, tried(newest)) == (kept, marks)
