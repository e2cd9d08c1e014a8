"""A declared study on disk: a run directory for each cell, a copy of the declaration, one table.

study.toml          the declaration
study.json          study, version, source, command, machine, rounding, date; of cells made elsewhere, `earlier`
iterations.csv      a line for each trial and iteration of the finished trials
TASK/METHOD/…/seed-1000/   the run directories
"""

import json
import tomllib
from collections.abc import Callable, Set
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from io import StringIO
from pathlib import Path
from statistics import fmean
from typing import Any

import pandas as pd

from bayespbrl import checks
from bayespbrl.baselines import NEEDED
from bayespbrl.envs.opening import open_environment
from bayespbrl.runs.files import ASIDE, write_file
from bayespbrl.studies.declaration import AXES, Declaration, parsed
from bayespbrl.studies.engine import Engine, Failure, Progress
from bayespbrl.studies.machine import machine, rounding, source_digest
from bayespbrl.studies.rows import DamagedTrial, Row, Seeds, collected, row_of, seconds_of
from bayespbrl.studies.tables import FIGURES, SECONDS, took_place
from bayespbrl.studies.trials import executor_for

Trial = tuple[tuple[str, str, str, str], int]  # the levels of its row, and its seed
WHENCE = ("source", "machine", "rounding")


@dataclass
class Study:
    """A study that can be run.

    Attributes:
      declaration: what was declared.
      directory: where it is kept.
      trials: of each row.
      rows: the seeds of each row of the declaration, with what is finished already.
    """

    declaration: Declaration
    directory: Path
    trials: int
    rows: list[Seeds]

    @classmethod
    def prepare(cls, declaration: Declaration, directory: Path | str, *, trials: int | None = None) -> "Study":
        """The study with the cells that its directory holds; nothing is written.

        Args:
          declaration: what to run.
          directory: a new one, or that of this study by this version.
          trials: of each row; None: as declared. More may be run later.

        Raises:
          ValueError: a bad option or an unknown task, by its row; a directory of something else, of other settings or
            of another version; fewer trials than are finished.
        """
        directory = Path(directory)
        number = declaration.trials if trials is None else checks.whole("trials", trials)
        _check_same(declaration, directory)
        rows = []
        for declared in declaration.rows:
            try:
                row = row_of(
                    declared.env,
                    directory / declared.name,
                    declared.options,
                    seed=declaration.seed,
                    untrained=declared.untrained,
                    name=declared.name,
                )
                _check_baseline(declared.baseline, row)
            except ValueError as error:
                raise ValueError(f"study {declaration.name}, {declared.name}: {error}") from error
            seeds = Seeds(replace(row, baseline=declared.baseline), number)
            seeds.to_do()
            _check_no_more(seeds)
            rows.append(seeds)
        return cls(declaration, directory, number, rows)

    @property
    def cells(self) -> int:
        """Number of trials in all."""
        return self.trials * len(self.rows)

    @property
    def finished(self) -> int:
        """Number of finished cells."""
        return sum(len(row.with_outcome(True)) for row in self.rows)

    def minutes_left(self) -> float | None:
        """Estimated minutes on one core for the unfinished cells; None without a finished or declared time.

        By the row's finished trials, else as declared.
        """
        total = 0.0
        for declared, row in zip(self.declaration.rows, self.rows, strict=True):
            left = self.trials - len(row.with_outcome(True))
            known = [seconds_of(row.row, seed) for seed in row.with_outcome(True)]
            took = [seconds / 60 for seconds in known if seconds is not None]
            each = 0.0 if declared.untrained else fmean(took) if took else declared.minutes
            if left and each is None:
                return None
            total += left * (each or 0.0)
        return total

    def run(
        self,
        jobs: int | Executor = 1,
        *,
        command: str = "",
        progress: Callable[[Progress], None] | None = None,
    ) -> list[Failure]:
        """Run the unfinished cells, and write the tables.

        Args:
          jobs: trials at a time, in processes of this machine; or an executor, whose workers see the same directory.
          command: what the study was started with, to be kept.
          progress: called as the study goes on.

        Returns:
          the trials that were given up; all others are finished.
        """
        with executor_for(jobs) as executor:
            if self.finished < self.cells or not (self.directory / "study.json").exists():
                self._write_declaration(command)
            else:
                self._write_changes()
            failures = Engine(self.rows, executor, progress).run()
        self.write_table()
        return failures

    def _write_declaration(self, command: str) -> None:
        """`study.toml` and `study.json`, which keeps where earlier cells are from, if from elsewhere."""
        begun = any(
            file.exists() for file in (self.directory / "iterations.csv", *(r.row.directory for r in self.rows))
        )
        before = read_study_json(self.directory) if begun and (self.directory / "study.json").exists() else {}
        content: dict[str, Any] = {
            "study": self.declaration.name,
            "title": self.declaration.title,
            "version": version("bayespbrl"),
            "source": source_digest(),
            "command": command,
            "machine": machine(),
            "rounding": rounding(),
            "date": datetime.now(UTC).date().isoformat(),
            "trials": self.trials,
            "seed": self.declaration.seed,
        }
        earlier = list(before.get("earlier", []))
        if before and any(before.get(name) != content[name] for name in WHENCE):
            earlier.append({name: before.get(name) for name in (*WHENCE, "command", "date")})
        if earlier:
            content["earlier"] = earlier
        self.directory.mkdir(parents=True, exist_ok=True)
        write_file(self.directory / "study.toml", self.declaration.text)
        write_file(self.directory / "study.json", json.dumps(content, indent=1) + "\n")

    def _write_changes(self) -> None:
        """What may change of a finished study: its declaration's title and levels, and the number of trials."""
        before = read_study_json(self.directory)
        content = before | {"title": self.declaration.title, "trials": self.trials}
        if (self.directory / "study.toml").read_text(encoding="utf-8") != self.declaration.text:
            write_file(self.directory / "study.toml", self.declaration.text)
        if content != before:
            write_file(self.directory / "study.json", json.dumps(content, indent=1) + "\n")

    def write_table(self, out: Path | None = None) -> None:
        """Write `iterations.csv` of the finished trials; lines of those whose run directories are gone stay.

        Args:
          out: the directory to write to; None: the study's.
        """
        finished = [row for row in zip(self.declaration.rows, self.rows, strict=True) if row[1].with_outcome(True)]
        if finished:
            lines = pd.concat([_table_of(declared.levels, seeds) for declared, seeds in finished])
            self.write_lines("iterations.csv", lines, self.trials_with(True), out)

    def write_lines(self, name: str, lines: pd.DataFrame, read: Set[Trial], out: Path | None = None) -> None:
        """Write a table of trials. What the study's table of that name has of trials not read stays.

        Args:
          name: of the file.
          lines: columns `AXES`, `seed` and others.
          read: the trials whose lines these are.
          out: the directory to write to; None: the study's.
        """
        file = self.directory / name
        text = lines.to_csv(index=False, lineterminator="\n", float_format="%.6g")
        if file.exists():
            new = pd.read_csv(StringIO(text), dtype=str, keep_default_na=False)
            try:
                kept = pd.read_csv(file, dtype=str, keep_default_na=False)
                same = list(kept.columns) == list(new.columns)
                stays = [trial not in read for trial in _trials(kept)] if same else []
            except (OSError, ValueError) as error:  # pandas' own errors are ValueErrors
                raise ValueError(f"{file}: expected a table, got {checks.reason(error)}") from error
            if same:
                whole = pd.concat([new, kept[stays]])
                places = {row.levels: place for place, row in enumerate(self.declaration.rows)}
                order = [(places.get(levels, len(places)), seed) for levels, seed in _trials(whole)]
                text = whole.iloc[sorted(range(len(order)), key=order.__getitem__)].to_csv(
                    index=False, lineterminator="\n"
                )
        write_file((out or self.directory) / name, text)

    def trials_with(self, outcome: bool) -> set[Trial]:
        """The trials on disk that count (True) or were redrawn (False)."""
        rows = zip(self.declaration.rows, self.rows, strict=True)
        return {(declared.levels, seed) for declared, seeds in rows for seed in seeds.with_outcome(outcome)}


