"""A run on disk: what it holds, that it comes back bit for bit, and what happens to damaged ones."""

import dataclasses
import errno
import json
import multiprocessing
import os
import pickle
import re
import shutil
import time
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from toys import QUICK, Odd, Slope, fingerprint

import bayespbrl
from bayespbrl import Learner, ReturnExpert
from bayespbrl.diagnostics.report import tables as report_tables
from bayespbrl.diagnostics.report import write_report
from bayespbrl.diagnostics.report.contents import read_contents
from bayespbrl.envs.opening import given_by_name, open_environment
from bayespbrl.envs.spaces import in_words
from bayespbrl.envs.stepping import step_limit
from bayespbrl.features import OneHot, drawn
from bayespbrl.policies import LinearGaussianPolicy, TabularPolicy
from bayespbrl.runs import directory as run_directory
from bayespbrl.runs import run as runs
from bayespbrl.runs.answers_file import read_answers
from bayespbrl.runs.directory import PartialLine, RunDirectory, read_log_lines
from bayespbrl.runs.stored_classes import classes_of, from_tree, to_tree
from bayespbrl.settings.presets import PAPER

FILES = {"settings.json", "events.jsonl", "summary.json", "iterations"}


def start(directory, **changes):
    return bayespbrl.start("gridworld", directory, **(QUICK | changes))


def contents(directory):
    return {
        str(path.relative_to(directory)): path.read_bytes() for path in sorted(directory.rglob("*")) if path.is_file()
    }


