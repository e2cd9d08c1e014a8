"""Studies side by side, seed by seed: what their `trials.csv` say about learning.

    python benchmarks/compare.py runs/a runs/b … [--floor -4680] [--ceiling runs/known-reward] [--lost -1300]

The first study is the one that the others are compared with. For each: the median and lower quartile of the value at
some numbers of answers and at the end; how many trials are lost, which is to end below `--lost`; the answers at which
median and lower quartile of the relative value (specification, section 1: (value − floor) / (ceiling − floor)) first
reach 0.95, with 95 % bootstrap intervals, and the iterations at which they do; the first study's answers until its
lower quartile does, as a share of this study's; the median of the answers that a trial took; and the median difference
to the first study, after as many answers as every trial of both gave and at the end. Shares and differences are over
the same seeds, with 95 % bootstrap intervals. Answers are those given before the next question: where an iteration
asked nothing, what it learnt counts for the answers before. A study is a directory of `bayespbrl trials` or its table,
or several with different seeds, `a+b`, of which as many iterations count as all have. The floor is the random policy's
value; the ceiling a number, or a study with the known reward, whose median it is.
"""

import argparse
import csv
from pathlib import Path

import numpy as np

from bayespbrl.studies.tables import by_answers

COLUMNS = (6, 8, 10, 15, 20, 30)
REACHED = 0.95


class Study:
    """Values over (seed, iteration) and over (seed, answers).

    After so many answers a trial has the last policy before it asked for more, or ended.
    """

    def __init__(self, path: str):
        tables = [Path(part) / "trials.csv" if Path(part).is_dir() else Path(part) for part in path.split("+")]
        self.name = "+".join(table.parent.name if table.name == "trials.csv" else table.stem for table in tables)
        rows: dict[int, dict[int, tuple[int, float]]] = {}
        for table in tables:
            before = set(rows)
            with table.open() as lines:
                for row in csv.DictReader(lines):
                    if int(row["seed"]) in before:
                        raise ValueError(f"{path}: expected tables with different seeds, got seed {row['seed']} twice")
                    seed = rows.setdefault(int(row["seed"]), {})
                    seed[int(row["iteration"])] = int(row["answers"]), float(row["value"])
        self.seeds = sorted(rows)
        common = min(map(len, rows.values()))
        kept = [[rows[seed][iteration] for iteration in sorted(rows[seed])[:common]] for seed in self.seeds]
        answers = np.array([[answers for answers, _ in trial] for trial in kept])
        self.by_iteration = np.array([[value for _, value in trial] for trial in kept])
        self.used = answers[:, -1]
        self.answers, self.values = by_answers(answers, self.by_iteration)

    def at(self, answers: float) -> np.ndarray:
        """The value of each trial once so many answers are in; its last where it gave fewer."""
        return self.values[:, np.flatnonzero(self.answers <= answers)[-1]]


def shared(*studies: Study) -> list[list[int]]:
    """For each study the rows of the seeds that all of them have, in one order."""
    seeds = sorted(set.intersection(*(set(study.seeds) for study in studies)))
    return [[study.seeds.index(seed) for seed in seeds] for study in studies]


def resampled(number: int) -> np.ndarray:
    """Rows of the bootstrap, the same whenever there are as many trials; shape (samples, number)."""
    return np.random.default_rng(0).integers(number, size=(10_000, number))


def first(numbers: np.ndarray, values: np.ndarray, value: float, quantile: float) -> np.ndarray:
    """The first of `numbers`, one a column, at which a quantile over the rows is `value` or more; inf if none is.

    `values` may be a stack of tables, (…, trials, columns).
    """
    reached = np.quantile(values, quantile, axis=-2) >= value
    return np.where(reached.any(axis=-1), numbers[reached.argmax(axis=-1)], np.inf)


def answers_to(study: Study, value: float, quantile: float) -> str:
    """The first number of answers at which a quantile of the value is `value` or more, with its bootstrap interval."""
    samples = first(study.answers, study.values[resampled(len(study.seeds))], value, quantile)
    low, high = np.quantile(samples, [0.025, 0.975], method="inverted_cdf")
    return f"{told(first(study.answers, study.values, value, quantile))} [{told(low)}, {told(high)}]"


