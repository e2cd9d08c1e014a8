"""Episodes through the ordinary gymnasium interface, for environments that offer no pure functions."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.functional_jax_env import FunctionalJaxVectorEnv
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers import TimeLimit
from jaxtyping import Bool, Float, Shaped
from numpy.typing import ArrayLike

from bayespbrl.checks import one_line, shortened, whole
from bayespbrl.envs.functional import FunctionalEnv
from bayespbrl.envs.opening import (
    AnyEnvironment,
    as_given,
    environment_attribute,
    environment_name,
    flattened,
    layers,
    made_from,
    open_environment,
    plainly_wrapped,
)

MAX_LANES = 128  # copies of an environment stepped side by side
PROBES = 10  # episodes of random actions
Rows = Shaped[np.ndarray, "n ..."]
Episode = tuple[Rows, Rows, Float[np.ndarray, " t"], bool]


def step_limit(environment: AnyEnvironment, max_steps: int | None = None) -> int:
    """The time limit that holds: `max_steps`, else the `TimeLimit` wrapper's, else the spec's, else the dynamics'.

    An object of the user's, of which there are no copies with another limit, keeps its own where that is less.
    """
    env = open_environment(environment)
    wrapped = [layer._max_episode_steps for layer in layers(env) if isinstance(layer, TimeLimit)]
    if max_steps is not None:
        pure = isinstance(env.unwrapped, FunctionalEnv) and plainly_wrapped(env)
        own = [] if made_from(env) is not None or pure else wrapped
        return min([whole("max_steps", max_steps), *own])
    limits: list[int | None] = [min(wrapped, default=None)]
    limits.append(env.spec.max_episode_steps if env.spec is not None else None)
    limits.append(environment_attribute(env, "max_episode_steps"))
    for limit in limits:
        if limit is not None:
            return int(limit)
    raise ValueError(f"max_steps: expected a number, because {environment_name(env)} has no time limit, got None")


def of_whole_episodes(env: gymnasium.Env, name: str, max_steps: int | None = None) -> Any:
    """`optimal_return` or `published_returns` of the environment; None without, and where episodes have another length.

    Args:
      env: opened.
      name: of the dynamics' attribute, which is about their own time limit.
      max_steps: as of `step_limit`.
    """
    limit = environment_attribute(env, "max_episode_steps")
    other = max_steps is not None and limit is not None and step_limit(env, max_steps) != limit
    return None if other else environment_attribute(env, name)


def episodes_by_interface(
    env: gymnasium.Env,
    act: Callable[[int, int, Rows], Rows],
    *,
    seeds: int | Sequence[int],
    episodes: int,
    steps: int,
    time_limit: int | None = None,
) -> Iterator[Episode]:
    """`(states, actions, rewards, terminated)` of each episode, the arrays as in a trajectory.

    Args:
      env: from `open_environment`. If that made it from an id, copies run side by side; else the object itself, one
        episode after the other.
      act: `act(first, step, observations) -> actions` for a batch of episodes, from number `first` on.
      seeds: of each episode's reset; one number is that of the first, and the others count up from it.
      steps: cap on the length of an episode.
      time_limit: replaces the environment's own limit where copies are made.

    Raises:
      ValueError: the environment raised, or returned a number that is not finite or an observation that is not one of
        its discrete space; names it and the step.
    """
    lanes = min(episodes, MAX_LANES) if made_from(env) is not None else 1
    with _blaming(environment_name(env), "making copies of it, which an object of it does without"):
        vector = _copies(env, lanes, time_limit, one_by_one=not isinstance(seeds, int))
    try:
        for first in range(0, episodes, lanes):
            if isinstance(seeds, int):
                reset: int | list[int] = seeds + first
            else:  # the last lanes may have no episode left
                reset = [int(seeds[min(first + lane, episodes - 1)]) for lane in range(lanes)]
            vector_episodes = _batch(vector, env, act, seed=reset, first=first, steps=steps)
            yield from vector_episodes[: episodes - first]
    finally:
        vector.close()


def random_episodes(env: gymnasium.Env, most: int, hold: int = 1, *, time_limit: int | None = None) -> list[Rows]:
    """The states of a few episodes of random actions, the same at every call.

    Args:
      most: steps after which an episode is cut.
      hold: steps for which an action is repeated.
      time_limit: as in `episodes_by_interface`.

    Raises:
      ValueError: as `episodes_by_interface`.
    """
    space = deepcopy(env.action_space)
    space.seed(0)
    held = np.empty(0)

    def act(first: int, step: int, observations: Rows) -> Rows:
        nonlocal held
        if step % hold == 0:
            held = np.stack([np.asarray(space.sample()) for _ in observations])
        return held

    drawn = episodes_by_interface(env, act, seeds=0, episodes=PROBES, steps=most, time_limit=time_limit)
    return [states for states, _, _, _ in drawn]


class _Silent(gymnasium.Wrapper):
    """One episode after each reset with a seed, without infos.

    Nobody reads infos, and copies side by side fail where theirs are of different form. A copy whose episode has ended
    waits for the others: it returns its last observation, and nothing is stepped.
    """

    _last: Any = None  # observation of an episode that has ended

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """The observation alone; without a seed, as copies reset themselves after an episode, its last one."""
        if seed is None and self._last is not None:
            return self._last, {}
        self._last = None
        returned = self.env.reset(seed=seed, options=options)
        if not isinstance(returned, tuple) or len(returned) != 2:
            raise ValueError(f"expected (observation, info), got {shortened(returned)}")
        return self._observed(returned[0]), {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """A step without its info; NumPy would make NaN of a reward that is None."""
        if self._last is not None:
            return self._last, 0.0, False, False, {}
        returned = self.env.step(action)
        if not isinstance(returned, tuple) or len(returned) != 5:
            raise ValueError(f"expected (observation, reward, terminated, truncated, info), got {shortened(returned)}")
        observation, reward, terminated, truncated, _ = returned
        if reward is None or np.asarray(reward).ndim:
            raise ValueError(f"expected a number as the reward, got {reward!r}")
        observation = self._observed(observation)
        self._last = observation if terminated or truncated else None
        return observation, reward, terminated, truncated, {}

    def _observed(self, observation: Any) -> Any:
        if np.shape(observation) != self.observation_space.shape:
            shape = self.observation_space.shape
            raise ValueError(f"expected an observation of shape {shape}, got {shortened(observation)}")
        return observation


class _Borrowed(_Silent):
    """The user's own environment, which is not closed with its copies."""

    def close(self) -> None:
        """Nothing."""


