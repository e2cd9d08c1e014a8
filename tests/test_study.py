"""Declared studies: what is declared, run, resumed, refused; trials that die; a cluster of real workers."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import BrokenExecutor, Future
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from distributed.client import ClosedClientError
from test_cli import call, refused
from test_trials import ThisProcess, without_processes

import bayespbrl
from bayespbrl.results.study_data import read_study
from bayespbrl.runs import run as runs
from bayespbrl.runs.lock import ContinuedElsewhere, continuing
from bayespbrl.studies import Study, declared, rows
from bayespbrl.studies import engine as engine_module
from bayespbrl.studies.cluster import scheduler_executor
from bayespbrl.studies.declaration import parsed, shipped
from bayespbrl.studies.engine import Engine, Progress
from bayespbrl.studies.machine import source_digest
from bayespbrl.studies.processes import trial_processes
from bayespbrl.studies.rows import Seeds, row_of, run_trial
from bayespbrl.studies.tables import measure_first_policy

TINY = {"preset": "paper", "utility": "linear-program", "iterations": 2, "max_steps": 10, "evaluation_episodes": 2}
DECLARATION = """
title = "Two tiny rows"
trials = 2
seed = 2980
[options]
preset = "paper"
iterations = 2
max_steps = 10
evaluation_episodes = 2
[tasks.gridworld]
minutes = 2
[methods.linear-program]
utility = "linear-program"
[methods.random]
untrained = true
[noise.none]
[noise.mistaken]
expert = "mistaken"
[[leave_out]]
methods = ["random"]
noise = ["mistaken"]
"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The directory of the tiny study, not to be changed."""
    directory = tmp_path_factory.mktemp("studies") / "tiny"
    study = Study.prepare(parsed(DECLARATION, "tiny"), directory)
    assert study.minutes_left() == pytest.approx(2 * 2 * 2.0)  # two rows that learn
    with pytest.MonkeyPatch.context() as monkeypatch:
        without_processes(monkeypatch)
        assert study.run(command="bayespbrl study tiny") == []
    return directory


def test_every_cell_is_a_run_directory_and_the_table_has_a_line_for_each_iteration(finished):
    assert sorted(path.relative_to(finished).as_posix() for path in finished.glob("*/*/*/seed-*")) == [
        f"gridworld/{row}/seed-{seed}"
        for row in ("linear-program/mistaken", "linear-program/none", "random/none")
        for seed in (2980, 2981)
    ]
    table = pd.read_csv(finished / "iterations.csv")
    assert len(table) == 2 * 2 * 2 + 2
    last = table[(table.methods == "linear-program") & (table.noise == "none") & (table.seed == 2981)].iloc[-1]
    kept = runs.load(finished / "gridworld/linear-program/none/seed-2981").iterations[-1]
    assert (last.answers, last.value) == (kept["answers"], pytest.approx(kept["value"], rel=1e-5))
    random = table[table.methods == "random"]
    assert random.iteration.tolist() == [0, 0]
    assert random.value.notna().all()
    description = json.loads((finished / "study.json").read_text())
    assert {"version", "command", "machine", "date"} <= set(description)


def test_an_untrained_cell_has_the_value_of_the_first_policy(finished):
    options = {"preset": "paper", "iterations": 2, "max_steps": 10, "evaluation_episodes": 2}
    learner = bayespbrl.Learner("gridworld", seed=2980, **options)
    cell = finished / "gridworld/random/none/seed-2980"
    kept = json.loads((cell / "first-policy.json").read_text())
    with pytest.raises(ValueError, match="expected a run of the learner, got a trial of a policy that does not learn"):
        runs.resume(cell)
    assert kept["value"] == pytest.approx(float(learner.cycle.evaluated(learner.policy).total.mean()))


def test_the_random_policy_of_the_default_is_random(tmp_path):
    learner = bayespbrl.Learner("gridworld", seed=1)
    measure_first_policy(learner, tmp_path)
    value = json.loads((tmp_path / "first-policy.json").read_text())["value"]
    assert value == pytest.approx(42.6, abs=6)  # of the uniform policy, which has to have its noise; 18.75 without