@pytest.fixture(scope="module")
def straight():
    """The run that was never stopped, and never written."""
    return fingerprint(Learner("gridworld", **QUICK).run(ReturnExpert()))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished run; not to be changed."""
    directory = tmp_path_factory.mktemp("runs") / "finished"
    start(directory).run(ReturnExpert())
    return directory


@pytest.fixture
def copy(finished, tmp_path):
    return Path(shutil.copytree(finished, tmp_path / "copy"))


def events(directory):
    return [json.loads(line) for line in (directory / "events.jsonl").read_text().splitlines()]


def test_a_run_directory_holds_what_it_should(finished):
    assert {path.name for path in finished.iterdir()} == FILES
    assert {path.name for path in (finished / "iterations").iterdir()} == {"0001.nc", "0002.nc", "0003.nc"}
    settings = json.loads((finished / "settings.json").read_text())
    assert settings["format"] == 3
    assert settings["version"] == "0.1.0"
    assert {name: settings[name] for name in QUICK} == QUICK
    assert settings["env"] == "gridworld"


def test_every_question_with_its_order_and_every_answer_is_in_the_log(finished):
    log = events(finished)
    first = ["collected", "asked", "answered", "asked", "answered", "improved"]
    assert [e["event"] for e in log] == first + 2 * ["collected", "asked", "answered", "improved"]
    asked = [e for e in log if e["event"] == "asked"]
    answered = [e for e in log if e["event"] == "answered"]
    assert [e["query"] for e in asked] == [e["query"] for e in answered] == [1, 2, 3, 4]
    assert all(e["newcomer"] in (e["first"], e["second"]) for e in asked)
    trajectories = bayespbrl.load(finished).trajectories
    for question, answer in zip(asked, answered, strict=True):
        both = (trajectories[question["first"]], trajectories[question["second"]])
        assert answer["answer"] == ReturnExpert()(*both)


def test_the_summary_lists_the_iterations(finished):
    summary = json.loads((finished / "summary.json").read_text())
    named = ["iteration", "answers", "pairs", "pairs_satisfied", "value", "kl_bound", "kl", "kl_fitted_policy"]
    named += ["feature_gap", "rank_kept", "temperature", "rhat_max", "effective_sample_size_min", "seconds"]
    assert all(set(named) <= set(iteration) for iteration in summary["iterations"])
    assert [iteration["iteration"] for iteration in summary["iterations"]] == [1, 2, 3]
    assert [iteration["answers"] for iteration in summary["iterations"]] == [2, 3, 4]
    assert (summary["finished"], summary["answers"]) == (True, 4)
    assert summary["iterations"] == bayespbrl.load(finished).iterations


def test_the_files_of_the_iterations_are_netcdf_and_nothing_is_pickled(finished):
    for number in (1, 2, 3):
        with xr.open_datatree(finished / "iterations" / f"000{number}.nc", engine="h5netcdf") as tree:
            assert set(tree.children) == {"trajectories", "policy", "utility"}
            states = tree["trajectories"]["states"]
            assert (states.dims, states.shape) == (("trajectory", "time"), (10, 21))
            assert tree["policy"]["table"].dtype == np.float64
            assert tree["utility"].attrs["class"] == "linear-program"
    for path, content in contents(finished).items():
        start = content[:4]
        assert start[1:] == b"HDF" if path.endswith(".nc") else start[:1] == b"{"


def test_what_is_loaded_is_what_was_learned(finished, straight):
    run = bayespbrl.load(finished)
    assert fingerprint(run.learner) == straight
    assert run.preferences.answers == 4
    assert len(run.trajectories) == 30
    assert run.settings.update.kl_bound == 0.3
    assert run.posterior is None
    assert run.estimate.quality.status == "Optimal"
    assert run.estimate.utilities(np.arange(25)).shape == (25,)


def test_the_estimate_of_every_iteration_can_be_read(finished, tmp_path):
    run = bayespbrl.load(finished)
    for number, summary in enumerate(run.iterations, 1):
        assert run.estimate_of(number).quality.pairs == summary["pairs"]
    np.testing.assert_array_equal(run.estimate_of(3).weights, run.estimate.weights)
    for bad in (0, 4):
        with pytest.raises(ValueError, match="iteration: expected"):
            run.estimate_of(bad)
    (Path(shutil.copytree(finished, tmp_path / "copy")) / "iterations" / "0001.nc").write_bytes(b"")
    with pytest.raises(ValueError, match=r"0001\.nc: expected the netCDF file of an iteration"):
        bayespbrl.runs.run.Run(tmp_path / "copy", run.learner).estimate_of(1)


def test_loading_changes_nothing(finished):
    before = contents(finished)
    run = bayespbrl.load(finished)
    run.evaluate(3)
    assert contents(finished) == before


def test_the_policy_acts(finished):
    policy = bayespbrl.load(finished).policy
    actions = [policy.act(state) for state in range(25)]
    assert all(type(action) is int and 0 <= action < 5 for action in actions)
    key = jax.random.key(3)
    assert policy.act(np.int64(12), key=key) == policy.act(12, key=key) == policy(12, key=key)


@pytest.mark.parametrize("observation", [np.zeros(3), [1], [[0, 1]]])
def test_the_policy_refuses_an_observation_of_another_shape(finished, observation):
    with pytest.raises(ValueError, match=r"observation: expected shape \(\), got \("):
        bayespbrl.load(finished).policy.act(observation)


def test_the_policy_goes_to_other_processes(finished):
    policy = bayespbrl.load(finished).policy
    key = jax.random.key(3)
    assert pickle.loads(pickle.dumps(policy)).act(12, key=key) == policy.act(12, key=key)


@pytest.mark.parametrize("observation", [25, -1, 2.7])
def test_the_policy_refuses_an_observation_that_is_no_state(finished, observation):
    with pytest.raises(ValueError, match=r"observation: expected one of Discrete\(25\), got "):
        bayespbrl.load(finished).policy.act(observation)


@pytest.mark.slow
@pytest.mark.parametrize("space", [gymnasium.spaces.Discrete(2, start=1), gymnasium.spaces.Box(-1, 1, (1, 2))])
def test_the_policy_acts_in_the_environment_as_it_was_given(tmp_path, space):
    environment = Odd(space)
    bayespbrl.start(environment, tmp_path / "run", **(QUICK | {"centres": 5})).ask()
    policy = bayespbrl.load(tmp_path / "run", env=environment).policy
    observation, _ = environment.reset(seed=0)
    for _ in range(8):
        observation, *_ = environment.step(policy.act(observation))


def test_settings_come_back_as_they_were_kept_whatever_the_preset_says_today(tmp_path):
    start(tmp_path / "run").ask()
    with mock.patch.dict(PAPER["gridworld"], {"trajectory_discount": 1.0}):
        assert bayespbrl.load(tmp_path / "run").settings.estimation.trajectory_discount is None
        assert start(tmp_path / "new").settings.estimation.trajectory_discount == 1.0


def test_an_environment_that_was_open_already_is_acted_in_as_it_is(tmp_path):
    environment = open_environment(Odd(gymnasium.spaces.Discrete(2, start=1)))
    bayespbrl.start(environment, tmp_path / "run", **(QUICK | {"centres": 5})).ask()
    policy = bayespbrl.load(tmp_path / "run", env=environment).policy
    observation, _ = environment.reset(seed=0)
    assert all(environment.action_space.contains(policy.act(observation)) for _ in range(8))


def test_evaluation_is_a_function_of_the_seed(finished):
    run = bayespbrl.load(finished)
    assert run.evaluate(3, seed=1) == run.evaluate(3, seed=1) == bayespbrl.load(finished).evaluate(3, seed=1)
    assert run.evaluate(3, seed=1) != run.evaluate(3, seed=2)


def test_a_directory_appears_with_its_settings_in_it_or_not_at_all(tmp_path, monkeypatch):
    seen = []
    write = run_directory.write_file
    monkeypatch.setattr(run_directory, "write_file", lambda file, text: seen.append(file) or write(file, text))
    learner = start(tmp_path / "deep" / "run")
    assert seen[0].parent != tmp_path / "deep" / "run"  # written aside
    assert {path.name for path in (tmp_path / "deep").iterdir()} == {"run"}
    assert {path.name for path in (tmp_path / "deep" / "run").iterdir()} == {"settings.json", "iterations"}
    assert learner.state.trajectories == ()

    def full(file, text):
        raise OSError("no space left on device")

    monkeypatch.setattr(run_directory, "write_file", full)
    with pytest.raises(
        ValueError, match=r"other: expected a place where a run directory can be made, got no space left"
    ):
        start(tmp_path / "other")
    assert {path.name for path in tmp_path.iterdir()} == {"deep"}


@pytest.mark.parametrize("kind", ["folder", "file", "run", "dangling link"])
def test_a_path_that_exists_is_refused_and_nothing_changed(tmp_path, finished, kind):
    path = tmp_path / "taken"
    if kind == "folder":
        path.mkdir()
    elif kind == "file":
        path.write_text("mine")
    elif kind == "run":
        shutil.copytree(finished, path)
    else:
        path.symlink_to(tmp_path / "nowhere")
    before = contents(tmp_path)
    it = "a run, which resume continues" if kind == "run" else "one that exists"
    with pytest.raises(ValueError, match=rf"taken: expected a run directory that does not exist yet, got {it}"):
        start(path)
    assert contents(tmp_path) == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["taken"]


def test_a_place_that_may_not_be_looked_at_is_refused(tmp_path, monkeypatch):
    def forbidden(path, **options):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    with monkeypatch.context() as patched:
        patched.setattr(Path, "exists", forbidden)
        with pytest.raises(ValueError, match=r"run: expected a place where a run directory can be made, got .*denied"):
            start(tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("what", ["take_over", "write_summary"])
def test_a_run_that_cannot_be_written_is_not_resumed_but_loaded(copy, monkeypatch, what):
    denied = mock.Mock(side_effect=PermissionError(errno.EACCES, "Permission denied"))
    monkeypatch.setattr(RunDirectory, what, denied)
    before = contents(copy)
    with pytest.raises(ValueError, match=r"copy: expected a run that can be written to, got .*Permission denied"):
        runs.resume(copy)
    bayespbrl.load(copy)
    assert contents(copy) == before


def test_a_log_that_cannot_be_read_is_named(copy, monkeypatch):
    denied = mock.Mock(side_effect=PermissionError(errno.EACCES, "Permission denied"))
    monkeypatch.setattr(run_directory, "_content", denied)
    with pytest.raises(ValueError, match=r"copy: events\.jsonl: expected a log that can be read, got .*denied"):
        bayespbrl.load(copy)


def test_bad_options_leave_nothing_behind(tmp_path):
    for changes in ({"kl_bound": -1}, {"iterations": 0}, {"colour": "red"}):
        with pytest.raises(ValueError, match="expected"):
            start(tmp_path / "run", **changes)
    assert list(tmp_path.iterdir()) == []


def test_an_environment_without_a_time_limit_leaves_nothing_behind(tmp_path):
    with pytest.raises(
        ValueError, match="max_steps: expected a number, because CliffWalking-v1 has no time limit, got None"
    ):
        bayespbrl.start("CliffWalking-v1", tmp_path / "run")
    assert list(tmp_path.iterdir()) == []
    assert bayespbrl.start("CliffWalking-v1", tmp_path / "run", max_steps=5).settings.rollouts.max_steps == 5


def test_without_a_directory_a_fresh_one_is_made_under_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    one, two = start(None), start(None)
    assert one.settings == two.settings
    names = sorted(path.name for path in (tmp_path / "runs").iterdir())
    assert len(names) == 2
    assert all(name.startswith("gridworld-2") for name in names)


def test_a_run_continued_from_disk_between_any_two_calls_is_the_one_never_stopped(tmp_path, straight):
    directory = tmp_path / "run"
    start(directory)
    asked = []
    while True:
        questions = runs.resume(directory).ask()
        if not questions:
            break
        assert runs.resume(directory).ask()[0].number == questions[0].number  # the same, asked again
        (query,) = questions
        asked.append(query.number)
        learner = runs.resume(directory)
        learner.ask()
        learner.tell([ReturnExpert()(*query.trajectories)])
    assert asked == [1, 2, 3, 4]
    assert fingerprint(bayespbrl.load(directory).learner) == straight


def test_a_run_in_progress_can_be_read_at_any_time(tmp_path):
    directory = tmp_path / "run"
    learner = start(directory)
    states = []

    def look(learner):
        before = contents(directory)
        run = bayespbrl.load(directory)
        assert contents(directory) == before
        states.append((run.preferences.answers, len(run.iterations), len(run.trajectories)))

    look(learner)
    learner.ask()
    look(learner)
    bayespbrl.load(directory).policy.act(3)  # the first policy, before the first iteration
    assert bayespbrl.load(directory).estimate is None
    learner.tell([ReturnExpert()(*learner.ask()[0].trajectories)])
    look(learner)
    learner.run(ReturnExpert(), progress=look)
    assert states == [(0, 0, 0), (0, 0, 10), (1, 0, 10), (2, 1, 10), (3, 2, 20), (4, 3, 30)]


def test_a_run_of_discrete_states_keeps_the_standardised_features_of_its_utility(tmp_path):
    options = {"answers": 3, "iterations": 2, "max_steps": 4, "evaluation_episodes": 2, "check_episodes": 2, "seed": 3}
    learner = bayespbrl.start("FrozenLake-v1", tmp_path / "run", **options).run(ReturnExpert())
    estimate = runs.load(tmp_path / "run").estimate
    assert np.ptp(estimate.features.lengths) > 1
    states = np.arange(16)
    np.testing.assert_array_equal(estimate.utilities(states), learner.estimate.utilities(states))
    states, visits = report_tables.utility_table(read_contents(tmp_path / "run")), np.zeros(16, int)
    for trajectory in learner.trajectories:
        np.add.at(visits, trajectory.states, 1)
    assert 0 < np.count_nonzero(visits) < 16
    np.testing.assert_array_equal(states["reached"], visits > 0)


def test_features_of_ours_that_cannot_be_stored_are_an_error_and_not_taken_for_the_users(tmp_path, monkeypatch):
    monkeypatch.setattr(drawn, "standardised", lambda trajectories, number: OneHot(number, [1.0] * number))
    with pytest.raises(ValueError, match="lengths"):
        bayespbrl.start("FrozenLake-v1", tmp_path / "run", answers=3, iterations=2, max_steps=4).run(ReturnExpert())


def test_a_finished_run_is_finished_when_resumed(copy):
    before = contents(copy)
    learner = runs.resume(copy)
    assert learner.finished
    assert learner.ask() == []
    assert contents(copy) == before


def test_of_two_learners_on_one_run_the_second_to_write_is_refused_and_nothing_is_lost(tmp_path, straight):
    first = start(tmp_path / "run")
    expert = ReturnExpert()
    first.tell([expert(*query.trajectories) for query in first.ask()])
    second = bayespbrl.resume(tmp_path / "run")
    queries = first.ask()
    second.tell([expert(*query.trajectories) for query in second.ask()])
    kept = contents(tmp_path / "run")
    with pytest.raises(ValueError, match="got events that another learner has written"):
        first.tell([expert(*query.trajectories) for query in queries])
    assert contents(tmp_path / "run") == kept
    assert fingerprint(second.run(expert)) == straight
    assert fingerprint(bayespbrl.load(tmp_path / "run").learner) == straight


@pytest.mark.slow
def test_undo_works_on_disk_across_iterations_and_the_same_answers_lead_to_the_same_run(copy, straight):
    for undone in (1, 2, 3, 4):
        learner = runs.resume(copy)
        for _ in range(undone):
            learner.undo()
        assert json.loads((copy / "summary.json").read_text())["finished"] is False
        assert runs.resume(copy).preferences.answers == 4 - undone
        assert fingerprint(learner.run(ReturnExpert())) == straight
        assert fingerprint(bayespbrl.load(copy).learner) == straight


def test_what_was_undone_does_not_hinder_reading_what_came_after(copy):
    # Two undone answers, and the run stopped where the second iteration's file holds trajectories alone again.
    learner = runs.resume(copy)
    for _ in range(3):
        learner.undo()
    learner.tell(["tie"])
    assert learner.state.iteration == 1
    again = bayespbrl.load(copy)
    assert fingerprint(again.learner) == fingerprint(learner)
    assert len(again.trajectories) == 20
    assert [e["event"] for e in events(copy)].count("undone") == 3  # the log forgets nothing


def test_a_last_line_that_was_cut_off_is_recovered(copy, straight):
    whole = (copy / "events.jsonl").read_bytes()
    last = len(whole.splitlines()[-1])
    for cut in (1, 30, 400, last + 100):  # the last: of two lines, which leaves the summary an iteration ahead
        (copy / "events.jsonl").write_bytes(whole[:-cut])
        before = contents(copy)
        assert bayespbrl.load(copy).preferences.answers <= 4
        assert contents(copy) == before
        learner = runs.resume(copy)
        assert (copy / "events.jsonl").read_bytes()[-1:] == b"\n"
        assert fingerprint(learner.run(ReturnExpert())) == straight
        assert (copy / "events.jsonl").read_bytes().count(b"\n") == whole.count(b"\n")


@pytest.mark.slow
def test_a_run_killed_between_any_two_writes_goes_on_as_if_it_had_not_been(tmp_path, monkeypatch, straight):
    """Copies the directory at each sync and around each renaming, and goes on from every copy that differs."""
    directory, copies, found = tmp_path / "run", [], []
    fsync, replace = os.fsync, Path.replace

    def snapshot():
        if directory.exists():
            found.append(contents(directory))
            if found[-1] not in found[:-1]:
                copies.append(Path(shutil.copytree(directory, tmp_path / f"copy {len(copies)}")))

    def syncing(descriptor):
        snapshot()
        fsync(descriptor)

    def replacing(path, target):
        snapshot()
        result = replace(path, target)
        snapshot()
        return result

    learner = start(directory)
    monkeypatch.setattr(os, "fsync", syncing)
    monkeypatch.setattr(Path, "replace", replacing)
    learner.run(ReturnExpert())
    monkeypatch.undo()
    assert len(found) > 40
    assert len(copies) > 20
    for path in copies:
        log = path / "events.jsonl"
        kept = log.read_text() if log.exists() else ""
        assert fingerprint(runs.resume(path).run(ReturnExpert())) == straight
        assert log.read_text().startswith(kept)
        summary = json.loads((path / "summary.json").read_text())
        assert (summary["finished"], len(summary["iterations"])) == (True, 3)
        left = {file.name for file in path.iterdir()} - FILES
        assert all(re.fullmatch(r"summary\.json\..*\.part", name) for name in left)
        shutil.rmtree(path)


@pytest.mark.parametrize("lines", [None, 0, 4])
def test_a_log_that_has_lost_iterations_is_refused_and_nothing_is_written_over(copy, lines):
    log = copy / "events.jsonl"
    if lines is None:
        log.unlink()
    else:
        log.write_bytes(b"".join(log.read_bytes().splitlines(keepends=True)[:lines]))
    before = contents(copy)
    for read in (runs.resume, bayespbrl.load):
        with pytest.raises(ValueError, match=r"expected the 3 completed iterations of summary.json, got 0"):
            read(copy)
    assert contents(copy) == before


def test_a_run_that_goes_on_while_it_is_read_has_lost_nothing(copy, monkeypatch):
    log, whole = copy / "events.jsonl", (copy / "events.jsonl").read_bytes()
    summary = (copy / "summary.json").read_text()
    log.write_bytes(whole.splitlines(keepends=True)[0])
    (copy / "summary.json").unlink()
    replay = bayespbrl.events.replay

    def meanwhile(*arguments):  # another process completes all iterations after the log was read
        state = replay(*arguments)
        (copy / "summary.json").write_text(summary)
        log.write_bytes(whole)
        return state

    monkeypatch.setattr(bayespbrl.events, "replay", meanwhile)
    assert bayespbrl.load(copy).iterations == []


def test_an_undoing_that_was_killed_before_its_summary_is_no_lost_iteration(copy):
    summary = (copy / "summary.json").read_bytes()
    learner = runs.resume(copy)
    for _ in range(3):
        learner.undo()
    (copy / "summary.json").write_bytes(summary)
    assert runs.resume(copy).state.iteration == 0
    assert json.loads((copy / "summary.json").read_text())["iterations"] == []


def test_a_summary_that_a_killed_process_left_old_is_brought_up_to_date(copy):
    old = json.loads((copy / "summary.json").read_text())
    old["iterations"].pop()
    (copy / "summary.json").write_text(json.dumps(old | {"finished": False}))
    runs.resume(copy)
    new = json.loads((copy / "summary.json").read_text())
    assert (new["finished"], len(new["iterations"])) == (True, 3)


@pytest.mark.parametrize(
    "fails", [*(pytest.param(kind, marks=pytest.mark.slow) for kind in ("fsync", "interrupt")), "summary"]
)
def test_an_event_that_could_not_be_kept_is_taken_back_and_can_be_tried_again(tmp_path, monkeypatch, straight, fails):
    directory = tmp_path / "run"
    learner = start(directory)
    (query,) = learner.ask()
    learner.tell([ReturnExpert()(*query.trajectories)])
    (query,) = learner.ask()
    answer = ReturnExpert()(*query.trajectories)
    before = (directory / "events.jsonl").read_bytes()
    error = KeyboardInterrupt if fails == "interrupt" else OSError

    def fail(*arguments):
        raise error("stopped")

    if fails == "summary":
        monkeypatch.setattr(run_directory, "write_file", fail)
    else:
        monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(error, match="stopped"):
        learner.tell([answer])
    monkeypatch.undo()
    kept = (directory / "events.jsonl").read_bytes()
    assert kept.startswith(before)
    assert kept.count(b"\n") == before.count(b"\n") + (fails == "summary")  # there the answer was kept
    assert fingerprint(runs.load(directory).learner) == fingerprint(learner)
    assert fingerprint(learner.run(ReturnExpert())) == straight
    assert fingerprint(bayespbrl.load(directory).learner) == straight


SETTINGS = {
    "missing": None,
    "empty": "",
    "no JSON": "{format: 3}",
    "foreign": '{"name": "package", "version": "1.0"}',
    "a list": "[1, 2]",
    "bad value": '{"format": 3, "env": "gridworld", "kl_bound": -1}',
    "no environment": '{"format": 3}',
    "not text": b"\xff\xfe\x00\x01",
}


@pytest.mark.parametrize("content", SETTINGS.values(), ids=SETTINGS)
def test_a_directory_without_the_settings_of_a_run_is_refused(copy, content):
    file = copy / "settings.json"
    if content is None:
        file.unlink()
    else:
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
    before = contents(copy)
    for read in (bayespbrl.load, runs.resume):
        with pytest.raises(ValueError, match=r"settings\.json") as refusal:
            read(copy)
        assert "\n" not in str(refusal.value)
    assert contents(copy) == before


def test_a_newer_format_is_refused_by_name(copy):
    settings = json.loads((copy / "settings.json").read_text())
    (copy / "settings.json").write_text(json.dumps(settings | {"format": 4}))
    with pytest.raises(ValueError, match=r"settings\.json: expected format 3, got 4 of a newer version"):
        bayespbrl.load(copy)
    (copy / "settings.json").write_text(json.dumps(settings | {"format": 2}))
    with pytest.raises(ValueError, match=r"settings\.json: expected format 3, got 2: read it with the version"):
        bayespbrl.load(copy)


def test_a_directory_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(ValueError, match="nowhere: expected a run directory"):
        bayespbrl.load(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="expected a run directory"):
        RunDirectory.open(tmp_path)


def netcdf_of_another(file):
    xr.Dataset({"temperature": ("time", np.arange(3.0))}).to_netcdf(file, engine="h5netcdf")


DAMAGE = {
    "missing": lambda file: file.unlink(),
    "empty": lambda file: file.write_bytes(b""),
    "cut in half": lambda file: file.write_bytes(file.read_bytes()[: file.stat().st_size // 2]),
    "cut at the end": lambda file: file.write_bytes(file.read_bytes()[:-200]),
    "text": lambda file: file.write_text("hello"),
    "of another program": netcdf_of_another,
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_or_foreign_file_of_an_iteration_is_named(copy, damage):
    damage(copy / "iterations" / "0002.nc")
    before = contents(copy)
    for read in (bayespbrl.load, runs.resume):
        with pytest.raises(
            ValueError, match=r"copy: 0002\.nc: expected the netCDF file of an iteration, got "
        ) as refusal:
            read(copy)
        assert "\n" not in str(refusal.value)
    assert contents(copy) == before


@pytest.mark.parametrize(
    "line",
    ["hello", "[1]", "{}", '{"event": "collected"}', '{"event": "answered", "query": 1}', '{"event": "burnt"}', "3"],
)
def test_a_foreign_line_in_the_log_is_refused(copy, line):
    log = copy / "events.jsonl"
    lines = log.read_text().splitlines()
    lines[2] = line
    log.write_text("\n".join(lines) + "\n")
    before = contents(copy)
    for read in (bayespbrl.load, runs.resume):
        with pytest.raises(ValueError, match=r"copy: (events\.jsonl, line 3: expected an event|.*expected)"):
            read(copy)
    assert contents(copy) == before


@pytest.mark.parametrize("cut_off", [False, True])
def test_a_run_to_which_another_learner_writes_while_it_is_read_is_not_resumed(tmp_path, cut_off):
    learner = start(tmp_path / "run")
    learner.ask()
    log = learner.log.log_file
    if cut_off:
        with log.open("ab") as file:
            file.write(b'{"event": "answ')
    late = RunDirectory.open(tmp_path / "run")
    assert [entry.event["event"] for entry in late.entries()] == ["collected", "asked"]
    runs.resume(tmp_path / "run").tell(["first"])
    with log.open("ab") as file:
        file.write(b'{"event": "impr')  # that one is writing on
    before = contents(tmp_path / "run")
    with pytest.raises(ValueError, match="run: expected the run as this learner left it, got events that another"):
        late.take_over()
    assert contents(tmp_path / "run") == before


def test_runs_that_begin_in_one_second_have_directories_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings = start(tmp_path / "run").settings
    made = [RunDirectory.create_fresh(settings, {}).path for _ in range(4)]
    assert len(set(made)) == 4
    taken, create = [], RunDirectory.create.__func__

    def overtaken(cls, *arguments):  # by another process, after the name was chosen
        if not taken:
            taken.append(create(cls, *arguments))
        return create(cls, *arguments)

    monkeypatch.setattr(RunDirectory, "create", classmethod(overtaken))
    other = RunDirectory.create_fresh(settings, {}).path
    assert other != taken[0].path
    assert (other.parent, other.exists(), taken[0].path.exists()) == (tmp_path / "runs", True, True)


def test_each_line_of_a_log_is_an_event_or_says_what_stands_there_instead(tmp_path):
    log = tmp_path / "events.jsonl"
    assert read_log_lines(log) == []
    log.write_bytes(b'{"event": "asked"}\n\xff\xfe\n{"event": "improved"}\n{"event": "undone"}\n{"event": "un')
    first, undecodable, without_iteration, last, cut_off = read_log_lines(log)
    assert (first, last) == ({"event": "asked"}, {"event": "undone"})
    assert "events.jsonl, line 2: expected an event, got" in str(undecodable)
    assert 'line 3: expected an event, got \'{"event": "improved"}\'' in str(without_iteration)
    assert isinstance(cut_off, PartialLine)
    assert not isinstance(undecodable, PartialLine)


def rows(states):
    return np.eye(25)[states][:, ::2]


@pytest.mark.parametrize("utility", ["linear-program", pytest.param("known-reward", marks=pytest.mark.slow)])
@pytest.mark.parametrize("answers", [0, 1, 2, 4])
def test_a_run_with_features_of_the_users_own_wants_them_again(tmp_path, answers, utility):
    changes = {"features": rows, "utility": utility}
    directory = tmp_path / "run"
    learner = start(directory, **changes)
    for _ in range(answers):
        learner.tell([ReturnExpert()(*learner.ask()[0].trajectories)])
    for read in (bayespbrl.load, runs.resume):
        with pytest.raises(
            ValueError, match=r"run: expected features= again, which the run was started with, got None"
        ):
            read(directory)
    run = runs.resume(directory, features=rows).run(ReturnExpert())
    whole = Learner("gridworld", **(QUICK | changes)).run(ReturnExpert())
    if utility == "linear-program":
        assert fingerprint(run) == fingerprint(whole)
    np.testing.assert_array_equal(run.policy.table, whole.policy.table)


@pytest.mark.parametrize("kind", [np.ndarray.tolist, lambda values: jnp.asarray(values, dtype=jnp.float32)])
def test_features_that_are_lists_or_of_single_precision_give_the_same_utilities_after_loading(tmp_path, kind):
    def features(states):
        return kind(np.sin(np.outer(np.arange(25), [0.3, 0.7, 1.1]))[states])

    learner = start(tmp_path / "run", features=features)
    for _ in range(2):
        learner.tell([ReturnExpert()(*learner.ask()[0].trajectories)])
    loaded = bayespbrl.load(tmp_path / "run", features=features)
    states, trajectories = np.arange(25), learner.trajectories
    assert learner.estimate.utilities(states).any()
    np.testing.assert_array_equal(loaded.estimate.utilities(states), learner.estimate.utilities(states))
    np.testing.assert_array_equal(
        loaded.estimate.trajectory_utilities(trajectories), learner.estimate.trajectory_utilities(trajectories)
    )


@dataclasses.dataclass(frozen=True)
class Corner:
    """Features of a user's own that could be stored as the package's are."""

    size: int

    def __call__(self, states):
        return np.column_stack([states // self.size, states % self.size]).astype(float)


@pytest.mark.parametrize("features", [Corner(5), OneHot(25)], ids=["own", "ours"])
def test_features_that_are_a_dataclass_are_the_users_own_and_passed_again(tmp_path, features):
    learner = start(tmp_path / "run", features=features)
    for _ in range(2):
        learner.tell([ReturnExpert()(*learner.ask()[0].trajectories)])
    with pytest.raises(ValueError, match="features"):
        bayespbrl.load(tmp_path / "run")
    loaded = bayespbrl.load(tmp_path / "run", features=features)
    np.testing.assert_array_equal(loaded.estimate.utilities(np.arange(25)), learner.estimate.utilities(np.arange(25)))
    assert runs.resume(tmp_path / "run", features=features).run(ReturnExpert()).finished


def test_features_for_a_run_that_has_none_are_refused(finished):
    with pytest.raises(ValueError, match=r"expected no features=, got <function"):
        bayespbrl.load(finished, features=rows)


def test_a_run_with_a_policy_of_the_users_own_wants_one_again(tmp_path):
    policy = TabularPolicy(np.random.default_rng(0).dirichlet(np.ones(5), 25))
    directory = tmp_path / "run"
    learner = start(directory, policy=policy)
    learner.tell([ReturnExpert()(*learner.ask()[0].trajectories)])
    with pytest.raises(ValueError, match=r"run: expected policy= again, which the run was started with, got None"):
        bayespbrl.load(directory)
    run = runs.resume(directory, policy=policy).run(ReturnExpert())
    assert fingerprint(run) == fingerprint(Learner("gridworld", policy=policy, **QUICK).run(ReturnExpert()))
    assert fingerprint(bayespbrl.load(directory, policy=policy).learner) == fingerprint(run)


class Corridor(gymnasium.Env):
    """Discrete positions; ends at either end, so that trajectories differ in length."""

    observation_space = gymnasium.spaces.Discrete(7)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position = 3
        return self.position, {}

    def step(self, action):
        self.position += 1 if action == (self.np_random.random() < 0.8) else -1
        return self.position, float(self.position), self.position in (0, 6), False, {}


@pytest.mark.parametrize("env", ["swing-up", Corridor()], ids=["box", "fewer states"])
@pytest.mark.parametrize("read", [bayespbrl.load, runs.resume])
def test_another_environment_than_the_runs_is_refused(copy, read, env):
    before = contents(copy)
    with pytest.raises(ValueError, match="copy: expected no env=, or gridworld, which the run was started with, got"):
        read(copy, env=env)
    assert contents(copy) == before


IN_THE_CORRIDOR = {
    "preset": "paper",
    "utility": "linear-program",
    "iterations": 2,
    "max_steps": 12,
    "evaluation_episodes": 2,
}


class Longer(Corridor):
    """More states than the corridor's, which are among them."""

    observation_space = gymnasium.spaces.Discrete(9)


