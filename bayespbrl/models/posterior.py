"""Step 1, Bayesian PBIRL: draws from p(w | preferences) that have converged, or say that they have not (eqs. 7-8)."""

from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax import lax
from threadpoolctl import ThreadpoolController
from xarray.core import indexing

from bayespbrl import checks
from bayespbrl.models.convergence import Convergence, chain_convergence
from bayespbrl.models.elliptical_slice import EllipticalSlice, EllipticalSliceState
from bayespbrl.models.expectation_propagation import GaussianApproximation, expectation_propagation
from bayespbrl.models.likelihoods import Likelihood, log_prob, prob, total_log_prob
from bayespbrl.models.low_rank import LowRank, UtilityWeights, low_rank, used_rows
from bayespbrl.models.preference_model import (
    PreferenceModel,
    PreferenceProblem,
    low_rank_model,
    padded_problem,
    prior_ellipse,
    reference_ellipse,
)

# Share of each answer's Gaussian factor that enters the reference: with all of it the reference is as narrow as the
# posterior's bulk and its residual has no bound in the tails; towards none it is the prior, which mixes badly.
REFERENCE_POWER = 0.5
# Moves round the reference's and the prior's ellipses per recorded draw. Draws a chain until convergence, mean of 24
# seeds, on the Gridworld's and the swing-up's differences: 698 and 375 with 30 and 2, 583 and 333 with 26 and 6, 708
# and 385 with 24 and 8. Effective draws of 4000 on three harder posteriors of the Bicycle's (seed 101): 260, 404, 150
# with 30 and 2, 1238, 1305, 231 with 26 and 6.
REFERENCE_MOVES, PRIOR_MOVES = 26, 6
# Draws that one call of the compiled sampler makes; its length is part of what is compiled.
CHUNK = 25


@dataclass(frozen=True)
class SamplerOptions:
    """How long the chains are; attributes as the keywords of `sample_posterior`."""

    num_warmup: int = 25
    num_samples: int = 250
    max_samples: int = 8_000
    num_chains: int = 4

    def __post_init__(self) -> None:
        checks.whole("num_warmup", self.num_warmup, 0)
        checks.whole("num_samples", self.num_samples, 4)
        checks.whole("max_samples", self.max_samples, self.num_samples)
        checks.whole("num_chains", self.num_chains, 2)


def sample_posterior(
    differences: np.ndarray,
    *,
    prior_scale: float = PreferenceModel.prior_scale,
    steepness: float = PreferenceModel.steepness,
    lapse_rate: float = PreferenceModel.lapse_rate,
    likelihood: str = PreferenceModel.likelihood,
    indifferent: np.ndarray | None = None,
    tie_threshold: float | None = PreferenceModel.tie_threshold,
    number_of_preferences: int | None = None,
    num_warmup: int = SamplerOptions.num_warmup,
    num_samples: int = SamplerOptions.num_samples,
    max_samples: int = SamplerOptions.max_samples,
    num_chains: int = SamplerOptions.num_chains,
    seed: int = 0,
) -> xr.DataTree:
    """Draw from the posterior of the utility weights w ~ N(0, σ²I) given preferences (eqs. 7-8), until it converges.

    After `num_samples` draws a chain, and after every doubling, R̂ ≤ 1.01 and at least 400 effective draws are asked of
    every margin; what has not met them at `max_samples` says `converged = 0`. Everything is computed in float64.

    Args:
      differences: ψ(preferred) − ψ(dominated), shape (K, D), used as given: divide by a scale of your choice first.
        A row of zeros has a margin of exactly zero in every draw. K = 0 gives the prior.
      prior_scale: σ > 0.
      steepness: m > 0.
      lapse_rate: λ in [0, 1), the share of answers that are coin tosses.
      likelihood: "mixed" (eq. 8), "logistic" or "probit".
      indifferent: which answers were "no difference", shape (K,) bool; needs `tie_threshold`. The sign of such a row
        does not matter.
      tie_threshold: δ > 0: margins within it are often called ties. None: no ties, and no threshold.
      number_of_preferences: K of eq. 8, where it is not the number of rows (an answer held out).
      num_warmup: draws a chain that are thrown away; rounded up to whole chunks of min(num_samples, 25) draws.
      num_samples: draws a chain to begin with, >= 4.
      max_samples: cap on the draws a chain.
      num_chains: >= 2, so that R̂ means something.
      seed: of everything random; the same seed gives the same draws.

    Returns:
      A tree with the groups
      `posterior`: margins (chain, draw, preference), coordinates z (chain, draw, coordinate), and utility_weights
        (chain, draw, feature), which is computed where it is indexed and held nowhere;
      `sample_stats`: lp (log likelihood), candidates (per move), stuck;
      `log_likelihood`: answers (chain, draw, preference); `observed_data`: answers, 1 as given and 0 for a tie;
      `constant_data`: differences;
      at the root: utility_weights_mean (feature), whose part outside the differences' row space is exactly zero;
        utility_weights_most_likely (feature), the draw of highest likelihood with the rest at its mean, zero; and the
        attributes log_evidence (expectation propagation's), log_evidence_converged, rhat_max,
        effective_sample_size_min, converged, stuck, prior_scale, steepness, lapse_rate, likelihood,
        number_of_preferences, tie_threshold, seed.
      `stored(tree).to_netcdf(path)` writes it without the utility weights; `restored` brings them back.

    Raises:
      ValueError: an argument out of its range, named with what came.
    """
    return posterior_draws(
        differences,
        PreferenceModel(prior_scale, steepness, lapse_rate, likelihood, tie_threshold),
        seed=seed,
        indifferent=indifferent,
        number_of_preferences=number_of_preferences,
        sampler=SamplerOptions(num_warmup, num_samples, max_samples, num_chains),
    )


