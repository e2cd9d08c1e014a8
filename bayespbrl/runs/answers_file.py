"""Answers as a table, one line per question: `preferences.csv` of a run, and answers that were collected elsewhere."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bayespbrl import checks
from bayespbrl.preferences import Answer, PastQuestion
from bayespbrl.runs.files import write_file

COLUMNS = ("question", "first", "second", "answer", "answerer", "seconds", "repeats", "session", "replays")
NEEDED = ("first", "second", "answer")
GIVEN = [str(answer) for answer in Answer if answer is not Answer.UNDO]


class CollectedAnswers(NamedTuple):
    """Answers as `infer_utility` takes them: `infer_utility(feature_sums, **read_answers(file)._asdict())`.

    Attributes:
      pairs: (preferred, other), row numbers.
      ties: pairs without a difference.
      shown_first: 1 where the first of the pair, or of the tie, was shown first, else −1, shape (K,): pairs, then ties.
      answerers: who gave each, in the same order, "" without a name; None where nobody has a name.
    """

    pairs: tuple[tuple[int, int], ...]
    ties: tuple[tuple[int, int], ...]
    shown_first: np.ndarray
    answerers: tuple[str, ...] | None


def write_answers(file: Path | str, past: Sequence[PastQuestion]) -> Path:
    """Write the questions that were answered, in their order, and return the path.

    The columns are `question`, its number; `first` and `second`, the numbers of the trajectories in the order shown;
    `answer`, one of first, second, tie and skip ("cannot tell"); `answerer`, `seconds` and `repeats`, the number of the
    earlier question that it repeats; `session`, of the sitting, and `replays`, how often the clips began again. The
    last five are empty where they are not known.
    """
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(COLUMNS)
    for each in past:
        known = (getattr(each, name) for name in COLUMNS[4:])
        values = ("" if value is None else value for value in known)
        writer.writerow([each.number, each.first, each.second, str(each.answer), *values])
    file = checks.path("file", file)
    try:
        write_file(file, table.getvalue())
    except OSError as error:
        raise ValueError(f"{file}: expected a place where the answers can be written, got {error}") from error
    return file


def read_answers(file: Path | str) -> CollectedAnswers:
    """Answers of a run, or collected elsewhere, from a CSV file.

    Args:
      file: with a head and at least the columns `first`, `second` (whole numbers from 0, in the order shown) and
        `answer`; `answerer` is read where it is there, and other columns are not. Rows with the answer skip are left
        out. A byte-order mark, as Excel writes it, and spaces around a cell do no harm.

    Raises:
      ValueError: a file that cannot be read, a missing column or one in capitals, or a bad cell, by its line and
        column.
    """
    file = checks.path("file", file)
    try:
        lines = csv.DictReader(io.StringIO(file.read_text(encoding="utf-8-sig"), newline=""))
        lines.fieldnames = [name.strip() for name in lines.fieldnames or ()]
        if not set(NEEDED) <= set(lines.fieldnames) or len(set(lines.fieldnames)) < len(lines.fieldnames):
            raise ValueError(
                f"expected the columns {', '.join(NEEDED)}, each once and separated by commas, got "
                f"{', '.join(lines.fieldnames) or 'none'}"
            )
        for name in lines.fieldnames:
            if name not in COLUMNS and name.lower() in COLUMNS:
                raise ValueError(f"expected the column {name.lower()} in small letters, got {name}")
        rows = [_row(line, lines.line_num) for line in lines]
    except (OSError, ValueError, csv.Error) as error:
        raise ValueError(f"{file}: {error}") from error
    given = [row for row in rows if row[2] is not Answer.SKIP]
    ordered = sorted(given, key=lambda row: row[2] is Answer.TIE)  # stable: pairs, then ties
    every = [(second, first) if answer is Answer.SECOND else (first, second) for first, second, answer, _ in ordered]
    number = sum(row[2] is not Answer.TIE for row in ordered)
    names = tuple(row[3] for row in ordered)
    sides = np.array([-1 if row[2] is Answer.SECOND else 1 for row in ordered], dtype=np.int64)
    return CollectedAnswers(tuple(every[:number]), tuple(every[number:]), sides, names if any(names) else None)


def _row(line: dict[Any, Any], number: int) -> tuple[int, int, Answer, str]:
    try:
        if None in line:
            raise ValueError(f"expected a cell for each column, got {len(line[None] or ())} more")
        first, second = (_row_number(name, line[name]) for name in ("first", "second"))
        if first == second:
            raise ValueError(f"second: expected another number than first, got {second} twice")
        answer = Answer(checks.one_of("answer", (line["answer"] or "").strip(), GIVEN))
        name = (line.get("answerer") or "").strip()
        return first, second, answer, checks.short_name("answerer", name) if name else ""
    except ValueError as error:
        raise ValueError(f"line {number}: {error}") from None


def _row_number(column: str, cell: str | None) -> int:
    text = (cell or "").strip()
    if not text.isdecimal():
        raise ValueError(f"{column}: expected a whole number >= 0, got {text!r}")
    return int(text)