def forget_spaces(directory):
    """Make a run directory as older versions wrote it."""
    file = directory / "settings.json"
    file.write_text(
        json.dumps({name: value for name, value in json.loads(file.read_text()).items() if name != "spaces"})
    )


def test_an_environment_with_more_states_than_the_policy_has_is_refused(tmp_path):
    bayespbrl.start(Corridor(), tmp_path / "run", **IN_THE_CORRIDOR).run(ReturnExpert())
    with pytest.raises(ValueError, match=r"run: env: expected the run's observation_space, Discrete\(7\), got "):
        runs.resume(tmp_path / "run", env=Longer())
    forget_spaces(tmp_path / "run")
    before = contents(tmp_path / "run")
    with pytest.raises(ValueError, match=r"run: policy: expected one from Discrete\(9\) to "):
        runs.resume(tmp_path / "run", env=Longer())
    assert contents(tmp_path / "run") == before


class Counted(Corridor):
    """The corridor, whose positions and actions count from elsewhere."""

    observation_space = gymnasium.spaces.Discrete(7, start=1)


def test_an_environment_with_other_spaces_is_refused_and_a_run_that_does_not_know_its_spaces_is_not(tmp_path):
    bayespbrl.start(Corridor(), tmp_path / "run", **IN_THE_CORRIDOR)
    before = contents(tmp_path / "run")
    message = r"run: env: expected the run's observation_space, Discrete\(7\), got Discrete\(7, start=1\)"
    for read in (bayespbrl.load, runs.resume):
        with pytest.raises(ValueError, match=message):
            read(tmp_path / "run", env=Counted())
    assert contents(tmp_path / "run") == before
    forget_spaces(tmp_path / "run")
    bayespbrl.load(tmp_path / "run", env=Counted())


