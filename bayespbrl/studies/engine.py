"""The engine of all studies: rows of trials through any `concurrent.futures.Executor`, until each is done or given up.

A trial whose process dies continues from its run directory. A trial that raises is given up at once, since it would
raise again. Neither ends the others. One that another command on the same directory runs is looked at again once
nothing else is left to do.
"""

import errno
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from dataclasses import dataclass, field

from bayespbrl.runs.lock import ContinuedElsewhere
from bayespbrl.studies.rows import Row, Seeds, run_trial

MOST_DEATHS = 3  # of a trial's process
POLL = 0.5  # seconds between looks at which trials have started
ELSEWHERE = 5.0  # seconds between looks at trials that another command runs
LOST = "the connection to the scheduler is lost"
NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@dataclass(frozen=True)
class Failure:
    """A trial that is not finished, and why."""

    row: Row
    seed: int
    reason: str

    def __str__(self) -> str:
        return f"{self.row.name} seed {self.seed}: {self.reason}".strip()


@dataclass
class Progress:
    """The progress of a study: numbers of trials, and seconds since it was begun or continued.

    Attributes:
      total: trials of the study, those to come in place of redrawn ones among them.
      before: finished before this call.
      done: finished, `before` among them; redrawn trials do not count.
      running: trials that run now; None on a Dask cluster, whose futures do not tell.
      elsewhere, failed: trials that another command runs, or that were given up.
      seconds: since the call.
      latest: the trial that was finished last: its row and seed.
    """

    total: int
    before: int = 0
    done: int = 0
    running: int | None = 0
    elsewhere: int = 0
    failed: int = 0
    seconds: float = 0.0
    latest: tuple[Row, int] | None = None

    @property
    def seconds_left(self) -> float | None:
        """By the pace of this call so far; None before a trial of it has finished."""
        finished = self.done - self.before
        return None if not finished else self.seconds / finished * (self.total - self.done - self.failed)


@dataclass
class Engine:
    """Runs the trials of `rows`; each `Seeds` holds the outcomes.

    Attributes:
      rows: what to run.
      executor: where.
      progress: called when a trial starts, ends or fails.
      failures: trials given up.
    """

    rows: Sequence[Seeds]
    executor: Executor
    progress: Callable[[Progress], None] | None = None
    failures: list[Failure] = field(default_factory=list)

    def run(self) -> list[Failure]:
        """All trials, and those that replace redrawn ones; returns the failures."""
        self._began = time.monotonic()
        self._state = Progress(sum(row.trials for row in self.rows))
        self._submitted: set[tuple[int, int]] = set()
        self._deaths: Counter[tuple[int, int]] = Counter()
        self._running: dict[Future[bool], tuple[int, int]] = {}
        self._elsewhere: set[tuple[int, int]] = set()
        self._submit_all()
        self._state.before = self._done()
        for place, row in enumerate(self.rows):
            for seed in row.with_outcome(True):
                self._report(place, seed)
        while self._running:
            finished = wait(self._running, timeout=POLL, return_when=FIRST_COMPLETED).done
            for future in finished:
                self._finish(future, *self._running.pop(future))
            if not finished and _lost(self.executor):
                self._give_up()
                break
            self._submit_all()
            self._report()
            if not self._running and self._elsewhere:
                time.sleep(ELSEWHERE)
                for each in sorted(self._elsewhere):
                    self._submit(*each)
                self._elsewhere.clear()
        return self.failures

    def _submit_all(self) -> None:
        """The first trial of each row, then the second of each: a study that is stopped has something of every row."""
        new = [
            (seed - row.row.settings.seed, place, seed) for place, row in enumerate(self.rows) for seed in row.to_do()
        ]
        given_up = [Failure(row.row, row.row.settings.seed, row.exhausted) for row in self.rows if row.exhausted]
        given_up += [Failure(row.row, *damage) for row in self.rows for damage in row.damaged.items()]
        self.failures += [failure for failure in given_up if failure not in self.failures]
        for _, place, seed in sorted(new):
            if (place, seed) not in self._submitted:
                self._submit(place, seed)

    def _submit(self, place: int, seed: int) -> None:
        self._submitted.add((place, seed))
        try:
            self._running[self.executor.submit(run_trial, self.rows[place].row, seed)] = (place, seed)
        except Exception as error:
            lost = _lost(self.executor)
            if not (lost or isinstance(error, BrokenExecutor | RuntimeError)):
                raise
            reason = LOST if lost else f"{type(error).__name__}: {error}"  # it takes nothing more
            self.failures.append(Failure(self.rows[place].row, seed, reason))

    def _finish(self, future: Future[bool], place: int, seed: int) -> None:
        row = self.rows[place]
        try:
            row.outcomes[seed] = future.result()
        except ContinuedElsewhere:
            self._elsewhere.add((place, seed))
            return
        except (Exception, CancelledError) as error:
            reason = str(error)
            if _died(error):
                self._deaths[place, seed] += 1
                if self._deaths[place, seed] < MOST_DEATHS:
                    self._submit(place, seed)
                    return
                reason = f"died {MOST_DEATHS} times: {error}"
            self.failures.append(Failure(row.row, seed, reason))
            if getattr(error, "errno", None) in NO_SPACE:
                raise ValueError(f"the disk is full: {error}") from error
            return
        if row.outcomes[seed]:
            self._report(place, seed)

    def _give_up(self) -> None:
        """All trials whose end nobody will tell; they may be continued."""
        lost = [*self._running.values(), *sorted(self._elsewhere)]
        self.failures += [Failure(self.rows[place].row, seed, LOST) for place, seed in lost]
        self._running.clear()

    def _done(self) -> int:
        return sum(len(row.with_outcome(True)) for row in self.rows)

    def _report(self, place: int | None = None, seed: int = 0) -> None:
        if self.progress is None:
            return
        state = self._state
        state.done, state.failed = self._done(), len(self.failures)
        state.running = None if _cluster(self.executor) else sum(future.running() for future in self._running)
        state.elsewhere = len(self._elsewhere)
        state.seconds = time.monotonic() - self._began
        state.latest = None if place is None else (self.rows[place].row, seed)
        self.progress(state)


def _cluster(executor: Executor) -> object | None:
    """Dask's client, which need not be installed; None for another executor."""
    return getattr(executor, "_client", None)


def _lost(executor: Executor) -> bool:
    """Whether Dask's client has given its scheduler up: then its futures are cancelled, or stay pending for ever."""
    return getattr(_cluster(executor), "status", None) in ("closing", "closed")


def _died(error: BaseException) -> bool:
    """Whether a trial's process died before its trial ended; the trial may be started again."""
    # of Dask's, which need not be installed
    names = {kind.__name__ for kind in type(error).__mro__}
    return isinstance(error, BrokenExecutor | CancelledError | MemoryError) or bool(
        names & {"KilledWorker", "CommClosedError"}
    )