def posterior_draws(
    differences: np.ndarray,
    model: PreferenceModel,
    *,
    seed: int,
    indifferent: np.ndarray | None = None,
    number_of_preferences: int | None = None,
    sampler: SamplerOptions | None = None,
) -> xr.DataTree:
    """`sample_posterior` for a model that is at hand; `sampler` None takes the default `SamplerOptions`."""
    differences = _checked(differences)
    seed = checks.whole("seed", seed, 0)
    sampler = SamplerOptions() if sampler is None else sampler
    number_of_preferences = len(differences) if number_of_preferences is None else number_of_preferences
    fit = fit_gaussian(differences, model, indifferent=indifferent, number_of_preferences=number_of_preferences)
    settings = {
        "prior_scale": float(model.prior_scale),
        "steepness": float(model.steepness),
        "lapse_rate": float(model.lapse_rate),
        "likelihood": model.likelihood,
        "number_of_preferences": int(number_of_preferences),
        "tie_threshold": float("nan") if model.tie_threshold is None else float(model.tie_threshold),
        "seed": seed,
    }
    with jax.enable_x64(True), _one_blas_thread():
        chunk = min(sampler.num_samples, CHUNK)
        chains = _Chains.start(fit, num_chains=sampler.num_chains, chunk=chunk, seed=seed)
        chains = replace(chains.extended(sampler.num_warmup), draws=())
        wanted = sampler.num_samples
        while True:
            chains = chains.extended(wanted - chains.length)
            report = chain_convergence(chains.collected("coordinates", wanted) @ fit.factors.loadings.T)
            if report.converged() or 2 * wanted > sampler.max_samples:
                break
            wanted *= 2
    return _tree(differences, fit, chains, wanted, report, settings)


@dataclass(frozen=True)
class GaussianFit:
    """A posterior's thin factorisation and its Gaussian approximation.

    Attributes:
      factors: Ψ = L Qᵀ.
      likelihood: p.
      prior_scale: σ.
      approximation: expectation propagation's, of z.
      log_evidence: its log marginal likelihood of all answers, rows of zero included.
    """

    factors: LowRank
    likelihood: Likelihood
    prior_scale: float
    approximation: GaussianApproximation
    log_evidence: float


