"""Swing-up of a strong but noisy pendulum, the paper's third domain.

Constants: the swing-up of the authors' published experiments (Wirth, Fürnkranz, Neumann 2016), in SI units.
"""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.experimental.functional import FuncEnv
from gymnasium.spaces import Box
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Key

from bayespbrl.envs.angles import wrapped
from bayespbrl.envs.film_strip import Line, draw_film_strip, draw_pose
from bayespbrl.envs.functional import Drawn, FunctionalEnv

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MASS = 10.0  # kg
LENGTH = 0.5  # m, from the pivot to where the weight acts
GRAVITY = 9.81  # m/s²
INERTIA = MASS * LENGTH**2 / 3  # kg m²
WEIGHT = MASS * GRAVITY * LENGTH / INERTIA  # 58.86 /s²
FRICTION = 0.2  # 1/s, deceleration per angular velocity
MAX_TORQUE = 30.0  # N m
TORQUE_NOISE = 4.47  # N m, standard deviation, one draw a control step
CONTROL_STEP = 0.05  # s
SUBSTEPS = 50  # of 1 ms
START_SPREAD = 0.2  # rad about hanging down
# Friction balances the greatest torque and weight at this speed, and no Euler step can pass it.
MAX_SPEED = (WEIGHT + MAX_TORQUE / INERTIA) / FRICTION  # 474.3 rad/s
State = Float[Array, "2"]
Action = Float[Array, "1"]


class SwingUpDynamics(FuncEnv):
    """The pendulum as pure functions. State and observation: (θ in [−π, π), θ̇), θ = 0 upright; rad and rad/s."""

    observation_space = Box(np.array([-np.pi, -MAX_SPEED]), np.array([np.pi, MAX_SPEED]), dtype=np.float64)
    action_space = Box(-MAX_TORQUE, MAX_TORQUE, (1,), dtype=np.float64)
    max_episode_steps = 60
    observation_period: tuple[float, ...] = (2 * np.pi, np.inf)
    frames_per_second = 1 / CONTROL_STEP
    published_returns: tuple[tuple[str, float], ...] = (("every method of the paper, about", -1900.0),)

    def initial(self, rng: Key[Array, ""], params: None = None) -> State:
        """At rest, within 0.2 rad of hanging down."""
        angle = jax.random.uniform(rng, minval=np.pi - START_SPREAD, maxval=np.pi + START_SPREAD)
        return jnp.stack([wrapped(angle), jnp.zeros_like(angle)])

    def transition(self, state: State, action: Action, rng: Key[Array, ""], params: None = None) -> State:
        """One control step: noise on the torque, then the clip."""
        noise = TORQUE_NOISE * jax.random.normal(rng)
        return self.swing(state, jnp.clip(action[0] + noise, -MAX_TORQUE, MAX_TORQUE))

    def swing(self, state: State, torque: ArrayLike) -> State:
        """One control step under the constant `torque` that really acts, by symplectic Euler."""
        seconds = CONTROL_STEP / SUBSTEPS

        def substep(_: int, moving: tuple[Array, Array]) -> tuple[Array, Array]:
            angle, speed = moving
            speed = speed + seconds * self.acceleration(angle, speed, torque)
            return angle + seconds * speed, speed

        angle, speed = jax.lax.fori_loop(0, SUBSTEPS, substep, (state[0], state[1]))
        return jnp.stack([wrapped(angle), speed])

    def acceleration(self, angle: Array, speed: Array, torque: ArrayLike) -> Array:
        """θ̈ = 58.86 sin θ + 1.2 u − 0.2 θ̇."""
        return WEIGHT * jnp.sin(angle) + torque / INERTIA - FRICTION * speed

    def observation(self, state: State, rng: Array | None = None, params: None = None) -> State:
        """The state itself."""
        return state

    def reward(
        self, state: State, action: Action, next_state: State, rng: Array | None = None, params: None = None
    ) -> Float[Array, ""]:
        """−10 θ² at the *current* state."""
        return -10.0 * wrapped(state[0]) ** 2

    def terminal(self, state: State, rng: Array | None = None, params: None = None) -> Bool[Array, ""]:
        """Never."""
        return jnp.asarray(False)

    def pose(self, observation: Float[np.ndarray, " s"]) -> list[Line]:
        """The pendulum as a line in the square [−1, 1]², pivot in the middle."""
        angle = float(observation[0])
        return [np.array([[0.0, 0.0], [np.sin(angle), np.cos(angle)]])]

    def draw(self, observation: Float[np.ndarray, " s"], axes: "Axes") -> None:
        """The pendulum, seen from the front."""
        draw_pose(self.pose(observation), axes)
        axes.set(xlim=(-1.2, 1.2), ylim=(-1.2, 1.2), aspect="equal", xticks=[], yticks=[])

    def draw_trajectory(self, trajectory: Drawn, axes: "Axes") -> None:
        """A film strip of the pendulum."""
        draw_film_strip(self.pose, trajectory.states, axes, step_seconds=CONTROL_STEP)


DYNAMICS = SwingUpDynamics()


class SwingUp(FunctionalEnv):
    """A pendulum with a strong and noisy motor, to be swung up and kept upright.

    θ̈ = 58.86 sin θ + 1.2 u − 0.2 θ̇ with θ = 0 upright; control step 0.05 s.

    ## Action space
    `Box(-30, 30, (1,), float64)`. N(0, 4.47²) N m are added to the torque, and the sum is clipped to the same range.

    | Num | Action              | Min | Max | Unit |
    |-----|---------------------|-----|-----|------|
    | 0   | torque at the pivot | -30 | 30  | N m  |

    ## Observation space
    `Box((2,), float64)`.

    | Num | Observation                  | Min    | Max   | Unit  |
    |-----|------------------------------|--------|-------|-------|
    | 0   | angle θ, 0 upright, periodic | -π     | π     | rad   |
    | 1   | angular velocity θ̇          | -474.3 | 474.3 | rad/s |

    ## Reward
    −10 θ² at the state in which the action is taken; range [−98.7, 0]. Hanging still earns about −5500 an
    episode, random torques −4680; the best that is known about −905.

    ## Start
    θ ~ U(π − 0.2, π + 0.2), at rest.

    ## End
    No terminal state; truncated after 60 steps (3 s).

    ## Source
    Wirth, Fürnkranz, Neumann (2016), Model-free preference-based reinforcement learning.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 (gymnasium's interface)

    def __init__(self, render_mode: str | None = None):
        super().__init__(DYNAMICS, render_mode)
