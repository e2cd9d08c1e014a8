"""Step 1, Bayesian PBIRL: draws from p(w, all else | preferences), with their convergence (eqs. 7-8)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
import xarray as xr
from jaxtyping import Float
from numpy.typing import ArrayLike

from bayespbrl import checks
from bayespbrl.models.chains import CHUNK, LEAST_LAPSES, Chains
from bayespbrl.models.convergence import Convergence, chain_convergence
from bayespbrl.models.evidence import log_evidence
from bayespbrl.models.gaussian_fit import GaussianFit, fit_gaussian, refitted
from bayespbrl.models.likelihoods import has_steps, ties_of
from bayespbrl.models.posterior_tree import fit_attributes, margins_of, posterior_tree, settings_of
from bayespbrl.models.preference_model import NOTHING_ELSE, Answers, PreferenceModel
from bayespbrl.models.threads import one_blas_thread

# A setting that fewer draws have is not diagnosed: how many do is known too badly, and matters little.
LEAST_SHARE = 0.05
# Chains that have not converged after so many times the draws that they begin with also move by `surrogate_moves`.
LONG = 4


@dataclass(frozen=True)
class SamplerOptions:
    """Number and length of the chains; attributes as the keywords of `sample_posterior`."""

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
    differences: ArrayLike,
    *,
    prior_scale: float = PreferenceModel.prior_scale,
    steepness: float | None = PreferenceModel.steepness,
    lapse_rate: float | None = PreferenceModel.lapse_rate,
    likelihood: str = PreferenceModel.likelihood,
    indifferent: ArrayLike | None = None,
    tie_threshold: float | None = PreferenceModel.tie_threshold,
    shown_first: ArrayLike | None = None,
    answerers: ArrayLike | None = None,
    number_of_preferences: int | None = None,
    num_warmup: int = SamplerOptions.num_warmup,
    num_samples: int = SamplerOptions.num_samples,
    max_samples: int = SamplerOptions.max_samples,
    num_chains: int = SamplerOptions.num_chains,
    seed: int = 0,
) -> xr.DataTree:
    """Draw from the posterior of the utility weights w ~ N(0, σ²I) given preferences (eqs. 7-8), until it converges.

    What is None is inferred with the weights, and so is which of several settings of the features explains the answers.
    By default steepness and lapse rate are given, as in eq. 8; `infer_utility` and the learner infer both.
    The chains have converged when every margin (side biases are part of them), every hyperparameter, and membership in
    each setting that has at least a twentieth of the draws, has R̂ ≤ 1.01 and at least 400 effective draws. This is
    checked after `num_samples` draws a chain and after every doubling; where it is not met at
    `max_samples`, `converged` is 0. With several settings and at most 64 answers, chains that have not converged after
    four times `num_samples` restart from their current states with moves added (`models.surrogate_moves`), if twice as
    many are allowed; earlier draws are discarded and do not count towards the cap. Everything is computed in float64.

    Args:
      differences: ψ(preferred) − ψ(dominated), shape (K, D), used as given: divide by a scale of your choice first.
        A row of zeros has a margin of exactly zero in every draw. K = 0 gives the prior. For C settings of the features
        (length scales, or other features), equally probable a priori: shape (C, K, D).
      prior_scale: σ > 0.
      steepness: m > 0.
      lapse_rate: λ in [0, 1), the share of answers given at random.
      likelihood: "mixed" (eq. 8), "logistic" or "probit".
      indifferent: which answers were "no difference", shape (K,) bool. The sign of such a row does not matter. None:
        nobody could say so.
      tie_threshold: δ > 0: margins within it are often called ties. None: inferred where `indifferent` is given.
      shown_first: 1 where the preferred one was shown first, −1 where the other was, 0 where nothing is known, shape
        (K,). The margin by which the answerer favours the first shown is then inferred. None: nobody does.
      answerers: who gave each answer, names or numbers from 0, shape (K,): each has a lapse rate and a side bias, under
        one prior. None: one answerer.
      number_of_preferences: K of eq. 8, where it is not the number of rows (an answer held out).
      num_warmup: draws a chain that are discarded (burn-in); rounded up to whole chunks of min(num_samples, 25) draws,
        and once more as many where the references of the chains are fitted anew after it.
      num_samples: draws a chain to begin with, >= 4.
      max_samples: cap on the draws a chain.
      num_chains: >= 2, so that R̂ means something.
      seed: the same seed gives the same draws.

    Returns:
      A tree with the groups
      `posterior`: margins (chain, draw, preference); coordinates z (chain, draw, coordinate); setting (chain, draw);
        steepness (chain, draw); lapse_rate (chain, draw, answerer); tie_threshold (chain, draw) where there are ties;
        side_bias (chain, draw) where `shown_first` is known, with a dimension answerer where `answerers` are; and
        utility_weights (chain, draw, feature), those of the draw's setting; the last two are computed when indexed;
      `sample_stats`: lp (log likelihood), candidates (per move), stuck, diverging (a likelihood of zero or NaN);
      `log_likelihood`: answers (chain, draw, preference); `log_prior`: coordinates (chain, draw), the log density
        of z alone, up to a constant, by which ArviZ's `psense` weighs other prior scales; `observed_data`: answers, 1
        as given and 0 for a tie;
      `constant_data`: differences, with a dimension `setting` in front where they had one; shown_first, answerers;
      at the root: utility_weights_mean (feature), whose part outside the differences' row space is exactly zero;
        utility_weights_most_likely (feature), the draw of highest likelihood with the rest at its mean, zero (both with
        a dimension `setting` in front where there is one: each setting's part of the sum); and the attributes
        log_evidence and log_evidence_error (by bridge sampling; infinite where that cannot be told), rhat_max,
        effective_sample_size_min, converged, stuck,
        prior_scale, steepness, lapse_rate, likelihood, number_of_preferences, tie_threshold (NaN: inferred), seed.
      `stored(tree).to_netcdf(path)` writes it without the utility weights; `restored` brings them back.

    Raises:
      ValueError: an argument out of its range, named with what came.
    """
    return posterior_draws(
        differences,
        PreferenceModel(prior_scale, steepness, lapse_rate, likelihood, tie_threshold),
        seed=seed,
        answers=Answers(indifferent, shown_first, answerers),
        number_of_preferences=number_of_preferences,
        sampler=SamplerOptions(num_warmup, num_samples, max_samples, num_chains),
    )


def posterior_draws(
    differences: ArrayLike,
    model: PreferenceModel,
    *,
    seed: int,
    answers: Answers = NOTHING_ELSE,
    number_of_preferences: int | None = None,
    sampler: SamplerOptions | None = None,
) -> xr.DataTree:
    """`sample_posterior` with its options in objects; `sampler` None for the default `SamplerOptions`."""
    seed = checks.seed(seed)
    sampler = SamplerOptions() if sampler is None else sampler
    settings = settings_of(differences)
    model.check_threshold(np.sqrt(np.mean(np.sum(settings**2, axis=2), axis=1).max()) if settings.size else 0.0)
    answers = answers.checked(settings.shape[1])
    number = settings.shape[1]
    if number_of_preferences is not None:
        number = checks.whole("number_of_preferences", number_of_preferences, 0)
    fits = [
        fit_gaussian(each, model, indifferent=answers.indifferent, number_of_preferences=number)
        for each in answers.with_sides(settings, model.prior_scale)
    ]
    with jax.enable_x64(True), one_blas_thread():
        chains = Chains.start(
            fits,
            num_chains=sampler.num_chains,
            chunk=min(sampler.num_samples, CHUNK),
            seed=seed,
            by_answerer=answers.by_answerer(settings.shape[1]),
        )
        chains = chains.extended(sampler.num_warmup)
        if chains.draws and _needs_better_references(chains, fits[0], model):
            chains = _with_better_references(chains, fits, model, answers, number).extended(sampler.num_warmup)
        chains, wanted, report = _until_converged(chains, fits, sampler)
        evidence = log_evidence(chains, wanted, seed=seed)
    attributes = fit_attributes(number, seed, evidence)
    return posterior_tree(fits, chains, wanted, report, attributes, np.asarray(differences), answers)


def _until_converged(
    chains: Chains, fits: Sequence[GaussianFit], sampler: SamplerOptions
) -> tuple[Chains, int, Convergence]:
    """The chains with new draws, until they converge or up to the cap, how many draws count, and the report.

    Decision: slow chains restart from their current states with moves added. Nearly all converge before, and these
    moves would make each draw 1.5 to 1.8 times as slow.
    """
    chains, wanted = replace(chains, draws=()), sampler.num_samples
    while True:
        chains = chains.extended(wanted - chains.length)
        report = chain_convergence(_diagnosed(chains, wanted, margins_of(fits, chains, wanted)))
        if report.converged() or 2 * wanted > sampler.max_samples:
            return chains, wanted, report
        slow = wanted >= LONG * sampler.num_samples
        further = chains.with_further_moves() if slow else chains
        if further is chains:
            wanted *= 2
        else:
            chains, wanted = replace(further.extended(sampler.num_warmup), draws=()), sampler.num_samples


def _needs_better_references(chains: Chains, fit: GaussianFit, model: PreferenceModel) -> bool:
    """Whether references at the prior's means are far from the posterior.

    Those of many answers are, where their steepness or lapse rate is inferred or eq. 8 has its steps. Those of fewer
    are, where a tie threshold is inferred: under one that is much smaller than expected, weights that are moved from
    one setting to another no longer leave the margins of ties within it.
    """
    unknown = None in (model.steepness, model.lapse_rate) or has_steps(fit.likelihood)
    return unknown if chains.many else ties_of(fit.likelihood) is not None and model.tie_threshold is None


def _with_better_references(
    chains: Chains, fits: Sequence[GaussianFit], model: PreferenceModel, answers: Answers, number: int
) -> Chains:
    """The chains with references fitted at what is typical of their draws so far."""
    typical = chains.typical()
    steepness = typical["steepness"] if model.steepness is None else model.steepness
    lapse_rate = max(typical["lapse_rate"], LEAST_LAPSES) if model.lapse_rate is None else model.lapse_rate
    threshold = typical["tie_threshold"] if answers.indifferent is not None else model.tie_threshold
    given = replace(model, steepness=steepness, lapse_rate=lapse_rate, tie_threshold=threshold)
    them = [refitted(fit, given, number, answers.indifferent, widening=chains.many) for fit in fits]
    return chains.with_references(them, typical)


def _diagnosed(
    chains: Chains, length: int, margins: Float[np.ndarray, "chain draw k"]
) -> Float[np.ndarray, "chain draw n"]:
    """The quantities that must converge: margins, inferred hyperparameters, membership in each setting."""
    settings = chains.collected("setting", length)
    numbers, counts = np.unique(settings, return_counts=True)
    members = [settings == n for n, count in zip(numbers, counts, strict=True) if count >= LEAST_SHARE * settings.size]
    values = [chains.values(name, length) for name in ("steepness", "tie_threshold")]
    columns = [margins, chains.values("lapse_rate", length), *(each[..., None] for each in (*values, *members))]
    return np.concatenate(columns, axis=2)
