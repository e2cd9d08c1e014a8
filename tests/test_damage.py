"""Damaged and foreign run directories, full disks and wrong kinds: one clear line, and what was there stays."""

import json
import os
import subprocess
import sys

import h5netcdf
import numpy as np
import pytest
import xarray as xr
from test_cli import refused
from toys import Slope

import bayespbrl
from bayespbrl.diagnostics.report import write_report
from bayespbrl.diagnostics.report.contents import read_contents
from bayespbrl.improvement.schedules import ConfidenceBound
from bayespbrl.queries import InformationWhenUnsure
from bayespbrl.runs.directory import RunDirectory, read_summary
from bayespbrl.studies.tables import collect

DEEP = "[" * 100_000
PACKAGE = "raise SystemExit('this was imported')"


@pytest.mark.slow
def test_a_file_size_limit_ends_in_one_line_and_the_run_goes_on(tmp_path):
    out = tmp_path / "run"
    options = ["--preset", "paper", "--utility", "linear-program", "--iterations", "2", "--max-steps", "30"]
    limited = (  # an iteration's file is larger
        "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (16_000, 16_000)); "
        "from bayespbrl.cli.commands import main; main()"
    )
    command = [sys.executable, "-c", limited, "run", "gridworld", *options, "--out", str(out)]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    options = {"capture_output": True, "text": True, "cwd": tmp_path, "env": environment}
    done = subprocess.run(command, check=False, **options)
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("bayespbrl: ")
    assert "File too large" in done.stderr
    assert "0001.nc" in done.stderr
    assert not list(out.rglob("*.part"))
    learner = bayespbrl.resume(out)
    assert learner.run(bayespbrl.ReturnExpert()).finished


