"""A table of studies side by side, seed by seed, from their `trials.csv`.

    python benchmarks/compare.py runs/a runs/b … [--floor -4680] [--ceiling runs/known-reward] [--lost -1300]

A study is a directory of `bayespbrl trials`, or its table, or several with different seeds, `a+b`, of which as many
iterations count as all have. The first study is the reference. The columns:

after N, at the end    median [lower quartile] of the value
lost                   trials that end below `--lost`
median, lower quartile at 0.95
                       answers until it reaches 0.95 of the relative value, (value − floor) / (ceiling − floor)
in iterations          iterations until median and lower quartile do
the first's share      the reference's answers until its lower quartile does, as a share of this study's
answers in all         median over the trials
paired difference      median difference to the reference, after as many answers as all trials of both gave
paired at the end      the same at the end

Shares and differences are over the seeds that both studies have. Brackets after answers, shares and differences are
95 % bootstrap intervals. Answers are those given before the next question: what an iteration without a question learns
counts for the answers before it. The floor is the value of the random policy. The ceiling is a number, or a study of
the known reward, whose median it is.
"""

import argparse
import csv
from pathlib import Path

import numpy as np

from bayespbrl.studies.tables import by_answers

COLUMNS = (6, 8, 10, 15, 20, 30)
REACHED = 0.95


class Study:
    """The trials of one study.

    Attributes:
      name: of the directories or tables, joined by "+".
      seeds: in increasing order; rows of all tables below.
      by_iteration: values, shape (seeds, iterations).
      used: answers of each trial at its end.
      answers: numbers of answers, in increasing order.
      values: shape (seeds, answers): of the last policy before the trial asked for more, or ended.
    """

    def __init__(self, path: str):
        tables = [Path(part) / "trials.csv" if Path(part).is_dir() else Path(part) for part in path.split("+")]
        self.name = "+".join(table.parent.name if table.name == "trials.csv" else table.stem for table in tables)
        rows: dict[int, dict[int, tuple[int, float]]] = {}
        for table in tables:
            trials = read_trials(table)
            if twice := sorted(set(rows) & set(trials)):
                raise ValueError(f"{path}: expected tables with different seeds, got seed {twice[0]} twice")
            rows |= trials
        self.seeds = sorted(rows)
        common = min(map(len, rows.values()))
        kept = [[rows[seed][iteration] for iteration in sorted(rows[seed])[:common]] for seed in self.seeds]
        answers = np.array([[answers for answers, _ in trial] for trial in kept])
        self.by_iteration = np.array([[value for _, value in trial] for trial in kept])
        self.used = answers[:, -1]
        self.answers, self.values = by_answers(answers, self.by_iteration)

    def at(self, answers: float) -> np.ndarray:
        """Value of each trial after so many answers; its last if it gave fewer."""
        return self.values[:, np.flatnonzero(self.answers <= answers)[-1]]


def read_trials(table: Path) -> dict[int, dict[int, tuple[int, float]]]:
    """Answers and value by iteration, by seed."""
    trials: dict[int, dict[int, tuple[int, float]]] = {}
    with table.open() as lines:
        for row in csv.DictReader(lines):
            trial = trials.setdefault(int(row["seed"]), {})
            trial[int(row["iteration"])] = int(row["answers"]), float(row["value"])
    return trials


def shared(*studies: Study) -> list[list[int]]:
    """For each study, the rows of the seeds that all of them have, in one order."""
    seeds = sorted(set.intersection(*(set(study.seeds) for study in studies)))
    return [[study.seeds.index(seed) for seed in seeds] for study in studies]


def resampled(number: int) -> np.ndarray:
    """Bootstrap rows, the same for the same number of trials, shape (samples, number)."""
    return np.random.default_rng(0).integers(number, size=(10_000, number))


def first(numbers: np.ndarray, values: np.ndarray, value: float, quantile: float) -> np.ndarray:
    """The first of `numbers`, one a column, at which a quantile over the trials is at least `value`; inf if none is.

    Args:
      numbers: shape (columns,).
      values: a table or a stack of tables, shape (…, trials, columns).
      value: to be reached.
      quantile: over the trials.
    """
    reached = np.quantile(values, quantile, axis=-2) >= value
    return np.where(reached.any(axis=-1), numbers[reached.argmax(axis=-1)], np.inf)


def answers_to(study: Study, value: float, quantile: float) -> str:
    """Answers until a quantile of the value is at least `value`, with a bootstrap interval."""
    samples = first(study.answers, study.values[resampled(len(study.seeds))], value, quantile)
    low, high = np.quantile(samples, [0.025, 0.975], method="inverted_cdf")
    return f"{shown(first(study.answers, study.values, value, quantile))} [{shown(low)}, {shown(high)}]"


def iterations_to(study: Study, value: float, quantile: float) -> str:
    """Iterations until a quantile of the value is at least `value`."""
    return shown(first(1 + np.arange(study.by_iteration.shape[1]), study.by_iteration, value, quantile))


