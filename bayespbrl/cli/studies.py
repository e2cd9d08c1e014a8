"""What the command line shows of a declared study: its plan, its progress, its failures."""

import shlex
from concurrent.futures import Executor

from bayespbrl.cli.display import console, progress_bar
from bayespbrl.studies import Study
from bayespbrl.studies.engine import Failure, Progress

MOST_FAILURES = 10  # that are shown one by one


def show_plan(study: Study, jobs: int) -> None:
    """Print how many cells a study has, how many are finished, and about how long the others take."""
    rows, left = len(study.rows), study.minutes_left()
    line = f"{study.declaration.title}: {rows} rows of {study.trials} trials, {study.cells} cells, "
    if left is None:
        about = "how long is known when a trial of each row is finished"
    elif jobs == 1:
        about = f"about {_time(60 * left)} on one core"
    else:
        about = f"about {_time(60 * left / jobs)} on {jobs} cores"
    console.print(f"{line}{study.finished} of them finished; {about}.")


def run_study(study: Study, where: int | Executor, command: str) -> list[Failure]:
    """Run a study with a bar: trials done, running, failed, and the time left; returns the failures."""
    console.print(f"Directory: {study.directory}")
    with progress_bar() as bar:
        task = bar.add_task("trials", total=study.cells, completed=study.finished, state="")

        def show(now: Progress) -> None:
            left = "" if now.seconds_left is None else f", about {_time(now.seconds_left)} left"
            elsewhere = f"{now.elsewhere} run by another command, " if now.elsewhere else ""
            running = "" if now.running is None else f"{now.running} running, "
            state = f"{running}{elsewhere}{now.failed} failed{left}"
            bar.update(task, completed=now.done, state=state)

        try:
            failures = study.run(where, command=command, progress=show)
        except KeyboardInterrupt:
            there = " Workers finish the trials that they have begun." if isinstance(where, Executor) else ""
            console.print(f"Stopped. Nothing is lost: repeat the command to continue.{there}")
            raise
    for failure in failures[:MOST_FAILURES]:
        console.print(f"Failed: {failure}")
    permission = ["--import-package"] * any(":" in row.env for row in study.declaration.rows)
    results = shlex.join(["bayespbrl", "results", str(study.directory), *permission])
    console.print(f"Table: {study.directory / 'iterations.csv'}; {results}")
    return failures


def _time(seconds: float) -> str:
    """Seconds in the unit that reads best."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
