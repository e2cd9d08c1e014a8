"""A row of figures a seed, appended to a CSV file as it comes, so that a study that was cut goes on where it was."""

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pandas as pd

from bayespbrl.runs.files import written_aside

Row = dict[str, float]


def done(file: Path, columns: Sequence[str]) -> list[Row]:
    """The rows so far; a last one that is cut off is dropped."""
    if not file.exists():
        return []
    # half of a number is a number too
    table = csv.DictReader([line for line in file.read_text().splitlines(keepends=True) if line.endswith("\n")])
    if absent := [name for name in columns if name not in (table.fieldnames or ())]:
        raise SystemExit(f"{file}: expected a column {absent[0]}, got none; choose another --out")
    rows = [row for row in table if all(row[name] not in (None, "") for name in columns)]
    return [{name: float(row[name]) for name in columns} for row in rows]


def run(
    seeds: Sequence[int],
    file: Path,
    columns: Sequence[str],
    one_run: Callable[[int], Row],
    same: Mapping[str, float] | None = None,
    jobs: int = 1,
) -> list[Row]:
    """All rows, after the missing runs in `jobs` processes; `same` are figures that all have, which the options say."""
    rows = done(file, columns)
    for name, value in (same or {}).items():
        if others := sorted({row[name] for row in rows} - {value}):
            raise SystemExit(f"{file}: expected rows with {name} {value:g}, got {others[0]:g}; choose another --out")
    file.parent.mkdir(parents=True, exist_ok=True)
    with written_aside(file) as aside:
        pd.DataFrame(rows, columns=list(columns)).to_csv(aside, index=False, lineterminator="\r\n")
    for row in _computed(one_run, sorted(set(seeds) - {int(row["seed"]) for row in rows}), jobs):
        rows.append({name: round(value, 5) for name, value in row.items()} | dict(same or {}))
        with file.open("a", newline="") as lines:
            csv.DictWriter(lines, columns).writerow(rows[-1])
    return [row for row in rows if int(row["seed"]) in seeds]


def _computed(one_run: Callable[[int], Row], seeds: Sequence[int], jobs: int) -> Iterator[Row]:
    if jobs == 1:
        yield from map(one_run, seeds)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as processes:
        yield from processes.map(one_run, seeds)
