"""The utility averaged over length scales and steepness, against importance sampling from the prior."""

import numpy as np
import pytest

from bayespbrl import Learner, ReturnExpert, queries
from bayespbrl.features import OneHot, RadialBasis
from bayespbrl.models import PreferenceModel
from bayespbrl.queries import InformationWhenUnsure
from bayespbrl.trajectories import Trajectory, trajectory_features
from bayespbrl.utility.averaging import BANDWIDTH_MULTIPLES, MOST_BANDWIDTHS, average_utility
from bayespbrl.utility.comparisons import Comparisons
from bayespbrl.utility.hyperparameters import STEEPNESS_MULTIPLES, choose_hyperparameters
from bayespbrl.utility.inference import estimate_utility

LINE = RadialBasis(np.linspace(-1, 1, 5)[:, None], np.array([0.4]), np.array([np.inf]), normalised=True)
PAIRS = [(0, 1), (0, 2), (3, 2)]
STATES = np.linspace(-1.2, 1.2, 7)[:, None]
ALL = {"utility": "posterior-mean", "schedule": "confidence", "query": "information-when-unsure"}
QUICK = {"max_steps": 20, "evaluation_episodes": 3, "seed": 7, "hyperparameters": "averaged"}


def walks(number=4):
    rng = np.random.default_rng(3)
    made = []
    for start_at in (0.7, -0.2, -0.9, 0.1, 0.4, -0.5, 0.9)[:number]:
        states = np.clip(start_at + np.cumsum(rng.normal(scale=0.15, size=(7, 1)), axis=0), -1, 1)
        made.append(Trajectory(states, np.zeros((6, 1)), np.zeros(6)))
    return made


def averaged(features, trajectories, pairs, *, likelihood="logistic", seed=0):
    comparisons, model = Comparisons.among(trajectories, pairs, discount=1.0), PreferenceModel(likelihood=likelihood)
    choice = choose_hyperparameters(comparisons, features, model)
    given = PreferenceModel(likelihood=likelihood, steepness=choice.model.steepness)
    sampled = estimate_utility(comparisons, choice.features, given, method="posterior-mean")
    return average_utility(sampled, comparisons, features, model=model, seed=seed)


@pytest.mark.slow
def test_the_pairs_that_it_satisfies_are_counted_by_the_average_and_not_by_the_likeliest_setting():
    trajectories = walks(7)
    for seed in range(40):
        order = np.random.default_rng(seed).permutation(7)  # answers that no utility of the features need explain
        pairs = list(zip(order[:-1].tolist(), order[1:].tolist(), strict=True))
        estimate = averaged(LINE, trajectories, pairs)
        mixed = estimate.trajectory_utilities(trajectories)
        assert estimate.quality.pairs_satisfied == sum(mixed[i] > mixed[j] for i, j in pairs)
        own = estimate.sampled.trajectory_utilities(trajectories)
        if estimate.quality.pairs_satisfied != sum(own[i] > own[j] for i, j in pairs):
            return
    pytest.fail("no case in which the two differ")


@pytest.mark.slow
def test_mean_and_spread_are_those_of_the_mixture_by_importance_sampling():
    # The posterior over (setting, weights) by weighing draws of the prior by the likelihood: no Gaussian, no evidence.
    trajectories, rng = walks(5), np.random.default_rng(0)
    worth = [np.sin(4 * trajectory.states[1:]).sum() for trajectory in trajectories]
    pairs = [(i, j) for i in range(5) for j in range(5) if worth[i] > worth[j]]
    weights, utilities = [], []
    for multiple in BANDWIDTH_MULTIPLES:
        features = LINE.rescaled([multiple])
        sums = trajectory_features(trajectories, features, discount=1.0)
        differences = np.array([sums[i] - sums[j] for i, j in pairs])
        scale = np.abs(differences).max()
        for relative in STEEPNESS_MULTIPLES:
            w = rng.normal(size=(300_000, 5))
            margins = w @ differences.T / scale
            weights.append(np.prod(1 / (1 + np.exp(-5.0 * relative * margins)), axis=1))
            utilities.append(w @ features(STATES).T / scale)
    p, u = np.concatenate(weights), np.concatenate(utilities)
    p /= p.sum()
    mean = p @ u
    spread = np.sqrt(p @ (u - mean) ** 2)

    estimate = averaged(LINE, trajectories, pairs)
    np.testing.assert_allclose(estimate.utilities(STATES), mean, atol=0.05 * spread.max())
    of_each = np.array([part.sum() for part in np.split(p, 9)]).reshape(3, 3).sum(axis=1)
    np.testing.assert_allclose(estimate.probabilities, of_each, atol=0.03)
    assert of_each.max() > 2 * of_each.min()  # the answers speak for some more than for others
    draws = np.concatenate(
        [averaged(LINE, trajectories, pairs, seed=s).utilities_and_draws(STATES)[1] for s in range(10)]
    )
    assert draws.shape == (2000, 7)
    np.testing.assert_allclose(draws.mean(axis=0), mean, atol=4 * spread.max() / np.sqrt(2000) + 0.03 * spread.max())
    np.testing.assert_allclose(draws.std(axis=0), spread, rtol=0.1)
    assert estimate.probabilities.sum() == pytest.approx(1)


