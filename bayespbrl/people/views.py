"""What a view says of a turn, as plain data for the page and the widget."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayespbrl import queries, questions
from bayespbrl.envs.opening import environment_name
from bayespbrl.events import LearnerState
from bayespbrl.learner import Learner
from bayespbrl.models.likelihoods import prob
from bayespbrl.people.clips import Clip
from bayespbrl.preferences import Answer, Query

View = Mapping[str, Any]
INSTRUCTIONS, THINKING, QUESTION, FINISHED, FAILED = "instructions", "thinking", "question", "finished", "failed"
WAITING = "waiting"  # the questions that are left lie with others
# An answer that is expected to tell less changes little: then the page says that a person may stop.
LITTLE = questions.LEAST_INFORMATION / np.log(2)  # bits
BREAK = 20  # answers of a sitting between two reminders that a person may pause


@dataclass(frozen=True)
class Shown:
    """What a person is shown of a question: the clips, and what the learner says about it, as plain data."""

    clips: tuple[Clip, Clip]
    said: View


NOTHING_LEFT = "Others are answering the last questions. Wait, in case one of them leaves, or close this page."
NOTHING_SAID: View = {"worth": None, "sure": None, "advice": ""}


def described(learner: Learner, state: LearnerState, phase: str, *, turn: int, answerer: str | None) -> dict[str, Any]:
    """A view of a phase without a question: the run, and who answers."""
    return {
        "phase": phase,
        "turn": turn,
        "task": re.sub(r"^bayespbrl/|-v\d+$", "", environment_name(learner.environment)),
        "answered": state.preferences.answers,
        "budget": learner.settings.questions.answers,
        "iteration": state.iteration,
        "undo": state.previous is not None and state.past[-1].answerer == answerer,
        "answerer": answerer,
        "practice": None,
        "notice": "",
        "say": "",
    }


def with_question(view: View, shown: Shown, rate: float) -> View:
    """The view with a question, whose clips play at `rate` steps a second."""
    return {**view, "clips": [clip.described() for clip in shown.clips], "rate": rate, **shown.said}


def said_of(query: Query, state: LearnerState) -> tuple[View, tuple[Answer, ...]]:
    """What the learner says about a question, and the answers to it, the likeliest first and a tie last."""
    said, first = dict(NOTHING_SAID), 0.5
    if state.estimate is not None and state.estimate.posterior is not None:
        draws = state.estimate.trajectory_draws(query.trajectories, number=queries.QUERY_DRAWS)
        likelihood = state.estimate.likelihood(queries.QUERY_DRAWS)
        first = float(prob(likelihood, draws[:, :1] - draws[:, 1:]).mean())
        worth = queries.expected_information(draws[:, :1], draws[:, 1:], likelihood=likelihood)
        said |= {"sure": max(first, 1 - first), "worth": float(worth[0] / np.log(2))}
        if said["worth"] < LITTLE:
            said["advice"] = (
                f"That is less than {LITTLE:.2f} bit: further answers change little, and you can stop here."
            )
    likely = (Answer.FIRST, Answer.SECOND) if first >= 0.5 else (Answer.SECOND, Answer.FIRST)
    return said, (*likely, Answer.SKIP, Answer.TIE)  # after a skip there is little to compute


def notice(given: int, *, practised: bool) -> str:
    """A quiet line beside a question, after so many answers of a sitting."""
    if given > 0 and given % BREAK == 0:
        return f"You have given {given} answers. Pause when you like; nothing is lost."
    return "The practice is over. From now on your answers are kept." if practised and not given else ""


def ending(learner: Learner, state: LearnerState, given: int) -> str:
    """Why there is no further question, after so many answers of a sitting."""
    answers, budget = state.preferences.answers, learner.settings.questions.answers
    if not state.finished(learner.settings):
        return f"These were the {given} answers of this sitting. Thank you! The run can go on later."
    if budget is not None and answers >= budget:
        return f"All {answers} answers are given, and the policy has caught up with them. Thank you!"
    if state.iteration >= learner.settings.most_iterations:
        return f"The run has done its {state.iteration} iterations, with {answers} answers. Thank you!"
    return (
        f"The learner can foresee your answers: none was worth {LITTLE:.2f} bit in the last {state.unasked} "
        f"iterations. It stops after {answers} answers. Thank you!"
    )