def test_a_second_call_computes_nothing_again_and_more_trials_may_follow(finished, tmp_path, monkeypatch):
    without_processes(monkeypatch)
    copy = shutil.copytree(finished, tmp_path / "study")
    shutil.rmtree(copy / "gridworld/linear-program/none/seed-2981")
    before = {file: file.stat().st_mtime_ns for file in copy.glob("*/*/*/seed-*/**/*") if file.is_file()}
    seen = []
    again = Study.prepare(parsed(DECLARATION, "tiny"), copy)
    assert (again.finished, again.cells) == (5, 6)
    again.run(progress=lambda now: seen.append((now.done, now.failed)))
    assert seen[-1] == (6, 0)
    assert {file: file.stat().st_mtime_ns for file in before} == before
    assert (copy / "iterations.csv").read_text().split("\n")[1].split(",")[:7] == (
        (finished / "iterations.csv").read_text().split("\n")[1].split(",")[:7]
    )
    assert Study.prepare(parsed(DECLARATION, "tiny"), copy, trials=3).finished == 6
    with pytest.raises(
        ValueError, match=r"trials: expected more than 1, of which .*linear-program.* has finished more"
    ):
        Study.prepare(parsed(DECLARATION, "tiny"), copy, trials=1)
    shutil.rmtree(copy / "gridworld/linear-program/none/seed-2981")  # as one that failed, with a finished one after it
    Study.prepare(parsed(DECLARATION, "tiny"), copy, trials=3).run()
    shutil.rmtree(copy / "gridworld/linear-program/none/seed-2981")
    with pytest.raises(ValueError, match=r"trials: expected more than 1, of which .*linear-program"):
        Study.prepare(parsed(DECLARATION, "tiny"), copy, trials=1)


def test_a_damaged_trial_is_given_up_and_the_others_go_on(finished, tmp_path, monkeypatch):
    without_processes(monkeypatch)
    copy = shutil.copytree(finished, tmp_path / "study")
    (copy / "gridworld/linear-program/none/seed-2980/settings.json").write_text("")
    shutil.rmtree(copy / "gridworld/linear-program/none/seed-2981")
    study = Study.prepare(parsed(DECLARATION, "tiny"), copy)
    (failure,) = study.run()
    assert "linear-program/none seed 2980" in str(failure)
    assert "settings.json" in str(failure)
    assert study.finished == 5
    assert len(read_study(copy).rows) == 3


@pytest.mark.parametrize(
    ("damaged", "told"),
    [
        (lambda summary: summary["iterations"][0].update(value=None), "expected answers and value in iteration 1"),
        (lambda summary: summary.pop("env"), "expected seed, env and utility of a run"),
        (
            lambda summary: summary["iterations"][0].pop("seconds"),
            "expected a number as seconds_utility in iteration 1",
        ),
        (lambda summary: summary["iterations"][0].update(kl="x"), "expected a number as kl in iteration 1, got x"),
    ],
)
def test_a_damaged_summary_takes_nothing_from_the_tables_of_others(finished, tmp_path, monkeypatch, damaged, told):
    without_processes(monkeypatch)
    copy = shutil.copytree(finished, tmp_path / "study")
    (copy / "iterations.csv").unlink()
    file = copy / "gridworld/linear-program/none/seed-2980/summary.json"
    damaged(summary := json.loads(file.read_text()))
    file.write_text(json.dumps(summary))
    study = Study.prepare(parsed(DECLARATION, "tiny"), copy)
    (failure,) = study.run()
    assert "linear-program/none seed 2980" in str(failure)
    assert told in str(failure)
    assert sum(len(row.seeds) for row in read_study(copy).rows) == 5


def test_a_damaged_measurement_is_given_up_and_the_others_go_on(finished, tmp_path, monkeypatch):
    without_processes(monkeypatch)
    copy = shutil.copytree(finished, tmp_path / "study")
    (copy / "gridworld/random/none/seed-2980/first-policy.json").write_text("")
    study = Study.prepare(parsed(DECLARATION, "tiny"), copy)
    (failure,) = study.run()
    assert "random/none seed 2980" in str(failure)
    assert "first-policy.json: expected value" in str(failure)
    assert study.finished == 5
    assert len(read_study(copy).rows) == 3  # as it was measured
    (copy / "iterations.csv").write_text("")
    with pytest.raises(ValueError, match=r"iterations\.csv: expected a table, got"):
        study.write_table()


