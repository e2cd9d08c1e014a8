"""The KL bound of each update: constant, or by the posterior's confidence in the update (paper, conclusion).

A schedule decides once per iteration, after the utility and Q are estimated and before the policy moves. It is called
with the `Situation` and returns the bound in nats, or a `Bound` with its reason. Two lines make one of your own, for a
utility with a posterior (else `situation.update.q_draws` is None):

    def cautious(situation):
        return 0.5 if situation.update.agreement(0.5) > 0.9 else 0.1
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from bayespbrl import checks
from bayespbrl.improvement.update import ProposedUpdate
from bayespbrl.utility.estimate import UtilityEstimate

LEAST_BOUND = 0.05  # nats; without any step there would be nothing to learn from


@dataclass(frozen=True)
class Situation:
    """The information available to a schedule.

    Attributes:
      iteration: 1 for the first.
      answers: counted so far.
      usual_bound: the bound that the run was given, nats.
      estimate: the utility estimate of this iteration; `estimate.quality` says whether it can be trusted.
      update: the proposed update, as each posterior draw judges it.
    """

    iteration: int
    answers: int
    usual_bound: float
    estimate: UtilityEstimate
    update: ProposedUpdate


@dataclass(frozen=True)
class Bound:
    """A decision and its grounds.

    Attributes:
      kl_bound: ε of eq. 11, nats.
      reason: in words.
      signal: confidence that the update is a gain, in [0, 1]; query rules and iterations without a question depend on
        it. None for a schedule that has no such figure.
      statistics: further figures by name: plain numbers.
    """

    kl_bound: float
    reason: str = ""
    signal: float | None = None
    statistics: Mapping[str, float] = field(default_factory=dict)

    def summary(self) -> dict[str, Any]:
        """Reason, signal and statistics as plain data."""
        signal = {} if self.signal is None else {"signal": self.signal}
        return {"reason": self.reason, **signal, **self.statistics}


# One that looks at neither the draws nor the halves of an update may have an attribute `needs_draws` that is False:
# they are not computed then.
Schedule = Callable[[Situation], "Bound | float"]


@dataclass(frozen=True)
class ConstantBound:
    """The same bound at every iteration, the paper's schedule: the run's own where `kl_bound` is None."""

    kl_bound: float | None = None
    needs_draws: ClassVar[bool] = False

    def __call__(self, situation: Situation) -> Bound:
        return Bound(situation.usual_bound if self.kl_bound is None else self.kl_bound, "constant")


@dataclass(frozen=True)
class ConfidenceBound:
    """A share of the largest bound that grows with the posterior's confidence in the gain of the update.

    Each draw of the utility has a Q-function of its own (LSTD is linear in the utility). The direction in which REPS
    moves for the mean Q promises it the gain G = Σ WᵢAᵢQᵢ (`ProposedUpdate.gains`). An update of relative length s
    gains sG. The length in [0, 1] that maximises E[sG] − ½E[(sG)²]/E[G] is the *signal* s = E[G]²/(E[G]² + Var[G]). KL
    grows with the square of the length, so the bound is s² times the largest. What the draws share is Q's own sampling
    error; the signal is therefore multiplied with the reliability of Q (`ProposedUpdate.reliability`). The signal
    depends neither on the unit of the utility nor on any bound. Where the mean expects no gain the bound is the least;
    a posterior that has not converged never raises it above the run's own.

    Attributes:
      largest: the bound when all draws expect the same gain, nats, > 0.
    """

    largest: float = 1.0

    def __post_init__(self) -> None:
        checks.positive("largest", self.largest)

    def __call__(self, situation: Situation) -> Bound:
        quality, update, usual = situation.estimate.quality, situation.update, situation.usual_bound
        statistics = {
            "rhat_max": float(quality.rhat_max),
            "effective_sample_size_min": float(quality.effective_sample_size_min),
        }
        if update.q_draws is None and update.q_halves is None:
            return Bound(usual, "no posterior: the run's own bound", statistics=statistics)
        signal = statistics["reliability"] = update.reliability
        reason = f"reliability of Q {signal:.2f}"
        if update.q_draws is not None:
            gains = update.gains()
            square = float(np.mean(gains)) ** 2  # E[G]²
            total = square + float(np.var(gains))  # E[G]² + Var[G]
            # s = E[G]²/(E[G]² + Var[G]), as derived above
            signal *= square / total if total > 0 and np.mean(gains) > 0 else 0.0
            statistics["agreement"] = float(np.mean(gains > 0))
            reason = f"{statistics['agreement']:.0%} of the draws expect a gain, {reason}"
        bound = min(self.largest, max(LEAST_BOUND, signal**2 * self.largest))  # KL grows with s²
        reason = f"{reason}; signal {signal:.2f}"
        if not quality.converged and bound > usual:
            return Bound(usual, f"{reason}; not converged: at most the run's own bound", signal, statistics)
        return Bound(bound, reason, signal, statistics)


SCHEDULES: dict[str, Schedule] = {"constant": ConstantBound(), "confidence": ConfidenceBound()}


def decide(schedule: Schedule, situation: Situation) -> Bound:
    """The checked decision of `schedule`.

    Raises:
      ValueError: a bound that is no positive finite number; a reason, signal or statistics that a run cannot keep. The
        message names the schedule.
    """
    bound = schedule(situation)
    name = f"schedule {getattr(schedule, '__name__', type(schedule).__name__)}"
    if not isinstance(bound, Bound):
        bound = Bound(bound, "by the user's own schedule")
    value = checks.positive(f"{name}, KL bound", bound.kl_bound)
    if not isinstance(bound.reason, str) or not isinstance(bound.statistics, Mapping):
        got = f"{bound.reason!r} and {bound.statistics!r}"
        raise ValueError(f"{name}: expected a text as reason and a mapping as statistics, got {got}")
    for key, figure in bound.statistics.items():
        if not isinstance(key, str) or key in ("reason", "signal") or not _can_be_kept(figure):
            raise ValueError(f"{name}: expected named numbers as statistics, got {key!r}: {figure!r}")
    signal = None if bound.signal is None else checks.share(f"{name}, signal", bound.signal)
    return Bound(value, bound.reason, signal, dict(bound.statistics))


def _can_be_kept(figure: object) -> bool:
    """Whether JSON can store it: a number, a text, None, or a list of them."""
    if isinstance(figure, list | tuple):
        return all(map(_can_be_kept, figure))
    return figure is None or isinstance(figure, int | float | str | np.integer | np.floating | np.bool_)
