"""Length scales, steepness and lapse rate that maximise the marginal likelihood of the answers."""

from dataclasses import dataclass, replace

import numpy as np

from bayespbrl.features import StateFeatures
from bayespbrl.models import PreferenceModel, fit_gaussian, search_hyperparameters
from bayespbrl.utility.comparisons import Comparisons, number_of_bandwidths, rescaled

# The grid: multiples of the bandwidths and of the steepness as given, and lapse rates. The posterior depends on σ and m
# through σ·m alone (eq. 8 is a step and a sigmoid of m·t), so σ needs no axis.
BANDWIDTH_MULTIPLES = (0.25, 0.5, 1.0, 2.0, 4.0)
STEEPNESS_MULTIPLES = (0.2, 1.0, 5.0)
LAPSE_RATES = (0.0, 0.1, 0.4)


@dataclass(frozen=True)
class HyperparameterChoice:
    """The setting of highest marginal likelihood.

    Attributes:
      features: φ with the chosen length scales.
      model: with the chosen steepness and lapse rate.
      bandwidth_multiples: of the features as given, one a state dimension; empty for features without bandwidths.
      log_evidence: log p(answers | this setting) by expectation propagation, nats.
      gain: log evidence over that of the setting as given, nats.
      weight: posterior probability among the settings examined, under a uniform prior.
      examined: how many there were.
    """

    features: StateFeatures
    model: PreferenceModel
    bandwidth_multiples: tuple[float, ...] = ()
    log_evidence: float = 0.0
    gain: float = 0.0
    weight: float = 1.0
    examined: int = 1

    def summary(self) -> dict[str, float | int | list[float]]:
        """The figures as plain data."""
        return {
            "steepness": self.model.steepness,
            "lapse_rate": self.model.lapse_rate,
            "bandwidth_multiples": list(self.bandwidth_multiples),
            "log_evidence": self.log_evidence,
            "gain": self.gain,
            "weight": self.weight,
            "examined": self.examined,
        }


def choose_hyperparameters(
    comparisons: Comparisons, features: StateFeatures, model: PreferenceModel
) -> HyperparameterChoice:
    """Climb the marginal likelihood over length scales (one a state dimension), steepness and lapse rate.

    Args:
      comparisons: the answers.
      features: φ to begin with; its bandwidths are chosen where it is a `RadialBasis`.
      model: prior and likelihood to begin with.
    """
    dimensions = number_of_bandwidths(features)
    differences: dict[tuple[float, ...], np.ndarray] = {}

    def with_values(steepness: float, lapse_rate: float) -> PreferenceModel:
        return replace(model, steepness=model.steepness * steepness, lapse_rate=lapse_rate)

    def log_evidence(point: tuple[float, ...]) -> float:
        multiples = point[:dimensions]
        if multiples not in differences:
            differences[multiples] = comparisons.scaled_differences(rescaled(features, multiples))[0]
        return fit_gaussian(differences[multiples], with_values(*point[dimensions:])).log_evidence

    start = (*[1.0] * dimensions, 1.0, float(model.lapse_rate))
    if not comparisons.pairs:
        return HyperparameterChoice(features, model, start[:dimensions])
    axes = [*[BANDWIDTH_MULTIPLES] * dimensions, STEEPNESS_MULTIPLES, sorted({*LAPSE_RATES, float(model.lapse_rate)})]
    search = search_hyperparameters(log_evidence, axes, start=start, together=dimensions)
    return HyperparameterChoice(
        rescaled(features, search.best[:dimensions]),
        with_values(*search.best[dimensions:]),
        search.best[:dimensions],
        float(search.log_evidence[search.reached]),
        float(search.log_evidence[search.reached] - search.log_evidence[0]),
        float(search.weights[search.reached]),
        len(search.points),
    )
