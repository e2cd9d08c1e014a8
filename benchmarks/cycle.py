"""Seconds of a trial by step of the cycle, and its peak memory.

    python benchmarks/cycle.py [gridworld|bicycle|swing-up|acrobot|<gymnasium id>]
        [--answers N] [--iterations N] [--preset NAME] [--seed S] [--utility NAME] [--policy KIND] [--centres N]

One trial with the simulated expert and the preset of the domain. Prints a table and one JSON line. The functions of the
steps are replaced by timed ones wherever they are bound. Each second counts once, for the innermost step. A second in
which JAX traces or compiles counts for `compilation` instead.
"""

import argparse
import functools
import itertools
import json
import os
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from bayespbrl import Learner, ReturnExpert, features, models, policies, rollouts, trajectories
from bayespbrl.improvement import lstd, reps
from bayespbrl.policies import batch, hyperparameter_search

FUNCTIONS: dict[str, tuple[Callable[..., Any], ...]] = {
    "features": (
        features.draw_state_features,
        features.draw_state_action_features,
        trajectories.trajectory_features,
    ),
    "sampler": (models.posterior_draws,),
    "linear program": (models.linear_program,),
    "LSTD": (lstd.transition_sums, lstd.solve_lstd),
    "dual": (reps.reps_weights, reps.reps_weights_by_state),
    "CMA-ES": (hyperparameter_search.search,),
    "actions": (batch.sample_actions, batch.entropies),
    "rollouts": (rollouts.rollout,),
    "evaluation": (rollouts.returns,),
}
METHODS: dict[str, tuple[tuple[type, str], ...]] = {
    "features": (
        (features.RadialBasis, "__call__"),
        (features.JointRadialBasis, "__call__"),
        (features.StateActionProduct, "__call__"),
        (features.OneHot, "__call__"),
    ),
    "policy fit": tuple(
        (kind, "fit")
        for kind in (
            policies.GaussianProcessPolicy,
            policies.LinearGaussianPolicy,
            policies.SoftmaxPolicy,
            policies.TabularPolicy,
        )
    ),
}
REST = "rest"


class Stopwatch:
    """Seconds by step; each counts for the step that was entered last.

    Attributes:
      seconds: by step; their sum is `elapsed`.
      programs: number of programs compiled so far.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {REST: 0.0, "compilation": 0.0}
        self.programs = 0
        self._inside = [REST]
        self._began = self._since = time.perf_counter()
        self._compiled: list[tuple[float, float]] = []  # intervals, disjoint and in order

    @property
    def elapsed(self) -> float:
        """Seconds from the beginning to the last switch."""
        return self._since - self._began

    def switch(self) -> None:
        """Add the time since the last switch to the innermost step."""
        now = time.perf_counter()
        step = self._inside[-1]
        self.seconds[step] = self.seconds.get(step, 0.0) + now - self._since
        self._since = now

    def timed(self, step: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """`function`, whose time counts for `step`."""

        @functools.wraps(function)
        def wrapper(*arguments: Any, **options: Any) -> Any:
            self.switch()
            self._inside.append(step)
            try:
                return function(*arguments, **options)
            finally:
                self.switch()
                self._inside.pop()

        return wrapper

    def compiled(self, event: str, duration_secs: float, **details: Any) -> None:
        """Listener of JAX: move the time of what was just traced or compiled away from the step that needed it."""
        if not event.startswith("/jax/core/compile/"):
            return
        self.programs += event.endswith("backend_compile_duration")
        end = time.perf_counter()
        begin, counted = end - duration_secs, 0.0
        while self._compiled and self._compiled[-1][0] >= begin:  # a function traced within this one
            inner = self._compiled.pop()
            counted += inner[1] - inner[0]
        self._compiled.append((begin, end))
        self.seconds["compilation"] += duration_secs - counted
        step = self._inside[-1]
        self.seconds[step] = self.seconds.get(step, 0.0) - (duration_secs - counted)


def install(stopwatch: Stopwatch) -> None:
    """Replace the functions of the steps by timed ones, in every module that binds them."""
    for step, functions in FUNCTIONS.items():
        for function in functions:
            timed = stopwatch.timed(step, function)
            for name, module in list(sys.modules.items()):
                if name.startswith("bayespbrl"):
                    for attribute, value in list(vars(module).items()):
                        if value is function:
                            setattr(module, attribute, timed)
    for step, methods in METHODS.items():
        for kind, name in methods:
            setattr(kind, name, stopwatch.timed(step, getattr(kind, name)))
    jax.monitoring.register_event_duration_secs_listener(stopwatch.compiled)


def measure(environment: str, **settings: Any) -> dict[str, Any]:
    """The figures of one trial, as in the JSON line."""
    stopwatch = Stopwatch()
    install(stopwatch)
    began = [time.perf_counter()]

    def finished_iteration(learner: Learner) -> None:
        while len(began) <= learner.state.iteration:
            began.append(time.perf_counter())

    learner = Learner(environment, **settings)
    learner.run(ReturnExpert(), progress=finished_iteration)
    finished_iteration(learner)
    stopwatch.switch()
    steps = {step: round(seconds, 3) for step, seconds in stopwatch.seconds.items() if abs(seconds) >= 5e-4}
    return {
        "benchmark": "cycle",
        "environment": environment,
        "utility": learner.settings.estimation.utility,
        "seed": learner.settings.seed,
        "iterations": len(learner.iterations),
        "answers": learner.preferences.answers,
        "transitions": sum(len(trajectory) for trajectory in learner.trajectories),
        "value": learner.iterations[-1]["value"],
        "seconds": round(stopwatch.elapsed, 3),
        "seconds_by_step": dict(sorted(steps.items(), key=lambda item: -item[1])),
        "seconds_by_iteration": [round(after - before, 3) for before, after in itertools.pairwise(began)],
        "programs_compiled": stopwatch.programs,
        "peak_memory_mib": round(peak_memory() / 1024),
        "cores": os.cpu_count(),
        "device": jax.devices()[0].platform,
    }


def peak_memory() -> int:
    """KiB, of this process alone where the system tells; the resource usage may include its parent's."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    own = [int(line.split()[1]) for line in lines if line.startswith("VmHWM")]
    return own[0] if own else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def main() -> None:
    """Measure, then print a table and one JSON line."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        argument_default=argparse.SUPPRESS,  # the preset decides
    )
    parser.add_argument("environment", nargs="?", default="swing-up")
    parser.add_argument("--iterations", type=int)
    parser.add_argument("--answers", type=int)
    parser.add_argument("--preset")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--utility")
    parser.add_argument("--policy")
    parser.add_argument("--centres", type=int)
    arguments = vars(parser.parse_args())
    result = measure(arguments.pop("environment"), **arguments)
    print(f"{result['environment']}, {result['utility']}, {result['iterations']} iterations: {result['seconds']:.1f} s")
    for step, seconds in result["seconds_by_step"].items():
        print(f"  {step:<16}{seconds:9.2f} s {seconds / result['seconds']:7.1%}")
    print(f"  peak memory {result['peak_memory_mib']} MiB, {result['programs_compiled']} programs compiled")
    print(json.dumps(result))


if __name__ == "__main__":
    main()