def _trials(lines: pd.DataFrame) -> list[Trial]:
    columns = (lines[name].to_list() for name in (*AXES, "seed"))
    return [((a, b, c, d), int(seed)) for a, b, c, d, seed in zip(*columns, strict=True)]


def _table_of(levels: tuple[str, ...], seeds: Seeds) -> pd.DataFrame:
    """A line for each trial of a row and each iteration that it had."""
    table = collected(seeds)
    if SECONDS[0] in table:
        table["seconds"] = sum(table[name] for name in SECONDS)
    present = {column: name for column, name in FIGURES.items() if name in table}
    lines = table[list(present.values())].to_dataframe(["seed", "iteration"]).reset_index()
    lines = lines.rename(columns={name: column for column, name in present.items()})
    if "seconds" in lines:
        lines = lines[took_place(table).values.ravel()]
    lines = lines.astype({"answers": int} | ({"converged": bool} if "converged" in lines else {}))
    for place, (axis, level) in enumerate(zip(AXES, levels, strict=True)):
        lines.insert(place, axis, level)
    return lines.reindex(columns=[*AXES, "seed", "iteration", *FIGURES])


def _check_baseline(baseline: str | None, row: Row) -> None:
    """Check that a row's task and options suit its baseline, if it has one."""
    if baseline is None:
        return
    if row.settings.questions.clip_steps is not None:
        raise ValueError("clip_steps: expected none, because a baseline compares whole trajectories")
    environment = open_environment(row.env)
    NEEDED[baseline](environment)
    environment.close()


