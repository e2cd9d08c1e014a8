"""Stochastic policies: tabular, softmax, linear-Gaussian, Gaussian process."""

from bayespbrl.policies.batch import entropies, log_probabilities, sample_actions
from bayespbrl.policies.gaussian_process import GaussianProcessPolicy
from bayespbrl.policies.linear_gaussian import LinearGaussianPolicy
from bayespbrl.policies.policy import Policy
from bayespbrl.policies.softmax import SoftmaxPolicy
from bayespbrl.policies.tabular import TabularPolicy

__all__ = [
    "GaussianProcessPolicy",
    "LinearGaussianPolicy",
    "Policy",
    "SoftmaxPolicy",
    "TabularPolicy",
    "entropies",
    "log_probabilities",
    "sample_actions",
]
