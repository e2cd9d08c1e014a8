"""The directory of a run: settings, an append-only log of events, one netCDF file an iteration, a summary.

settings.json         what the run was asked to do; the directory appears with it in one step
events.jsonl          every question and every answer, flushed before the learner moves on
iterations/0001.nc    trajectories, policy, utility estimate and posterior, renamed into place
summary.json          one object for each completed iteration
"""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, fields
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from bayespbrl.events import Entry, LearnerState, surviving
from bayespbrl.runs.files import write_file
from bayespbrl.runs.iteration_files import read_iteration, write_iteration
from bayespbrl.settings import Settings

FORMAT = 2  # 1 named classes by their modules


class RunDirectory:
    """The log of a run (see the module's first lines). Made by `create` or `open`."""

    def __init__(self, path: Path, settings: Settings):
        self.path = path
        self.settings = settings
        self._end: int | None = None  # bytes of the log as this learner left it

    @classmethod
    def create(cls, path: Path | str, settings: Settings) -> "RunDirectory":
        """A new run directory, which appears at once with its settings in it.

        Raises:
          ValueError: the path exists, or cannot be written.
        """
        path = Path(path)
        if path.exists() or path.is_symlink():
            raise ValueError(f"{path}: expected a run directory that does not exist yet, got an existing one")
        content = {"format": FORMAT, "version": version("bayespbrl"), **asdict(settings)}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            building = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
            try:
                building.chmod(0o755)
                write_file(building / "settings.json", json.dumps(content, indent=2) + "\n")
                (building / "iterations").mkdir()
                building.rename(path)
            except OSError:
                shutil.rmtree(building, ignore_errors=True)
                raise
        except OSError as error:
            raise ValueError(f"{path}: cannot make a run directory there ({error})") from error
        made = cls(path, settings)
        made._end = 0
        return made

    @classmethod
    def open(cls, path: Path | str) -> "RunDirectory":
        """The run directory at `path`; `ValueError` if it is none or of a newer format."""
        path = Path(path)
        file = path / "settings.json"
        try:
            content = json.loads(file.read_text())
        except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise ValueError(f"{path}: expected a run directory with its settings.json, got {error}") from error
        if not isinstance(content, dict) or not isinstance(content.get("format"), int):
            raise ValueError(f"{file}: expected the settings of a run, got a foreign file")
        if content["format"] > FORMAT:
            raise ValueError(f"{file}: expected format {FORMAT}, got {content['format']} of a newer version")
        if content["format"] < FORMAT:
            raise ValueError(
                f"{file}: expected format {FORMAT}, got {content['format']}: read it with the version that wrote it, "
                f"{content.get('version', 'an older one')}"
            )
        names = {field.name for field in fields(Settings)}
        try:
            return cls(path, Settings(**{name: value for name, value in content.items() if name in names}))
        except (TypeError, ValueError) as error:
            raise ValueError(f"{file}: {error}") from error

    def append(self, entry: Entry, state: LearnerState) -> None:
        """Keep one event: first its heavy parts, then its line, flushed to the disk.

        Raises:
          ValueError: another learner has gone on with the run in the meantime; nothing is written then.
        """
        if self._end is not None and self._end != self._log_size():
            raise ValueError(
                f"{self.path}: expected the run as this learner left it, but another one has gone on with it; "
                "resume it to go on from there"
            )
        if entry.parts:
            write_iteration(self.iteration_file(entry.event["iteration"]), entry)
        line = (json.dumps(dict(entry.event), allow_nan=False) + "\n").encode()
        with (self.path / "events.jsonl").open("ab", buffering=0) as file:
            before = file.tell()
            try:
                if file.write(line) != len(line):
                    raise OSError(f"{file.name}: the line was not written whole")
                os.fsync(file.fileno())
                if entry.event["event"] in ("improved", "undone"):
                    self.write_summary(state)
                self._end = file.tell()
            except BaseException:  # a full disk or Ctrl-C: the learner will not have moved on either
                file.truncate(before)
                raise

    def finished(self) -> bool:
        """Whether the run has completed all its iterations, by its summary."""
        return (self.path / "summary.json").exists() and bool(read_summary(self.path)["finished"])

    def entries(self, *, features: Any = None, known: Sequence[type] = ()) -> Iterator[Entry]:
        """The events so far, what was undone left out, with their heavy parts; neither is a last line cut off."""
        for event in surviving(self._events()):
            parts = {}
            if event["event"] in ("collected", "improved"):
                parts = read_iteration(
                    self.iteration_file(event["iteration"]), event["event"], features=features, known=known
                )
            yield Entry(event, parts)

    def _events(self) -> Iterator[dict[str, Any]]:
        for number, line in enumerate(self._complete_lines(), start=1):
            try:
                event = json.loads(line)
            except ValueError:
                event = None
            heavy = isinstance(event, dict) and event.get("event") in ("collected", "improved")
            if (
                not isinstance(event, dict)
                or "event" not in event
                or (heavy and type(event.get("iteration")) is not int)
            ):
                raise ValueError(f"events.jsonl, line {number}: expected an event, got {line[:60]!r}")
            yield event

    def summarised(self) -> int:
        """How many iterations `summary.json` tells of; 0 where it cannot be read, for it is made anew from the log."""
        try:
            return len(read_summary(self.path)["iterations"])
        except (ValueError, TypeError):
            return 0

    def expect_whole(self, state: LearnerState, known: int) -> None:
        """That the log is not shorter than the summary: who went on with it would write over what it lost.

        An event that was interrupted can leave the summary one iteration ahead, and one that takes an answer back more.

        Args:
          state: by the log.
          known: what was `summarised` before the log was read, for another process may be going on with the run.

        Raises:
          ValueError: iterations are missing from the log.
        """
        if known <= state.iteration + 1:
            return
        if [event["event"] for event in self._events()][-1:] != ["undone"]:
            raise ValueError(
                f"events.jsonl: expected the {known} completed iterations that summary.json tells of, "
                f"got {state.iteration}"
            )

    def drop_partial_line(self) -> None:
        """Cut off a last line that a killed process left half-written, so that the next event starts a new one."""
        file = self.path / "events.jsonl"
        if file.exists():
            whole = file.read_bytes()
            complete = whole[: whole.rfind(b"\n") + 1]
            if complete != whole:
                os.truncate(file, len(complete))
        self._end = self._log_size()

    def _log_size(self) -> int:
        file = self.path / "events.jsonl"
        return file.stat().st_size if file.exists() else 0

    def _complete_lines(self) -> list[str]:
        file = self.path / "events.jsonl"
        if not file.exists():
            return []
        try:
            return file.read_text(encoding="utf-8").split("\n")[:-1]
        except UnicodeDecodeError as error:
            raise ValueError(f"events.jsonl: expected lines of JSON, got {error}") from error

    def iteration_file(self, number: int) -> Path:
        """Where the heavy parts of an iteration are kept."""
        return self.path / "iterations" / f"{number:04d}.nc"

    def write_summary(self, state: LearnerState) -> None:
        """Write `summary.json` anew."""
        summary = {
            "env": self.settings.env,
            "utility": self.settings.utility,
            "seed": self.settings.seed,
            "finished": state.iteration >= self.settings.iterations,
            "answers": state.preferences.answers,
            "iterations": list(state.summaries),
        }
        write_file(self.path / "summary.json", json.dumps(summary, indent=1) + "\n")


def read_summary(directory: Path | str) -> dict[str, Any]:
    """`summary.json` of a run; `ValueError` if it is missing, truncated or foreign."""
    file = Path(directory) / "summary.json"
    try:
        summary = json.loads(file.read_text())
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{file}: expected the summary of a run, got {error}") from error
    if not isinstance(summary, dict) or not {"seed", "finished", "iterations"} <= set(summary):
        raise ValueError(f"{file}: expected the summary of a run, got a foreign file")
    return summary


def fresh_directory(env: str) -> Path:
    """A path under `runs/` that does not exist yet, named by environment and time."""
    stem = f"{env.replace('/', '-').lower()}-{datetime.now().strftime('%Y%m%d-%H%M%S')}"
    path, count = Path("runs") / stem, 1
    while path.exists():
        count += 1
        path = Path("runs") / f"{stem}-{count}"
    return path
