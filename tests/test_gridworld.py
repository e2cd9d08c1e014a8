"""The Gridworld against its published returns, and its moves and rewards by hand."""

import gymnasium
import jax
import numpy as np
import pytest

from bayespbrl.envs import functional
from bayespbrl.envs.gridworld import DYNAMICS, REWARDS

ACTION_NAMES = ("stay", "left", "down", "right", "up")


def value(choose, *, steps=300):
    """Expected undiscounted return from the start by backward recursion; `choose` turns Q (25, 5) into V (25,)."""
    table, rewards = DYNAMICS.transition_table(), REWARDS.reshape(-1)
    values = np.zeros(25)
    for _ in range(steps):
        values = choose(table @ (rewards + values))
    return values[int(DYNAMICS.initial(jax.random.key(0)))]


def test_optimal_return_by_dynamic_programming_is_the_published_one():
    assert value(lambda q: q.max(axis=1)) == pytest.approx(294.8125, abs=1e-4)


def test_uniform_policy_earns_fifteen_percent_of_the_optimum():
    assert value(lambda q: q.mean(axis=1)) == pytest.approx(44.34, abs=0.005)


def test_reward_doubles_towards_the_top_right_corner():
    # r = 2^−(4−(j−1)+(i−1)), i and j from 1
    by_hand = [[2.0 ** -(4 - (j - 1) + (i - 1)) for j in range(1, 6)] for i in range(1, 6)]
    np.testing.assert_array_equal(REWARDS, by_hand)
    assert (REWARDS[0, 4], REWARDS[4, 0], REWARDS[2, 2]) == (1.0, 1 / 256, 1 / 16)


@pytest.mark.parametrize(
    ("state", "action", "expected"),
    [
        *((7, "stay", 7), (7, "left", 6), (7, "down", 12), (7, "right", 8), (7, "up", 2)),
        *((5, "left", 5), (21, "down", 21), (9, "right", 9), (3, "up", 3)),
    ],
)
def test_moves_are_by_the_compass_and_clamped_at_the_edge(state, action, expected):
    assert int(DYNAMICS.move(state, ACTION_NAMES.index(action))) == expected


def test_half_of_the_moves_become_stay():
    keys = jax.random.split(jax.random.key(1), 4000)
    cells = np.asarray(jax.vmap(lambda key: DYNAMICS.transition(12, 3, key))(keys))
    assert set(np.unique(cells)) == {12, 13}
    assert np.mean(cells == 13) == pytest.approx(0.5, abs=0.03)


def test_the_reward_is_that_of_the_next_cell():
    assert float(DYNAMICS.reward(8, 3, 9)) == REWARDS[1, 4]


def test_the_episode_starts_in_the_centre_and_is_truncated_not_terminated_after_300_steps():
    env = gymnasium.make("bayespbrl/Gridworld-v0")
    observation, _ = env.reset(seed=5)
    assert observation == 12
    ends = [env.step(4)[2:4] for _ in range(300)]
    assert not any(terminated for terminated, _ in ends)
    assert [truncated for _, truncated in ends] == [False] * 299 + [True]


def test_transition_table_rows_are_probabilities():
    table = DYNAMICS.transition_table()
    np.testing.assert_allclose(table.sum(axis=2), 1.0)
    assert table[12, 3, 13] == table[12, 3, 12] == 0.5
    assert table[4, 4, 4] == 1.0


def test_a_step_is_the_same_from_the_pure_functions_under_either_dtype():
    def run():
        return [int(part) for part in functional.step(DYNAMICS, jax.random.key(3), 12, 4)[:2]]

    with jax.enable_x64(True):
        wide = run()
    assert wide[0] == wide[1]
    assert wide[0] in (7, 12)
