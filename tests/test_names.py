"""Names of environments: their parts, and runs of a task that gymnasium makes with arguments."""

import json

import gymnasium
import numpy as np
import pytest
from test_cli import call, refused
from toys import QUICK

import bayespbrl
from bayespbrl.envs.names import parsed, spec_named
from bayespbrl.envs.opening import identity, open_environment, reopened
from bayespbrl.settings import settings_for

SMALL = QUICK | {"preset": "paper", "iterations": 2, "max_steps": 20}
DRY = "FrozenLake-v1,is_slippery=false"


def test_the_parts_of_a_name_and_the_kinds_of_values():
    name = parsed("package.tasks:own/Maze-v0,size=8,wind=-1e-3,map_name=8x8,seen=False,goal=None,code='3',path=a:b")
    assert (name.module, name.id) == ("package.tasks", "own/Maze-v0")
    expected = {"size": 8, "wind": -1e-3, "map_name": "8x8", "seen": False, "goal": None, "code": "3", "path": "a:b"}
    assert name.arguments == expected
    assert [type(value) for value in name.arguments.values()] == [type(value) for value in expected.values()]
    assert parsed("swing-up") == ("", "bayespbrl/SwingUp-v0", {})


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Pendulum-v1,", "environment Pendulum-v1: expected NAME=VALUE after each comma, each once, got ''"),
        ("Pendulum-v1,g", "environment Pendulum-v1: expected NAME=VALUE after each comma, each once, got 'g'"),
        ("Pendulum-v1,g=1,g=2", "expected NAME=VALUE after each comma, each once, got 'g=2'"),
        ("Pendulum-v1,render_mode=human", "environment Pendulum-v1: expected no render_mode, as pictures choose it"),
        ("Pendulum-v1,max_episode_steps=9", "expected no max_episode_steps, as the option max_steps ends trajectories"),
        ("Pendulum-v1,mass=2", "environment Pendulum-v1: expected one that gymnasium.make can make, got .*'mass'"),
        ("Gone-v1,g=1", "or a registered gymnasium id, got 'Gone-v1,g=1'"),
    ],
)
def test_what_is_no_name_is_refused(name, message):
    with pytest.raises(ValueError, match=message):
        bayespbrl.Learner(name)


def test_arguments_are_of_this_name_alone():
    opened = open_environment("Pendulum-v1,g=3")
    assert opened.unwrapped.g == 3
    assert "g" not in gymnasium.spec("Pendulum-v1").kwargs
    assert open_environment("Pendulum-v1").unwrapped.g == 10.0
    assert spec_named("Pendulum-v1") is gymnasium.spec("Pendulum-v1")
    assert reopened("Pendulum-v1,g=3") == "named"
    assert identity("Pendulum-v1,g=3") not in (identity("Pendulum-v1"), identity("Pendulum-v1,g=4"))
    assert identity("FrozenLake-v1,map_name=8x8,is_slippery=false") == identity(f"{DRY},map_name='8x8'")


def test_all_copies_of_a_name_have_its_arguments():
    run = bayespbrl.Learner(DRY, **SMALL, trajectories_per_iteration=20)
    run.ask()
    moves = {(int(state), int(action)): set() for state in range(16) for action in range(4)}
    for trajectory in run.trajectories:
        for state, action, after in zip(trajectory.states, trajectory.actions, trajectory.states[1:], strict=False):
            moves[int(state), int(action)].add(int(after))
    assert max(map(len, moves.values())) == 1  # on ice that is not slippery a move decides where it leads
    assert sum(map(len, moves.values())) > 10


def test_the_rows_of_the_presets_are_of_names_without_arguments():
    for preset in ("default", "paper"):
        with_arguments, other = (settings_for(name, preset=preset) for name in ("swing-up,x=1", "SomebodysEnv-v3"))
        assert with_arguments.options() == other.options() != settings_for("swing-up", preset=preset).options()


def test_a_run_of_a_name_with_arguments_goes_on_by_itself(tmp_path):
    learner = bayespbrl.start(DRY, tmp_path / "run", **SMALL)
    answers = [bayespbrl.ReturnExpert()(*query.trajectories) for query in learner.ask()]
    learner.tell(answers)
    expected = learner.run(bayespbrl.ReturnExpert())
    assert bayespbrl.load(tmp_path / "run").learner.settings.env == DRY
    again = bayespbrl.resume(tmp_path / "run", env="FrozenLake-v1,is_slippery=False")
    for mine, theirs in zip(again.trajectories, expected.trajectories, strict=True):
        np.testing.assert_array_equal(mine.states, theirs.states)
    for other in ("FrozenLake-v1", "FrozenLake-v1,is_slippery=True"):
        with pytest.raises(
            ValueError, match=f"expected no env=, or {DRY}, which the run was started with, got {other}"
        ):
            bayespbrl.resume(tmp_path / "run", env=other)
    settings = tmp_path / "run" / "settings.json"
    settings.write_text(json.dumps(json.loads(settings.read_text()) | {"env": "FrozenLake-v1,is_slippery"}))
    with pytest.raises(ValueError, match="expected NAME=VALUE after each comma"):
        bayespbrl.load(tmp_path / "run")


def test_the_command_line_takes_arguments_in_a_name(tmp_path, monkeypatch, capsys):
    options = ["--preset", "paper", "--utility", "linear-program", "--iterations", "1", "--max-steps", "20"]
    assert call(monkeypatch, "run", DRY, *options, "--out", tmp_path / "run") == 0
    assert "FrozenLake-v1,is_slippery=false" in capsys.readouterr().out
    error = refused(monkeypatch, capsys, "run", "FrozenLake-v1,size", "--out", tmp_path / "other")
    assert "expected NAME=VALUE after each comma, each once, got 'size'" in error
    assert not (tmp_path / "other").exists()
