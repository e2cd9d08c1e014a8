"""The same run for many seeds, side by side (paper, "Experiments")."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import xarray as xr

from bayespbrl import checks, runs
from bayespbrl.envs.opening import environment_name
from bayespbrl.experts import simulated_expert
from bayespbrl.learner import task_of
from bayespbrl.rollouts import open_environment
from bayespbrl.runs.directory import RunDirectory, read_summary
from bayespbrl.settings import Settings, settings_for
from bayespbrl.studies.processes import trial_processes
from bayespbrl.studies.tables import by_answers, collect, has_balancing, measure_balancing, write_tables

# Trials are redrawn that meet no preference within so many iterations: all trajectories of an early acrobot may time
# out alike (paper, "Experiments").
PREFERENCE_WITHIN = {"bayespbrl/Acrobot-v0": 3}
# The most steps of an episode for the balancing time of the final policy, where the task is to stay upright.
BALANCING_STEPS = {"bayespbrl/Bicycle-v0": 3000}
MOST_SEEDS_A_TRIAL = 10  # a study gives up after so many seeds per trial: preferences are too rare there


@dataclass(frozen=True)
class Trials:
    """The results of a study.

    Attributes:
      table: `value`, `answers` and all other figures of the summaries over (seed, iteration), and `balancing_steps`
        over seed where they were measured; the attributes `redraws` and `redrawn_seeds` name the redrawn trials.
      path: the directory of the study.
    """

    table: xr.Dataset
    path: Path

    def quartiles(self) -> xr.Dataset:
        """Median, lower and upper quartile of the value over seeds, by the number of answers.

        A trial's value at a number of answers is that of its last policy with no more answers.
        """
        numbers, reached = by_answers(self.table["answers"].values, self.table["value"].values)
        levels = {"lower_quartile": 0.25, "median": 0.5, "upper_quartile": 0.75}
        curves = xr.DataArray(reached, {"answers": numbers}, ("seed", "answers"))
        return xr.Dataset(
            {name: curves.quantile(level, "seed").drop_vars("quantile") for name, level in levels.items()}
        )


def run_trials(
    env: str,
    directory: Path | str,
    *,
    seeds: range,
    jobs: int = 1,
    preference_within: int | None = None,
    progress: Callable[[int], None] | None = None,
    **settings: Any,
) -> Trials:
    """Run one trial per seed, `jobs` at a time, each in a run directory of its own.

    Finished trials are kept and unfinished ones continue where they stopped, so a study can be interrupted and resumed.
    A trial that meets no preference within its first iterations stops there, and the next unused seed above `seeds`
    replaces it.

    Args:
      env: a short name or a gymnasium id.
      directory: of the study, with the run directories `seed-1000`, … and the tables `trials.csv` and `trials.nc`.
      seeds: consecutive, such as `range(1000, 1020)`.
      jobs: trials at a time.
      preference_within: the number of iterations within which a trial has to meet a preference (an answer that is no
        tie); None for that of the environment in `PREFERENCE_WITHIN`, or no limit.
      progress: called with the seed of each trial that counts, those finished before included.
      **settings: options of `Settings`.

    Raises:
      ValueError: bad options; a trial in the directory with other settings; a trial that failed, by its seed; too few
        seeds that meet a preference.
    """
    if not isinstance(seeds, range) or seeds.step != 1 or not seeds:
        raise ValueError(f"seeds: expected a range of consecutive seeds, at least one, got {seeds!r}")
    checks.whole("jobs", jobs)
    if preference_within is not None:
        checks.whole("preference_within", preference_within)
    directory = Path(directory)
    if directory.exists() and not directory.is_dir():
        raise ValueError(f"{directory}: expected a directory for the trials, got a file")
    environment = open_environment(env)
    identity = environment_name(environment)
    first = settings_for(env, task=task_of(environment, settings.get("max_steps")), **settings, seed=seeds.start)
    environment.close()
    if first.expert != "return":
        raise ValueError(f"expert: expected return, since trials are simulated, got {first.expert!r}")
    within = PREFERENCE_WITHIN.get(identity) if preference_within is None else preference_within
    study = _Study(env, directory, first, settings, within, BALANCING_STEPS.get(identity))
    tried = _Seeds(study, len(seeds))
    _in_parallel(tried, jobs, progress)
    redrawn = tried.with_outcome(False)
    table = collect([study.path(seed) for seed in tried.with_outcome(True)])
    table.attrs |= {"redraws": len(redrawn), "redrawn_seeds": " ".join(map(str, redrawn))}
    write_tables(table, directory)
    return Trials(table, directory)


@dataclass(frozen=True)
class _Study:
    """What all trials of a study share: plain data, since it is sent to other processes.

    Attributes:
      settings: of the first seed, complete.
      options: as given by the user.
      preference_within: None where trials need no preference.
      balancing_steps: None where no balancing time is measured.
    """

    env: str
    directory: Path
    settings: Settings
    options: dict[str, Any]
    preference_within: int | None
    balancing_steps: int | None

    def path(self, seed: int) -> Path:
        return self.directory / f"seed-{seed}"

    def outcome(self, seed: int) -> bool | None:
        """Whether a trial on disk counts (True) or is redrawn (False); None for one that is not finished.

        Raises:
          ValueError: a run with other settings, or a directory that is no run.
        """
        path = self.path(seed)
        if not path.exists():
            return None
        kept = RunDirectory.open(path)
        if kept.settings != replace(self.settings, seed=seed):
            raise ValueError(f"{path}: expected a trial with these settings, got others: {kept.settings}")
        if (path / "summary.json").exists() and self.redraws(read_summary(path)["iterations"]):
            return False
        measured = self.balancing_steps is None or has_balancing(path)
        return True if measured and kept.finished() else None

    def redraws(self, summaries: Sequence[Mapping[str, Any]]) -> bool:
        """Whether a trial with these summaries met no preference within the iterations that it has for that."""
        within = self.preference_within
        return within is not None and len(summaries) >= within and summaries[within - 1]["pairs"] == 0


@dataclass
class _Seeds:
    """The outcomes of a study's seeds, from the first upwards, until `trials` of them count.

    One seed is added for each that is redrawn, so the seeds do not depend on the order in which trials finish.
    """

    study: _Study
    trials: int
    outcomes: dict[int, bool | None] = field(default_factory=dict)

    def with_outcome(self, outcome: bool | None) -> list[int]:
        return [seed for seed, reached in self.outcomes.items() if reached is outcome]

    def to_do(self) -> list[int]:
        """The seeds of unfinished trials, after adding as many new seeds as are needed.

        Raises:
          ValueError: too few trials meet a preference.
        """
        while len(self.outcomes) - len(redrawn := self.with_outcome(False)) < self.trials:
            if len(self.outcomes) >= MOST_SEEDS_A_TRIAL * self.trials:
                raise ValueError(
                    f"{len(redrawn)} of {len(self.outcomes)} trials met no preference within "
                    f"{self.study.preference_within} iterations: expected {self.trials} that do"
                )
            seed = self.study.settings.seed + len(self.outcomes)
            self.outcomes[seed] = self.study.outcome(seed)
        return self.with_outcome(None)


def _in_parallel(seeds: _Seeds, jobs: int, progress: Callable[[int], None] | None) -> None:
    """Run the seeds with something left to do, and those that replace redrawn ones, in processes of their own."""
    failures: list[str] = []
    running: dict[Future[bool], int] = {}
    started: set[int] = set()
    reported: set[int] = set()
    with trial_processes(jobs) as pool:
        while True:
            for seed in seeds.to_do():
                if seed not in started:
                    started.add(seed)
                    running[pool.submit(_trial, seeds.study, seed)] = seed
            for seed in seeds.with_outcome(True):
                if progress is not None and seed not in reported:
                    progress(seed)
                reported.add(seed)
            if not running:
                break
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                seed = running.pop(future)
                if (error := future.exception()) is not None:
                    failures.append(f"seed {seed}: {error}")
                    continue
                seeds.outcomes[seed] = future.result()
    if failures:
        raise ValueError(f"{len(failures)} of {seeds.trials} trials failed; the first: {failures[0]}")


def _trial(study: _Study, seed: int) -> bool:
    """Run one trial to its end, from where it stopped if it was begun; returns whether it counts."""
    path = study.path(seed)
    learner = runs.resume(path) if path.exists() else runs.start(study.env, path, **study.options, seed=seed)
    expert = simulated_expert(learner.settings.wrong_answers, seed=seed)
    while not study.redraws(learner.state.summaries) and (questions := learner.ask()):
        learner.tell([expert(*query.trajectories) for query in questions])
    if study.redraws(learner.state.summaries):
        return False
    if study.balancing_steps is not None:
        measure_balancing(learner, path, max_steps=study.balancing_steps)
    return True
