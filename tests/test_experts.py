"""Experts: the noise-free return, a share of wrong answers, a person at the prompt."""

from types import SimpleNamespace

import numpy as np
import pytest
from toys import QUICK, Echo, Memory

import bayespbrl
from bayespbrl.experts import (
    SIMULATED,
    MarginExpert,
    NoisyExpert,
    ReturnExpert,
    Teacher,
    TerminalExpert,
    named_expert,
)
from bayespbrl.preferences import Answer
from bayespbrl.runs.simulated import expert_of
from bayespbrl.trajectories import Trajectory


def trajectory(rewards, seed=0):
    rewards = np.asarray(rewards, dtype=float)
    rng = np.random.default_rng(seed)
    return Trajectory(rng.normal(size=(len(rewards) + 1, 2)), rng.normal(size=(len(rewards), 1)), rewards)


def test_the_higher_undiscounted_return_is_preferred_even_if_it_is_longer_or_comes_late():
    late, early = trajectory([0, 0, 0, 3.0]), trajectory([2.9, 0])
    assert ReturnExpert()(late, early) is Answer.FIRST
    assert ReturnExpert()(early, late) is Answer.SECOND


def test_equal_returns_tie_whatever_the_order_of_the_sum():
    rewards = np.random.default_rng(1).normal(size=1000) * 1e3
    assert rewards.sum() != rewards[::-1].cumsum()[-1]  # rounding differs
    assert ReturnExpert()(trajectory(rewards), trajectory([rewards[::-1].cumsum()[-1]])) is Answer.TIE
    assert ReturnExpert()(trajectory([0.0]), trajectory([0.0, 0.0])) is Answer.TIE
    cancelling = [0.1, 0.2, -0.3]
    assert np.sum(cancelling) != np.sum(cancelling[::-1])
    assert ReturnExpert()(trajectory(cancelling), trajectory(cancelling[::-1])) is Answer.TIE


def test_a_small_but_real_difference_decides():
    assert ReturnExpert()(trajectory([1.0 + 1e-6]), trajectory([1.0])) is Answer.FIRST
    assert ReturnExpert()(trajectory([-1e-12]), trajectory([0.0])) is Answer.SECOND
    assert ReturnExpert()(trajectory([-2.0]), trajectory([-1.0])) is Answer.SECOND


def test_the_asked_share_of_answers_is_wrong():
    pairs = [(trajectory([1.0], 2 * i), trajectory([0.0], 2 * i + 1)) for i in range(4000)]
    for share in (0.0, 0.2, 1.0):
        expert = NoisyExpert(ReturnExpert(), share, seed=4)
        wrong = np.mean([expert(*pair) is Answer.SECOND for pair in pairs])
        assert abs(wrong - share) <= 4 * np.sqrt(share * (1 - share) / len(pairs))


def test_errors_on_errors_are_independent_of_them():
    pairs = [(trajectory([1.0], 2 * i), trajectory([0.0], 2 * i + 1)) for i in range(4000)]
    twice = NoisyExpert(NoisyExpert(ReturnExpert(), 0.3), 0.3)
    wrong = np.mean([twice(*pair) is Answer.SECOND for pair in pairs])
    assert abs(wrong - 0.42) <= 4 * np.sqrt(0.42 * 0.58 / len(pairs))


def test_wrong_answers_are_a_function_of_the_two_trajectories_and_the_seed_alone():
    pairs = [(trajectory([1.0], 2 * i), trajectory([0.0], 2 * i + 1)) for i in range(60)]

    def answers(seed, pairs):
        expert = NoisyExpert(ReturnExpert(), 0.5, seed=seed)
        return [expert(*pair) for pair in pairs]

    once = answers(0, pairs)
    assert answers(0, pairs) == once
    assert answers(0, pairs[::-1])[::-1] == once  # nothing remembered
    turned = {Answer.FIRST: Answer.SECOND, Answer.SECOND: Answer.FIRST}
    assert [turned[answer] for answer in answers(0, [(b, a) for a, b in pairs])] == once
    assert answers(1, pairs) != once
    assert len(set(once)) == 2


@pytest.mark.parametrize("answer", ["tie", "skip", "undo"])
def test_what_is_not_decided_cannot_be_turned_round(answer):
    assert NoisyExpert(lambda a, b: answer, 1.0)(trajectory([1.0]), trajectory([0.0], 1)) is Answer(answer)


@pytest.mark.parametrize("share", [-0.1, 1.5, float("nan")])
def test_a_share_of_wrong_answers_outside_zero_to_one_is_refused(share):
    with pytest.raises(ValueError, match="wrong_answers: expected"):
        NoisyExpert(ReturnExpert(), share)


@pytest.mark.parametrize("seed", [-1, 0.5, True, None])
def test_a_seed_that_is_no_whole_number_is_refused(seed):
    with pytest.raises(ValueError, match="seed: expected a whole number"):
        NoisyExpert(ReturnExpert(), 0.1, seed=seed)


