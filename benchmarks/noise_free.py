"""Where a policy without its noise may stay for good: does it help to show it?

    python benchmarks/noise_free.py [--trials 20] [--seed 3561] [--jobs 2] [--out FILE.csv]

FrozenLake-v1 that does not slip, as an object of the user's: the goal ends an episode with 1, and whoever runs into a
wall all the time has 0. A policy with its noise does not stay at a wall, but runs keep policies without. Each trial is
a pair of runs of the default with at most 20 answers, with `noise_free` as it is where states are discrete and without;
the value is that of the policy a run keeps, so 0 or 1.

A row is appended for each pair as it ends; a second call does only those that are missing. At the end it prints how
many trials of each reach the goal, with exact intervals, and the sign test of the pairs.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import gymnasium
import pandas as pd
from rows_by_seed import run

import bayespbrl
from bayespbrl.results.intervals import failed_trials, sign_test
from bayespbrl.results.tables import markdown

RESULTS = Path(__file__).parent / "results" / "noise-free.csv"
SHOWN = {"shown": True, "not shown": False}
COLUMNS = ("seed", *(f"{name} {which}" for which in SHOWN for name in ("answers", "value", "best value")))


def pair(seed: int) -> dict[str, float]:
    """The figures of both runs of one seed, as the columns name them."""
    figures: dict[str, float] = {"seed": seed}
    for which, noise_free in SHOWN.items():
        environment = gymnasium.make("FrozenLake-v1", is_slippery=False)
        learner = bayespbrl.Learner(environment, answers=20, seed=seed, noise_free=noise_free)
        iterations = learner.run(bayespbrl.ReturnExpert()).iterations
        figures |= {f"{name} {which}": iterations[-1][name] for name in ("answers", "value")}
        figures[f"best value {which}"] = max(each["value_newest"] for each in iterations)
    return figures


def show(rows: Sequence[dict[str, float]]) -> None:
    """Print shares, numbers of answers and the test."""
    table = pd.DataFrame(rows)
    lines = []
    for which in SHOWN:
        reached = int((table[f"value {which}"] == 1).sum())
        share, low, high = failed_trials(reached, len(table))  # the exact interval of any share
        lines.append(
            {
                "without noise": which,
                "pairs": str(len(table)),
                "kept policy reaches the goal": f"{reached} ({share:.2f} [{low:.2f}, {high:.2f}])",
                "some policy did": str(int((table[f"best value {which}"] == 1).sum())),
                "answers, median": f"{table[f'answers {which}'].median():g}",
            }
        )
    print(markdown(pd.DataFrame(lines)))
    difference = table["value shown"] - table["value not shown"]
    less, more = int((difference < 0).sum()), int((difference > 0).sum())
    print(f"\nShown better in {more} pairs and worse in {less}: p = {sign_test(less, more):.2g}")


def main() -> None:
    """Run the pairs that are missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--seed", type=int, default=3561, help="of the first trial")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=RESULTS)
    chosen = parser.parse_args()
    show(run(range(chosen.seed, chosen.seed + chosen.trials), chosen.out, COLUMNS, pair, jobs=chosen.jobs))


if __name__ == "__main__":
    main()
