"""Threads of the linear algebra."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from threadpoolctl import ThreadpoolController


@cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """A context, or a decorator, in which BLAS uses one thread.

    NumPy and SciPy bring a BLAS each, whose idle threads spin. Beside another busy program a run would take five times
    as long, and from K = 80 on the Gaussian fit ten times. Sums are then rounded alike on any number of cores.
    """
    with _blas().limit(limits=1, user_api="blas"):
        yield
