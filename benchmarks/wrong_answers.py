"""A fifth of the answers wrong: is the lapse rate found, and do the predicted answers stay calibrated?

    python benchmarks/wrong_answers.py [--wrong 0.2] [--runs 100] [--seed 4400] [--out FILE.csv]

Each run draws a utility w ~ N(0, I) over items with five features, scaled so that margins have the prior standard
deviation 1, and 26 random pairs of items. The answerer orders each pair by the utility, and every answer is turned
round with the given probability: the lapse rate is twice that. The model infers it and the steepness, with the
likelihood of eq. 8. After 3, 6, 10, 15, 20 and 25 answers the next one is predicted. A file is of one probability.

A row is appended for each run as it ends; a second call does only the runs that are missing. At the end it prints how
many 90 % intervals of the lapse rate hold the true value, and the calibration of the predictions of all runs.
"""

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from rows_by_seed import run

from bayespbrl.diagnostics import answer_probabilities
from bayespbrl.models import PreferenceModel, posterior_draws
from bayespbrl.results.intervals import failed_trials
from bayespbrl.results.tables import calibration_line, markdown

DIMENSION, ANSWERS, MARKS = 5, 26, (3, 6, 10, 15, 20, 25)
MODEL = PreferenceModel(steepness=None, lapse_rate=None)
RESULTS = Path(__file__).parent / "results" / "wrong-answers.csv"
COLUMNS = [
    *("seed", "wrong", "given wrong", "mean", "lower", "upper", "converged"),
    *(f"{name} {mark}" for mark in MARKS for name in ("predicted", "came")),
]


def one_run(seed: int, *, wrong: float) -> dict[str, float]:
    """The figures of one run, as the columns name them."""
    rng = np.random.default_rng([seed, 22])
    weights, differences = rng.normal(size=DIMENSION), rng.normal(size=(ANSWERS, DIMENSION)) / np.sqrt(DIMENSION)
    turned = rng.random(ANSWERS) < wrong
    came = (differences @ weights > 0) != turned  # whether the first of each pair is preferred
    rows = np.where(came[:, None], 1, -1) * differences
    tree = posterior_draws(rows, MODEL, seed=seed)
    converged, draws = bool(tree.attrs["converged"]), tree["posterior"].dataset["lapse_rate"].values
    figures = {"seed": seed, "wrong": wrong, "given wrong": float(turned.mean()), "mean": float(draws.mean())}
    figures |= dict(zip(("lower", "upper"), np.quantile(draws, [0.05, 0.95]).tolist(), strict=True))
    for mark in MARKS:
        before = posterior_draws(rows[:mark], MODEL, seed=seed)
        converged &= bool(before.attrs["converged"])
        probability = answer_probabilities(before, differences[mark : mark + 1])[0, 0]
        figures |= {f"predicted {mark}": float(probability), f"came {mark}": float(came[mark])}
    return figures | {"converged": float(converged)}


def show(rows: Sequence[dict[str, float]]) -> None:
    """Print coverage and calibration."""
    true = 2 * rows[0]["wrong"]
    held = sum(row["lower"] <= true <= row["upper"] for row in rows)
    share = failed_trials(held, len(rows))  # the exact interval of any share
    print(f"{len(rows)} runs, {sum(row['converged'] for row in rows):g} with converged posteriors throughout")
    print(f"lapse rate: true {true:.2f}, posterior mean {np.mean([row['mean'] for row in rows]):.2f}; ", end="")
    print(f"covered {share.estimate:.3f} [{share.low:.3f}, {share.high:.3f}]")
    predicted = np.array([row[f"predicted {mark}"] for mark in MARKS for row in rows])
    came = np.array([bool(row[f"came {mark}"]) for mark in MARKS for row in rows])
    print(markdown(pd.DataFrame([calibration_line(predicted, came)])))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--wrong", type=float, default=0.2, help="share of wrong answers")
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=4400)
    parser.add_argument("--out", type=Path, default=RESULTS)
    chosen = parser.parse_args()
    if not 0 <= chosen.wrong <= 0.5:  # the lapse rate is twice that
        parser.error(f"--wrong: expected a number from 0 to 0.5, got {chosen.wrong}")
    seeds = range(chosen.seed, chosen.seed + chosen.runs)
    show(run(seeds, chosen.out, COLUMNS, partial(one_run, wrong=chosen.wrong), {"wrong": chosen.wrong}))
