"""A posterior as a DataTree in ArviZ's schema, to keep in memory and on disk."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float
from numpy.typing import ArrayLike
from xarray.core import indexing

from bayespbrl import checks
from bayespbrl.models.chains import Chains
from bayespbrl.models.convergence import Convergence
from bayespbrl.models.gaussian_fit import GaussianFit
from bayespbrl.models.likelihoods import ties_of
from bayespbrl.models.low_rank import LowRank, UtilityWeights, low_rank, used_rows
from bayespbrl.models.preference_model import Answers
from bayespbrl.models.priors import SIDE_BIAS_SCALE
from bayespbrl.models.threads import one_blas_thread

SAMPLE = ("chain", "draw")
LARGEST_DIFFERENCE = 1e30  # and its inverse the smallest: their fourth powers must be numbers
SAME_MARGINS = 1e-6  # relative to the largest: rounding on one machine, in another's coordinates the error is near 1


def settings_of(differences: ArrayLike) -> Float[np.ndarray, "s k d"]:
    """Differences (K, D) or (C, K, D) as (C, K, D), checked."""
    array = checks.reals("differences", differences)
    if array.ndim != 3:
        array = checks.matrix("differences", array)[None]
    checks.finite("differences", array)
    if not array.shape[0] or not array.shape[2]:
        raise ValueError(f"differences: expected shape (K, D >= 1) or (C, K, D), got {np.shape(differences)}")
    largest = float(np.max(np.abs(array), initial=0.0))
    if largest and not 1 / LARGEST_DIFFERENCE <= largest <= LARGEST_DIFFERENCE:
        raise ValueError(
            f"differences: expected the largest between {1 / LARGEST_DIFFERENCE:g} and {LARGEST_DIFFERENCE:g}, got "
            f"{largest:g}; divide them by their root mean square length"
        )
    return array


def check_posterior(tree: Any) -> None:
    """`ValueError` where `tree` is no posterior as `sample_posterior` returns it."""
    if not isinstance(tree, xr.DataTree) or "posterior" not in tree.children:
        has = "; its .posterior is one" if isinstance(getattr(tree, "posterior", None), xr.DataTree) else ""
        raise ValueError(f"tree: expected a posterior, as sample_posterior returns it, got {type(tree).__name__}{has}")


def margins_of(fits: Sequence[GaussianFit], chains: Chains, length: int) -> Float[np.ndarray, "chain {length} k"]:
    """The margins of the first `length` draws of each chain, each under its own setting."""
    z, settings = chains.collected("coordinates", length), chains.collected("setting", length)
    margins = np.empty((*z.shape[:2], len(fits[0].differences)))
    for number, fit in enumerate(fits):
        loadings = fit.factors.loadings
        margins[settings == number] = z[settings == number][:, : loadings.shape[1]] @ loadings.T
    return margins


def fit_attributes(number: int, seed: int, evidence: tuple[float, float]) -> dict[str, float]:
    """The attributes of a fit: K of eq. 8, the seed, the log marginal likelihood and its Monte Carlo error."""
    log_evidence, error = evidence
    return {
        "number_of_preferences": int(number),
        "seed": seed,
        "log_evidence": log_evidence,
        "log_evidence_error": error,
    }


def posterior_tree(
    fits: Sequence[GaussianFit],
    chains: Chains,
    length: int,
    report: Convergence,
    attributes: Mapping[str, float],
    differences: Float[np.ndarray, "*s k d"],
    answers: Answers,
) -> xr.DataTree:
    """The first `length` draws of the chains, with the groups that `sample_posterior` describes.

    `fits` are where the chains began, `report` is of all that is diagnosed, and `attributes` are kept with the tree.
    """
    answer, likelihood = (*SAMPLE, "preference"), fits[0].likelihood
    z, log_p = chains.collected("coordinates", length), chains.collected("answers", length)
    flags = {name: (SAMPLE, chains.collected(name, length)) for name in ("candidates", "stuck", "diverging")}
    lp, settings = np.sum(log_p, axis=2), chains.collected("setting", length)
    labels = {"chain": np.arange(z.shape[0]), "draw": np.arange(length)}
    tied = answers.tied(len(fits[0].differences))
    root_attributes = {
        **{
            name: x if isinstance(x, str) else float("nan" if x is None else x)
            for name, x in asdict(fits[0].model).items()
        },
        **attributes,
        "rhat_max": report.rhat_max,
        "effective_sample_size_min": min(report.effective_sample_size_min, float(lp.size)),
        "converged": int(report.converged() and not np.any(flags["diverging"][1])),
        "stuck": int(np.sum(flags["stuck"][1])),
    }
    draws = {
        "margins": (answer, margins_of(fits, chains, length)),
        "coordinates": ((*SAMPLE, "coordinate"), z),
        "setting": (SAMPLE, settings),
        "steepness": (SAMPLE, chains.values("steepness", length)),
        "lapse_rate": ((*SAMPLE, "answerer"), chains.values("lapse_rate", length)),
    }
    if ties_of(likelihood) is not None:
        draws["tie_threshold"] = (SAMPLE, chains.values("tie_threshold", length))
    parts = {"shown_first": answers.shown_first, "answerers": answers.answerers}
    known = {name: ("preference", x) for name, x in parts.items() if x is not None}
    people = {} if answers.names is None else {"answerer": np.array(answers.names, dtype=object)}
    dimensions = ("setting", "preference", "feature")[3 - differences.ndim :]
    tree = xr.DataTree.from_dict(
        {
            "/": xr.Dataset(attrs=root_attributes),
            "/posterior": xr.Dataset(draws, labels | people),
            "/sample_stats": xr.Dataset({"lp": (SAMPLE, lp), **flags}, labels),
            "/log_likelihood": xr.Dataset({"answers": (answer, log_p)}, labels),
            "/observed_data": xr.Dataset({"answers": ("preference", (~tied).astype(np.int8))}),
            "/constant_data": xr.Dataset({"differences": (dimensions, differences), **known}),
        }
    )
    return _with_weights(tree, [fit.factors.basis for fit in fits])


def answers_of(tree: xr.DataTree) -> Answers:
    """Ties, sides and answerers of the answers that a tree was fitted to."""
    known, drawn = tree.children["constant_data"].dataset, tree.children["posterior"].dataset
    tied = np.asarray(tree.children["observed_data"]["answers"]) == 0
    parts = {name: known[name].values.astype(int) for name in ("shown_first", "answerers") if name in known}
    names = tuple(map(str, drawn["answerer"].values)) if "answerer" in drawn.coords else None
    return Answers(tied if "tie_threshold" in drawn else None, **parts, names=names)


def number_of_preferences(tree: xr.DataTree) -> int:
    """K of eq. 8 in a tree's model, at least 1."""
    return max(int(tree.attrs["number_of_preferences"]), 1)


