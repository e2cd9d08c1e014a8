"""Simulation-based calibration of the posterior in the loop that it is used in: adaptive questions, adaptive stopping.

    python benchmarks/simulation_based_calibration.py --runs 300 --jobs 2 [--ties] [--bug NAME] [--out FILE.csv]

In each run everything is drawn from the prior of the model: setting of the features, weights, steepness, lapse rate,
and with `--ties` the tie threshold. An answerer simulated by them answers questions about pairs of items that the
posterior of the answers so far chooses, those of highest expected information, until that is below a limit or there are
ten answers. The rank of each true value among the draws of the last posterior must then be uniform (Talts et al. 2018),
whatever was asked and whenever it ended. Eq. 8 is given its K beforehand, because the probability of an answer depends
on it.

Printed are, for each functional, the p-value of uniformity (χ², ten bins) and the smallest times their number
(Bonferroni). `--bug` plants one that must be rejected: `no-setting` (the setting is never moved), `no-volume` (its move
forgets the volume), `no-lapses` (the lapse rate is taken for zero), `one-steepness` (steepness is given, wrongly),
`narrow` (the weights outside the answers' span are half as wide).
"""

import argparse
import csv
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import xarray as xr
from scipy import stats

from bayespbrl.models import Answers, PreferenceModel, gibbs, low_rank, posterior_draws
from bayespbrl.models.likelihoods import likelihood_of, prob
from bayespbrl.models.posterior import SamplerOptions
from bayespbrl.queries import expected_information

ITEMS, DIMENSION, SETTINGS, MOST_ANSWERS, LEAST_INFORMATION, KEPT = 12, 8, 3, 10, 0.05, 99
MODEL = PreferenceModel(steepness=None, lapse_rate=None)
SAMPLER = SamplerOptions(num_samples=100, max_samples=100)
BUGS = ("no-setting", "no-volume", "no-lapses", "one-steepness", "narrow")
Ranks = dict[str, float]


def one_run(seed: int, bug: str = "", *, ties: bool = False) -> Ranks:
    """The rank of each true value, in [0, 1]."""
    _plant(bug)
    rng = np.random.default_rng([seed, 19])
    features = _features(rng)
    truth = _truth(rng)
    truth["threshold"] *= ties
    utilities = features[truth["setting"]] @ truth["weights"]
    pairs, tied = np.zeros((0, 2), int), np.zeros(0, bool)
    model = {
        "no-lapses": PreferenceModel(steepness=None, lapse_rate=0.0),
        "one-steepness": PreferenceModel(steepness=0.5, lapse_rate=None),
    }.get(bug, MODEL)
    while True:
        rows = features[:, pairs[:, 0]] - features[:, pairs[:, 1]]
        tree = posterior_draws(
            rows,
            model,
            seed=seed,
            answers=Answers(tied if ties else None),
            number_of_preferences=MOST_ANSWERS,
            sampler=SAMPLER,
        )
        drawn = tree["posterior"].dataset.isel(draw=slice(None, None, 2))
        asked = _pairs(rng, 8)
        settings, weights = drawn["setting"].values.ravel(), drawn["utility_weights"].values.reshape(-1, DIMENSION)
        margins = np.einsum("spd,sd->sp", (features[:, asked[:, 0]] - features[:, asked[:, 1]])[settings], weights)
        values = {name: drawn[name].values.reshape(len(settings), 1) for name in ("steepness", "lapse_rate")}
        likelihood = likelihood_of("mixed", float(MOST_ANSWERS), **values)
        information = expected_information(margins, np.zeros(len(margins)), likelihood=likelihood)
        best = int(np.argmax(information))
        if len(pairs) == MOST_ANSWERS or (len(pairs) > 3 and information[best] < LEAST_INFORMATION):
            break
        first, second = asked[best]
        answer = _answer(rng, float(utilities[first] - utilities[second]), truth)
        pairs = np.concatenate([pairs, [[first, second] if answer >= 0 else [second, first]]])
        tied = np.append(tied, answer == 0)
    compared = _compared(features, drawn, truth)
    chosen = rng.choice(len(settings), KEPT, replace=False)
    return {name: _rank(rng, sample[chosen], true) for name, (sample, true) in compared.items()}


def _features(rng: np.random.Generator) -> np.ndarray:
    """Of the items under each setting, shape (C, n, D)."""
    features = rng.normal(size=(SETTINGS, ITEMS, DIMENSION)) / np.sqrt(2 * DIMENSION)
    features[1] *= np.linspace(0.2, 1.8, DIMENSION)
    features[2, :, 1:] *= 0.1  # under this setting one dimension is nearly all that counts
    features[2, :, 0] *= np.sqrt(DIMENSION)
    return features


