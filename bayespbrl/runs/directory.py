"""The directory of a run: settings, an append-only log of events, one netCDF file per iteration, a summary.

settings.json         the options of the run; the directory is created together with this file, in one step
events.jsonl          every question and every answer, flushed to the disk before the learner moves on
iterations/0001.nc    the iteration's trajectories, policy and its trials, utility estimate and posterior
summary.json          the figures of each completed iteration
"""

import json
import os
import shlex
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from bayespbrl import checks
from bayespbrl.events import Entry, LearnerState, surviving
from bayespbrl.features import StateFeatures
from bayespbrl.runs.files import check_file, check_folder, synchronise, write_file
from bayespbrl.runs.iteration_files import read_iteration, write_iteration
from bayespbrl.settings import OPTIONS, Settings

FORMAT = 3  # format 2 had one setting's posterior beside an average; format 1 named classes by their modules
HEAVY = ("collected", "improved")  # events with heavy parts, in the file of their iteration
BASELINE_FILE, FIRST_POLICY_FILE = "baseline.json", "first-policy.json"  # of a study's trials that do not learn so
Event = dict[str, Any]
Spaces = Mapping[str, str]  # the environment's, by name, in words, and the keywords of a user's object


class RunDirectory:
    """A run directory, which is the learner's `Log`; `create` makes a new one, `open` finds an existing one."""

    def __init__(self, path: Path, settings: Settings, spaces: Spaces):
        self.path = path.absolute()  # a notebook may change its directory
        self.settings, self.spaces = settings, spaces
        self._read = 0  # size of the log, in bytes, as far as `entries` has read it
        self._end: int | None = None  # and after this learner's last event

    @classmethod
    def create(cls, path: Path | str, settings: Settings, spaces: Spaces) -> "RunDirectory":
        """A new run directory. It appears together with its settings, or not at all.

        Args:
          path: must not exist.
          settings, spaces: of the run.

        Raises:
          ValueError: the path exists, or cannot be written, or is no UTF-8, which netCDF could not read.
        """
        path = checks.path("directory", path)
        try:
            bytes(path.absolute()).decode()
        except UnicodeDecodeError as error:
            raise ValueError(f"{str(path)!a}: expected a path in UTF-8, got another") from error
        content = {"format": FORMAT, "version": version("bayespbrl"), "env": settings.env, **settings.options()}
        content["spaces"] = dict(spaces)
        try:
            if path.exists() or path.is_symlink():
                it = "a run, which resume continues" if (path / "settings.json").exists() else "one that exists"
                raise ValueError(f"{path}: expected a run directory that does not exist yet, got {it}")
            path.parent.mkdir(parents=True, exist_ok=True)
            building = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
            try:
                building.chmod(0o777 & ~_umask())
                write_file(building / "settings.json", json.dumps(content, indent=2) + "\n")
                (building / "iterations").mkdir()
                building.rename(path)
                synchronise(path.parent)
            except BaseException:
                shutil.rmtree(building, ignore_errors=True)
                raise
        except OSError as error:
            raise ValueError(f"{path}: expected a place where a run directory can be made, got {error}") from error
        made = cls(path, settings, spaces)
        made._end = 0
        return made

    @classmethod
    def create_fresh(cls, settings: Settings, spaces: Spaces) -> "RunDirectory":
        """A new run directory under `runs/`, named after the environment and the time; errors as of `create`."""
        stem = f"{settings.env.replace('/', '-').lower()}-{datetime.now().strftime('%Y%m%d-%H%M%S')}"
        path, number = Path("runs") / stem, 1
        while True:
            try:
                return cls.create(path, settings, spaces)
            except ValueError:
                if not path.exists():  # else another run has it, which may have begun in the same second
                    raise
            number += 1
            path = Path("runs") / f"{stem}-{number}"

    @classmethod
    def open(cls, path: Path | str) -> "RunDirectory":
        """The run directory at `path`; `ValueError` where that is no run, or one of another format."""
        path = checks.path("directory", path)
        file = path / "settings.json"
        content = _read_json(file, f"{path}: expected a run directory with its settings.json")
        if not isinstance(content, dict) or not isinstance(content.get("format"), int):
            raise ValueError(f"{file}: expected the settings of a run, got {str(content)[:60]}")
        if content["format"] > FORMAT:
            raise ValueError(f"{file}: expected format {FORMAT}, got {content['format']} of a newer version")
        if content["format"] < FORMAT:
            raise ValueError(
                f"{file}: expected format {FORMAT}, got {content['format']}: read it with the version that wrote it, "
                f"{content.get('version', 'an older one')}"
            )
        if not isinstance(content.get("env"), str):
            raise ValueError(f"{file}: expected the environment's name as env, got {content.get('env')!r}")
        _check_own(path)
        known, spaces = {name: value for name, value in content.items() if name in OPTIONS}, content.get("spaces")
        try:
            settings = Settings.from_options(content["env"], known)
            return cls(path, settings, spaces if isinstance(spaces, dict) else {})  # older runs have none
        except (TypeError, ValueError) as error:
            raise ValueError(f"{file}: {error}") from error

    def check_learner(self) -> None:
        """`ValueError` where the directory is a study's trial of a baseline, or of a policy that does not learn."""
        for name, what in ((BASELINE_FILE, "a baseline"), (FIRST_POLICY_FILE, "a policy that does not learn")):
            if (self.path / name).exists():
                raise ValueError(f"{self.path}: expected a run of the learner, got a trial of {what}: see its {name}")

    def check_newest(self) -> None:
        """`ValueError` where another learner has written to the run since this one's last event."""
        if not self.path.exists():
            raise ValueError(f"{self.path}: expected the run directory, which is gone")
        self._check_size(self._log_size())

    def _check_size(self, size: int) -> None:
        if self._end is not None and self._end != size:
            raise ValueError(
                f"{self.path}: expected the run as this learner left it, got events that another learner has written; "
                "resume the run to continue from there"
            )

    def append(self, entry: Entry, state: LearnerState) -> None:
        """Write one event: first its heavy parts, then its line, flushed to the disk.

        Raises:
          ValueError: another learner has written to the run in the meantime; nothing is written then.
        """
        self.check_newest()
        if entry.parts:
            write_iteration(self.iteration_file(entry.event["iteration"]), entry)
        line = (json.dumps(dict(entry.event), allow_nan=False) + "\n").encode()
        with self.log_file.open("ab", buffering=0) as file:
            before = file.tell()
            self._check_size(before)  # the heavy parts took their time
            try:
                if file.write(line) != len(line):
                    raise OSError(f"{file.name}: the line was not written whole")
                os.fsync(file.fileno())
                if not before:
                    synchronise(self.path)  # the log's name, too, outlasts a power failure
                if entry.event["event"] in ("improved", "undone"):
                    self.write_summary(state)
                self._end = file.tell()
            except BaseException:  # a full disk or Ctrl-C: the learner does not move on either
                file.truncate(before)
                raise

    def entries(self, *, features: StateFeatures | None = None, known: Sequence[type] = ()) -> Iterator[Entry]:
        """The events so far with their heavy parts, without those undone and without a last line that is cut off.

        Args:
          features: φ(s) of the user's, where the run was started with it.
          known: classes of the user's that the files may name.
        """
        content = self._log()
        self._read = content.rfind(b"\n") + 1
        for event in surviving(_events(content)):
            parts = {}
            if event["event"] in HEAVY:
                parts = read_iteration(
                    self.iteration_file(event["iteration"]), event["event"], features=features, known=known
                )
            yield Entry(event, parts)

    def _log(self) -> bytes:
        try:
            return _content(self.log_file)
        except OSError as error:
            raise ValueError(f"events.jsonl: expected a log that can be read, got {error}") from error

    def summarised(self) -> int:
        """The number of iterations in `summary.json`; 0 where it cannot be read, since it is derived from the log."""
        try:
            return len(read_summary(self.path)["iterations"])
        except (ValueError, TypeError):
            return 0

    def check_complete(self, state: LearnerState, summarised: int) -> None:
        """Check that the log holds all iterations of the summary: a learner that continues would overwrite the others.

        The summary may be one iteration ahead where an event was interrupted, and more where an undo was.

        Args:
          state: the learner's, by the log.
          summarised: as returned by `summarised` before the log was read; another process may continue the run.

        Raises:
          ValueError: iterations are missing from the log.
        """
        if summarised <= state.iteration + 1:
            return
        if [event["event"] for event in _events(self._log())][-1:] != ["undone"]:
            raise ValueError(
                f"events.jsonl: expected the {summarised} completed iterations of summary.json, got {state.iteration}"
            )

    def take_over(self) -> None:
        """Continue the log from where `entries` has read it, without a last line that a killed process left cut off.

        Raises:
          ValueError: another learner has written to the run since; nothing is changed then.
        """
        content = _content(self.log_file)
        self._end = self._read
        self._check_size(content.rfind(b"\n") + 1)
        if len(content) > self._end:  # the next event starts a new line
            os.truncate(self.log_file, self._end)

    def _log_size(self) -> int:
        return self.log_file.stat().st_size if self.log_file.exists() else 0

    @property
    def log_file(self) -> Path:
        """The append-only log of events."""
        return self.path / "events.jsonl"

    def iteration_file(self, number: int) -> Path:
        """The file with the heavy parts of an iteration."""
        return self.path / "iterations" / f"{number:04d}.nc"

    def write_summary(self, state: LearnerState) -> None:
        """Write `summary.json`."""
        summary = {
            "env": self.settings.env,
            "utility": self.settings.estimation.utility,
            "seed": self.settings.seed,
            "finished": state.finished(self.settings),
            "answers": state.preferences.answers,
            "iterations": list(state.summaries),
        }
        write_file(self.path / "summary.json", json.dumps(summary, indent=1) + "\n")