def test_rows_may_be_added(finished, tmp_path, monkeypatch):
    without_processes(monkeypatch)
    copy = shutil.copytree(finished, tmp_path / "study")
    more = DECLARATION.replace("[methods.random]", "[methods.known]\nutility = 'known-reward'\n[methods.random]")
    study = Study.prepare(parsed(more, "tiny"), copy)
    assert (study.finished, study.cells) == (6, 10)
    assert study.run() == []
    added = "gridworld/known/none", "gridworld/known/mistaken"
    rows = [row.declared.name for row in read_study(copy).rows]
    assert sorted(rows) == sorted([row.name for row in parsed(DECLARATION, "tiny").rows] + list(added))


def test_a_trial_that_another_program_runs_is_left_to_it(tmp_path):
    row = row_of("gridworld", tmp_path, TINY, seed=2980)
    runs.start("gridworld", row.path(2980), **TINY, seed=2980)
    with continuing(row.path(2980)), pytest.raises(ValueError, match="expected a run that no other program continues"):
        run_trial(row, 2980)
    assert not (row.path(2980) / "events.jsonl").exists()
    assert run_trial(row, 2980)


def test_a_trial_that_another_command_runs_is_waited_for_and_no_failure(tmp_path, monkeypatch):
    seeds = Seeds(row_of("gridworld", tmp_path, TINY, seed=2980), 2)
    runs.start("gridworld", seeds.row.path(2980), **TINY, seed=2980)
    held, seen = contextlib.ExitStack(), []
    held.enter_context(continuing(seeds.row.path(2980)))

    def other_ends(_):
        held.close()

    monkeypatch.setattr(engine_module.time, "sleep", other_ends)
    assert Engine([seeds], ThisProcess(), lambda now: seen.append((now.elsewhere, now.failed))).run() == []
    assert seeds.with_outcome(True) == [2980, 2981]
    assert (1, 0) in seen
    assert seen[-1] == (0, 0)


@pytest.mark.slow
def test_two_commands_share_a_study_and_neither_reports_a_failure(tmp_path):
    (tmp_path / "tiny.toml").write_text(DECLARATION)
    command = [sys.executable, "-m", "bayespbrl", "study", "tiny.toml", "--trials", "3", "--out", "study"]
    both = [subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    told = [each.communicate(timeout=300)[0] for each in both]
    assert [each.returncode for each in both] == [0, 0], told
    assert not any("Failed" in each for each in told)
    assert Study.prepare(parsed(DECLARATION, "tiny"), tmp_path / "study", trials=3).finished == 9
    assert len(read_study(tmp_path / "study").rows) == 3


def test_a_study_that_was_killed_as_it_began_can_be_begun_again(tmp_path):
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "study.toml").write_text(DECLARATION)
    assert Study.prepare(parsed(DECLARATION, "tiny"), tmp_path / "study").finished == 0
    (tmp_path / "study" / "study.json.12-abcdef01.part").touch()  # while it wrote, or while another command writes
    assert Study.prepare(parsed(DECLARATION, "tiny"), tmp_path / "study").finished == 0
    (tmp_path / "study" / "study.json.old").touch()
    with pytest.raises(ValueError, match="expected the directory of a study"):
        Study.prepare(parsed(DECLARATION, "tiny"), tmp_path / "study")


def test_the_time_of_a_baseline_is_known(tmp_path, monkeypatch):
    without_processes(monkeypatch)
    text = DECLARATION.split("[methods")[0].replace("minutes = 2", "") + "[methods.pf]\nbaseline = 'pf'"
    study = Study.prepare(parsed(text, "tiny"), tmp_path / "study", trials=1)
    assert study.minutes_left() is None
    assert study.run() == []
    assert Study.prepare(parsed(text, "tiny"), tmp_path / "study", trials=2).minutes_left() > 0


def test_a_finished_study_keeps_where_it_is_from_and_a_continued_one_names_both(finished, tmp_path, monkeypatch):
    without_processes(monkeypatch)
    copy = shutil.copytree(finished, tmp_path / "study")
    kept = json.loads((copy / "study.json").read_text()) | {"source": "older", "date": "2026-01-01"}
    (copy / "study.json").write_text(json.dumps(kept))
    Study.prepare(parsed(DECLARATION, "tiny"), copy).run()
    assert json.loads((copy / "study.json").read_text()) == kept
    shutil.rmtree(copy / "gridworld/linear-program/none/seed-2981")
    for _ in range(2):
        Study.prepare(parsed(DECLARATION, "tiny"), copy).run()
        now = json.loads((copy / "study.json").read_text())
        assert now["source"] == source_digest()
        assert [(part["source"], part["date"]) for part in now["earlier"]] == [("older", "2026-01-01")]
    assert "some trials: source older, 2026-01-01" in read_study(copy).source


