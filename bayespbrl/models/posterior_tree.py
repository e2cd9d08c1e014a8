"""A posterior as a DataTree in ArviZ's schema, to keep in memory and on disk."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float
from xarray.core import indexing

from bayespbrl.models.chains import Chains
from bayespbrl.models.convergence import Convergence
from bayespbrl.models.gaussian_fit import GaussianFit
from bayespbrl.models.likelihoods import WithTies
from bayespbrl.models.low_rank import UtilityWeights, low_rank


def posterior_tree(
    fit: GaussianFit, chains: Chains, length: int, report: Convergence, attributes: Mapping[str, int]
) -> xr.DataTree:
    """The first `length` draws of the chains, with the groups that `sample_posterior` describes.

    `fit` is where the chains began, `report` of the margins' draws, and `attributes` are kept with the tree.
    """
    sample, answer = ("chain", "draw"), ("chain", "draw", "preference")
    z, answers = chains.collected("coordinates", length), chains.collected("answers", length)
    flags = {name: (sample, chains.collected(name, length)) for name in ("candidates", "stuck", "diverging")}
    lp = np.sum(answers, axis=2)
    labels = {"chain": np.arange(z.shape[0]), "draw": np.arange(length)}
    likelihood, basis = fit.likelihood, fit.factors.basis
    tied = (
        np.asarray(likelihood.indifferent) if isinstance(likelihood, WithTies) else np.zeros(len(fit.differences), bool)
    )
    most_likely = z[np.unravel_index(np.argmax(lp), lp.shape)]
    points = {"mean": basis @ z.mean(axis=(0, 1)), "most_likely": basis @ most_likely}
    root_attributes = {
        **{
            name: x if isinstance(x, str) else float("nan" if x is None else x) for name, x in asdict(fit.model).items()
        },
        **attributes,
        "log_evidence": fit.log_evidence,
        "log_evidence_converged": int(fit.approximation.converged),
        "rhat_max": report.rhat_max,
        "effective_sample_size_min": min(report.effective_sample_size_min, float(lp.size)),
        "converged": int(report.converged() and not np.any(flags["diverging"][1])),
        "stuck": int(np.sum(flags["stuck"][1])),
    }
    draws = {"margins": (answer, z @ fit.factors.loadings.T), "coordinates": ((*sample, "coordinate"), z)}
    statistics = {"lp": (sample, lp), **flags}
    root = xr.Dataset({f"utility_weights_{name}": ("feature", w) for name, w in points.items()}, attrs=root_attributes)
    return xr.DataTree.from_dict(
        {
            "/": root,
            "/posterior": _with_weights(xr.Dataset(draws, labels), basis, root_attributes),
            "/sample_stats": xr.Dataset(statistics, labels),
            "/log_likelihood": xr.Dataset({"answers": (answer, answers)}, labels),
            "/observed_data": xr.Dataset({"answers": ("preference", (~tied).astype(np.int8))}),
            "/constant_data": xr.Dataset({"differences": (("preference", "feature"), fit.differences)}),
        }
    )


def _with_weights(posterior: xr.Dataset, basis: Float[np.ndarray, "d r"], settings: Mapping[Any, Any]) -> xr.Dataset:
    z = posterior["coordinates"].values
    lazy = UtilityWeights(z, basis, prior_scale=float(settings["prior_scale"]), seed=int(settings["seed"]))
    weights = xr.Variable(("chain", "draw", "feature"), indexing.LazilyIndexedArray(lazy))
    return posterior.assign(utility_weights=weights)


def stored(tree: xr.DataTree) -> xr.DataTree:
    """The tree without the computed `posterior["utility_weights"]`, to write to disk; `restored` brings it back."""
    posterior = tree.children["posterior"].to_dataset(inherit=False).drop_vars("utility_weights", errors="ignore")
    return _replaced(tree, posterior)


def restored(tree: xr.DataTree) -> xr.DataTree:
    """A tree read back from disk, with `posterior["utility_weights"]` computed where it is indexed, as before."""
    basis = low_rank(tree.children["constant_data"].to_dataset()["differences"].values).basis
    posterior = tree.children["posterior"].to_dataset(inherit=False)
    return _replaced(tree, _with_weights(posterior, basis, tree.attrs))


def _replaced(tree: xr.DataTree, posterior: xr.Dataset) -> xr.DataTree:
    groups = {path: node.to_dataset(inherit=False) for path, node in tree.subtree_with_keys}
    return xr.DataTree.from_dict({**groups, "posterior": posterior})
