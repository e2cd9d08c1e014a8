"""The same run for many seeds, side by side: what a claim about learning rests on (paper, "Experiments")."""

import csv
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from bayespbrl import runs
from bayespbrl.experts import simulated_expert
from bayespbrl.rollouts import open_environment
from bayespbrl.settings import settings_for

COLUMNS = ("env", "utility", "seed", "iteration", "answers", "value")
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Trials:
    """What the trials gave.

    Attributes:
      table: `value` and `answers` over (seed, iteration), and each summary's figures by name.
      path: the directory of the run directories and of the table.
    """

    table: xr.Dataset
    path: Path

    def quartiles(self) -> xr.Dataset:
        """Median, lower and upper quartile of the value over seeds, by iteration, with the median of answers."""
        value = self.table["value"]
        levels = {"lower_quartile": 0.25, "median": 0.5, "upper_quartile": 0.75}
        figures = {name: value.quantile(level, "seed").drop_vars("quantile") for name, level in levels.items()}
        return xr.Dataset({"answers": self.table["answers"].median("seed"), **figures})


def run_trials(
    env: str,
    directory: Path | str,
    *,
    trials: int,
    jobs: int = 1,
    seed: int = 1000,
    progress: Callable[[int], None] | None = None,
    **settings: Any,
) -> Trials:
    """Run seeds `seed` … `seed + trials − 1`, `jobs` at a time, each in a run directory of its own.

    Finished ones are kept as they are and unfinished ones go on where they stopped, so a study can be cut and resumed.

    Args:
      env: a short name or a gymnasium id.
      directory: of the study; `seed-1000` and so on within it, and `trials.csv` and `trials.nc`.
      trials, jobs: at least 1.
      seed: the first.
      progress: called with the seed of each trial that is finished.
      **settings: options of `Settings`.

    Raises:
      ValueError: bad options; a trial in the directory with other settings; a trial that failed, by its seed.
    """
    for name, number in (("trials", trials), ("jobs", jobs)):
        if isinstance(number, bool) or not isinstance(number, int) or number < 1:
            raise ValueError(f"{name}: expected a whole number >= 1, got {number!r}")
    directory = Path(directory)
    if directory.exists() and not directory.is_dir():
        raise ValueError(f"{directory}: expected a directory for the trials, got a file")
    open_environment(env).close()
    plans = [settings_for(env, **settings, seed=number) for number in range(seed, seed + trials)]
    if plans[0].expert != "return":
        raise ValueError(f"expert: expected return, trials are simulated, got {plans[0].expert!r}")
    missing = []
    for plan in plans:
        path = directory / f"seed-{plan.seed}"
        if path.exists():
            kept = runs.RunDirectory.open(path)
            if kept.settings != plan:
                raise ValueError(f"{path}: expected a trial with these settings, got one with others: {kept.settings}")
            if kept.finished():
                continue
        missing.append((path, plan.seed))
    failures = _in_parallel(env, missing, jobs, settings, progress)
    if failures:
        raise ValueError(f"{len(failures)} of {trials} trials failed; the first: {failures[0]}")
    table = collect([directory / f"seed-{plan.seed}" for plan in plans])
    _write_tables(table, directory)
    return Trials(table, directory)


def _in_parallel(
    env: str,
    missing: Sequence[tuple[Path, int]],
    jobs: int,
    settings: dict[str, Any],
    progress: Callable[[int], None] | None,
) -> list[str]:
    """Run the missing trials in spawned processes; messages of those that failed."""
    failures: list[str] = []
    if not missing:
        return failures
    with (
        _environment(ONE_THREAD if jobs > 1 else {}),
        ProcessPoolExecutor(min(jobs, len(missing)), mp_context=multiprocessing.get_context("spawn")) as pool,
    ):
        futures = {pool.submit(_trial, env, path, number, settings): number for path, number in missing}
        for future in as_completed(futures):
            if (error := future.exception()) is not None:
                failures.append(f"seed {futures[future]}: {error}")
            elif progress is not None:
                progress(futures[future])
    return failures


def _trial(env: str, path: Path, seed: int, settings: dict[str, Any]) -> None:
    """One trial from start to end, or from where it stopped."""
    learner = runs.resume(path) if path.exists() else runs.start(env, path, **settings, seed=seed)
    learner.run(simulated_expert(learner.settings.wrong_answers, seed=seed))


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


def collect(directories: Sequence[Path | str]) -> xr.Dataset:
    """The summaries of finished runs as one data set over (seed, iteration).

    Numbers and lists of numbers are kept, the latter with a dimension of their own; None becomes NaN.
    """
    summaries = [runs.read_summary(path) for path in directories]
    seeds = [summary["seed"] for summary in summaries]
    iterations = [entry["iteration"] for entry in summaries[0]["iterations"]]
    variables = {}
    for name in summaries[0]["iterations"][0]:
        values = [[entry[name] for entry in summary["iterations"]] for summary in summaries]
        if name != "iteration" and (figures := _figures(values)) is not None:
            variables[name] = (("seed", "iteration", f"{name}_dimension")[: figures.ndim], figures)
    attributes = {"env": summaries[0]["env"], "utility": summaries[0]["utility"]}
    return xr.Dataset(variables, {"seed": seeds, "iteration": iterations}, attributes)


def _figures(values: Sequence[Sequence[Any]]) -> np.ndarray | None:
    """Numbers, or lists of numbers that are all as long, as one array; None for anything else."""
    flat = [value for row in values for value in row if value is not None]
    lengths = {len(value) if isinstance(value, list) else 0 for value in flat}
    if len(lengths) > 1 or any(isinstance(value, str | dict) for value in flat):
        return None
    missing = [np.nan] * length if (length := max(lengths, default=0)) else np.nan
    return np.array([[missing if value is None else value for value in row] for row in values])


def _write_tables(table: xr.Dataset, directory: Path) -> None:
    """`trials.csv`, one row a trial and iteration, and `trials.nc`, both renamed into place."""
    aside = directory / "trials.csv.part"
    with aside.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for number in table["seed"].values:
            for iteration in table["iteration"].values:
                cell = table.sel(seed=number, iteration=iteration)
                answers, value = int(cell["answers"]), float(cell["value"])
                writer.writerow([table.attrs["env"], table.attrs["utility"], number, iteration, answers, value])
    aside.replace(directory / "trials.csv")
    aside = directory / "trials.nc.part"
    table.to_netcdf(aside, engine="h5netcdf")
    aside.replace(directory / "trials.nc")
