from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize

from bayespbrl.improvement import reps
from bayespbrl.improvement.reps import advantages, reps_weights, reps_weights_by_state
from bayespbrl.improvement.whitening import whitened


def random_problem(states=6, actions=3, seed=0):
    """All actions of each state, weighted by q(a|s) × visits; one-hot state features."""
    rng = np.random.default_rng(seed)
    base = (rng.dirichlet(np.ones(states))[:, None] * rng.dirichlet(np.ones(actions), states)).ravel()
    return rng.normal(3.0, 5.0, states * actions), np.repeat(np.eye(states), actions, axis=0), base


def continuous_problem(samples=800, centres=60, seed=1):
    rng = np.random.default_rng(seed)
    states, actions = rng.normal(size=samples), rng.normal(size=samples)
    features = np.exp(-0.5 * (states[:, None] - states[:centres]) ** 2)
    return np.sin(states) + actions * np.cos(states) - 0.2 * actions**2, features, np.full(samples, 1 / samples)


@pytest.mark.parametrize("kl_bound", [0.01, 0.1, 0.5])
@pytest.mark.parametrize("problem", [random_problem, continuous_problem])
def test_the_bound_and_the_state_distribution_are_met(problem, kl_bound):
    solution = reps_weights(*problem(), kl_bound=kl_bound)
    assert solution.converged
    assert solution.bound_active
    assert solution.kl == pytest.approx(kl_bound, rel=1e-4)
    assert solution.feature_gap < 1e-7


@pytest.mark.parametrize("problem", [random_problem, continuous_problem])
@pytest.mark.parametrize("size", [1e3, 1e6])
def test_what_differs_between_states_alone_hides_no_advantage(problem, size):
    """V(s) that is linear in the features is the same for all admissible p, however large it is."""
    q_values, features, base = problem()
    mapping = whitened(features, base).mapping  # what the constraint does not keep is no function of its features
    of_states = mapping @ (size * np.random.default_rng(2).normal(size=mapping.shape[1]))
    plain = reps_weights(q_values, features, base, kl_bound=0.2)
    hidden = reps_weights(q_values + features @ of_states, features, base, kl_bound=0.2)
    assert hidden.bound_active
    np.testing.assert_allclose(hidden.probabilities, plain.probabilities, atol=1e-5)
    assert np.ptp(features @ (hidden.value_weights - plain.value_weights - of_states)) < 0.01


def test_where_q_differs_between_states_alone_there_is_nothing_to_gain():
    _, features, base = random_problem()
    solution = reps_weights(features @ np.arange(6.0), features, base, kl_bound=0.2)
    np.testing.assert_allclose(solution.sample_weights, 1.0)
    assert solution.kl == pytest.approx(0.0, abs=1e-15)
    assert solution.status == reps.CONSTANT
    assert np.ptp(features @ solution.value_weights - features @ np.arange(6.0)) < 1e-9


def test_columns_that_are_zero_everywhere_change_nothing():
    _, features, base = random_problem()
    wide = np.zeros((len(features), 1500))
    wide[:, 7:1500:250] = features
    few, many = whitened(features, base), whitened(wide, base)
    np.testing.assert_allclose(np.abs(many.features), np.abs(few.features), atol=1e-9)
    np.testing.assert_allclose((wide - base @ wide) @ many.mapping, many.features, atol=1e-12)
    assert np.count_nonzero(many.mapping.any(axis=1)) == 6


def test_weights_equal_the_primal_optimum_of_a_general_solver():
    q_values, features, base = random_problem(states=3, actions=2, seed=5)
    solution = reps_weights(q_values, features, base, kl_bound=0.05)
    marginals = features.T @ base
    primal = scipy.optimize.minimize(
        lambda p: -p @ q_values,
        base,
        method="SLSQP",
        bounds=[(1e-12, 1)] * 6,
        constraints=[
            {"type": "eq", "fun": lambda p: features.T @ p - marginals},
            {"type": "ineq", "fun": lambda p: 0.05 - p @ np.log(p / base)},
        ],
        options={"ftol": 1e-14, "maxiter": 500},
    )
    np.testing.assert_allclose(solution.probabilities, primal.x, atol=1e-5)