@pytest.mark.parametrize(
    "name", [".foo:Env-v0", "foo..bar:Env-v0", ":Env-v0", "a:b:Env-v0", "no_such_package_x:Env-v0"]
)
def test_a_name_that_cannot_be_imported_is_one_line(monkeypatch, capsys, tmp_path, name):
    assert "environment" in refused(monkeypatch, capsys, "run", name, "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()


def damage_of(directory):
    """What the report's reader names, as one text."""
    return "\n".join(warning.what for warning in read_contents(directory).damage)


def of_another_environment(directory, name):
    settings = json.loads((directory / "settings.json").read_text())
    (directory / "settings.json").write_text(json.dumps(settings | {"env": name}))


@pytest.mark.parametrize("name", [".foo:Env-v0", "strangers_package:Env-v0"])
def test_a_strangers_run_imports_no_package_unless_told(monkeypatch, capsys, tmp_path, gridworld_copy, name):
    (tmp_path / "strangers_package.py").write_text(PACKAGE)
    monkeypatch.syspath_prepend(tmp_path)
    of_another_environment(gridworld_copy, name)
    assert "expected permission to import" in refused(monkeypatch, capsys, "resume", gridworld_copy)
    with pytest.raises(ValueError, match="import_package=True"):
        bayespbrl.load(gridworld_copy)
    assert "expected permission to import" in damage_of(gridworld_copy)
    assert "strangers_package" not in sys.modules
    if name.startswith("strangers"):
        with pytest.raises(SystemExit, match="this was imported"):
            bayespbrl.load(gridworld_copy, import_package=True)


@pytest.mark.parametrize("file", ["settings.json", "summary.json", "events.jsonl"])
def test_brackets_nested_thousands_deep_are_named(monkeypatch, capsys, gridworld_copy, file):
    (gridworld_copy / file).write_text(DEEP + "\n")
    if file == "settings.json":
        assert "nested too deeply" in refused(monkeypatch, capsys, "resume", gridworld_copy)
        return
    assert file in damage_of(gridworld_copy)
    if file == "summary.json":
        with pytest.raises(ValueError, match="nested too deeply"):
            read_summary(gridworld_copy)
    else:
        assert "events.jsonl, line 1" in refused(monkeypatch, capsys, "resume", gridworld_copy)


ENTRIES = [{"iteration": 1, "answers": 2}, {"iteration": 1, "answers": None, "value": 1.0}, None]


@pytest.mark.parametrize("entry", ENTRIES, ids=str)
def test_a_summary_without_value_or_answers_is_named(monkeypatch, capsys, gridworld_copy, entry):
    summary = read_summary(gridworld_copy)
    (gridworld_copy / "summary.json").write_text(json.dumps(summary | {"iterations": [entry]}))
    with pytest.raises(ValueError, match=r"summary\.json: expected answers and value in iteration 1"):
        collect([gridworld_copy])
    assert len(bayespbrl.load(gridworld_copy).iterations) == 3  # by the log
    lines = [json.loads(line) for line in (gridworld_copy / "events.jsonl").read_text().splitlines()]
    for line in lines:
        if line["event"] == "improved":
            line["summary"] = entry
    (gridworld_copy / "events.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert "expected a summary with answers and value" in refused(monkeypatch, capsys, "resume", gridworld_copy)
    assert "expected a summary with answers and value" in damage_of(gridworld_copy)


def rewritten(file, name, data):
    """A variable of an iteration file with other data, under the same dimensions where they fit, else its own."""
    group, _, variable = name.rpartition("/")
    with xr.open_datatree(file, engine="h5netcdf") as opened:
        tree = opened.load()
    dimensions = [f"own_{variable}_{axis}" for axis in range(np.ndim(data))]
    tree[group].dataset = tree[group].to_dataset().drop_vars(variable).assign({variable: (dimensions, data)})
    tree.to_netcdf(file, engine="h5netcdf")


DAMAGE = {
    "text in place of states": ("trajectories/states", np.full((10, 21), "x" * 5, dtype="S5")),
    "states beyond the grid": ("trajectories/states", np.full((10, 21), 10_000)),
    "continuous states": ("trajectories/states", np.zeros((10, 21, 2))),
    "actions beyond the grid": ("trajectories/actions", np.full((10, 20), 77)),
    "one trajectory": ("trajectories/length", np.array([20])),
    "lengths beyond the steps": ("trajectories/length", np.full(10, 10**9)),
    "no weights": ("utility/weights", np.zeros((0, 0))),
    "weights of another shape": ("utility/weights", np.zeros((1, 2))),
    "multiples as text": ("utility/multiples", np.full((1, 1), "y", dtype="S1")),
}


# those that differ in what is wrong with them
FAST = ["text in place of states", "states beyond the grid", "lengths beyond the steps", "weights of another shape"]


@pytest.mark.parametrize(
    "kind", [*FAST, *(pytest.param(kind, marks=pytest.mark.slow) for kind in DAMAGE if kind not in FAST)]
)
def test_a_damaged_iteration_file_is_named(gridworld_copy, kind):
    name, data = DAMAGE[kind]
    rewritten(gridworld_copy / "iterations" / "0003.nc", name, data)
    contents = read_contents(gridworld_copy)
    assert [warning.what.split(":")[:2] for warning in contents.damage] == [["Missing data", " iterations/0003.nc"]]
    assert contents.estimate_iteration == 2


@pytest.mark.slow
def test_the_report_of_a_damaged_run_has_all_its_sections(gridworld_copy):
    for number, kind in ((1, "states beyond the grid"), (3, "weights of another shape")):
        rewritten(gridworld_copy / "iterations" / f"000{number}.nc", *DAMAGE[kind])
    text = write_report(gridworld_copy, format="md").read_text()
    assert text.count("Missing data: iterations/000") >= 2
    assert "could not be made" not in text


def test_a_file_that_claims_terabytes_is_refused_before_it_is_read(monkeypatch, capsys, gridworld_copy):
    file = gridworld_copy / "iterations" / "0002.nc"
    with h5netcdf.File(file, "a") as opened:
        opened["trajectories"].dimensions["huge"] = 10**12
        opened["trajectories"].create_variable("claim", ("huge",), dtype="f8", chunks=(10**6,))
    assert "bytes of arrays in a file of" in refused(monkeypatch, capsys, "resume", gridworld_copy)
    assert "bytes of arrays" in damage_of(gridworld_copy)


WRONG_KINDS = {
    "features": ["rbf", 3, np.zeros(3)],
    "policy": [3, object(), lambda states: 0],
    "schedule": [0.3, np.zeros(2), ConfidenceBound],
    "query": [3, ["information"], InformationWhenUnsure],
}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in WRONG_KINDS.items() for value in values])
def test_an_object_of_the_wrong_kind_is_named_at_once(tmp_path, name, value):
    with pytest.raises(ValueError, match=f"{name}: expected a"):
        bayespbrl.start(Slope(), tmp_path / "run", max_steps=5, **{name: value})
    assert not (tmp_path / "run").exists()


def test_an_expert_that_is_no_function_is_named_before_anything_happens(tmp_path):
    learner = bayespbrl.start("gridworld", tmp_path / "run", preset="paper", max_steps=5)
    with pytest.raises(ValueError, match="expert: expected a function of two trajectories, got 'return'"):
        learner.run("return")
    with pytest.raises(ValueError, match="expert: expected a function of two trajectories, got <class"):
        learner.run(bayespbrl.ReturnExpert)  # and not an instance
    with pytest.raises(ValueError, match=r"expert: expected one of return, .*, got array"):
        bayespbrl.Learner("gridworld", expert=np.zeros(2))
    assert not RunDirectory.open(tmp_path / "run").log_file.exists()
