"""Which kind of policy suits an environment's spaces."""

from collections.abc import Callable
from functools import partial
from typing import Any

from gymnasium import Space
from gymnasium.spaces import Box, Discrete
from numpy.typing import ArrayLike

from bayespbrl.policies.gaussian_process import GaussianProcessPolicy
from bayespbrl.policies.linear_gaussian import LinearGaussianPolicy
from bayespbrl.policies.policy import Policy
from bayespbrl.policies.softmax import SoftmaxPolicy
from bayespbrl.policies.tabular import TabularPolicy

LEAST_EXPLORATION = 0.01  # share of a tabular policy's choices that stay uniform, which keeps REPS well-conditioned


def initial_policy(
    kind: str,
    observation_space: Space[Any],
    action_space: Space[Any],
    *,
    action_scale: float = 0.75,
    period: ArrayLike | None = None,
) -> Policy:
    """The first policy of a run: as random as the action space allows.

    Args:
      kind: `tabular`, `softmax`, `linear-gaussian`, `gaussian-process`, or `auto`: tabular for discrete states and
        actions, softmax for discrete actions in continuous states, gaussian-process for continuous actions.
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
    least = float(LEAST_EXPLORATION / getattr(action_space, "n", 1))
    kinds: dict[str, Callable[..., Policy]] = {
        "tabular": partial(TabularPolicy.initial, minimum_probability=least),
        "softmax": partial(SoftmaxPolicy.initial, period=period),
        "linear-gaussian": partial(LinearGaussianPolicy.initial, initial_scale=action_scale),
        "gaussian-process": partial(GaussianProcessPolicy.initial, period=period, initial_scale=action_scale),
    }
    if kind not in kinds:
        raise ValueError(f"policy: expected auto, {', '.join(kinds)} to start from, got {kind!r}")
    return kinds[kind](observation_space, action_space)
