import numpy as np
import pytest
from scipy.optimize import linprog

from bayespbrl.models import linear_program


def test_consistent_answers_have_the_corner_of_the_box():
    # all answers want w₁ up and w₂ down: w = (1, −1), objective 1 + 2 = 3
    result = linear_program(np.array([[1.0, 0.0], [0.0, -2.0]]))
    np.testing.assert_allclose(result.weights, [1, -1])
    assert result.objective == pytest.approx(3)
    assert result.converged


def test_a_violated_answer_counts_twice():
    # w > 0 gives 3w − 2·2w < 0, w < 0 gives 2·3w + (−2w)·1 < 0: zero is best
    assert linear_program(np.array([[3.0], [-2.0]])).objective == pytest.approx(0, abs=1e-9)
    assert linear_program(np.array([[5.0], [-2.0]])).objective == pytest.approx(1)


def test_agrees_with_scipy_on_random_problems():
    rng = np.random.default_rng(0)
    for number, dimension in ((3, 7), (20, 5), (41, 60)):
        d = rng.normal(size=(number, dimension))
        rows = np.block([[-d, np.eye(number)], [-2 * d, np.eye(number)]])
        bounds = [(-1, 1)] * dimension + [(None, None)] * number
        expected = linprog(
            np.concatenate([np.zeros(dimension), -np.ones(number)]), A_ub=rows, b_ub=np.zeros(2 * number), bounds=bounds
        )
        result = linear_program(d)
        assert result.objective == pytest.approx(-expected.fun, rel=1e-7)
        assert np.all(np.abs(result.weights) <= 1)


def test_nothing_to_solve_is_the_origin():
    result = linear_program(np.zeros((0, 4)))
    np.testing.assert_array_equal(result.weights, np.zeros(4))
    assert result.converged


@pytest.mark.parametrize("bad", [np.ones(3), np.array([[np.nan]]), np.array([[np.inf, 1.0]])])
def test_bad_differences_are_named(bad):
    with pytest.raises(ValueError, match="differences: expected"):
        linear_program(bad)


@pytest.mark.parametrize("unit", [1e-9, 1e-5, 1e5, 1e15])
def test_the_unit_of_the_differences_does_not_matter(unit):
    differences = np.array([[1.0, 0.3], [0.5, -1.0], [-0.2, 0.4]])
    result = linear_program(unit * differences)
    assert result.converged
    np.testing.assert_allclose(result.weights, linear_program(differences).weights, atol=1e-6)
    np.testing.assert_allclose(result.objective, 1.15 * unit, rtol=1e-6)
