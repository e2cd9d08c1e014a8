"""Films of a policy: one fresh episode as an animated GIF and as a film strip."""

import os
import sys
from pathlib import Path

import gymnasium
import jax
import numpy as np

from bayespbrl import checks, rollouts
from bayespbrl.envs import pictures
from bayespbrl.envs.opening import (
    as_given,
    environment_attribute,
    environment_name,
    flattened,
    given_by_name,
    made_from,
)
from bayespbrl.envs.stepping import step_limit
from bayespbrl.learner import Learner
from bayespbrl.policies.actor import Actor
from bayespbrl.runs.files import written_aside

FRAMES = 60  # pictures in the GIF of a drawn episode; where the environment renders itself, at most twice as many


def film_policy(learner: Learner, directory: Path) -> tuple[Path, Path]:
    """Write the film and the film strip of one episode under the learner's policy: `final.gif` and `final.png`.

    An environment whose dynamics have a method `draw` is drawn. Any other one renders itself in its mode `rgb_array`.

    Returns:
      the paths of the film and of the strip.

    Raises:
      ValueError: an environment that cannot be rendered, or that fails while it is.
    """
    film, strip = directory / "final.gif", directory / "final.png"
    environment, settings = learner.environment, learner.settings
    # another number than the learner's would need a new compilation
    update, number = settings.update, settings.rollouts.trajectories_per_iteration
    episodes = update.check_episodes if update.checked else number
    try:
        if environment_attribute(environment, "draw") is not None:
            shown = rollouts.rollout(
                environment,
                learner.policy,
                key=jax.random.key(settings.seed),
                episodes=episodes,
                max_steps=settings.rollouts.max_steps,
            )[0]
            with written_aside(film) as gif, written_aside(strip) as png:
                pictures.film(environment, shown, gif, max_frames=FRAMES)
                pictures.drawing(environment, shown, png)
        else:
            frames, milliseconds = _rendered(learner)
            with written_aside(film) as gif, written_aside(strip) as png:
                pictures.animation(frames, gif, milliseconds=milliseconds)
                pictures.contact_sheet(frames, png)
    except Exception as error:  # whatever a drawing or rendering of the user's raises
        name, reason = environment_name(environment), checks.reason(error)
        raise ValueError(f"environment {name} cannot be rendered: {reason}") from error
    return film, strip


def _rendered(learner: Learner) -> tuple[np.ndarray, float]:
    """Pictures of one episode that the environment renders, and the milliseconds for which to show each."""
    settings = learner.settings
    limit = step_limit(learner.environment, settings.rollouts.max_steps)
    env = rendering(learner.environment, limit)
    actor = Actor(learner.policy, env.observation_space, env.action_space, np.random.default_rng(settings.seed))
    stride = 1
    try:
        observation, _ = env.reset(seed=settings.seed)
        frames = [rendered_frame(env)]
        for step in range(1, limit + 1):
            observation, _, terminated, truncated, _ = env.step(actor.act(observation))
            ended = terminated or truncated or step == limit
            if ended or step % stride == 0:
                frames.append(rendered_frame(env))
            if ended:
                break
            if len(frames) == 2 * FRAMES:  # bounds the memory of a long episode
                frames, stride = frames[::2], 2 * stride
    finally:
        if env is not learner.environment:
            env.close()
    return np.stack(frames), 1000 * stride / float(env.metadata.get("render_fps") or 10)


def rendering(environment: gymnasium.Env, limit: int) -> gymnasium.Env:
    """The environment in a mode that renders: made again where its name says how, else the user's object.

    Copies of what has a name end after `limit` steps, as in the rollouts. On Linux without a display MuJoCo is asked to
    render by EGL, unless the environment variable `MUJOCO_GL` says otherwise.

    Raises:
      ValueError: it has no mode `rgb_array`, or is an object in another mode.
    """
    spec, given = made_from(environment), as_given(environment)
    if spec is None and environment.render_mode != "rgb_array" and given_by_name(given):
        spec = given.spec
    if spec is None:
        if environment.render_mode != "rgb_array":
            raise ValueError(f"expected render_mode rgb_array, got {environment.render_mode}")
        return environment
    modes = environment.metadata.get("render_modes") or ()
    if "rgb_array" not in modes:
        raise ValueError(f"expected a mode rgb_array, got {', '.join(modes) or 'none'}")
    own = limit if made_from(environment) is not None else None
    shown = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if "mujoco" in sys.modules and sys.platform == "linux" and not shown:
        os.environ.setdefault("MUJOCO_GL", "egl")  # its way to render without a display
    return flattened(gymnasium.make(spec, max_episode_steps=own, render_mode="rgb_array"))


def rendered_frame(env: gymnasium.Env) -> np.ndarray:
    """The environment's picture of its state, shape (height, width, 3) uint8; `ValueError` where it gives another."""
    frame = np.asarray(env.render())
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
        raise ValueError(f"expected a picture of shape (height, width, 3) in uint8, got {frame.shape} in {frame.dtype}")
    return frame
