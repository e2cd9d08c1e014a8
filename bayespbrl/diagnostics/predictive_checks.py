"""Posterior predictive checks: do answers drawn from the posterior look like those that were given?

Each check counts something in the answers and in as many answers simulated by each posterior draw. The p-value is the
probability that the simulated count is at least the observed one; half of the equal ones count. Near 0 or 1 the model
does not explain what was counted (Gelman, Meng & Stern 1996).
"""

import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from bayespbrl import checks
from bayespbrl.diagnostics.predictions import tied_rows
from bayespbrl.models.likelihoods import likelihood_of, prob
from bayespbrl.models.posterior_tree import answers_of, check_posterior, number_of_preferences, settings_of
from bayespbrl.utility.posterior_utility import spacing

CHECKS = ("surprises", "cycles", "ties")
MOST_ANSWERS_IN_TRIADS = 120  # of more, triads are looked for among the first only
SAME = 1e-9  # length of a sum of differences, over the longest difference, that is zero but for rounding


def predictive_checks(tree: xr.DataTree, *, draws: int = 1000, seed: int = 0) -> xr.Dataset:
    """Counts of surprises, cycles and ties, observed and by the posterior predictive.

    A surprise is an answer that states the opposite of the draw's margin. A cycle is a triad of things that were
    compared with one another, of which each was preferred to the next; a pair compared twice with opposite answers is
    one too. Ties are counted where they were possible.

    Args:
      tree: what `sample_posterior` returned.
      draws: maximum number of draws of the posterior, evenly spaced.
      seed: of the simulated answers.

    Returns:
      along `check`: `observed`, the mean over the draws; `expected`, `lower` and `upper`, mean and central 90 %
      interval of the simulated count; `possible`, the largest count (of cycles the number of triads, not all of which
      can be cycles at once); `p_value`, NaN where nothing was possible.

    Raises:
      ValueError: fewer than one draw.
    """
    check_posterior(tree)
    drawn = tree.children["posterior"].dataset
    number = tree.children["constant_data"].sizes["preference"]
    every = slice(None, None, spacing(drawn["setting"].size, checks.whole("draws", draws)))
    margins = drawn["margins"].values.reshape(drawn["setting"].size, number)[every]
    given = np.where(tied_rows(tree), 0, 1)[None]
    simulated = _simulated(tree, margins, every, np.random.default_rng(seed))
    triads = _triads(settings_of(tree.children["constant_data"].dataset["differences"].values)[0])
    counts: dict[str, tuple[np.ndarray, np.ndarray, int]] = {
        "surprises": (_surprises(given, margins), _surprises(simulated, margins), int(np.any(margins, axis=0).sum())),
        "cycles": (_cycles(given, triads), _cycles(simulated, triads), len(triads)),
        "ties": (np.sum(given == 0, axis=1), np.sum(simulated == 0, axis=1), number * ("tie_threshold" in drawn)),
    }
    rows = [_row(observed, by_model, possible) for observed, by_model, possible in counts.values()]
    names = ("observed", "expected", "lower", "upper", "possible", "p_value")
    data = {name: ("check", np.array(column)) for name, column in zip(names, zip(*rows, strict=True), strict=True)}
    return xr.Dataset(data, coords={"check": list(CHECKS)})


def _row(observed: np.ndarray, simulated: np.ndarray, possible: int) -> tuple[float, ...]:
    p_value = np.mean(simulated > observed) + 0.5 * np.mean(simulated == observed)  # Gelman, Meng & Stern (1996)
    lower, upper = np.quantile(simulated, (0.05, 0.95), method="inverted_cdf")  # counts
    figures = (observed.mean(), simulated.mean(), lower, upper, possible, p_value if possible else np.nan)
    return tuple(float(figure) for figure in figures)


def _simulated(
    tree: xr.DataTree, margins: Float[np.ndarray, "s k"], every: slice, rng: np.random.Generator
) -> Int[np.ndarray, "s k"]:
    """Answers by each draw: 1 as given, −1 the opposite, 0 a tie."""
    drawn, known = tree.children["posterior"].dataset, answers_of(tree)
    who = np.zeros(margins.shape[1], int) if known.answerers is None else np.asarray(known.answerers)
    size = drawn["setting"].size
    lapse_rates = drawn["lapse_rate"].values.reshape(size, -1)[every][:, who]
    likelihood = likelihood_of(
        tree.attrs["likelihood"],
        float(number_of_preferences(tree)),
        steepness=drawn["steepness"].values.reshape(-1, 1)[every],
        lapse_rate=lapse_rates,
        tie_threshold=drawn["tie_threshold"].values.reshape(-1, 1)[every] if "tie_threshold" in drawn else None,
        indifferent=np.zeros(margins.shape[1], dtype=bool),
    )
    above, below = prob(likelihood, margins), prob(likelihood, -margins)
    uniform = rng.random(margins.shape)
    return np.where(uniform < above, 1, np.where(uniform >= 1 - below, -1, 0))


def _surprises(answers: Int[np.ndarray, "*s k"], margins: Float[np.ndarray, "s k"]) -> Int[np.ndarray, " s"]:
    return np.asarray(np.sum(answers * margins < 0, axis=1))


def _triads(differences: Float[np.ndarray, "k d"]) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Two or three rows, and the signs with which they add up to zero: one thing, or three, compared in a ring."""
    rows = differences[:MOST_ANSWERS_IN_TRIADS]
    limit = SAME * float(np.max(np.linalg.norm(rows, axis=1), initial=0.0))
    gram = rows @ rows.T
    length = np.diag(gram)
    used, later = length > 0, np.arange(len(rows))
    found: list[tuple[tuple[int, ...], tuple[int, ...]]] = []
    for i in np.flatnonzero(used).tolist():
        pairs = np.triu(used[:, None] & used & (later[:, None] > i), 1)
        for second in (1, -1):
            # the Gram matrix sorts out nearly all; what it leaves is added up without cancellation
            two = length[i] + length + 2 * second * gram[i]
            near = used & (later > i) & (two <= 1e-12 * (length[i] + length))
            found += [((i, j), (1, second)) for j in np.flatnonzero(near).tolist()]
            for third in (1, -1):
                three = two[:, None] + length + 2 * third * (gram[i] + second * gram)
                j, k = np.nonzero(pairs & (three <= 1e-12 * (length[i] + length[:, None] + length)))
                found += [((i, m, n), (1, second, third)) for m, n in zip(j.tolist(), k.tolist(), strict=True)]
    return [
        (members, signs) for members, signs in found if np.linalg.norm(np.array(signs) @ rows[list(members)]) <= limit
    ]


def _cycles(
    answers: Int[np.ndarray, "*s k"], triads: list[tuple[tuple[int, ...], tuple[int, ...]]]
) -> Int[np.ndarray, " s"]:
    """Rings in which every answer points the same way round."""
    total = np.zeros(len(answers), dtype=int)
    for members, signs in triads:
        turned = answers[:, list(members)] * np.asarray(signs)
        total += np.all(turned == 1, axis=1) | np.all(turned == -1, axis=1)
    return total
