"""Films of the final policy: of environments that can be drawn, that render themselves, and that do neither."""

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from PIL import Image

from bayespbrl import Learner
from bayespbrl.envs import pictures
from bayespbrl.envs.opening import open_environment
from bayespbrl.runs import film
from bayespbrl.runs.film import FRAMES, film_policy

QUICK = {
    "preset": "paper",
    "utility": "linear-program",
    "iterations": 1,
    "evaluation_episodes": 2,
    "seed": 3,
    "centres": 10,
}


class Counter(gymnasium.Env):
    """Renders its step as the brightness of a picture; ends after `length` steps."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012
    observation_space = Box(-1e6, 1e6, (1,))
    action_space = Discrete(2)

    def __init__(self, render_mode=None, length=7, broken=False):
        self.render_mode, self.length, self.broken, self.closed = render_mode, length, broken, False

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.time += 1
        return np.full(1, self.time, np.float32), float(action), self.time == self.length, False, {}

    def render(self):
        if self.broken:
            raise RuntimeError("no display")
        return np.full((4, 6, 3), self.time % 256, np.uint8)

    def close(self):
        self.closed = True


class Silent(Counter):
    metadata = {"render_modes": []}  # noqa: RUF012


gymnasium.register("bayespbrl-tests/Counter-v0", entry_point=Counter, max_episode_steps=9)
gymnasium.register("bayespbrl-tests/Silent-v0", entry_point=Silent, max_episode_steps=9)


def frames_of(path):
    with Image.open(path) as image:
        count = image.n_frames
        shown = []
        for number in range(count):
            image.seek(number)
            shown.append((int(np.asarray(image.convert("RGB"))[0, 0, 0]), image.info["duration"]))
    return shown


@pytest.mark.slow
def test_an_environment_that_can_be_drawn_leaves_a_film_and_a_strip(tmp_path, monkeypatch):
    monkeypatch.setattr("bayespbrl.runs.film.FRAMES", 6)  # each takes a tenth of a second
    gif, strip = film_policy(Learner("gridworld", max_steps=20, **QUICK), tmp_path)
    assert (gif, strip) == (tmp_path / "final.gif", tmp_path / "final.png")
    with Image.open(gif) as image:
        assert 2 <= image.n_frames <= 6
    with Image.open(strip) as image:
        assert image.format == "PNG"


@pytest.mark.parametrize("env", ["bayespbrl-tests/Counter-v0", Counter("rgb_array")])
def test_an_environment_that_renders_itself_is_filmed_step_by_step(tmp_path, env):
    learner = Learner(env, max_steps=9, **QUICK)
    gif, strip = film_policy(learner, tmp_path)
    shown = frames_of(gif)
    assert [brightness for brightness, _ in shown] == list(range(8))  # the reset and seven steps
    assert [milliseconds for _, milliseconds in shown] == [50] * 7 + [1500]
    with Image.open(strip) as image:
        assert image.size == (6 * 6, 2 * 4)  # eight pictures, six a row
    assert isinstance(env, str) or not env.closed  # the user's own stays open


def test_the_film_of_a_name_lasts_as_long_as_the_run_says_and_not_as_registered(tmp_path):
    gymnasium.register("bayespbrl-tests/Short-v0", Counter, max_episode_steps=4, kwargs={"length": 99})
    try:
        shown = frames_of(film_policy(Learner("bayespbrl-tests/Short-v0", max_steps=9, **QUICK), tmp_path)[0])
    finally:
        del gymnasium.registry["bayespbrl-tests/Short-v0"]
    assert [brightness for brightness, _ in shown] == list(range(10))


def test_a_long_episode_is_thinned_out_evenly_and_keeps_its_end(tmp_path):
    learner = Learner(Counter("rgb_array", length=250), max_steps=300, **QUICK)
    brightness, durations = zip(*frames_of(film_policy(learner, tmp_path)[0]), strict=True)
    assert len(brightness) <= 2 * FRAMES
    assert (brightness[0], brightness[-1]) == (0, 250)
    assert set(np.diff(brightness[:-1])) == {4}
    assert set(durations[:-1]) == {200}


@pytest.mark.parametrize(
    ("env", "reason"),
    [
        ("bayespbrl-tests/Silent-v0", "Silent-v0 cannot be rendered: expected a mode rgb_array, got none"),
        (Counter(), "Counter cannot be rendered: expected render_mode rgb_array, got None"),
        (Counter("rgb_array", broken=True), "Counter cannot be rendered: no display"),
    ],
)
def test_an_environment_that_cannot_be_rendered_is_named_and_nothing_is_written(tmp_path, env, reason):
    with pytest.raises(ValueError, match=reason):
        film_policy(Learner(env, max_steps=9, **QUICK), tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("platform", "variables", "expected"),
    [
        ("linux", {}, "egl"),
        ("linux", {"MUJOCO_GL": "osmesa"}, "osmesa"),
        ("linux", {"DISPLAY": ":0"}, None),
        ("linux", {"WAYLAND_DISPLAY": "wayland-0"}, None),
        ("darwin", {}, None),
    ],
)
def test_mujoco_is_asked_to_render_without_a_display_where_there_is_none(monkeypatch, platform, variables, expected):
    monkeypatch.setattr(film.os, "environ", dict(variables))
    monkeypatch.setattr(film.sys, "platform", platform)
    if expected:  # other environments are rendered without it
        monkeypatch.delitem(film.sys.modules, "mujoco", raising=False)
        film.rendering(open_environment("bayespbrl-tests/Counter-v0"), 9).close()
        assert film.os.environ == variables
    monkeypatch.setitem(film.sys.modules, "mujoco", None)
    film.rendering(open_environment("bayespbrl-tests/Counter-v0"), 9).close()
    assert film.os.environ.get("MUJOCO_GL") == expected


def test_a_contact_sheet_shows_first_and_last_and_leaves_the_rest_white(tmp_path):
    frames = np.arange(20, dtype=np.uint8)[:, None, None, None] * np.ones((1, 2, 3, 3), np.uint8)
    sheet = np.asarray(Image.open(pictures.contact_sheet(frames, tmp_path / "sheet.png", most=4, columns=3)))
    assert sheet.shape == (4, 9, 3)
    assert sheet[0, ::3, 0].tolist() == [0, 6, 13]
    assert sheet[2, ::3, 0].tolist() == [19, 255, 255]
