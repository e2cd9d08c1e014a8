"""Seconds of features and policy fits by number of samples, and the share of the target that each fit keeps.

    python benchmarks/policy_fit.py [--samples 600 2400 12000 24000] [--repeats 5]

One row for each policy and N. Weights are those of a relative entropy update with bound 0.35 towards a known target.
"gain" is the rise of the expected objective under the fitted policy over that under the weighted samples. Run it on an
idle machine, or with OPENBLAS_NUM_THREADS=1: threads of other processes slow a fit down by a factor of ten.
"""

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from gymnasium.spaces import Box, Discrete
from scipy.optimize import brentq

from bayespbrl.features import RadialBasisOptions, draw_state_action_features, draw_state_features
from bayespbrl.policies import GaussianProcessPolicy, LinearGaussianPolicy, SoftmaxPolicy, sample_actions

KL_BOUND = 0.35
PERIOD = (2 * np.pi, np.inf)
STATES = Box(-np.inf, np.inf, (2,))
TORQUE = Box(-30.0, 30.0, (1,))


def pendulum_states(number: int, rng: np.random.Generator) -> np.ndarray:
    """Random angles and speeds, shape (number, 2)."""
    return np.column_stack([rng.uniform(-np.pi, np.pi, number), 5 * rng.normal(size=number)])


def advantage(states: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """The advantage of each action, best at the torque 25 sin θ − 3 θ̇, with the environment's clipping; shape (N,)."""
    wanted = np.clip(25 * np.sin(states[:, 0]) - 3 * states[:, 1], -30, 30)
    return -np.square((np.clip(actions, -30, 30) - wanted) / 30)


def relative_entropy_weights(values: np.ndarray, base: np.ndarray) -> np.ndarray:
    """p/W ∝ exp(value/η) with KL(p ‖ W) = KL_BOUND, shape (N,); mean one under W."""

    def weights(log_temperature: float) -> np.ndarray:
        unscaled = np.exp((values - values.max()) / np.exp(log_temperature))  # eq. 12
        return unscaled / (base @ unscaled)

    def excess(log_temperature: float) -> float:
        w = weights(log_temperature)
        return float(base @ (w * np.log(np.maximum(w, 1e-300)))) - KL_BOUND

    return weights(brentq(excess, -8, 8))


def timed(function: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Median seconds of `function`, and its last result."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = function()
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds)), result


def seeded_fit(policy: Any, seed: int, *samples: np.ndarray, **options: Any) -> Any:
    """The fitted policy, the same at each repetition."""
    return policy.fit(*samples, rng=np.random.default_rng(seed), **options)


def features_row(number: int, repeats: int, rng: np.random.Generator) -> None:
    """Print the seconds of φ(s) and φ(s, a)."""
    states, actions = pendulum_states(number, rng), rng.uniform(-30, 30, (number, 1))
    options = RadialBasisOptions(700, period=PERIOD)
    phi = draw_state_features(STATES, states, options, rng=rng)
    joint = draw_state_action_features(STATES, TORQUE, states, actions, options, rng=rng)
    state_seconds, _ = timed(lambda: phi(states), repeats)
    joint_seconds, _ = timed(lambda: joint(states, actions), repeats)
    print(f"{number:6d}  φ(s), D = 700: {state_seconds:.3f} s   φ(s, a), Q = 700: {joint_seconds:.3f} s", flush=True)


def continuous_rows(name: str, policy: Any, number: int, repeats: int, rng: np.random.Generator, **options) -> None:
    """Print three updates in a row; the first search starts from the median rule, the others from the last result."""
    states = pendulum_states(number, rng)
    for update in range(3):
        sampling = partial(sample_actions, policy, jax.random.key(update), states)
        sample_seconds, actions = timed(sampling, repeats)
        values = advantage(states, actions[:, 0])
        weights = relative_entropy_weights(values, np.full(number, 1 / number))
        fitting = partial(seeded_fit, policy, update, states, actions, weights, **options)
        fit_seconds, new = timed(fitting, repeats)
        fresh = advantage(states, sample_actions(new, jax.random.key(99), states)[:, 0]).mean()
        gain = (fresh - values.mean()) / ((weights * values).mean() - values.mean())
        print(
            f"{number:6d}  {name:28s} update {update}: fit {fit_seconds:.3f} s  sample {sample_seconds:.3f} s  "
            f"KL(new ‖ old) {new.kl_divergence(policy, states).mean():.3f}  gain {gain:.2f}  "
            f"sd {new.action_standard_deviation(states).mean():.1f}",
            flush=True,
        )
        policy = new


def softmax_rows(number: int, repeats: int, rng: np.random.Generator) -> None:
    """Print three updates in a row with every action of every state, as in the learner."""
    states = pendulum_states(number, rng)
    policy = SoftmaxPolicy.initial(STATES, Discrete(3), period=PERIOD)
    pairs, choices = np.repeat(states, 3, axis=0), np.tile(np.arange(3), number)
    values = advantage(pairs, np.array([-30.0, 0.0, 30.0])[choices])
    for update in range(3):
        base = policy.probabilities(states).ravel() / number
        weights = relative_entropy_weights(values, base)
        fitting = partial(seeded_fit, policy, update, pairs, choices, weights, base_weights=base)
        fit_seconds, new = timed(fitting, repeats)
        rise = (new.probabilities(states).ravel() / number - base) @ values
        print(
            f"{number:6d}  {'softmax':28s} update {update}: fit {fit_seconds:.3f} s  "
            f"KL(new ‖ old) {new.kl_divergence(policy, states).mean():.3f}  "
            f"gain {rise / ((base * weights - base) @ values):.2f}  converged {bool(new.converged)}",
            flush=True,
        )
        policy = new


def main() -> None:
    """Print the rows of each number of samples."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, nargs="+", default=[600, 2400, 12_000, 24_000])
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    for number in arguments.samples:
        rng = np.random.default_rng(0)
        features_row(number, arguments.repeats, rng)
        process = GaussianProcessPolicy.initial(STATES, TORQUE, period=PERIOD, initial_scale=0.9)
        continuous_rows("process", process, number, arguments.repeats, rng)
        continuous_rows("process, hyperparameters kept", process, number, arguments.repeats, rng, evaluations=0)
        linear = LinearGaussianPolicy.initial(STATES, TORQUE, initial_scale=0.9)
        continuous_rows("linear-Gaussian", linear, number, arguments.repeats, rng)
        softmax_rows(number, arguments.repeats, rng)


if __name__ == "__main__":
    main()
