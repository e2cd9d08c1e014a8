"""Schedules of the KL bound: what they decide from, and what a run makes of it."""

from types import SimpleNamespace

import numpy as np
import pytest

from bayespbrl import Learner, load, resume, start
from bayespbrl.experts import ReturnExpert
from bayespbrl.improvement import ProposedUpdate
from bayespbrl.schedules import BOUNDS, Bound, ConfidenceBound, ConstantBound, Situation, decided

NUMBER = 400


def proposed(draws=None, seed=0):
    rng = np.random.default_rng(seed)
    return ProposedUpdate(
        rng.normal(size=NUMBER), rng.normal(size=(NUMBER, 3)), np.full(NUMBER, 1 / NUMBER), q_draws=draws
    )


def situation(update, *, converged=True, usual=0.35):
    quality = SimpleNamespace(converged=converged, rhat_max=1.002, effective_sample_size_min=900.0)
    return Situation(3, 4, usual, SimpleNamespace(quality=quality), update)


def test_the_gain_of_the_mean_itself_is_what_reps_promises_and_grows_with_the_bound():
    mean = proposed().q_values
    update = proposed(np.column_stack([mean, 2 * mean + 5, -mean]))
    gains = [update.gains(bound) for bound in (0.05, 0.2, 0.8)]
    for bound, gain in zip((0.05, 0.2, 0.8), gains, strict=True):
        reps = update.solve(bound)
        assert gain[0] == pytest.approx(reps.probabilities @ mean - mean.mean())
        np.testing.assert_allclose(gain[1:], [2 * gain[0], -gain[0]], rtol=1e-9)  # a constant is no gain
        assert reps.kl == pytest.approx(bound, rel=1e-4)
    assert 0 < gains[0][0] < gains[1][0] < gains[2][0]
    assert update.agreement(0.2) == pytest.approx(2 / 3)


def test_certain_draws_allow_the_largest_bound_and_draws_at_odds_the_least():
    mean = proposed().q_values
    sure = ConfidenceBound()(situation(proposed(np.column_stack([mean] * 10))))
    assert (sure.kl_bound, sure.statistics["agreement"]) == (max(BOUNDS), 1.0)
    at_odds = ConfidenceBound()(situation(proposed(np.column_stack([mean, -mean]))))
    assert (at_odds.kl_bound, at_odds.statistics["agreement"]) == (min(BOUNDS), 0.5)
    assert "fewer than 90%" in at_odds.reason
    assert sure.statistics["rhat_max"] == 1.002


def test_the_bound_is_the_largest_at_which_the_draws_agree():
    """A draw that likes what the mean likes, but for the very best tenth: small updates please it, bold ones do not."""
    mean = proposed().q_values
    draw = np.where(mean > np.quantile(mean, 0.97), -20.0, mean)
    update = proposed(np.column_stack([draw] * 10))
    bound = ConfidenceBound(bounds=(0.001, 0.01, 0.1, 1.0, 2.0))(situation(update))
    agreements = [update.agreement(value) for value in (0.001, 0.01, 0.1, 1.0, 2.0)]
    assert agreements[-1] == 0.0
    largest = max((v for v, a in zip((0.001, 0.01, 0.1, 1.0, 2.0), agreements, strict=True) if a >= 0.9), default=0.001)
    assert bound.kl_bound == largest


def test_a_posterior_that_has_not_converged_never_raises_the_bound():
    mean = proposed().q_values
    update = proposed(np.column_stack([mean] * 10))
    assert ConfidenceBound()(situation(update, converged=False)).kl_bound == 0.35
    assert ConfidenceBound()(situation(update, converged=False, usual=0.05)).kl_bound == 0.1
    assert ConfidenceBound()(situation(proposed(), usual=0.27)).kl_bound == 0.27  # no posterior


def test_the_constant_bound_is_the_runs_or_its_own():
    assert ConstantBound()(situation(proposed(), usual=0.2)).kl_bound == 0.2
    assert ConstantBound(0.6)(situation(proposed(), usual=0.2)).kl_bound == 0.6


@pytest.mark.parametrize("value", [0, -0.1, float("nan"), float("inf"), None, "0.3", True])
def test_a_schedule_that_decides_nonsense_is_named(value):
    def careless(situation):
        return value

    with pytest.raises(ValueError, match="schedule careless: expected a positive finite KL bound, got"):
        decided(careless, situation(proposed()))


@pytest.mark.parametrize("options", [{"bounds": ()}, {"bounds": (0.1, -1.0)}, {"confidence": 0.0}, {"confidence": 1.2}])
def test_bad_options_are_refused(options):
    with pytest.raises(ValueError, match=f"{next(iter(options))}: expected"):
        ConfidenceBound(**options)


def three_lines(situation):
    return Bound(0.2 if situation.iteration == 1 else 0.4, "by the clock", {"answers": float(situation.answers)})


def test_a_run_follows_a_schedule_of_the_users_own_records_why_and_goes_on_with_it(tmp_path):
    learner = start("gridworld", tmp_path / "run", schedule=three_lines, iterations=3, evaluation_episodes=5)
    expert = ReturnExpert()
    while len(learner.iterations) < 2:
        learner.tell([expert(*query.trajectories) for query in learner.ask()])
    with pytest.raises(ValueError, match=r"a run with schedule of the user's own: expected it again as schedule="):
        resume(tmp_path / "run")
    whole = resume(tmp_path / "run", schedule=three_lines).run(expert)
    assert [summary["kl_bound"] for summary in whole.iterations] == [0.2, 0.4, 0.4]
    assert whole.iterations[0]["schedule"] == {"reason": "by the clock", "answers": 2.0}
    assert load(tmp_path / "run").iterations == whole.iterations  # reading needs no schedule


def test_the_bound_follows_the_posterior_of_a_run_and_comes_from_the_same_choices():
    learner = Learner("gridworld", schedule="confidence", iterations=3, evaluation_episodes=5).run(ReturnExpert())
    for summary in learner.iterations:
        assert summary["kl_bound"] in BOUNDS
        assert 0 <= summary["schedule"]["agreement"] <= 1
        assert summary["schedule"]["rhat_max"] == summary["rhat_max"]


def test_a_schedule_that_asks_the_posterior_needs_one():
    with pytest.raises(ValueError, match="schedule: expected constant with linear-program, no posterior"):
        Learner("gridworld", schedule="confidence", utility="linear-program")
    with pytest.raises(ValueError, match="schedule: expected a function of the user's own beside 'other'"):
        Learner("gridworld", schedule="other")