def test_trials_whose_directories_are_gone_keep_where_they_are_from(finished, tmp_path, monkeypatch):
    without_processes(monkeypatch)
    copy = shutil.copytree(finished, tmp_path / "study")
    kept = json.loads((copy / "study.json").read_text()) | {"source": "older", "date": "2026-01-01"}
    (copy / "study.json").write_text(json.dumps(kept))
    shutil.rmtree(copy / "gridworld")
    Study.prepare(parsed(DECLARATION, "tiny"), copy).run()
    now = json.loads((copy / "study.json").read_text())
    assert [(part["source"], part["date"]) for part in now["earlier"]] == [("older", "2026-01-01")]


def test_what_may_change_of_a_finished_study_is_kept(finished, tmp_path):
    copy = shutil.copytree(finished, tmp_path / "study")
    before = json.loads((copy / "study.json").read_text())
    text = "report_at = [2]\n" + DECLARATION
    assert Study.prepare(parsed(text, "tiny"), copy).run() == []
    assert (copy / "study.toml").read_text() == text
    assert json.loads((copy / "study.json").read_text()) == before


def test_a_trial_in_place_of_one_that_was_redrawn_stays_where_that_is_damaged_or_gone(tmp_path, monkeypatch):
    without_processes(monkeypatch)
    text = DECLARATION.split("[methods")[0]
    study = Study.prepare(parsed(text, "tiny"), tmp_path / "study", trials=2)
    assert study.run() == []
    _, other = (study.rows[0].row.path(seed) for seed in (2980, 2981))
    other.rename(other.with_name("seed-2982"))  # as if 2981 had been redrawn
    settings = other.with_name("seed-2982") / "settings.json"
    settings.write_text(settings.read_text().replace("2981", "2982"))
    before = (tmp_path / "study" / "iterations.csv").read_text()
    other.mkdir()
    damaged = Study.prepare(parsed(text, "tiny"), tmp_path / "study", trials=2)
    assert list(damaged.rows[0].damaged) == [2981]
    other.rmdir()
    assert Study.prepare(parsed(text, "tiny"), tmp_path / "study", trials=2).finished == 1
    with pytest.raises(ValueError, match="expected more than 1, of which"):
        Study.prepare(parsed(text, "tiny"), tmp_path / "study", trials=1)
    assert (tmp_path / "study" / "iterations.csv").read_text() == before


def test_a_baseline_does_not_compare_clips(tmp_path):
    text = DECLARATION.split("[methods")[0] + "[methods.pf]\nbaseline = 'pf'\nclip_steps = 5"
    with pytest.raises(ValueError, match="clip_steps: expected none, because a baseline compares whole"):
        Study.prepare(parsed(text, "tiny"), tmp_path / "study")


def test_a_row_that_hardly_ever_meets_a_preference_is_reported_and_the_others_go_on(tmp_path, monkeypatch):
    monkeypatch.setattr(rows, "MOST_SEEDS_A_TRIAL", 2)
    good = Seeds(row_of("gridworld", tmp_path / "good", TINY, seed=5, name="good"), 1)
    bad = Seeds(replace(good.row, directory=tmp_path / "bad", name="bad", preference_within=1), 1)
    bad.outcomes.update({5: False, 6: False})
    failures = Engine([bad, good], Dies({})).run()
    assert [str(failure) for failure in failures] == [
        "bad seed 5: expected 1 trials with a preference within 1 iterations, got none in 2 of 2"
    ]
    assert good.with_outcome(True) == [5]


@pytest.mark.parametrize("name", shipped())
def test_every_shipped_study_is_one(name):
    declaration = declared(name)
    assert declaration.rows
    assert declaration.seed >= 2000  # lower ones are used up


