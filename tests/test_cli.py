import io
import json
import re
import subprocess
import sys

import pytest

from bayespbrl.cli import main

QUICK = ["--utility", "linear-program", "--iterations", "2"]


def call(monkeypatch, *arguments):
    """Exit status of the command line with these arguments, in this process."""
    monkeypatch.setattr(sys, "argv", ["bayespbrl", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        main()
    return stop.value.code


def refused(monkeypatch, capsys, *arguments):
    """The one line with which the command line refuses these arguments."""
    assert call(monkeypatch, *arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.startswith("bayespbrl: ")
    return error


def test_run_leaves_a_run_directory_with_a_picture_and_says_where(monkeypatch, capsys, tmp_path):
    out = tmp_path / "run"
    assert call(monkeypatch, "run", "gridworld", *QUICK, "--out", out) == 0
    shown = capsys.readouterr().out
    assert "answers" in shown
    assert re.sub(r"\s", "", str(out)) in re.sub(r"\s", "", shown)
    assert (out / "run.png").read_bytes().startswith(b"\x89PNG")
    assert [entry["answers"] for entry in json.loads((out / "summary.json").read_text())["iterations"]] == [2, 3]


def test_options_reach_the_settings(monkeypatch, tmp_path):
    out = tmp_path / "run"
    options = ["--kl-bound", "0.2", "--seed", "7", "--steepness", "3", "--wrong-answers", "0.1"]
    assert call(monkeypatch, "run", "gridworld", *QUICK, *options, "--out", out) == 0
    settings = json.loads((out / "settings.json").read_text())
    expected = {"kl_bound": 0.2, "seed": 7, "steepness": 3.0, "wrong_answers": 0.1, "utility": "linear-program"}
    assert {name: settings[name] for name in expected} == expected


def test_resuming_a_finished_run_says_so(monkeypatch, capsys, tmp_path):
    out = tmp_path / "run"
    call(monkeypatch, "run", "gridworld", *QUICK, "--out", out)
    before = (out / "events.jsonl").read_bytes()
    capsys.readouterr()
    assert call(monkeypatch, "resume", out) == 0
    assert "finished" in capsys.readouterr().out
    assert (out / "events.jsonl").read_bytes() == before


def test_a_run_without_out_gets_a_fresh_directory_under_runs(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        assert call(monkeypatch, "run", "gridworld", *QUICK) == 0
    assert len(list((tmp_path / "runs").iterdir())) == 2


def test_a_person_answers_at_the_prompt_stops_and_resumes(monkeypatch, capsys, tmp_path):
    out = tmp_path / "run"
    monkeypatch.setattr(sys, "stdin", io.StringIO("1\nx\nt\nq\n"))
    status = call(monkeypatch, "run", "gridworld", *QUICK, "--expert", "terminal", "--out", out)
    shown = capsys.readouterr().out
    assert status == 130
    assert "resume" in shown
    assert (out / "query.png").read_bytes().startswith(b"\x89PNG")
    answered = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]
    assert [event["answer"] for event in answered if event["event"] == "answered"] == ["first", "tie"]
    monkeypatch.setattr(sys, "stdin", io.StringIO("2\n"))
    assert call(monkeypatch, "resume", out) == 0
    assert json.loads((out / "summary.json").read_text())["answers"] == 3


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["run", "gridwurld"], "gridwurld"),
        (["run", "gridworld", "--utility", "magic"], "utility"),
        (["run", "gridworld", "--kl-bound", "-1"], "kl_bound"),
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


def test_a_truncated_iteration_file_is_named(monkeypatch, capsys, tmp_path):
    out = tmp_path / "run"
    call(monkeypatch, "run", "gridworld", *QUICK, "--out", out)
    capsys.readouterr()
    file = out / "iterations" / "0002.nc"
    file.write_bytes(file.read_bytes()[:1000])
    assert "0002.nc" in refused(monkeypatch, capsys, "resume", out)
    assert file.stat().st_size == 1000


def test_the_module_runs_as_a_program():
    result = subprocess.run(
        [sys.executable, "-m", "bayespbrl", "run", "nowhere"], capture_output=True, text=True, check=False
    )
    assert result.returncode == 2
    assert result.stderr.startswith("bayespbrl: environment: expected gridworld")
