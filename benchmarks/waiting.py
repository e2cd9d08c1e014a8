"""How long a person waits between an answer and the next question.

    python benchmarks/waiting.py swing-up [--answers 20] [--looks 8] [--seed 0] [--cpu]

The simulated expert answers through a session as the page does it, each question after looking for so many seconds.
Prints one JSON line: seconds until the next question was there, for each answer that had one, their median and their
maximum, how many took less than a second, and the load average. With `--cpu` all seconds are CPU seconds of this
process, so that other programs hardly matter.
"""

import argparse
import json
import os
import time
from collections.abc import Callable

import numpy as np

import bayespbrl
from bayespbrl.people.session import Session
from bayespbrl.people.views import QUESTION
from bayespbrl.preferences import Answer


def waits(session: Session, *, looks: float, clock: Callable[[], float]) -> tuple[list[float], int]:
    """Seconds of each wait by `clock`, and how many were shorter than a second."""
    expert, seconds, short = bayespbrl.ReturnExpert(), [], 0
    while (view := session.wait())["phase"] == QUESTION:
        begin = clock()
        while clock() - begin < looks and not (clock is time.process_time and session.idle):
            time.sleep(0.02)
        query = session.learner.state.query
        assert query is not None
        begin = clock()
        session.answer(view["turn"], str(Answer(expert(*query.trajectories))), looks)
        while session.view["turn"] == view["turn"] or session.view["phase"] == "thinking":
            time.sleep(0.005)
        if session.view["phase"] == QUESTION:
            seconds.append(clock() - begin)
            short += seconds[-1] < 1.0
    return seconds, short


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env")
    parser.add_argument("--answers", type=int, default=20)
    parser.add_argument("--looks", type=float, default=8.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cpu", action="store_true")
    chosen = parser.parse_args()
    if chosen.answers < 2:
        parser.error(f"--answers: expected at least 2, as no question follows the last, got {chosen.answers}")
    learner = bayespbrl.Learner(chosen.env, answers=chosen.answers, seed=chosen.seed, expert="other")
    session = Session(learner).open()
    try:
        clock = time.process_time if chosen.cpu else time.perf_counter
        seconds, short = waits(session, looks=chosen.looks, clock=clock)
    finally:
        session.close()
    figures: dict[str, object] = {"cpu": chosen.cpu, "load": round(os.getloadavg()[0], 1)}
    figures |= {"median": float(np.median(seconds)), "worst": max(seconds), "below_a_second": short}
    print(json.dumps({"env": chosen.env, "looks": chosen.looks, **figures, "seconds": np.round(seconds, 2).tolist()}))


if __name__ == "__main__":
    main()
