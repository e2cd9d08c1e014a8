"""A trial of a baseline: its policies are evaluated as the learner's are, after each answer."""

import json
import time
from pathlib import Path
from typing import Any

from bayespbrl.baselines import BASELINES
from bayespbrl.learner import Learner
from bayespbrl.runs.directory import BASELINE_FILE
from bayespbrl.runs.files import write_file
from bayespbrl.runs.simulated import expert_of
from bayespbrl.studies.tables import checked_trial


def measure_baseline(learner: Learner, name: str, directory: Path) -> None:
    """Run a baseline of `BASELINES` on a learner's task, with its expert and seed; in `baseline.json`.

    It gets as many answers as the learner may (`Settings.most_answers`). The trial is written when it
    ends: one that was stopped starts again.

    Raises:
      ValueError: a task that the baseline does not take, or an expert who skipped all questions.
    """
    settings = learner.settings
    steps = BASELINES[name](
        learner.environment,
        expert_of(learner),
        answers=settings.most_answers,
        seed=settings.seed,
        max_steps=settings.rollouts.max_steps,
    )
    entries: list[dict[str, Any]] = []
    began = time.perf_counter()
    for step in steps:
        learned = time.perf_counter()
        evaluated = learner.cycle.evaluated(step.policy)
        value, ended = float(evaluated.total.mean()), time.perf_counter()
        entries.append(
            {
                "iteration": step.answers,
                "answers": step.answers,
                "pairs": step.pairs,
                "value": value,
                "value_newest": value,
                "terminated": float(evaluated.terminated.mean()),
                "seconds": {"utility": learned - began, "improvement": 0.0, "evaluation": ended - learned},
            }
        )
        began = time.perf_counter()
    if not entries:
        raise ValueError(f"baseline {name}: expected an answer, got none: all questions were skipped")
    content = {"env": settings.env, "utility": name, "seed": settings.seed, "iterations": entries}
    write_file(directory / BASELINE_FILE, json.dumps(content, indent=1) + "\n")


def read_baseline(directory: Path | str) -> dict[str, Any]:
    """What `measure_baseline` wrote, in the form of a run's summary.

    Raises:
      ValueError: no such file, or a damaged one.
    """
    file = Path(directory) / BASELINE_FILE
    try:
        content = json.loads(file.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{file}: expected the values of a baseline, got {error}") from error
    return checked_trial(content, file)
