"""The KL bound of each policy update: constant, or as large as the posterior is sure of it (paper, future work).

A schedule is called once an iteration, after the utility and Q are estimated and before the policy moves, with the
`Situation`; it returns the bound in nats, or a `Bound`, which says why. Three lines make one of your own:

    def cautious(situation):
        return 0.5 if situation.update.agreement(0.5) > 0.9 else 0.1
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayespbrl.improvement import ProposedUpdate

BOUNDS = (0.1, 0.2, 0.35, 0.5, 0.7, 1.0)


@dataclass(frozen=True)
class Situation:
    """What a schedule may look at.

    Attributes:
      iteration: 1 for the first.
      answers: counted so far.
      usual_bound: the bound that the run was given, nats.
      estimate: the utility estimate of this iteration; `estimate.quality` says whether it can be trusted.
      update: what an update of any size would do, in the eyes of each posterior draw.
    """

    iteration: int
    answers: int
    usual_bound: float
    estimate: Any
    update: ProposedUpdate


@dataclass(frozen=True)
class Bound:
    """A decision and its grounds.

    Attributes:
      kl_bound: ε of eq. 11, nats.
      reason: in words.
      statistics: what it rests on, by name: plain numbers.
    """

    kl_bound: float
    reason: str = ""
    statistics: dict[str, float] = field(default_factory=dict)


Schedule = Callable[[Situation], "Bound | float"]


@dataclass(frozen=True)
class ConstantBound:
    """The same bound at every iteration: the run's, unless told; the paper's schedule."""

    kl_bound: float | None = None

    def __call__(self, situation: Situation) -> Bound:
        return Bound(situation.usual_bound if self.kl_bound is None else self.kl_bound, "constant")


@dataclass(frozen=True)
class ConfidenceBound:
    """The largest bound at which nine posterior draws in ten still find the new policy better than the old.

    Each draw of the utility has a Q-function of its own (LSTD is linear in the utility), and REPS's weights p(ε) for
    the mean Q promise it a gain of Σ (pᵢ − Wᵢ)Qᵢ. The *agreement* at ε is the share of the draws whose gain is
    positive: it asks whether the update is safe, not whether the trajectories are easy to order. A posterior that has
    not converged, or none at all, never raises the bound over the run's own.

    Attributes:
      bounds: to choose from, nats, > 0.
      confidence: the agreement that is asked for, in (0, 1].
    """

    bounds: tuple[float, ...] = BOUNDS
    confidence: float = 0.9

    def __post_init__(self) -> None:
        if not self.bounds or not all(np.isfinite(bound) and bound > 0 for bound in self.bounds):
            raise ValueError(f"bounds: expected finite numbers > 0, got {self.bounds}")
        if not 0 < self.confidence <= 1:
            raise ValueError(f"confidence: expected a share in (0, 1], got {self.confidence}")

    def __call__(self, situation: Situation) -> Bound:
        quality, update = situation.estimate.quality, situation.update
        diagnostics = {
            "rhat_max": float(quality.rhat_max),
            "effective_sample_size_min": float(quality.effective_sample_size_min),
        }
        if update.q_draws is None:
            return Bound(situation.usual_bound, "no posterior: the run's own bound", diagnostics)
        allowed = sorted(self.bounds)
        if not quality.converged:
            allowed = [bound for bound in allowed if bound <= situation.usual_bound] or [allowed[0]]
        for bound in reversed(allowed):
            agreement = update.agreement(bound)
            if agreement >= self.confidence:
                break
        reason = f"{agreement:.0%} of the draws find an update of {bound:g} nats better"
        if agreement < self.confidence:
            reason += f", fewer than {self.confidence:.0%}: the least bound"
        if not quality.converged:
            reason += "; not converged: no more than the run's own bound"
        return Bound(bound, reason, {"agreement": agreement, **diagnostics})


SCHEDULES: dict[str, Schedule] = {"constant": ConstantBound(), "confidence": ConfidenceBound()}


def decided(schedule: Schedule, situation: Situation) -> Bound:
    """What `schedule` decides, checked.

    Raises:
      ValueError: anything but a positive finite number, naming the schedule.
    """
    bound = schedule(situation)
    if not isinstance(bound, Bound):
        bound = Bound(bound, "by a schedule of the user's own")
    value = bound.kl_bound
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or value <= 0:
        name = getattr(schedule, "__name__", type(schedule).__name__)
        raise ValueError(f"schedule {name}: expected a positive finite KL bound, got {value!r}")
    return Bound(float(value), bound.reason, dict(bound.statistics))
