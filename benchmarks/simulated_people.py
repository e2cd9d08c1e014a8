"""Simulated people: whether lapse rates and side biases are found, and what they are worth for predictions.

    python benchmarks/simulated_people.py [--drawn] [--runs 200] [--seed 4000] [--out FILE.csv]

Each run draws a utility w ~ N(0, I) over items with five features, scaled so that margins have the prior standard
deviation 1. Two people answer forty random questions in turn. Both are Bradley-Terry answerers of steepness 5 who call
margins "no difference" by a threshold of one third, and favour the side shown first by 0.5 nats. One never lapses; 40 %
of the other's answers are given at random, each of the three equally probable. The model infers all of it. It is
compared with the same model without these parts: no ties, no side bias, and one lapse rate, which is inferred too.

With `--drawn`, steepness, threshold, biases and lapse rates of each run are drawn from the priors of the model. Then
90 % of the intervals must hold the true value, but for the lapse rate's values, which are few. At fixed values near the
middle of a prior more of them do.

A row is appended for each run as it ends: means and 90 % intervals, and for both models the log score of 200 further
answers of the two people (100 each) about new items, given that they state an order. A second call does only the runs
that are missing. At the end it prints how many intervals hold the true value and the difference of the log scores.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr
from rows_by_seed import run
from scipy import stats
from scipy.special import expit

from bayespbrl.diagnostics import answer_probabilities
from bayespbrl.models import Answers, PreferenceModel, posterior_draws, priors
from bayespbrl.results.intervals import failed_trials

ANSWERS, HELD_OUT, DIMENSION = 40, 200, 5
STEEPNESS, THRESHOLD, BIAS_NATS, LAPSE_RATES = 5.0, 1 / 3, 0.5, (0.0, 0.4)
MODEL = PreferenceModel(steepness=None, lapse_rate=None, likelihood="logistic")
PREFERRED, DOMINATED = 0, 1
RESULTS = Path(__file__).parent / "results"
QUANTITIES = ("lapse rate 0", "lapse rate 1", "side bias 0", "side bias 1")
ENDS = ("true", "mean", "lower", "upper")
COLUMNS = [
    "seed",
    "drawn",
    *(f"{name} {end}" for name in QUANTITIES for end in ENDS),
    *("ties", "log score", "log score without", "stated", "converged", "converged without"),
]


@dataclass(frozen=True)
class People:
    """The two people; all is in units of the margin.

    Attributes:
      steepness, threshold: of both.
      lapse_rates, biases: of each.
    """

    steepness: float = STEEPNESS
    threshold: float = THRESHOLD
    lapse_rates: tuple[float, float] = LAPSE_RATES
    biases: tuple[float, float] = (BIAS_NATS / STEEPNESS, BIAS_NATS / STEEPNESS)

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "People":
        """From the priors of the model."""

        def one(prior: priors.Grid) -> float:
            return float(rng.choice(prior.values, p=prior.probabilities))

        bias, second = rng.normal(0, priors.SIDE_BIAS_SCALE, 2)
        lapses = (one(priors.LAPSE_RATE), one(priors.LAPSE_RATE))
        return cls(one(priors.STEEPNESS), one(priors.TIE_THRESHOLD), lapses, (bias, second))

    def answers(self, rng: np.random.Generator, margins: np.ndarray, who: np.ndarray) -> np.ndarray:
        """1 the first shown, −1 the second, 0 no difference."""
        lapsed, at_random, drawn = rng.random((3, len(margins)))
        margins = margins + np.array(self.biases)[who]
        # Bradley & Terry (1952), with the threshold of Rao & Kupper (1967)
        first, second = (expit(self.steepness * (side * margins - self.threshold)) for side in (1, -1))
        answer = np.where(drawn < first, 1, np.where(drawn < first + second, -1, 0))
        return np.where(lapsed < np.array(self.lapse_rates)[who], np.floor(3 * at_random).astype(int) - 1, answer)


@dataclass(frozen=True)
class Questions:
    """Answers to n questions about two items each.

    Attributes:
      differences: features of the first shown less those of the second, shape (n, D).
      who: 0 or 1.
      answer: 1 the first, −1 the second, 0 no difference.
    """

    differences: np.ndarray
    who: np.ndarray
    answer: np.ndarray

    @property
    def rows(self) -> np.ndarray:
        """Features of the preferred less those of the other; as shown where neither is."""
        return np.where(self.answer[:, None] < 0, -1, 1) * self.differences

    @property
    def sides(self) -> np.ndarray:
        """1 where the row's first was shown first."""
        return np.where(self.answer < 0, -1, 1)

    def of(self, chosen: np.ndarray) -> "Questions":
        """Some of them."""
        return Questions(self.differences[chosen], self.who[chosen], self.answer[chosen])


