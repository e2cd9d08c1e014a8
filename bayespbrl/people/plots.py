"""Plots of observations over time with a line that moves, for environments without a drawing.

An environment, or its dynamics, may have `observation_names`, one for each entry of an observation.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import gymnasium
import numpy as np
from jaxtyping import Int
from PIL import Image, ImageDraw

from bayespbrl.envs.opening import environment_attribute
from bayespbrl.figures import new_figure, pixels
from bayespbrl.people.drawing import BLUE, GREY, ORANGE
from bayespbrl.trajectories import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_PANELS = 6  # more entries are one picture, a row each
INCHES, DPI = (4.4, 4.0), 100
INK = "#8490a0"


def draw_plots(
    environment: gymnasium.Env, trajectories: Sequence[Trajectory], shown: Callable[[int], Int[np.ndarray, " f"]]
) -> list[list[Image.Image]]:
    """For each trajectory its plot once for each of the states `shown(T + 1)`, all with the same limits."""
    states = [_columns(trajectory.states) for trajectory in trajectories]
    together = np.concatenate(states)
    limits = np.stack([together.min(axis=0), together.max(axis=0)], axis=-1)
    names = observation_names(environment, len(limits))
    longest = max(len(table) for table in states) - 1
    return [_film(table, limits, names, longest, shown(len(table))) for table in states]


def observation_names(environment: gymnasium.Env, number: int) -> list[str]:
    """What the environment calls the entries of an observation; numbered where it does not say."""
    own = getattr(environment.unwrapped, "observation_names", None)
    own = environment_attribute(environment, "observation_names") if own is None else own
    if isinstance(own, Sequence) and not isinstance(own, str) and len(own) == number:
        return [str(name) for name in own]
    return ["observation"] if number == 1 else [f"observation {place}" for place in range(number)]


def _is_math(name: str) -> bool:
    """Whether Matplotlib can draw a name with `$` as a formula; where it cannot, the `$` are drawn."""
    from matplotlib.mathtext import MathTextParser

    try:
        MathTextParser("agg").parse(name)
    except ValueError:
        return False
    return True


def _columns(states: np.ndarray) -> np.ndarray:
    return np.asarray(states, float).reshape(len(states), -1)


def _film(
    table: np.ndarray, limits: np.ndarray, names: Sequence[str], longest: int, shown: Int[np.ndarray, " f"]
) -> list[Image.Image]:
    figure = new_figure(*INCHES, dpi=DPI)
    figure.patch.set_alpha(0.0)
    few = len(names) <= MOST_PANELS
    panels = _panels(figure, table, limits, names) if few else [_rows(figure, table, limits, names)]
    for axes in panels:
        axes.set_xlim(0, longest)
    panels[-1].set_xlabel("step", color=INK, fontsize=9)
    ground = Image.fromarray(pixels(figure))
    top, bottom = panels[0].get_window_extent().y1, panels[-1].get_window_extent().y0
    pictures = []
    for index in shown:
        picture = ground.copy()
        pen = ImageDraw.Draw(picture)
        x = panels[0].transData.transform((index, 0))[0]
        pen.line([(x, ground.height - top), (x, ground.height - bottom)], fill=ORANGE if few else GREY, width=2)
        for axes, value in zip(panels if few else [], table[index], strict=False):
            y = ground.height - axes.transData.transform((index, value))[1]
            pen.ellipse((x - 5, y - 5, x + 5, y + 5), fill=ORANGE)
        pictures.append(picture)
    return pictures


def _panels(figure: "Figure", table: np.ndarray, limits: np.ndarray, names: Sequence[str]) -> list["Axes"]:
    """A line for each entry, one above the other."""
    panels = list(figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0])
    for axes, values, (low, high), name in zip(panels, table.T, limits, names, strict=True):
        margin = 0.08 * (high - low) or 0.5
        axes.plot(values, color=np.array(BLUE) / 255, linewidth=1.8)
        axes.set_ylim(low - margin, high + margin)
        axes.set_title(name, color=INK, fontsize=9, loc="left", pad=2, parse_math=_is_math(name))
        _quiet(axes)
    return panels


def _rows(figure: "Figure", table: np.ndarray, limits: np.ndarray, names: Sequence[str]) -> "Axes":
    """A row of colours for each entry, each between its limits."""
    axes = figure.subplots()
    low, high = limits.T
    scaled = (table - low) / np.where(high > low, high - low, 1.0)
    axes.imshow(scaled.T, aspect="auto", cmap="viridis", vmin=0, vmax=1, interpolation="nearest")
    axes.set_title(f"{len(names)} observations, each from its least to its greatest", color=INK, fontsize=9, loc="left")
    _quiet(axes)
    return axes


def _quiet(axes: "Axes") -> None:
    axes.patch.set_alpha(0.0)
    axes.tick_params(colors=INK, labelsize=8)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(INK)
