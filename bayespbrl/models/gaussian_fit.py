"""A posterior's thin factorisation and Gaussian approximation: where sampling begins, and the marginal likelihood."""

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from bayespbrl import checks
from bayespbrl.models.expectation_propagation import GaussianApproximation, expectation_propagation
from bayespbrl.models.likelihoods import Likelihood, WithLapses, has_steps, prob, ties_of
from bayespbrl.models.low_rank import LowRank, low_rank, used_rows
from bayespbrl.models.preference_model import PreferenceModel
from bayespbrl.models.threads import one_blas_thread

NOW_AND_THEN = 0.05  # lapse rate of the Gaussian where answers without lapses contradict each other
# Those of which the most probable Gaussian is taken, where answers are more than these nats below coin tosses, and at
# least so many for each dimension.
MORE_LAPSES, BELOW_CHANCE, FOR_EACH_DIMENSION = (0.3, 0.55, 0.8), 10.0, 2


@dataclass(frozen=True)
class GaussianFit:
    """A posterior's thin factorisation and its Gaussian approximation.

    Attributes:
      differences: Ψ, whose rows are ψ(preferred) − ψ(dominated).
      model: prior and likelihood.
      factors: Ψ = L Qᵀ.
      likelihood: p of these answers.
      approximation: expectation propagation's, of z.
      log_evidence: expectation propagation's log marginal likelihood of all answers, rows of zeros included, nats;
        where the approximation is that of more lapses, under these. It decides where chains start.
    """

    differences: Float[np.ndarray, "k d"]
    model: PreferenceModel
    factors: LowRank
    likelihood: Likelihood
    approximation: GaussianApproximation
    log_evidence: float


def fit_gaussian(
    differences: ArrayLike,
    model: PreferenceModel,
    *,
    indifferent: ArrayLike | None = None,
    number_of_preferences: int | None = None,
) -> GaussianFit:
    """Factorise the differences (K, D) and fit a Gaussian by expectation propagation.

    Args:
      differences, indifferent, number_of_preferences: as in `sample_posterior`.
      model: prior and likelihood; what it infers is at its prior's mean.
    """
    differences = checks.matrix("differences", differences)
    number, dimension = differences.shape
    if dimension == 0:
        raise ValueError(f"differences: expected shape (K, D >= 1), got {differences.shape}")
    tied = None if indifferent is None else checks.flags("indifferent", indifferent, number)
    known = number if number_of_preferences is None else number_of_preferences
    which = _which_tied(tied, model, number)
    likelihood = model.answer_likelihood(known, which)
    with one_blas_thread():
        factors = low_rank(differences)
        used = used_rows(factors.loadings)
        approximation = _approximation(factors, likelihood, model.prior_scale)
        log_evidence = approximation.log_evidence
        if not np.all(used):
            log_evidence += _of_zero_rows(model, known, which, ~used)
    return GaussianFit(differences, model, factors, likelihood, approximation, log_evidence)


def refitted(
    fit: GaussianFit, model: PreferenceModel, number_of_preferences: int, tied: ArrayLike | None, *, widening: bool
) -> GaussianFit:
    """The same factorisation and likelihood with the Gaussian of another model, in which nothing is left to infer.

    `widening` is for many answers: the factor of a violated answer may widen the Gaussian, where that converges.
    """
    likelihood = model.answer_likelihood(number_of_preferences, _which_tied(tied, model, len(fit.differences)))
    with one_blas_thread():
        approximation = None
        if widening:
            with suppress(np.linalg.LinAlgError):  # wider than the prior allows
                approximation = _approximation(fit.factors, likelihood, model.prior_scale, widening=True)
        if approximation is None or not approximation.converged:
            approximation = _approximation(fit.factors, likelihood, model.prior_scale)
        return replace(fit, approximation=approximation)


def _of_zero_rows(model: PreferenceModel, known: int, tied: ArrayLike | None, zero: np.ndarray) -> float:
    """Σ log p of the answers whose rows are zero, by those of a preference and of a tie: a new K compiles nothing."""
    either = None if tied is None else np.array([False, True])
    logarithms = np.log(prob(model.answer_likelihood(known, either), np.zeros(2)))
    kinds = np.zeros(len(zero), dtype=int) if tied is None else np.asarray(tied, dtype=int)
    return float(np.sum(logarithms[kinds][zero]))


def _which_tied(tied: ArrayLike | None, model: PreferenceModel, number: int) -> ArrayLike | None:
    """None of K answers where a threshold is given and nobody was undecided: K of eq. 8 may be another."""
    return np.zeros(number, dtype=bool) if tied is None and model.tie_threshold is not None else tied


def _approximation(
    factors: LowRank, likelihood: Likelihood, prior_scale: float, *, widening: bool = False
) -> GaussianApproximation:
    """Expectation propagation's Gaussian.

    Decision: where answers contradict each other and nobody lapses, each is a step that squeezes the Gaussian between
    them, until it is a thousandth as wide as the posterior: chains would all start at one point. It is then that of
    answerers who lapse now and then. Answers that contradict each other more often than the lapse rate allows squeeze
    it too, and a setting with such a reference is never entered. Where many about few dimensions are far less probable
    than coin tosses, it is the most probable of those of larger lapse rates. (With a quarter of 40 answers about two
    features wrong, and a lapse rate of 0.125, no chain had a draw of four settings out of five, which have 0.81 of the
    posterior.)
    """
    used = used_rows(factors.loadings)
    loadings = factors.loadings[used]

    def fitted(answers: Likelihood) -> GaussianApproximation:
        mixture = answers.probit_mixture().of(used)
        return expectation_propagation(loadings, mixture, prior_scale=prior_scale, widening=widening)

    fit = fitted(likelihood)
    if not has_steps(likelihood):
        return fit
    if isinstance(likelihood, WithLapses):
        number, dimension = loadings.shape
        by_chance = -np.log(likelihood.choices) * number
        if number < FOR_EACH_DIMENSION * dimension or fit.log_evidence >= by_chance - BELOW_CHANCE:
            return fit
        rates = [rate for rate in MORE_LAPSES if rate > likelihood.lapse_rate]
        fits = [fit, *(fitted(replace(likelihood, lapse_rate=rate)) for rate in rates)]
        return max(fits, key=lambda each: np.nan_to_num(each.log_evidence, nan=-np.inf))
    ties = ties_of(likelihood)
    ordered = np.ones(len(loadings), dtype=bool) if ties is None else ~np.asarray(ties.indifferent)[used]
    if np.all(loadings[ordered] @ fit.mean >= 0):
        return fit
    return replace(fitted(WithLapses(likelihood, NOW_AND_THEN)), log_evidence=fit.log_evidence)
