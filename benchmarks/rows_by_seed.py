"""A row of figures a seed, appended to a CSV file as it comes, so that a study that was cut goes on where it was."""

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import pandas as pd

from bayespbrl.runs.files import written_aside

Row = dict[str, float]


def done(file: Path, columns: Sequence[str], about: Mapping[str, str] | None = None) -> list[Row]:
    """The rows so far; a last one that is cut off is dropped.

    Args:
      file, columns: with the figures.
      about: names, each in a column of its own, that all rows have; those of others are refused.
    """
    if not file.exists():
        return []
    about = about or {}
    # half of a number is a number too
    table = csv.DictReader([line for line in file.read_text().splitlines(keepends=True) if line.endswith("\n")])
    if absent := [name for name in (*about, *columns) if name not in (table.fieldnames or ())]:
        raise SystemExit(f"{file}: expected a column {absent[0]}, got none; choose another --out")
    rows = [row for row in table if all(row[name] not in (None, "") for name in (*about, *columns))]
    for name, value in about.items():
        _same(file, name, value, [row[name] for row in rows])
    return [{name: float(row[name]) for name in columns} for row in rows]


def run(
    seeds: Sequence[int],
    file: Path,
    columns: Sequence[str],
    one_run: Callable[[int], Row],
    same: Mapping[str, float] | None = None,
    jobs: int = 1,
    about: Mapping[str, str] | None = None,
) -> list[Row]:
    """All rows, after the missing runs in `jobs` processes.

    `same` are figures that all rows have, which the options say; `about` are such names.
    """
    rows, about = done(file, columns, about), about or {}
    for name, value in (same or {}).items():
        _same(file, name, f"{value:g}", [f"{row[name]:g}" for row in rows])
    file.parent.mkdir(parents=True, exist_ok=True)
    names = [*about, *columns]
    with written_aside(file) as aside:
        table = pd.DataFrame([dict(about) | row for row in rows], columns=names)
        table.to_csv(aside, index=False, na_rep="nan", lineterminator="\r\n")
    for row in _computed(one_run, sorted(set(seeds) - {int(row["seed"]) for row in rows}), jobs):
        rows.append({name: round(value, 5) for name, value in row.items()} | dict(same or {}))
        with file.open("a", newline="") as lines:
            csv.DictWriter(lines, names).writerow(dict(about) | rows[-1])
    return [row for row in rows if int(row["seed"]) in seeds]


def _same(file: Path, name: str, value: str, found: Sequence[str]) -> None:
    if others := sorted(set(found) - {value}):
        raise SystemExit(f"{file}: expected rows with {name} {value}, got {others[0]}; choose another --out")


def _computed(one_run: Callable[[int], Row], seeds: Sequence[int], jobs: int) -> Iterator[Row]:
    """A row for each seed, as they end."""
    if jobs == 1:
        yield from map(one_run, seeds)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as processes:
        for future in as_completed([processes.submit(one_run, seed) for seed in seeds]):
            yield future.result()
