"""Files that are on the disk whole or not at all: written aside, flushed, renamed into place."""

import io
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import xarray as xr

_ONE_AT_A_TIME = threading.Lock()  # the setting of Dask below is the whole process's


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
    except BaseException as error:
        aside.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is not None and error.filename is None:  # a full disk
            raise OSError(error.errno, error.strerror, str(file)) from error
        raise


def write_netcdf(file: Path, data: xr.Dataset | xr.DataTree) -> None:
    """Write a netCDF file, whole or not at all.

    HDF5 ends the process where the disk is full while it writes to it; the bytes are therefore made in memory. In a
    Dask worker xarray would lock them by a lock of the cluster, which needs a file name and fails without one.
    """
    content = io.BytesIO()
    dask = sys.modules.get("dask")  # imported wherever this may be a Dask worker
    with _ONE_AT_A_TIME, nullcontext() if dask is None else dask.config.set(scheduler="threads"):
        data.to_netcdf(content, engine="h5netcdf")
    write_file(file, content.getvalue())


def write_file(file: Path, content: str | bytes) -> None:
    """Write text, as UTF-8, or bytes to `file`, whole or not at all."""
    with written_aside(file) as aside:
        aside.write_bytes(content.encode() if isinstance(content, str) else content)