def _compared(features: np.ndarray, drawn: xr.Dataset, truth: dict[str, Any]) -> dict[str, tuple[np.ndarray, float]]:
    """Draws of each functional, shape (S,), and its true value."""
    settings, weights = drawn["setting"].values.ravel(), drawn["utility_weights"].values.reshape(-1, DIMENSION)
    values = {name: drawn[name].values.reshape(len(settings), 1) for name in ("steepness", "lapse_rate")}
    likelihood = likelihood_of("mixed", float(MOST_ANSWERS), **values)
    held_out = features[:, 0] - features[:, 1]
    margin = np.einsum("sd,sd->s", held_out[settings], weights)
    probability = prob(likelihood, margin[:, None])[:, 0]
    true_margin = float(held_out[truth["setting"]] @ truth["weights"])
    true_likelihood = likelihood_of(
        "mixed", float(MOST_ANSWERS), steepness=truth["steepness"], lapse_rate=truth["lapse"]
    )
    compared = {
        "margin": (margin, true_margin),
        "probability": (probability, float(prob(true_likelihood, np.array([true_margin]))[0])),
        "utility of the first": (
            np.einsum("sd,sd->s", features[:, 0][settings], weights),
            float((features[truth["setting"]] @ truth["weights"])[0]),
        ),
        "lapse rate": (values["lapse_rate"][:, 0], truth["lapse"]),
        "steepness": (values["steepness"][:, 0], truth["steepness"]),
        "setting": ((settings == 2).astype(float), float(truth["setting"] == 2)),
    }
    if "tie_threshold" in drawn:
        compared["tie threshold"] = (drawn["tie_threshold"].values.ravel(), truth["threshold"])
    return compared


def _truth(rng: np.random.Generator) -> dict[str, Any]:
    def drawn(prior: Any) -> float:
        return float(rng.choice(prior.values, p=prior.probabilities / prior.probabilities.sum()))

    return {
        "setting": int(rng.integers(SETTINGS)),
        "weights": rng.normal(size=DIMENSION),
        "steepness": drawn(MODEL.steepness_prior),
        "lapse": drawn(MODEL.lapse_rate_prior),
        "threshold": drawn(MODEL.tie_threshold_prior),
    }


def _answer(rng: np.random.Generator, margin: float, truth: dict[str, Any]) -> int:
    """1: the first, −1: the second, 0: no difference."""
    likelihood = likelihood_of("mixed", float(MOST_ANSWERS), steepness=truth["steepness"], lapse_rate=truth["lapse"])
    above, below = prob(likelihood, np.array([margin, -margin]) - truth["threshold"])
    return int(rng.choice([1, -1, 0], p=[above, below, max(1 - above - below, 0.0)]))


def _pairs(rng: np.random.Generator, number: int) -> np.ndarray:
    return np.array([rng.choice(ITEMS, 2, replace=False) for _ in range(number)])


def _rank(rng: np.random.Generator, sample: np.ndarray, true: float) -> float:
    """Equal values are ordered at random."""
    below, equal = np.sum(sample < true), np.sum(sample == true)
    return float((below + rng.integers(equal + 1) + rng.random()) / (len(sample) + 1))


@cache
def _plant(bug: str) -> None:
    """Once a process: a bug planted again would be wrapped in itself."""
    if bug == "no-setting":
        gibbs._setting_move = lambda key, z, unknowns, problem: (z, unknowns)
    elif bug == "no-volume":
        moved = gibbs._setting_move

        def without(key: Any, z: Any, unknowns: Any, problem: Any) -> Any:
            volume = jnp.sum(jnp.log(jnp.diagonal(problem.settings.root, axis1=1, axis2=2)), axis=1)
            return moved(key, z, unknowns, problem._replace(log_probabilities=problem.log_probabilities - volume))

        gibbs._setting_move = without
    elif bug == "narrow":
        original = low_rank.UtilityWeights.__init__

        def narrower(self: Any, *arguments: Any, prior_scale: float, seed: int) -> None:
            original(self, *arguments, prior_scale=prior_scale / 2, seed=seed)

        setattr(low_rank.UtilityWeights, "__init__", narrower)  # noqa: B010


def _all_ranks(runs: int, jobs: int, seed: int, bug: str, ties: bool) -> Iterator[Ranks]:
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as executor:
        yield from executor.map(partial(one_run, bug=bug, ties=ties), range(seed, seed + runs))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bug", choices=BUGS, default="")
    parser.add_argument("--ties", action="store_true")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    found: dict[str, list[float]] = {}
    for ranks in _all_ranks(arguments.runs, arguments.jobs, arguments.seed, arguments.bug, arguments.ties):
        for name, rank in ranks.items():
            found.setdefault(name, []).append(rank)
    p_values = {}
    for name, values in found.items():
        counts, _ = np.histogram(values, bins=10, range=(0, 1))
        p_values[name] = float(stats.chisquare(counts).pvalue)
        print(f"{name:22} n = {len(values):4}  p = {p_values[name]:.3g}  {counts.tolist()}", flush=True)
    print(f"smallest p × {len(p_values)} = {min(1.0, min(p_values.values()) * len(p_values)):.3g}")
    if arguments.out:
        with arguments.out.open("w", newline="") as file:
            csv.writer(file).writerows([[name, *values] for name, values in found.items()])


if __name__ == "__main__":
    main()
