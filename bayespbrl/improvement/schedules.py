"""The KL bound of each policy update: constant, or as large as the posterior is sure of it (paper, future work).

A schedule is called once an iteration, after the utility and Q are estimated and before the policy moves, with the
`Situation`; it returns the bound in nats, or a `Bound`, which says why. Three lines make one of your own:

    def cautious(situation):
        return 0.5 if situation.update.agreement(0.5) > 0.9 else 0.1
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayespbrl.improvement.update import ProposedUpdate

LEAST_BOUND = 0.02  # nats; an update of nothing would leave the draws nothing to disagree about


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
      statistics: what it rests on, by name: plain numbers. One named `signal`, in [0, 1], also says whether an
        iteration may ask nothing (`Settings.unasked_iterations`).
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
    """As large a share of the largest bound as the posterior is sure of the gain that the update promises.

    Each draw of the utility has a Q-function of its own (LSTD is linear in the utility), and the direction in which
    REPS moves for the mean Q promises it a gain of G = Σ WᵢAᵢQᵢ (`ProposedUpdate.gains`). An update of relative length
    s gains s·G and a draw regrets what it loses, so that of all s in [0, 1] the one that maximises
    E[sG] − ½E[(sG)²]/E[G] is the *signal* s = E[G]²/(E[G]² + Var[G]). KL grows with the square of the length: the bound
    is s² times the largest. It asks whether this update is safe, not whether the trajectories are easy to order, and
    the answer does not depend on the units of the utility nor on any bound. Where the mean expects no gain the bound
    is the least there is, and for a posterior that has not converged it is never raised over the run's own.

    Attributes:
      largest: the bound when all draws expect the same gain, nats, > 0.
    """

    largest: float = 1.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.largest) and self.largest > 0):
            raise ValueError(f"largest: expected a finite number > 0, got {self.largest}")

    def __call__(self, situation: Situation) -> Bound:
        quality, update, usual = situation.estimate.quality, situation.update, situation.usual_bound
        statistics = {
            "rhat_max": float(quality.rhat_max),
            "effective_sample_size_min": float(quality.effective_sample_size_min),
        }
        if update.q_draws is None:
            return Bound(usual, "no posterior: the run's own bound", statistics)
        gains = update.gains()
        square = float(np.mean(gains)) ** 2
        total = square + float(np.var(gains))
        signal = square / total if total > 0 and np.mean(gains) > 0 else 0.0
        statistics |= {"signal": signal, "agreement": float(np.mean(gains > 0))}
        bound = max(LEAST_BOUND, signal**2 * self.largest)
        reason = f"{statistics['agreement']:.0%} of the draws expect a gain, whose signal is {signal:.2f}"
        if not quality.converged and bound > usual:
            return Bound(usual, f"{reason}; not converged: no more than the run's own bound", statistics)
        return Bound(bound, reason, statistics)


SCHEDULES: dict[str, Schedule] = {"constant": ConstantBound(), "confidence": ConfidenceBound()}


def decided(schedule: Schedule, situation: Situation) -> Bound:
    """What `schedule` decides, checked.

    Raises:
      ValueError: anything but a positive finite number, or a reason or statistics that a run cannot keep, naming the
        schedule.
    """
    bound = schedule(situation)
    name = getattr(schedule, "__name__", type(schedule).__name__)
    if not isinstance(bound, Bound):
        bound = Bound(bound, "by a schedule of the user's own")
    value = bound.kl_bound
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or value <= 0:
        raise ValueError(f"schedule {name}: expected a positive finite KL bound, got {value!r}")
    if not isinstance(bound.reason, str) or not isinstance(bound.statistics, Mapping):
        got = f"{bound.reason!r} and {bound.statistics!r}"
        raise ValueError(f"schedule {name}: expected a reason in words and statistics by name, got {got}")
    for key, figure in bound.statistics.items():
        if not isinstance(key, str) or key == "reason" or not _kept(figure):
            raise ValueError(f"schedule {name}: expected statistics that are numbers by name, got {key!r}: {figure!r}")
    return Bound(float(value), bound.reason, dict(bound.statistics))


def _kept(figure: Any) -> bool:
    """Whether a run can keep it: a number, a text, none, or a list of them."""
    if isinstance(figure, list | tuple):
        return all(map(_kept, figure))
    return figure is None or isinstance(figure, int | float | str | np.number | np.bool_)
