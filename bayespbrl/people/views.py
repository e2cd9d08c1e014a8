"""The contents of a view, as plain data for the page and the widget."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from bayespbrl import queries, questions
from bayespbrl.envs.opening import environment_name
from bayespbrl.events import LearnerState
from bayespbrl.learner import Learner
from bayespbrl.models.likelihoods import Likelihood, prob, with_threshold
from bayespbrl.people.clips import Clip
from bayespbrl.preferences import Answer, Query
from bayespbrl.settings import MOST_UNASKED

View = Mapping[str, Any]
INSTRUCTIONS, THINKING, QUESTION, FINISHED, FAILED = "instructions", "thinking", "question", "finished", "failed"
WAITING = "waiting"  # the questions that are left lie with others
# An answer that is expected to tell less changes little: then the page says so.
LITTLE = questions.LEAST_INFORMATION / np.log(2)  # bits
BREAK = 20  # answers of a sitting between two reminders that a person may pause


@dataclass(frozen=True)
class Shown:
    """What a person is shown of a question: the clips, and what the learner says about it, as plain data."""

    clips: tuple[Clip, Clip]
    said: View


NOTHING_LEFT = "Others are answering the last questions. Wait, in case one of them leaves, or close this page."
ALL_GIVEN = "All answers are given, thank you! You need not wait while the learner finishes."
# The answers, the likeliest first, where nothing is known. After a skip there is little to compute.
UNKNOWN: tuple[Answer, ...] = (Answer.FIRST, Answer.SECOND, Answer.SKIP, Answer.TIE)
NOTHING_SAID: View = {"worth": None, "sure": None, "advice": ""}


def described(learner: Learner, state: LearnerState, phase: str, *, turn: int, answerer: str | None) -> dict[str, Any]:
    """A view of a phase without a question: the run, and who answers."""
    given_all = state.left(learner.settings) <= 0
    return {
        "phase": phase,
        "turn": turn,
        "task": re.sub(r"^bayespbrl/|-v\d+$", "", environment_name(learner.environment)),
        "answered": state.preferences.answers,
        "budget": learner.settings.questions.answers,
        "iteration": state.iteration,
        "undo": state.may_undo(answerer),
        "answerer": answerer,
        "all_given": given_all,
        "practice": None,
        "notice": "",
        "say": ALL_GIVEN if given_all and phase == THINKING else "",
    }


def with_question(view: View, shown: Shown, rate: float) -> View:
    """The view with a question, whose clips play at `rate` steps a second."""
    return {**view, "clips": [clip.described() for clip in shown.clips], "rate": rate, **shown.said}


def said_of(query: Query, state: LearnerState, answerer: str | None = None) -> tuple[View, tuple[Answer, ...]]:
    """What the learner says about a question, and the answers to it, the likeliest first.

    How sure it is of an answer counts the lapses and the side bias of who answers. What the answer is worth is what it
    tells of the utility alone, as when questions are chosen. A tie comes last while the run has none.
    """
    said, likely = dict(NOTHING_SAID), UNKNOWN
    if state.estimate is not None and state.estimate.posterior is not None:
        draws = state.estimate.trajectory_draws(query.trajectories, number=queries.QUERY_DRAWS)
        thresholds = state.estimate.tie_thresholds(queries.QUERY_DRAWS)
        worth = queries.expected_information(
            draws[:, :1],
            draws[:, 1:],
            likelihood=state.estimate.likelihood(queries.QUERY_DRAWS),
            tie_thresholds=thresholds,
        )
        likelihood = state.estimate.likelihood(queries.QUERY_DRAWS, answerer=answerer or "")
        bias = state.estimate.side_biases(queries.QUERY_DRAWS, answerer=answerer or "")
        margins = draws[:, :1] - draws[:, 1:] + (0.0 if bias is None else bias)
        first = float(prob(likelihood, margins).mean())
        said |= {"sure": max(first, 1 - first), "worth": float(worth[0] / np.log(2))}
        if thresholds is not None:
            chances = chances_with_ties(margins, likelihood, thresholds)
            said |= {"sure": float(chances.max()), "most": np.log2(3)}
        if said["worth"] < LITTLE:
            said["advice"] = (
                f"That is less than {LITTLE:.2f} bit: it changes little. If the next are worth no more, you can stop."
            )
        likely = UNKNOWN if first >= 0.5 else (Answer.SECOND, Answer.FIRST, *UNKNOWN[2:])
        likely = with_ties(likely, margins, likelihood, thresholds)
    return said, likely


def chances_with_ties(
    margins: Float[np.ndarray, "s 1"], likelihood: Likelihood, thresholds: np.ndarray
) -> Float[np.ndarray, " 3"]:
    """Posterior probability of "first", "second" and "no difference"."""
    likelihood = with_threshold(likelihood, thresholds, np.zeros(1, dtype=bool))
    first, second = (float(prob(likelihood, sign * margins).mean()) for sign in (1, -1))
    return np.array([first, second, max(1 - first - second, 0.0)])


def with_ties(
    likely: tuple[Answer, ...], margins: np.ndarray, likelihood: Likelihood, thresholds: np.ndarray | None
) -> tuple[Answer, ...]:
    """The answers in the order of their probability, once the run has ties; a skip, which costs little, comes third.

    Args:
      likely: the order without ties.
      margins: posterior draws of the utility of the first over that of the second, shape (S, 1).
      likelihood, thresholds: of the next answer; None where no answer was a tie.
    """
    if thresholds is None:
        return likely
    each = chances_with_ties(margins, likelihood, thresholds)
    chances = dict(zip((Answer.FIRST, Answer.SECOND, Answer.TIE), each, strict=True))
    ordered = sorted(chances, key=lambda answer: -chances[answer])
    return (*ordered[:2], Answer.SKIP, ordered[2])


def notice(given: int, *, practised: bool) -> str:
    """A short notice beside a question, by the number of answers in this sitting."""
    if given > 0 and given % BREAK == 0:
        return f"You have given {given} answers. Pause when you like; nothing is lost."
    return "The practice is over. From now on your answers are kept." if practised and not given else ""


def ending(learner: Learner, state: LearnerState, given: int) -> str:
    """Why there is no further question, by the number of answers in this sitting."""
    answers, budget = state.preferences.answers, learner.settings.questions.answers
    if not state.finished(learner.settings):
        these = f"These were the {given} answers" if given != 1 else "This was the one answer"
        return f"{these} of this sitting. Thank you! The run can go on later."
    if budget is not None and answers >= budget:
        given_all = f"All {answers} answers are given, and the policy has caught up with them. Thank you!"
        return given_all if answers > 1 else "Your answer is given, and the policy has caught up with it. Thank you!"
    restarted = state.restart is not None and state.unasked < MOST_UNASKED  # and asked again
    if restarted or state.iteration >= learner.settings.most_iterations:
        return f"The run has done its {state.iteration} iterations, with {answers} answers. Thank you!"
    return (
        f"The learner can foresee your answers: none was worth {LITTLE:.2f} bit in the last {state.unasked} "
        f"iterations. It stops after {answers} answers. Thank you!"
    )
