"""The comparisons, the data of step 1, as differences of features (paper, eq. 5)."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from bayespbrl import checks
from bayespbrl.features import StateFeatures
from bayespbrl.models import Answers
from bayespbrl.preferences import pair_differences
from bayespbrl.trajectories import Trajectory, trajectory_features

LEAST_DIFFERENCE = 1e-290  # of feature sums; what is divided by a smaller one may be no number


@dataclass(frozen=True)
class Comparisons:
    """The trajectories that some answer is about, and the pairs that follow from the answers.

    Attributes:
      trajectories: n of them.
      pairs: K pairs (preferred, dominated) of their numbers; the order of a tie does not matter.
      discount: γ of ψ.
      answers: which of them are ties, which side was shown first, and who answered.
    """

    trajectories: tuple[Trajectory, ...]
    pairs: tuple[tuple[int, int], ...]
    discount: float
    answers: Answers = field(default_factory=Answers)

    @classmethod
    def among(
        cls,
        trajectories: Sequence[Trajectory],
        pairs: Sequence[tuple[int, int]],
        *,
        discount: float,
        ties: Sequence[tuple[int, int]] = (),
        sides: Sequence[int] | None = None,
        answered_by: Sequence[str] | None = None,
    ) -> "Comparisons":
        """Those of `trajectories` that `pairs` and `ties` name, or the first where they name none.

        Args:
          trajectories: by number.
          pairs, ties: of their numbers.
          discount: γ of ψ.
          sides: of the pairs and then the ties, as in `Source`; where there are any, a side bias is inferred.
          answered_by: names, of the pairs and then the ties; each person has a lapse rate and a side bias. Where nobody
            has a name, all are one person.
        """
        every = (*pairs, *ties)
        numbers = sorted({number for pair in every for number in pair} or {0})
        row = {number: position for position, number in enumerate(numbers)}
        tied = np.arange(len(every)) >= len(pairs)
        return cls(
            tuple(trajectories[n] for n in numbers),
            tuple((row[i], row[j]) for i, j in every),
            discount,
            Answers(
                indifferent=tied if ties else None,
                shown_first=None if sides is None or not any(sides) else np.array(sides),
                answerers=np.array(answered_by) if answered_by is not None and any(answered_by) else None,
            ),
        )

    @property
    def ordered(self) -> np.ndarray:
        """Which pairs state an order, shape (K,) bool."""
        return ~self.answers.tied(len(self.pairs))

    def feature_sums(self, features: StateFeatures) -> Float[np.ndarray, "n d"]:
        """ψ(τ) of each trajectory."""
        return trajectory_features(self.trajectories, features, discount=self.discount)

    def differences(self, feature_sums: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "k d"]:
        """ψ(preferred) − ψ(dominated) of each pair."""
        with np.errstate(over="ignore"):  # what is no number is refused by name
            return pair_differences(self.pairs, feature_sums)


def normalised(differences: Float[np.ndarray, "k d"]) -> tuple[Float[np.ndarray, "k d"], float]:
    """Differences divided by their root mean square length, and that length.

    Decision: under w ~ N(0, I) the margins wᵀψ then have the variance 1 in the mean over the answers, whatever the
    features. The answers do not tell the amplitude of the utility. Fixed like this it is the same under all settings of
    the features, so that a setting counts in a mean of utilities by its probability alone; and steepness, tie threshold
    and side bias mean the same under each. Differences that are all below `LEAST_DIFFERENCE` count as 0.
    """
    largest = float(np.max(np.abs(differences), initial=0.0))
    checks.finite("feature_sums: differences", largest)  # of two that are near the largest number
    if 0.0 < largest < LEAST_DIFFERENCE:
        return np.zeros_like(differences), 1.0
    if largest and not 1e-150 < largest < 1e150:  # its square is no number
        scaled, scale = normalised(differences / largest)
        return scaled, scale * largest
    scale = float(np.sqrt(np.mean(np.sum(differences**2, axis=1)))) if len(differences) else 1.0
    scale = scale or 1.0
    return differences / scale, scale
