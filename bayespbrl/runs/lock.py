"""A lock on a run: one process continues it at a time."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows, where the log's own check has to do
    fcntl = None  # type: ignore[assignment]


class ContinuedElsewhere(ValueError):
    """A run that another process continues."""


@contextmanager
def continuing(directory: Path | str) -> Iterator[None]:
    """Lock a run directory. The system releases the lock when the process ends, for whatever reason.

    Raises:
      ContinuedElsewhere: another process continues the run.
      ValueError: the directory is no run.
    """
    try:
        held = os.open(Path(directory) / "settings.json", os.O_RDWR)  # NFS locks only what may be written
    except OSError as error:
        raise ValueError(f"{directory}: expected a run directory with its settings.json, got {error}") from error
    try:
        if fcntl is not None:
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise ContinuedElsewhere(
                    f"{directory}: expected a run that no other program continues, got one that does; stop it first"
                ) from error
            except OSError:  # a file system without locks, where the log's own check has to do
                pass
        yield
    finally:
        os.close(held)
