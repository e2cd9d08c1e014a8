"""Which kind of policy suits an environment's spaces."""

from typing import Any

from gymnasium import Space
from gymnasium.spaces import Box, Discrete

from bayespbrl.policies.gaussian_process import GaussianProcessPolicy
from bayespbrl.policies.linear_gaussian import LinearGaussianPolicy
from bayespbrl.policies.softmax import SoftmaxPolicy
from bayespbrl.policies.tabular import TabularPolicy

# Share of a tabular policy's choices that stay uniform. On the Gridworld it costs 0.2 % of the optimum (the known
# reward ends at 0.998) and keeps the dual well-conditioned; without it one fit in 500 failed.
LEAST_EXPLORATION = 0.01


def initial_policy(
    kind: str, observation_space: Space, action_space: Space, *, action_scale: float = 0.75, period: Any = None
) -> Any:
    """The first policy of a run: as random as the action space allows.

    Args:
      kind: `tabular`, `softmax`, `linear-gaussian`, `gaussian-process`, or `auto`: tabular for discrete states and
        actions, softmax for discrete actions in continuous states, gaussian-process for continuous actions.
      action_scale: standard deviation of a continuous policy, in ranges of the action space.
      period: of each observation dimension, infinite where not periodic; None for none.

    Raises:
      ValueError: a kind there is not, or spaces that it does not suit.
    """
    if kind == "auto":
        if isinstance(action_space, Box):
            kind = "gaussian-process"
        else:
            kind = "tabular" if isinstance(observation_space, Discrete) else "softmax"
    match kind:
        case "tabular":
            least = LEAST_EXPLORATION / getattr(action_space, "n", 1)
            return TabularPolicy.initial(observation_space, action_space, minimum_probability=float(least))
        case "softmax":
            return SoftmaxPolicy.initial(observation_space, action_space, period=period)
        case "linear-gaussian":
            return LinearGaussianPolicy.initial(observation_space, action_space, initial_scale=action_scale)
        case "gaussian-process":
            return GaussianProcessPolicy.initial(
                observation_space, action_space, period=period, initial_scale=action_scale
            )
    raise ValueError(
        f"policy: expected auto, tabular, softmax, linear-gaussian or gaussian-process to start from, got {kind!r}"
    )