def next_lapse_rates(tree: xr.DataTree) -> Float[np.ndarray, "chain draw"]:
    """The lapse rate of an answer by one of the answerers, each as probable as their share of the answers.

    The probability of an answer is linear in the lapse rate, so that this mean is exact.
    """
    rates, known = tree.children["posterior"].dataset["lapse_rate"].values, answers_of(tree)
    if rates.shape[2] == 1:
        return np.asarray(rates[:, :, 0])
    counts = np.bincount(np.asarray(known.answerers), minlength=rates.shape[2])
    shares = counts / counts.sum() if counts.any() else np.full(rates.shape[2], 1 / rates.shape[2])
    return np.asarray(rates @ shares)


def utility_margins(tree: xr.DataTree) -> Float[np.ndarray, "chain draw k"]:
    """Draws of the margins without what an answerer adds for the side shown first."""
    drawn, known = tree.children["posterior"].dataset, answers_of(tree)
    margins = np.asarray(drawn["margins"].values)
    if known.shown_first is None:
        return margins
    bias = drawn["side_bias"].values
    each = bias[:, :, np.asarray(known.answerers)] if bias.ndim == 3 else bias[:, :, None]
    return np.asarray(margins - np.asarray(known.shown_first) * each)


def bases_of(tree: xr.DataTree) -> list[Float[np.ndarray, "d r"]]:
    """Q of each setting, of the features and, where they are known, the sides."""
    return [factors.basis for factors in _factors_of(tree)]


def _factors_of(tree: xr.DataTree) -> list[LowRank]:
    """As when the tree was sampled, if by this machine."""
    settings = settings_of(tree.children["constant_data"].dataset["differences"].values)
    augmented = answers_of(tree).with_sides(settings, float(tree.attrs["prior_scale"]))
    with one_blas_thread():
        return [low_rank(each) for each in augmented]


def stored(tree: xr.DataTree) -> xr.DataTree:
    """The tree without what `restored` computes, to write to disk."""
    posterior = tree.children["posterior"].to_dataset(inherit=False)
    posterior = posterior.drop_vars(["utility_weights", "side_bias"], errors="ignore")
    kept = tree.filter(lambda node: node.name != "log_prior")
    return _replaced(kept, posterior, xr.Dataset(attrs=tree.attrs))


