"""Step 4: candidates and how they are shown."""

import numpy as np
import pytest

from bayespbrl.queries import highest_utility_candidates, random_candidates, show


def test_highest_utility_comes_first_and_equals_stay_in_their_order():
    assert highest_utility_candidates([10, 11, 12, 13], np.array([0.5, -1.0, 2.0, 0.5])) == (12, 10, 13, 11)
    assert highest_utility_candidates([4, 5, 6], np.zeros(3)) == (4, 5, 6)


def test_a_utility_for_each_trajectory_is_demanded():
    with pytest.raises(ValueError, match="utilities: expected one for each of 3"):
        highest_utility_candidates([4, 5, 6], np.zeros(2))


def test_random_candidates_are_a_uniform_permutation():
    rng = np.random.default_rng(3)
    drawn = np.array([random_candidates([7, 8, 9], rng=rng) for _ in range(3000)])
    assert set(map(tuple, np.sort(drawn, axis=1).tolist())) == {(7, 8, 9)}
    shares = [(drawn[:, place] == number).mean() for place in range(3) for number in (7, 8, 9)]
    np.testing.assert_allclose(shares, 1 / 3, atol=4 * np.sqrt(2 / 9 / 3000))


def test_the_same_stream_draws_the_same_candidates():
    first, second = (random_candidates(range(10), rng=np.random.default_rng(5)) for _ in range(2))
    assert first == second
    assert all(type(number) is int for number in first)


def test_the_newcomer_is_shown_first_half_of_the_time():
    rng = np.random.default_rng(11)
    trajectories = list("abcdef")  # what is shown does not look inside
    shown = [show(1, 5, 2, trajectories, rng=rng) for _ in range(4000)]
    assert abs(np.mean([query.first == 5 for query in shown]) - 0.5) < 4 * 0.5 / np.sqrt(4000)


def test_a_question_names_the_two_and_holds_them_in_the_order_shown():
    rng = np.random.default_rng(0)
    for number in range(20):
        query = show(number, 5, 2, list("abcdef"), rng=rng)
        assert {query.first, query.second} == {5, 2}
        assert (query.newcomer, query.incumbent) == (5, 2)
        assert query.trajectories == ("abcdef"[query.first], "abcdef"[query.second])
        assert query.number == number