def fit_gaussian(
    differences: np.ndarray,
    model: PreferenceModel,
    *,
    indifferent: np.ndarray | None = None,
    number_of_preferences: int | None = None,
) -> GaussianFit:
    """Factorise the differences (K, D) and fit a Gaussian by expectation propagation: how `sample_posterior` begins.

    Args:
      differences, indifferent, number_of_preferences: as of `sample_posterior`.
      model: prior and likelihood.
    """
    differences = _checked(differences)
    number = len(differences)
    tied = np.zeros(number, dtype=bool) if indifferent is None else np.asarray(indifferent)
    if tied.shape != (number,) or tied.dtype != bool:
        raise ValueError(f"indifferent: expected bool of shape ({number},), got {tied.dtype} of shape {tied.shape}")
    likelihood = model.answer_likelihood(number if number_of_preferences is None else number_of_preferences, tied)
    with _one_blas_thread():
        return _fit_gaussian(differences, model.prior_scale, likelihood)


def _fit_gaussian(differences: np.ndarray, prior_scale: float, likelihood: Likelihood) -> GaussianFit:
    factors = low_rank(differences)
    used = used_rows(factors.loadings)
    mixture = likelihood.probit_mixture().of(used)
    approximation = expectation_propagation(factors.loadings[used], mixture, prior_scale=prior_scale)
    log_evidence = approximation.log_evidence
    if not np.all(used):  # rows of zeros have a factor of their own; else nothing is compiled for a new K
        log_evidence += float(np.sum(np.log(prob(likelihood, np.zeros(len(used)))[~used])))
    return GaussianFit(factors, likelihood, prior_scale, approximation, log_evidence)


@cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


def _one_blas_thread() -> Any:
    """NumPy and SciPy bring a BLAS each, whose idle threads wait for work by spinning: on matrices as small as ours
    that costs a factor of ten from K = 80 on (K = 160, two cores: 2.9 s instead of 0.14 s for the Gaussian fit)."""
    return _blas().limit(limits=1, user_api="blas")


@dataclass(frozen=True)
class _Chains:
    """Chains that can be extended, a chunk of fixed length at a time, by one compiled sampler."""

    problem: PreferenceProblem
    state: EllipticalSliceState
    chunk: int
    rank: int
    number: int
    draws: tuple[dict[str, np.ndarray], ...] = ()

    @classmethod
    def start(cls, fit: GaussianFit, *, num_chains: int, chunk: int, seed: int) -> "_Chains":
        loadings, approximation = fit.factors.loadings, fit.approximation
        site_precisions = np.zeros(len(loadings))
        site_precisions[used_rows(loadings)] = REFERENCE_POWER * approximation.site_precisions
        problem = padded_problem(
            loadings,
            fit.likelihood,
            prior_scale=fit.prior_scale,
            mean=approximation.mean,
            site_precisions=site_precisions,
        )
        # from the reference, which is wider than the posterior's bulk: those that agree have forgotten their start
        noise = np.random.default_rng(seed).standard_normal((num_chains, len(problem.centre)))
        start = np.asarray(problem.centre) + noise @ np.asarray(problem.root).T
        start, zeros = jnp.asarray(start), jnp.zeros(num_chains)
        keys = jax.random.split(jax.random.key(seed), num_chains)
        state = EllipticalSliceState({"utility_weights": start}, zeros, zeros, zeros.astype(bool), keys)
        return cls(problem, state, chunk, loadings.shape[1], len(loadings))

    @property
    def length(self) -> int:
        return sum(len(part["lp"][0]) for part in self.draws)

    def extended(self, more: int) -> "_Chains":
        """At least `more` draws longer."""
        draws, state = list(self.draws), self.state
        for _ in range(-(-more // self.chunk)):
            state, states, answers = _run(state, self.problem, length=self.chunk)
            draws.append(
                {
                    "coordinates": np.asarray(states.z["utility_weights"])[:, :, : self.rank],
                    "answers": np.asarray(answers)[:, :, : self.number],
                    "lp": np.asarray(states.log_likelihood),
                    "candidates": np.asarray(states.candidates),
                    "stuck": np.asarray(states.stuck),
                }
            )
        return replace(self, state=state, draws=tuple(draws))

    def collected(self, name: str, length: int) -> np.ndarray:
        return np.concatenate([part[name] for part in self.draws], axis=1)[:, :length]


def _ellipses(model_args: tuple, model_kwargs: dict) -> list:
    (problem,) = model_args
    return [(reference_ellipse(problem), REFERENCE_MOVES), (prior_ellipse(problem), PRIOR_MOVES)]


def _log_likelihood(z: dict, model_args: tuple, model_kwargs: dict) -> jax.Array:
    (problem,) = model_args
    return total_log_prob(problem.likelihood, problem.loadings @ z["utility_weights"], problem.used)


# The same kernel as for numpyro.infer.MCMC, which compiles anew on every run; this loop does once for each capacity.
KERNEL = EllipticalSlice(low_rank_model, batch=8, ellipses=_ellipses, log_likelihood=_log_likelihood)


# Half the compiler's effort is lost on a loop of small vectors: level 1 compiles faster and runs as fast.
@partial(jax.jit, static_argnames="length", compiler_options={"xla_backend_optimization_level": 1})
def _run(
    state: EllipticalSliceState, problem: PreferenceProblem, *, length: int
) -> tuple[EllipticalSliceState, EllipticalSliceState, jax.Array]:
    """`length` draws of all chains: the last state, all states (chain, draw, ...), and log p of each answer at each."""

    def draw(state, _):
        state = KERNEL.sample(state, (problem,), {})
        return state, state._replace(rng_key=jnp.zeros(()))

    last, states = lax.scan(draw, state, None, length=length)
    states = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1) if x.ndim > 1 else x, states)
    answers = log_prob(problem.likelihood, states.z["utility_weights"] @ problem.loadings.T)
    return last, states, answers