def test_one_state_gives_the_softmax_at_the_temperature_that_meets_the_bound():
    q_values, base = np.array([0.0, 1.0, 3.0]), np.array([0.5, 0.3, 0.2])
    solution = reps_weights(q_values, np.ones((3, 1)), base, kl_bound=0.1)

    def softmax(temperature):
        weights = base * np.exp(q_values / temperature)
        return weights / weights.sum()

    def excess(temperature):
        p = softmax(temperature)
        return p @ np.log(p / base) - 0.1

    temperature = scipy.optimize.brentq(excess, 0.5, 100)
    assert solution.temperature == pytest.approx(temperature, rel=1e-4)
    np.testing.assert_allclose(solution.probabilities, softmax(temperature), rtol=1e-4)
    assert solution.rank_kept == 0


def test_weights_tend_to_one_as_the_bound_tends_to_zero():
    solution = reps_weights(*continuous_problem(), kl_bound=1e-6)
    np.testing.assert_allclose(solution.sample_weights, 1.0, atol=0.02)


def test_weights_average_to_one_and_do_not_depend_on_the_units_of_q():
    q_values, features, base = random_problem()
    solution = reps_weights(q_values, features, base, kl_bound=0.2)
    scaled = reps_weights(1000 * q_values - 7, features, base, kl_bound=0.2)
    assert base @ solution.sample_weights == pytest.approx(1.0)
    np.testing.assert_allclose(scaled.sample_weights, solution.sample_weights, rtol=1e-5)
    assert scaled.temperature == pytest.approx(1000 * solution.temperature, rel=1e-5)


def test_the_value_weights_reproduce_the_sample_weights():
    q_values, features, base = random_problem()
    solution = reps_weights(q_values, features, base, kl_bound=0.2)
    logits = (q_values - features @ solution.value_weights) / solution.temperature
    probabilities = base * np.exp(logits - logits.max())
    np.testing.assert_allclose(probabilities / probabilities.sum(), solution.probabilities, atol=1e-10)


def test_an_unreachable_bound_is_reported_as_inactive_and_the_policy_turns_greedy():
    q_values, features, base = random_problem(states=2, actions=2)
    solution = reps_weights(q_values, features, base, kl_bound=50.0)
    assert not solution.bound_active
    greedy = q_values.reshape(2, 2).argmax(axis=1)
    conditional = solution.probabilities.reshape(2, 2) / solution.probabilities.reshape(2, 2).sum(axis=1, keepdims=True)
    assert np.all(conditional[[0, 1], greedy] > 0.99)


def test_a_bound_is_active_where_kl_is_within_a_hundredth_of_it():
    solution = reps_weights(*random_problem(), kl_bound=0.5)
    active = [replace(solution, kl=share * 0.5).bound_active for share in (0.98, 0.992, 1.0, 1.008, 1.02)]
    assert active == [False, True, True, True, False]


@pytest.mark.parametrize("kl_bound", [50.0, 1e6])
def test_a_bound_that_many_samples_do_not_reach_leads_to_a_greedy_step_too(kl_bound):
    rng = np.random.default_rng(0)
    states, centres = rng.uniform(-1, 1, (2000, 2)), rng.uniform(-1, 1, (40, 2))
    features = np.exp(-np.square(states[:, None] - centres).sum(axis=2) / 0.1)
    q_values = np.sin(3 * states[:, 0]) + rng.normal(size=2000)
    solution = reps_weights(q_values, features, np.full(2000, 1 / 2000), kl_bound=kl_bound)
    assert solution.converged
    assert solution.feature_gap < 0.01  # of a standard deviation
    best = reps_weights(q_values, features, np.full(2000, 1 / 2000), kl_bound=3.5)
    assert solution.probabilities @ q_values > best.probabilities @ q_values


def test_equal_values_leave_the_policy_as_it_is():
    _, features, base = random_problem()
    solution = reps_weights(np.full(len(base), 4.0), features, base, kl_bound=0.3)
    np.testing.assert_allclose(solution.sample_weights, 1.0)
    assert not solution.bound_active


@pytest.mark.parametrize("kl_bound", [0.0, -1.0, np.nan, np.inf])
def test_a_bad_bound_is_named(kl_bound):
    with pytest.raises(ValueError, match="kl_bound"):
        reps_weights(*random_problem(), kl_bound=kl_bound)


