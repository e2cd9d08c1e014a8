"""Files that are on the disk whole or not at all: written aside, flushed, renamed into place."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def written_aside(file: Path) -> Iterator[Path]:
    """A path beside `file` to write to; it becomes `file` when the block ends.

    Where the block raises, `file` is as it was and nothing is left beside it.
    """
    aside = file.with_name(file.name + ".part")
    try:
        aside.unlink(missing_ok=True)  # HDF5 refuses a file that a killed process left open
        yield aside
        with aside.open("r+b") as written:
            os.fsync(written.fileno())
        aside.replace(file)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise


def write_file(file: Path, content: str | bytes) -> None:
    """Write text, as UTF-8, or bytes to `file`, whole or not at all."""
    with written_aside(file) as aside:
        aside.write_bytes(content.encode() if isinstance(content, str) else content)
