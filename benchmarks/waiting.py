"""How long a person waits between an answer and the next question.

    python benchmarks/waiting.py swing-up [--answers 20] [--looks 8] [--seed 0]

The simulated expert answers through a session as the page does it, each question after looking for so many seconds.
Prints one JSON line: seconds until the next question was there, for each answer that had one, their median and their
maximum, and how many took less than a second.
"""

import argparse
import json
import time

import numpy as np

import bayespbrl
from bayespbrl.people.session import QUESTION, Session
from bayespbrl.preferences import Answer


def waits(session: Session, *, looks: float) -> tuple[list[float], int]:
    """Seconds of each wait, and how many were shorter than a second."""
    expert, seconds, short = bayespbrl.ReturnExpert(), [], 0
    while (view := session.wait())["phase"] == QUESTION:
        time.sleep(looks)
        query = session.learner.state.query
        assert query is not None
        begin = time.perf_counter()
        session.answer(view["turn"], str(Answer(expert(*query.trajectories))), looks)
        while session.view["turn"] == view["turn"] or session.view["phase"] == "thinking":
            time.sleep(0.005)
        if session.view["phase"] == QUESTION:
            seconds.append(time.perf_counter() - begin)
            short += seconds[-1] < 1.0
    return seconds, short


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env")
    parser.add_argument("--answers", type=int, default=20)
    parser.add_argument("--looks", type=float, default=8.0)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    learner = bayespbrl.Learner(chosen.env, answers=chosen.answers, seed=chosen.seed, expert="other")
    session = Session(learner).open()
    try:
        seconds, short = waits(session, looks=chosen.looks)
    finally:
        session.close()
    figures = {"median": float(np.median(seconds)), "worst": max(seconds), "below_a_second": short}
    print(json.dumps({"env": chosen.env, "looks": chosen.looks, **figures, "seconds": np.round(seconds, 2).tolist()}))


if __name__ == "__main__":
    main()
