"""A film strip: the poses of a trajectory side by side on one pair of axes."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from bayespbrl.figures import spread

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Line = Float[np.ndarray, "points 2"]
COLUMNS = 6
MAX_POSES = 30


def draw_pose(lines: Sequence[Line], axes: "Axes", *, offset: ArrayLike = (0.0, 0.0), width: float = 6.0) -> None:
    """Connected limbs: each polyline is drawn with a joint at its first point."""
    for number, line in enumerate(lines):
        x, y = (np.asarray(line) + offset).T
        axes.plot(x, y, color=f"C{number}", linewidth=width, solid_capstyle="round")
        axes.plot(x[:1], y[:1], "o", color="0.2", markersize=width)


def draw_film_strip(
    pose: Callable[[Float[np.ndarray, " s"]], Sequence[Line]],
    states: Float[np.ndarray, "t s"],
    axes: "Axes",
    *,
    step_seconds: float,
) -> None:
    """At most 30 poses, first and last among them, six a row, each with its time.

    Args:
      pose: the polylines of one observation, in the square [−1, 1]².
      states: observations.
      axes: matplotlib axes.
      step_seconds: duration of a step.
    """
    shown = spread(len(states), MAX_POSES)
    for place, index in enumerate(shown):
        row, column = divmod(place, COLUMNS)
        offset = np.array([2.3 * column, -2.8 * row])
        draw_pose(pose(states[index]), axes, offset=offset, width=2.5)
        axes.text(offset[0], offset[1] - 1.35, f"{index * step_seconds:.2f} s", ha="center", va="center", fontsize=7)
    rows = -(-len(shown) // COLUMNS)
    axes.set(
        xlim=(-1.2, 2.3 * COLUMNS - 1.1), ylim=(-2.8 * (rows - 1) - 1.6, 1.2), aspect="equal", xticks=[], yticks=[]
    )