def test_an_environment_made_with_other_keywords_is_refused(tmp_path):
    def made(**keywords):
        return gymnasium.make("Pendulum-v1", **keywords)

    bayespbrl.start(made(g=3), tmp_path / "run", **QUICK)
    bayespbrl.load(tmp_path / "run", env=made(g=3.0, render_mode="rgb_array"))
    before = contents(tmp_path / "run")
    for env, got in ((made(g=4), "g=4.0"), (made(), "none")):
        for read in (bayespbrl.load, runs.resume):
            with pytest.raises(ValueError, match=f"run: env: expected the run's keywords, g=3.0, got {got}"):
                read(tmp_path / "run", env=env)
    assert contents(tmp_path / "run") == before
    runs.resume(tmp_path / "run", env=made(g=np.float64(3.0)))


class Parts(Corridor):
    """The corridor, observed as one of two parts; actions count from elsewhere."""

    observation_space = gymnasium.spaces.Dict(at=gymnasium.spaces.Discrete(7), seen=gymnasium.spaces.Box(0, 1, (1,)))
    action_space = gymnasium.spaces.Discrete(2, start=1)


def test_a_learner_whose_spaces_are_flattened_can_be_pickled():
    learner = pickle.loads(pickle.dumps(bayespbrl.Learner(Parts(), **QUICK | {"max_steps": 5})))
    assert learner.environment.observation_space.shape == (8,)
    assert learner.environment.action_space == gymnasium.spaces.Discrete(2)
    assert learner.environment.action(np.int64(0)) == 1


