"""Densities and how to sample them.

likelihoods              what an answer says about a margin: eq. 8, lapses, Bradley-Terry, probit, ties
preference_model         eq. 7 in NumPyro, and the ellipses that make it fast to sample
elliptical_slice         the kernel, for any NumPyro model with Gaussian priors
low_rank                 the part of the utility that the answers can see
expectation_propagation  the Gaussian that the ellipses go round, and the evidence
posterior                all of these together: chains until they have converged, as a DataTree
hyperparameters          length scale, prior scale, steepness: what the answers speak for
linear_program           eq. 10, the alternative to the posterior
"""

from bayespbrl.models.elliptical_slice_kernel import EllipticalSlice
from bayespbrl.models.gaussian_fit import GaussianFit, fit_gaussian
from bayespbrl.models.hyperparameters import HyperparameterSearch, search_hyperparameters
from bayespbrl.models.linear_program import LinearProgramResult, linear_program
from bayespbrl.models.posterior import posterior_draws, sample_posterior
from bayespbrl.models.posterior_tree import restored, stored
from bayespbrl.models.preference_model import PreferenceModel, preference_model

__all__ = [
    "EllipticalSlice",
    "GaussianFit",
    "HyperparameterSearch",
    "LinearProgramResult",
    "PreferenceModel",
    "fit_gaussian",
    "linear_program",
    "posterior_draws",
    "preference_model",
    "restored",
    "sample_posterior",
    "search_hyperparameters",
    "stored",
]
