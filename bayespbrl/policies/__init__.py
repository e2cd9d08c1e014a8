"""Stochastic policies: tabular, softmax, linear-Gaussian, Gaussian process.

policy                   the protocol that all follow; choice says which suits an environment
tabular, softmax, linear_gaussian, gaussian_process
sparse_regression        the weighted FITC regression of the Gaussian process
hyperparameter_search    its bandwidths and variances by CMA-ES
greedy                   a policy without its noise
actor                    a policy to act with in an environment, as stable-baselines3 has them
batch                    a policy at many observations; samples checks what it is fitted to
spaces                   which spaces suit it, and actions within their bounds
"""

from bayespbrl.policies.batch import entropies, log_probabilities, sample_actions
from bayespbrl.policies.gaussian_process import GaussianProcessPolicy
from bayespbrl.policies.greedy import greedy
from bayespbrl.policies.linear_gaussian import LinearGaussianPolicy
from bayespbrl.policies.policy import Policy, Sampler, has_mode, is_discrete
from bayespbrl.policies.softmax import SoftmaxPolicy
from bayespbrl.policies.spaces import clipped
from bayespbrl.policies.tabular import TabularPolicy

__all__ = [
    "GaussianProcessPolicy",
    "LinearGaussianPolicy",
    "Policy",
    "Sampler",
    "SoftmaxPolicy",
    "TabularPolicy",
    "clipped",
    "entropies",
    "greedy",
    "has_mode",
    "is_discrete",
    "log_probabilities",
    "sample_actions",
]
