"""Step 3: policy × environment → trajectories (paper, step 3), compiled where the environment is pure functions.

An environment with pure functions (`env.unwrapped.dynamics`) and a policy that is a JAX pytree run as one compiled
`lax.scan` over all episodes at once. Anything else is stepped through the ordinary gymnasium interface: as a vector
environment if it was opened by its id (its own one where it has one), else episode by episode.

Continuous actions are clipped to the action space, and the clipped action is the one stored.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.experimental.functional import FuncEnv
from gymnasium.spaces import Box, Discrete
from jax import Array
from jaxtyping import Bool, Float, Int, Key, Shaped

from bayespbrl.checks import whole
from bayespbrl.envs import functional
from bayespbrl.envs.opening import AnyEnvironment, environment_name, open_environment, pure_functions
from bayespbrl.envs.stepping import check_observed, episodes_by_interface, outside_of, step_limit
from bayespbrl.policies.batch import sample_rows
from bayespbrl.policies.policy import AnyArray, Sampler, is_pytree
from bayespbrl.trajectories import Trajectory

_PHASE = 2**31 - 1  # no step of an episode has this number
_COMPILER = {"xla_backend_optimization_level": 1}  # compiles faster, and what it makes runs as fast

# An episode as it runs: the state of the dynamics, which may be any pytree, the observation, and whether it goes on.
Running = tuple[Any, Shaped[Array, "..."], Bool[Array, ""]]


@dataclass(frozen=True)
class Returns:
    """Evaluation of a policy, one entry per episode.

    Attributes:
      total: undiscounted sum of the environment's reward.
      steps: length of the episode.
      terminated: whether it ended in a terminal state (not at the time limit).
    """

    total: Float[np.ndarray, " n"]
    steps: Int[np.ndarray, " n"]
    terminated: Bool[np.ndarray, " n"]


def rollout(
    environment: AnyEnvironment,
    policy: Sampler,
    *,
    key: Key[Array, ""],
    episodes: int,
    max_steps: int | None = None,
    hold: int = 1,
    starts: Sequence[int] | None = None,
) -> tuple[Trajectory, ...]:
    """Trajectories of `episodes` episodes under `policy.sample`.

    Args:
      environment: anything `open_environment` takes.
      policy: its `sample` is JAX-traceable if the policy is a pytree of arrays.
      key: JAX random key; it decides everything, resets included.
      episodes: number of episodes, ≥ 1.
      max_steps: time limit; by default the environment's own, which an object of yours keeps where it is less.
      hold: steps for which the policy's random key stays the same, ≥ 1; where dynamics are compiled, the first block of
        an episode is shorter, at random. Each action still follows the policy at its state. Noise that neighbouring
        steps share leads further away than noise that averages out.
      starts: a seed for the reset of each episode; None: `key` decides on them. An environment that is stepped by the
        gymnasium interface draws its own noise by that seed too.

    Raises:
      ValueError: bad arguments; no time limit known; an environment that raises, or returns NaN or an observation that
        is not one of its discrete space, named with the step.
    """
    env = open_environment(environment)
    steps = _checked_step_limit(env, policy, key, episodes, max_steps)
    whole("hold", hold)
    if starts is not None and len(starts) != episodes:
        raise ValueError(f"starts: expected {episodes}, one for each episode, got {len(starts)}")
    dynamics = _pure_dynamics(env, policy)
    if dynamics is None:
        return tuple(_by_interface(env, policy, key, steps, max_steps is not None, episodes, hold, starts))
    with jax.enable_x64(True):
        keys = jax.random.split(key, episodes)
        reset_keys = keys if starts is None else jax.vmap(jax.random.key)(np.asarray(starts))
        run = _simulate(dynamics, policy, keys, reset_keys, hold, steps=steps)
        observations, actions, rewards, terminated, lengths = (np.asarray(part) for part in run)
    _check_run(env, dynamics, policy, observations, actions, rewards, lengths)
    return tuple(
        Trajectory(states[: length + 1], acts[:length], signal[:length], bool(ended))
        for states, acts, signal, ended, length in zip(observations, actions, rewards, terminated, lengths, strict=True)
    )


def returns(
    environment: AnyEnvironment, policy: Sampler, *, key: Key[Array, ""], episodes: int, max_steps: int | None = None
) -> Returns:
    """Undiscounted returns of the same episodes as `rollout` with the same arguments, without keeping them.

    Raises:
      ValueError: as `rollout`.
    """
    env = open_environment(environment)
    limit = _checked_step_limit(env, policy, key, episodes, max_steps)
    dynamics = _pure_dynamics(env, policy)
    if dynamics is None:
        run = _by_interface(env, policy, key, limit, max_steps is not None, episodes)
        rows = [(trajectory.total_reward, len(trajectory), trajectory.terminated) for trajectory in run]
        return Returns(*(np.array(column) for column in zip(*rows, strict=True)))
    with jax.enable_x64(True):
        evaluated = _evaluate(dynamics, policy, key, limit, episodes=episodes)
        total, steps, terminated, sound = map(np.asarray, evaluated)
    if not sound.all():  # the same episodes so far, whose check says what is wrong
        rollout(env, policy, key=key, episodes=episodes, max_steps=max(int(steps[~sound].min()), 1))
    return Returns(total, steps, terminated)


def reset_seed(key: Key[Array, ""]) -> int:
    """The seed of the first episode's reset where a rollout with `key` steps the gymnasium interface.

    The other episodes' count up from it, but for environments with a vector version of their own.
    """
    with jax.enable_x64(False):  # else the caller's setting would decide
        return int(jax.random.randint(jax.random.split(key)[0], (), 0, 2**30))


def _checked_step_limit(env: gymnasium.Env, policy: object, key: object, episodes: int, max_steps: int | None) -> int:
    if not callable(getattr(policy, "sample", None)):
        raise ValueError(f"policy: expected an object with sample(key, observation), got {type(policy).__name__}")
    if not isinstance(key, jax.Array):
        raise ValueError(f"key: expected a JAX random key, got {type(key).__name__}")
    whole("episodes", episodes)
    return step_limit(env, max_steps)


def _pure_dynamics(env: gymnasium.Env, policy: Sampler) -> FuncEnv | None:
    """The pure functions of the environment; None where it has others, or the policy cannot be compiled with them."""
    dynamics = pure_functions(env) if is_pytree(policy) else None
    if dynamics is not None:
        functional.check(dynamics, environment_name(env))
    return dynamics


def _check_run(
    env: gymnasium.Env,
    dynamics: FuncEnv,
    policy: Sampler,
    observations: Shaped[np.ndarray, "n t1 ..."],
    actions: Shaped[np.ndarray, "n t ..."],
    rewards: Float[np.ndarray, "n t"],
    lengths: Int[np.ndarray, " n"],
) -> None:
    """Check a run of pure functions, and name what went wrong first: of NaN the policy can only make more NaN.

    An action outside a discrete space would be taken as the nearest by JAX.
    """
    flat = observations.reshape(-1, *observations.shape[2:])
    bad = ~np.isfinite(flat).reshape(len(flat), -1).all(axis=1) | outside_of(dynamics.observation_space, flat)
    bad = bad.reshape(observations.shape[:2])
    bad[:, 1:] |= ~np.isfinite(rewards)
    first = int(np.argmax([*bad.any(axis=0), True]))  # the environment's step; 0 is the reset
    taken = actions[:, :first]
    _check_of_space(policy, dynamics.action_space, taken[np.arange(taken.shape[1]) < lengths[:, None]])
    if first < bad.shape[1]:
        where = f"step {first}" if first else "its reset"
        check_observed(env, where, observations[:, first], rewards[:, first - 1 : first])


def _check_of_space(policy: Sampler, space: gymnasium.Space[Any], actions: Shaped[np.ndarray, "n ..."]) -> None:
    """Check actions, one a row; those beyond the bounds of a `Box` are taken at the bounds."""
    if not np.isfinite(actions).all():
        raise ValueError(f"policy {type(policy).__name__}: expected finite actions, got NaN or infinity")
    fits = np.prod(actions.shape[1:]) == np.prod(space.shape or ())
    outside = outside_of(space, actions) if fits else np.ones(len(actions), bool)
    if outside.any():
        raise ValueError(f"policy {type(policy).__name__}: expected actions of {space}, got {actions[outside][0]}")


def _start(dynamics: FuncEnv, key: Key[Array, ""]) -> tuple[Running, Key[Array, ""]]:
    start_key, steps_key = jax.random.split(key)
    state, observation = functional.reset(dynamics, start_key)
    state = jax.tree.map(jnp.asarray, state)  # a Python number too
    state = _of_later_types(dynamics, start_key, state)
    return (state, _wide(dynamics, observation), jnp.asarray(True)), steps_key


def _of_later_types(dynamics: FuncEnv, key: Key[Array, ""], state: Any) -> Any:
    """A first state with the types of later ones: whole numbers may become others after a step."""
    later = jax.eval_shape(partial(functional.step, dynamics), key, state, functional.zero_action(dynamics))[0]
    return jax.tree.map(lambda a, b: a if a.dtype == b.dtype else a.astype(b.dtype), state, later)


def _advance(
    dynamics: FuncEnv,
    policy: Sampler,
    running: Running,
    steps_key: Key[Array, ""],
    t: Int[AnyArray, ""],
    drawn: Int[Array, ""] | None = None,
) -> tuple[Running, tuple[Shaped[Array, "..."], Float[Array, ""], Bool[Array, ""], Bool[Array, ""]]]:
    """One step of one episode: the next state, and action, reward, whether it terminated, whether it was running.

    An episode that has ended stays as it is and earns nothing. The action draws the noise of step `drawn`; of its own
    when None.
    """
    state, observation, alive = running
    action_key, transition_key = jax.random.split(jax.random.fold_in(steps_key, t))
    if drawn is not None:
        action_key, _ = jax.random.split(jax.random.fold_in(steps_key, drawn))
    action = _clipped(dynamics.action_space, policy.sample(action_key, observation))
    next_state, next_observation, reward, terminated = functional.step(dynamics, transition_key, state, action)

    def kept(new: AnyArray, old: Array) -> Array:
        return jnp.where(alive, new, old).astype(old.dtype)

    next_state = jax.tree.map(kept, next_state, jax.tree.map(jnp.asarray, state))
    next_observation = kept(_wide(dynamics, next_observation), observation)
    terminated = alive & jnp.asarray(terminated, bool)
    outcome = (action, jnp.where(alive, jnp.asarray(reward, float), 0.0), terminated, alive)
    return (next_state, next_observation, alive & ~terminated), outcome


@partial(jax.jit, static_argnames=("dynamics", "steps"), compiler_options=_COMPILER)
def _simulate(
    dynamics: FuncEnv,
    policy: Sampler,
    keys: Key[Array, " n"],
    reset_keys: Key[Array, " n"],
    hold: int,
    *,
    steps: int,
) -> tuple[Array, ...]:
    """Observations, actions, rewards, whether it terminated and length of each episode."""

    def episode(key: Key[Array, ""], reset_key: Key[Array, ""]) -> tuple[Array, ...]:
        running, _ = _start(dynamics, reset_key)
        _, steps_key = jax.random.split(key)
        first = running[1]
        phase = jax.random.randint(jax.random.fold_in(steps_key, _PHASE), (), 0, hold)

        def scan_step(running: Running, t: Int[Array, ""]) -> tuple[Running, tuple[Array, ...]]:
            drawn = jnp.maximum((t + phase) // hold * hold - phase, 0)
            running, outcome = _advance(dynamics, policy, running, steps_key, t, drawn)
            return running, (running[1], *outcome)

        _, (observations, actions, rewards, terminated, alive) = jax.lax.scan(scan_step, running, jnp.arange(steps))
        return jnp.concatenate([first[None], observations]), actions, rewards, terminated.any(), alive.sum()

    return jax.vmap(episode)(keys, reset_keys)


@partial(jax.jit, static_argnames=("dynamics", "episodes"), compiler_options=_COMPILER)
def _evaluate(
    dynamics: FuncEnv, policy: Sampler, key: Key[Array, ""], steps: int, *, episodes: int
) -> tuple[Array, ...]:
    """Sums, and whether `_check_run` would find nothing, until every episode has ended; new `steps` compile nothing."""
    running, steps_keys = jax.vmap(partial(_start, dynamics))(jax.random.split(key, episodes))
    advance = jax.vmap(partial(_advance, dynamics, policy), in_axes=(0, 0, None))

    def loop_step(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        t, (state, observation, alive), total, length, terminated, sound = carry
        (state, observation, still), (action, reward, ended, _) = advance((state, observation, alive), steps_keys, t)
        sound &= jnp.isfinite(reward) & _within(dynamics.observation_space, observation)
        sound &= _within(dynamics.action_space, action) | ~alive
        length = length + alive
        return t + 1, (state, observation, still & sound), total + reward, length, terminated | ended, sound

    def goes_on(carry: tuple[Any, ...]) -> Bool[Array, ""]:
        return (carry[0] < steps) & carry[1][2].any()

    sound, none = _within(dynamics.observation_space, running[1]), jnp.zeros(episodes)
    running = (*running[:2], running[2] & sound)
    carry = (jnp.asarray(0), running, none, none.astype(int), none.astype(bool), sound)
    return jax.lax.while_loop(goes_on, loop_step, carry)[2:]


def _within(space: gymnasium.Space[Any], values: Shaped[Array, "n ..."]) -> Bool[Array, " n"]:
    """Which rows are of a `Discrete` space that counts from 0, or finite; the bounds of a `Box` are not looked at."""
    within = (values >= 0) & (values < space.n) if isinstance(space, Discrete) else jnp.isfinite(values)
    return within.reshape(len(values), -1).all(axis=1)


def _wide(dynamics: FuncEnv, observation: Shaped[AnyArray, "..."]) -> Shaped[Array, "..."]:
    return jnp.asarray(observation).astype(float if isinstance(dynamics.observation_space, Box) else int)


def _clipped(space: gymnasium.Space[Any], action: Shaped[AnyArray, "..."]) -> Shaped[Array, "..."]:
    if not isinstance(space, Box):
        return jnp.asarray(action).astype(int)
    low, high = np.asarray(space.low, float), np.asarray(space.high, float)
    return jnp.clip(jnp.reshape(jnp.asarray(action, float), space.shape), low, high)


@jax.jit
def _act(
    policy: Sampler, key: Key[Array, ""], counter: int, observations: Shaped[AnyArray, "n ..."]
) -> Shaped[Array, "n ..."]:
    keys = jax.random.split(jax.random.fold_in(key, counter), len(observations))
    return sample_rows(policy, keys, observations)


def _act_one_by_one(
    policy: Sampler, key: Key[Array, ""], counter: int, observations: Shaped[np.ndarray, "n ..."]
) -> Shaped[np.ndarray, "n ..."]:
    """Actions of a policy that is an ordinary Python object."""
    keys = jax.random.split(jax.random.fold_in(key, counter), len(observations))
    return np.stack([np.asarray(policy.sample(*pair)) for pair in zip(keys, observations, strict=True)])


def _by_interface(
    env: gymnasium.Env,
    policy: Sampler,
    key: Key[Array, ""],
    steps: int,
    explicit: bool,
    episodes: int,
    hold: int = 1,
    starts: Sequence[int] | None = None,
) -> Iterator[Trajectory]:
    policy_key = jax.random.split(key)[1]
    choose = _act if is_pytree(policy) else _act_one_by_one
    blocks = -(-steps // hold)  # of an episode: none is shared with the next

    def act(first: int, step: int, observations: Shaped[np.ndarray, "n ..."]) -> Shaped[np.ndarray, "n ..."]:
        with jax.enable_x64(True):
            actions = np.asarray(choose(policy, policy_key, first * blocks + step // hold, observations))
        _check_of_space(policy, env.action_space, actions)
        return actions

    time_limit = steps if explicit else None
    seeds = reset_seed(key) if starts is None else starts
    for states, actions, rewards, terminated in episodes_by_interface(
        env, act, seeds=seeds, episodes=episodes, steps=steps, time_limit=time_limit
    ):
        yield Trajectory(states, actions, rewards, terminated)