def test_bad_arrays_are_named():
    q_values, features, base = random_problem()
    with pytest.raises(ValueError, match="expected q_values"):
        reps_weights(q_values[:-1], features, base, kl_bound=0.1)
    with pytest.raises(ValueError, match="q_values"):
        reps_weights(np.where(q_values > 3, np.nan, q_values), features, base, kl_bound=0.1)
    with pytest.raises(ValueError, match="base_weights"):
        reps_weights(q_values, features, 2 * base, kl_bound=0.1)
    with pytest.raises(ValueError, match=r"state_features: expected shape \(N, D\), got \(18,\)"):
        reps_weights(q_values, features[:, 0], base, kl_bound=0.1)
    with pytest.raises(ValueError, match="N > 0, got"):
        reps_weights([], np.zeros((0, 1)), [], kl_bound=0.1)


@pytest.mark.parametrize(("spread", "leaves"), [(1e-5, False), (1e-10, True)])
def test_a_q_that_differs_by_rounding_alone_leaves_the_policy_as_it_is(spread, leaves):
    q_values, features, base = random_problem()
    solution = reps_weights(
        1.0 + spread * (q_values - base @ q_values) / np.std(q_values), features, base, kl_bound=0.3
    )
    assert (solution.status == reps.CONSTANT) == leaves
    assert (solution.kl == pytest.approx(0.3, rel=1e-3)) != leaves
    advantage = advantages(1.0 + spread * q_values, whitened(features, base), base)
    assert (not advantage.any()) == leaves


def test_the_largest_directions_are_kept_and_none_below_the_tolerance():
    rng = np.random.default_rng(2)
    features = rng.normal(size=(500, 4)) * [1.0, 10.0, 1.2e-2, 5e-3]
    base = np.full(500, 1 / 500)
    kept = whitened(features, base)
    assert kept.features.shape[1] == 3  # a thousandth of the largest is the least
    largest = whitened(features, base, most=1)
    assert largest.features.shape[1] == 1
    assert abs(np.corrcoef(largest.features[:, 0], features[:, 1])[0, 1]) > 0.999


@pytest.mark.parametrize("scale", [1e-20, 1.0, 1e3, 1e20])
def test_features_are_whitened_whatever_their_unit_and_a_constant_is_none(scale):
    q_values, features, base = random_problem()
    assert whitened(scale * features, base).features.shape[1] == whitened(features, base).features.shape[1] == 5
    constant = reps_weights(q_values, np.full((len(base), 1), scale), base, kl_bound=0.1)
    assert (constant.rank_kept, constant.converged) == (0, True)


def test_a_solver_that_fails_leaves_the_policy_as_it_is_and_says_so(monkeypatch):
    monkeypatch.setattr(reps, "ITERATIONS", 1)
    q_values, features, base = random_problem()
    solution = reps.reps_weights(q_values, features, base, kl_bound=0.2)
    assert not solution.converged
    assert "Maximum_Iterations" in solution.status
    np.testing.assert_allclose(solution.sample_weights, 1.0)
    assert solution.kl == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("problem", [random_problem, continuous_problem])
def test_small_updates_follow_the_advantage(problem):
    q_values, features, base = problem()
    constraint = whitened(features, base)
    advantage = advantages(q_values, constraint, base)
    np.testing.assert_allclose([base @ advantage, *(base * advantage) @ constraint.features], 0, atol=1e-12)
    solution = reps_weights(q_values, features, base, kl_bound=1e-6, constraint=constraint)
    step = np.sqrt(2 * solution.kl / (base @ advantage**2)) * advantage
    np.testing.assert_allclose(solution.sample_weights - 1, step, atol=0.01 * np.abs(step).max())
    np.testing.assert_array_equal(
        solution.probabilities, reps_weights(q_values, features, base, kl_bound=1e-6).probabilities
    )


def test_the_advantage_state_by_state_is_that_of_one_hot_features():
    q_values, features, base = random_problem()
    np.testing.assert_allclose(
        advantages(q_values, features.argmax(axis=1), base),
        advantages(q_values, whitened(features, base), base),
        atol=1e-10,
    )


