"""Does the default learn worse than the last version without it, with the options of that version's best rows?

    git worktree add /tmp/earlier 49879bc
    bayespbrl study earlier-version --out runs/earlier-version
    python benchmarks/earlier_version.py --checkout /tmp/earlier --jobs 2 --study runs/earlier-version
    python benchmarks/earlier_version.py   # the table, from the committed rows

On the paper's four tasks with 12 answers, twenty pairs of trials each: the value of what a version returns, a mean of
100 episodes without the noise of the actions. The earlier version returns its newest policy, the default the one that
it keeps. The study declares seeds, answers and the value below which a trial has failed. p is Wilcoxon's, adjusted by
Holm's method for the tasks.

Trials go on where they were stopped, one process each.
"""

import argparse
import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from rows_by_seed import done, run

from bayespbrl.results.intervals import holm, paired_difference
from bayespbrl.results.study_data import read_study
from bayespbrl.results.tables import markdown, median_and_quartile
from bayespbrl.studies.declaration import declared
from bayespbrl.studies.processes import ONE_THREAD

HERE = Path(__file__).parent
DECLARED = declared("earlier-version")
ROWS = {row.levels[0]: row for row in DECLARED.rows}  # by task
SEEDS = range(DECLARED.seed, DECLARED.seed + DECLARED.trials)
COLUMNS = ("seed", "answers", "iterations", "value", "with_noise")


def rows_of(task: str, results: Path) -> Path:
    """Where the earlier version's rows of a task are."""
    return results / f"earlier-version-{task}.csv"


def trial(seed: int, *, task: str, checkout: Path) -> dict[str, float]:
    """The figures of one trial of the earlier version, in a process that imports that version."""
    answers = ROWS[task].options["answers"]
    command = [sys.executable, str(HERE / "earlier_version_trial.py"), task, str(seed), str(answers)]
    variables = os.environ | ONE_THREAD | {"PYTHONPATH": str(checkout)}
    printed = subprocess.run(command, env=variables, check=True, stdout=subprocess.PIPE, text=True).stdout
    return {name: float(value) for name, value in json.loads(printed.splitlines()[-1]).items()}


def table(study: Path, results: Path) -> pd.DataFrame:
    """A line for each task of which both versions have trials."""
    lines, p_values = [], []
    for row in read_study(study).rows:
        task = row.declared.levels[0]
        earlier = {int(line["seed"]): line for line in done(rows_of(task, results), COLUMNS)}
        if not earlier:
            continue
        kept = dict(zip(row.seeds, row.final, strict=True))
        seeds = sorted(set(kept) & set(earlier))
        values = {
            "earlier": np.array([earlier[seed]["value"] for seed in seeds]),
            "with noise": np.array([earlier[seed]["with_noise"] for seed in seeds]),
            "default": np.array([kept[seed] for seed in seeds]),
        }
        difference, p = paired_difference(values["default"], values["earlier"])
        p_values.append(p)
        line = {"task": task, "pairs": str(len(seeds))}
        for name, of in values.items():
            line[name] = f"{median_and_quartile(of)}, {(of < ROWS[task].failed_below).sum()} fail"
        lines.append(line | {"default − earlier": "{:.3g} [{:.3g}, {:.3g}]".format(*difference)})
    return pd.DataFrame(lines).assign(p=[f"{p:.2g}" for p in holm(p_values)])


def main() -> None:
    """Run the trials that are missing, if there is a checkout to run, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkout", type=Path, help="a working tree of commit 49879bc")
    parser.add_argument("--tasks", nargs="+", choices=ROWS, default=list(ROWS))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--study", type=Path, default=HERE / "studies" / "earlier-version", help="of the default")
    parser.add_argument("--results", type=Path, default=HERE / "results", help="where the earlier version's rows are")
    chosen = parser.parse_args()
    for task in chosen.tasks if chosen.checkout else ():
        one_trial = partial(trial, task=task, checkout=chosen.checkout.resolve())
        run(SEEDS, rows_of(task, chosen.results), COLUMNS, one_trial, jobs=chosen.jobs)
        print(f"{task}: {len(SEEDS)} trials", flush=True)
    print(markdown(table(chosen.study, chosen.results)))


if __name__ == "__main__":
    main()
