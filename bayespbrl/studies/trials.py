"""The same run for many seeds, side by side (paper, "Experiments"): a study of one row."""

from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import xarray as xr

from bayespbrl import checks
from bayespbrl.studies.engine import Engine, Progress
from bayespbrl.studies.processes import trial_processes
from bayespbrl.studies.rows import Seeds, collected, row_of
from bayespbrl.studies.tables import by_answers, write_tables


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
    jobs: int | Executor = 1,
    preference_within: int | None = None,
    progress: Callable[[int], None] | None = None,
    **settings: Any,
) -> Trials:
    """Run one trial per seed, each in a run directory of its own.

    Finished trials are kept and unfinished ones continue where they stopped, so a study can be interrupted and resumed.
    A trial that meets no preference within its first iterations stops there, and the next unused seed above `seeds`
    replaces it. A trial whose process dies is continued, at most twice.

    Args:
      env: a short name or a gymnasium id.
      directory: of the study, with the run directories `seed-1000`, … and the tables `trials.csv` and `trials.nc`.
      seeds: consecutive, such as `range(1000, 1020)`.
      jobs: trials at a time, in processes of this machine; or an executor, whose workers see the same directory.
      preference_within: the number of iterations within which a trial has to meet a preference (an answer that is no
        tie); None for that of the environment in `PREFERENCE_WITHIN`, or no limit.
      progress: called with the seed of each trial that counts, those finished before included.
      **settings: options of `Settings`.

    Raises:
      ValueError: bad options; the directory of a run; a trial in the directory with other settings; a trial that
        failed, by its seed; too few seeds that meet a preference.
    """
    if not isinstance(seeds, range) or seeds.step != 1 or not seeds:
        raise ValueError(f"seeds: expected a range of consecutive seeds, at least one, got {seeds!r}")
    checks.seed(seeds[-1])
    if (Path(directory) / "settings.json").exists():
        raise ValueError(f"{directory}: expected a directory for trials, got a run; choose another one")
    row = row_of(env, Path(directory), settings, seed=seeds.start, preference_within=preference_within)
    tried = Seeds(row, len(seeds))

    def report(state: Progress) -> None:
        if progress is not None and state.latest is not None:
            progress(state.latest[1])

    with executor_for(jobs) as executor:
        failures = Engine([tried], executor, report).run()
    if failures:
        raise ValueError(f"{len(failures)} of {tried.trials} trials failed; the first: {failures[0]}")
    table = collected(tried)
    write_tables(table, row.directory)
    return Trials(table, row.directory)


def executor_for(jobs: int | Executor) -> AbstractContextManager[Executor]:
    """Processes of this machine, as many as `jobs`; or the executor given, which stays open."""
    return nullcontext(jobs) if isinstance(jobs, Executor) else trial_processes(checks.whole("jobs", jobs))
