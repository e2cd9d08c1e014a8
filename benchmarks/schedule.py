"""What the schedule `confidence` costs: each policy update of a run again without it, to the same bound.

    python benchmarks/schedule.py [gridworld|bicycle|swing-up|…] [--iterations N] [--seed S] [--hyperparameters KIND]

runs a trial that does each update once more with a constant bound, the one that was decided: same utility, same
transitions, same random choices. It does so twice, and the second time, which compiles nothing, is measured. Prints one
JSON line: processor seconds of both kinds and the ratio of the difference to all that the trial takes without it.
"""

import argparse
import json
import time
from typing import Any

from bayespbrl import Learner, ReturnExpert
from bayespbrl.improvement import schedules


class Twice(Learner):
    """A learner that does each update again without looking at draws."""

    def __init__(self, *arguments: Any, **settings: Any):
        super().__init__(*arguments, **settings)
        self.seconds = {"with": 0.0, "without": 0.0}

    def _update(self, estimate: Any, steps: Any) -> Any:
        schedule, began = self.schedule, time.process_time()
        improved, bound = super()._update(estimate, steps)
        between = time.process_time()
        self.schedule = schedules.ConstantBound(bound.kl_bound)
        super()._update(estimate, steps)
        self.schedule = schedule
        self.seconds["with"] += between - began
        self.seconds["without"] += time.process_time() - between
        return improved, bound


def measure(environment: str, **settings: Any) -> dict[str, Any]:
    """Two trials, the second measured; as the JSON line has it."""
    for _ in range(2):
        learner = Twice(environment, schedule="confidence", **settings)
        began = time.process_time()
        learner.run(ReturnExpert())
        seconds = time.process_time() - began
    updates = learner.seconds
    whole = seconds - updates["with"]  # one update an iteration: those without
    return {
        "benchmark": "schedule",
        "environment": environment,
        "hyperparameters": learner.settings.hyperparameters,
        "iterations": learner.settings.iterations,
        "seconds_without": round(whole, 2),
        "updates_with": round(updates["with"], 2),
        "updates_without": round(updates["without"], 2),
        "overhead": round((updates["with"] - updates["without"]) / whole, 4),
    }


def main() -> None:
    """Measure, and print one JSON line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("environment", nargs="?", default="swing-up")
    parser.add_argument("--iterations", type=int)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--hyperparameters")
    arguments = vars(parser.parse_args())
    print(json.dumps(measure(arguments.pop("environment"), **arguments)))


if __name__ == "__main__":
    main()
