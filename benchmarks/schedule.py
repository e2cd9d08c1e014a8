"""Cost of the schedule `confidence`: each policy update of a run again without it, to the same bound.

    python benchmarks/schedule.py [gridworld|bicycle|swing-up|…] [--iterations N] [--seed S] [--hyperparameters KIND]

Each update is repeated with a constant bound, the one that was decided on, from the same utility, transitions and
random choices. The trial runs twice; the second run, which compiles nothing, is measured. Prints one JSON line:
processor seconds with and without the schedule, and the difference as a share of the whole trial without it.
"""

import argparse
import json
import time
from dataclasses import dataclass, field, replace
from typing import Any

from bayespbrl import Learner, ReturnExpert
from bayespbrl.cycle import Cycle
from bayespbrl.events import LearnerState
from bayespbrl.improvement import schedules
from bayespbrl.improvement.check import Check
from bayespbrl.improvement.update import Improvement
from bayespbrl.utility import UtilityEstimate


@dataclass(frozen=True)
class Twice(Cycle):
    """A cycle that repeats each update without looking at posterior draws."""

    seconds: dict[str, float] = field(default_factory=lambda: {"with": 0.0, "without": 0.0})

    def update(
        self, state: LearnerState, utility: UtilityEstimate, check: Check | None
    ) -> tuple[Improvement, schedules.Bound]:
        """The update, and the same again with a constant bound."""
        began = time.process_time()
        improved, bound = super().update(state, utility, check)
        between = time.process_time()
        Cycle.update(replace(self, schedule=schedules.ConstantBound(bound.kl_bound)), state, utility, check)
        self.seconds["with"] += between - began
        self.seconds["without"] += time.process_time() - between
        return improved, bound


def measure(environment: str, **settings: Any) -> dict[str, Any]:
    """The figures of the second of two trials, as in the JSON line."""
    for _ in range(2):
        learner = Learner(environment, schedule="confidence", **settings)
        learner.cycle = cycle = Twice(**vars(learner.cycle))
        began = time.process_time()
        learner.run(ReturnExpert())
        seconds = time.process_time() - began
    updates = cycle.seconds
    whole = seconds - updates["with"]  # one update an iteration: those without
    return {
        "benchmark": "schedule",
        "environment": environment,
        "hyperparameters": learner.settings.estimation.hyperparameters,
        "iterations": len(learner.iterations),
        "seconds_without": round(whole, 2),
        "updates_with": round(updates["with"], 2),
        "updates_without": round(updates["without"], 2),
        "overhead": round((updates["with"] - updates["without"]) / whole, 4),
    }


def main() -> None:
    """Measure, then print one JSON line."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        argument_default=argparse.SUPPRESS,  # the preset decides
    )
    parser.add_argument("environment", nargs="?", default="swing-up")
    parser.add_argument("--iterations", type=int)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--hyperparameters")
    arguments = vars(parser.parse_args())
    print(json.dumps(measure(arguments.pop("environment"), **arguments)))


if __name__ == "__main__":
    main()
