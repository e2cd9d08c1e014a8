"""Answers as a table, one line per question: `preferences.csv` of a run, and answers that were collected elsewhere."""

import csv
import io
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from bayespbrl import checks
from bayespbrl.preferences import Answer, PastQuestion
from bayespbrl.runs.files import write_file

COLUMNS = ("question", "first", "second", "answer", "answerer", "seconds", "repeats", "session", "replays")
NEEDED = ("first", "second", "answer")
COUNTS = ("question", "repeats", "replays")
GIVEN = [str(answer) for answer in Answer if answer is not Answer.UNDO]
Line = dict[Any, Any]
Parsed = TypeVar("Parsed")


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
    rows = _read(file, _row)
    given = [row for row in rows if row[2] is not Answer.SKIP]
    ordered = sorted(given, key=lambda row: row[2] is Answer.TIE)  # stable: pairs, then ties
    every = [(second, first) if answer is Answer.SECOND else (first, second) for first, second, answer, _ in ordered]
    number = sum(row[2] is not Answer.TIE for row in ordered)
    names = tuple(row[3] for row in ordered)
    sides = np.array([-1 if row[2] is Answer.SECOND else 1 for row in ordered], dtype=np.int64)
    return CollectedAnswers(tuple(every[:number]), tuple(every[number:]), sides, names if any(names) else None)


def read_questions(file: Path | str) -> tuple[PastQuestion, ...]:
    """The questions of such a file with all that is known of each, as `diagnostics.people` takes them.

    Args:
      file: as of `read_answers`, with any of the columns of `write_answers` besides, whose cells may be empty. Without
        `question` a line has the next number. Whom a question compared with whom is not in a file: `newcomer` is
        `second`.

    Raises:
      ValueError: as `read_answers`; a question that is there twice, or repeats one that is not above it, or of others.
    """
    past: dict[int, PastQuestion] = {}

    def question(line: Line, number: int) -> None:
        first, second, answer, name = _row(line, number)
        cells = {column: (line.get(column) or "").strip() for column in COLUMNS}
        try:
            counts = {column: _row_number(column, cells[column]) for column in COUNTS if cells[column]}
            seconds = _seconds(cells["seconds"]) if cells["seconds"] else None
            asked, repeats = counts.get("question", max(past, default=0) + 1), counts.get("repeats")
            if asked in past:
                raise ValueError(f"question: expected another number in each line, got {asked} twice")
            if repeats is not None and repeats not in past:
                raise ValueError(f"repeats: expected the number of a question above, got {repeats}")
            if repeats is not None and {first, second} != {past[repeats].first, past[repeats].second}:
                raise ValueError(f"repeats: expected a question about the same two, got {repeats}, about others")
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from None
        shown = (asked, first, second, second, repeats, answer, name or None, seconds)
        past[asked] = PastQuestion(*shown, cells["session"] or None, counts.get("replays"))

    _read(file, question)
    return tuple(past.values())


def _read(file: Path | str, parse: Callable[[Line, int], Parsed]) -> list[Parsed]:
    """Each line of a CSV file with answers, parsed; the file is named in an error."""
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
        return [parse(line, lines.line_num) for line in lines]
    except (OSError, ValueError, csv.Error) as error:
        raise ValueError(f"{file}: {error}") from error


def _row(line: Line, number: int) -> tuple[int, int, Answer, str]:
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


def _seconds(cell: str) -> float:
    try:
        seconds = float(cell)
    except ValueError:
        seconds = -1.0
    if not 0 <= seconds < math.inf:
        raise ValueError(f"seconds: expected a number >= 0, got {cell!r}")
    return seconds
