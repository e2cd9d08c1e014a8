"""Comparison rule of the authors' implementation; ψ differences of eq. 5."""

import numpy as np
import pytest

from bayespbrl.preferences import Answer, Preferences, pair_differences, parse_answer
from bayespbrl.questions import opponent_now
from bayespbrl.trajectories import Trajectory


def test_a_better_newcomer_is_preferred_over_every_undominated_one_and_replaces_them():
    before = Preferences(pairs=((0, 5),), undominated=(0, 2, 3), answers=4)
    after = before.add(7, 3, preferred=7)
    assert after == Preferences(((0, 5), (7, 0), (7, 2), (7, 3)), (7,), 5)


def test_every_undominated_one_is_preferred_over_a_worse_newcomer():
    before = Preferences(undominated=(0, 2, 3), answers=4)
    assert before.add(7, 3, preferred=3) == Preferences(((0, 7), (2, 7), (3, 7)), (0, 2, 3), 5)


def test_a_tie_joins_the_undominated_and_is_kept_as_a_tie_not_as_a_pair():
    before = Preferences(pairs=((0, 5),), undominated=(0,), answers=1)
    assert before.add(7, 0, preferred=None) == Preferences(((0, 5),), (0, 7), 2, ((7, 0),))


def test_only_rivals_of_the_same_start_are_compared_and_the_others_stand():
    before = Preferences(undominated=(0, 2, 3), answers=4)
    better = before.add(7, 2, preferred=7, rivals=[2])
    assert better == Preferences(((7, 2),), (0, 3, 7), 5)
    worse = before.add(7, 2, preferred=2, rivals=[2])
    assert worse == Preferences(((2, 7),), (0, 3, 2), 5)
    never_shown = before.add(7, 5, preferred=None, rivals=[])
    assert never_shown == Preferences((), (0, 2, 3, 5, 7), 5, ((7, 5),))


def test_an_opponent_that_another_question_of_the_iteration_has_beaten_stays_beaten():
    before = Preferences().add(5, 0, preferred=5, rivals=[])
    for rivals in ([], [5], [0]):
        better = before.add(3, 0, preferred=3, rivals=rivals)
        assert (better.pairs, better.undominated) == (((5, 0), (3, 0)), (5, 3))  # nothing is known of 3 and 5
        worse = before.add(3, 0, preferred=0, rivals=rivals)
        assert (worse.pairs, worse.undominated) == (((5, 0), (0, 3)), (5,))


def test_a_beaten_opponent_gives_way_to_who_stands_for_its_start():
    here, there = (
        Trajectory(states=np.array([[start], [0.0]]), actions=np.zeros((1, 1)), rewards=np.zeros(1), terminated=False)
        for start in (1.0, 2.0)
    )
    known, opponents = [here, here, here, there, there], {1: 0, 2: 0, 4: 3}
    beaten = Preferences().add(1, 0, preferred=1, rivals=[]).add(4, 3, preferred=3, rivals=[])
    assert [opponent_now(new, opponents, known, Preferences()) for new in (1, 2, 4)] == [0, 0, 3]
    assert opponent_now(2, opponents, known, beaten) == 1
    assert opponent_now(2, {}, known, beaten) == 3
    assert opponent_now(1, opponents, known, beaten) == 0  # nobody is compared with itself


def test_the_side_is_known_of_what_was_asked_and_of_nothing_that_follows():
    def sides(preferences):
        """Of the pairs, then of the ties, that were asked about."""
        both = (*preferences.pairs, *preferences.ties)
        return [(pair, row.side) for pair, row in zip(both, preferences.rows(), strict=True) if row.side]

    before = Preferences(undominated=(0, 2), answers=2)
    assert sides(before.add(7, 2, preferred=7, shown_first=7)) == [((7, 2), 1)]
    assert sides(before.add(7, 2, preferred=7, shown_first=2)) == [((7, 2), -1)]
    assert sides(before.add(7, 2, preferred=2, shown_first=7)) == [((2, 7), -1)]
    both = before.add(7, 2, preferred=None, shown_first=2).add(8, 7, preferred=8, shown_first=8)
    assert sides(both) == [((8, 7), 1), ((7, 2), -1)]


def test_five_answers_by_hand():
    # 0 is the first; 1 better; 2 ties with 1; 3 worse than both; 4 ties with 2; 5 better than 1, 2 and 4.
    preferences = Preferences().start(0)
    for newcomer, incumbent, preferred in [(1, 0, 1), (2, 1, None), (3, 2, 2), (4, 2, None), (5, 4, 5)]:
        preferences = preferences.add(newcomer, incumbent, preferred=preferred)
    assert preferences.pairs == ((1, 0), (1, 3), (2, 3), (5, 1), (5, 2), (5, 4))
    assert preferences.undominated == (5,)
    assert preferences.answers == 5  # ties count as answers, but not as pairs


@pytest.mark.parametrize(("incumbent", "preferred"), [(0, 0), (9, 9), (3, 0)])
def test_a_comparison_with_another_than_the_newest_undominated_one_is_refused(incumbent, preferred):
    before = Preferences(undominated=(0, 3))
    with pytest.raises(ValueError, match=r"incumbent: expected|preferred: expected"):
        before.add(7, incumbent, preferred=preferred)
    with pytest.raises(ValueError, match="incumbent: expected"):
        Preferences().add(7, 0, preferred=7)


def test_a_trajectory_is_compared_with_another_and_one_of_the_two_preferred():
    with pytest.raises(ValueError, match="newcomer: expected another trajectory"):
        Preferences(undominated=(0,)).add(0, 0, preferred=None)
    with pytest.raises(ValueError, match="preferred: expected 0, 1 or None, got 7"):
        Preferences(undominated=(0,)).add_repeated(0, 1, preferred=7)


def test_differences_are_preferred_minus_dominated():
    features = np.array([[1.0, 2.0, 4.0], [0.5, -1.0, 3.0], [7.0, 0.0, 1.0]])
    differences = pair_differences(((0, 1), (2, 0)), features)
    np.testing.assert_array_equal(differences, [[0.5, 3.0, 1.0], [6.0, -2.0, -3.0]])


def test_differences_of_no_pair_and_of_one_are_matrices():
    features = np.arange(12.0).reshape(4, 3)
    assert pair_differences((), features).shape == (0, 3)
    np.testing.assert_array_equal(pair_differences([(3, 1)], features), [[6.0, 6.0, 6.0]])


@pytest.mark.parametrize("pair", [(0, 4), (-1, 2), (2, 2)])
def test_a_pair_of_trajectories_that_are_not_there_or_the_same_is_refused(pair):
    with pytest.raises(ValueError, match="pairs: expected"):
        pair_differences([(0, 1), pair], np.zeros((4, 3)))


def test_answers_are_recognised_and_anything_else_is_refused_by_name():
    assert parse_answer("tie") is Answer.TIE
    assert parse_answer(Answer.UNDO) is Answer.UNDO
    for nonsense in ("both", 1, None, "FIRST", ["first"], float("nan")):
        with pytest.raises(ValueError, match="answer: expected one of 'first'"):
            parse_answer(nonsense)
