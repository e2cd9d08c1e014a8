"""A Dask cluster as the executor of a study: `scheduler_executor`, for `bayespbrl study --scheduler`.

The workers have to see the study's directory under the same path, and to have the same version installed.
"""

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

WAIT = 15  # seconds for the scheduler


@contextmanager
def scheduler_executor(address: str) -> Iterator[Executor]:
    """The workers of the scheduler at `address`, such as `tcp://127.0.0.1:8786`, as one executor.

    Raises:
      ValueError: `distributed` is not installed; no scheduler answers there.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise ValueError(f"scheduler: expected the extra cluster (pip install '.[cluster]'), got {error}") from error
    try:
        client = Client(address, timeout=WAIT, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"scheduler: expected an answer from {address!r} within {WAIT} s, got {error}") from error
    try:
        # not pure: a trial that is started again is another task; a worker that dies makes the scheduler try anew
        yield client.get_executor(pure=False)
    finally:
        client.close()