def _copies(env: gymnasium.Env, lanes: int, time_limit: int | None, *, one_by_one: bool) -> VectorEnv:
    """Copies side by side; `one_by_one` where each has to be reset with a seed of its own."""
    spec = made_from(env)
    if spec is None:
        return SyncVectorEnv([lambda: _Borrowed(env)])
    options: dict[str, Any] = {} if time_limit is None else {"max_episode_steps": time_limit}
    if (
        spec.vector_entry_point is not None
        and not (options or one_by_one)
        and not spec.additional_wrappers
        and flattened(env.unwrapped) is env.unwrapped
    ):
        vector = gymnasium.make_vec(spec, num_envs=lanes)
        if _like_copies(vector, env):
            return vector
        vector.close()
    wrappers: list[Any] = [flattened, _Silent]
    return gymnasium.make_vec(spec, num_envs=lanes, vectorization_mode="sync", wrappers=wrappers, **options)


def _like_copies(vector: VectorEnv, env: gymnasium.Env) -> bool:
    """Whether an environment's own vector version does what copies of it would do side by side."""
    if isinstance(vector.unwrapped, FunctionalJaxVectorEnv):  # where one lane is reset, the others stay where they were
        return False
    # In the other modes the last observation of an episode is hidden, or a reset is due that not all of them allow.
    if vector.metadata.get("autoreset_mode") != AutoresetMode.NEXT_STEP:
        return False
    lane = (vector.single_observation_space, vector.single_action_space)
    return lane == (env.observation_space, env.action_space)