class PartialLine(ValueError):
    """An incomplete last line of a log, left by a process that was killed while writing."""


def read_log_lines(file: Path) -> list[Event | ValueError]:
    """Each line of a log: an event, or an error with its line number. A missing log has no lines."""
    return _lines(_content(file))


def _content(file: Path) -> bytes:
    return file.read_bytes() if file.exists() else b""


def _events(content: bytes) -> Iterator[Event]:
    """The events of a log but for a last line that is cut off; `ValueError` for a line that is no event."""
    for event in _lines(content):
        if isinstance(event, PartialLine):
            return
        if isinstance(event, ValueError):
            raise event
        yield event


def _lines(content: bytes) -> list[Event | ValueError]:
    *lines, rest = content.split(b"\n")
    events = [_event(number, line) for number, line in enumerate(lines, start=1)]
    return events + [PartialLine("events.jsonl: the last line is cut off")] * bool(rest)


def _event(number: int, line: bytes) -> Event | ValueError:
    try:
        event = json.loads(line.decode())
    except (ValueError, RecursionError):
        event = None
    named = isinstance(event, dict) and "event" in event
    if named and (event["event"] not in HEAVY or type(event.get("iteration")) is int):
        return dict(event)
    return ValueError(f"events.jsonl, line {number}: expected an event, got {line.decode(errors='replace')[:60]!r}")