def asked(rng: np.random.Generator, weights: np.ndarray, people: People, number: int) -> Questions:
    """Random questions, which the two people answer in turn."""
    differences = rng.normal(size=(number, len(weights))) / np.sqrt(len(weights))
    who = np.arange(number) % 2
    return Questions(differences, who, people.answers(rng, differences @ weights, who))


def one_run(seed: int, *, drawn: bool = False) -> dict[str, float]:
    """The figures of one run, as the columns name them."""
    rng = np.random.default_rng([seed, 21])
    weights, people = rng.normal(size=DIMENSION), People.drawn(rng) if drawn else People()
    known, later = (asked(rng, weights, people, number) for number in (ANSWERS, HELD_OUT))
    stated, order = known.of(known.answer != 0), later.of(later.answer != 0)
    answers = Answers(known.answer == 0, known.sides, known.who)
    tree = posterior_draws(known.rows, MODEL, seed=seed, answers=answers)
    without = posterior_draws(stated.rows, MODEL, seed=seed)
    posterior = tree["posterior"].dataset
    true = dict(zip(QUANTITIES, (*people.lapse_rates, *people.biases), strict=True))
    figures: dict[str, float] = {"seed": seed, "ties": float(np.mean(known.answer == 0)), "stated": len(order.answer)}
    for name in QUANTITIES:
        draws = posterior[name[:-2].replace(" ", "_")].values[:, :, int(name[-1])]
        values = (true[name], draws.mean(), *np.quantile(draws, [0.05, 0.95]))
        figures |= {f"{name} {end}": float(value) for end, value in zip(ENDS, values, strict=True)}
    figures["log score"] = _log_score(tree, order, Answers(None, order.sides, order.who))
    figures["log score without"] = _log_score(without, order, Answers())
    figures |= {"converged": tree.attrs["converged"], "converged without": without.attrs["converged"]}
    return figures


def _log_score(tree: xr.DataTree, order: Questions, answers: Answers) -> float:
    """Mean log probability of the stated orders, given that an order is stated; NaN where none is."""
    if not len(order.answer):
        return float("nan")
    probabilities = answer_probabilities(tree, order.rows, answers)
    return float(np.mean(np.log(probabilities[:, PREFERRED] / probabilities[:, [PREFERRED, DOMINATED]].sum(axis=1))))


def show(rows: Sequence[dict[str, float]]) -> None:
    """Print coverage and the difference of the log scores."""
    print(f"{len(rows)} runs, {sum(row['converged'] for row in rows):g} converged")
    for name in QUANTITIES:
        held = sum(row[f"{name} lower"] <= row[f"{name} true"] <= row[f"{name} upper"] for row in rows)
        share = failed_trials(held, len(rows))  # the exact interval of any share
        truth, mean = (np.mean([row[f"{name} {end}"] for row in rows]) for end in ("true", "mean"))
        print(f"{name}: true {truth:.2f}, posterior mean {mean:.2f} (means over the runs); ", end="")
        print(f"covered {share.estimate:.3f} [{share.low:.3f}, {share.high:.3f}]")
    rows = [row for row in rows if row["stated"]]
    gain = np.array([row["log score"] - row["log score without"] for row in rows])
    reach = stats.t.ppf(0.975, len(gain) - 1) * gain.std(ddof=1) / np.sqrt(len(gain))
    without = np.mean([row["log score without"] for row in rows])
    print(f"{len(rows)} runs in which an order was stated afterwards: ", end="")
    print(f"log score an answer {without + gain.mean():.4f}, without these parts {without:.4f}")
    print(f"difference {gain.mean():.4f} [{gain.mean() - reach:.4f}, {gain.mean() + reach:.4f}] (paired, 95 %)")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--drawn", action="store_true", help="draw the people from the priors")
    parser.add_argument("--seed", type=int, default=4000)
    parser.add_argument("--out", type=Path)
    chosen = parser.parse_args()
    out = chosen.out or RESULTS / f"simulated-people{'-drawn' if chosen.drawn else ''}.csv"
    seeds = range(chosen.seed, chosen.seed + chosen.runs)
    show(run(seeds, out, COLUMNS, partial(one_run, drawn=chosen.drawn), {"drawn": float(chosen.drawn)}))
