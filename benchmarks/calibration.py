"""Calibration of the predicted answers of many runs: was each answer as probable as the learner said beforehand?

    bayespbrl trials swing-up --trials 10 --seed 3000 --out runs/swing-up
    python benchmarks/calibration.py runs/swing-up runs/gridworld …

Each argument is a run directory or a folder of them, and becomes one row. An answer is predicted by the posterior that
the learner had when it asked: which of the two is preferred, given that either is. The first iteration, in which it had
none, is left out. `z` is the log score less its
expectation under the predictions themselves, in standard deviations: below −2 the predictions are overconfident. `ECE`
is the expected calibration error over bins of width 0.1 of the confidence, beside that of calibrated predictions by
chance. The last column is the share of right predictions among those stated with at least 0.95.

Two more tables follow, of the updates of all studies: how often an update was a gain of the hidden value, by the share
of the posterior draws that called it one (agreement), and by the schedule's signal. Runs with a constant bound have
neither.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

from bayespbrl.diagnostics import gain_calibration
from bayespbrl.diagnostics.report.contents import read_contents
from bayespbrl.preferences import Answer
from bayespbrl.results.tables import calibration_line, markdown
from bayespbrl.runs.directory import read_summary


def run_directories(study: Path) -> list[Path]:
    """The run directory itself, or those in it, however deep."""
    if (study / "settings.json").exists():
        return [study]
    runs = sorted(path.parent for path in study.rglob("summary.json"))
    if not runs:
        raise ValueError(f"{study}: expected a run directory or a folder with a finished iteration, got none")
    return runs


def predictions(study: Path) -> tuple[np.ndarray, np.ndarray, int]:
    """Probability that the first shown is preferred, whether it was, for all answers of a study; number of runs."""
    runs = run_directories(study)
    decided = [answer for run in runs for answer in read_contents(run).scored]
    predicted = np.array([answer.predicted for answer in decided])
    return predicted, np.array([answer.answer is Answer.FIRST for answer in decided], dtype=bool), len(runs)


def row(study: Path) -> dict[str, str]:
    """One line of the table."""
    predicted, observed, runs = predictions(study)
    return {"study": study.name, "runs": str(runs)} | calibration_line(np.clip(predicted, 0, 1), observed)


def print_gains(studies: list[str], statistic: str) -> None:
    """How often an update was a gain, by a statistic of the schedule."""
    runs = [read_summary(run)["iterations"] for study in studies for run in run_directories(Path(study))]
    result = gain_calibration(runs, statistic)
    print(f"\n| {statistic} | updates | stated | gained ± standard error |\n|---|---|---|---|")
    for n in np.flatnonzero(result["updates"].values > 0):
        one = {name: float(values[n]) for name, values in result.data_vars.items()}
        shares = f"{one['stated']:.2f} | {one['gained']:.2f} ± {one['standard_error']:.2f}"
        print(f"| {one['lower']:g}–{one['upper']:g} | {one['updates']:.0f} | {shares} |")


def main() -> None:
    """Print the tables as markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studies", nargs="+", help="a run directory, or a folder of them")
    studies = parser.parse_args().studies
    try:
        print(markdown(pd.DataFrame([row(Path(study)) for study in studies])), flush=True)
        for statistic in ("agreement", "signal"):
            print_gains(studies, statistic)
    except ValueError as error:
        parser.exit(2, f"{parser.prog}: {error}\n")


if __name__ == "__main__":
    main()
