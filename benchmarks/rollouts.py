"""Steps per second of the compiled rollouts, and of the same policy stepped through gymnasium.

    python benchmarks/rollouts.py [gridworld|bicycle|swing-up|acrobot] [--episodes 100] [--seconds 3]

The comparison steps one environment at a time through `gymnasium.make(…).step`, with the policy compiled by itself.
Both sides are warmed up first; the compiled side returns whole trajectories. Prints one JSON line.
"""

import argparse
import json
import time
from dataclasses import dataclass
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box

from bayespbrl.envs.opening import open_environment
from bayespbrl.rollouts import returns, rollout


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RadialPolicy:
    """50 radial basis functions plus noise, about as expensive as a small Gaussian process."""

    centres: np.ndarray
    weights: np.ndarray
    deviation: np.ndarray

    def sample(self, key: jax.Array, observation: jax.Array) -> jax.Array:
        """One action."""
        activity = jnp.exp(-0.5 * jnp.sum((observation - self.centres) ** 2, axis=1))
        return activity @ self.weights + self.deviation * jax.random.normal(key, self.deviation.shape)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TabularPolicy:
    """A table of action probabilities."""

    log_probabilities: np.ndarray

    def sample(self, key: jax.Array, observation: jax.Array) -> jax.Array:
        """One action."""
        return jax.random.categorical(key, self.log_probabilities[observation])


def policy_for(env: gymnasium.Env) -> Any:
    """A fixed policy that fits the environment's spaces."""
    rng = np.random.default_rng(0)
    space: Any = env.action_space
    if not isinstance(space, Box):
        return TabularPolicy(np.log(rng.dirichlet(np.ones(5), size=25)))
    states: Any = env.observation_space
    centres = rng.normal(size=(50, states.shape[0]))
    return RadialPolicy(centres, rng.normal(size=(50, space.shape[0])) * space.high, 0.5 * space.high)


def compiled_steps_per_second(name: str, policy: Any, run: Any, episodes: int, seconds: float) -> float:
    """Environment steps a second of `run` (`rollout` or `returns`), with a new key each time."""
    key = jax.random.key(0)
    run(name, policy, key=key, episodes=episodes)
    steps, repeat, start = 0, 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        repeat += 1
        result = run(name, policy, key=jax.random.fold_in(key, repeat), episodes=episodes)
        steps += int(result.steps.sum()) if run is returns else sum(len(trajectory) for trajectory in result)
    return steps / (time.perf_counter() - start)


def interface_steps_per_second(name: str, policy: Any, seconds: float) -> float:
    """Environment steps a second of the jitted policy in the registered environment, one step at a time."""
    env = open_environment(name)
    sample = jax.jit(lambda policy, key, observation: policy.sample(key, observation))
    split = jax.jit(jax.random.split)
    key = jax.random.key(0)
    observation, _ = env.reset(seed=0)

    def steps_in(seconds: float) -> int:
        nonlocal key, observation
        steps, start = 0, time.perf_counter()
        while time.perf_counter() - start < seconds:
            key, action_key = split(key)
            action = np.asarray(sample(policy, action_key, observation))
            if isinstance(env.action_space, Box):
                action = np.clip(action, env.action_space.low, env.action_space.high)
            observation, _, terminated, truncated, _ = env.step(action)
            steps += 1
            if terminated or truncated:
                observation, _ = env.reset()
        return steps

    with jax.enable_x64(True):
        policy = jax.tree.map(jnp.asarray, policy)
        steps_in(0.5)  # compiles
        return steps_in(seconds) / seconds


def main() -> None:
    """Measure, then print one JSON line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("environment", nargs="?", default="swing-up")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=3.0, help="for each of the three measurements")
    arguments = parser.parse_args()
    name, seconds = arguments.environment, arguments.seconds
    policy = policy_for(open_environment(name))
    interface = interface_steps_per_second(name, policy, seconds)
    whole = compiled_steps_per_second(name, policy, rollout, arguments.episodes, seconds)
    sums = compiled_steps_per_second(name, policy, returns, arguments.episodes, seconds)
    line = {
        "benchmark": "rollouts",
        "environment": name,
        "episodes": arguments.episodes,
        "interface_steps_per_second": round(interface),
        "rollout_steps_per_second": round(whole),
        "returns_steps_per_second": round(sums),
        "ratio_rollout": round(whole / interface, 1),
        "ratio_returns": round(sums / interface, 1),
        "device": jax.devices()[0].platform,
    }
    print(json.dumps(line))


if __name__ == "__main__":
    main()
