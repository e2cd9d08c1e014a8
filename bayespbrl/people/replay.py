"""A trajectory's episode once more, rendered by the environment itself in its mode `rgb_array`."""

import warnings
from collections.abc import Iterator

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from jaxtyping import Int
from PIL import Image

from bayespbrl import checks
from bayespbrl.envs.functional import FunctionalEnv
from bayespbrl.envs.opening import environment_name, made_from
from bayespbrl.learner import Learner
from bayespbrl.runs.film import rendered_frame, rendering
from bayespbrl.trajectories import Trajectory

NOT_REPEATED = "reset with the same seed, it does not repeat its episode"


def replayed(
    learner: Learner, number: int, trajectory: Trajectory, shown: Int[np.ndarray, " f"]
) -> list[Image.Image] | None:
    """Pictures of the states `shown` of trajectory `number`, in increasing order.

    The environment is reset with the trajectory's seed and does its actions again, up to the last of these states.
    Returns None where the environment does not render, and, with a warning, where it fails to or where that does not
    lead to the same observations, bit for bit.

    Args:
      trajectory: all of it, also where a question is about a part: an episode begins at its reset.
    """
    environment = learner.environment
    if isinstance(environment.unwrapped, FunctionalEnv):
        return None  # it draws by `draw`, which needs no episode
    if "rgb_array" not in (environment.render_mode, *(environment.metadata.get("render_modes") or ())):
        return None
    if learner.comparable_starts is False:  # then even to try would change the next episode
        _warn(environment, NOT_REPEATED)
        return None
    try:
        env = rendering(environment, max(len(trajectory), 1))
    except Exception as error:  # whatever an environment of the user's raises: there are plots
        _warn(environment, checks.reason(error))
        return None
    wanted, pictures = set(map(int, shown)), []
    try:
        for step, same in enumerate(_observed(env, learner.cycle.reset_seed(number), trajectory)):
            if not same:
                spec, limit = made_from(environment), learner.settings.rollouts.max_steps
                shared = spec is not None and spec.vector_entry_point is not None and limit is None
                what = "its own vector version, which collects, shares random numbers" if shared else NOT_REPEATED
                _warn(environment, what)
                return None
            if step in wanted:
                pictures.append(Image.fromarray(rendered_frame(env)))
            if len(pictures) == len(wanted):
                break
    except Exception as error:  # as above
        _warn(environment, checks.reason(error))
        return None
    finally:
        if env is not environment:
            env.close()
    return pictures


def _warn(environment: gymnasium.Env, reason: str) -> None:
    """Say why there are no pictures of what should render."""
    warnings.warn(f"{environment_name(environment)} is not rendered but plotted: {reason}", stacklevel=2)


def _observed(env: gymnasium.Env, seed: int, trajectory: Trajectory) -> Iterator[bool]:
    """For each state of the trajectory whether the environment comes to the same, in the type of its space."""
    space, kind = env.action_space, env.observation_space.dtype
    observation, _ = env.reset(seed=seed)
    yield np.array_equal(np.asarray(observation).astype(kind), trajectory.states[0])
    for action, state in zip(trajectory.actions, trajectory.states[1:], strict=True):
        taken = action.astype(space.dtype) if isinstance(space, Box) else np.int64(action)
        observation = env.step(taken)[0]
        yield np.array_equal(np.asarray(observation).astype(kind), state)