def _checked(differences: np.ndarray) -> np.ndarray:
    differences = checks.matrix("differences", differences)
    if differences.shape[1] == 0:
        raise ValueError(f"differences: expected shape (K, D >= 1), got {differences.shape}")
    return differences


def _tree(
    differences: np.ndarray, fit: GaussianFit, chains: _Chains, length: int, report: Convergence, settings: dict
) -> xr.DataTree:
    sample, answer = ("chain", "draw"), ("chain", "draw", "preference")
    z = chains.collected("coordinates", length)
    answers, stuck = chains.collected("answers", length), chains.collected("stuck", length)
    lp, candidates = np.sum(answers, axis=2), chains.collected("candidates", length)
    labels = {"chain": np.arange(z.shape[0]), "draw": np.arange(length)}
    tied = getattr(fit.likelihood, "indifferent", np.zeros(len(differences), dtype=bool))
    root = xr.Dataset(
        {
            "utility_weights_mean": ("feature", fit.factors.basis @ z.mean(axis=(0, 1))),
            "utility_weights_most_likely": (
                "feature",
                fit.factors.basis @ z[np.unravel_index(np.argmax(lp), lp.shape)],
            ),
        },
        attrs={
            "log_evidence": fit.log_evidence,
            "log_evidence_converged": int(fit.approximation.converged),
            "rhat_max": report.rhat_max,
            "effective_sample_size_min": min(report.effective_sample_size_min, float(lp.size)),
            "converged": int(report.converged()),
            "stuck": int(np.sum(stuck)),
            **settings,
        },
    )
    posterior = xr.Dataset(
        {"margins": (answer, z @ fit.factors.loadings.T), "coordinates": ((*sample, "coordinate"), z)}, labels
    )
    statistics = {"lp": (sample, lp), "candidates": (sample, candidates), "stuck": (sample, stuck)}
    return xr.DataTree.from_dict(
        {
            "/": root,
            "/posterior": _with_weights(posterior, fit.factors.basis, settings),
            "/sample_stats": xr.Dataset(statistics, labels),
            "/log_likelihood": xr.Dataset({"answers": (answer, answers)}, labels),
            "/observed_data": xr.Dataset({"answers": ("preference", (~tied).astype(np.int8))}),
            "/constant_data": xr.Dataset({"differences": (("preference", "feature"), differences)}),
        }
    )


def _with_weights(posterior: xr.Dataset, basis: np.ndarray, settings: Any) -> xr.Dataset:
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