def test_spaces_in_words_differ_where_their_bounds_do():
    box, other = gymnasium.spaces.Box(-1.0, 1.0, (2,)), gymnasium.spaces.Box(np.float32([-1, -2]), np.float32([1, 1]))
    assert in_words(box) == "Box(-1.0, 1.0, (2,))"
    assert in_words(other) == "Box([-1.0, -2.0], 1.0, (2,))"
    both = gymnasium.spaces.Dict(a=box, b=gymnasium.spaces.Tuple([gymnasium.spaces.Discrete(3), other]))
    assert in_words(both) == "Dict(a: Box(-1.0, 1.0, (2,)), b: Tuple(Discrete(3), Box([-1.0, -2.0], 1.0, (2,))))"


def test_features_of_another_number_are_refused(tmp_path):
    learner = start(tmp_path / "run", features=rows)
    learner.tell([ReturnExpert()(*learner.ask()[0].trajectories)])
    learner.tell([ReturnExpert()(*learner.ask()[0].trajectories)])
    assert learner.estimate is not None
    with pytest.raises(ValueError, match=r"run: features: expected \d+ for each state, as before, got"):
        bayespbrl.load(tmp_path / "run", features=lambda states: rows(states)[:, :-1])


def test_other_features_of_the_same_number_are_refused(tmp_path):
    learner = start(tmp_path / "run", features=rows, utility="posterior-mean")
    learner.tell([ReturnExpert()(*learner.ask()[0].trajectories)])
    bayespbrl.load(tmp_path / "run", features=rows)  # before the first estimate
    learner.tell([ReturnExpert()(*learner.ask()[0].trajectories)])
    for again in (bayespbrl.load, bayespbrl.resume):
        again(tmp_path / "run", features=rows)
    for features in (lambda states: rows(states)[:, ::-1], lambda states: 2 * rows(states)):
        with pytest.raises(ValueError, match=r"run: features: expected the features of the run, got others: .* off by"):
            bayespbrl.load(tmp_path / "run", features=features)


