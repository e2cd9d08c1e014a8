"""Which length scale, prior scale and steepness the answers speak for: weights by their log marginal likelihood.

Expectation propagation gives the log evidence log p(answers | candidate) for the price of one Gaussian fit.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from bayespbrl.models.likelihoods import preference_likelihood
from bayespbrl.models.posterior import fit_gaussian


@dataclass(frozen=True)
class Candidate:
    """One setting to be weighed; `differences` carries its features, and so its length scale.

    Attributes:
      differences: ψ(preferred) − ψ(dominated), shape (K, D), D as this candidate's features have it.
      prior_scale, steepness, lapse_rate, likelihood: as in `sample_posterior`.
      log_prior: log of the weight that the candidate had before the answers, up to a constant.
    """

    differences: np.ndarray
    prior_scale: float = 1.0
    steepness: float = 5.0
    lapse_rate: float = 0.0
    likelihood: str = "mixed"
    log_prior: float = 0.0


@dataclass(frozen=True)
class HyperparameterWeights:
    """What the answers say about the candidates, in their order.

    Attributes:
      weights: posterior probability of each, shape (C,), summing to 1.
      log_evidence: log p(answers | candidate) by expectation propagation, shape (C,).
      converged: whether each fit did, shape (C,) bool.
    """

    weights: np.ndarray
    log_evidence: np.ndarray
    converged: np.ndarray

    @property
    def best(self) -> int:
        """Index of the candidate of highest weight."""
        return int(np.argmax(self.weights))


def select_hyperparameters(candidates: Sequence[Candidate]) -> HyperparameterWeights:
    """Weigh candidates by p(candidate | answers) ∝ p(answers | candidate) p(candidate).

    All candidates must be about the same answers: the same K.

    Raises:
      ValueError: no candidates, candidates of different K, or an argument out of its range.
    """
    if not candidates:
        raise ValueError("candidates: expected at least one, got none")
    numbers = sorted({len(candidate.differences) for candidate in candidates})
    if len(numbers) > 1:
        raise ValueError(f"candidates: expected the same number of answers K in each, got {numbers}")
    fits = []
    for c in candidates:
        likelihood = preference_likelihood(
            c.likelihood, steepness=c.steepness, number_of_preferences=numbers[0], lapse_rate=c.lapse_rate
        )
        fits.append(fit_gaussian(c.differences, prior_scale=c.prior_scale, likelihood=likelihood))
    log_evidence = np.array([fit.log_evidence for fit in fits])
    log_weights = log_evidence + np.array([candidate.log_prior for candidate in candidates])
    return HyperparameterWeights(
        np.exp(log_weights - logsumexp(log_weights)),
        log_evidence,
        np.array([fit.approximation.converged for fit in fits]),
    )
