"""The acrobot (Sutton and Barto 1998) with a continuous torque, the paper's fourth domain.

Constants and equations: Sutton and Barto (1998), Reinforcement learning: an introduction, figure 11.5, in SI units.
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

MASS_1 = MASS_2 = 1.0  # kg
LENGTH_1 = LENGTH_2 = 1.0  # m
CENTRE = 0.5  # m, l_c: from a link's joint to its centre of mass
INERTIA_1 = INERTIA_2 = 1.0  # kg m²
GRAVITY = 9.8  # m/s²
MAX_TORQUE = 1.0  # N m
TORQUE_NOISE = 0.2  # N m, half width of the uniform noise, one draw a step
MAX_SPEED_1, MAX_SPEED_2 = 4 * np.pi, 9 * np.pi  # rad/s
SUBSTEP_SECONDS, SUBSTEPS = 0.05, 4
OBSERVATION_LIMIT = np.array([np.pi, np.pi, MAX_SPEED_1, MAX_SPEED_2])
GOAL_HEIGHT = 1.0  # m above the first joint
State = Float[Array, "4"]
Action = Float[Array, "1"]


class AcrobotDynamics(FuncEnv):
    """The acrobot as pure functions.

    State and observation: (θ₁, θ₂, θ̇₁, θ̇₂), θ₁ from hanging down, θ₂ relative to the first link, both wrapped to
    [−π, π); rad and rad/s.
    """

    observation_space = Box(-OBSERVATION_LIMIT, OBSERVATION_LIMIT, dtype=np.float64)
    action_space = Box(-MAX_TORQUE, MAX_TORQUE, (1,), dtype=np.float64)
    max_episode_steps = 500
    published_returns: tuple[tuple[str, float], ...] = (("LP, as published", -211.3), ("EPMC, as published", -385.2))
    observation_period: tuple[float, ...] = (2 * np.pi, 2 * np.pi, np.inf, np.inf)
    frames_per_second = 1 / (SUBSTEPS * SUBSTEP_SECONDS)

    def initial(self, rng: Key[Array, ""], params: None = None) -> State:
        """At rest, hanging down."""
        return jnp.zeros(4)

    def transition(self, state: State, action: Action, rng: Key[Array, ""], params: None = None) -> State:
        """One step: the torque clipped, then noise on it."""
        noise = jax.random.uniform(rng, minval=-TORQUE_NOISE, maxval=TORQUE_NOISE)
        return self.swing(state, jnp.clip(action[0], -MAX_TORQUE, MAX_TORQUE) + noise)

    def swing(self, state: State, torque: ArrayLike) -> State:
        """Four semi-implicit Euler sub-steps under the constant `torque` that really acts.

        Decision: the velocities are limited after every sub-step.
        """

        def substep(_: int, state: State) -> State:
            angles, speeds = state[:2], state[2:]
            limits = jnp.asarray(OBSERVATION_LIMIT[2:])
            speeds = jnp.clip(speeds + SUBSTEP_SECONDS * self.accelerations(state, torque), -limits, limits)
            return jnp.concatenate([wrapped(angles + SUBSTEP_SECONDS * speeds), speeds])

        return jax.lax.fori_loop(0, SUBSTEPS, substep, jnp.asarray(state))

    def accelerations(self, state: State, torque: ArrayLike) -> Float[Array, "2"]:
        """(θ̈₁, θ̈₂) by Sutton and Barto (1998), figure 11.5."""
        angle_1, angle_2, speed_1, speed_2 = state
        coupling = MASS_2 * LENGTH_1 * CENTRE  # m₂ l₁ l_c2
        sine, cosine = jnp.sin(angle_2), jnp.cos(angle_2)
        # Sutton and Barto (1998), figure 11.5: d₁, d₂, φ₂, φ₁
        d1 = MASS_1 * CENTRE**2 + MASS_2 * (LENGTH_1**2 + CENTRE**2) + 2 * coupling * cosine + INERTIA_1 + INERTIA_2
        d2 = MASS_2 * CENTRE**2 + coupling * cosine + INERTIA_2
        phi2 = MASS_2 * CENTRE * GRAVITY * jnp.cos(angle_1 + angle_2 - jnp.pi / 2)
        phi1 = (
            -coupling * speed_2**2 * sine
            - 2 * coupling * speed_1 * speed_2 * sine
            + (MASS_1 * CENTRE + MASS_2 * LENGTH_1) * GRAVITY * jnp.cos(angle_1 - jnp.pi / 2)
            + phi2
        )
        # Sutton and Barto (1998), figure 11.5: θ̈₂, then θ̈₁ from it
        second = (torque + d2 / d1 * phi1 - coupling * speed_1**2 * sine - phi2) / (
            MASS_2 * CENTRE**2 + INERTIA_2 - d2**2 / d1
        )
        return jnp.stack([-(d2 * second + phi1) / d1, second])

    def observation(self, state: State, rng: Array | None = None, params: None = None) -> State:
        """The state itself."""
        return state

    def reward(
        self, state: State, action: Action, next_state: State, rng: Array | None = None, params: None = None
    ) -> Float[Array, ""]:
        """−1 a step. Decision: the step that reaches the goal included, so that −return is the number of steps."""
        return jnp.asarray(-1.0)

    def terminal(self, state: State, rng: Array | None = None, params: None = None) -> Bool[Array, ""]:
        """The tip more than 1 m above the first joint."""
        return -LENGTH_1 * jnp.cos(state[0]) - LENGTH_2 * jnp.cos(state[0] + state[1]) > GOAL_HEIGHT

    def pose(self, observation: Float[np.ndarray, " s"]) -> list[Line]:
        """The two links as lines in the square [−1, 1]², at half their size."""
        first, both = float(observation[0]), float(observation[0] + observation[1])
        elbow = 0.5 * np.array([np.sin(first), -np.cos(first)])
        return [
            np.stack([np.zeros(2), elbow]),
            np.stack([elbow, elbow + 0.5 * np.array([np.sin(both), -np.cos(both)])]),
        ]

    def draw(self, observation: Float[np.ndarray, " s"], axes: "Axes") -> None:
        """Both links, and the height that the tip must pass."""
        axes.axhline(0.5 * GOAL_HEIGHT, linestyle=":", color="tab:green")
        draw_pose(self.pose(observation), axes)
        axes.set(xlim=(-1.2, 1.2), ylim=(-1.2, 1.2), aspect="equal", xticks=[], yticks=[])

    def draw_trajectory(self, trajectory: Drawn, axes: "Axes") -> None:
        """A film strip of both links; the title says after how many steps the goal was reached."""
        draw_film_strip(self.pose, trajectory.states, axes, step_seconds=SUBSTEPS * SUBSTEP_SECONDS)
        outcome = "reached the goal" if trajectory.terminated else "did not reach the goal"
        axes.set_title(f"{outcome} in {len(trajectory)} steps")


DYNAMICS = AcrobotDynamics()


class Acrobot(FunctionalEnv):
    """Two links that hang from a bar, driven at the elbow only; their tip has to swing above a line.

    ## Action space
    `Box(-1, 1, (1,), float64)`. Noise U(−0.2, 0.2) N m is added to the torque and not clipped.

    | Num | Action              | Min | Max | Unit |
    |-----|---------------------|-----|-----|------|
    | 0   | torque at the elbow | -1  | 1   | N m  |

    ## Observation space
    `Box((4,), float64)`.

    | Num | Observation                                        | Min | Max | Unit  |
    |-----|----------------------------------------------------|-----|-----|-------|
    | 0   | angle θ₁ of the first link, 0 hanging, periodic    | -π  | π   | rad   |
    | 1   | angle θ₂ of the second relative to it, periodic    | -π  | π   | rad   |
    | 2   | angular velocity θ̇₁, limited                      | -4π | 4π  | rad/s |
    | 3   | angular velocity θ̇₂, limited                      | -9π | 9π  | rad/s |

    ## Reward
    −1 a step, the one that reaches the goal included; an episode earns minus the number of its steps, at least −500.

    ## Start
    At rest, hanging down.

    ## End
    Terminated when −cos θ₁ − cos(θ₁ + θ₂) > 1. Truncated after 500 steps of 0.2 s.

    ## Source
    Sutton, Barto (1998), Reinforcement learning: an introduction; DeJong, Spong (1994).
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012 (gymnasium's interface)

    def __init__(self, render_mode: str | None = None):
        super().__init__(DYNAMICS, render_mode)
