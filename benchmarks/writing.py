"""How long it takes to write an answer into a run that has many already.

    python benchmarks/writing.py [--answers 20000] [--repeat 50] [--out DIR]

A run of the Gridworld gets so many answers written into its log, and is resumed. Then questions are asked and answered.
Prints one JSON line: milliseconds from an answer until it is on the disk and in the learner's state (median and worst),
those of a write and `fsync` of a line alone, seconds of the resume, and the size of the log.
"""

import argparse
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import bayespbrl
from bayespbrl import events
from bayespbrl.events import Entry
from bayespbrl.preferences import Answer

PERSON = {"answerer": "Ada", "seconds": 2.5, "session": "20260101T000000Z-0000", "replays": 1}


def asked(number: int, newcomer: int) -> dict[str, Any]:
    """The event of a question about a newcomer and trajectory 0."""
    return {"event": "asked", "query": number, "first": newcomer, "second": 0, "newcomer": newcomer, "rivals": [0]}


def answered(number: int) -> dict[str, Any]:
    """The event of an answer that leaves trajectory 0 the best."""
    return dict(events.answered(number, Answer.SECOND, **PERSON).event)  # type: ignore[arg-type]


def filled(directory: Path, answers: int) -> None:
    """A run with so many answers, about the trajectories of its first iteration."""
    learner = bayespbrl.start("gridworld", directory, expert="other", max_steps=20, evaluation_episodes=1)
    entry = learner.cycle.next(learner.state)
    assert entry is not None
    learner.record(entry)
    several = len(learner.trajectories) - 1
    lines = [json.dumps(each) for k in range(1, answers + 1) for each in (asked(k, 1 + k % several), answered(k))]
    with (directory / "events.jsonl").open("a") as log:
        log.write("\n".join(lines) + "\n")


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--answers", type=int, default=20_000)
    parser.add_argument("--repeat", type=int, default=50)
    parser.add_argument("--out", type=Path, help="folder on the disk to write to; a temporary one if omitted")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=chosen.out) as folder:
        directory = Path(folder) / "run"
        filled(directory, chosen.answers)
        began = time.perf_counter()
        learner = bayespbrl.resume(directory)
        resumed = time.perf_counter() - began
        assert learner.preferences.answers == chosen.answers
        seconds, plain = [], []
        for number in range(chosen.answers + 1, chosen.answers + 1 + chosen.repeat):
            learner.record(Entry(asked(number, 1)))
            began = time.perf_counter()
            learner.record(Entry(answered(number)))
            seconds.append(time.perf_counter() - began)
            with (directory / "plain").open("ab", buffering=0) as file:
                began = time.perf_counter()
                file.write(json.dumps(answered(number)).encode() + b"\n")
                os.fsync(file.fileno())
                plain.append(time.perf_counter() - began)
        size = (directory / "events.jsonl").stat().st_size
    figures: dict[str, object] = {"answers": chosen.answers, "load": round(os.getloadavg()[0], 1)}
    for name, values in (("answer", seconds), ("line", plain)):
        figures |= {f"{name} ms": round(1000 * float(np.median(values)), 2), f"{name} worst": 1000 * max(values)}
    print(json.dumps(figures | {"resumed s": round(resumed, 1), "log MB": round(size / 1e6, 1)}))


if __name__ == "__main__":
    main()