def restored(tree: xr.DataTree) -> xr.DataTree:
    """The tree with `posterior["utility_weights"]`, computed where it is indexed, side bias, log prior and points."""
    factors = _factors_of(tree)
    return _with_weights(_in_these_coordinates(tree, factors), [each.basis for each in factors])


def _in_these_coordinates(tree: xr.DataTree, factors: Sequence[LowRank]) -> xr.DataTree:
    """The tree with coordinates z that have its margins under these factors, t = L z.

    Where rows of the differences depend on those before them (repeated questions, ties), Q is determined by rounding,
    which differs between processors. The margins determine w = Q z all the same.
    """
    posterior = tree.children["posterior"].to_dataset(inherit=False)
    z, margins, settings = (posterior[name].values for name in ("coordinates", "margins", "setting"))
    new = z.copy()
    for number, each in enumerate(factors):
        chosen, rank, used = settings == number, each.basis.shape[1], used_rows(each.loadings)
        wanted, found = margins[chosen][:, used], z[chosen][:, :rank] @ each.loadings[used].T
        if not np.allclose(found, wanted, rtol=0, atol=SAME_MARGINS * np.max(np.abs(wanted), initial=0.0)):
            lengths = np.linalg.norm(each.loadings[used], axis=1)
            moved = np.linalg.lstsq(each.loadings[used] / lengths[:, None], (wanted / lengths).T, rcond=None)[0].T
            new[chosen, :rank] = moved
    return _replaced(tree, posterior.assign(coordinates=(posterior["coordinates"].dims, new)), tree.to_dataset())


def _with_weights(tree: xr.DataTree, bases: Sequence[Float[np.ndarray, "d _"]]) -> xr.DataTree:
    posterior = tree.children["posterior"].to_dataset(inherit=False)
    z, settings = posterior["coordinates"].values, posterior["setting"].values
    differences = tree.children["constant_data"].dataset["differences"]
    width, several = differences.shape[-1], differences.ndim == 3
    scale, seed = float(tree.attrs["prior_scale"]), int(tree.attrs["seed"])

    def lazy(unit: float, dimension: str) -> xr.Variable:
        weights = UtilityWeights(z, bases, settings, prior_scale=scale, seed=seed, unit=unit)
        return xr.Variable((*SAMPLE, dimension), indexing.LazilyIndexedArray(weights))

    posterior = posterior.assign(utility_weights=lazy(1.0, "feature")[:, :, :width])
    if "shown_first" in tree.children["constant_data"].dataset:
        sides = lazy(SIDE_BIAS_SCALE / scale, "answerer")[:, :, width:]
        posterior = posterior.assign(side_bias=sides if "answerer" in posterior.coords else sides[:, :, 0])
    lp = tree.children["sample_stats"].dataset["lp"].values
    best = np.zeros(lp.shape, bool)
    best[np.unravel_index(np.argmax(lp), lp.shape)] = True
    points = {}
    for name, share in (("mean", np.full(lp.shape, 1 / lp.size)), ("most_likely", best.astype(float))):
        parts = np.zeros((len(bases), width))
        for number, basis in enumerate(bases):
            chosen = settings == number
            # paper, step 1: the posterior mean μ_w, or the most likely sample
            parts[number] = (basis @ (share[chosen] @ z[chosen][:, : basis.shape[1]]))[:width]
        points[f"utility_weights_{name}"] = (("setting", "feature"), parts) if several else (("feature",), parts[0])
    prior = xr.Dataset({"coordinates": (SAMPLE, log_prior(z, scale))}, {name: posterior[name] for name in SAMPLE})
    return _replaced(tree, posterior, xr.Dataset(points, attrs=tree.attrs), log_prior=prior)


def log_prior(z: Float[np.ndarray, "chain draw q"], prior_scale: float) -> Float[np.ndarray, "chain draw"]:
    """Log prior of the coordinates, up to a constant (eq. 7)."""
    return np.asarray(-np.sum(z**2, axis=2) / (2 * prior_scale**2))


def _replaced(tree: xr.DataTree, posterior: xr.Dataset, root: xr.Dataset, **others: xr.Dataset) -> xr.DataTree:
    groups = {path: node.to_dataset(inherit=False) for path, node in tree.subtree_with_keys}
    return xr.DataTree.from_dict({**groups, **others, ".": root, "posterior": posterior})
