"""Clips of trajectories: sprite sheets, whose pictures a page draws in step.

A picture comes from the first of these that there is: our drawing of the task's observations, the environment's own
`rgb_array`, the dynamics' `draw(observation, axes)`, and plots of the observations over time.
"""

import io
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any
from zlib import crc32

import numpy as np
from PIL import Image

from bayespbrl.envs.functional import picture
from bayespbrl.envs.opening import environment_attribute
from bayespbrl.events import LearnerState
from bayespbrl.figures import spread
from bayespbrl.learner import Learner
from bayespbrl.people.drawing import SIDE, draw_grid, draw_scenes, scene_of
from bayespbrl.people.plots import draw_plots
from bayespbrl.people.replay import replayed
from bayespbrl.preferences import Query
from bayespbrl.trajectories import Trajectory

MOST_FRAMES = 80
SLOW_FRAMES = 30  # where a picture takes hundredths of a second
MOST_BYTES = 950_000  # of a clip; a question has two, and with the page itself it takes at most 2 MB
REMEMBERED = 12  # clips
SHORTEST, LONGEST = 2.5, 8.0  # seconds that a clip takes at speed 1
COLOURS = 128


@dataclass(frozen=True)
class Clip:
    """A film of one trajectory as one image: `frames` pictures, row by row.

    Attributes:
      sheet: a PNG or JPEG of at most `MOST_BYTES`.
      frames, columns: pictures, and pictures in a row.
      width, height: of a picture, in pixels.
      steps: of the trajectory; the pictures are spread evenly over them, the first and the last state among them.
      ended: whether the last state is terminal.
    """

    sheet: bytes
    frames: int
    columns: int
    width: int
    height: int
    steps: int
    ended: bool

    def described(self) -> dict[str, Any]:
        """All but the sheet, as plain data."""
        return {name: value for name, value in vars(self).items() if name != "sheet"}


class Clips:
    """Draws the clips of a learner's questions, and remembers the last ones."""

    def __init__(self, learner: Learner):
        self.learner = learner
        self._known: OrderedDict[tuple[int, int], Clip] = OrderedDict()

    def of(self, query: Query, state: LearnerState) -> tuple[Clip, Clip]:
        """Both clips of a question in a state, in the order shown."""
        first, second = (
            self._remembered(number, trajectory, state)
            for number, trajectory in zip((query.first, query.second), query.trajectories, strict=True)
        )
        if first is not None and second is not None:
            return first, second
        plots = draw_plots(self.learner.environment, query.trajectories, partial(spread, most=MOST_FRAMES // 2))
        return tuple(  # type: ignore[return-value]
            sheet_of(pictures, trajectory) for pictures, trajectory in zip(plots, query.trajectories, strict=True)
        )

    def rate(self, clips: Sequence[Clip]) -> float:
        """Steps a second at speed 1: as the environment states, but a clip takes 2.5 to 8 s."""
        environment = self.learner.environment
        own = environment_attribute(environment, "frames_per_second")
        own = float(own or environment.metadata.get("render_fps") or 10.0)
        longest = max(clip.steps for clip in clips)
        return longest / float(np.clip(longest / own, SHORTEST, LONGEST))

    def _remembered(self, number: int, trajectory: Trajectory, state: LearnerState) -> Clip | None:
        """The clip of what is shown of trajectory `number`; None where only plots of both can be drawn."""
        key = number, crc32(trajectory.states.tobytes())  # after an undo the number may be another's
        if key not in self._known:
            pictures = self._pictures(number, trajectory, state)
            if pictures is None:
                return None
            self._known[key] = sheet_of(pictures, trajectory)
            while len(self._known) > REMEMBERED:
                self._known.popitem(last=False)
        self._known.move_to_end(key)
        return self._known[key]

    def _pictures(self, number: int, trajectory: Trajectory, state: LearnerState) -> list[Image.Image] | None:
        environment = self.learner.environment
        shown = spread(len(trajectory.states), MOST_FRAMES)
        scene, grid = scene_of(environment), environment_attribute(environment, "grid_shape")
        if scene is not None:
            return draw_scenes(scene, trajectory.states, shown)
        if grid is not None:
            return draw_grid(grid, trajectory.states, shown)
        first = state.clips[number][0] if state.clips else 0
        if (pictures := replayed(self.learner, number, state.trajectories[number], first + shown)) is not None:
            return pictures
        if (draw := environment_attribute(environment, "draw")) is not None:
            some = spread(len(trajectory.states), SLOW_FRAMES)
            return [Image.fromarray(picture(partial(draw, trajectory.states[index]))) for index in some]
        return None


def sheet_of(pictures: Sequence[Image.Image], trajectory: Trajectory) -> Clip:
    """The clip with these pictures of a trajectory: PNG where few colours do, else JPEG."""
    pictures = [_fitting(each) for each in pictures]
    while True:
        sheet, columns = _sheet(pictures)
        encoded = _encoded(sheet)
        if len(encoded) <= MOST_BYTES or len(pictures) <= 2:
            break
        pictures = [pictures[index] for index in spread(len(pictures), max(2, len(pictures) // 2))]
    width, height = pictures[0].size
    return Clip(encoded, len(pictures), columns, width, height, len(trajectory), trajectory.terminated)


def _fitting(image: Image.Image) -> Image.Image:
    """The picture, reduced to one and a half times the usual side where it is larger."""
    most = 3 * SIDE // 2
    if max(image.size) <= most:
        return image
    scale = most / max(image.size)
    width, height = (max(1, round(scale * side)) for side in image.size)
    return image.resize((width, height), Image.Resampling.BILINEAR, reducing_gap=2.0)


def _sheet(pictures: Sequence[Image.Image]) -> tuple[Image.Image, int]:
    width, height = pictures[0].size
    columns = max(1, min(len(pictures), round(np.sqrt(len(pictures) * height / width))))
    rows = -(-len(pictures) // columns)
    sheet = Image.new(pictures[0].mode, (columns * width, rows * height))
    for place, each in enumerate(pictures):
        row, column = divmod(place, columns)
        sheet.paste(each, (column * width, row * height))
    return sheet, columns


def _encoded(sheet: Image.Image) -> bytes:
    if sheet.mode == "RGBA" or sheet.getcolors(COLOURS) is not None:
        content = _saved(sheet.quantize(COLOURS, method=Image.Quantize.FASTOCTREE), "PNG")
    else:
        for quality in (85, 70, 50):
            content = _saved(sheet.convert("RGB"), "JPEG", quality=quality)
            if len(content) <= MOST_BYTES:
                break
    return content


def _saved(image: Image.Image, form: str, **options: Any) -> bytes:
    file = io.BytesIO()
    image.save(file, form, **options)
    return file.getvalue()
