"""Densities and how to sample them."""

from bayespbrl.models.linear_program import LinearProgramResult, linear_program
from bayespbrl.models.posterior import restored, sample_posterior, stored

__all__ = ["LinearProgramResult", "linear_program", "restored", "sample_posterior", "stored"]
