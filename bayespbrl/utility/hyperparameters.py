"""Length scales, steepness and lapse rate that the answers speak for (specification, section 8)."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from bayespbrl.features import RadialBasis
from bayespbrl.models import Candidate, search_hyperparameters
from bayespbrl.preferences import pair_differences
from bayespbrl.trajectories import Trajectory, trajectory_features
from bayespbrl.utility.estimate import StateFeatures, compared, scaled_differences

# What the evidence chooses from: multiples of the bandwidths and of the steepness as given, and lapse rates. Posteriors
# under σ and m depend on σ·m alone (eq. 8 is a step and a sigmoid of m·t), so σ needs no axis of its own.
BANDWIDTH_MULTIPLES = (0.25, 0.5, 1.0, 2.0, 4.0)
STEEPNESS_MULTIPLES = (0.2, 1.0, 5.0)
LAPSE_RATES = (0.0, 0.1, 0.4)


@dataclass(frozen=True)
class HyperparameterChoice:
    """What the answers speak for.

    Attributes:
      features: φ with the length scales that were chosen.
      steepness, lapse_rate: of the likelihood.
      bandwidth_multiples: of the features as given, one a state dimension; empty for features without bandwidths.
      log_evidence: log p(answers | this choice) by expectation propagation, nats.
      gain: log evidence over that of the settings as given, nats.
      weight: posterior probability among the settings examined, each as likely as the others beforehand.
      examined: how many there were.
    """

    features: StateFeatures
    steepness: float
    lapse_rate: float
    bandwidth_multiples: tuple[float, ...]
    log_evidence: float
    gain: float
    weight: float
    examined: int

    def summary(self) -> dict[str, float | int | list[float]]:
        """All but the features, as plain data."""
        figures = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "features"}
        return figures | {"bandwidth_multiples": list(self.bandwidth_multiples)}


def choose_hyperparameters(
    trajectories: Sequence[Trajectory],
    pairs: Sequence[tuple[int, int]],
    features: StateFeatures,
    *,
    discount: float,
    prior_scale: float = 1.0,
    steepness: float = 5.0,
    lapse_rate: float = 0.0,
    likelihood: str = "mixed",
) -> HyperparameterChoice:
    """The length scale in each state dimension, the steepness and the lapse rate that make the answers most likely.

    Only trajectories that were compared matter, so the cost does not grow with those that were not.

    Args:
      trajectories, pairs, discount, prior_scale, likelihood: as of `utility.estimate_utility`.
      features: φ to begin with; its bandwidths are chosen where it is a `RadialBasis`.
      steepness, lapse_rate: to begin with.

    Source: specification, section 8: the utility's length scale is chosen by evidence.
    """
    shown, rows = compared(trajectories, pairs)
    dimensions = number_of_bandwidths(features)
    differences: dict[tuple[float, ...], np.ndarray] = {}

    def candidate(point: tuple[float, ...]) -> Candidate:
        multiples, (relative_steepness, lapses) = point[:dimensions], point[dimensions:]
        if multiples not in differences:
            differences[multiples] = rescaled_differences(shown, rows, features, multiples, discount=discount)[0]
        return Candidate(
            differences[multiples],
            prior_scale=prior_scale,
            steepness=steepness * relative_steepness,
            lapse_rate=lapses,
            likelihood=likelihood,
        )

    start = (*[1.0] * dimensions, 1.0, float(lapse_rate))
    if not pairs:
        return HyperparameterChoice(features, steepness, lapse_rate, start[:dimensions], 0.0, 0.0, 1.0, 1)
    axes = [*[BANDWIDTH_MULTIPLES] * dimensions, STEEPNESS_MULTIPLES, sorted({*LAPSE_RATES, float(lapse_rate)})]
    search = search_hyperparameters(candidate, axes, start=start, together=dimensions)
    log_evidence = search.weighed.log_evidence
    return HyperparameterChoice(
        rescaled(features, search.best[:dimensions]),
        steepness * search.best[dimensions],
        search.best[dimensions + 1],
        search.best[:dimensions],
        float(log_evidence[search.reached]),
        float(log_evidence[search.reached] - log_evidence[0]),
        float(search.weighed.weights[search.reached]),
        len(search.points),
    )


def number_of_bandwidths(features: StateFeatures) -> int:
    """S where φ has a bandwidth in each state dimension, 0 where it has none."""
    return len(features.bandwidths) if isinstance(features, RadialBasis) else 0


def rescaled(features: StateFeatures, multiples: ArrayLike) -> StateFeatures:
    """φ with `multiples` of its bandwidths, where it has any."""
    return features.rescaled(multiples) if isinstance(features, RadialBasis) else features


def rescaled_differences(
    shown: Sequence[Trajectory],
    rows: Sequence[tuple[int, int]],
    features: StateFeatures,
    multiples: ArrayLike,
    *,
    discount: float,
) -> tuple[np.ndarray, float]:
    """`scaled_differences` of what was `compared`, with `multiples` of the bandwidths of φ."""
    sums = trajectory_features(shown, rescaled(features, multiples), discount=discount)
    return scaled_differences(pair_differences(rows, sums))
