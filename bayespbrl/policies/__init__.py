"""Stochastic policies: tabular, softmax, linear-Gaussian, Gaussian process."""
