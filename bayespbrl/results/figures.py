"""Figures of a study: learning curves by task, and performance profiles over its tasks."""

import numpy as np
from matplotlib.figure import Figure

from bayespbrl.diagnostics.axes import finished
from bayespbrl.figures import new_figure
from bayespbrl.results.intervals import performance_profile
from bayespbrl.results.study_data import StudyData

LEVELS = np.linspace(0, 1.1, 111)


def curves_figure(data: StudyData) -> Figure:
    """Median and quartiles of the value over answers, one panel per task."""
    tasks = data.tasks
    figure = new_figure(4.5 * len(tasks), 4)
    for axes, task in zip(np.atleast_1d(figure.subplots(1, len(tasks))), tasks, strict=True):
        for row in data.of_task(task):
            name = " ".join(level for level in row.declared.levels[1:] if level)
            if row.declared.untrained:
                axes.axhline(float(np.median(row.final)), color="0.6", linestyle=":", label=name)
                continue
            low, middle, high = np.quantile(row.values, [0.25, 0.5, 0.75], axis=0)
            (line,) = axes.plot(row.answers, middle, label=name or "median")
            axes.fill_between(row.answers, low, high, color=line.get_color(), alpha=0.15, linewidth=0)
        finished(axes, xlabel="answers", ylabel="value", title=task).legend(fontsize="x-small")
    return figure


def profiles_figure(data: StudyData) -> Figure | None:
    """Performance profiles over the tasks that have floor and ceiling, one curve per method; None without any."""
    relative: dict[str, dict[str, np.ndarray]] = {}
    for task in data.tasks:
        if (scale := data.floor_and_ceiling(task)) is None:
            continue
        for row in data.of_task(task):
            if not row.declared.untrained:
                name = " ".join(level for level in row.declared.levels[1:] if level)
                relative.setdefault(name, {})[task] = (row.final - scale[0]) / (scale[1] - scale[0])
    if not relative:
        return None
    figure = new_figure(6, 4)
    axes = figure.subplots()
    for name, tasks in relative.items():
        profile = performance_profile(tasks, LEVELS)
        (line,) = axes.plot(profile.levels, profile.share, label=f"{name} ({len(tasks)} tasks)")
        axes.fill_between(profile.levels, profile.low, profile.high, color=line.get_color(), alpha=0.15, linewidth=0)
    axes.set(xlabel="relative value τ", ylabel="share of runs above τ", title=f"Study {data.name}")
    axes.legend(fontsize="x-small")
    return figure
