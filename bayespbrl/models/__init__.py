"""Densities and how to sample them."""
