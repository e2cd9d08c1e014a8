import numpy as np
import pytest
import scipy.optimize

from bayespbrl import reps
from bayespbrl.reps import reps_weights


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


def test_a_solver_that_fails_leaves_the_policy_as_it_is_and_says_so(monkeypatch):
    monkeypatch.setattr(reps, "ITERATIONS", 1)
    q_values, features, base = random_problem()
    solution = reps.reps_weights(q_values, features, base, kl_bound=0.2)
    assert not solution.converged
    assert "Maximum_Iterations" in solution.status
    np.testing.assert_allclose(solution.sample_weights, 1.0)
    assert solution.kl == pytest.approx(0.0, abs=1e-12)
