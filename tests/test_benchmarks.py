"""The benchmark of the cycle runs, and its seconds add up; the others measure, and are run by hand."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

CYCLE = Path(__file__).parents[1] / "benchmarks" / "cycle.py"


@pytest.mark.slow
def test_the_seconds_of_the_steps_of_a_trial_add_up():
    arguments = ["bicycle", "--iterations", "2", "--centres", "30", "--seed", "4"]
    run = subprocess.run([sys.executable, str(CYCLE), *arguments], capture_output=True, text=True, check=True)
    *table, line = run.stdout.splitlines()
    result = json.loads(line)
    steps = result["seconds_by_step"]
    named = {"features", "sampler", "LSTD", "dual", "policy fit", "CMA-ES", "rollouts", "evaluation", "compilation"}
    assert named <= set(steps)
    assert all(seconds > 0 for seconds in steps.values())
    assert sum(steps.values()) == pytest.approx(result["seconds"], abs=0.1)
    assert steps["rest"] < 0.1 * result["seconds"]
    assert len(result["seconds_by_iteration"]) == result["iterations"] == 2
    assert result["answers"] == 3
    assert 100 < result["peak_memory_mib"] < 2048
    assert all(any(f"  {step} " in row for row in table) for step in steps)