BAD = [
    ("title = [", "expected TOML"),
    ("[tasks]", "at least one task"),
    ("trials = 0\n[tasks.gridworld]", "trials: expected a whole number >= 1"),
    ("[tasks.gridworld]\nspeed = 3", "tasks.gridworld: expected entries among .*, got speed"),
    ("[tasks.gridworld]\nminutes = 'long'", "minutes: expected a positive finite number"),
    ("[options]\nseed = 4\n[tasks.gridworld]", "options: expected entries among .*, got seed"),
    ("levels = 3\n[tasks.gridworld]", "expected entries among .*, got levels"),
    ("[tasks.gridworld]\n[noise]\nfew = 3", "noise.few: expected a table, got 3"),
    ("[tasks.gridworld]\n[[leave_out]]\ntasks = ['nowhere']", "leave_out: expected a list of tasks among gridworld"),
    ("[tasks.gridworld]\n[[leave_out]]\ntasks = ['gridworld']", "all are left out"),
    ("[tasks.gridworld]\n[[leave_out]]\nmethods = ['mean']", "leave_out: expected no methods: none declared, got"),
    ("leave_out = 5\n[tasks.gridworld]", "leave_out: expected a list of tables, got 5"),
    ("[tasks.gridworld]\n[[leave_out]]\ntasks = [['a']]", "leave_out: expected a list of tasks among gridworld"),
    ("[tasks.'../up']", "expected a name of letters"),
    ("[tasks.'study.json']", "expected a name of letters"),
    ("[tasks.gridworld]\nminutes = -5", "minutes: expected a positive finite number, got -5"),
    ("[tasks.gridworld]\nenv = ''", "env: expected a short name or a gymnasium id, got ''"),
    ("[tasks.gridworld]\nminute = 5", "expected entries among env, minutes, failed_below, .*, got minute"),
    (
        "[tasks.gridworld]\n[methods.pf]\nbaseline = 'pf'\nuntrained = true",
        "expected untrained or a baseline",
    ),
    ("[tasks.gridworld]\n[[leave_out]]\ntasks = []", "leave_out: expected a list of tasks among gridworld"),
]


@pytest.mark.parametrize(("text", "message"), BAD, ids=[message[:30] for _, message in BAD])
def test_a_bad_declaration_is_named(text, message):
    with pytest.raises(ValueError, match=f"study bad.*{message}"):
        parsed(text, "bad")


