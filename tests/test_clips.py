"""Questions about a part of each trajectory: what is shown, what the answers are explained by, and what is kept."""

import json

import numpy as np
import pytest

import bayespbrl
from bayespbrl import Learner, ReturnExpert
from bayespbrl.trajectories import Trajectory, trajectory_features
from bayespbrl.utility.comparisons import Comparisons

OPTIONS = {"preset": "paper", "iterations": 3, "max_steps": 20, "evaluation_episodes": 2, "seed": 4}


class Watching:
    """The simulated expert, and what it was shown."""

    def __init__(self):
        self.shown = []

    def __call__(self, first, second):
        self.shown.append((first, second))
        return ReturnExpert()(first, second)


def test_a_clip_is_a_part_with_its_states_actions_rewards_and_its_end():
    whole = Trajectory(np.arange(6), np.arange(5) % 2, np.arange(5.0), terminated=True)
    part = whole.clip(1, 3)
    assert part.states.tolist() == [1, 2, 3, 4]
    assert part.actions.tolist() == [1, 0, 1]
    assert part.rewards.tolist() == [1, 2, 3]
    assert not part.terminated
    assert whole.clip(2, 3).terminated
    assert len(whole.clip(3, 9)) == 2


@pytest.mark.slow
def test_questions_show_clips_and_the_answers_are_explained_by_them(tmp_path, monkeypatch):
    explained = []
    among = Comparisons.among
    monkeypatch.setattr(
        Comparisons,
        "among",
        lambda trajectories, *a, **o: explained.append(trajectories) or among(trajectories, *a, **o),
    )
    expert = Watching()
    run = bayespbrl.start("gridworld", tmp_path / "run", utility="linear-program", clip_steps=6, **OPTIONS).run(expert)
    clips = run.state.clips
    assert [len(whole) for whole in run.trajectories] == [20] * 30  # the learner still learns from all of them
    assert {steps for _, steps in clips} == {6}
    assert len({first for first, _ in clips}) > 5  # anywhere
    assert all(0 <= first <= 14 for first, _ in clips)
    lines = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    asked = [line for line in lines if line["event"] == "asked"]
    for line, both in zip(asked, expert.shown, strict=True):
        for number, shown in zip((line["first"], line["second"]), both, strict=True):
            first, steps = clips[number]
            np.testing.assert_array_equal(shown.states, run.trajectories[number].states[first : first + steps + 1])
    for compared in explained:
        assert all(len(one) == 6 for one in compared)
    one_hot = np.eye(25).__getitem__
    expected = trajectory_features([shown for pair in expert.shown for shown in pair], one_hot, discount=1.0)
    assert expected.sum(axis=1).tolist() == [6] * len(expected)


@pytest.mark.slow
def test_a_run_with_clips_is_kept_goes_on_and_is_reported(tmp_path):
    options = OPTIONS | {"utility": "linear-program", "clip_steps": 6}
    begun = bayespbrl.start("gridworld", tmp_path / "run", **options)
    begun.tell([ReturnExpert()(*begun.ask()[0].trajectories)])
    again = bayespbrl.resume(tmp_path / "run")
    assert again.state.clips == begun.state.clips
    straight = Learner("gridworld", **options).run(ReturnExpert())
    assert again.run(ReturnExpert()).iterations[-1]["value"] == straight.iterations[-1]["value"]
    assert again.preferences == straight.preferences
    assert bayespbrl.load(tmp_path / "run").report().exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"clip_steps": 21}, "clip_steps: expected at most 20, the steps of an episode, got 21"),
        ({"clip_steps": 0}, "clip_steps: expected a whole number >= 1, got 0"),
        ({"clip_steps": 6, "same_start": True}, "same_start: expected false with clip_steps"),
    ],
)
def test_bad_clips_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Learner("gridworld", **OPTIONS, **options)
