"""One row of a study: a task with one choice of options, its trials, and which seeds they have."""

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import xarray as xr

from bayespbrl import checks
from bayespbrl.envs.opening import environment_name, open_environment
from bayespbrl.experts import SIMULATED
from bayespbrl.learner import Learner
from bayespbrl.runs import run as runs
from bayespbrl.runs.directory import BASELINE_FILE, FIRST_POLICY_FILE, RunDirectory, read_summary
from bayespbrl.runs.lock import continuing
from bayespbrl.runs.simulated import expert_of
from bayespbrl.settings import Settings, Task, settings_for
from bayespbrl.settings.presets import measured_options
from bayespbrl.studies.baseline_trials import measure_baseline, read_baseline
from bayespbrl.studies.tables import (
    BALANCING_FILE,
    collect,
    collect_first_policies,
    measure_balancing,
    measure_first_policy,
    read_balancing,
    read_first_policy,
    read_trial,
)

# A trial is redrawn if it meets no preference within this many iterations: an early acrobot's trajectories may all time
# out (paper, "Experiments").
PREFERENCE_WITHIN = {"bayespbrl/Acrobot-v0": 3}
# The most steps of an episode for the balancing time of the final policy, where the task is to stay upright.
BALANCING_STEPS = {"bayespbrl/Bicycle-v0": 3000}
MOST_SEEDS_A_TRIAL = 10  # a study gives up after this many seeds per trial: preferences are too rare there


class DamagedTrial(ValueError):
    """A trial on disk that cannot be read."""


@dataclass(frozen=True)
class Row:
    """The options that all trials of a row share: plain data, since it is sent to other processes.

    Attributes:
      env: a short name or a gymnasium id.
      directory: of the row, with the run directories `seed-1000`, ….
      settings: of the first seed, complete.
      options: as given by the user.
      preference_within: the number of iterations within which a trial has to meet a preference; None: no need.
      balancing_steps: None where no balancing time is measured.
      untrained: whether only the value of the first policy is measured, which is the random policy.
      baseline: the algorithm of `bayespbrl.baselines` that runs instead of the learner; None: the learner.
      name: in messages, before the seed; empty for a study of one row.
    """

    env: str
    directory: Path
    settings: Settings
    options: dict[str, Any]
    preference_within: int | None
    balancing_steps: int | None
    untrained: bool = False
    name: str = ""
    baseline: str | None = None

    def path(self, seed: int) -> Path:
        return self.directory / f"seed-{seed}"

    def outcome(self, seed: int) -> bool | None:
        """Whether a trial on disk counts (True) or is redrawn (False); None for one that is not finished.

        Raises:
          DamagedTrial: one that cannot be read, or a directory that is no run.
          ValueError: a run with other settings.
        """
        path = self.path(seed)
        if not path.exists():
            return None
        try:
            kept = RunDirectory.open(path)
            summary = read_summary(path) if (path / "summary.json").exists() else {}
        except ValueError as error:
            raise DamagedTrial(str(error)) from error
        done = summary.get("iterations", [])
        if not isinstance(done, list) or any(not isinstance(entry, dict) or "pairs" not in entry for entry in done):
            raise DamagedTrial(f"{path / 'summary.json'}: expected pairs in each iteration, got {str(done)[:60]}")
        if others := self._others(kept.settings, seed):
            raise ValueError(f"{path}: expected a trial with these settings, got others: {', '.join(others)}")
        if self.untrained or self.baseline is not None:
            return True if self._measured(path) else None
        if done and self.redraws(len(done), done[-1]["pairs"]):
            return False
        return True if summary.get("finished") and self._measured(path) else None

    def _measured(self, path: Path) -> bool:
        """Whether a trial has all that its tables need, each readable; `DamagedTrial` if not."""
        needed: dict[str, Callable[[Path], Any]] = {"summary.json": read_trial}
        if self.untrained or self.baseline is not None:
            needed = {FIRST_POLICY_FILE: read_first_policy} if self.untrained else {BASELINE_FILE: read_baseline}
        elif self.balancing_steps is not None:
            needed[BALANCING_FILE] = read_balancing
        if not all((path / file).exists() for file in needed):
            return False
        try:
            for read in needed.values():
                read(path)
        except ValueError as error:
            raise DamagedTrial(str(error)) from error
        return True

    def _others(self, kept: Settings, seed: int) -> list[str]:
        """What differs in the settings of a trial, but for what is measured: by chance where no seed decides it."""
        there = {"env": kept.env} | kept.options()
        here = {"env": self.settings.env} | replace(self.settings, seed=seed).options()
        here |= {name: there[name] for name in measured_options(self.env, self.options)}
        return [f"{name} {there[name]!r} instead of {value!r}" for name, value in here.items() if there[name] != value]

    @property
    def trial_options(self) -> dict[str, Any]:
        """The options of a trial, with what was measured for the row, so that it is the same for all."""
        complete = self.settings.options()
        return {name: complete[name] for name in measured_options(self.env, self.options)} | self.options

    def redraws(self, iterations: int, pairs: int) -> bool:
        """Whether a trial is redrawn: it has no ordered pair after the iterations allowed for the first one."""
        return self.preference_within is not None and iterations >= self.preference_within and pairs == 0


