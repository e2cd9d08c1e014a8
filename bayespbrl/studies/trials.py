"""The same run for many seeds, side by side: what a claim about learning rests on (paper, "Experiments")."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import xarray as xr

from bayespbrl import runs
from bayespbrl.envs.opening import environment_name
from bayespbrl.experts import simulated_expert
from bayespbrl.rollouts import open_environment
from bayespbrl.runs.directory import RunDirectory, read_summary
from bayespbrl.settings import Settings, settings_for
from bayespbrl.studies import tables as trial_tables

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

# Environments whose trials have to meet a preference (an answer that is no tie) within so many iterations, and are
# redrawn where they do not (paper, "Experiments"): all trajectories of an early acrobot may time out alike.
PREFERENCE_WITHIN = {"bayespbrl/Acrobot-v0": 3}
MOST_SEEDS_A_TRIAL = 10  # a study that has tried so many gives up: preferences are too rare there


@dataclass(frozen=True)
class Trials:
    """What the trials gave.

    Attributes:
      table: `value` and `answers` over (seed, iteration), and each summary's figures by name; `balancing_steps` over
        seed where lasting is the task. Its attributes `redraws` and `redrawn_seeds` tell in whose place others came.
      path: the directory of the run directories and of the table.
    """

    table: xr.Dataset
    path: Path

    def quartiles(self) -> xr.Dataset:
        """Median, lower and upper quartile of the value over seeds, by the number of answers.

        A trial's value after so many answers is that of the last policy it had before it asked for more, or ended.
        """
        numbers, reached = trial_tables.by_answers(self.table["answers"].values, self.table["value"].values)
        levels = {"lower_quartile": 0.25, "median": 0.5, "upper_quartile": 0.75}
        curves = xr.DataArray(reached, {"answers": numbers}, ("seed", "answers"))
        return xr.Dataset(
            {name: curves.quantile(level, "seed").drop_vars("quantile") for name, level in levels.items()}
        )


def run_trials(
    env: str,
    directory: Path | str,
    *,
    trials: int,
    jobs: int = 1,
    seed: int = 1000,
    preference_within: int | None = None,
    progress: Callable[[int], None] | None = None,
    **settings: Any,
) -> Trials:
    """Run seeds `seed` … `seed + trials − 1`, `jobs` at a time, each in a run directory of its own.

    Finished ones are kept as they are and unfinished ones go on where they stopped, so a study can be cut and resumed.
    A trial that meets no preference in its first iterations is left as it is then, and the next unused seed above the
    block takes its place.

    Args:
      env: a short name or a gymnasium id.
      directory: of the study; `seed-1000` and so on within it, and `trials.csv` and `trials.nc`.
      trials, jobs: at least 1.
      seed: the first.
      preference_within: how many iterations a trial has to meet a preference; where None, three for the acrobot, whose
        trajectories may all time out alike, and any number elsewhere.
      progress: called with the seed of each trial that counts, also of those that were finished before.
      **settings: options of `Settings`.

    Raises:
      ValueError: bad options; a trial in the directory with other settings; a trial that failed, by its seed; too few
        seeds that meet a preference.
    """
    for name, number in (("trials", trials), ("jobs", jobs), ("preference_within", preference_within)):
        if number is None and name == "preference_within":
            continue
        if isinstance(number, bool) or not isinstance(number, int) or number < 1:
            raise ValueError(f"{name}: expected a whole number >= 1, got {number!r}")
    directory = Path(directory)
    if directory.exists() and not directory.is_dir():
        raise ValueError(f"{directory}: expected a directory for the trials, got a file")
    environment = open_environment(env)
    identity = environment_name(environment)
    environment.close()
    plan = settings_for(env, **settings, seed=seed)
    if plan.expert != "return":
        raise ValueError(f"expert: expected return, trials are simulated, got {plan.expert!r}")
    study = _Study(
        env=env,
        directory=directory,
        settings=plan,
        options=settings,
        preference_within=PREFERENCE_WITHIN.get(identity) if preference_within is None else preference_within,
        balancing_steps=trial_tables.BALANCING_STEPS.get(identity),
    )
    seeds = _Seeds(study, trials)
    _in_parallel(seeds, jobs, progress)
    redrawn = seeds.with_outcome(False)
    table = trial_tables.collect([study.path(number) for number in seeds.with_outcome(True)])
    table.attrs |= {"redraws": len(redrawn), "redrawn_seeds": " ".join(map(str, redrawn))}
    trial_tables.write_tables(table, directory)
    return Trials(table, directory)


@dataclass(frozen=True)
class _Study:
    """What all trials of a study share; plain data, because child processes are given it.

    Attributes:
      settings: of the first seed, in full; `options` as they were given.
      preference_within: None where trials need no preference.
      balancing_steps: None where lasting is not the task.
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
        """Whether a trial on disk counts (True) or is redrawn (False); None where there is something left to do.

        Raises:
          ValueError: a run with other settings, or none at all.
        """
        path = self.path(seed)
        if not path.exists():
            return None
        kept = RunDirectory.open(path)
        if kept.settings != replace(self.settings, seed=seed):
            raise ValueError(f"{path}: expected a trial with these settings, got one with others: {kept.settings}")
        if (path / "summary.json").exists() and self.redraws(read_summary(path)["iterations"]):
            return False
        measured = self.balancing_steps is None or trial_tables.has_balancing(path)
        return True if measured and kept.finished() else None

    def redraws(self, iterations: Sequence[Any]) -> bool:
        """Whether the iterations within which a preference has to come are over without one."""
        within = self.preference_within
        return within is not None and len(iterations) >= within and iterations[within - 1]["pairs"] == 0


