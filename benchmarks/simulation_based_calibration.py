"""Simulation-based calibration of the posterior in the loop that it is used in: adaptive questions, adaptive stopping.

    python benchmarks/simulation_based_calibration.py --runs 300 [--ties] [--bug NAME] [--jobs 2] [--out FILE.csv]

In each run everything is drawn from the prior of the model: setting of the features, weights, steepness, lapse rate,
and with `--ties` the tie threshold. An answerer simulated by them answers questions about pairs of items that the
posterior of the answers so far chooses, those of highest expected information, until that is below a limit or there are
ten answers. The rank of each true value among the draws of the last posterior must then be uniform (Talts et al. 2018),
whatever was asked and whenever it ended. Eq. 8 is given its K beforehand, because the probability of an answer depends
on it. One functional, the log likelihood of all answers, depends on the answers themselves: without it a posterior that
ignores answers would pass (Modrák et al. 2023).

Printed are, for each functional, the p-value of uniformity (χ², ten bins) and the smallest times their number
(Bonferroni). With `--out` each run is a row of the file, written as it ends; a second call runs the missing seeds only.

`--bug` plants one that must be rejected: `no-setting` (the setting is never moved), `no-volume` (its move forgets the
volume), `no-lapses` (the lapse rate is taken for zero), `one-steepness` (steepness is given, wrongly), `narrow` (the
weights outside the answers' span are half as wide), `prior-scale` (the prior's scale is taken for twice what it is),
`half` (only the first half of the answers is used), `unmoved` (the chains stay where they start). In the file they are
numbered from 1 in this order; 0 is none.
"""

import argparse
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax.numpy as jnp
import numpy as np
import xarray as xr
from rows_by_seed import Row, run
from scipy import stats

from bayespbrl.models import Answers, EllipticalSlice, PreferenceModel, chains, gibbs, low_rank, posterior_draws
from bayespbrl.models.likelihoods import Likelihood, likelihood_of, prob, with_threshold
from bayespbrl.models.posterior import SamplerOptions
from bayespbrl.queries import expected_information

ITEMS, DIMENSION, SETTINGS, MOST_ANSWERS, LEAST_INFORMATION, KEPT = 12, 8, 3, 10, 0.05, 99
MODEL = PreferenceModel(steepness=None, lapse_rate=None)
SAMPLER = SamplerOptions(num_samples=100, max_samples=100)
ASKING = SamplerOptions(num_samples=25, max_samples=25, num_chains=2)  # which questions are asked need not be exact
WRONG_MODELS = {
    "no-lapses": PreferenceModel(steepness=None, lapse_rate=0.0),
    "one-steepness": PreferenceModel(steepness=0.5, lapse_rate=None),
    "prior-scale": PreferenceModel(2.0, steepness=None, lapse_rate=None),
}
BUGS = ("no-setting", "no-volume", "no-lapses", "one-steepness", "narrow", "prior-scale", "half", "unmoved")
QUANTITIES = (
    *("margin", "probability", "return of the first", "lapse rate", "steepness", "setting", "tie threshold"),
    "log likelihood",
)


def one_run(seed: int, bug: str = "", *, ties: bool = False) -> Row:
    """The rank of each true value, in [0, 1], with the seed."""
    _plant(bug)
    rng = np.random.default_rng([seed, 19])
    features = _features(rng)
    truth = _truth(rng)
    truth["threshold"] *= ties
    utilities = features[truth["setting"]] @ truth["weights"]
    pairs, tied = np.zeros((0, 2), int), np.zeros(0, bool)
    while len(pairs) < MOST_ANSWERS:
        drawn = _posterior(features, pairs, tied if ties else None, WRONG_MODELS.get(bug, MODEL), ASKING, seed)
        asked = _pairs(rng, 8)
        margins = _margins(features[:, asked[:, 0]] - features[:, asked[:, 1]], drawn)
        information = expected_information(margins, np.zeros(len(margins)), likelihood=_likelihood(drawn))
        best = int(np.argmax(information))
        if len(pairs) > 3 and information[best] < LEAST_INFORMATION:
            break
        first, second = asked[best]
        answer = _answer(rng, float(utilities[first] - utilities[second]), truth)
        pairs = np.concatenate([pairs, [[first, second] if answer >= 0 else [second, first]]])
        tied = np.append(tied, answer == 0)
    kept = len(pairs) // 2 if bug == "half" else len(pairs)
    told = tied[:kept] if ties else None
    drawn = _posterior(features, pairs[:kept], told, WRONG_MODELS.get(bug, MODEL), SAMPLER, seed)
    drawn = drawn.isel(draw=slice(None, None, 2))
    compared = _compared(features, drawn, truth)
    compared["log likelihood"] = _log_likelihood(features, pairs, tied, drawn, truth)
    chosen = rng.choice(drawn["setting"].size, KEPT, replace=False)
    return {"seed": seed} | {name: _rank(rng, sample[chosen], true) for name, (sample, true) in compared.items()}


def _posterior(
    features: np.ndarray,
    pairs: np.ndarray,
    tied: np.ndarray | None,
    model: PreferenceModel,
    sampler: SamplerOptions,
    seed: int,
) -> xr.Dataset:
    """Draws given the answers so far."""
    rows = features[:, pairs[:, 0]] - features[:, pairs[:, 1]]
    tree = posterior_draws(
        rows, model, seed=seed, answers=Answers(tied), number_of_preferences=MOST_ANSWERS, sampler=sampler
    )
    return tree["posterior"].dataset


