"""The command line: what it runs, what it shows, and what it refuses."""

import contextlib
import importlib.metadata
import io
import json
import os
import re
import shutil
import subprocess
import sys
from unittest import mock

import jax
import numpy as np
import pytest
import xarray as xr

import bayespbrl
from bayespbrl.cli.commands import main
from bayespbrl.cli.compiled import LEAST_SECONDS, VARIABLE, keep_compiled
from bayespbrl.cli.display import show_trials
from bayespbrl.runs.directory import command_to_continue
from bayespbrl.settings import Settings
from bayespbrl.studies import Trials

SHORT = ["--preset", "paper", "--utility", "linear-program", "--max-steps", "20"]
QUICK = [*SHORT, "--iterations", "2"]


def call(monkeypatch, *arguments):
    """Exit status of the command line with these arguments, in this process."""
    monkeypatch.setattr(sys, "argv", ["bayespbrl", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        main()
    return stop.value.code


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The directory of a run of two iterations, not to be changed, and what the command line showed of it."""
    out = tmp_path_factory.mktemp("cli") / "run"
    with pytest.MonkeyPatch.context() as monkeypatch, contextlib.redirect_stdout(io.StringIO()) as shown:
        assert call(monkeypatch, "run", "gridworld", *QUICK, "--out", out) == 0
    return out, shown.getvalue()


def refused(monkeypatch, capsys, *arguments):
    """The one line with which the command line refuses these arguments."""
    assert call(monkeypatch, *arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.startswith("bayespbrl: ")
    return error


@pytest.fixture
def unpictured(monkeypatch):
    """Without the picture and the film of a finished run, which take most of the time of a short one."""
    monkeypatch.setattr("bayespbrl.cli.display._film", lambda learner, directory: "")
    monkeypatch.setattr("bayespbrl.diagnostics.plots.run_figure", lambda learner: mock.Mock())


@pytest.mark.slow
def test_run_leaves_a_run_directory_with_a_picture_and_says_where(finished):
    out, shown = finished
    assert "answers" in shown
    assert re.sub(r"\s", "", str(out)) in re.sub(r"\s", "", shown)
    assert (out / "run.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "final.gif").read_bytes().startswith(b"GIF")
    assert (out / "final.png").read_bytes().startswith(b"\x89PNG")
    assert [entry["answers"] for entry in json.loads((out / "summary.json").read_text())["iterations"]] == [2, 3]


@pytest.mark.slow
def test_a_run_in_an_environment_that_cannot_be_rendered_finishes_and_says_so(monkeypatch, capsys, tmp_path):
    out = tmp_path / "run"
    options = [*SHORT, "--iterations", "1", "--centres", "10"]
    with mock.patch.dict(sys.modules, {"pygame": None}):  # with which gymnasium renders it
        assert call(monkeypatch, "run", "CartPole-v1", *options, "--out", out) == 0
    assert "No film of the final policy: environment CartPole-v1 cannot be rendered" in capsys.readouterr().out
    assert not (out / "final.gif").exists()


def test_trials_tell_redraws_and_how_long_the_final_policies_last(capsys, tmp_path):
    names = ["answers", "value", "bound_active", "kl", "kl_bound", "feature_gap", "feature_gap_raw", "rank_kept"]
    table = xr.Dataset(
        {name: (("seed", "iteration"), np.ones((2, 1))) for name in [*names, "utility_converged"]},
        {"seed": [1, 3], "iteration": [1]},
        {"env": "bicycle", "utility": "posterior-mean", "redraws": 2, "redrawn_seeds": "2 4"},
    )
    table = xr.concat([table, table.assign_coords(iteration=[2])], "iteration")
    table["terminated"] = ("seed", "iteration"), np.array([[0.5, 0.0], [0.25, 0.25]])
    # the second trial ended after its first iteration; what stands in its second place is no fit of its
    table["seconds_utility"] = ("seed", "iteration"), np.array([[1.0, 1.0], [1.0, np.nan]])
    table["utility_converged"] = ("seed", "iteration"), np.array([[1.0, 1.0], [0.0, 0.0]])
    table["balancing_steps"] = "seed", np.array([100.0, 300.0]), {"max_steps": 3000, "episodes": 100}
    show_trials(Trials(table, tmp_path))
    shown = capsys.readouterr().out
    assert "Trials redrawn because they met no preference: 2, seeds 2, 4." in shown
    assert "87.5% of the evaluation episodes survive (worst trial 75.0%)" in shown
    assert "KL bound active in 3 of 3 iterations" in shown
    assert "fits that did not converge: 1." in shown
    assert "200 steps in the median trial, 100 in the worst, at most 3000" in shown
    assert (tmp_path / "trials.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.usefixtures("unpictured")
def test_options_reach_the_settings(monkeypatch, tmp_path):
    out = tmp_path / "run"
    options = ["--kl-bound", "0.2", "--seed", "7", "--steepness", "3", "--wrong-answers", "0.1"]
    options += ["--updates-per-iteration", "2", "--unasked-iterations", "1"]
    assert call(monkeypatch, "run", "gridworld", *QUICK, *options, "--out", out) == 0
    settings = json.loads((out / "settings.json").read_text())
    expected = {"kl_bound": 0.2, "seed": 7, "steepness": 3.0, "wrong_answers": 0.1, "utility": "linear-program"}
    expected |= {"updates_per_iteration": 2, "unasked_iterations": 1}
    assert {name: settings[name] for name in expected} == expected


@pytest.mark.slow
@pytest.mark.usefixtures("unpictured")
def test_rows_that_answers_do_not_tell_apart_have_their_iteration(monkeypatch, capsys, tmp_path, finished):
    options = [*SHORT, "--iterations", "6", "--unasked-iterations", "5", "--kl-bound", "0.0734567"]
    assert call(monkeypatch, "run", "gridworld", *options, "--out", tmp_path / "quiet") == 0
    shown = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("│")[1:3]] for line in shown.splitlines() if line.startswith("│")]
    assert rows == [["1", "2"], ["5", "4"], ["6", "4"]]
    assert "…" not in shown  # where eighty columns are too few, cells are cut
    assert "iteration ┃" in shown
    assert "answers ┃" in finished[1]
    assert "iteration ┃" not in finished[1]


def test_resuming_a_finished_run_says_so(monkeypatch, capsys, finished):
    out = finished[0]
    before = (out / "events.jsonl").read_bytes()
    assert call(monkeypatch, "resume", out) == 0
    assert "finished" in capsys.readouterr().out
    assert (out / "events.jsonl").read_bytes() == before


@pytest.mark.slow
def test_resuming_draws_the_pictures_that_a_finished_run_lacks(monkeypatch, capsys, tmp_path):
    out = tmp_path / "run"
    options = {"preset": "paper", "utility": "linear-program", "iterations": 1, "max_steps": 20, "expert": "other"}
    bayespbrl.start("gridworld", out, **options).run(bayespbrl.ReturnExpert())
    before = (out / "events.jsonl").read_bytes()
    assert call(monkeypatch, "resume", out) == 0
    shown = capsys.readouterr().out
    assert "run.png" in shown
    assert "simulated expert" not in shown  # nobody answers
    assert {path.name for path in out.glob("*.png")} == {"run.png", "final.png"}
    assert (out / "events.jsonl").read_bytes() == before


def test_an_interrupt_while_the_pictures_are_drawn_says_how_to_get_them(monkeypatch, capsys, tmp_path):
    with mock.patch("bayespbrl.cli.display._film", side_effect=KeyboardInterrupt):
        assert call(monkeypatch, "run", "gridworld", *QUICK, "--out", tmp_path / "run") == 130
    assert f"Nothing is lost: bayespbrl resume {tmp_path / 'run'}" in capsys.readouterr().out.replace("\n", "")


def test_nobody_answers_for_an_expert_of_the_users_own(monkeypatch, capsys, tmp_path):
    assert "expert: expected a simulated expert, page or terminal, got other" in refused(
        monkeypatch, capsys, "run", "gridworld", *QUICK, "--expert", "other", "--out", tmp_path / "run"
    )
    assert not (tmp_path / "run").exists()
    options = {"preset": "paper", "utility": "linear-program", "iterations": 2, "max_steps": 20}
    bayespbrl.start("gridworld", tmp_path / "own", **options, expert="other").ask()
    before = (tmp_path / "own" / "events.jsonl").read_bytes()
    assert "got other" in refused(monkeypatch, capsys, "resume", tmp_path / "own")
    assert (tmp_path / "own" / "events.jsonl").read_bytes() == before


def test_a_run_without_a_simulated_expert_leaves_nothing_behind_but_what_was_there(monkeypatch, capsys, tmp_path):
    out, options = tmp_path / "run", {"expert": "stochastic", "max_steps": 20}
    arguments = ["MountainCar-v0", "--expert", "stochastic", "--max-steps", 20, "--out", out]
    said = refused(monkeypatch, capsys, "run", *arguments)
    assert not out.exists()
    bayespbrl.start("MountainCar-v0", out, **options)
    (out / "notes.txt").write_text("mine")
    assert refused(monkeypatch, capsys, "resume", out) == said
    assert (out / "notes.txt").read_text() == "mine"


def test_the_command_that_continues_a_run_names_what_it_needs(tmp_path):
    line = command_to_continue("resume", Settings("package:Env-v0"), tmp_path, ["Ada"])
    assert line == f"bayespbrl resume {tmp_path} --answerer=Ada --import-package"
    assert command_to_continue("ask", Settings("Pendulum-v1"), tmp_path) == f"bayespbrl ask {tmp_path}"


@pytest.mark.usefixtures("unpictured")
def test_a_path_with_square_brackets_is_shown_as_it_is(monkeypatch, capsys, tmp_path):
    out = tmp_path / "[wide]" / "[/b]"
    assert call(monkeypatch, "run", "gridworld", *SHORT, "--iterations", "1", "--out", out) == 0
    assert f"Run directory: {out}" in capsys.readouterr().out


@pytest.mark.usefixtures("unpictured")
def test_a_run_without_out_gets_a_fresh_directory_under_runs(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        assert call(monkeypatch, "run", "gridworld", *SHORT, "--iterations", "1") == 0
    assert len(list((tmp_path / "runs").iterdir())) == 2


@pytest.mark.usefixtures("unpictured")
def test_a_person_answers_at_the_prompt_stops_and_resumes(monkeypatch, capsys, tmp_path):
    out = tmp_path / "run"
    monkeypatch.setattr(sys, "stdin", io.StringIO("1\nx\nt\nq\n"))
    status = call(monkeypatch, "run", "gridworld", *QUICK, "--expert", "terminal", "--answerer", "Ada", "--out", out)
    shown = capsys.readouterr().out
    assert status == 130
    assert f"resume {out} --answerer=Ada" in shown.replace("\n", "")
    assert (out / "query.png").read_bytes().startswith(b"\x89PNG")
    answered = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]
    answered = [event for event in answered if event["event"] == "answered"]
    assert [event["answer"] for event in answered] == ["first", "tie"]
    assert all(event["answerer"] == "Ada" and event["seconds"] >= 0 for event in answered)
    monkeypatch.setattr(sys, "stdin", io.StringIO("2\n"))
    assert call(monkeypatch, "resume", out) == 0
    assert json.loads((out / "summary.json").read_text())["answers"] == 3


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["run", "gridwurld"], "gridwurld"),
        (["run", "gridworld", "--utility", "magic"], "utility"),
        (["run", "gridworld", "--kl-bound", "-1"], "kl_bound"),
        (["run", "gridworld", "--answerer", "Ada"], "answerer"),
        (["run", "gridworld", "--expert", "terminal", "--answerer", " "], "answerer"),
        (["run", "gridworld", "--repeats", "1.5"], "repeats"),
        (["run", "gridworld", "--kl-bound", "nan"], "kl_bound"),
        (["run", "gridworld", "--iterations", "0"], "iterations"),
        (["run", "gridworld", "--seed", "-1"], "seed"),
        (["run", "gridworld", "--no-such-option"], "no-such-option"),
        (["run", "gridworld", "--kl-bound", "big"], "kl-bound"),
        (["run"], "ENV"),
        (["trials", "gridworld", "--trials", "0"], "trials"),
        (["trials", "gridworld", "--jobs", "0"], "jobs"),
        (["trials", "gridworld", "--expert", "terminal"], "expert"),
        ([], "command"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(monkeypatch, capsys, tmp_path, options, named):
    monkeypatch.chdir(tmp_path)
    assert named.lower() in refused(monkeypatch, capsys, *options).lower()
    assert list(tmp_path.iterdir()) == []


def test_an_existing_run_directory_is_refused_and_kept(monkeypatch, capsys, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    assert str(tmp_path) in refused(monkeypatch, capsys, "run", "gridworld", *QUICK, "--out", tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_foreign_directory_cannot_be_resumed(monkeypatch, capsys, tmp_path):
    assert "settings.json" in refused(monkeypatch, capsys, "resume", tmp_path)


def test_a_truncated_iteration_file_is_named(monkeypatch, capsys, tmp_path, finished):
    out = shutil.copytree(finished[0], tmp_path / "run")
    file = out / "iterations" / "0002.nc"
    file.write_bytes(file.read_bytes()[:1000])
    assert "0002.nc" in refused(monkeypatch, capsys, "resume", out)
    assert file.stat().st_size == 1000


def test_the_version_is_that_of_the_installed_package(monkeypatch, capsys):
    assert call(monkeypatch, "--version") == 0
    assert capsys.readouterr().out == f"bayespbrl {importlib.metadata.version('bayespbrl')}\n"


@pytest.mark.slow
def test_the_module_runs_as_a_program():
    result = subprocess.run(
        [sys.executable, "-m", "bayespbrl", "run", "nowhere"], capture_output=True, text=True, check=False
    )
    assert result.returncode == 2
    assert result.stderr.startswith("bayespbrl: environment: expected gridworld")


def test_what_is_compiled_is_kept_in_the_users_cache_unless_jax_is_told_where(monkeypatch, tmp_path):
    kept, seconds = jax.config.jax_compilation_cache_dir, jax.config.jax_persistent_cache_min_compile_time_secs
    monkeypatch.delenv(LEAST_SECONDS, raising=False)
    try:
        monkeypatch.setenv(VARIABLE, "elsewhere")
        keep_compiled()
        assert (os.environ[VARIABLE], jax.config.jax_compilation_cache_dir) == ("elsewhere", kept)
        monkeypatch.delenv(VARIABLE)
        (tmp_path / "file").write_text("")
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))  # where no folder can be made
        keep_compiled()
        assert VARIABLE not in os.environ
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        keep_compiled()
        (folder,) = (tmp_path / "bayespbrl").iterdir()
        assert os.environ[VARIABLE] == jax.config.jax_compilation_cache_dir == str(folder)
        assert (os.environ[LEAST_SECONDS], jax.config.jax_persistent_cache_min_compile_time_secs) == ("0", 0.0)
    finally:
        for name in (VARIABLE, LEAST_SECONDS):
            os.environ.pop(name, None)  # before monkeypatch restores it
        jax.config.update("jax_compilation_cache_dir", kept)
        jax.config.update(LEAST_SECONDS.lower(), seconds)