def read_summary(directory: Path | str) -> dict[str, Any]:
    """`summary.json` of a run; `ValueError` if it is missing, truncated or foreign."""
    file = Path(directory) / "summary.json"
    summary = _read_json(file, f"{file}: expected the summary of a run")
    if not isinstance(summary, dict) or not {"seed", "finished", "iterations"} <= set(summary):
        raise ValueError(f"{file}: expected the summary of a run, got {str(summary)[:60]}")
    return summary


def command_to_continue(command: str, settings: Settings, path: Path, answerers: Sequence[str] = ()) -> str:
    """`bayespbrl resume` or `ask` for a run, as a line for a shell, with the names of the people who answer."""
    options = [*(f"--answerer={name}" for name in answerers), *["--import-package"] * (":" in settings.env)]
    return shlex.join(["bayespbrl", command, str(path), *options])


def _check_own(path: Path) -> None:
    """`ValueError` where what is written to leads elsewhere, as it may in a stranger's run."""
    log, folder = path / "events.jsonl", path / "iterations"
    if log.is_symlink() or (log.exists() and not log.is_file()):
        raise ValueError(f"{log}: expected a file of the run's own, got a link or something that is no file")
    check_folder(folder)


def _read_json(file: Path, expected: str) -> Any:
    try:
        check_file(file)
        return json.loads(file.read_text())
    except RecursionError as error:
        raise ValueError(f"{expected}, got brackets nested too deeply") from error
    except (OSError, ValueError) as error:
        raise ValueError(f"{expected}, got {error}") from error


def _umask() -> int:
    """The permissions that the user's new files do not get; it can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
