"""Pictures of observations, drawn with Pillow: fast enough for a film of each trajectory, on a transparent ground.

The colours are readable on light and on dark.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from gymnasium import Env
from jaxtyping import Float, Int, Shaped
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw

from bayespbrl.envs import acrobot
from bayespbrl.envs.bicycle import FALL_ANGLE
from bayespbrl.envs.opening import environment_attribute, observed_otherwise

SIDE = 320  # pixels of a picture
FINER = 2  # drawn larger and reduced: smooth edges
TAIL = 6  # observations before, whose end is drawn as a dot

Colour = tuple[int, int, int, int]
BLUE: Colour = (66, 118, 232, 255)
ORANGE: Colour = (236, 129, 44, 255)
GREY: Colour = (132, 143, 160, 255)
FAINT: Colour = (132, 143, 160, 90)
GREEN: Colour = (46, 160, 103, 255)


@dataclass(frozen=True)
class Stroke:
    """A line through points of the square [−1, 1]², y upwards; `width` is a share of the square's half side."""

    points: Float[np.ndarray, "p 2"]
    colour: Colour = BLUE
    width: float = 0.1
    dot: float = 0.0  # radius of a dot on its first point


def line(*points: ArrayLike, colour: Colour = BLUE, width: float = 0.1, dot: float = 0.0) -> Stroke:
    """A `Stroke` through points."""
    return Stroke(np.array(points, float), colour, width, dot)


def arc(angle: float, length: float, start: tuple[float, float] = (0.0, 0.0)) -> list[tuple[float, float]]:
    """Both ends of a rod: its angle is from upright, clockwise, in rad."""
    return [start, (start[0] + length * np.sin(angle), start[1] + length * np.cos(angle))]


Observation = Shaped[np.ndarray, "..."]
Scene = Callable[[Observation], list[Stroke]]


def limbs(pose: Callable[[Observation], Sequence[np.ndarray]]) -> Scene:
    """The scene of polylines, as the `pose` of the dynamics has them."""

    def scene(observation: Observation) -> list[Stroke]:
        colours = (BLUE, ORANGE)
        return [Stroke(points, colours[k % 2], 0.1, 0.075) for k, points in enumerate(pose(observation))]

    return scene


def _cart_pole(observation: Observation) -> list[Stroke]:
    x, angle = float(observation[0]) / 2.6, float(observation[2])
    return [
        line((-1, -0.5), (1, -0.5), colour=FAINT, width=0.02),
        line((x - 0.14, -0.42), (x + 0.14, -0.42), colour=GREY, width=0.16),
        line(*arc(angle, 1.0, (x, -0.42)), colour=BLUE, width=0.06, dot=0.05),
    ]


def _pendulum(observation: Observation) -> list[Stroke]:
    angle = float(np.arctan2(observation[1], observation[0]))  # counter-clockwise
    return [line(*arc(-angle, 0.85), width=0.12, dot=0.08)]


def _acrobot(observation: Observation) -> list[Stroke]:
    first = float(np.arctan2(observation[1], observation[0]))
    both = first + float(np.arctan2(observation[3], observation[2]))
    elbow = (0.45 * np.sin(first), -0.45 * np.cos(first))
    tip = (elbow[0] + 0.45 * np.sin(both), elbow[1] - 0.45 * np.cos(both))
    goal = line((-1, 0.45), (1, 0.45), colour=GREEN, width=0.015)
    return [goal, line((0, 0), elbow, dot=0.06), line(elbow, tip, colour=ORANGE, dot=0.06)]


def _mountain_car(observation: Observation) -> list[Stroke]:
    def place(x: ArrayLike) -> np.ndarray:
        return np.stack([(np.asarray(x) + 0.3) / 0.95, 0.55 * np.sin(3 * np.asarray(x))], axis=-1)

    hill = Stroke(place(np.linspace(-1.2, 0.6, 60)), GREY, 0.03)
    x, y = place(float(observation[0]))
    top = place(0.45)
    flag = line(top, top + np.array([0, 0.3]), colour=GREEN, width=0.03)
    return [hill, flag, line((x, y + 0.08), (x, y + 0.08), dot=0.09)]


def _bicycle(observation: Observation) -> list[Stroke]:
    steering, lean = float(observation[0]), 3 * float(observation[2])  # the lean is magnified three times
    foot, limit = (0.0, -0.8), 3 * FALL_ANGLE
    top = np.array(arc(lean, 1.4, foot)[1])
    bar = 0.35 * np.array([np.cos(steering), np.sin(steering)])
    return [
        line((-1, -0.8), (1, -0.8), colour=GREY, width=0.03),
        *(line(*arc(side, 1.5, foot), colour=FAINT, width=0.02) for side in (-limit, limit)),
        line(*arc(lean, 1.4, foot)),
        line(top - bar, top + bar, colour=ORANGE, width=0.07),
    ]