def _batch(
    vector: VectorEnv,
    env: gymnasium.Env,
    act: Callable[[int, int, Rows], Rows],
    *,
    seed: int | list[int],
    first: int,
    steps: int,
) -> list[Episode]:
    """One episode a lane, from episode `first` on; `env` is the one that `vector` copies.

    A lane that has ended is ignored: a copy waits, and in a vector version of the environment's own it goes on.
    """
    lanes, seen, done = vector.num_envs, vector.single_observation_space, vector.single_action_space
    name = environment_name(env)
    with _blaming(name, "its reset"):
        observations, _ = vector.reset(seed=seed)  # type: ignore[arg-type]  # copies take a list too
    alive, ended, lengths = np.ones(lanes, bool), np.zeros(lanes, bool), np.zeros(lanes, int)
    states, actions, rewards = [check_observed(env, "its reset", _wide(seen, observations))], [], []
    t = 0
    while t < steps and alive.any():
        actions.append(_within(done, act(first, t, _of_running(alive, states[-1], states[0]))))
        t += 1
        with _blaming(name, f"step {t}"):
            observations, reward, terminated, truncated, _ = vector.step(actions[-1].copy())  # which it may change
        check_observed(env, f"step {t}", _wide(seen, observations)[alive], np.asarray(reward)[alive])
        states.append(_wide(seen, observations))
        rewards.append(np.array(reward, float))  # a copy: the environment may write to its own anew
        lengths += alive
        ended |= alive & terminated
        alive &= ~(terminated | truncated)
    table = np.stack(states), _wide(done, np.stack(actions)), np.stack(rewards)
    return [
        (table[0][: n + 1, i].copy(), table[1][:n, i].copy(), table[2][:n, i].copy(), bool(ended[i]))
        for i, n in enumerate(lengths)
    ]


def _of_running(alive: Bool[np.ndarray, " n"], now: Rows, first: Rows) -> Rows:
    """The observations to act on; a lane that has ended shows its first, as a policy may not be defined at its last."""
    return np.where(alive.reshape(-1, *[1] * (now.ndim - 1)), now, first)


def _wide(space: gymnasium.Space[Any], values: ArrayLike) -> Rows:
    return np.asarray(values).astype(float if isinstance(space, Box) else np.int64)


def _within(space: gymnasium.Space[Any], actions: Rows) -> Rows:
    if isinstance(space, Box):
        return np.clip(actions.reshape(len(actions), -1), space.low, space.high).astype(space.dtype)
    return np.asarray(actions).astype(np.int64)


def check_observed(env: gymnasium.Env, where: str, observations: Rows, *rewards: Rows) -> Rows:
    """Rows of observations, with rewards, as they are; `ValueError` for one that is not finite or of the space."""
    if not all(np.isfinite(values).all() for values in (observations, *rewards)):
        raise ValueError(
            f"environment {environment_name(env)}: expected finite observations and rewards, got NaN or infinity at "
            f"{where}"
        )
    if (outside := outside_of(env.observation_space, observations)).any():
        space = as_given(env).observation_space
        number = observations[outside][0] + getattr(space, "start", 0)
        raise ValueError(
            f"environment {environment_name(env)}: expected observations of {space}, got {number} at {where}"
        )
    return observations


def outside_of(space: gymnasium.Space[Any], observations: Rows) -> Bool[np.ndarray, "..."]:
    """Which are none of a `Discrete` space that counts from 0; the bounds of a `Box` are not looked at."""
    if not isinstance(space, Discrete):
        return np.zeros(len(observations), bool)
    return (observations < 0) | (observations >= space.n) | (observations != np.floor(observations))


@contextmanager
def _blaming(name: str, where: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        raise ValueError(f"environment {name} failed at {where}: {type(error).__name__}: {one_line(error)}") from error
