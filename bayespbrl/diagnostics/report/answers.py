"""The section of a report on the answers: each with its probability and pictures, the most surprising first."""

from collections.abc import Sequence
from functools import partial

import gymnasium
import numpy as np
import xarray as xr

from bayespbrl.diagnostics.report import figures
from bayespbrl.diagnostics.report.contents import RunContents
from bayespbrl.diagnostics.report.document import Block, Body, Comparison, Picture, Table, drawn, thumbnail
from bayespbrl.diagnostics.report.formatting import cell, number
from bayespbrl.diagnostics.report.log import AnsweredQuestion
from bayespbrl.diagnostics.report.tables import contradicted
from bayespbrl.envs.pictures import draw_trajectory
from bayespbrl.preferences import Answer

# The most surprising answers have large pictures, the others small ones; beyond the cap an answer has numbers only.
LARGE, PICTURED = 4, 60


def answers(contents: RunContents, table: xr.Dataset) -> Body:
    """Every answer with its probability, the most surprising first; `table` is the `answers_table`."""
    if not contents.answers:
        return ["No question has been answered yet."], []
    blocks: list[Block] = []
    if np.isfinite(table["probability"].values).any() or np.isfinite(table["before"].values).any():
        caption = (
            "Probability of each answer. Open circles: before it was given. Dots: by the last posterior, which has "
            "seen it. The lower a dot, the more the other answers speak against that one."
        )
        alt = f"Probabilities of {len(contents.answers)} answers before and after they were given."
        panels = [("", partial(figures.plot_answers, table))]
        blocks.append(drawn("answers", panels, caption, alt, size=(7.6, 3.2)))
    order = surprise_order(table)
    text = []
    if contents.environment is None:
        text.append("The trajectories cannot be drawn, because the environment cannot be opened.")
    else:
        blocks += _comparisons(contents, contents.environment, table, order[:PICTURED])
    return text, [*blocks, _rows(table, order)]


def surprise_order(table: xr.Dataset) -> np.ndarray:
    """Answers from the least to the most probable given all, those without a probability last."""
    key = table["probability"].values
    key = np.where(np.isnan(key), table["before"].values, key)
    if np.isnan(key).all():
        key = table["margin"].values
    return np.argsort(key, kind="stable")  # NaN last


def _comparisons(
    contents: RunContents, environment: gymnasium.Env, table: xr.Dataset, order: Sequence[int] | np.ndarray
) -> list[Comparison]:
    pictures: dict[int, Picture] = {}
    blocks = []
    for place, k in enumerate(order):
        answer = contents.answers[int(k)]
        shown = [n for n in (answer.first, answer.second) if n in contents.compared]
        for n in shown:
            if n not in pictures:
                draw = partial(draw_trajectory, environment, contents.compared[n])
                pictures[n] = thumbnail(f"trajectory-{n}", draw, f"trajectory {n}", f"Drawing of trajectory {n}.")
        title = f"Question {answer.question}: {_in_words(answer)}"
        both = tuple(pictures[n] for n in shown)
        known = _probabilities(table, int(k)) or _unused(contents, answer)
        blocks.append(Comparison(title, known, both, small=place >= LARGE))
    return blocks


def _in_words(answer: AnsweredQuestion) -> str:
    named = {"first": f"{answer.first} over {answer.second}", "second": f"{answer.second} over {answer.first}"}
    return named.get(str(answer.answer), f"{answer.answer} between {answer.first} and {answer.second}")


def _probabilities(table: xr.Dataset, k: int) -> str:
    before, after = (float(table[name][k]) for name in ("before", "probability"))
    parts = []
    if np.isfinite(after):
        parts.append(f"probability {after:.3f} given all answers")
    if np.isfinite(before):
        parts.append(f"{before:.3f} beforehand")
    margin = float(table["margin"][k])
    if not parts and np.isfinite(margin):
        parts.append(f"margin {number(margin)}" + (", contradicted by the estimate" if contradicted(table)[k] else ""))
    return ", ".join(parts)


def _unused(contents: RunContents, answer: AnsweredQuestion) -> str:
    """What is said of an answer without a probability."""
    options = contents.settings.estimation
    if answer.answer is Answer.TIE and not contents.without_posterior and options.plain_draws is None:
        return "the posterior learns from it that the two are alike"
    return "not used by the model"


def _rows(table: xr.Dataset, order: np.ndarray) -> Table:
    names = ("question", "iteration", "first", "second", "said", "before", "probability", "margin", "margin_sd")
    head = ["question", "iteration", "shown first", "second", "answer", "before", "given all", "margin", "± sd"]
    rows = [[cell(table[name].values[k]) for name in names] for k in order]
    caption = (
        "Every answer: its probability before it was given and given all answers, and its margin, the utility of the "
        "preferred trajectory less that of the other. A tie has no probability beforehand until an estimate has seen "
        "one."
    )
    return Table(caption, head, rows)
