"""The section of a report on the answers: each with its probability and pictures, the most surprising on top."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from bayespbrl.diagnostics.report import figures
from bayespbrl.diagnostics.report.contents import Evidence
from bayespbrl.diagnostics.report.document import Comparison, Picture, Section, Table, drawn, thumbnail
from bayespbrl.diagnostics.report.log import AnswerRecord
from bayespbrl.diagnostics.report.summary import cell, figure
from bayespbrl.envs.pictures import draw_trajectory

# Pictures of the most surprising answers are large, of the others small, and past the cap there are only numbers.
LARGE, PICTURED = 4, 60


def answers(evidence: Evidence, table: xr.Dataset) -> Section:
    """Every answer with its probability, the most surprising on top."""
    title = "The answers, most surprising first"
    if not evidence.answers:
        return Section("answers", title, ["No question has been answered yet."])
    blocks: list[Any] = []
    if np.isfinite(table["probability"].values).any() or np.isfinite(table["before"].values).any():
        caption = (
            "The probability of each answer that was given: open circles by the posterior that had not heard it, dots "
            "by the last one, which has. Dots below one half are answers that all the others speak against."
        )
        panels = [("", partial(figures.plot_answers, table))]
        alt = f"Probabilities of {len(evidence.answers)} answers before and after they were given."
        blocks.append(drawn("answers", panels, caption, alt, columns=1, size=(7.6, 3.2)))
    order = surprise_order(table)
    text = []
    if evidence.environment is None:
        text.append("The trajectories cannot be drawn: the environment cannot be opened.")
    else:
        blocks += _comparisons(evidence, table, order[:PICTURED])
    blocks.append(_answers_as_rows(table, order))
    return Section("answers", title, text, blocks)


def surprise_order(table: xr.Dataset) -> np.ndarray:
    """Answers from the least to the most probable given all others, those without a probability last."""
    key = table["probability"].values
    key = np.where(np.isnan(key), table["before"].values, key)
    if np.isnan(key).all():
        key = table["margin"].values
    return np.argsort(key, kind="stable")  # NaN last


def _comparisons(evidence: Evidence, table: xr.Dataset, order: Sequence[int] | np.ndarray) -> list[Comparison]:
    pictures: dict[int, Picture] = {}
    blocks = []
    for place, k in enumerate(order):
        record = evidence.answers[int(k)]
        shown = [number for number in (record.first, record.second) if number in evidence.trajectories]
        for number in shown:
            if number not in pictures:
                draw = partial(draw_trajectory, evidence.environment, evidence.trajectories[number])
                pictures[number] = thumbnail(
                    f"trajectory-{number}", draw, f"trajectory {number}", f"Drawing of trajectory {number}."
                )
        title = f"Question {record.question}: {_said(record)}"
        both = tuple(pictures[number] for number in shown)
        blocks.append(Comparison(title, _expected(table, int(k)), both, small=place >= LARGE))
    return blocks


def _said(record: AnswerRecord) -> str:
    named = {"first": f"{record.first} over {record.second}", "second": f"{record.second} over {record.first}"}
    return named.get(str(record.answer), f"{record.answer} between {record.first} and {record.second}")


def _expected(table: xr.Dataset, k: int) -> str:
    before, after = (float(table[name][k]) for name in ("before", "probability"))
    parts = []
    if np.isfinite(after):
        parts.append(f"probability {after:.3f} given all answers")
    if np.isfinite(before):
        parts.append(f"{before:.3f} beforehand")
    margin = float(table["margin"][k])
    if not parts and np.isfinite(margin):
        parts.append(f"margin {figure(margin)}" + (", contradicted by the estimate" if margin <= 0 else ""))
    return ", ".join(parts) or "not used by the model"


def _answers_as_rows(table: xr.Dataset, order: np.ndarray) -> Table:
    names = ("question", "iteration", "first", "second", "said", "before", "probability", "margin", "margin_sd")
    head = ["question", "iteration", "shown first", "second", "said", "before", "given all", "margin", "± sd"]
    rows = [[cell(table[name].values[k]) for name in names] for k in order]
    caption = (
        "Every answer: the probability of what was said before it was said and given all answers, and the margin, by "
        "how much the estimate puts the preferred one higher."
    )
    return Table(caption, head, rows)