@pytest.mark.parametrize("path", [None, 3])
def test_what_is_no_path_is_refused(path):
    for use in (bayespbrl.load, runs.resume, read_answers):
        with pytest.raises(ValueError, match=f"expected a path, got {path}"):
            use(path)
    with pytest.raises(ValueError, match="directory: expected a path, got 3"):
        start(3)


@pytest.mark.slow
def test_trajectories_of_different_lengths_and_an_environment_of_the_users_own_come_back(tmp_path):
    directory = tmp_path / "run"
    learner = bayespbrl.start(Corridor(), directory, **IN_THE_CORRIDOR).run(ReturnExpert())
    assert len({len(trajectory) for trajectory in learner.trajectories}) > 1
    assert any(trajectory.terminated for trajectory in learner.trajectories)
    with pytest.raises(ValueError, match="run: expected env= again, which the run was started with, got None"):
        bayespbrl.load(directory)
    with pytest.raises(ValueError, match=r"run: env: expected the run's observation_space, .*, got Box"):
        bayespbrl.load(directory, env=Slope())
    forget_spaces(directory)
    with pytest.raises(ValueError, match=r"run: states of the run: expected entries of Box\(.*, got int64 of"):
        bayespbrl.load(directory, env=Slope())
    run = bayespbrl.load(directory, env=Corridor())
    assert fingerprint(run.learner) == fingerprint(learner)
    assert run.policy.act(3) in (0, 1)
    stopped = bayespbrl.start(Corridor(), tmp_path / "stopped", **IN_THE_CORRIDOR)
    stopped.tell([ReturnExpert()(*stopped.ask()[0].trajectories)])
    resumed = runs.resume(tmp_path / "stopped", env=Corridor()).run(ReturnExpert())
    assert fingerprint(resumed) == fingerprint(learner)


@pytest.mark.parametrize("how", ["arguments", "wrapper", "limit"])
def test_an_environment_that_its_name_would_not_give_again_has_to_be_passed(tmp_path, how):
    def made():
        environment = gymnasium.make(
            "Pendulum-v1", **{"arguments": {"g": 2.0}, "limit": {"max_episode_steps": 9}}.get(how, {})
        )
        return gymnasium.wrappers.ClipReward(environment, -1.0, 0.0) if how == "wrapper" else environment

    bayespbrl.start(made(), tmp_path / "run", utility="linear-program", max_steps=5).ask()
    for read in (bayespbrl.load, runs.resume):
        with pytest.raises(ValueError, match="expected env= again, which the run was started with, got None"):
            read(tmp_path / "run")
    assert bayespbrl.load(tmp_path / "run", env=made()).settings.environment == "other"
    assert "expected your own environment Pendulum-v1 as env= of bayespbrl.load, got none" in write_report(
        tmp_path / "run", format="md"
    ).read_text(encoding="utf-8")


def test_a_run_goes_on_in_no_other_environment_than_its_own(tmp_path):
    bayespbrl.start("Pendulum-v1", tmp_path / "run", utility="linear-program", max_steps=5).ask()
    for other in ("CartPole-v1", gymnasium.make("Pendulum-v1", g=30.0), Corridor()):
        with pytest.raises(ValueError, match="expected no env=, or Pendulum-v1, which the run was started with, got"):
            runs.resume(tmp_path / "run", env=other)
    for same in ("Pendulum-v1", gymnasium.make("Pendulum-v1"), bayespbrl.load(tmp_path / "run").learner.environment):
        assert bayespbrl.load(tmp_path / "run", env=same).settings.env == "Pendulum-v1"


def test_an_object_keeps_the_time_limit_that_it_was_started_with(tmp_path):
    def carts(limit):
        return gymnasium.make("CartPole-v1", max_episode_steps=limit)

    options = QUICK | {"utility": "linear-program", "iterations": 3}
    whole = bayespbrl.Learner(carts(8), **options).run(ReturnExpert())
    assert max(map(len, whole.trajectories)) == 8
    learner = bayespbrl.start(carts(8), tmp_path / "run", **options)
    learner.tell([ReturnExpert()(*learner.ask()[0].trajectories)])
    assert fingerprint(runs.resume(tmp_path / "run", env=carts(500)).run(ReturnExpert())) == fingerprint(whole)
    for read in (bayespbrl.load, runs.resume):
        with pytest.raises(ValueError, match="run: env: expected a time limit of 8 steps or more, got 7"):
            read(tmp_path / "run", env=carts(7))


def test_all_that_only_python_can_give_is_asked_for_at_once(tmp_path):
    bayespbrl.start(Corridor(), tmp_path / "run", features=rows, utility="linear-program", max_steps=5)
    with pytest.raises(ValueError, match=r"expected env=, features= again, .* got None \(only Python can give it\)"):
        bayespbrl.resume(tmp_path / "run")


def test_arguments_that_are_arrays_are_compared():
    kwargs = {"goal": np.array([1.0, 2.0]), "render_mode": None}
    gymnasium.register("Goal-v0", entry_point=lambda goal, render_mode: Corridor(), kwargs=kwargs, max_episode_steps=5)
    try:
        assert given_by_name(gymnasium.make("Goal-v0"))
        assert not given_by_name(gymnasium.make("Goal-v0", goal=np.array([1.0, 3.0])))
        assert not given_by_name(gymnasium.make("Goal-v0", goal=np.ones(3)))
    finally:
        del gymnasium.registry["Goal-v0"]


def test_a_run_of_an_object_of_a_registered_environment_goes_on_bit_for_bit(tmp_path):
    options = QUICK | {"utility": "linear-program", "max_steps": 12, "iterations": 3}
    whole = bayespbrl.Learner(gymnasium.make("Pendulum-v1"), **options).run(ReturnExpert())
    learner = bayespbrl.start(gymnasium.make("Pendulum-v1"), tmp_path / "run", **options)
    learner.tell([ReturnExpert()(*query.trajectories) for query in learner.ask()])
    assert learner.settings.environment == "object"
    resumed = runs.resume(tmp_path / "run").run(ReturnExpert())
    assert fingerprint(resumed) == fingerprint(whole)


def test_an_object_that_was_changed_since_it_was_made_is_asked_for_again(tmp_path):
    env = gymnasium.make("Pendulum-v1")
    env.unwrapped.g = 0.0
    learner = bayespbrl.start(env, tmp_path / "run", **QUICK | {"max_steps": 5})
    assert learner.settings.environment == "other"
    with pytest.raises(ValueError, match="expected env= again"):
        bayespbrl.load(tmp_path / "run")
    assert bayespbrl.load(tmp_path / "run", env=env).learner.environment.unwrapped.g == 0
    used = gymnasium.make("Pendulum-v1")
    used.reset(seed=5)
    used.step(np.ones(1))
    assert bayespbrl.Learner(used, **QUICK | {"max_steps": 5}).settings.environment == "object"


