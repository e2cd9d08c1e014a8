"""Which kind of policy suits an environment's spaces."""

from collections.abc import Callable
from typing import Any, cast

import jax
import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box, Discrete
from numpy.typing import ArrayLike

from bayespbrl import checks
from bayespbrl.policies.batch import entropies
from bayespbrl.policies.gaussian_process import GaussianProcessPolicy
from bayespbrl.policies.linear_gaussian import LinearGaussianPolicy
from bayespbrl.policies.policy import ContinuousPolicy, Policy, has_mode, is_discrete, is_pytree
from bayespbrl.policies.softmax import SoftmaxPolicy
from bayespbrl.policies.tabular import TabularPolicy

Spaces = tuple[Space[Any], Space[Any]]  # of observations, of actions
LEAST_EXPLORATION = 0.01  # share of a tabular policy's choices that stay uniform, which keeps REPS well-conditioned
# The kinds of policies by name: from the spaces, the scale of continuous actions and the period of each observation.
POLICIES: dict[str, Callable[[Spaces, float, ArrayLike | None], Policy]] = {
    "tabular": lambda spaces, scale, period: TabularPolicy.initial(
        *spaces, minimum_probability=float(LEAST_EXPLORATION / getattr(spaces[1], "n", 1))
    ),
    "softmax": lambda spaces, scale, period: SoftmaxPolicy.initial(*spaces, period=period),
    "linear-gaussian": lambda spaces, scale, period: LinearGaussianPolicy.initial(*spaces, initial_scale=scale),
    "gaussian-process": lambda spaces, scale, period: GaussianProcessPolicy.initial(
        *spaces, period=period, initial_scale=scale
    ),
}


def initial_policy(
    kind: str,
    observation_space: Space[Any],
    action_space: Space[Any],
    *,
    action_scale: float,
    period: ArrayLike | None = None,
) -> Policy:
    """The first policy of a run: as random as the action space allows.

    Args:
      kind: a name of `POLICIES`, or `auto`: tabular for discrete states and actions, softmax for discrete actions in
        continuous states, gaussian-process for continuous actions.
      action_scale: standard deviation of a continuous policy, in ranges of the action space.
      period: of each observation dimension, infinite where not periodic; None for none.

    Raises:
      ValueError: unknown kind, or spaces that do not suit it.
    """
    if kind == "auto":
        if isinstance(action_space, Box):
            kind = "gaussian-process"
        else:
            kind = "tabular" if isinstance(observation_space, Discrete) else "softmax"
    if kind not in POLICIES:
        raise ValueError(f"policy: expected one of auto, {', '.join(POLICIES)}, got {kind!r}")
    try:
        return POLICIES[kind]((observation_space, action_space), action_scale, period)
    except ValueError as error:
        raise ValueError(f"policy {kind}: {error}") from error


def expected_policy(given: object) -> str:
    """What was expected where something was given that is no policy, for an error."""
    if isinstance(given, type):
        return f"a policy, an object, got the class {given.__name__}"
    methods = ("sample", "entropy", "kl_divergence", "fit")
    if (lacks := [name for name in methods if not hasattr(given, name)]) and len(lacks) < len(methods):
        return f"a policy (bayespbrl.policies.Policy), got a {type(given).__name__} without {', '.join(lacks)}"
    return f"a policy (bayespbrl.policies) or a kind by name, got {checks.shortened(given)}"


def fitting(
    policy: Policy, observation_space: Space[Any], action_space: Space[Any], *, noise_free: bool = False
) -> Policy:
    """`policy`, tried at one observation.

    Raises:
      ValueError: one that does not take the observations of the one space, does not give the actions of the other,
        lacks what an update needs of it, or is to be shown `noise_free` and does not know its most probable action.
    """
    if noise_free and not has_mode(policy):
        raise ValueError(f"policy: expected one with a mode because of noise_free, got a {type(policy).__name__}")
    if isinstance(observation_space, Discrete):
        observation = np.asarray(observation_space.n - 1)  # the last: a smaller table has no row for it
    else:
        bounds = cast(Box, observation_space)
        observation = np.asarray(np.clip(0.5, bounds.low, bounds.high), np.float64)
    expected: tuple[int, ...] = action_space.shape or (1, getattr(action_space, "n", 1))
    try:
        if isinstance(action_space, Discrete) != is_discrete(policy):
            got: object = f"actions that are {'' if is_discrete(policy) else 'not '}discrete"
        elif is_discrete(policy):
            chances = np.asarray(policy.probabilities(observation[None]))
            got = chances.shape
            if got == expected and not (np.all(chances >= 0) and np.isclose(chances.sum(), 1, atol=1e-3)):
                raise ValueError(f"probabilities {checks.shortened(chances[0].tolist())}")
        else:
            got = np.asarray(policy.sample(jax.random.key(0), observation)).shape
        if got == expected:  # what the first update needs
            if not is_pytree(policy):
                raise ValueError("one that is no JAX pytree of arrays")
            entropies(policy, observation[None])
            if not is_discrete(policy):
                cast(ContinuousPolicy, policy).action_standard_deviation(observation[None])
    except Exception as error:
        got = checks.reason(error)
    if got != expected:
        raise ValueError(f"policy: expected one from {observation_space} to {action_space}, got {got}")
    return policy
