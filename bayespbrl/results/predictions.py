"""Each answer of a study's runs with the probability that the learner gave it beforehand: `answers.csv`."""

import os
from pathlib import Path

import numpy as np
import pandas as pd

from bayespbrl.diagnostics.report.contents import read_contents
from bayespbrl.preferences import Answer
from bayespbrl.results.study_data import ANSWER_COLUMNS
from bayespbrl.runs.files import write_file
from bayespbrl.studies.processes import trial_processes
from bayespbrl.studies.study import Study

FEW = 8  # runs that are not worth a process


def write_predictions(study: Study) -> Path:
    """Write `answers.csv` of the finished trials: predictions by the posterior at the time of the question.

    The first iteration, which has no posterior, and answers that state no preference are left out. To read a run takes
    seconds, so where there are many, each core has a process.
    """
    runs = [
        (declared.levels, seed, seeds.row.path(seed))
        for declared, seeds in zip(study.declaration.rows, study.rows, strict=True)
        if not declared.untrained and declared.baseline is None
        for seed in seeds.with_outcome(True)
    ]
    paths = [path for _, _, path in runs]
    if len(runs) <= FEW:
        predicted = [_predicted(path) for path in paths]
    else:
        with trial_processes(os.cpu_count() or 1) as processes:
            predicted = list(processes.map(_predicted, paths))
    lines = [
        [*levels, seed, *answer]
        for (levels, seed, _), answers in zip(runs, predicted, strict=True)
        for answer in answers
    ]
    file = study.directory / "answers.csv"
    table = pd.DataFrame(lines, columns=ANSWER_COLUMNS)
    write_file(file, table.to_csv(index=False, lineterminator="\n", float_format="%.6g"))
    return file


def _predicted(run: Path) -> list[tuple[int, int, float, bool]]:
    return [
        (answer.question, answer.iteration, answer.predicted, answer.answer is Answer.FIRST)
        for answer in read_contents(run).answers
        if answer.iteration > 1 and answer.row is not None and np.isfinite(answer.predicted)
    ]