class Walk(gymnasium.Env):
    """A walk whose pace, goal and noise are where an attribute that is a number does not tell."""

    observation_space, action_space = gymnasium.spaces.Box(-99, 99, (1,)), gymnasium.spaces.Discrete(2)
    made = 0

    def __init__(self, seeded=True, single=False):
        self.model, self.goal, self.seeded = SimpleNamespace(pace=1.0), {"at": [7, (3, 4)]}, seeded
        self.episodes, self.starts = 0, []  # over its lifetime
        type(self).made += 1
        if single and type(self).made > 1:
            raise RuntimeError("port 5005 is in use")

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed if self.seeded else None)
        self.position = self.np_random.normal(size=1).astype(np.float32)
        self.episodes += 1
        self.starts.append(self.position.copy())
        return self.position.copy(), {}

    def step(self, action):
        self.position += self.model.pace * (2 * action - 1)
        return self.position.copy(), 0.0, False, False, {}


@pytest.fixture
def walks():
    """Registers walks, and makes an object of one."""
    names = []

    def made(**arguments):
        names.append(f"Walk{len(names)}-v0")
        gymnasium.register(names[-1], entry_point=Walk, kwargs=arguments, max_episode_steps=5)
        Walk.made = 0
        return gymnasium.make(names[-1])

    yield made
    for name in names:
        del gymnasium.registry[name]


def test_an_object_whose_inner_parts_were_changed_is_asked_for_again(walks):
    def how(env):
        return Learner(env, **QUICK | {"utility": "linear-program"}).settings.environment

    assert how(walks()) == "object"
    faster, elsewhere = walks(), walks()
    faster.unwrapped.model.pace = 2.0
    elsewhere.unwrapped.goal["at"][1] = (3, 5)
    assert how(faster) == how(elsewhere) == "other"
    assert how(walks(seeded=False)) == "other"  # its position after a reset tells
    assert how(walks(single=True)) == "other"  # there is only one


def test_an_environment_of_which_there_is_only_one_is_named(walks):
    name, Walk.made = walks(single=True).spec.id, 0
    with pytest.raises(ValueError, match=rf"{name} failed at making copies of it, .* port 5005 is in use"):
        Learner(name, **QUICK | {"utility": "linear-program"}).ask()


def test_a_run_goes_on_as_it_is_stepped_by_name_or_as_an_object(tmp_path):
    options = QUICK | {"utility": "linear-program", "max_steps": 5}
    bayespbrl.start("Pendulum-v1", tmp_path / "named", **options).ask()
    bayespbrl.start(gymnasium.make("Pendulum-v1"), tmp_path / "object", **options).ask()
    opened = bayespbrl.load(tmp_path / "named").learner.environment
    assert Learner(opened, **options).settings.environment == "named"
    for directory, env, asked in (
        ("named", gymnasium.make("Pendulum-v1"), "Pendulum-v1 by its name"),
        ("object", "Pendulum-v1", "an object of Pendulum-v1 as made"),
    ):
        with pytest.raises(ValueError, match=f"{directory}: expected no env=, or {asked}, got .* go on otherwise"):
            runs.resume(tmp_path / directory, env=env)
        assert bayespbrl.load(tmp_path / directory, env=env).settings.environment == directory
    for directory, env in (("named", "Pendulum-v1"), ("named", opened), ("object", gymnasium.make("Pendulum-v1"))):
        assert runs.resume(tmp_path / directory, env=env).settings.environment == directory
    start(tmp_path / "compiled").ask()
    assert runs.resume(tmp_path / "compiled", env=gymnasium.make("bayespbrl/Gridworld-v0")).state.queries == 1


@pytest.mark.parametrize("dtype", [np.float16, complex])
def test_a_policy_of_numbers_that_no_file_holds_is_refused_at_the_start(tmp_path, dtype):
    @jax.tree_util.register_dataclass
    @dataclasses.dataclass(frozen=True, eq=False)
    class Noted(TabularPolicy):
        note: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(2, dtype))

    policy = Noted(np.full((25, 5), 0.2), 0.01)
    with pytest.raises(ValueError, match=r"expected real numbers of 32 or 64 bits in Noted.note, got "):
        start(tmp_path / "run", policy=policy)
    assert not (tmp_path / "run").exists()


def test_a_run_of_an_object_that_nobody_registers_any_more_is_one_line(tmp_path):
    gymnasium.register("Gone-v0", entry_point=Corridor, max_episode_steps=5)
    try:
        bayespbrl.start(gymnasium.make("Gone-v0"), tmp_path / "run", **QUICK)
    finally:
        del gymnasium.registry["Gone-v0"]
    with pytest.raises(ValueError, match=r"expected gridworld, .* or a registered gymnasium id, got 'Gone-v0'"):
        bayespbrl.load(tmp_path / "run")


def test_an_object_keeps_its_own_time_limit():
    assert step_limit(gymnasium.make("Pendulum-v1"), 500) == 200
    assert step_limit("Pendulum-v1", 500) == 500
    assert step_limit(gymnasium.make("Pendulum-v1"), 50) == 50


def test_options_of_numpy_are_kept_as_numbers(tmp_path):
    options = QUICK | {"seed": np.int64(3), "kl_bound": np.float32(0.5), "answers": np.int64(4)}
    learner = bayespbrl.start("gridworld", tmp_path / "run", **options)
    assert learner.settings == bayespbrl.load(tmp_path / "run").settings
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@dataclasses.dataclass(frozen=True)
class Net:
    weights: np.ndarray


@dataclasses.dataclass(frozen=True)
class Nested(LinearGaussianPolicy):
    net: Net = dataclasses.field(default_factory=lambda: Net(np.zeros(2)))


def test_a_policy_of_parts_is_known_by_all_their_classes():
    first = bayespbrl.Learner("Pendulum-v1", policy="linear-gaussian", **QUICK).state.first_policy
    fields = {field.name: getattr(first, field.name) for field in dataclasses.fields(LinearGaussianPolicy)}
    policy = Nested(**fields)
    assert classes_of(policy) == (Nested, Net)
    back = from_tree(to_tree(policy), known=classes_of(policy))
    np.testing.assert_array_equal(back.net.weights, policy.net.weights)
    with pytest.raises(ValueError, match="expected tuples of numbers and texts in Net"):
        to_tree(Net((np.zeros(2),)))


def test_a_log_that_leads_elsewhere_is_refused_and_left_alone(tmp_path):
    bayespbrl.start("gridworld", tmp_path / "run", **QUICK)
    (tmp_path / "secret").write_text("no line")
    (tmp_path / "run" / "events.jsonl").symlink_to(tmp_path / "secret")
    with pytest.raises(ValueError, match="expected a file of the run's own, got a link"):
        runs.resume(tmp_path / "run")
    assert (tmp_path / "secret").read_text() == "no line"


def test_iterations_that_lead_elsewhere_are_refused_and_left_alone(tmp_path):
    """Those of another run would be overwritten."""
    other = bayespbrl.start("gridworld", tmp_path / "other", **QUICK)
    other.ask()
    before = other.log.iteration_file(1).read_bytes()
    bayespbrl.start("gridworld", tmp_path / "run", **QUICK | {"seed": 8})
    (tmp_path / "run" / "iterations").rmdir()
    (tmp_path / "run" / "iterations").symlink_to(tmp_path / "other" / "iterations")
    with pytest.raises(ValueError, match="iterations: expected a folder of the run's own, got a link"):
        runs.resume(tmp_path / "run")
    assert other.log.iteration_file(1).read_bytes() == before


