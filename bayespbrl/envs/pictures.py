"""Pictures of trajectories for a person to judge: one drawing of the whole, or a film.

An environment's dynamics may offer `draw(observation, axes)` and `draw_trajectory(trajectory, axes)`; without them the
observations are drawn against time. No hidden reward is shown.
"""

import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from bayespbrl.checks import whole
from bayespbrl.envs.functional import Drawn, picture
from bayespbrl.envs.opening import AnyEnvironment, environment_attribute, open_environment
from bayespbrl.figures import spread

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MAX_FRAMES = 100


def draw_trajectory(environment: AnyEnvironment, trajectory: Drawn, axes: "Axes") -> "Axes":
    """Draw a whole trajectory on matplotlib `axes`, and return them.

    Args:
      environment: anything `open_environment` takes.
      trajectory: to draw.
      axes: matplotlib axes, of any figure.
    """
    own = environment_attribute(open_environment(environment), "draw_trajectory")
    if own is not None:
        own(trajectory, axes)
        return axes
    states = np.asarray(trajectory.states)
    if states.ndim == 1:
        axes.step(np.arange(len(states)), states, where="post")
        axes.set_ylabel("observation")
    else:
        for number, dimension in enumerate(states.T):
            axes.plot(dimension, label=f"observation {number}")
        if states.shape[1] <= 10:
            axes.legend(loc="best", fontsize=8)
    axes.set(xlabel="step", title=f"{len(trajectory)} steps" + (", terminated" if trajectory.terminated else ""))
    return axes


def frames(
    environment: AnyEnvironment, trajectory: Drawn, *, max_frames: int = MAX_FRAMES
) -> UInt8[np.ndarray, "f height width 3"]:
    """RGB pictures of the states, evenly spread, first and last among them.

    A single picture of the whole trajectory where the environment cannot draw one observation.
    """
    whole("max_frames", max_frames, least=2)
    draw = environment_attribute(open_environment(environment), "draw")
    if draw is None:
        return picture(partial(draw_trajectory, environment, trajectory))[None]
    shown = spread(len(trajectory.states), max_frames)
    return np.stack([picture(partial(draw, trajectory.states[index])) for index in shown])


def film(
    environment: AnyEnvironment, trajectory: Drawn, path: str | os.PathLike[str], *, max_frames: int = MAX_FRAMES
) -> Path:
    """Write `frames` as an animated GIF, at the speed the dynamics state (`frames_per_second`, 10 by default)."""
    pictures = frames(environment, trajectory, max_frames=max_frames)
    stride = len(trajectory.states) / len(pictures)
    rate = environment_attribute(open_environment(environment), "frames_per_second") or 10.0
    return animation(pictures, path, milliseconds=1000 * stride / rate)


def drawing(environment: AnyEnvironment, trajectory: Drawn, path: str | os.PathLike[str]) -> Path:
    """Write `draw_trajectory` as a PNG."""
    Image.fromarray(picture(partial(draw_trajectory, environment, trajectory), inches=(9.0, 7.0))).save(path, "PNG")
    return Path(path)


def animation(
    frames: UInt8[np.ndarray, "f height width 3"], path: str | os.PathLike[str], *, milliseconds: float
) -> Path:
    """Write pictures as a GIF that rests on the last.

    `milliseconds` is how long each is shown, at least 20, which is as fast as viewers are.
    """
    images = [Image.fromarray(frame) for frame in frames]
    durations = [max(20, round(milliseconds))] * (len(images) - 1) + [1500]
    images[0].save(path, save_all=True, append_images=images[1:], duration=durations, loop=0, format="GIF")
    return Path(path)


def contact_sheet(
    frames: UInt8[np.ndarray, "f height width 3"], path: str | os.PathLike[str], *, most: int = 12, columns: int = 6
) -> Path:
    """Write at most `most` of the pictures, evenly spread, as one PNG, row by row."""
    shown = frames[spread(len(frames), most)]
    rows = -(-len(shown) // columns)
    height, width = shown.shape[1:3]
    sheet = np.full((rows * height, min(columns, len(shown)) * width, 3), 255, dtype=np.uint8)
    for place, frame in enumerate(shown):
        row, column = divmod(place, columns)
        sheet[row * height : (row + 1) * height, column * width : (column + 1) * width] = frame
    Image.fromarray(sheet).save(path, "PNG")
    return Path(path)
