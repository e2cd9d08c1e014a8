"""What the answers say about length scales and lapses."""

import numpy as np

from bayespbrl.features import OneHot, RadialBasis
from bayespbrl.models import PreferenceModel
from bayespbrl.trajectories import Trajectory
from bayespbrl.utility.comparisons import Comparisons
from bayespbrl.utility.hyperparameters import choose_hyperparameters


def test_the_answers_choose_a_length_scale_in_each_dimension_of_the_state():
    rng = np.random.default_rng(0)
    walks = [rng.uniform(-1, 1, 2) + 0.02 * rng.normal(size=(3, 2)) for _ in range(80)]
    trajectories = [Trajectory(walk, np.zeros((2, 1)), np.zeros(2)) for walk in walks]

    def hidden(trajectory):  # ripples in the first dimension, flat in the second
        return np.sin(6 * trajectory.states[1:, 0]).sum()

    drawn = rng.permutation(80).reshape(40, 2).tolist()
    pairs = [(i, j) if hidden(trajectories[i]) > hidden(trajectories[j]) else (j, i) for i, j in drawn]
    features = RadialBasis(rng.uniform(-1, 1, (100, 2)), np.array([1.0, 1.0]), np.full(2, np.inf))
    choice = choose_hyperparameters(Comparisons.among(trajectories, pairs, discount=0.9), features, PreferenceModel())
    assert choice.bandwidth_multiples[0] < 1 < choice.bandwidth_multiples[1]
    assert choice.gain > 3
    np.testing.assert_allclose(choice.features.bandwidths, choice.bandwidth_multiples)
    # what was not compared changes nothing
    twice = Comparisons.among([*trajectories, *trajectories], pairs, discount=0.9)
    more = choose_hyperparameters(twice, features, PreferenceModel())
    assert more.summary() == choice.summary()
    # answers at odds with each other speak for lapses
    wrong = [(j, i) if k % 4 == 0 else (i, j) for k, (i, j) in enumerate(pairs)]
    of_wrong = choose_hyperparameters(Comparisons.among(trajectories, wrong, discount=0.9), features, PreferenceModel())
    assert of_wrong.model.lapse_rate > choice.model.lapse_rate


def test_without_answers_the_choice_is_what_was_given():
    stay = Trajectory(np.full(5, 1), np.zeros(4, dtype=int), np.zeros(4))
    given = PreferenceModel(steepness=3.0, lapse_rate=0.2)
    choice = choose_hyperparameters(Comparisons.among([stay], [], discount=0.9), OneHot(3), given)
    assert (choice.model, choice.gain, choice.bandwidth_multiples) == (given, 0.0, ())
