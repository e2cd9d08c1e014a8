"""What was compared: the data of step 1, as differences of features (paper, eq. 5)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from bayespbrl.features import RadialBasis, StateFeatures
from bayespbrl.preferences import pair_differences
from bayespbrl.trajectories import Trajectory, trajectory_features


@dataclass(frozen=True)
class Comparisons:
    """The trajectories that some answer is about, and the ordered pairs that follow from the answers.

    Attributes:
      trajectories: n of them.
      pairs: K ordered pairs (preferred, dominated) of their numbers.
      discount: γ of ψ.
    """

    trajectories: tuple[Trajectory, ...]
    pairs: tuple[tuple[int, int], ...]
    discount: float

    @classmethod
    def among(
        cls, trajectories: Sequence[Trajectory], pairs: Sequence[tuple[int, int]], *, discount: float
    ) -> "Comparisons":
        """Those of `trajectories` that `pairs` name, or the first where they name none: others cost no features."""
        numbers = sorted({number for pair in pairs for number in pair} or {0})
        row = {number: position for position, number in enumerate(numbers)}
        return cls(tuple(trajectories[n] for n in numbers), tuple((row[i], row[j]) for i, j in pairs), discount)

    def feature_sums(self, features: StateFeatures) -> Float[np.ndarray, "n d"]:
        """ψ(τ) of each trajectory."""
        return trajectory_features(self.trajectories, features, discount=self.discount)

    def scaled_differences(self, features: StateFeatures) -> tuple[Float[np.ndarray, "k d"], float]:
        """`scaled_differences` of the pairs under φ."""
        return scaled_differences(pair_differences(self.pairs, self.feature_sums(features)))


def scaled_differences(differences: Float[np.ndarray, "k d"]) -> tuple[Float[np.ndarray, "k d"], float]:
    """Differences divided by their largest absolute entry, and that entry.

    Decision: prior scale and steepness apply to differences of this size, so that they need no unit.
    """
    scale = float(np.max(np.abs(differences), initial=0.0)) or 1.0
    return differences / scale, scale


def number_of_bandwidths(features: StateFeatures) -> int:
    """S where φ has a bandwidth in each state dimension, 0 where it has none."""
    return len(features.bandwidths) if isinstance(features, RadialBasis) else 0


def rescaled(features: StateFeatures, multiples: ArrayLike) -> StateFeatures:
    """φ with `multiples` of its bandwidths, where it has any."""
    return features.rescaled(multiples) if isinstance(features, RadialBasis) else features