@dataclass
class _Seeds:
    """The seeds of a study from the first upwards, and what became of each: as many as `trials` of them count.

    Which they are does not depend on the order in which trials finish: a seed is added for each that is redrawn.
    """

    study: _Study
    trials: int
    outcomes: dict[int, bool | None] = field(default_factory=dict)

    def with_outcome(self, outcome: bool) -> list[int]:
        return [seed for seed, what in self.outcomes.items() if what is outcome]

    def to_do(self) -> list[int]:
        """The seeds with something left to do, once there are enough of them.

        Raises:
          ValueError: hardly any trial meets a preference.
        """
        while len(self.outcomes) - len(redrawn := self.with_outcome(False)) < self.trials:
            if len(self.outcomes) >= MOST_SEEDS_A_TRIAL * self.trials:
                raise ValueError(
                    f"{len(redrawn)} of {len(self.outcomes)} trials met no preference within "
                    f"{self.study.preference_within} iterations: expected {self.trials} that do"
                )
            seed = self.study.settings.seed + len(self.outcomes)
            self.outcomes[seed] = self.study.outcome(seed)
        return [seed for seed, what in self.outcomes.items() if what is None]


def _in_parallel(seeds: _Seeds, jobs: int, progress: Callable[[int], None] | None) -> None:
    """Run in spawned processes what is left to do, and what is redrawn in its place."""
    failures: list[str] = []
    running: dict[Future[bool], int] = {}
    before = multiprocessing.active_children()
    with (
        _environment(ONE_THREAD if jobs > 1 else {}),
        ProcessPoolExecutor(
            jobs, mp_context=multiprocessing.get_context("spawn"), initializer=_end_with_the_study
        ) as pool,
        _ending_at_once(pool, before),
    ):
        started: set[int] = set()
        told: set[int] = set()
        while True:
            for seed in seeds.to_do():
                if seed not in started:
                    started.add(seed)
                    running[pool.submit(_trial, seeds.study, seed)] = seed
            for seed in seeds.with_outcome(True):
                if progress is not None and seed not in told:
                    progress(seed)
                told.add(seed)
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


@contextmanager
def _ending_at_once(pool: ProcessPoolExecutor, others: Sequence[BaseProcess]) -> Iterator[None]:
    """Where the study is interrupted its trials end too, as if killed: each goes on where it stopped when called again.

    `others` are child processes that are not the pool's; those that began since are taken for it.
    """
    try:
        yield
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - set(others):
            process.terminate()
        raise


def _end_with_the_study() -> None:
    """In a trial's process: end when the study's does, be it killed, so that nobody goes on writing for it.

    An interrupt from the keyboard, which reaches all processes, is the study's to decide on.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    study = multiprocessing.parent_process()

    def wait_for_it() -> None:
        if study is not None:
            study.join()
            os._exit(1)

    threading.Thread(target=wait_for_it, daemon=True).start()


def _trial(study: _Study, seed: int) -> bool:
    """One trial from start to end, or from where it stopped; whether it counts."""
    path = study.path(seed)
    learner = runs.resume(path) if path.exists() else runs.start(study.env, path, **study.options, seed=seed)
    expert = simulated_expert(learner.settings.wrong_answers, seed=seed)
    while not study.redraws(learner.state.summaries) and (questions := learner.ask()):
        learner.tell([expert(*query.trajectories) for query in questions])
    if study.redraws(learner.state.summaries):
        return False
    if study.balancing_steps is not None:
        trial_tables.measure_balancing(learner, path, max_steps=study.balancing_steps)
    return True


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    """Environment variables that child processes inherit, restored afterwards."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