def test_an_unknown_study_task_or_value_is_one_line(monkeypatch, capsys, tmp_path):
    assert "study: expected one of" in refused(monkeypatch, capsys, "study", "nothing", "--out", tmp_path / "out")
    missing = tmp_path / "missing.toml"
    assert "expected a readable file" in refused(monkeypatch, capsys, "study", missing, "--out", tmp_path / "out")
    for text, message in [("[tasks.mars]", "mars: environment"), ("[tasks.gridworld]\nexpert = 'me'", "expert")]:
        missing.write_text(text)
        assert message in refused(monkeypatch, capsys, "study", missing, "--out", tmp_path / "out")
    missing.write_text("[tasks.gridworld]")
    assert "trials: expected" in refused(
        monkeypatch, capsys, "study", missing, "--trials", 0, "--out", tmp_path / "out"
    )
    assert "jobs: expected" in refused(monkeypatch, capsys, "study", missing, "--jobs", 0, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_directory_of_something_else_other_settings_or_another_version_is_refused(finished, tmp_path):
    study = parsed(DECLARATION, "tiny")
    copy = shutil.copytree(finished, tmp_path / "study")
    for text, message in [
        (
            DECLARATION.replace("iterations = 2", "iterations = 3"),
            "got other options for gridworld/linear-program/none",
        ),
        (
            DECLARATION.replace("methods.random", "methods.chance").replace('"random"', '"chance"'),
            "got none of that name",
        ),
        (DECLARATION.replace("2980", "2990"), "expected its seed, 2980, got 2990"),
    ]:
        with pytest.raises(ValueError, match=message):
            Study.prepare(parsed(text, "tiny"), copy)
    with pytest.raises(ValueError, match="expected the study large, got tiny"):
        Study.prepare(parsed(DECLARATION, "large"), copy)
    description = json.loads((copy / "study.json").read_text())
    (copy / "study.json").write_text(json.dumps(description | {"version": "0.0.1"}))
    with pytest.raises(ValueError, match=r"got one by 0\.0\.1"):
        Study.prepare(study, copy)
    (copy / "study.json").unlink()
    with pytest.raises(ValueError, match="expected the directory of a study"):
        Study.prepare(study, copy)
    with pytest.raises(ValueError, match="got a file"):
        Study.prepare(study, copy / "study.toml")


def test_a_dry_run_says_how_many_cells_and_how_long_and_writes_nothing(monkeypatch, capsys, tmp_path):
    (tmp_path / "tiny.toml").write_text(DECLARATION)
    options = ("--trials", 30, "--jobs", 2, "--dry-run", "--out", tmp_path / "out")
    assert call(monkeypatch, "study", tmp_path / "tiny.toml", *options) == 0
    assert "3 rows of 30 trials, 90 cells, 0 of them finished; about 60 min on 2 cores." in capsys.readouterr().out
    assert not (tmp_path / "out").exists()


class Dies:
    """An executor whose workers die with their first calls of some seeds."""

    def __init__(self, deaths):
        self.deaths, self.calls = deaths, []

    def submit(self, function, row, seed):
        self.calls.append(seed)
        future = ThisProcess().submit(lambda: True)
        if self.calls.count(seed) <= self.deaths.get(seed, 0):
            future = ThisProcess().submit(self.die)
        return future

    @staticmethod
    def die():
        raise BrokenExecutor("its process ended (signal 9)")


def test_a_trial_that_dies_is_started_three_times_at_most_and_the_others_go_on(tmp_path):
    seeds = Seeds(row_of("gridworld", tmp_path / "row", TINY, seed=5, name="row"), 4)
    executor, seen = Dies({6: 2, 7: 3}), []
    failures = Engine([seeds], executor, lambda now: seen.append((now.done, now.failed))).run()
    assert sorted(executor.calls) == [5, 6, 6, 6, 7, 7, 7, 8]
    assert seeds.with_outcome(True) == [5, 6, 8]
    assert [str(failure) for failure in failures] == ["row seed 7: died 3 times: its process ended (signal 9)"]
    assert seen[-1] == (3, 1)


class Cancels:
    """An executor as Dask's when its client gives the scheduler up: what runs is cancelled, and it takes no more."""

    def __init__(self):
        self._client = SimpleNamespace(status="running")

    def submit(self, function, row, seed):
        if self._client.status == "closed":
            raise ClosedClientError("Client is closed.")
        future = Future()
        if seed == 4:
            future.set_exception(ContinuedElsewhere("another command runs it"))
        if seed == 6:
            self._client.status = "closed"
            future.cancel()
            future.set_running_or_notify_cancel()
        return future


def test_trials_whose_scheduler_is_lost_are_given_up_whether_cancelled_pending_or_run_elsewhere(tmp_path):
    seeds = Seeds(row_of("gridworld", tmp_path / "row", TINY, seed=4, name="row"), 4)
    failures = Engine([seeds], Cancels()).run()
    lost = "the connection to the scheduler is lost"
    assert sorted(map(str, failures)) == [f"row seed {seed}: {lost}" for seed in (4, 5, 6, 7)]


@pytest.mark.parametrize(("executor", "running"), [(Cancels(), None), (ThisProcess(), 0)])
def test_how_many_trials_run_is_not_said_where_the_executor_does_not_tell(tmp_path, executor, running):
    seeds, seen = Seeds(row_of("gridworld", tmp_path / "row", TINY, seed=6, name="row"), 1), []
    Engine([seeds], executor, lambda now: seen.append(now.running)).run()
    assert set(seen) == {running}


def test_the_time_left_follows_the_pace_of_this_call():
    assert Progress(10, before=4, done=4, seconds=5.0).seconds_left is None
    assert Progress(10, before=4, done=6, failed=1, seconds=30.0).seconds_left == pytest.approx(15 * 3)


def killed_once(directory):
    """The number of the process, at the first call; that process is then killed."""
    mark = Path(directory) / "killed"
    if not mark.exists():
        mark.write_text("")
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


def fails(message):
    raise ZeroDivisionError(message)


@pytest.mark.slow
def test_a_process_that_dies_fails_its_own_call_and_no_other(tmp_path):
    with trial_processes(2) as executor:
        calls = [executor.submit(killed_once, tmp_path)] + [executor.submit(time.sleep, 0.2) for _ in range(3)]
        with pytest.raises(BrokenExecutor, match="signal 9"):
            calls[0].result()
        assert [call.result() for call in calls[1:]] == [None] * 3
        assert executor.submit(killed_once, tmp_path).result() != os.getpid()
        with pytest.raises(RuntimeError, match="ZeroDivisionError: by nothing"):
            executor.submit(fails, "by nothing").result()
        with pytest.raises(MemoryError, match="Unable to allocate"):  # NumPy's own kind: the trial is started again
            executor.submit(np.empty, 1 << 59).result()


def test_no_scheduler_is_one_line(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("bayespbrl.studies.cluster.WAIT", 1)
    (tmp_path / "tiny.toml").write_text(DECLARATION)
    for address in ("tcp://127.0.0.1:9", "nonsense://x"):
        options = ("--scheduler", address, "--out", tmp_path / "out")
        assert f"scheduler: expected an answer from {address!r} within" in refused(
            monkeypatch, capsys, "study", tmp_path / "tiny.toml", *options
        )
    assert not (tmp_path / "out").exists()


@contextlib.contextmanager
def cluster(folder):
    """A Dask scheduler and two workers, each a process; yields the address and all three."""
    file = folder / "scheduler.json"
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": folder, "env": environment}
    program = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    started = [subprocess.Popen([*program, "--port", "0", "--no-dashboard", "--scheduler-file", str(file)], **quiet)]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", "--no-nanny", "--nthreads", "1", "--no-dashboard"]
    try:
        started += [subprocess.Popen([*worker, "--scheduler-file", str(file)], **quiet) for _ in range(2)]
        waited = time.monotonic() + 60
        while not file.exists():
            assert time.monotonic() < waited
            time.sleep(0.1)
        yield json.loads(file.read_text())["address"], started
    finally:
        for process in started:
            process.kill()
            process.wait()


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_loses_no_trial_and_computes_nothing_twice(tmp_path):
    longer = TINY | {"iterations": 8}
    seeds = Seeds(row_of("gridworld", tmp_path / "row", longer, seed=5), 4)
    with cluster(tmp_path) as (address, (_, *workers)), scheduler_executor(address) as executor:

        def kill_one(now):  # in the middle of a trial: two iterations are on the disk, more are to come
            logs = [tmp_path / "row" / f"seed-{seed}" / "iterations" / "0002.nc" for seed in (5, 6, 7, 8)]
            if any(log.exists() for log in logs) and all(worker.poll() is None for worker in workers):
                workers[0].kill()

        engine = Engine([seeds], executor, kill_one)
        assert engine.run() == []
        assert workers[0].poll() is not None
    assert seeds.with_outcome(True) == [5, 6, 7, 8]
    for seed in (5, 6, 7, 8):
        log = (tmp_path / "row" / f"seed-{seed}" / "events.jsonl").read_text().splitlines()
        improved = [json.loads(line)["iteration"] for line in log if json.loads(line)["event"] == "improved"]
        assert improved == list(range(1, 9))
        alone = row_of("gridworld", tmp_path / "alone", longer, seed=5)
    assert run_trial(alone, 6)
    kept, again = (runs.load(tmp_path / name / "seed-6").iterations for name in ("row", "alone"))
    assert [entry["value"] for entry in kept] == [entry["value"] for entry in again]


@pytest.mark.slow
def test_a_scheduler_that_dies_ends_the_study_and_names_its_trials(tmp_path, monkeypatch):
    seeds = Seeds(row_of("gridworld", tmp_path / "row", TINY | {"iterations": 20}, seed=5, name="row"), 2)
    with cluster(tmp_path) as (address, (scheduler, *_)):
        monkeypatch.setattr("bayespbrl.studies.cluster.WAIT", 5)
        with scheduler_executor(address) as executor:

            def kill(now):
                if any((tmp_path / "row").glob("seed-*/iterations/0001.nc")):
                    scheduler.kill()

            failures = Engine([seeds], executor, kill).run()
    assert {str(failure) for failure in failures} == {
        f"row seed {seed}: the connection to the scheduler is lost" for seed in (5, 6)
    }


def test_a_row_is_where_it_is_for_workers_in_other_folders_too(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert row_of("gridworld", Path("row"), TINY, seed=5).path(5) == tmp_path / "row" / "seed-5"


@pytest.mark.parametrize("part", ["query", "schedule", "policy"])
def test_a_row_needs_parts_that_the_package_has(tmp_path, part):
    with pytest.raises(ValueError, match=f"{part}: expected one that the package has"):
        row_of("gridworld", tmp_path, {part: "other"}, seed=2980)


def test_a_row_needs_a_simulated_expert(tmp_path):
    with pytest.raises(ValueError, match="expert: expected one of return, stochastic"):
        rows.row_of("gridworld", tmp_path, {"expert": "terminal"}, seed=1)
