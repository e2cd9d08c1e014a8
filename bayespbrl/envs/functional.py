"""Pure environment functions as a gymnasium environment; step 3 needs both views of the same dynamics.

`reset` and `step` fix how one key is shared among the functions of a `FuncEnv`; the gymnasium class below and the
compiled rollouts both go through them, so that the two views cannot drift apart.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, Protocol

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.experimental.functional import FuncEnv
from gymnasium.spaces import Box
from jax import Array
from jaxtyping import Key, Shaped, UInt8

from bayespbrl.checks import one_line
from bayespbrl.figures import new_figure, pixels

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class Drawn(Protocol):
    """The part of a trajectory that is drawn: states (T+1, …), number of steps, how it ended."""

    @property
    def states(self) -> Shaped[np.ndarray, "t1 ..."]: ...
    @property
    def terminated(self) -> bool: ...
    def __len__(self) -> int: ...


def reset(dynamics: FuncEnv, key: Key[Array, ""]) -> tuple[Any, Any]:
    """Start an episode: `(state, observation)`. Traceable; follows its caller's dtype."""
    initial_key, observation_key = jax.random.split(key)
    state = dynamics.initial(initial_key)
    return state, dynamics.observation(state, observation_key)


def step(dynamics: FuncEnv, key: Key[Array, ""], state: Any, action: Any) -> tuple[Any, Any, Any, Any]:
    """One step: `(next_state, observation, reward, terminated)`. Traceable; follows its caller's dtype.

    The action is passed on as it comes; the caller or the dynamics clip it to the action space.
    """
    transition_key, observation_key, reward_key, terminal_key = jax.random.split(key, 4)
    next_state = dynamics.transition(state, action, transition_key)
    observation = dynamics.observation(next_state, observation_key)
    reward = dynamics.reward(state, action, next_state, reward_key)
    return next_state, observation, reward, dynamics.terminal(next_state, terminal_key)


def zero_action(dynamics: FuncEnv) -> Array:
    """An action of zeros, which tracing needs; follows its caller's dtype."""
    space = dynamics.action_space
    return jnp.zeros(space.shape or (), float if isinstance(space, Box) else int)


@lru_cache(maxsize=64)
def check(dynamics: FuncEnv, name: str) -> None:
    """Check that a step can be traced, and gives an observation of the space, one reward and one `terminal`.

    Raises:
      ValueError: what the functions raise, or a result of another shape.
    """
    key = jax.random.key(0)
    try:
        with jax.enable_x64(True):
            state, first = jax.eval_shape(partial(reset, dynamics), key)
            later = jax.eval_shape(partial(step, dynamics), key, state, zero_action(dynamics))
    except Exception as error:
        raise ValueError(f"environment {name} failed: {type(error).__name__}: {one_line(error)}") from error
    shape = dynamics.observation_space.shape or ()
    names, shapes = ("observation", "observation", "reward", "terminal"), (shape, shape, (), ())
    for part, got, expected in zip(names, (first, *later[1:]), shapes, strict=True):
        if got.shape != expected:
            raise ValueError(f"environment {name}: {part}: expected shape {expected}, got {got.shape}")


# One compilation for all environments over the same dynamics object (hashed by identity).
_reset = jax.jit(reset, static_argnums=0)
_step = jax.jit(step, static_argnums=0)


class FunctionalEnv(gymnasium.Env):
    """A gymnasium environment over the pure functions of `dynamics`, in float64.

    The dynamics may offer `draw(observation, axes)`, which draws one observation on matplotlib axes; then
    `render_mode="rgb_array"` is available. It must not be changed after its first use, because it is compiled in.

    Attributes:
      dynamics: the `FuncEnv`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (gymnasium's interface)

    def __init__(self, dynamics: FuncEnv, render_mode: str | None = None):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode: expected None or 'rgb_array', got {render_mode!r}")
        if render_mode is not None and not hasattr(dynamics, "draw"):
            raise ValueError(
                f"render_mode: expected None, because {type(dynamics).__name__} has no method draw(observation, axes), "
                f"got {render_mode!r}"
            )
        self.dynamics = dynamics
        self.observation_space = dynamics.observation_space
        self.action_space = dynamics.action_space
        self.render_mode = render_mode
        self._key: jax.Array | None = None
        self._state: Any = None
        self._observed: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; its JAX key is drawn from the environment's seeded NumPy generator."""
        super().reset(seed=seed)
        episode_key = jax.random.key(int(self.np_random.integers(2**31)))
        self._key, initial_key = jax.random.split(episode_key)
        with jax.enable_x64(True):
            self._state, observation = _reset(self.dynamics, initial_key)
        return self._observation(observation), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One step; `truncated` is always False, because the time limit is gymnasium's `TimeLimit` wrapper."""
        if self._key is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        self._key, step_key = jax.random.split(self._key)
        with jax.enable_x64(True):
            action = np.asarray(action, dtype=self.action_space.dtype)
            self._state, observation, reward, terminated = _step(self.dynamics, step_key, self._state, action)
        return self._observation(observation), float(reward), bool(terminated), False, {}

    @property
    def is_its_dynamics(self) -> bool:
        """Whether it does what its dynamics do: no subclass has a `reset` or `step` of its own."""
        mine = FunctionalEnv
        return all(getattr(type(self), name) is getattr(mine, name) for name in ("reset", "step", "_observation"))

    def _observation(self, observation: Any) -> Any:
        if isinstance(self.observation_space, gymnasium.spaces.Discrete):
            self._observed = np.int64(observation)
            return self._observed
        if not isinstance(self.observation_space, gymnasium.spaces.Box):  # of several parts
            self._observed = jax.tree.map(np.asarray, observation)
            return self._observed
        self._observed = np.array(observation, dtype=self.observation_space.dtype)
        return self._observed.copy()

    def render(self) -> Any:
        """The current observation as an RGB picture, shape (height, width, 3) uint8; None without a render mode."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() without a render mode: make the environment with render_mode='rgb_array'")
            return None
        if self._key is None:
            raise gymnasium.error.ResetNeeded("call reset() before render()")
        return picture(partial(self.dynamics.draw, self._observed))  # type: ignore[attr-defined]


def picture(
    draw: Callable[["Axes"], object], *, inches: tuple[float, float] = (4.0, 4.0)
) -> UInt8[np.ndarray, "height width 3"]:
    """What `draw(axes)` draws, without matplotlib's global state."""
    figure = new_figure(*inches, layout=None, dpi=80)  # a computed layout costs more than the drawing
    draw(figure.add_axes((0.12, 0.1, 0.83, 0.82)))
    return pixels(figure)[..., :3].copy()
