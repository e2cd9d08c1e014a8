"""Pictures of trajectories for a person to judge by: one drawing of the whole, or a film.

An environment's dynamics may offer `draw(observation, axes)` and `draw_trajectory(trajectory, axes)`; without them the
observations are drawn against time. No hidden reward is shown.
"""

import os
from pathlib import Path
from typing import Any

import numpy as np

from bayespbrl.envs.functional import picture
from bayespbrl.envs.opening import open_environment

MAX_FRAMES = 100


def draw_trajectory(environment: Any, trajectory: Any, axes: Any) -> Any:
    """Draw a whole trajectory on matplotlib `axes`, and return them.

    Args:
      environment: anything `open_environment` takes.
      trajectory: has `states` (T+1, …), `actions` (T, …), `terminated` and a length.
      axes: matplotlib axes, of any figure.
    """
    own = getattr(_dynamics(environment), "draw_trajectory", None)
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


def frames(environment: Any, trajectory: Any, *, max_frames: int = MAX_FRAMES) -> np.ndarray:
    """RGB pictures of the states, evenly spread, first and last among them; shape (F, height, width, 3) uint8.

    A single picture of the whole trajectory where the environment cannot draw one observation.
    """
    if max_frames < 2:
        raise ValueError(f"max_frames: expected at least 2, got {max_frames}")
    draw = getattr(_dynamics(environment), "draw", None)
    if draw is None:
        return picture(lambda axes: draw_trajectory(environment, trajectory, axes))[None]
    shown = _shown(trajectory, max_frames)
    return np.stack([picture(lambda axes, index=index: draw(trajectory.states[index], axes)) for index in shown])


def film(environment: Any, trajectory: Any, path: str | os.PathLike[str], *, max_frames: int = MAX_FRAMES) -> Path:
    """Write `frames` as an animated GIF, at the speed the dynamics state (`frames_per_second`, 10 by default)."""
    from PIL import Image

    pictures = [Image.fromarray(frame) for frame in frames(environment, trajectory, max_frames=max_frames)]
    stride = len(trajectory.states) / len(pictures)
    rate = getattr(_dynamics(environment), "frames_per_second", 10.0)
    milliseconds = [max(20, round(1000 * stride / rate))] * (len(pictures) - 1) + [1500]  # rest on the last picture
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=milliseconds, loop=0, format="GIF")
    return Path(path)


def _shown(trajectory: Any, max_frames: int) -> np.ndarray:
    states = len(trajectory.states)
    return np.unique(np.linspace(0, states - 1, min(states, max_frames)).round().astype(int))


def _dynamics(environment: Any) -> Any:
    return getattr(open_environment(environment).unwrapped, "dynamics", None)
