"""Atomic files: written aside, flushed, renamed into place."""

import os
import re
import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import netCDF4
import xarray as xr
from xarray.backends import NetCDF4DataStore

NETCDF = threading.Lock()  # to hold while a netCDF file is read or written: the library serves one thread at a time


ASIDE = re.compile(r".\.\d+-[0-9a-f]{8}\.part$")  # what is written, beside the file that it will be
STALE = 3600.0  # seconds without a change after which a file aside is what a killed process left


@contextmanager
def written_aside(file: Path) -> Iterator[Path]:
    """A path beside `file` to write to; it becomes `file` when the block ends.

    Where the block raises, `file` is as it was and nothing is left beside it. Of several writers the last to end wins.
    """
    aside = file.with_name(f"{file.name}.{os.getpid()}-{secrets.token_hex(4)}.part")
    _drop_stale(file.parent)
    try:
        yield aside
        with aside.open("r+b") as written:
            os.fsync(written.fileno())
        aside.replace(file)
        synchronise(file.parent)
    except BaseException as error:
        aside.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is not None and error.filename is None:  # a full disk
            raise OSError(error.errno, error.strerror, str(file)) from error
        raise


def synchronise(directory: Path) -> None:
    """Flush a directory, so that a file in it has its name after a power failure; not every system can."""
    with suppress(OSError):
        opened = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


def check_file(file: Path) -> None:
    """`ValueError` for what is no file, as a pipe, which would be read for ever; a stranger's run may have one."""
    if file.exists() and not file.is_file():
        raise ValueError("something that is no file")


def check_folder(folder: Path) -> None:
    """`ValueError` for a link or what is no folder, where files are written; a stranger's run may have one."""
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise ValueError(f"{folder}: expected a folder of the run's own, got a link or something that is no folder")


def _drop_stale(directory: Path) -> None:
    """Delete what killed processes left in a directory, where that is possible."""
    with suppress(OSError):
        for entry in os.scandir(directory):
            with suppress(OSError):  # another process deletes it too
                if ASIDE.search(entry.name) and time.time() - entry.stat().st_mtime > STALE:
                    os.unlink(entry.path)


def write_netcdf(file: Path, data: xr.Dataset | xr.DataTree) -> None:
    """Write a netCDF file, whole or not at all.

    HDF5 ends the process where the disk is full while it writes to it; the bytes are therefore made in memory.
    """
    tree = data if isinstance(data, xr.DataTree) else xr.DataTree(data)
    with NETCDF:
        opened = netCDF4.Dataset(file.name, "w", memory=0)
        try:
            for node in tree.subtree:
                group = opened if node is tree else opened.createGroup(node.path)
                node.to_dataset(inherit=False).dump_to_store(NetCDF4DataStore(group))
        finally:
            content = opened.close()
    write_file(file, content[: _end_of(content)])


def _end_of(content: memoryview) -> int:
    """Where an HDF5 file ends in a buffer with room to spare.

    That is the end of the buffer where the superblock is of an unknown kind: bytes after its end do a file no harm.
    """
    if content[8] not in (2, 3) or content[9] != 8:  # version, and bytes of an address (HDF5 file format)
        return len(content)
    return int.from_bytes(content[28:36], "little")


def write_file(file: Path, content: str | bytes | memoryview) -> None:
    """Write text, as UTF-8, or bytes to `file`, whole or not at all."""
    with written_aside(file) as aside:
        aside.write_bytes(content.encode() if isinstance(content, str) else content)
