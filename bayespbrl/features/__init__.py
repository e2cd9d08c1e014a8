"""State features φ(s) and state-action features φ(s, a): one-hot and radial basis functions (paper, step 1).

Features are callables on NumPy arrays, drawn anew at each iteration from the observed samples. Each is a frozen
dataclass of arrays and numbers, so that a run can store what it used. A user's own state features are any function of
observations, in any units; `OwnFeatures` checks and scales what it returns.

functions   what features are: functions of arrays, checked
discrete    of discrete states
radial      radial basis functions
drawn       those of an environment, drawn at what was observed
"""

from bayespbrl.features.discrete import DiffusionBasis, OneHot, diffusion_basis
from bayespbrl.features.drawn import FeatureSource, StateActionProduct, draw_state_action_features, draw_state_features
from bayespbrl.features.functions import (
    OwnFeatures,
    StateActionFeatures,
    StateFeatures,
    checked_features,
    linear,
    ranges,
)
from bayespbrl.features.radial import JointRadialBasis, RadialBasis, RadialBasisOptions

__all__ = [
    "DiffusionBasis",
    "FeatureSource",
    "JointRadialBasis",
    "OneHot",
    "OwnFeatures",
    "RadialBasis",
    "RadialBasisOptions",
    "StateActionFeatures",
    "StateActionProduct",
    "StateFeatures",
    "checked_features",
    "diffusion_basis",
    "draw_state_action_features",
    "draw_state_features",
    "linear",
    "ranges",
]
