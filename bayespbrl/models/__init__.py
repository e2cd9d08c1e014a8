"""Densities and how to sample them."""

from bayespbrl.models.elliptical_slice import EllipticalSlice
from bayespbrl.models.hyperparameters import (
    Candidate,
    HyperparameterSearch,
    HyperparameterWeights,
    search_hyperparameters,
    select_hyperparameters,
)
from bayespbrl.models.linear_program import LinearProgramResult, linear_program
from bayespbrl.models.posterior import restored, sample_posterior, stored
from bayespbrl.models.preference_model import preference_model

__all__ = [
    "Candidate",
    "EllipticalSlice",
    "HyperparameterSearch",
    "HyperparameterWeights",
    "LinearProgramResult",
    "linear_program",
    "preference_model",
    "restored",
    "sample_posterior",
    "search_hyperparameters",
    "select_hyperparameters",
    "stored",
]
