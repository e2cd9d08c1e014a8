"""A trajectory's episode once more, rendered by the environment itself in its mode `rgb_array`."""

from collections.abc import Iterator

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from jaxtyping import Int
from PIL import Image

from bayespbrl.envs.functional import FunctionalEnv
from bayespbrl.learner import Learner
from bayespbrl.runs.film import rendered_frame, rendering
from bayespbrl.trajectories import Trajectory


def replayed(
    learner: Learner, number: int, trajectory: Trajectory, shown: Int[np.ndarray, " f"]
) -> list[Image.Image] | None:
    """Pictures of the states `shown` of trajectory `number`, in increasing order.

    The environment is reset with the trajectory's seed and does its actions again, up to the last of these states.
    Returns None where that does not lead to the same observations, bit for bit, or where the environment does not
    render.

    Args:
      trajectory: all of it, also where a question is about a part: an episode begins at its reset.
    """
    if isinstance(learner.environment.unwrapped, FunctionalEnv):
        return None  # it draws by `draw`, which needs no episode
    try:
        env = rendering(learner.environment)
    except Exception:  # whatever an environment of the user's raises: there are plots
        return None
    wanted, pictures = set(map(int, shown)), []
    try:
        for step, same in enumerate(_observed(env, learner.cycle.reset_seed(number), trajectory)):
            if not same:
                return None
            if step in wanted:
                pictures.append(Image.fromarray(rendered_frame(env)))
            if len(pictures) == len(wanted):
                break
    except Exception:  # as above
        return None
    finally:
        if env is not learner.environment:
            env.close()
    return pictures


def _observed(env: gymnasium.Env, seed: int, trajectory: Trajectory) -> Iterator[bool]:
    """For each state of the trajectory whether the environment comes to the same."""
    space = env.action_space
    observation, _ = env.reset(seed=seed)
    yield np.array_equal(np.asarray(observation), trajectory.states[0])
    for action, state in zip(trajectory.actions, trajectory.states[1:], strict=True):
        taken = action.astype(space.dtype) if isinstance(space, Box) else np.int64(action)
        observation = env.step(taken)[0]
        yield np.array_equal(np.asarray(observation), state)
