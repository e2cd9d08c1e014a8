"""The data of a study: its description, its declaration, a line for each iteration, and each predicted answer.

They are read from a study's directory, or from a copy of these four files alone: `study.json`, `study.toml`,
`iterations.csv`, `answers.csv`.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bayespbrl import checks
from bayespbrl.settings import MOST_TRAJECTORIES, settings_for
from bayespbrl.studies.declaration import AXES, Declaration, DeclaredRow, parsed
from bayespbrl.studies.study import read_study_json
from bayespbrl.studies.tables import FIGURES, by_answers

ITERATION_COLUMNS = [*AXES, "seed", "iteration", *FIGURES]
ANSWER_COLUMNS = [*AXES, "seed", "question", "iteration", "predicted", "first"]
IN_EACH_LINE = ("seed", "question", "iteration", "answers", "predicted")  # a trial without a value has failed
# Options that need what the default derives from the task; without it, values that allow whatever a study ran with.
WITHOUT_TASK = {"trajectories_per_iteration": MOST_TRAJECTORIES, "against_kept": False}


@dataclass(frozen=True)
class RowData:
    """The trials of one row.

    Attributes:
      declared: the row.
      seeds: of the finished trials, in increasing order.
      answers: numbers of answers, increasing, from the smallest that every trial has a policy for, shape (n,).
      values: of each trial's last policy with no more answers, shape (S, n).
      used: answers of each trial in all, shape (S,).
      final: value of each trial at its end, shape (S,).
      lines: the iterations, all columns.
    """

    declared: DeclaredRow
    seeds: tuple[int, ...]
    answers: np.ndarray
    values: np.ndarray
    used: np.ndarray
    final: np.ndarray
    lines: pd.DataFrame

    @property
    def allowed(self) -> int:
        """The budget of answers, by the options; or the most that a trial used, if that is more."""
        options = {**self.declared.options, **WITHOUT_TASK}
        return max(int(self.used.max()), settings_for(self.declared.env, **options).most_answers)

    def at(self, answers: float) -> np.ndarray | None:
        """Value of each trial after that many answers, or its last where it ended with fewer.

        None above the budget, and where some trial has no policy by then.
        """
        reached = np.flatnonzero(self.answers <= answers)
        return self.values[:, reached[-1]] if len(reached) and answers <= self.allowed else None


@dataclass(frozen=True)
class StudyData:
    """The data of a study.

    Attributes:
      path: where they are.
      description: `study.json`.
      declaration: `study.toml`.
      rows: those with finished trials, in the order of the declaration.
      predicted: each predicted answer, columns `ANSWER_COLUMNS`; None without `answers.csv`.
    """

    path: Path
    description: dict[str, Any]
    declaration: Declaration
    rows: tuple[RowData, ...]
    predicted: pd.DataFrame | None

    @property
    def name(self) -> str:
        return self.declaration.name

    @property
    def tasks(self) -> list[str]:
        """The tasks with finished trials, in the order of the declaration."""
        return list(dict.fromkeys(row.declared.levels[0] for row in self.rows))

    def of_task(self, task: str) -> list[RowData]:
        """The rows of a task."""
        return [row for row in self.rows if row.declared.levels[0] == task]

    def row_of(self, declared: DeclaredRow) -> RowData | None:
        """The trials of a declared row; None where none is finished."""
        return next((row for row in self.rows if row.declared is declared), None)

    def reference_of(self, declared: DeclaredRow) -> DeclaredRow | None:
        """The row that another one is compared with; None for a task's first, and for those that define the scale.

        The first method with the same noise and variant; of the first method, the first noise; of that, the first
        variant.
        """
        if declared.of_scale:
            return None
        for axis in range(1, len(AXES)):
            rest = declared.levels[:axis] + declared.levels[axis + 1 :]
            alike = (row for row in self.declaration.rows if row.levels[:axis] + row.levels[axis + 1 :] == rest)
            if (first := next(row for row in alike if not row.of_scale)) is not declared:
                return first
        return None

    def floor(self, task: str) -> float | None:
        """Median value of the random policy; None where the study has no such row."""
        floors = [row.final for row in self.of_task(task) if row.declared.untrained]
        return float(np.median(np.concatenate(floors))) if floors else None

    def floor_and_ceiling(self, task: str) -> tuple[float, float] | None:
        """Median value of the random policy and, at its end, of the reference run on the hidden reward.

        None where the study has no such rows, or the two are not in this order.
        """
        rows, floor = self.of_task(task), self.floor(task)
        ceilings = [row.final for row in rows if row.declared.of_scale and not row.declared.untrained]
        if floor is None or not ceilings:
            return None
        ceiling = max(float(np.median(values)) for values in ceilings)
        return (floor, ceiling) if ceiling > floor else None

    @property
    def source(self) -> str:
        """Study, command, version, date and machine, for the caption of a table."""
        kept = self.description
        earlier = "".join(
            f"; some trials: source {part.get('source')}, {part.get('date')}, {part.get('machine')}"
            for part in kept.get("earlier", [])
        )
        unfinished = [declared.name for declared in self.declaration.rows if self.row_of(declared) is None]
        return (
            f"Study `{self.name}` (`{kept.get('command')}`), version {kept.get('version')} (source "
            f"{kept.get('source')}), {kept.get('date')}, {kept.get('machine')}{earlier}."
            f"{' Without finished trials: ' + ', '.join(unfinished) + '.' if unfinished else ''}"
        )


def read_study(directory: Path | str) -> StudyData:
    """The data in a directory.

    Raises:
      ValueError: no study, or a damaged file.
    """
    directory = Path(directory)
    description = read_study_json(directory)
    declaration = parsed(
        (directory / "study.toml").read_text(encoding="utf-8"), str(description.get("study", directory.name))
    )
    if not (table := directory / "iterations.csv").exists():
        raise ValueError(f"{directory}: expected finished trials, got none: there is no iterations.csv yet")
    lines = _read(table, ITERATION_COLUMNS)
    answers = directory / "answers.csv"
    rows = []
    for declared in declaration.rows:
        chosen = np.logical_and.reduce(
            [lines[axis] == level for axis, level in zip(AXES, declared.levels, strict=True)]
        )
        if chosen.any():
            rows.append(_row(declared, lines[chosen]))
    if not rows:
        raise ValueError(f"{directory}: expected finished trials in iterations.csv, got none")
    predicted = _read(answers, ANSWER_COLUMNS) if answers.exists() else None
    return StudyData(directory, description, declaration, tuple(rows), predicted)


def _read(file: Path, columns: list[str]) -> pd.DataFrame:
    try:
        # a level may be called None or NA
        missing = {name: [""] for name in (*ITERATION_COLUMNS, *ANSWER_COLUMNS, *FIGURES) if name not in AXES}
        table = pd.read_csv(file, dtype=dict.fromkeys(AXES, str), keep_default_na=False, na_values=missing)
    except (OSError, ValueError) as error:  # pandas' own errors are ValueErrors
        raise ValueError(f"{file}: expected a table, got {checks.reason(error)}") from error
    if absent := [name for name in columns if name not in table]:
        raise ValueError(f"{file}: expected the columns {', '.join(columns)}, got none of {', '.join(absent)}")
    if len(table):
        _check(file, table)
    return table


def _check(file: Path, table: pd.DataFrame) -> None:
    """Check the figures of a table by their kind; `ValueError` where a line was damaged."""
    for name in (*IN_EACH_LINE, *FIGURES):
        if name in table and name != "converged" and not pd.api.types.is_numeric_dtype(table[name]):
            raise ValueError(f"{file}: expected numbers as {name}, got {table[name].dtype}")
    for name in IN_EACH_LINE:
        if name in table and (gaps := int((~np.isfinite(table[name].astype(float))).sum())):
            raise ValueError(f"{file}: expected a number as {name} in each line, got none in {gaps} lines")
    key = [*AXES, "seed", "question" if "question" in table else "iteration"]
    if (again := table.duplicated(key)).any():
        line = table[again].iloc[0]
        told = ", ".join(f"{name} {line[name]}" for name in key if line[name] != "")
        raise ValueError(f"{file}: expected one line for each {key[-1]}, got two for {told}")
    if "first" in table and table["first"].dtype != bool:
        raise ValueError(f"{file}: expected True or False as first in each line, got others")
    if "predicted" in table and len(bad := table["predicted"][~table["predicted"].between(0, 1)]):
        raise ValueError(f"{file}: expected probabilities as predicted, got {bad.iloc[0]:g}")


def _row(declared: DeclaredRow, lines: pd.DataFrame) -> RowData:
    lines = lines.sort_values(["seed", "iteration"])
    grouped = [trial for _, trial in lines.groupby("seed")]
    longest = max(len(trial) for trial in grouped)

    def padded(name: str) -> np.ndarray:  # a trial that ended earlier keeps its last figures
        return np.array([np.pad(trial[name].values, (0, longest - len(trial)), mode="edge") for trial in grouped])

    answers, values = padded("answers"), padded("value")
    numbers, reached = by_answers(answers, values)
    seeds = tuple(int(trial["seed"].iloc[0]) for trial in grouped)
    return RowData(declared, seeds, numbers, reached, answers[:, -1], values[:, -1], lines)