def test_nonsense_of_the_expert_within_is_named():
    with pytest.raises(ValueError, match=r"answer: expected one of .*, got 'left'"):
        NoisyExpert(lambda a, b: "left", 0.1)(trajectory([1.0]), trajectory([0.0], 1))


def person(tmp_path, *replies):
    lines = iter(replies)

    def read(prompt):
        assert "[1] first" in prompt
        reply = next(lines)
        if isinstance(reply, type):
            raise reply
        return reply

    def draw(first, second, path):
        path.write_text(f"{len(first)} and {len(second)} steps")

    return TerminalExpert(draw, tmp_path / "pictures", read)


KEYS = {"1": "first", "2": "second", "t": "tie", "s": "skip", "u": "undo"}


@pytest.mark.parametrize(("reply", "answer"), [*KEYS.items(), *((a, a) for a in KEYS.values()), (" T \n", "tie")])
def test_a_person_answers_by_key_or_by_word(tmp_path, capsys, reply, answer):
    expert = person(tmp_path, reply)
    assert expert(trajectory([0.0, 1.0]), trajectory([1.0])) is Answer(answer)
    picture = tmp_path / "pictures" / "query.png"
    assert picture.read_text() == "2 and 1 steps"  # in the order shown
    assert str(picture) in capsys.readouterr().out


def test_how_long_a_person_took_is_without_the_drawing(tmp_path, monkeypatch):
    now = [0.0]

    def draw(first, second, path):
        now[0] += 60

    def read(prompt):
        now[0] += 2.5
        return "1"

    monkeypatch.setattr("bayespbrl.experts.time", SimpleNamespace(perf_counter=lambda: now[0]))
    expert, log = TerminalExpert(draw, tmp_path, read), Memory()
    assert expert.seconds is None
    options = QUICK | {"iterations": 1, "expert": "terminal"}
    bayespbrl.Learner("gridworld", **options).logged(log).run(expert, answerer="Ada")
    assert {event["seconds"] for event in log.answers()} == {2.5}


def test_a_person_who_types_nonsense_is_asked_again(tmp_path, capsys):
    assert person(tmp_path, "", "3", "firs", "2")(trajectory([0.0]), trajectory([1.0])) is Answer.SECOND
    assert capsys.readouterr().out.count("Expected one of 1, 2, t, s, u, q") == 3


@pytest.mark.parametrize("reply", ["q", "quit", "Q", EOFError, KeyboardInterrupt, RuntimeError])
def test_a_person_can_stop(tmp_path, reply):
    with pytest.raises(KeyboardInterrupt):
        person(tmp_path, reply)(trajectory([0.0]), trajectory([1.0]))


def wrong_share(expert, difference, number=4000):
    """Share of wrong answers about two returns that differ by `difference`, the better one first."""
    pairs = [(trajectory([difference], 2 * i), trajectory([0.0], 2 * i + 1)) for i in range(number)]
    return np.mean([expert(*pair) is Answer.SECOND for pair in pairs])


def close(share, expected, number=4000):
    return abs(share - expected) <= 4 * np.sqrt(expected * (1 - expected) / number)


def test_the_stochastic_teacher_is_boltzmann_rational():
    for difference in (0.1, 1.0, 3.0):
        assert close(wrong_share(Teacher(rationality=2.0, seed=3), difference), 1 / (1 + np.exp(2.0 * difference)))


def test_the_mistaken_teacher_errs_as_often_as_told_and_on_top_of_the_stochastic_one():
    assert close(wrong_share(Teacher(mistakes=0.1, seed=3), 5.0), 0.1)
    by_chance = 1 / (1 + np.exp(1.0))
    assert close(wrong_share(Teacher(1.0, mistakes=0.2), 1.0), 0.8 * by_chance + 0.2 * (1 - by_chance))


def test_an_expert_who_is_reversed_twice_errs_independently_each_time():
    errs, expert = 0.0, Teacher(mistakes=0.3, seed=3)
    for chance in (0.3, 0.3, 0.3):
        errs = errs * (1 - chance) + (1 - errs) * chance
    assert close(wrong_share(NoisyExpert(NoisyExpert(expert, 0.3, seed=3), 0.3, seed=3), 5.0), errs)


@pytest.mark.parametrize("expert", [Teacher(mistakes=0.1, seed=3), MarginExpert(2.0, seed=3)])
def test_an_expert_who_errs_and_is_reversed_with_the_same_seed_errs_independently(expert):
    errs = 0.1 if isinstance(expert, Teacher) else expert.error_probability(1.0)
    reversed_too = NoisyExpert(expert, 0.1, seed=3)
    assert close(wrong_share(reversed_too, 1.0), 0.9 * errs + 0.1 * (1 - errs))


