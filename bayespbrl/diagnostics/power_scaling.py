"""Power-scaling sensitivity of the posterior to the prior scale σ and to the likelihood.

The normalised power α of the prior N(0, σ²I) is N(0, σ²I/α), so that power-scaling the prior changes σ to σ/√α, and the
scale of the side biases alike where these are inferred. The likelihood to the power α counts every answer α times.
"""

import numpy as np
import xarray as xr
from arviz_stats import psense
from matplotlib.axes import Axes

from bayespbrl import checks
from bayespbrl.diagnostics.axes import finished
from bayespbrl.models.low_rank import low_rank
from bayespbrl.models.posterior_tree import bases_of, check_posterior, log_prior, settings_of

COMPONENTS = ("prior", "likelihood")
# Least standard deviation of a log density over the draws, in nats. Below it powers near 1 have no visible effect, and
# ArviZ's estimate of the weights' tail divides by zero.
LEAST_SPREAD = 1e-3
THRESHOLD = 0.05  # a quantity counts as sensitive from here on (Kallioinen et al. 2024)


def sensitivity(tree: xr.DataTree, features: np.ndarray | None = None, *, seed: int = 0) -> xr.Dataset:
    """Power-scaling sensitivity of the margins, or of utilities wᵀφ, to σ and to the likelihood.

    Args:
      tree: what `sample_posterior` returned.
      features: φ(s) of states or feature sums ψ(τ), shape (n, D), in the units of the differences: of an estimate's
        posterior divided by its `scales`. None: the K margins.
      seed: of the prior draws in the directions that no answer constrains.

    Returns:
      `sensitivity` (component, quantity) with components "prior" and "likelihood", 0 for a quantity that is the same in
      every draw and, of the likelihood, where the answers are equally likely under all draws or there are none;
      `diagnosis` (quantity), the components that reach the threshold: "both" (prior and answers disagree, or the
      answers only bound the prior's spread), "prior", "likelihood" or "neither"; and the attribute `threshold`.

    Raises:
      ValueError: features of another shape or not finite.

    Source: Kallioinen et al. (2024), by `arviz_stats.psense`.
    """
    check_posterior(tree)
    draws, of_prior = _quantities(tree, features, seed=seed)
    labels = {"chain": np.arange(draws.shape[0]), "draw": np.arange(draws.shape[1])}
    varies = ~np.all(draws == draws[:1, :1], axis=(0, 1))
    log_likelihood = np.asarray(tree["log_likelihood"]["answers"]).sum(axis=2)
    sensitivities = np.zeros((2, draws.shape[2]))
    groups = {"posterior": (("chain", "draw", "quantity"), draws[:, :, varies])}
    for row, (name, log_density) in enumerate(zip(COMPONENTS, (of_prior, log_likelihood), strict=True)):
        if not varies.any() or np.std(log_density) < LEAST_SPREAD:
            continue
        group = {f"log_{name}": (("chain", "draw"), log_density)}
        parts = {key: xr.Dataset({"utility": value}, labels) for key, value in {**groups, **group}.items()}
        sensitivities[row, varies] = psense(xr.DataTree.from_dict(parts), group=name)["utility"].values
    return xr.Dataset(
        {
            "sensitivity": (("component", "quantity"), sensitivities),
            "diagnosis": ("quantity", _diagnosis(sensitivities >= THRESHOLD)),
        },
        coords={"component": list(COMPONENTS)},
        attrs={"threshold": THRESHOLD},
    )


def plot_sensitivity(result: xr.Dataset, axes: Axes) -> Axes:
    """Sensitivity to the prior scale and to the likelihood, as two bars for each quantity."""
    numbers = np.arange(result.sizes["quantity"])
    labels = {"prior": "prior scale", "likelihood": "likelihood"}
    for component, offset in zip(COMPONENTS, (-0.2, 0.2), strict=True):
        axes.bar(numbers + offset, result["sensitivity"].sel(component=component), 0.4, label=labels[component])
    axes.axhline(result.attrs["threshold"], color="0.5", linestyle="--", linewidth=1)
    return finished(axes, xlabel="quantity", ylabel="power-scaling sensitivity", title="Sensitivity")


def _quantities(tree: xr.DataTree, features: np.ndarray | None, *, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Draws (chain, draw, n), and the log prior (chain, draw) of the coordinates they depend on, up to a constant."""
    z = np.asarray(tree["posterior"]["coordinates"])
    scale = float(tree.attrs["prior_scale"])
    of_coordinates = log_prior(z, scale)
    if features is None:
        return np.asarray(tree["posterior"]["margins"]), of_coordinates
    settings = settings_of(np.asarray(tree["constant_data"]["differences"]))
    if len(settings) > 1:
        raise ValueError(
            f"features: expected None for a posterior over {len(settings)} settings, got shape {np.shape(features)}"
        )
    known = settings[0]
    features = checks.matrix("features", features, columns=known.shape[1])
    (basis,) = bases_of(tree)
    features = np.pad(features, [(0, 0), (0, len(basis) - known.shape[1])])  # no side is in them
    inside = features @ basis
    # of the directions without any answer only those of the features: all D would dominate the importance weights
    rest = features - inside @ basis.T
    rounding = np.linalg.norm(rest, axis=1) <= 1e-9 * np.linalg.norm(features, axis=1)
    outside = low_rank(np.where(rounding[:, None], 0.0, rest))
    unseen = scale * np.random.default_rng(seed).standard_normal((*z.shape[:2], outside.loadings.shape[1]))
    return z @ inside.T + unseen @ outside.loadings.T, of_coordinates + log_prior(unseen, scale)


def _diagnosis(sensitive: np.ndarray) -> np.ndarray:
    names = np.array([["neither", "likelihood"], ["prior", "both"]])
    prior, likelihood = sensitive.astype(int)
    return names[prior, likelihood]
