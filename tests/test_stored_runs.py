"""Runs that an earlier version left: they are read, and go on, wherever the classes stand today."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import bayespbrl

STORED = Path(__file__).parent / "data" / "stored"


@pytest.mark.parametrize("name", ["gridworld", "swing-up"])
def test_a_stored_run_reads_as_it_did(name):
    run, expected = bayespbrl.load(STORED / name), json.loads((STORED / f"{name}.json").read_text())
    first = run.trajectories[:3]
    np.testing.assert_allclose(run.estimate.trajectory_utilities(first), expected["utilities"], rtol=1e-12)
    np.testing.assert_allclose(run.estimate.trajectory_draws(first, number=8), expected["draws"], rtol=1e-12)
    assert [list(pair) for pair in run.preferences.pairs] == expected["pairs"]
    assert [summary["value"] for summary in run.iterations] == expected["values"]


@pytest.mark.parametrize("name", ["gridworld", pytest.param("swing-up", marks=pytest.mark.slow)])
def test_a_stored_run_goes_on(name, tmp_path):
    shutil.copytree(STORED / name, tmp_path / name)
    learner = bayespbrl.resume(tmp_path / name)
    assert not learner.finished
    assert learner.run(bayespbrl.ReturnExpert()).finished
    assert len(learner.iterations) == 3