def test_a_trajectory_is_worth_the_sum_of_its_states_in_the_mean_and_in_every_draw():
    trajectories = walks()
    estimate = averaged(LINE, trajectories, PAIRS)
    states = np.concatenate([trajectory.states[1:] for trajectory in trajectories])
    np.testing.assert_allclose(
        estimate.trajectory_utilities(trajectories), estimate.utilities(states).reshape(4, 6).sum(axis=1), rtol=1e-10
    )
    for number in (None, 50, 1):
        drawn = estimate.trajectory_draws(trajectories, number=number)
        of_states = estimate.utilities_and_draws(states, number=number)[1]
        np.testing.assert_allclose(drawn, of_states.reshape(len(drawn), 4, 6).sum(axis=2), atol=1e-10)
    assert len(drawn) == 1
    with pytest.raises(ValueError, match="number: expected a whole number >= 1, got 0"):
        estimate.utilities_and_draws(states, number=0)[1]


@pytest.mark.slow
def test_mean_and_draws_in_one_pass_are_those_of_two():
    trajectories = walks()
    comparisons = Comparisons.among(trajectories, PAIRS, discount=1.0)
    one = estimate_utility(comparisons, LINE, PreferenceModel(), method="posterior-mean")
    for estimate in (averaged(LINE, trajectories, PAIRS), one):
        mean, draws = estimate.utilities_and_draws(STATES, number=20)
        np.testing.assert_allclose(mean, estimate.utilities(STATES), rtol=1e-12)
        every = estimate.utilities_and_draws(STATES)[1]
        np.testing.assert_allclose(draws, every[:: len(every) // 20], rtol=1e-12)
        assert draws.shape == (20, len(STATES))


def test_each_draw_is_of_its_own_component():
    estimate = averaged(LINE, walks(), PAIRS)
    assert len(set(estimate.components)) == len(BANDWIDTH_MULTIPLES)  # three answers leave all open
    drawn = estimate.utilities_and_draws(STATES)[1]
    for draw in (0, 77, 199):
        features = LINE.rescaled(estimate.multiples[estimate.components[draw]])
        np.testing.assert_allclose(drawn[draw], features(STATES) @ estimate.weight_draws[draw], atol=1e-12)
    shares = np.bincount(estimate.components) / len(estimate.components)
    np.testing.assert_allclose(shares, estimate.probabilities, atol=1.01 / 200)  # drawn evenly


@pytest.mark.slow
def test_features_without_bandwidths_are_averaged_over_the_steepness_alone():
    stays = [Trajectory(np.full(5, s), np.zeros(4, dtype=int), np.zeros(4)) for s in range(3)]
    estimate = averaged(OneHot(3), stays, [(1, 0), (2, 1)], likelihood="mixed")
    assert estimate.multiples.shape == (1, 0)
    assert estimate.utilities(np.arange(3))[2] > estimate.utilities(np.arange(3))[0]


def test_of_many_dimensions_some_length_scales_are_taken():
    centres = np.random.default_rng(1).uniform(-1, 1, size=(6, 4))
    features = RadialBasis(centres, np.full(4, 0.5), np.full(4, np.inf), normalised=True)
    walk = [Trajectory(centres[[i, i + 1, i]], np.zeros((2, 1)), np.zeros(2)) for i in range(3)]
    estimate = averaged(features, walk, [(0, 1), (1, 2)], likelihood="mixed")
    assert 1 < len(estimate.multiples) <= MOST_BANDWIDTHS
    assert len(np.unique(estimate.multiples, axis=0)) == len(estimate.multiples)
    assert set(estimate.multiples.flat) <= set(BANDWIDTH_MULTIPLES)


@pytest.mark.slow
@pytest.mark.parametrize("sure", [0.0, 1.1])
def test_an_unsure_learner_asks_for_information_about_all_that_was_never_shown(sure):
    run = Learner("swing-up", iterations=4, centres=20, **(ALL | {"query": InformationWhenUnsure(sure)}), **QUICK)
    newcomers, old = [], 0
    while questions := run.ask():
        (question,) = questions
        if run.state.iteration:
            shown = {number for query in newcomers for number in query}
            numbers = [i for i in range(len(run.trajectories)) if i not in shown]
            assert question.newcomer in numbers
            if sure == 0.0:  # never unsure: the paper's rule
                numbers = list(range(len(run.trajectories) - 10, len(run.trajectories)))
                scores = run.estimate.trajectory_utilities([run.trajectories[i] for i in numbers])
            else:
                asked = [run.trajectories[i] for i in [*numbers, question.incumbent]]
                draws = run.estimate.trajectory_draws(asked)
                likelihood = run.estimate.likelihood
                scores = queries.expected_information(draws[:, :-1], draws[:, -1], likelihood=likelihood)
            assert scores[numbers.index(question.newcomer)] == scores.max()
            assert len(run.state.candidates) == 10
            old += question.newcomer < len(run.trajectories) - 10
        newcomers.append((question.first, question.second))
        run.tell([ReturnExpert()(*question.trajectories)])
    assert (old > 0) == (sure > 1)


@pytest.mark.slow
def test_what_cannot_be_tells_nothing_and_is_not_asked_again():
    run = Learner("gridworld", iterations=3, **ALL, **(QUICK | {"hyperparameters": "given"}))
    skipped = []
    while questions := run.ask():
        (question,) = questions
        assert question.newcomer not in skipped
        if run.state.iteration and len(skipped) < 3:
            skipped.append(question.newcomer)
            run.tell(["skip"])
        else:
            run.tell([ReturnExpert()(*question.trajectories)])
    assert len(skipped) == 3
    assert run.preferences.answers == 4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"query": "information-when-unsure"}, "schedule: expected confidence with the query information-when-unsure"),
        (
            {"hyperparameters": "averaged", "utility": "linear-program"},
            "utility: expected posterior-mean with averaged",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(options, message):
    with pytest.raises(ValueError, match=f"^{message}.*, got "):
        Learner("gridworld", **options)
