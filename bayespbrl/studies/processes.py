"""Processes for the trials of a study: each runs one trial at a time, dies alone, and ends when the study ends."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any

from bayespbrl.runs.lock import ContinuedElsewhere

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
SENT = (ValueError, MemoryError, ContinuedElsewhere)  # as they are
_SPAWN = multiprocessing.get_context("spawn")


class TrialProcesses(Executor):
    """An executor of `jobs` spawned processes. One that dies fails its own call with `BrokenExecutor`, and no other.

    Decision: the next call of its slot gets a new process; otherwise a process is kept from call to call. To compile
    JAX's functions anew takes 16 s a trial, 8 s with JAX's cache on disk, of about a minute that a short trial takes.
    """

    def __init__(self, jobs: int):
        self._slots = threading.local()
        self._lock = threading.Lock()
        self._processes: set[_Process] = set()
        self._ended = False
        self._threads = ThreadPoolExecutor(jobs)

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        """Call `function`, which has to be importable, in one of the processes."""
        return self._threads.submit(self._call, function, arguments, named)

    def _call(self, function: Callable[..., Any], arguments: tuple[Any, ...], named: dict[str, Any]) -> Any:
        process: _Process | None = getattr(self._slots, "process", None)
        if process is None:
            with self._lock:
                if self._ended:
                    raise BrokenExecutor("the study has ended")
                process = self._slots.process = _Process()
                self._processes.add(process)
        try:
            result, error = process.call(function, arguments, named)
        except (EOFError, OSError) as gone:
            self._slots.process = None
            with self._lock:
                self._processes.discard(process)
            raise BrokenExecutor(f"its process ended ({process.end()})") from gone
        if error is not None:
            raise error
        return result

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes: after their calls, or at once without `wait`."""
        if wait:
            self._threads.shutdown(wait=True, cancel_futures=cancel_futures)
        with self._lock:
            self._ended = True
            processes = list(self._processes)
        for process in processes:
            process.terminate()
        self._threads.shutdown(wait=False, cancel_futures=cancel_futures)


class _Process:
    """A spawned process that answers calls over a pipe."""

    def __init__(self) -> None:
        self._ours, theirs = _SPAWN.Pipe()
        self._process = _SPAWN.Process(target=_serve, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()  # so that the pipe ends when the process does

    def call(self, *call: Any) -> tuple[Any, Exception | None]:
        """The result of a call, or the exception that it raised; `EOFError` or `OSError` where the process dies."""
        self._ours.send(call)
        outcome: tuple[Any, Exception | None] = self._ours.recv()
        return outcome

    def end(self) -> str:
        """How it ended, in words."""
        self._process.join(timeout=10)
        code = self._process.exitcode
        return f"signal {-code}" if code is not None and code < 0 else f"exit status {code}"

    def terminate(self) -> None:
        self._process.terminate()


def _serve(calls: Connection) -> None:
    _end_with_parent()
    while True:
        try:
            function, arguments, named = calls.recv()
        except EOFError:
            return
        try:
            outcome: tuple[Any, Exception | None] = (function(*arguments, **named), None)
        except (ValueError, OSError, MemoryError) as error:
            outcome = None, type(error)(str(error)) if type(error) in SENT else _plain(error)
        except Exception as error:  # not every exception can be sent
            outcome = None, RuntimeError(f"{type(error).__name__}: {error}")
        calls.send(outcome)


def _plain(error: Exception) -> Exception:
    """An error of a subclass, as what can be sent."""
    if isinstance(error, MemoryError):  # NumPy's
        return MemoryError(str(error))
    if not isinstance(error, OSError):
        return ValueError(str(error))
    return OSError(*error.args) if error.filename is None else OSError(*error.args[:2], error.filename)


@contextmanager
def trial_processes(jobs: int) -> Iterator[Executor]:
    """`TrialProcesses`, each with a single thread, so that sums are rounded alike however many there are.

    Where the block raises, the processes are terminated at once: a trial continues from disk when it is called again.
    """
    with _environment(ONE_THREAD):
        pool = TrialProcesses(jobs)
        try:
            yield pool
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        pool.shutdown()


def _end_with_parent() -> None:
    """End this process when its parent ends, even if that is killed, so that no trial writes on alone.

    An interrupt from the keyboard reaches all processes and is left to the parent.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def wait_for_it() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait_for_it, daemon=True).start()


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    """Environment variables that child processes inherit, restored afterwards."""
    before = {name: os.environ[name] for name in variables if name in os.environ}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name in variables:
            os.environ.pop(name, None)
        os.environ.update(before)
