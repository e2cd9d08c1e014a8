"""Experts: the noise-free return, a share of wrong answers, a person at the prompt."""

import numpy as np
import pytest

from bayespbrl.experts import NoisyExpert, ReturnExpert, TerminalExpert
from bayespbrl.preferences import Answer
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
    with pytest.raises(ValueError, match=r"expert: expected one of .*, got 'left'"):
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


def test_a_person_who_types_nonsense_is_asked_again(tmp_path, capsys):
    assert person(tmp_path, "", "3", "firs", "2")(trajectory([0.0]), trajectory([1.0])) is Answer.SECOND
    assert capsys.readouterr().out.count("Expected one of 1, 2, t, s, u, q") == 3


@pytest.mark.parametrize("reply", ["q", "quit", "Q", EOFError, KeyboardInterrupt])
def test_a_person_can_stop(tmp_path, reply):
    with pytest.raises(KeyboardInterrupt):
        person(tmp_path, reply)(trajectory([0.0]), trajectory([1.0]))