def shown(number: float | np.ndarray) -> str:
    """A number of answers or iterations."""
    return f"{number:g}" if np.isfinite(number) else "never"


def share_of_answers(study: Study, reference: Study, value: float) -> str:
    """The reference's answers until its lower quartile is at least `value`, as a share of the study's.

    Over the seeds of both. 0 if only the reference reaches it, "–" if the reference does not.
    """
    rows, of_reference = shared(study, reference)
    if not rows:
        return "–"
    values, before = study.values[rows], reference.values[of_reference]

    def share(values: np.ndarray, before: np.ndarray) -> np.ndarray:
        needed = first(study.answers, values, value, 0.25)
        by_reference = first(reference.answers, before, value, 0.25)
        with np.errstate(invalid="ignore"):  # where neither reaches it
            return np.where(np.isfinite(by_reference), by_reference / needed, np.inf)

    found, chosen = share(values, before), resampled(len(rows))
    low, high = np.quantile(share(values[chosen], before[chosen]), [0.025, 0.975], method="inverted_cdf")
    return f"{found:.2f} [{low:.2f}, {high:.2f}]" if np.isfinite(found) else "–"


def paired(study: Study, reference: Study, answers: float) -> str:
    """Median difference to the reference after so many answers, over shared seeds, with a bootstrap interval."""
    rows, of_reference = shared(study, reference)
    if not rows or answers < max(study.answers[0], reference.answers[0]):
        return "–"
    differences = study.at(answers)[rows] - reference.at(answers)[of_reference]
    low, high = np.quantile(np.median(differences[resampled(len(rows))], axis=1), [0.025, 0.975])
    return f"{np.median(differences):+.1f} [{low:+.1f}, {high:+.1f}]"


def summary(values: np.ndarray | None) -> str:
    """Median [lower quartile] over the trials."""
    return "–" if values is None else f"{np.median(values):.4g} [{np.quantile(values, 0.25):.4g}]"


def ceiling_of(number_or_study: str) -> float:
    """A number, or the median of a study's last values."""
    try:
        return float(number_or_study)
    except ValueError:
        return float(np.median(Study(number_or_study).values[:, -1]))


def cells(
    study: Study, reference: Study, *, columns: list[int], reached: float | None, lost: float | None
) -> list[str]:
    """One row of the table after name and number of trials.

    Args:
      study, reference: which is compared with which.
      columns: numbers of answers.
      reached: the value at 0.95 of the relative value; None where floor or ceiling is unknown.
      lost: a trial that ends below is lost; None: not counted.
    """
    begun, ended, last = study.answers[0], np.median(study.used), study.values[:, -1]
    row = [summary(study.at(answers) if begun <= answers <= ended else None) for answers in columns]
    row += [summary(last), "–" if lost is None else str(int(np.sum(last < lost)))]
    if reached is None:
        row += 4 * ["–"]
    else:
        row += [answers_to(study, reached, quantile) for quantile in (0.5, 0.25)]
        row.append("; ".join(iterations_to(study, reached, quantile) for quantile in (0.5, 0.25)))
        row.append("–" if study is reference else share_of_answers(study, reference, reached))
    row.append(f"{np.median(study.used):g}")
    if study is reference:
        return [*row, "–", "–"]
    both = min(*study.used, *reference.used)
    return [*row, *(paired(study, reference, answers) for answers in (both, np.inf))]


def print_table(studies: list[Study], *, reached: float | None, lost: float | None) -> None:
    """The table in markdown."""
    most = max(np.median(study.used) for study in studies)
    columns = [answers for answers in COLUMNS if answers < most]
    names = [f"after {answers}" for answers in columns]
    names += ["at the end", "lost", "median at 0.95", "lower quartile at 0.95", "in iterations", "the first's share"]
    names += ["answers in all", "paired difference", "paired at the end"]
    print("| study | trials | " + " | ".join(names) + " |")
    print("|---|" + "---|" * (len(names) + 1))
    for study in studies:
        row = cells(study, studies[0], columns=columns, reached=reached, lost=lost)
        print(f"| {study.name} | {len(study.seeds)} | " + " | ".join(row) + " |")


def main() -> None:
    """Read the studies and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studies", nargs="+")
    parser.add_argument("--floor", type=float, help="value of the random policy")
    parser.add_argument("--ceiling", help="value, or study, of the known reward")
    parser.add_argument("--lost", type=float, help="trials that end below this value are lost")
    options = parser.parse_args()
    try:
        studies = [Study(path) for path in options.studies]
        ceiling = None if options.ceiling is None else ceiling_of(options.ceiling)
    except (OSError, ValueError) as error:
        parser.error(str(error))
    reached = None
    if options.floor is not None and ceiling is not None:
        reached = options.floor + REACHED * (ceiling - options.floor)
        print(f"relative value {REACHED}: {reached:.4g}")
    print_table(studies, reached=reached, lost=options.lost)


if __name__ == "__main__":
    main()