@pytest.mark.parametrize("name", ["settings.json", "summary.json", "iterations/0001.nc"])
def test_a_pipe_in_a_run_is_not_waited_for(name, tmp_path):
    learner = bayespbrl.start("gridworld", tmp_path / "run", **QUICK)
    while not learner.state.iteration:
        learner.tell(["first"] * len(learner.ask()))
    (tmp_path / "run" / name).unlink()
    os.mkfifo(tmp_path / "run" / name)
    if name == "summary.json":  # follows from the log
        assert bayespbrl.load(tmp_path / "run").learner.state.iteration == 1
        with pytest.raises(ValueError, match="got something that is no file"):
            run_directory.read_summary(tmp_path / "run")
    else:
        with pytest.raises(ValueError, match="got something that is no file"):
            bayespbrl.load(tmp_path / "run")


def test_a_path_that_could_not_be_read_back_is_refused_before_anything_is_asked(tmp_path):
    path = tmp_path / os.fsdecode(b"a\xff")
    with pytest.raises(ValueError, match="expected a path in UTF-8"):
        bayespbrl.start("gridworld", path, **QUICK)
    assert not path.exists()


def test_what_another_learner_writes_while_heavy_parts_are_written_is_noticed(tmp_path, monkeypatch):
    learner = bayespbrl.start("gridworld", tmp_path / "run", **QUICK)
    written = run_directory.write_iteration

    def slowly(*arguments):
        written(*arguments)
        with learner.log.log_file.open("a") as log:
            log.write('{"event": "asked"}\n')

    monkeypatch.setattr(run_directory, "write_iteration", slowly)
    with pytest.raises(ValueError, match="events that another learner has written"):
        learner.ask()
    assert learner.log.log_file.read_text() == '{"event": "asked"}\n'


def test_a_run_directory_is_found_from_another_directory_and_missed_when_gone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    learner = bayespbrl.start("gridworld", "run", **QUICK | {"utility": "linear-program"})
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    learner.ask()
    shutil.rmtree(tmp_path / "run")
    with pytest.raises(ValueError, match="expected the run directory, which is gone"):
        learner.tell(["first"] * len(learner.ask()))


def test_an_environment_as_its_name_makes_it_need_not_be_passed_again(tmp_path):
    environment = gymnasium.make("bayespbrl/Gridworld-v0", render_mode="rgb_array")
    learner = bayespbrl.start(environment, tmp_path / "run", **QUICK)
    assert learner.settings.critic.discount == 0.995  # the preset's
    learner.run(ReturnExpert())
    assert fingerprint(bayespbrl.load(tmp_path / "run").learner) == fingerprint(learner)


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["linear-gaussian", "gaussian-process"])
def test_a_run_with_continuous_actions_comes_back_and_goes_on_bit_for_bit(tmp_path, policy):
    options = {
        "preset": "paper",
        "utility": "linear-program",
        "iterations": 2,
        "evaluation_episodes": 2,
        "centres": 20,
        "max_steps": 15,
    }
    whole = bayespbrl.start("swing-up", tmp_path / "whole", policy=policy, **options).run(ReturnExpert())
    stopped = bayespbrl.start("swing-up", tmp_path / "stopped", policy=policy, **options)
    for _ in range(2):
        stopped.tell([ReturnExpert()(*stopped.ask()[0].trajectories)])
    resumed = runs.resume(tmp_path / "stopped").run(ReturnExpert())
    assert fingerprint(resumed) == fingerprint(whole) == fingerprint(bayespbrl.load(tmp_path / "whole").learner)
    run = bayespbrl.load(tmp_path / "whole")
    space = run.learner.environment.action_space
    for observation in run.trajectories[0].states[:5]:
        action = run.policy.act(observation)
        assert space.contains(action)
    key = jax.random.key(0)
    np.testing.assert_array_equal(run.policy.act(observation, key=key), run.policy.act(observation, key=key))


@pytest.mark.slow
@pytest.mark.parametrize("utility", ["posterior-mean", "most-likely"])
def test_a_posterior_comes_back_and_the_run_goes_on_bit_for_bit(tmp_path, utility):
    changes = {"utility": utility}
    whole = start(tmp_path / "whole", **changes).run(ReturnExpert())
    directory = tmp_path / "stopped"
    for _ in range(4):
        learner = runs.resume(directory) if directory.exists() else start(directory, **changes)
        learner.tell([ReturnExpert()(*learner.ask()[0].trajectories)])
    assert fingerprint(runs.resume(directory)) == fingerprint(whole)
    run = bayespbrl.load(tmp_path / "whole")
    assert {"posterior", "log_likelihood", "observed_data", "constant_data"} <= set(run.posterior.children)
    given, back = whole.estimate.posterior, run.posterior
    for name in ("margins", "coordinates", "utility_weights"):
        np.testing.assert_array_equal(back["posterior"][name].values, given["posterior"][name].values)
    np.testing.assert_equal(dict(back.attrs), dict(given.attrs))  # NaN equals NaN
    for name in ("setting", "steepness", "lapse_rate"):
        np.testing.assert_array_equal(back["posterior"][name].values, given["posterior"][name].values)
    for one, other in zip(*(e.utilities_and_draws(np.arange(25)) for e in (run.estimate, whole.estimate)), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_a_run_whose_answers_are_all_ties_comes_back_with_its_posterior(tmp_path):
    learner = start(tmp_path / "run", utility="posterior-mean", iterations=1).run(lambda first, second: "tie")
    run = bayespbrl.load(tmp_path / "run")
    assert fingerprint(run.learner) == fingerprint(learner)
    assert (run.estimate.quality.pairs, len(run.preferences.ties)) == (0, 2)
    drawn = run.posterior["posterior"]
    assert drawn.sizes["preference"] == 2
    # ties say that the utilities are near each other, and not which is higher
    draws = drawn["margins"].values
    assert (np.abs(draws.mean(axis=(0, 1))) < 0.2 * draws.std(axis=(0, 1))).all()
    assert float(drawn["tie_threshold"].min()) > 0


def victim(directory, settings, say):
    """A process of its own that starts or continues a run, and says at each step what it does."""
    try:
        learner = runs.resume(directory)
    except ValueError:
        learner = runs.start("gridworld", directory, **settings)
    say.send("ready")

    def expert(first, second):
        say.send("asked")
        return ReturnExpert()(first, second)

    learner.run(expert)
    say.send("done")


def said(pipe):
    """All that a process said until it ended."""
    while True:
        try:
            yield pipe.recv()
        except EOFError:
            return


@pytest.mark.slow
def test_a_process_killed_at_any_moment_loses_no_answer(tmp_path):
    settings = QUICK | {"iterations": 12}
    directory, random = tmp_path / "run", np.random.default_rng()
    asked, kills, done = 0, 0, False
    forked = multiprocessing.get_context("forkserver")  # each from one process that has imported everything
    forked.set_forkserver_preload(["bayespbrl.runs.run"])
    while not done:
        pipe, say = forked.Pipe(duplex=False)
        process = forked.Process(target=victim, args=(directory, settings, say))
        process.start()
        say.close()
        assert pipe.recv() == "ready"
        if kills < 5:
            time.sleep(random.uniform(0.0, 2.5))
            process.kill()
            kills += 1
        lines = list(said(pipe))
        process.join()
        assert process.exitcode in (0, -9)
        asked += lines.count("asked")
        done = "done" in lines
        kept = (directory / "events.jsonl").read_text() if (directory / "events.jsonl").exists() else ""
        kept = kept[: kept.rfind("\n") + 1]
        assert kept.count('"answered"') >= asked - kills  # at most the answer on its way when the process was killed
        if not done:
            runs.load(directory)
    assert kept.count('"answered"') == 13
    assert 13 <= asked <= 13 + kills
    whole = Learner("gridworld", **settings).run(ReturnExpert())
    assert fingerprint(bayespbrl.load(directory).learner) == fingerprint(whole)