def _margins(differences: np.ndarray, drawn: xr.Dataset) -> np.ndarray:
    """Of n differences under each setting, (C, n, D), in each draw, (S, n)."""
    settings, weights = drawn["setting"].values.ravel(), drawn["utility_weights"].values.reshape(-1, DIMENSION)
    return np.einsum("spd,sd->sp", differences[settings], weights)


def _likelihood(drawn: xr.Dataset) -> Likelihood:
    """Of an answer that states an order, under each draw."""
    values = {name: drawn[name].values.reshape(-1, 1) for name in ("steepness", "lapse_rate")}
    return likelihood_of("mixed", float(MOST_ANSWERS), **values)


def _log_likelihood(
    features: np.ndarray, pairs: np.ndarray, tied: np.ndarray, drawn: xr.Dataset, truth: dict[str, Any]
) -> tuple[np.ndarray, float]:
    """Of all answers, in each draw and in truth."""
    differences = features[:, pairs[:, 0]] - features[:, pairs[:, 1]]
    margins, true_margins = _margins(differences, drawn), differences[truth["setting"]] @ truth["weights"]
    likelihood = _likelihood(drawn)
    if "tie_threshold" in drawn:
        likelihood = with_threshold(likelihood, drawn["tie_threshold"].values.reshape(-1, 1), np.zeros(len(tied), bool))
    return _of_answers(likelihood, margins, tied), float(_of_answers(_true_likelihood(truth), true_margins, tied))


def _of_answers(likelihood: Likelihood, margins: np.ndarray, tied: np.ndarray) -> np.ndarray:
    above, below = prob(likelihood, margins), prob(likelihood, -margins)
    return np.asarray(np.sum(np.log(np.maximum(np.where(tied, 1 - above - below, above), 1e-300)), axis=-1))


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
    held_out = features[:, 0] - features[:, 1]
    margin = _margins(held_out[:, None], drawn)[:, 0]
    probability = prob(_likelihood(drawn), margin[:, None])[:, 0]
    true_margin = float(held_out[truth["setting"]] @ truth["weights"])
    true_likelihood = likelihood_of(
        "mixed", float(MOST_ANSWERS), steepness=truth["steepness"], lapse_rate=truth["lapse"]
    )
    compared = {
        "margin": (margin, true_margin),
        "probability": (probability, float(prob(true_likelihood, np.array([true_margin]))[0])),
        "return of the first": (
            np.einsum("sd,sd->s", features[:, 0][settings], weights),
            float((features[truth["setting"]] @ truth["weights"])[0]),
        ),
        "lapse rate": (drawn["lapse_rate"].values.ravel(), truth["lapse"]),
        "steepness": (drawn["steepness"].values.ravel(), truth["steepness"]),
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


def _true_likelihood(truth: dict[str, Any]) -> Likelihood:
    """Of an answer that states an order."""
    return likelihood_of(
        "mixed",
        float(MOST_ANSWERS),
        steepness=truth["steepness"],
        lapse_rate=truth["lapse"],
        tie_threshold=truth["threshold"] or None,
        indifferent=np.zeros(1, dtype=bool),
    )


def _answer(rng: np.random.Generator, margin: float, truth: dict[str, Any]) -> int:
    """1: the first, −1: the second, 0: no difference."""
    above, below = prob(_true_likelihood(truth), np.array([margin, -margin]))
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

        def narrower(self: Any, *arguments: Any, prior_scale: float, **options: Any) -> None:
            original(self, *arguments, prior_scale=prior_scale / 2, **options)

        setattr(low_rank.UtilityWeights, "__init__", narrower)  # noqa: B010
    elif bug == "unmoved":
        setattr(chains, "moved", lambda key, z, unknowns, problem: (z, unknowns))  # noqa: B010
        setattr(EllipticalSlice, "sample", lambda self, state, *_: state)  # noqa: B010


def main() -> None:
    """Run what is missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bug", choices=BUGS, default="")
    parser.add_argument("--ties", action="store_true")
    parser.add_argument("--out", type=Path)
    chosen = parser.parse_args()
    quantities = [name for name in QUANTITIES if chosen.ties or name != "tie threshold"]
    same = {"ties": float(chosen.ties), "bug": float(1 + BUGS.index(chosen.bug) if chosen.bug else 0)}
    seeds, one = range(chosen.seed, chosen.seed + chosen.runs), partial(one_run, bug=chosen.bug, ties=chosen.ties)
    with TemporaryDirectory() as folder:
        file = chosen.out or Path(folder) / "ranks.csv"
        rows = run(seeds, file, ["seed", *same, *quantities], one, same, chosen.jobs)
    report([{name: row[name] for name in quantities} for row in rows])


def report(rows: Sequence[Row]) -> None:
    """Print uniformity of each functional."""
    found = {name: [ranks[name] for ranks in rows] for name in rows[0]}
    p_values = {}
    for name, values in found.items():
        counts, _ = np.histogram(values, bins=10, range=(0, 1))
        p_values[name] = float(stats.chisquare(counts).pvalue)  # Talts et al. (2018): ranks are uniform
        print(f"{name:22} n = {len(values):4}  p = {p_values[name]:.3g}  {counts.tolist()}", flush=True)
    print(f"smallest p × {len(p_values)} = {min(1.0, min(p_values.values()) * len(p_values)):.3g}")


if __name__ == "__main__":
    main()
