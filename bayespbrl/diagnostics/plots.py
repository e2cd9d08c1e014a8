"""Figures of a run and of a study. Each plot function draws on the matplotlib axes it is given and returns them."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayespbrl.diagnostics.axes import finished, number_cells
from bayespbrl.diagnostics.estimates import expect_estimate
from bayespbrl.envs.opening import environment_attribute
from bayespbrl.envs.stepping import of_whole_episodes
from bayespbrl.figures import new_figure, spread
from bayespbrl.learner import Learner
from bayespbrl.trajectories import Transitions, transitions

MOST_STEPS = 5000  # drawn as points: more of them hide each other


def learning_curve(iterations: Sequence[Mapping[str, Any]], axes: Axes, *, optimum: float | None = None) -> Axes:
    """Value against number of answers.

    Args:
      iterations: summaries of the completed iterations.
      axes: to draw on.
      optimum: drawn as a line when given.
    """
    axes.plot([s["answers"] for s in iterations], [s["value"] for s in iterations], marker="o", markersize=3)
    if optimum is not None:
        axes.axhline(optimum, color="0.5", linestyle="--", linewidth=1)
        axes.annotate(
            "optimal",
            (0.98, optimum),
            xycoords=("axes fraction", "data"),
            xytext=(0, -4),
            textcoords="offset points",
            va="top",
            ha="right",
            color="0.4",
        )
    return finished(axes, xlabel="answers", ylabel="value (mean return)", title="Learning curve")


def quartile_curve(quartiles: xr.Dataset, axes: Axes, *, levels: Mapping[str, float] | None = None) -> Axes:
    """Median and quartiles of the value over trials, against number of answers.

    Args:
      quartiles: lower_quartile, median and upper_quartile by answers, from `Trials.quartiles`.
      axes: to draw on.
      levels: horizontal lines by name: published returns, the optimum.
    """
    answers = quartiles["answers"]
    axes.fill_between(
        answers, quartiles["lower_quartile"], quartiles["upper_quartile"], alpha=0.25, linewidth=0, label="quartiles"
    )
    axes.plot(answers, quartiles["median"], marker="o", markersize=3, label="median")
    for name, level in (levels or {}).items():
        axes.axhline(level, color="0.5", linestyle="--", linewidth=1)
        axes.annotate(name, (0.98, level), xycoords=("axes fraction", "data"), va="bottom", ha="right", color="0.4")
    finished(axes, xlabel="answers", ylabel="value (mean return)").legend(loc="lower right")
    return axes


def trials_figure(
    quartiles: xr.Dataset, environment: gymnasium.Env, title: str, max_steps: int | None = None
) -> Figure:
    """`quartile_curve` with the environment's published returns and its optimum, where it has them.

    `max_steps` is the time limit of the episodes; None: the environment's.
    """
    figure = new_figure(7, 4.5)
    levels = dict(of_whole_episodes(environment, "published_returns", max_steps) or {})
    optimum = of_whole_episodes(environment, "optimal_return", max_steps)
    axes = quartile_curve(
        quartiles, figure.subplots(), levels=levels | ({} if optimum is None else {"optimal": optimum})
    )
    axes.set_title(title)
    return figure


def utility_beside_reward(learner: Learner, utility_axes: Axes, reward_axes: Axes) -> tuple[Axes, Axes]:
    """The inferred utility and the hidden reward of the visited states.

    Maps for a grid, coloured points for two-dimensional observations. For all other observations: the utility of each
    step against its reward, and of each trajectory against its return. Points are of at most `MOST_STEPS` steps, evenly
    spread.
    """
    shape = environment_attribute(learner.environment, "grid_shape")
    steps = transitions(learner.trajectories)
    if shape is None:
        steps = steps.at(spread(len(steps), MOST_STEPS))
    utilities = expect_estimate(learner.estimate).step_utilities(steps)
    if shape is None and (steps.states.ndim != 2 or steps.states.shape[1] != 2):
        return _scatter(utilities, steps.rewards, learner, utility_axes, reward_axes)
    draw = _points if shape is None else partial(_map_of_cells, shape=shape)
    for axes, values, title in (
        (utility_axes, utilities, "Inferred utility"),
        (reward_axes, steps.rewards, "Hidden reward"),
    ):
        draw(steps, values, axes)
        axes.set_title(title)
    return utility_axes, reward_axes


def run_figure(learner: Learner) -> Figure:
    """The learning curve, and the inferred utility beside the hidden reward, as one figure."""
    figure = new_figure(13, 4)
    curve, utility, reward = figure.subplots(1, 3)
    steps = learner.settings.rollouts.max_steps
    optimum = of_whole_episodes(learner.environment, "optimal_return", steps)
    learning_curve(learner.iterations, curve, optimum=optimum)
    utility_beside_reward(learner, utility, reward)
    return figure


def _map_of_cells(steps: Transitions, values: np.ndarray, axes: Axes, *, shape: tuple[int, int]) -> None:
    """Mean value on arrival in each cell; cells that were never entered stay blank."""
    size = shape[0] * shape[1]
    counts = np.bincount(steps.next_states, minlength=size)
    sums = np.bincount(steps.next_states, weights=values, minlength=size)
    means = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan).reshape(shape)
    image = axes.imshow(means, cmap="viridis")
    axes.figure.colorbar(image, ax=axes, shrink=0.8)
    number_cells(axes, shape)


def _points(steps: Transitions, values: np.ndarray, axes: Axes) -> None:
    first, second = steps.next_states.T
    points = axes.scatter(first, second, c=values, s=4, cmap="viridis")
    axes.figure.colorbar(points, ax=axes, shrink=0.8)
    axes.set(xlabel="observation 0", ylabel="observation 1")


def _scatter(
    utilities: np.ndarray, rewards: np.ndarray, learner: Learner, step_axes: Axes, trajectory_axes: Axes
) -> tuple[Axes, Axes]:
    step_axes.scatter(rewards, utilities, s=4, alpha=0.3)
    step_axes.set(xlabel="hidden reward", ylabel="inferred utility", title="Steps")
    returns = [trajectory.total_reward for trajectory in learner.trajectories]
    utilities = expect_estimate(learner.estimate).trajectory_utilities(learner.trajectories)
    trajectory_axes.scatter(returns, utilities, s=10)
    trajectory_axes.set(xlabel="hidden return", ylabel="inferred utility", title="Trajectories")
    return step_axes, trajectory_axes