def test_the_myopic_teacher_weighs_the_last_rewards_most():
    early, late = trajectory([3.0, 0, 0]), trajectory([0, 0, 2.0])
    assert Teacher()(early, late) is Answer.FIRST
    assert Teacher(discount=0.9)(early, late) is Answer.FIRST  # 3 · 0.81 > 2
    assert Teacher(discount=0.8)(early, late) is Answer.SECOND  # 3 · 0.64 < 2


def test_the_skipping_and_the_equal_teacher_follow_their_thresholds():
    low, high = trajectory([1.0]), trajectory([2.0])
    assert Teacher(least_return=2.5)(low, high) is Answer.SKIP
    assert Teacher(least_return=1.5)(low, high) is Answer.SECOND
    assert Teacher(equal_within=1.5)(low, high) is Answer.TIE
    assert Teacher(equal_within=1.0)(low, high) is Answer.SECOND


def test_the_margin_expert_errs_as_programming_by_feedback_says():
    expert = MarginExpert(width=2.0, seed=1)
    thresholds = np.random.default_rng(0).uniform(0, 2.0, 200_000)
    for difference in (0.2, 1.0, 1.8):
        simulated = np.maximum(0, (1 - difference / thresholds) / 2).mean()
        assert expert.error_probability(-difference) == pytest.approx(simulated, abs=0.003)
        assert close(wrong_share(expert, difference), expert.error_probability(difference))
    assert expert.error_probability(0) == 0.5
    assert expert.error_probability(2.5) == 0


@pytest.mark.parametrize("expert", [Teacher(1.0, seed=2), Teacher(mistakes=0.4, seed=2), MarginExpert(3.0, seed=2)])
def test_errors_are_a_function_of_the_two_trajectories_in_either_order(expert):
    pairs = [(trajectory([1.0], 2 * i), trajectory([0.0], 2 * i + 1)) for i in range(60)]
    turned = {Answer.FIRST: Answer.SECOND, Answer.SECOND: Answer.FIRST}
    once = [expert(*pair) for pair in pairs]
    assert [turned[expert(b, a)] for a, b in pairs] == once
    assert len(set(once)) == 2


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Teacher(rationality=0), "rationality"),
        (lambda: Teacher(rationality=None), "rationality: expected a number > 0"),
        (lambda: Teacher(least_return=None), "least_return: expected a number"),
        (lambda: NoisyExpert("return", 0.1), "expert: expected a function of two trajectories, got 'return'"),
        (lambda: NoisyExpert(ReturnExpert, 0.1), "expert: expected a function of two trajectories, got <class"),
        (lambda: Teacher(discount=0), "discount"),
        (lambda: Teacher(least_return=np.nan), "least_return"),
        (lambda: Teacher(equal_within=-1), "equal_within"),
        (lambda: Teacher(mistakes=2), "mistakes"),
        (lambda: MarginExpert(0), "width"),
        (lambda: named_expert("oracle"), "expert: expected one of return, stochastic"),
    ],
)
def test_bad_parameters_of_the_teachers_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_run_finds_the_expert_that_its_settings_name_in_units_of_its_task():
    options = {"preset": "paper", "utility": "linear-program", "max_steps": 20, "evaluation_episodes": 2, "seed": 3}
    found = {name: expert_of(bayespbrl.Learner("gridworld", expert=name, **options)) for name in SIMULATED}
    assert isinstance(found["return"], ReturnExpert)
    scale = found["margin"].width
    assert scale > 0
    assert found["stochastic"] == Teacher(rationality=1 / scale, seed=3)
    assert found["equal"] == Teacher(equal_within=0.1 * scale)
    assert (found["myopic"], found["mistaken"]) == (Teacher(discount=0.9), Teacher(mistakes=0.1, seed=3))
    learner = bayespbrl.Learner("gridworld", expert="skipping", iterations=3, **options)
    expert = expert_of(learner)
    learner.run(expert)
    assert expert_of(learner) == expert  # continued, it is the same


@pytest.mark.parametrize("name", ["stochastic", "skipping", "equal", "margin"])
def test_returns_that_are_equal_but_for_rounding_have_no_unit(name):
    learner = bayespbrl.Learner(Echo(reward=-0.01), expert=name, max_steps=200, preset="paper", seed=3)
    with pytest.raises(ValueError, match=f"expert: expected returns that differ for {name}, got -2 in all 100"):
        expert_of(learner)


def test_thresholds_are_in_units_of_the_clips_that_are_shown():
    options = {"preset": "paper", "utility": "linear-program", "max_steps": 40, "evaluation_episodes": 2, "seed": 3}
    widths = [
        expert_of(bayespbrl.Learner("gridworld", expert="margin", clip_steps=steps, **options)).width
        for steps in (None, 40, 4)
    ]
    assert widths[0] == pytest.approx(widths[1])
    assert 0 < widths[2] < 0.5 * widths[0]
