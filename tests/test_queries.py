"""Step 4: candidates and how they are shown."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bayespbrl.models.likelihoods import Logistic, Mixed, Probit, WithLapses
from bayespbrl.preferences import Preferences
from bayespbrl.queries import (
    ONLY_TIES,
    QUERY_RULES,
    InformationWhenUnsure,
    QuerySituation,
    candidates,
    expected_information,
    probability_better,
    random_candidates,
    show,
)
from bayespbrl.questions import (
    LEAST_INFORMATION,
    Questions,
    confirmation,
    first_questions,
    later_questions,
    opponents_from_the_same_start,
    rivals,
)
from bayespbrl.trajectories import Trajectory, same_starts


class Draws:
    """An estimate whose trajectories are the numbers of columns of a table of draws."""

    posterior = None  # no tree of draws

    def __init__(self, table, likelihood):
        self.table, self.answers = table, likelihood

    def likelihood(self, number=None):
        return self.answers

    def trajectory_draws(self, trajectories, *, number=None):
        return self.table[:, list(trajectories)]

    def trajectory_utilities(self, trajectories):
        return self.table[:, list(trajectories)].mean(axis=0)


def situation(utilities, incumbent, *, likelihood=None, rng=None, shown=(), signal=None, new=None):
    """Newcomers 0 … n − 1 and the incumbent n."""
    table, number = np.column_stack([utilities, incumbent]), utilities.shape[1]
    likelihood = Logistic(1.0) if likelihood is None else likelihood
    rng = np.random.default_rng(0) if rng is None else rng
    new = range(number) if new is None else new
    return QuerySituation(
        new, range(number + 1), frozenset({number, *shown}), number, Draws(table, likelihood), signal, rng
    )


def order(rule, *arguments, **options):
    return candidates(QUERY_RULES[rule], situation(*arguments, **options))


def test_highest_utility_comes_first_and_equals_stay_in_their_order():
    assert order("highest-utility", np.array([[0.5, -1.0, 2.0, 0.5]]), np.zeros(1)) == (2, 0, 3, 1)
    assert order("highest-utility", np.zeros((1, 3)), np.zeros(1)) == (0, 1, 2)


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


# Four draws of three newcomers; the incumbent is 0 in each. Better in 1, 3 and 2 of the four draws; the mean is highest
# for the first, which is far better in one draw.
DRAWS = np.array([[9.0, 1.0, 2.0], [-1.0, 1.0, 2.0], [-1.0, 1.0, -2.0], [-1.0, -1.0, -2.0]])
ZERO = np.zeros(4)


def test_probability_better_counts_draws_and_half_of_the_equal_ones():
    np.testing.assert_array_equal(probability_better(DRAWS, ZERO), [0.25, 0.75, 0.5])
    np.testing.assert_array_equal(probability_better(DRAWS, DRAWS[:, 1]), [0.375, 0.5, 0.5])
    # draws of both belong together: shifting both by anything a draw changes nothing
    shift = np.array([3.0, -40.0, 0.5, 7.0])
    np.testing.assert_array_equal(probability_better(DRAWS + shift[:, None], shift), [0.25, 0.75, 0.5])


def test_rules_order_the_same_draws_each_in_its_way():
    assert order("highest-utility", DRAWS, ZERO) == (0, 1, 2)
    assert order("probably-better", DRAWS, ZERO) == (1, 2, 0)
    # variances of the order 3/16, 3/16, 1/4: the even match first, then the equal ones by their mean
    assert order("disagreement", DRAWS, ZERO) == (2, 0, 1)
    # on what is equal in every draw they all agree
    assert order("disagreement", np.column_stack([ZERO, DRAWS]), ZERO)[-1] == 0
    # the mean of the better of the two: 9/4, 3/4, 4/4
    assert order("eubo", DRAWS, ZERO) == (0, 2, 1)
    # a logistic answer at ±1 is a vague one; at ±2 and evenly split it tells most
    assert order("information", DRAWS, ZERO)[0] == 2


def test_candidates_that_the_rule_cannot_tell_apart_come_by_their_mean_then_in_their_order():
    utilities = np.array([[1.0, 3.0, 2.0, 3.0], [1.0, 3.0, 2.0, 3.0]])
    for rule in ("probably-better", "disagreement", "information"):
        likelihood = Mixed(1e9, 1e9)  # every answer is certain, so that none tells anything
        assert order(rule, utilities, np.zeros(2), likelihood=likelihood) == (1, 3, 2, 0)


def test_thompson_ranks_by_one_draw_and_picks_each_draw_as_often():
    rng = np.random.default_rng(2)
    drawn = [order("thompson", DRAWS, ZERO, rng=rng) for _ in range(2000)]
    orders = [(0, 2, 1), (2, 1, 0), (1, 0, 2), (0, 1, 2)]  # in the last draw 0 and 1 are equal; 0 has the higher mean
    assert set(drawn) == set(orders)
    for expected in orders:
        assert abs(drawn.count(expected) / 2000 - 0.25) < 4 * np.sqrt(0.25 * 0.75 / 2000)


def test_thompson_is_chosen_by_its_stream():
    rankings = [
        [order("thompson", DRAWS, ZERO, rng=rng) for _ in range(20)]
        for rng in (np.random.default_rng(5), np.random.default_rng(5), np.random.default_rng(6))
    ]
    assert rankings[0] == rankings[1]
    assert rankings[0] != rankings[2]


def test_expected_information_of_certain_answers_is_the_entropy_of_the_order():
    # each draw knows its answer: H(p) = 0, and what remains is the entropy of a coin with the share of draws
    information = expected_information(DRAWS, ZERO, likelihood=Logistic(1e6))
    shares = np.array([0.25, 0.75, 0.5])
    np.testing.assert_allclose(information, -shares * np.log(shares) - (1 - shares) * np.log(1 - shares), atol=1e-12)


def test_expected_information_matches_the_mutual_information_of_the_joint_table():
    rng = np.random.default_rng(4)
    utilities, incumbent = rng.normal(size=(50, 3)), rng.normal(size=50)
    steepness = 1.4
    p = 1 / (1 + np.exp(-steepness * (utilities - incumbent[:, None])))
    expected = []
    for column in p.T:
        joint = np.column_stack([column, 1 - column]) / 50  # (draw, answer)
        independent = joint.sum(axis=1, keepdims=True) * joint.sum(axis=0)
        expected.append(np.sum(joint * np.log(joint / independent)))
    information = expected_information(utilities, incumbent, likelihood=Logistic(steepness))
    np.testing.assert_allclose(information, expected, rtol=1e-10)


def test_expected_information_counts_a_tie_as_an_answer_where_it_is_told_of_thresholds():
    rng = np.random.default_rng(4)
    margins, thresholds, lapse_rate = rng.normal(size=(50, 3)), rng.gamma(2.0, 0.3, size=(50, 1)), 0.2

    def sigmoid(t):
        return 1 / (1 + np.exp(-1.4 * t))

    attentive = np.array([sigmoid(margins - thresholds), sigmoid(-margins - thresholds)])
    p = lapse_rate / 3 + (1 - lapse_rate) * np.concatenate([attentive, 1 - attentive.sum(axis=0, keepdims=True)])
    joint = p / 50  # (answer, draw, comparison)
    independent = joint.sum(axis=0, keepdims=True) * joint.sum(axis=1, keepdims=True)
    likelihood = WithLapses(Logistic(1.4), lapse_rate)
    information = expected_information(margins, np.zeros(50), likelihood=likelihood, tie_thresholds=thresholds)
    np.testing.assert_allclose(information, np.sum(joint * np.log(joint / independent), axis=(0, 1)), rtol=1e-6)


@pytest.mark.parametrize(("ties", "first"), [(0, 1), (ONLY_TIES - 1, 1), (ONLY_TIES, 0)])
def test_after_nothing_but_ties_information_is_asked_about_what_may_be_none(ties, first):
    # The first newcomer is much better or no worse; the second is a little better or worse: a tie for certain.
    utilities = np.column_stack([np.repeat([0.01, 9.0], 50), np.tile([-0.1, 0.1], 50)])
    given = replace(situation(utilities, np.zeros(100), likelihood=Logistic(90.0)), only_ties=ties)
    given.estimate.tie_thresholds = lambda number=None: np.full((100, 1), 1.0)
    assert candidates(QUERY_RULES["information"], given)[0] == first


def test_answers_that_are_coin_tosses_tell_nothing_and_draws_that_agree_tell_nothing():
    same = np.full((6, 2), 0.3)
    np.testing.assert_allclose(expected_information(same, np.zeros(6), likelihood=Logistic(2.0)), 0.0, atol=1e-15)
    sure = expected_information(DRAWS, ZERO, likelihood=Logistic(3.0))
    lapsing = expected_information(DRAWS, ZERO, likelihood=WithLapses(Logistic(3.0), 0.4))
    assert (lapsing < 0.5 * sure).all()
    tossed = expected_information(DRAWS, ZERO, likelihood=WithLapses(Logistic(3.0), 1 - 1e-9))
    np.testing.assert_allclose(tossed, 0.0, atol=1e-12)


def test_expected_information_takes_the_steepness_and_lapse_rate_of_each_draw():
    steepness, lapse_rate = np.array([[0.5], [2.0], [4.0], [30.0]]), np.array([[0.0], [0.3], [0.0], [0.1]])
    each = [1 / (1 + np.exp(-m * row)) for m, row in zip(steepness, DRAWS, strict=True)]
    p = lapse_rate / 2 + (1 - lapse_rate) * np.array(each)

    def entropy(p):
        return -p * np.log(p) - (1 - p) * np.log(1 - p)

    information = expected_information(DRAWS, ZERO, likelihood=WithLapses(Logistic(steepness), lapse_rate))
    np.testing.assert_allclose(information, entropy(p.mean(axis=0)) - entropy(p).mean(axis=0), atol=1e-7)


@pytest.mark.parametrize("likelihood", [Mixed(5.0, 40.0), Mixed(5.0, 1.0), Logistic(1e-3), Probit(30.0)])
def test_expected_information_lies_between_nothing_and_one_bit(likelihood):
    rng = np.random.default_rng(9)
    information = expected_information(
        rng.normal(size=(400, 8)) * 10.0 ** np.arange(-4, 4), np.zeros(400), likelihood=likelihood
    )
    assert (information >= 0).all()
    assert (information <= np.log(2)).all()


def test_information_prefers_what_the_posterior_is_unsure_of_over_what_the_expert_is():
    # The first newcomer nearly equals the incumbent in every draw: its answer is a toss, and all draws agree on that.
    # The second is far better or far worse: its answer tells which.
    utilities = np.column_stack([np.tile([-0.01, 0.01], 50), np.repeat([-3.0, 3.0], 50)])
    for rule in ("information", "disagreement"):
        found = order(rule, utilities + 1.0, np.ones(100), likelihood=Logistic(5.0))
        assert found == ((1, 0) if rule == "information" else (0, 1))  # to the order alone both are even matches


@pytest.mark.parametrize(
    ("utilities", "incumbent", "message"),
    [
        (DRAWS, np.zeros(3), r"utilities: expected draws of shape \(S, n\), and .*got \(4, 3\) and \(3,\)"),
        (DRAWS[0], ZERO, "utilities: expected draws"),
        (DRAWS[:0], ZERO[:0], "utilities: expected draws"),
        (DRAWS * np.nan, ZERO, "utilities: expected finite draws"),
        (DRAWS, ZERO + np.inf, "utilities: expected finite draws"),
    ],
)
def test_draws_that_do_not_fit_are_refused(utilities, incumbent, message):
    with pytest.raises(ValueError, match=message):
        probability_better(utilities, incumbent)


def test_without_a_sure_signal_information_is_asked_about_all_that_was_never_shown():
    # trajectory 2 was shown; of the others only 1 is new
    about = {"shown": (2,), "new": [1], "likelihood": Logistic(5.0)}
    for signal, expected in ((None, (0,)), (0.74, (0,)), (0.75, (1,)), (1.0, (1,))):
        given = situation(DRAWS * [9.0, 0.2, 0.2], ZERO, signal=signal, **about)
        assert candidates(InformationWhenUnsure(), given) == expected


def test_each_is_compared_with_its_own_opponent():
    opponents = DRAWS[:, [1, 2, 0]]
    np.testing.assert_array_equal(probability_better(DRAWS, opponents), [0.375, 0.5, 0.25])
    given = replace(situation(DRAWS, ZERO, likelihood=Logistic(1.0)), opponents={0: 1, 1: 2, 2: 0})
    alone = [
        expected_information(DRAWS[:, [i]], DRAWS[:, j], likelihood=Logistic(1.0))[0]
        for i, j in ((0, 1), (1, 2), (2, 0))
    ]
    np.testing.assert_allclose(given.information(), alone)
    assert candidates(QUERY_RULES["information"], given)[0] == np.argmax(alone)


def from_start(start, *, steps=2):
    states = np.arange(steps + 1.0)[:, None] + start
    return Trajectory(states, np.zeros((steps, 1)), np.zeros(steps))


def test_an_opponent_is_from_the_same_start_where_there_is_one():
    trajectories = [from_start(start) for start in (0, 5, 0, 5, 0, 9)]
    assert same_starts(trajectories) == [[0, 2, 4], [1, 3], [5]]

    def opponents(undominated, favourites=()):
        return opponents_from_the_same_start(trajectories, Preferences(undominated=undominated), favourites)

    assert opponents(()) == {0: 2, 2: 0, 4: 0, 1: 3, 3: 1}  # the first other one; 5 is alone
    assert opponents((2, 3)) == {0: 2, 2: 0, 4: 2, 1: 3, 3: 1}  # the one that was shown and not beaten
    assert opponents((2, 0)) == {0: 2, 2: 0, 4: 0, 1: 3, 3: 1}  # the newest of those
    assert opponents((), favourites=(3, 4)) == {0: 4, 2: 4, 4: 0, 1: 3, 3: 1}


def test_rivals_are_the_undominated_of_the_start_and_all_across_starts():
    trajectories = [from_start(start) for start in (0, 5, 0, 5, 0, 9)]
    preferences = Preferences(undominated=(1, 0, 2))
    assert rivals(show(1, 4, 2, trajectories, rng=np.random.default_rng(0)), trajectories, preferences) == [0, 2]
    assert rivals(show(1, 5, 2, trajectories, rng=np.random.default_rng(0)), trajectories, preferences) == [1, 0, 2]


def test_the_first_questions_are_about_each_pair_from_one_start_once():
    rng = np.random.default_rng(0)
    chosen = first_questions(range(4), {0: 1, 1: 0, 2: 3, 3: 2}, Questions(), rng=rng)
    assert sorted(zip(chosen.candidates, chosen.opponents, strict=True)) == [(1, 0), (3, 2)]
    assert chosen.wanted == 2
    assert first_questions(range(4), {}, Questions(answers=1), rng=rng).wanted == 1
    assert first_questions(range(4), {}, Questions(), rng=rng).opponents is None


def test_a_question_is_left_out_whose_answer_would_tell_nothing():
    known, unknown = Preferences(((0, 1),), (0,), 4), Preferences((), (0, 1), 4)

    def chosen(draws, after=known, **options):
        given = situation(draws, ZERO)
        given.estimate.posterior = "drawn"
        return later_questions(QUERY_RULES["information"], given, Questions(**options), after, unasked=0)

    foreseeable = np.full((4, 3), 9.0)
    assert chosen(foreseeable).wanted == 1
    worthless = chosen(foreseeable, worthwhile=True)
    assert (worthless.wanted, worthless.information) == (0, pytest.approx(0, abs=1e-9))
    assert chosen(foreseeable, unknown, worthwhile=True).wanted == 1
    open_one = chosen(DRAWS, worthwhile=True)
    assert open_one.wanted == 1
    assert open_one.information > LEAST_INFORMATION


def test_nothing_is_asked_once_the_budget_is_spent():
    estimate = SimpleNamespace(quality=SimpleNamespace(converged=True))
    options = Questions(answers=3)
    assert not options.skips(Preferences(((0, 1),), (0,), 2), 0, estimate, 0.9)
    assert options.skips(Preferences(((0, 1),), (0,), 3), 0, estimate, 0.9)
    several = Questions(answers=3, queries_per_iteration=4)
    assert [several.within_budget(4, answers) for answers in (0, 1, 2, 3, 9)] == [3, 2, 1, 0, 0]
    given = situation(DRAWS, ZERO)
    after = Preferences(((0, 1),), (0,), 1)
    assert later_questions(QUERY_RULES["information"], given, several, after, unasked=0).wanted == 2


@pytest.mark.parametrize(
    ("likely", "signal", "answers", "expected"),
    [
        (0.5, 0.9, 8, (1, (2,))),  # in doubt, where the iteration would ask nothing
        (0.5, 0.1, 8, (1, (2, 0, 1))),  # in doubt: before those of the rule
        (0.95, 0.9, 8, (0, ())),  # foreseen: the signal is high, so the iteration asks nothing
        (0.5, 0.9, 20, (0, ())),  # the budget is spent
    ],
)
def test_a_policy_without_its_noise_is_asked_about_while_the_posterior_doubts_it(likely, signal, answers, expected):
    """Trajectory 2 is without noise, 3 the incumbent; the rule by itself would ask about 0, 1, 2."""
    better = np.where(np.arange(100) < 100 * likely, 9.0, -9.0)
    draws = np.column_stack([np.full(100, 30.0), np.full(100, 20.0), better])
    given = replace(situation(draws, np.zeros(100), signal=signal), noise_free=2)
    given.estimate.posterior, given.estimate.quality = "drawn", SimpleNamespace(converged=True)
    options, after = Questions(unasked_iterations=4, answers=20, worthwhile=True), Preferences(((0, 1),), (0,), answers)
    chosen = later_questions(QUERY_RULES["highest-utility"], given, options, after, unasked=0)
    assert (chosen.wanted, chosen.candidates) == expected
    without = replace(given, noise_free=None)
    assert later_questions(QUERY_RULES["highest-utility"], without, options, after, unasked=0).wanted == 0


@pytest.mark.parametrize(
    ("margin", "chance", "expected"),
    [
        (3.0, 0.5, (2,)),  # E max − max E = 1.5, where what was shown has a standard deviation of 5
        (3.0, 0.04, (2,)),  # 0.12
        (3.0, 0.02, ()),  # 0.06, below a fiftieth of 5
        (3.0, 1.0, ()),  # its opponent is better for sure
        (0.1, 0.5, ()),  # nobody knows which of the two is better, and it hardly matters
        (0.0, 0.5, ()),
    ],
)
def test_a_policy_without_noise_is_asked_about_where_it_matters_which_of_the_two_is_kept(margin, chance, expected):
    """Trajectory 2 is without noise, 1 its opponent, 0 and 3 were shown."""
    opponents = np.where(np.arange(100) < 100 * chance, margin, -margin) + 20.0
    draws = np.column_stack([np.full(100, 30.0), opponents, np.full(100, 20.0)])
    given = replace(situation(draws, np.full(100, 20.0)), noise_free=2, opponents={2: 1}, shown=frozenset({0, 3}))
    assert given.at_stake() == ()  # no posterior
    given.estimate.posterior, given.estimate.quality = "drawn", SimpleNamespace(converged=True)
    assert given.at_stake() == expected
    assert replace(given, noise_free=None).at_stake() == ()
    options, after = Questions(answers=20, against_kept=True), Preferences(((0, 3),), (3,), 8)
    chosen = later_questions(QUERY_RULES["highest-utility"], given, options, after, unasked=0)
    assert chosen.candidates[0] == (2 if expected else 0)
    assert (chosen.opponents is not None) == bool(expected)
    if expected:
        assert chosen.opponents[:2] == (1, 3)


@pytest.mark.parametrize(
    ("noise_free", "answers", "opponents", "expected"),
    [
        (2, 8, {}, (1, (2,), (3,))),
        (2, 8, {2: 1}, (1, (2,), (1,))),
        (None, 8, {}, (0, (), None)),
        (2, 20, {}, (0, (), None)),
    ],
)
def test_a_restarted_policy_is_asked_about_though_the_posterior_is_sure(noise_free, answers, opponents, expected):
    draws = np.column_stack([np.full(100, 30.0), np.full(100, 20.0), np.full(100, 9.0)])
    given = replace(situation(draws, np.zeros(100)), noise_free=noise_free, opponents=opponents)
    given.estimate.posterior = "drawn"
    options = Questions(answers=20, worthwhile=True)
    chosen = confirmation(given, options, Preferences(((0, 1),), (0,), answers))
    assert (chosen.wanted, chosen.candidates, chosen.opponents) == expected
    assert chosen.information is None or chosen.information < 1e-6


@pytest.mark.parametrize(("signal", "sure"), [(0.49, False), (0.51, True)])
def test_an_iteration_asks_nothing_from_a_signal_of_one_half_on(signal, sure):
    estimate = SimpleNamespace(quality=SimpleNamespace(converged=True))
    options, preferences = Questions(unasked_iterations=4), Preferences(((0, 1),), (0,), 8)
    assert options.skips(preferences, 0, estimate, signal) == sure
    estimate.quality.converged = False
    assert not options.skips(preferences, 0, estimate, signal)


def test_three_lines_make_a_rule_of_ones_own():
    def newest(situation):
        return sorted(situation.new, reverse=True)

    assert candidates(newest, situation(DRAWS, ZERO)) == (2, 1, 0)


@pytest.mark.parametrize("order_given", [[], None, [0, 0], [0, 4], [-1], [0.5], ["first"], 3])
def test_an_order_that_is_none_is_named(order_given):
    def careless(situation):
        return order_given

    with pytest.raises(ValueError, match="query rule careless: expected different trajectory numbers below 4, got"):
        candidates(careless, situation(DRAWS, ZERO))


def test_undominated_trajectories_in_an_order_are_left_out():
    given = replace(situation(DRAWS, ZERO), undominated=(1, 3))
    assert candidates(lambda _: [3, 1, 0, 2], given) == (0, 2)
    assert candidates(lambda _: [3, 2, 1, 0], situation(DRAWS, ZERO)) == (2, 1, 0)  # the incumbent is always one


@pytest.mark.parametrize("order_given", [[3], [1, 3]])
def test_a_rule_that_names_undominated_trajectories_only_is_refused(order_given):
    def fond(situation):
        return order_given

    given = replace(situation(DRAWS, ZERO), undominated=(1, 3))
    message = r"query rule fond: expected a trajectory other than the undominated \[1, 3\], got \["
    with pytest.raises(ValueError, match=message):
        candidates(fond, given)


def test_eubo_asks_about_the_best_of_both_where_each_has_an_opponent_of_its_own():
    # the second is better than its opponent by more, the first has the better best: E max 5 and 4
    table = np.array([[5.0, 4.0, 5.0, 1.0]])
    given = replace(situation(table[:, :3], table[:, 3]), new=[0, 1], opponents={0: 2, 1: 3})
    assert QUERY_RULES["eubo"](given) == [0, 1]


def test_where_worth_counts_a_question_that_tells_little_is_asked_after_one_that_tells_much():
    """The third is without noise: once in a hundred its opponent is far better, worth an answer that tells little."""
    chance = np.where(np.arange(1000) < 10, 500.0, 10.0)
    draws = np.column_stack([np.where(np.arange(1000) % 2, 9.0, -9.0), chance, np.full(1000, 20.0)])
    given = replace(situation(draws, np.zeros(1000)), noise_free=2, opponents={2: 1}, shown=frozenset({0, 3}))
    given.estimate.answers = WithLapses(Logistic(1.0), 0.6)
    given.estimate.posterior, given.estimate.quality = "drawn", SimpleNamespace(converged=True)
    assert given.at_stake() == (2,)
    assert given.told_by(2) < LEAST_INFORMATION < given.told_by(0)
    for worthwhile, first in ((False, 2), (True, 0)):
        options = Questions(answers=20, against_kept=True, worthwhile=worthwhile)
        after = Preferences(((0, 3),), (3,), 8)
        chosen = later_questions(QUERY_RULES["information"], given, options, after, unasked=0)
        assert (chosen.wanted, chosen.candidates[0]) == (1, first)
