"""Number of threads of the linear algebra."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from threading import Lock

from threadpoolctl import ThreadpoolController


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
