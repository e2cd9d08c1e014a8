"""Step 1: from preferences to an estimate of the expert's utility.

comparisons        the data: differences of features (eq. 5)
inference          the estimate by the chosen method, and the posterior without a learner
estimate, quality  the protocol of all estimates, and how far one can be trusted
posterior_utility  the posterior over everything, and the utility that is acted on (eqs. 7-8)
point_estimates    the linear program (eq. 10) and the known reward
length_scales      the settings of the features that the posterior is over
"""

from bayespbrl.utility.estimate import UtilityEstimate
from bayespbrl.utility.inference import infer_utility
from bayespbrl.utility.point_estimates import KnownReward, LinearProgramUtility
from bayespbrl.utility.posterior_utility import PosteriorUtility
from bayespbrl.utility.quality import FitQuality

__all__ = [
    "FitQuality",
    "KnownReward",
    "LinearProgramUtility",
    "PosteriorUtility",
    "UtilityEstimate",
    "infer_utility",
]