def by_state(problem):
    q_values, features, base = problem
    return q_values, features.argmax(axis=1), base


@pytest.mark.parametrize("kl_bound", [0.001, 0.1, 0.5])
def test_state_by_state_is_the_dual_with_one_hot_features(kl_bound):
    problem = random_problem()
    general = reps_weights(*problem, kl_bound=kl_bound)
    exact = reps_weights_by_state(*by_state(problem), kl_bound=kl_bound)
    assert exact.kl == pytest.approx(kl_bound, rel=1e-9)
    assert exact.bound_active
    assert exact.converged
    np.testing.assert_allclose(exact.probabilities, general.probabilities, atol=1e-6)
    np.testing.assert_allclose(exact.sample_weights, general.sample_weights, atol=1e-4)
    assert exact.temperature == pytest.approx(general.temperature, rel=1e-4)
    # V is known up to a constant; the general one has the mean of V(s) taken out
    visits = np.bincount(problem[1].argmax(axis=1), weights=problem[2])
    values = [solution.value_weights - visits @ solution.value_weights for solution in (exact, general)]
    np.testing.assert_allclose(*values, atol=1e-3)
    assert (exact.rank_kept, general.rank_kept) == (5, 5)
    assert exact.effective_samples == pytest.approx(general.effective_samples, rel=1e-4)


def test_state_by_state_no_state_gains_or_loses_weight_whatever_its_q():
    q_values, states, base = by_state(random_problem(states=40, actions=2, seed=3))
    solution = reps_weights_by_state(q_values + 1e3 * states, states, base, kl_bound=0.05)
    alike = reps_weights_by_state(q_values, states, base, kl_bound=0.05)
    np.testing.assert_allclose(solution.sample_weights, alike.sample_weights, rtol=1e-6)
    np.testing.assert_allclose(
        np.bincount(states, weights=solution.probabilities), np.bincount(states, weights=base), rtol=1e-12
    )
    assert solution.feature_gap < 1e-13
    assert solution.kl == pytest.approx(0.05, rel=1e-6)
    assert solution.sample_weights @ base == pytest.approx(1)


def test_state_by_state_a_bound_that_no_policy_reaches_is_not_active():
    q_values, states, base = by_state(random_problem())
    solution = reps_weights_by_state(q_values, states, base, kl_bound=50.0)
    assert not solution.bound_active
    best = np.array([q_values[states == state].argmax() for state in range(6)])
    chances = solution.probabilities.reshape(6, 3) / np.bincount(states, weights=base)[:, None]
    np.testing.assert_allclose(chances, np.eye(3)[best], atol=1e-6)


def test_state_by_state_a_q_that_is_the_same_for_all_actions_changes_nothing():
    _, states, base = by_state(random_problem())
    solution = reps_weights_by_state(7.0 + states, states, base, kl_bound=0.3)
    np.testing.assert_allclose(solution.sample_weights, 1.0, rtol=1e-12)
    assert not solution.bound_active
    assert solution.kl == pytest.approx(0, abs=1e-15)


def test_state_by_state_bad_input_is_refused():
    q_values, states, base = by_state(random_problem())
    for arguments in ((q_values[1:], states, base), (q_values * np.nan, states, base), (q_values, states, 2 * base)):
        with pytest.raises(ValueError, match="expected"):
            reps_weights_by_state(*arguments, kl_bound=0.3)
    with pytest.raises(ValueError, match=r"states: expected each of 0 … 6, got no 2"):
        reps_weights_by_state(q_values, states + (states >= 2), base, kl_bound=0.3)
    for wrong in (states - 1, states + 0.5, np.eye(18, dtype=int)):
        with pytest.raises(ValueError, match="states: expected whole numbers from 0"):
            reps_weights_by_state(q_values, wrong, base, kl_bound=0.3)
    with pytest.raises(ValueError, match="kl_bound"):
        reps_weights_by_state(q_values, states, base, kl_bound=0.0)


def test_state_by_state_a_bound_below_rounding_changes_nothing():
    for seed in range(40):
        q_values, states, base = by_state(random_problem(states=17, seed=seed))
        solution = reps_weights_by_state(q_values, states, base, kl_bound=1e-20)
        np.testing.assert_allclose(solution.sample_weights, 1.0, rtol=1e-6)
