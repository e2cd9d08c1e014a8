"""The settings of the features that the posterior is over: multiples of the bandwidths, one for each state dimension.

A few answers hardly tell "high is good" from "fast is good". Under one choice of length scales the posterior would be
sure of the one or the other; over all of them it says how sure the answers make it (Hoeting, Madigan, Raftery and
Volinsky 1999).
"""

import itertools

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from bayespbrl.features import RadialBasis, StateFeatures

# The prior: a uniform distribution over these multiples of the bandwidths as given, in each dimension.
MULTIPLES = (1.0, 3.0, 9.0)
MOST_SETTINGS = 27  # beyond three dimensions, so many points of the grid: the equal ones, and others at random


def settings(features: StateFeatures, *, inferred: bool, rng: np.random.Generator) -> Float[np.ndarray, "c s"]:
    """Multiples of the bandwidths of φ, one row for each of C settings; one row of ones where nothing is inferred."""
    dimensions = len(features.bandwidths) if isinstance(features, RadialBasis) else 0
    if not inferred or not dimensions:
        return np.ones((1, dimensions))
    if len(MULTIPLES) ** dimensions <= MOST_SETTINGS:
        return np.array(list(itertools.product(MULTIPLES, repeat=dimensions)))
    chosen = {(multiple,) * dimensions for multiple in MULTIPLES}
    while len(chosen) < MOST_SETTINGS:  # always as many: another number would compile the sampler anew
        chosen.add(tuple(rng.choice(MULTIPLES, size=dimensions).tolist()))
    return np.array(sorted(chosen))


def rescaled(features: StateFeatures, multiples: ArrayLike) -> StateFeatures:
    """φ with `multiples` of its bandwidths, where it has any."""
    return features.rescaled(multiples) if isinstance(features, RadialBasis) else features
