"""Each answer of a study's runs with the probability that the learner gave it beforehand: `answers.csv`."""

from concurrent.futures import BrokenExecutor
from pathlib import Path

import pandas as pd

from bayespbrl.diagnostics.report.contents import read_contents
from bayespbrl.models.threads import cores
from bayespbrl.preferences import Answer
from bayespbrl.results.study_data import ANSWER_COLUMNS
from bayespbrl.studies.processes import trial_processes
from bayespbrl.studies.study import Study

FEW = 8  # runs that are not worth a process


def write_predictions(study: Study, out: Path) -> list[str]:
    """Write `answers.csv` of the finished trials: predictions by the posterior at the time of the question.

    The first iteration, which has no posterior, and answers that state no preference are left out. What the file has of
    trials whose run directories are gone or damaged stays. To read a run takes seconds, so where there are many, each
    core has a process.

    Args:
      study: the study.
      out: the directory to write to.

    Returns:
      what could not be read, a line each.

    Raises:
      ValueError: the processes die, as in a script that is not guarded by `if __name__ == "__main__":`.
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
        try:
            with trial_processes(cores()) as processes:
                predicted = list(processes.map(_predicted, paths))
        except BrokenExecutor as error:
            raise ValueError(
                f"expected processes that read the runs, got none ({error}); in a script of your own, call this under "
                '`if __name__ == "__main__":`'
            ) from error
    whole = [
        (levels, seed, answers)
        for (levels, seed, _), (answers, damage) in zip(runs, predicted, strict=True)
        if not damage
    ]
    lines = [[*levels, seed, *answer] for levels, seed, answers in whole for answer in answers]
    read = study.trials_with(False) | {(levels, seed) for levels, seed, _ in whole}
    table = pd.DataFrame(lines, columns=ANSWER_COLUMNS)
    study.write_lines("answers.csv", table, read, out)
    return [f"{path}: {damage}" for path, (_, damage) in zip(paths, predicted, strict=True) if damage]


def _predicted(run: Path) -> tuple[list[tuple[int, int, float, bool]], str]:
    """Question, iteration, prediction and whether "first" was answered, of each answer; what is damaged.

    The study was opened before, so that the package of its environment may be imported here too.
    """
    contents = read_contents(run, import_package=True)
    answers = [
        (answer.question, answer.iteration, answer.predicted, answer.answer is Answer.FIRST)
        for answer in contents.scored
    ]
    return answers, " ".join(warning.what for warning in contents.damage)
