"""Densities and how to sample them.

preference_model         σ, m, λ, likelihood and ties in one object; eqs. 7-8 in NumPyro
priors                   of what is inferred besides the weights
likelihoods              the probability of an answer given a margin: eq. 8, lapses, Bradley-Terry, probit, ties
elliptical_slice         the kernel's textbook algorithm; elliptical_slice_kernel is the kernel for NumPyro
low_rank                 the part of the utility that the answers determine
expectation_propagation  a Gaussian close to the posterior, and the marginal likelihood
gaussian_fit             both of these for given answers
preference_problem       the model in low rank given all else, and the ellipses that sample it fast
gibbs                    moves over all else: length scales, steepness, lapse rates, tie threshold; chains runs both
surrogate_moves          between length scales, keeping the margins: for chains that take long to converge
step_moves               for many answers under eq. 8: flights (refraction), lapse rates with weights (lapse_transport),
                         single weights where few answers touch each (coordinate_sweep), and from mode to mode, where
                         chains take long (tempering)
split_dynamics           for many answers without steps: dynamics round the reference
evidence                 the marginal likelihood, by bridge sampling
plain_chain              the paper's sampler: a chain of fixed length
posterior                draws until the chains have converged; posterior_tree has them in ArviZ's schema
convergence              R̂, effective sample size and Monte Carlo error
linear_program           eq. 10, the alternative to the posterior
threads                  one thread of linear algebra while a run computes; independent parts in several
"""

from bayespbrl.models.elliptical_slice_kernel import EllipticalSlice
from bayespbrl.models.gaussian_fit import GaussianFit, fit_gaussian
from bayespbrl.models.linear_program import LinearProgramResult, linear_program
from bayespbrl.models.plain_chain import plain_draws
from bayespbrl.models.posterior import posterior_draws, sample_posterior
from bayespbrl.models.posterior_tree import restored, stored
from bayespbrl.models.preference_model import (
    NOTHING_ELSE,
    Answers,
    PreferenceModel,
    joint_preference_model,
    preference_model,
)

__all__ = [
    "NOTHING_ELSE",
    "Answers",
    "EllipticalSlice",
    "GaussianFit",
    "LinearProgramResult",
    "PreferenceModel",
    "fit_gaussian",
    "joint_preference_model",
    "linear_program",
    "plain_draws",
    "posterior_draws",
    "preference_model",
    "restored",
    "sample_posterior",
    "stored",
]