def row_of(
    env: str,
    directory: Path,
    options: Mapping[str, Any],
    *,
    seed: int,
    preference_within: int | None = None,
    untrained: bool = False,
    name: str = "",
) -> Row:
    """A row, its settings completed and checked; its first trial has `seed`.

    Raises:
      ValueError: an unknown environment, a bad option, an expert that is not simulated, or parts of the user's.
    """
    directory = directory.absolute()  # workers may be elsewhere
    if directory.exists() and not directory.is_dir():
        raise ValueError(f"{directory}: expected a directory for the trials, got a file")
    checks.optional(checks.whole, "preference_within", preference_within)
    environment = open_environment(env)
    identity = environment_name(environment)
    task = Task.of(environment, options.get("max_steps"))
    first = settings_for(env, task=task, **_measured_before(env, directory, options), **options, seed=seed)
    environment.close()
    if first.expert not in SIMULATED:
        raise ValueError(f"expert: expected one of {', '.join(SIMULATED)}, which are simulated, got {first.expert!r}")
    if first.own_parts:
        raise ValueError(
            f"{first.own_parts[0]}: expected one that the package has, got 'other', which only code passes"
        )
    within = PREFERENCE_WITHIN.get(identity) if preference_within is None else preference_within
    balancing = BALANCING_STEPS.get(identity)
    return Row(env, directory, first, dict(options), within, balancing, untrained, name)


def _measured_before(env: str, directory: Path, options: Mapping[str, Any]) -> dict[str, Any]:
    """What random episodes decided for the row's trials that there are: not always the same, where no seed does."""
    names = measured_options(env, options)
    for path in sorted(directory.glob("seed-*")) if names else ():
        with suppress(ValueError):
            if (kept := RunDirectory.open(path).settings).env == env:
                return {name: kept.options()[name] for name in names}
    return {}


@dataclass
class Seeds:
    """The outcomes of a row's seeds, from the first upwards, until `trials` of them count.

    One seed is added for each that is redrawn, so the seeds do not depend on the order in which trials finish.
    """

    row: Row
    trials: int
    outcomes: dict[int, bool | None] = field(default_factory=dict)
    damaged: dict[int, str] = field(default_factory=dict)
    exhausted: str = ""

    def with_outcome(self, outcome: bool | None) -> list[int]:
        return [seed for seed, reached in self.outcomes.items() if reached is outcome]

    def to_do(self) -> list[int]:
        """The seeds of unfinished trials, after adding as many new seeds as are needed; none once `exhausted`."""
        while len(self.outcomes) - len(redrawn := self.with_outcome(False)) < self.trials:
            if len(self.outcomes) >= MOST_SEEDS_A_TRIAL * self.trials:
                self.exhausted = self.exhausted or (
                    f"expected {self.trials} trials with a preference within {self.row.preference_within} iterations, "
                    f"got none in {len(redrawn)} of {len(self.outcomes)}"
                )
                return []
            seed = self.row.settings.seed + len(self.outcomes)
            try:
                self.outcomes[seed] = self.row.outcome(seed)
            except DamagedTrial as error:
                self.outcomes[seed], self.damaged[seed] = None, str(error)
        return [seed for seed in self.with_outcome(None) if seed not in self.damaged]


def run_trial(row: Row, seed: int, *, iterations: int | None = None) -> bool:
    """Run one trial to its end, from where it stopped if it was begun; returns whether it counts.

    One that another process has finished in the meantime is left as it is.

    Args:
      row, seed: which trial.
      iterations: a run of the learner stops at the first question after so many; None: at its end.

    Raises:
      ContinuedElsewhere: another process runs it.
      ValueError: it cannot be run.
    """
    path = row.path(seed)
    if (known := row.outcome(seed)) is not None:
        return known
    try:
        begun = None if path.exists() else runs.start(row.env, path, **row.trial_options, seed=seed)
    except ValueError:
        if not path.exists():
            raise
        begun = None  # another process began it at the same time
    with continuing(path):
        if (known := row.outcome(seed)) is not None:
            return known
        learner = runs.resume(path, env=row.env) if begun is None else begun
        if row.untrained:
            measure_first_policy(learner, path)
            return True
        if row.baseline is not None:
            measure_baseline(learner, row.baseline, path)
            return True
        return _trained(row, learner, path, iterations)


def _trained(row: Row, learner: Learner, path: Path, iterations: int | None) -> bool:
    expert = expert_of(learner)
    # a trial that was stopped within an iteration completes it when it is asked, and is redrawn as any other then
    while (questions := learner.ask()) and not _redraws(row, learner):
        if iterations is not None and learner.state.iteration >= iterations:
            return False
        learner.tell([expert(*query.trajectories) for query in questions])
    if _redraws(row, learner):
        return False
    if row.balancing_steps is not None:
        measure_balancing(learner, path, max_steps=row.balancing_steps)
    return True


def _redraws(row: Row, learner: Learner) -> bool:
    return row.redraws(learner.state.iteration, len(learner.preferences.pairs))


def seconds_of(row: Row, seed: int) -> float | None:
    """The seconds of a finished trial's estimates, updates and evaluations; None where they are not kept."""
    read = read_summary if row.baseline is None else read_baseline
    try:
        taken = [entry["seconds"] for entry in read(row.path(seed))["iterations"]]
        return float(sum(sum(entry.values()) for entry in taken))
    except (ValueError, KeyError, TypeError, AttributeError, json.JSONDecodeError):
        return None


def collected(seeds: Seeds) -> xr.Dataset:
    """The finished trials of a row as one data set (`tables.collect`), with the redrawn ones as attributes."""
    paths = [seeds.row.path(seed) for seed in seeds.with_outcome(True)]
    redrawn = seeds.with_outcome(False)
    if seeds.row.untrained:
        table = collect_first_policies(paths, seeds.row.settings.env)
    else:
        table = collect(paths, None if seeds.row.baseline is None else read_baseline)
    table.attrs |= {"redraws": len(redrawn), "redrawn_seeds": " ".join(map(str, redrawn))}
    return table
