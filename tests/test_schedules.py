"""Schedules of the KL bound: what they decide from, and what a run makes of it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from toys import SHORT

from bayespbrl import Learner, load, resume, start
from bayespbrl.experts import ReturnExpert
from bayespbrl.improvement.schedules import (
    LEAST_BOUND,
    SCHEDULES,
    Bound,
    ConfidenceBound,
    ConstantBound,
    Situation,
    decide,
)
from bayespbrl.improvement.update import ProposedUpdate

NUMBER = 400


def proposed(draws=None, seed=0):
    rng = np.random.default_rng(seed)
    return update_of(rng.normal(size=NUMBER), rng.normal(size=(NUMBER, 3)), draws)


def update_of(q_values, constraint, draws):
    """A proposed update as far as a schedule looks at it."""
    weights = np.full(len(q_values), 1 / len(q_values))
    return ProposedUpdate(None, None, None, (q_values, q_values), q_values, constraint, weights, draws)


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


def test_the_gain_of_the_smallest_updates_is_the_limit_of_the_others():
    rng = np.random.default_rng(4)
    update = proposed(proposed().q_values[:, None] + rng.normal(size=(NUMBER, 12)))
    direction, small = update.gains(), update.gains(1e-6)
    np.testing.assert_allclose(direction / direction[0], small / small[0], rtol=0.01)
    assert update.agreement() == update.agreement(1e-6)
    signals = [ConfidenceBound()(situation(update, usual=usual)).signal for usual in (0.1, 1.0)]
    assert signals[0] == signals[1] == pytest.approx(np.mean(small) ** 2 / np.mean(small**2), rel=0.01)


def test_a_q_that_is_constant_but_for_rounding_is_no_signal():
    values = 50 * (1 + 1e-10 * np.random.default_rng(1).normal(size=NUMBER))
    features = np.random.default_rng(2).normal(size=(NUMBER, 3))
    for constraint in (features, np.arange(NUMBER) // 2):
        update = update_of(values, constraint, np.outer(values, [0.5, 1.0, 2.0]))
        decision = ConfidenceBound()(situation(update))
        assert (decision.kl_bound, decision.signal) == (LEAST_BOUND, 0.0)


def test_features_of_the_constraint_that_are_not_finite_are_refused():
    update = update_of(np.arange(4.0), np.array([[0.0], [1.0], [np.nan], [2.0]]), np.eye(4))
    for use in (lambda: update.solve(0.3), update.gains):
        with pytest.raises(ValueError, match="state_features: expected finite entries"):
            use()


def test_certain_draws_allow_the_largest_bound_and_draws_at_odds_the_least():
    mean = proposed().q_values
    sure = ConfidenceBound()(situation(proposed(np.column_stack([mean] * 10))))
    assert sure.kl_bound == pytest.approx(1.0)
    assert (sure.signal, sure.statistics["agreement"]) == (pytest.approx(1.0), 1.0)
    assert ConfidenceBound(2.0)(situation(proposed(np.column_stack([mean] * 10)))).kl_bound == pytest.approx(2.0)
    at_odds = ConfidenceBound()(situation(proposed(np.column_stack([mean, -mean]))))
    assert (at_odds.kl_bound, at_odds.statistics["agreement"]) == (LEAST_BOUND, 0.5)
    assert "50% of the draws expect a gain" in at_odds.reason
    assert sure.statistics["rhat_max"] == 1.002
    worse = ConfidenceBound()(situation(proposed(np.column_stack([-mean] * 10))))
    assert (worse.kl_bound, worse.signal) == (LEAST_BOUND, 0.0)
    nothing = ConfidenceBound()(situation(proposed(np.zeros((NUMBER, 4)))))
    assert nothing.kl_bound == LEAST_BOUND


def test_the_bound_is_the_square_of_the_length_that_weighs_gain_against_spread():
    mean = proposed().q_values
    draws = np.column_stack([factor * mean for factor in (0.5, 1.0, 3.0, -1.0)])
    bound = ConfidenceBound(largest=0.8)(situation(proposed(draws)))
    gains = np.array([0.5, 1.0, 3.0, -1.0])
    lengths = np.linspace(0, 1, 100_001)
    worth = lengths * gains.mean() - 0.5 * lengths**2 * np.mean(gains**2) / gains.mean()
    assert bound.signal == pytest.approx(lengths[np.argmax(worth)], abs=1e-5)
    assert bound.kl_bound == pytest.approx(0.8 * bound.signal**2)
    assert bound.statistics["agreement"] == 0.75


def test_a_posterior_that_has_not_converged_never_raises_the_bound():
    mean = proposed().q_values
    update = proposed(np.column_stack([mean] * 10))
    assert ConfidenceBound()(situation(update, converged=False)).kl_bound == 0.35
    assert ConfidenceBound()(situation(update, converged=False, usual=0.6)).kl_bound == 0.6
    assert ConfidenceBound()(situation(update, converged=False, usual=0.05)).kl_bound == 0.05
    assert "not converged" in ConfidenceBound()(situation(update, converged=False)).reason
    at_odds = proposed(np.column_stack([mean, -0.5 * mean]))
    assert ConfidenceBound()(situation(at_odds, converged=False)).kl_bound == LEAST_BOUND
    assert ConfidenceBound()(situation(proposed(), usual=0.27)).kl_bound == 0.27  # no posterior


def test_the_signal_counts_the_sampling_error_of_q_beside_the_utilitys():
    update = proposed(np.column_stack([proposed().q_values] * 10))
    whole = ConfidenceBound()(situation(update))
    halves = np.random.default_rng(0).normal(size=(len(update.q_values), 2, 3))
    halves += 2 * update.q_values[:, None, None] / update.q_values.std()
    doubtful = replace(update, q_halves=halves)
    assert 0.1 < doubtful.reliability < 1
    assert ConfidenceBound()(situation(doubtful)).signal == pytest.approx(whole.signal * doubtful.reliability)
    alone = ConfidenceBound()(situation(replace(doubtful, q_draws=None)))  # the known reward
    assert (alone.signal, alone.kl_bound) == (doubtful.reliability, doubtful.reliability**2)


def test_the_constant_bound_is_the_runs_or_its_own():
    assert ConstantBound()(situation(proposed(), usual=0.2)).kl_bound == 0.2
    assert ConstantBound(0.6)(situation(proposed(), usual=0.2)).kl_bound == 0.6


@pytest.mark.parametrize("value", [0, -0.1, float("nan"), float("inf"), None, "0.3", True])
def test_a_schedule_that_decides_nonsense_is_named(value):
    def careless(situation):
        return value

    with pytest.raises(ValueError, match="schedule careless, KL bound: expected a positive finite number, got"):
        decide(careless, situation(proposed()))


@pytest.mark.parametrize(
    "statistics",
    [
        {"gain": np.ones(2)},
        {"gain": {"mean": 1.0}},
        {"reason": 1.0},
        {"signal": 1.0},
        {1: 1.0},
        {"gain": np.complex128(1j)},
    ],
)
def test_statistics_that_could_not_be_kept_are_named(statistics):
    with pytest.raises(ValueError, match=r"schedule .*: expected named numbers as statistics, got"):
        decide(lambda situation: Bound(0.2, "mine", None, statistics), situation(proposed()))


@pytest.mark.parametrize("signal", [-0.1, 1.5, float("nan"), "high", True])
def test_a_signal_that_is_no_share_is_named(signal):
    with pytest.raises(ValueError, match=r"schedule <lambda>, signal: expected a number in \[0, 1\], got"):
        decide(lambda situation: Bound(0.2, "mine", signal), situation(proposed()))


@pytest.mark.parametrize("bound", [Bound(0.3, "x", None, None), Bound(0.3, {1, 2}), Bound(0.3, None)])
def test_a_reason_that_is_no_text_and_statistics_without_names_are_refused(bound):
    with pytest.raises(
        ValueError, match=r"schedule <lambda>: expected a text as reason and a mapping as statistics, got"
    ):
        decide(lambda situation: bound, situation(proposed()))


def test_statistics_may_be_flags_texts_and_lists():
    statistics = {"sure": np.bool_(True), "why": "x", "gains": [1.0, np.float64(2.0)], "none": None}
    assert decide(lambda situation: Bound(0.2, "mine", 0.5, statistics), situation(proposed())).statistics == statistics


@pytest.mark.parametrize("needs_draws", [True, False])
def test_a_schedule_that_needs_no_draws_says_so_and_gets_none(needs_draws):
    seen = []

    def own(situation):
        seen.append(situation.update.q_draws is not None and situation.update.q_halves is not None)
        return 0.2

    own.needs_draws = needs_draws
    Learner("gridworld", schedule=own, iterations=1, answers=2, max_steps=20, evaluation_episodes=2).run(ReturnExpert())
    assert seen == [needs_draws]


@pytest.mark.parametrize("largest", [0.0, -1.0, float("nan"), float("inf")])
def test_bad_options_are_refused(largest):
    with pytest.raises(ValueError, match="largest: expected"):
        ConfidenceBound(largest)


QUICK = SHORT | {"utility": "linear-program"}


def three_lines(situation):
    return Bound(0.2 if situation.iteration == 1 else 0.4, "by the clock", None, {"answers": float(situation.answers)})


def test_a_run_follows_a_schedule_of_the_users_own_records_why_and_goes_on_with_it(tmp_path):
    learner = start("gridworld", tmp_path / "run", schedule=three_lines, iterations=3, **QUICK)
    expert = ReturnExpert()
    while len(learner.iterations) < 2:
        learner.tell([expert(*query.trajectories) for query in learner.ask()])
    with pytest.raises(ValueError, match=r"expected schedule= again, which the run was started with, got None"):
        resume(tmp_path / "run")
    whole = resume(tmp_path / "run", schedule=three_lines).run(expert)
    assert [summary["kl_bound"] for summary in whole.iterations] == [0.2, 0.4, 0.4]
    assert whole.iterations[0]["schedule"] == {"reason": "by the clock", "answers": 2.0}
    assert load(tmp_path / "run").iterations == whole.iterations  # reading needs no schedule


def test_the_bound_follows_the_posterior_of_a_run_and_comes_from_the_same_choices():
    learner = Learner("gridworld", preset="paper", schedule="confidence", iterations=3, evaluation_episodes=5).run(
        ReturnExpert()
    )
    for summary in learner.iterations:
        assert LEAST_BOUND <= summary["kl_bound"] <= 1
        assert 0 <= summary["schedule"]["signal"] <= 1
        assert 0 <= summary["schedule"]["agreement"] <= 1
        assert summary["schedule"]["rhat_max"] == summary["rhat_max"]


def test_a_schedule_named_in_schedules_is_used_by_that_name(tmp_path, monkeypatch):
    monkeypatch.setitem(SCHEDULES, "by-the-clock", three_lines)
    start("gridworld", tmp_path / "run", schedule="by-the-clock", iterations=2, **QUICK)
    whole = resume(tmp_path / "run").run(ReturnExpert())  # the name alone says which
    assert [summary["schedule"]["reason"] for summary in whole.iterations] == ["by the clock"] * 2
    monkeypatch.delitem(SCHEDULES, "by-the-clock")
    with pytest.raises(ValueError, match=r"^schedule: expected one of .*, got 'by-the-clock'$"):
        Learner("gridworld", schedule="by-the-clock")


def test_a_schedule_of_the_users_own_has_to_be_given():
    with pytest.raises(ValueError, match="schedule: expected a function, because the settings say 'other', got none"):
        Learner("gridworld", schedule="other")
