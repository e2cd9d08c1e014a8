"""Balancing a bicycle (Randløv and Alstrøm 1998; Lagoudakis and Parr 2003), the paper's second domain.

Constants: Randløv and Alstrøm (1998), Learning to drive a bicycle using reinforcement learning and shaping; SI units.
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

from bayespbrl.envs.functional import Drawn, FunctionalEnv

if TYPE_CHECKING:
    from matplotlib.axes import Axes

VELOCITY = 10 / 3.6  # m/s, v
GRAVITY = 9.82  # m/s², g (Denmark)
CENTRE_DROP = 0.3  # m, d_CM: the cyclist's centre of mass above the bicycle's
CENTRE_BEHIND = 0.66  # m, c: from the front tyre's contact to the common centre of mass, along the ground
HEIGHT = 0.94  # m, h: of the common centre of mass
BICYCLE_MASS = 15.0  # kg, M_c
TYRE_MASS = 1.7  # kg, M_d
CYCLIST_MASS = 60.0  # kg, M_p
TOTAL_MASS = BICYCLE_MASS + CYCLIST_MASS  # kg, M
TYRE_RADIUS = 0.34  # m, r
WHEELBASE = 1.11  # m, l
SPIN = VELOCITY / TYRE_RADIUS  # rad/s, σ̇
INERTIA_BICYCLE = (
    13 / 3 * BICYCLE_MASS * HEIGHT**2 + CYCLIST_MASS * (HEIGHT + CENTRE_DROP) ** 2
)  # kg m², about the ground
INERTIA_SPIN = TYRE_MASS * TYRE_RADIUS**2  # kg m², I_dc
INERTIA_TYRE = 3 / 2 * TYRE_MASS * TYRE_RADIUS**2  # kg m², I_dv
INERTIA_STEERING = 1 / 2 * TYRE_MASS * TYRE_RADIUS**2  # kg m², I_dl
STEP_SECONDS = 0.01
MAX_TORQUE = 2.0  # N m
MAX_DISPLACEMENT = 0.02  # m
DISPLACEMENT_NOISE = 0.02  # m, half width of the uniform noise
MAX_STEERING = np.deg2rad(80.0)  # rad
FALL_ANGLE = np.pi / 15  # rad, 12°
# Half widths of the uniform start (θ, θ̇, ω, ω̇). Decision: the sources conflict, and from a start at zero even a random
# policy survives 50 steps.
START_SPREAD = np.array([0.1413, 0.3320, 0.0738, 0.3495])
# Not enforced. Before the fall ∫ω̇ dt stays within 24°, so |θ̇| < 11 + 20.4 t rad/s (48 s to pass the limit), and
# 16 rad/s² over 24° cannot bring ω̇ past 4 rad/s.
OBSERVATION_LIMIT = np.array([MAX_STEERING, 1000.0, np.pi / 2, 10.0])
State = Float[Array, "4"]
Action = Float[Array, "2"]


class BicycleDynamics(FuncEnv):
    """The bicycle as pure functions.

    State and observation: (θ, θ̇, ω, ω̇), the handlebar's angle and the lean from the vertical; rad and rad/s.
    """

    observation_space = Box(-OBSERVATION_LIMIT, OBSERVATION_LIMIT, dtype=np.float64)
    action_space = Box(
        np.array([-MAX_TORQUE, -MAX_DISPLACEMENT]), np.array([MAX_TORQUE, MAX_DISPLACEMENT]), dtype=np.float64
    )
    max_episode_steps = 50
    observation_period: tuple[float, ...] = (np.inf,) * 4
    frames_per_second = 20.0  # a fifth of real time

    def initial(self, rng: Key[Array, ""], params: None = None) -> State:
        """Uniform about riding straight and upright."""
        return jax.random.uniform(rng, (4,), minval=-1.0, maxval=1.0) * jnp.asarray(START_SPREAD)

    def transition(self, state: State, action: Action, rng: Key[Array, ""], params: None = None) -> State:
        """One step: both actions clipped, then noise on the displacement only."""
        torque = jnp.clip(action[0], -MAX_TORQUE, MAX_TORQUE)
        displacement = jnp.clip(action[1], -MAX_DISPLACEMENT, MAX_DISPLACEMENT)
        noise = jax.random.uniform(rng, minval=-DISPLACEMENT_NOISE, maxval=DISPLACEMENT_NOISE)
        return self.ride(state, torque, displacement + noise)

    def ride(self, state: State, torque: ArrayLike, displacement: ArrayLike) -> State:
        """One semi-implicit Euler step under the torque and displacement that really act."""
        steering, steering_speed, lean, lean_speed = state
        steering_acceleration, lean_acceleration = self.accelerations(state, torque, displacement)
        lean_speed = lean_speed + lean_acceleration * STEP_SECONDS
        lean = lean + lean_speed * STEP_SECONDS
        steering_speed = steering_speed + steering_acceleration * STEP_SECONDS
        steering = jnp.clip(steering + steering_speed * STEP_SECONDS, -MAX_STEERING, MAX_STEERING)
        return jnp.stack([steering, steering_speed, lean, lean_speed])

    def accelerations(self, state: State, torque: ArrayLike, displacement: ArrayLike) -> tuple[Array, Array]:
        """(θ̈, ω̈) by Randløv and Alstrøm (1998)."""
        steering, steering_speed, lean, lean_speed = state
        # Randløv and Alstrøm (1998), with 1/r_f, 1/r_b and 1/r_CM: riding straight on the radii are infinite
        tangent = jnp.abs(jnp.tan(steering))
        front, back = jnp.abs(jnp.sin(steering)) / WHEELBASE, tangent / WHEELBASE
        centre = tangent / jnp.sqrt(((WHEELBASE - CENTRE_BEHIND) * tangent) ** 2 + WHEELBASE**2)
        total_lean = lean + jnp.arctan(displacement / HEIGHT)  # φ
        tyres = TYRE_MASS * TYRE_RADIUS * (front + back)
        centrifugal = jnp.sign(steering) * VELOCITY**2 * (tyres + TOTAL_MASS * HEIGHT * centre)
        tilting = HEIGHT * TOTAL_MASS * GRAVITY * jnp.sin(total_lean)
        righting = jnp.cos(total_lean) * (INERTIA_SPIN * SPIN * steering_speed + centrifugal)
        steering_acceleration = (torque - INERTIA_TYRE * SPIN * lean_speed) / INERTIA_STEERING  # θ̈
        return steering_acceleration, (tilting - righting) / INERTIA_BICYCLE  # ω̈

    def observation(self, state: State, rng: Array | None = None, params: None = None) -> State:
        """The state itself."""
        return state

    def reward(
        self, state: State, action: Action, next_state: State, rng: Array | None = None, params: None = None
    ) -> Float[Array, ""]:
        """−(ω′·15/π)² − 100·[fallen]. Decision: of several in the sources, the one that tells good riders apart."""
        return -((next_state[2] / FALL_ANGLE) ** 2) - 100.0 * self.terminal(next_state)

    def terminal(self, state: State, rng: Array | None = None, params: None = None) -> Bool[Array, ""]:
        """The bicycle leans further than 12°."""
        return jnp.abs(state[2]) > FALL_ANGLE

    def draw(self, observation: Float[np.ndarray, " s"], axes: "Axes") -> None:
        """From behind: the lean (magnified three times, with the fall's limits dotted) and the handlebar from above."""
        steering, lean = float(observation[0]), 3 * float(observation[2])
        for limit in (-3 * FALL_ANGLE, 3 * FALL_ANGLE):
            axes.plot([0, np.sin(limit)], [0, np.cos(limit)], ":", color="tab:red")
        axes.plot([-1, 1], [0, 0], color="0.5")
        top = np.array([np.sin(lean), np.cos(lean)])
        axes.plot([0, top[0]], [0, top[1]], color="tab:blue", linewidth=6, solid_capstyle="round")
        bar = 0.3 * np.array([np.cos(steering), np.sin(steering)])
        axes.plot(*zip(top - bar, top + bar, strict=True), color="tab:orange", linewidth=4, solid_capstyle="round")
        axes.set(xlim=(-1.1, 1.1), ylim=(-0.2, 1.4), aspect="equal", xticks=[], yticks=[])
        axes.set_title(f"lean {np.rad2deg(observation[2]):+.1f}°, handlebar {np.rad2deg(steering):+.1f}°")

    def draw_trajectory(self, trajectory: Drawn, axes: "Axes") -> None:
        """Lean and handlebar over time, with the angles at which the bicycle has fallen."""
        seconds = STEP_SECONDS * np.arange(len(trajectory) + 1)
        degrees = np.rad2deg(np.asarray(trajectory.states))
        axes.axhline(0, color="0.8", linewidth=1)
        for limit in (-12, 12):
            axes.axhline(limit, linestyle=":", color="tab:red")
        axes.plot(seconds, degrees[:, 0], color="tab:orange", linewidth=1, label="handlebar")
        axes.plot(seconds, degrees[:, 2], color="tab:blue", linewidth=3, label="lean")
        if trajectory.terminated:
            axes.plot(seconds[-1:], degrees[-1:, 2], "X", color="tab:red", markersize=12, label="fallen")
        axes.set(xlabel="time (s)", ylabel="angle (°)")
        axes.legend(loc="best", fontsize=8)


DYNAMICS = BicycleDynamics()


class Bicycle(FunctionalEnv):
    """A bicycle at 10 km/h that must not fall over.

    ## Action space
    `Box((2,), float64)`. Noise U(−0.02, 0.02) m is added to the displacement.

    | Num | Action                                             | Min   | Max  | Unit |
    |-----|----------------------------------------------------|-------|------|------|
    | 0   | torque on the handlebar                            | -2    | 2    | N m  |
    | 1   | displacement of the rider from the bicycle's plane | -0.02 | 0.02 | m    |

    ## Observation space
    `Box((4,), float64)`. The bounds other than θ's are not enforced; no episode of 3000 steps can pass them.

    | Num | Observation                     | Min     | Max    | Unit  |
    |-----|---------------------------------|---------|--------|-------|
    | 0   | angle of the handlebar θ        | -1.3963 | 1.3963 | rad   |
    | 1   | its velocity θ̇                 | -1000   | 1000   | rad/s |
    | 2   | lean from the vertical ω        | -π/2    | π/2    | rad   |
    | 3   | its velocity ω̇                 | -10     | 10     | rad/s |

    ## Reward
    −(ω′·15/π)² − 100·[fallen] at the *next* state; about [−102, 0]. A random policy earns about −40 an episode, a
    simple steer-into-the-fall law −4.

    ## Start
    Uniform in θ ± 0.1413, θ̇ ± 0.3320, ω ± 0.0738, ω̇ ± 0.3495.

    ## End
    Terminated when |ω| > π/15 (12°): fallen. Truncated after 50 steps (0.5 s).

    ## Source
    Randløv, Alstrøm (1998); Lagoudakis, Parr (2003), Least-squares policy iteration.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 (gymnasium's interface)

    def __init__(self, render_mode: str | None = None):
        super().__init__(DYNAMICS, render_mode)
