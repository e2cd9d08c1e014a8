"""Threads: one for the linear algebra, and several for independent parts of a computation."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import cache
from threading import Lock
from typing import TypeVar

from threadpoolctl import ThreadpoolController

Part = TypeVar("Part")
Result = TypeVar("Result")
VARIABLE = "OMP_NUM_THREADS"  # the processes of a study set it to 1


class _Limit:
    """Limits BLAS to one thread, a setting of the whole process, while any caller asks for it."""

    def __init__(self) -> None:
        self.controller, self.lock = ThreadpoolController(), Lock()
        self.users, self.limited = 0, ExitStack()

    def enter(self) -> None:
        with self.lock:
            self.users += 1
            if self.users == 1:
                self.limited.enter_context(self.controller.limit(limits=1, user_api="blas"))

    def leave(self) -> None:
        with self.lock:
            self.users -= 1
            if not self.users:
                self.limited.close()


@cache
def _limit() -> _Limit:
    return _Limit()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """A context, or a decorator, in which BLAS uses one thread; in several threads at once, until the last leaves it.

    NumPy and SciPy bring a BLAS each, whose idle threads spin. Beside another busy program a run would take five times
    as long, and from K = 80 on the Gaussian fit ten times. Sums are then rounded alike on any number of cores.
    """
    limit = _limit()
    limit.enter()
    try:
        yield
    finally:
        limit.leave()


def cores() -> int:
    """The number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def most_threads() -> int:
    """The number of threads of a computation: one for each core that this process may use, or fewer if so set."""
    given = os.environ.get(VARIABLE, "")
    return min(cores(), int(given)) if given.isdecimal() and int(given) else cores()


def in_threads(function: Callable[[Part], Result], parts: Iterable[Part]) -> list[Result]:
    """`function` of each part, in their order; the same on any number of cores. An error of one part is raised."""
    parts = list(parts)
    threads = min(most_threads(), len(parts))
    if threads <= 1:
        return [function(part) for part in parts]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(function, parts))
