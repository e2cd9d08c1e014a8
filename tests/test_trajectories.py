"""Trajectories, their table of steps, and ψ(τ) of the next states."""

import numpy as np
import pytest

from bayespbrl.trajectories import Trajectory, trajectory_features, transitions

SHORT = Trajectory(np.array([[1.0, 2.0], [3.0, 5.0]]), np.array([[0.5]]), np.array([7.0]), terminated=True)
LONG = Trajectory(
    np.array([[0.0, 1.0], [2.0, -1.0], [4.0, 3.0], [8.0, 6.0]]), np.array([[1.0], [2.0], [3.0]]), np.arange(3.0)
)


def two_features(states):
    return np.column_stack([states[:, 0] + 1, states[:, 0] * states[:, 1], np.ones(len(states))])


def test_features_by_hand_are_those_of_the_next_states_discounted_from_one():
    # LONG: φ(s₁) = (3, −2, 1), φ(s₂) = (5, 12, 1), φ(s₃) = (9, 48, 1); γ = ½. SHORT: φ(s₁) = (4, 15, 1).
    expected = [[3 + 2.5 + 2.25, -2 + 6 + 12, 1.75], [4, 15, 1]]
    np.testing.assert_allclose(trajectory_features([LONG, SHORT], two_features, discount=0.5), expected, rtol=1e-15)


@pytest.mark.parametrize("discount", [0.0, 0.9, 1.0])
def test_features_of_many_lengths_equal_a_plain_loop(discount):
    rng = np.random.default_rng(2)
    many = [
        Trajectory(rng.normal(size=(n + 1, 2)), rng.normal(size=(n, 1)), rng.normal(size=n), bool(n % 2))
        for n in (1, 7, 2, 30, 1)
    ]
    loop = [sum(discount**t * two_features(tau.states[t + 1 : t + 2])[0] for t in range(len(tau))) for tau in many]
    np.testing.assert_allclose(trajectory_features(many, two_features, discount=discount), loop, rtol=1e-12)


def test_the_first_state_has_no_part_in_the_features():
    moved = Trajectory(np.vstack([[[99.0, 99.0]], LONG.states[1:]]), LONG.actions, LONG.rewards)
    np.testing.assert_array_equal(*(trajectory_features([t], two_features, discount=0.9) for t in (LONG, moved)))


def test_features_of_discrete_states_count_discounted_visits():
    tau = Trajectory(np.array([0, 2, 2, 1]), np.array([0, 0, 1]), np.zeros(3))
    features = trajectory_features([tau], lambda states: np.eye(4)[states], discount=0.5)
    np.testing.assert_array_equal(features, [[0, 0.25, 1.5, 0]])


def test_steps_are_one_table_and_only_the_last_of_a_terminated_trajectory_is_terminal():
    steps = transitions([LONG, SHORT])
    np.testing.assert_array_equal(steps.states, [[0, 1], [2, -1], [4, 3], [1, 2]])
    np.testing.assert_array_equal(steps.next_states, [[2, -1], [4, 3], [8, 6], [3, 5]])
    np.testing.assert_array_equal(steps.actions, [[1], [2], [3], [0.5]])
    np.testing.assert_array_equal(steps.rewards, [0, 1, 2, 7])
    np.testing.assert_array_equal(steps.terminal, [False, False, False, True])
    assert len(steps) == 4


def test_the_return_is_undiscounted():
    assert LONG.total_reward == 3.0
    assert len(LONG) == 3


def test_no_trajectory_at_all_is_refused():
    with pytest.raises(ValueError, match="at least one trajectory"):
        transitions([])
    with pytest.raises(ValueError, match="at least one trajectory"):
        trajectory_features([], two_features, discount=0.9)


def test_a_trajectory_without_steps_or_of_lengths_that_do_not_fit_is_refused():
    with pytest.raises(ValueError, match="at least one step"):
        Trajectory(np.zeros((1, 2)), np.zeros((0, 1)), np.zeros(0))
    with pytest.raises(ValueError, match=r"T\+1 states, T actions and T rewards, got 3 states, 3 actions"):
        Trajectory(np.zeros((3, 2)), np.zeros((3, 1)), np.zeros(3))
    with pytest.raises(ValueError, match="and 2 rewards"):
        Trajectory(np.zeros((4, 2)), np.zeros((3, 1)), np.zeros(2))


@pytest.mark.parametrize("name", ["states", "actions", "rewards"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_refused_by_name(name, bad):
    parts = {"states": np.zeros((3, 2)), "actions": np.zeros((2, 1)), "rewards": np.zeros(2)}
    parts[name][-1] = bad
    with pytest.raises(ValueError, match=f"trajectory: {name}: expected finite entries, got NaN or infinity"):
        Trajectory(**parts)


def test_a_trajectory_equals_itself_alone():
    one, other = (Trajectory(np.zeros((2, 1)), np.zeros(1, int), np.zeros(1)) for _ in range(2))
    assert one in [other, one]
    assert one != other
    assert len({one, other}) == 2


def test_whole_numbers_are_float64_but_where_states_or_actions_are_discrete():
    both = Trajectory([[0, 1], [1, 2]], [[3]], [1]), Trajectory([0, 1], [1], [True])
    assert [part.dtype.kind for one in both for part in (one.states, one.actions, one.rewards)] == [*"fff", *"iif"]


def test_lists_become_arrays():
    given = Trajectory([[0.0], [1.0]], [[0.5]], [2.0])
    for array, expected in ((given.states, [[0.0], [1.0]]), (given.actions, [[0.5]]), (given.rewards, [2.0])):
        assert isinstance(array, np.ndarray)
        np.testing.assert_array_equal(array, expected)
    assert given.clip(0, 1).total_reward == 2.0


@pytest.mark.parametrize("bad", [None, 3.0, "a", [["a"], ["b"]], [[0.0], [1.0, 2.0]], [None, None]], ids=str)
@pytest.mark.parametrize("name", ["states", "actions", "rewards"])
def test_what_is_no_array_of_numbers_is_refused_by_name(name, bad):
    given = {"states": [[0.0], [1.0]], "actions": [[0.0]], "rewards": [0.0]} | {name: bad}
    with pytest.raises(ValueError, match=f"trajectory: {name}: expected "):
        Trajectory(**given)


def test_what_is_learned_from_cannot_be_changed_in_place_and_the_callers_arrays_can():
    states = np.zeros((3, 2))
    trajectory = Trajectory(states, [0, 1], np.ones(2))
    for values in (trajectory.states, trajectory.actions, trajectory.rewards, trajectory.clip(0, 1).states):
        with pytest.raises(ValueError, match="read-only"):
            values -= 1
    states[0, 0] = 5.0
    assert trajectory.states[0, 0] == 0.0