def _check_same(declaration: Declaration, directory: Path) -> None:
    """Check that a directory is new, or holds this study by this version."""
    if not directory.exists():
        return
    if not directory.is_dir():
        raise ValueError(f"{directory}: expected a directory for the study, got a file")
    names = (path.name for path in directory.iterdir())
    if {name for name in names if not ASIDE.search(name)} <= {"study.toml"}:  # empty, or stopped as it began
        return
    kept = read_study_json(directory)
    if kept.get("version") != version("bayespbrl"):
        raise ValueError(
            f"{directory}: expected a study by version {version('bayespbrl')}, got one by {kept.get('version')}; "
            "choose another --out"
        )
    if kept.get("study") != declaration.name:
        raise ValueError(
            f"{directory}: expected the study {declaration.name}, got {kept.get('study')}; choose another --out"
        )
    before = parsed((directory / "study.toml").read_text(encoding="utf-8"), declaration.name)
    if before.seed != declaration.seed:
        raise ValueError(f"{directory}: expected its seed, {before.seed}, got {declaration.seed}; choose another --out")
    rows = _settled(declaration)
    if others := [name for name, settled in _settled(before).items() if rows.get(name) != settled]:
        what = "other options" if others[0] in rows else "none of that name"
        raise ValueError(
            f"{directory}: expected all rows that the study has, as they are there, and perhaps more, got {what} for "
            f"{others[0]}; choose another --out"
        )


def _check_no_more(seeds: Seeds) -> None:
    """Check that a row has no more finished trials than it is to have: the table would lose them.

    Where a redrawn trial is damaged or gone, the one that replaced it lies beyond the seeds, and is none too many.
    """
    row, more = seeds.row, 0
    beyond = row.settings.seed + len(seeds.outcomes)
    kept = (path.name.removeprefix("seed-") for path in row.directory.glob("seed-*"))
    for seed in (int(each) for each in kept if each.isdecimal()):
        with suppress(DamagedTrial):
            more += seed >= beyond and bool(row.outcome(seed))
    if more and more + len(seeds.with_outcome(True)) > seeds.trials:
        raise ValueError(f"trials: expected more than {seeds.trials}, of which {row.name} has finished more already")


def _settled(declaration: Declaration) -> dict[str, tuple[Any, ...]]:
    """What may not change of a row between two calls, by its name."""
    return {row.name: (row.env, dict(row.options), row.untrained, row.baseline) for row in declaration.rows}


def read_study_json(directory: Path) -> dict[str, Any]:
    """`study.json` of a study's directory; `ValueError` where there is none, or it is damaged."""
    file = directory / "study.json"
    try:
        content = json.loads(file.read_text())
        if not (directory / "study.toml").exists():
            raise OSError("it has no study.toml")
        tomllib.loads((directory / "study.toml").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{directory}: expected the directory of a study, got {error}") from error
    earlier = content.get("earlier", []) if isinstance(content, dict) else None
    if not isinstance(earlier, list) or not all(isinstance(part, dict) for part in earlier):
        raise ValueError(f"{file}: expected the description of a study, got {str(content)[:60]}")
    return content