def iterations_to(study: Study, value: float, quantile: float) -> str:
    """The first iteration at which it is."""
    return told(first(1 + np.arange(study.by_iteration.shape[1]), study.by_iteration, value, quantile))


def told(number: float | np.ndarray) -> str:
    return f"{number:g}" if np.isfinite(number) else "never"


def share_of_answers(study: Study, reference: Study, value: float) -> str:
    """The answers until the lower quartile of `reference` is at `value`, as a share of `study`'s, over the same seeds.

    Where the study's is never there the share is 0, and where the reference's is not there is none.
    """
    rows, of_reference = shared(study, reference)
    if not rows:
        return "–"
    values, before = study.values[rows], reference.values[of_reference]

    def share(values: np.ndarray, before: np.ndarray) -> np.ndarray:
        needed = first(study.answers, values, value, 0.25)
        by_reference = first(reference.answers, before, value, 0.25)
        with np.errstate(invalid="ignore"):  # where neither is ever there
            return np.where(np.isfinite(by_reference), by_reference / needed, np.inf)

    found, chosen = share(values, before), resampled(len(rows))
    low, high = np.quantile(share(values[chosen], before[chosen]), [0.025, 0.975], method="inverted_cdf")
    return f"{found:.2f} [{low:.2f}, {high:.2f}]" if np.isfinite(found) else "–"


def paired(study: Study, reference: Study, answers: float) -> str:
    """The median difference after so many answers, over the seeds of both, with its bootstrap interval."""
    rows, of_reference = shared(study, reference)
    if not rows or answers < max(study.answers[0], reference.answers[0]):
        return "–"
    differences = study.at(answers)[rows] - reference.at(answers)[of_reference]
    low, high = np.quantile(np.median(differences[resampled(len(rows))], axis=1), [0.025, 0.975])
    return f"{np.median(differences):+.1f} [{low:+.1f}, {high:+.1f}]"


def summary(values: np.ndarray | None) -> str:
    """Median [lower quartile] over trials."""
    return "–" if values is None else f"{np.median(values):.4g} [{np.quantile(values, 0.25):.4g}]"


def ceiling_of(number_or_study: str) -> float:
    """A number, or the median of what a study ends with."""
    try:
        return float(number_or_study)
    except ValueError:
        return float(np.median(Study(number_or_study).values[:, -1]))


def main() -> None:
    """Read the studies and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studies", nargs="+")
    parser.add_argument("--floor", type=float, help="value of the random policy")
    parser.add_argument("--ceiling", help="value, or study, of the known reward")
    parser.add_argument("--lost", type=float, help="a trial that ends below is lost")
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
    most = max(np.median(study.used) for study in studies)
    columns = [answers for answers in COLUMNS if answers < most]
    names = [f"after {answers}" for answers in columns]
    names += ["at the end", "lost", "median at 0.95", "lower quartile at 0.95", "in iterations", "the first's share"]
    names += ["answers in all", "paired difference", "paired at the end"]
    print("| study | trials | " + " | ".join(names) + " |")
    print("|---|" + "---|" * (len(names) + 1))
    for study in studies:
        begun, ended = study.answers[0], np.median(study.used)
        cells = [study.at(answers) if begun <= answers <= ended else None for answers in columns]
        row = [summary(cell) for cell in [*cells, study.values[:, -1]]]
        row.append("–" if options.lost is None else str(int(np.sum(study.values[:, -1] < options.lost))))
        if reached is None:
            row += ["–", "–", "–", "–"]
        else:
            row += [answers_to(study, reached, quantile) for quantile in (0.5, 0.25)]
            row.append("; ".join(iterations_to(study, reached, quantile) for quantile in (0.5, 0.25)))
            row.append("–" if study is studies[0] else share_of_answers(study, studies[0], reached))
        row.append(f"{np.median(study.used):g}")
        both = min(*study.used, *studies[0].used)
        row += ["–", "–"] if study is studies[0] else [paired(study, studies[0], end) for end in (both, np.inf)]
        print(f"| {study.name} | {len(study.seeds)} | " + " | ".join(row) + " |")


if __name__ == "__main__":
    main()