def _double_pendulum(observation: Observation) -> list[Stroke]:
    return [line((-1, 0.5), (1, 0.5), colour=GREEN, width=0.015), *limbs(acrobot.DYNAMICS.pose)(observation)]


SCENES: dict[str, Scene] = {
    "bayespbrl/Acrobot-v0": _double_pendulum,
    "bayespbrl/Bicycle-v0": _bicycle,
    "CartPole-v0": _cart_pole,
    "CartPole-v1": _cart_pole,
    "Pendulum-v1": _pendulum,
    "Acrobot-v1": _acrobot,
    "MountainCar-v0": _mountain_car,
    "MountainCarContinuous-v0": _mountain_car,
}


def scene_of(environment: Env) -> Scene | None:
    """How an observation of the environment is drawn; None where no drawing is known."""
    name = environment.spec.id if environment.spec is not None else ""
    if name in SCENES and not observed_otherwise(environment):
        return SCENES[name]
    pose = environment_attribute(environment, "pose")
    return None if pose is None else limbs(pose)


def draw_scenes(scene: Scene, states: np.ndarray, shown: Int[np.ndarray, " f"]) -> list[Image.Image]:
    """A picture of each observation `shown`, with dots where the end of its last stroke has just been."""
    ends = np.array([scene(state)[-1].points[-1] for state in states])
    pictures = []
    for index in shown:
        large, pen = _canvas()
        for age, end in enumerate(ends[max(0, index - TAIL) : index]):
            _dot(pen, _pixels([end])[0], 0.016 * SIDE * FINER, (*ORANGE[:3], 40 + 110 * (age + 1) // TAIL))
        for stroke in scene(states[index]):
            _stroke(pen, stroke)
        pictures.append(large.reduce(FINER))
    return pictures


def draw_grid(shape: tuple[int, int], states: np.ndarray, shown: Int[np.ndarray, " f"]) -> list[Image.Image]:
    """The position on a grid with rows × columns cells, and how often each cell was visited so far (shade)."""
    rows, columns = shape
    cell = int(0.92 * SIDE * FINER / max(shape))
    left, top = (SIDE * FINER - columns * cell) // 2, (SIDE * FINER - rows * cell) // 2
    most = max(1, np.bincount(states).max())
    pictures = []
    for index in shown:
        large, pen = _canvas()
        visits = np.bincount(states[: index + 1], minlength=rows * columns)
        for number in range(rows * columns):
            x, y = left + cell * (number % columns), top + cell * (number // columns)
            shade = int(200 * np.sqrt(visits[number] / most))
            pen.rectangle((x, y, x + cell, y + cell), fill=(*BLUE[:3], shade), outline=FAINT, width=FINER)
        x, y = left + cell * (states[index] % columns + 0.5), top + cell * (states[index] // columns + 0.5)
        pen.ellipse((x - cell / 4, y - cell / 4, x + cell / 4, y + cell / 4), fill=ORANGE)
        pictures.append(large.reduce(FINER))
    return pictures


def _canvas() -> tuple[Image.Image, ImageDraw.ImageDraw]:
    large = Image.new("RGBA", (SIDE * FINER, SIDE * FINER), (0, 0, 0, 0))
    return large, ImageDraw.Draw(large)


def _stroke(pen: ImageDraw.ImageDraw, stroke: Stroke) -> None:
    points, scale = _pixels(stroke.points), 0.45 * SIDE * FINER
    width = max(1, round(scale * stroke.width))
    pen.line(points, fill=stroke.colour, width=width, joint="curve")
    if stroke.width >= 0.05 and stroke.colour[3] == 255 and len(points) > 1 and stroke.dot:
        _dot(pen, points[-1], width / 2, stroke.colour)
    if stroke.dot:
        _dot(pen, points[0], scale * stroke.dot, GREY if len(set(points)) > 1 else stroke.colour)


def _pixels(points: Iterable[Float[np.ndarray, "2"]]) -> list[tuple[float, float]]:
    half = SIDE * FINER / 2
    return [(half + 0.9 * half * float(x), half - 0.9 * half * float(y)) for x, y in points]


def _dot(pen: ImageDraw.ImageDraw, centre: tuple[float, float], radius: float, colour: Colour) -> None:
    x, y = centre
    pen.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)
