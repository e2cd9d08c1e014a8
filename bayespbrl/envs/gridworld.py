"""The Gridworld of Akrour et al. (2014), the paper's first domain: the reward doubles towards one corner."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.experimental.functional import FuncEnv
from gymnasium.spaces import Discrete
from jax import Array
from jaxtyping import Bool, Float, Int, Key

from bayespbrl.envs.functional import Drawn, FunctionalEnv

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE = 5
STAY_PROBABILITY = 0.5
# stay, left, down, right, up as (row, column); rows count downwards from the top
MOVES = np.array([(0, 0), (0, -1), (1, 0), (0, 1), (-1, 0)])
START = SIZE * (SIZE // 2) + SIZE // 2  # the centre
# Akrour et al. (2014): r = 2^−(4−(j−1)+(i−1)) for row i and column j counted from 1: top right 1, bottom left 1/256.
REWARDS = 2.0 ** -(SIZE - 1 - np.arange(SIZE)[None, :] + np.arange(SIZE)[:, None]).astype(float)
Cell = Int[Array, ""]


class GridworldDynamics(FuncEnv):
    """The Gridworld as pure functions. The state is the observation: 5·row + column, rows from the top, both from 0."""

    observation_space = Discrete(SIZE * SIZE)
    action_space = Discrete(len(MOVES))
    max_episode_steps = 300
    observation_period: tuple[float, ...] = (np.inf,)
    grid_shape = (SIZE, SIZE)
    optimal_return = 294.8125  # expected over 300 steps, by dynamic programming on `transition_table`

    def initial(self, rng: Key[Array, ""], params: None = None) -> Cell:
        """The centre cell."""
        return jnp.asarray(START)

    def transition(self, state: Cell, action: Cell, rng: Key[Array, ""], params: None = None) -> Cell:
        """With probability ½ the move, else stay; moves off the grid are clamped."""
        succeeds = jax.random.bernoulli(rng, 1 - STAY_PROBABILITY)
        moved = self.move(state, action)
        return jnp.where(succeeds, moved, state)

    def move(self, state: Cell, action: Cell) -> Cell:
        """The cell that a successful `action` leads to."""
        row, column = jnp.divmod(jnp.asarray(state), SIZE)
        change = jnp.asarray(MOVES, row.dtype)[action]
        row, column = jnp.clip(row + change[0], 0, SIZE - 1), jnp.clip(column + change[1], 0, SIZE - 1)
        return SIZE * row + column

    def observation(self, state: Cell, rng: Array | None = None, params: None = None) -> Cell:
        """The state itself."""
        return state

    def reward(
        self, state: Cell, action: Cell, next_state: Cell, rng: Array | None = None, params: None = None
    ) -> Float[Array, ""]:
        """The reward of the *next* cell."""
        return jnp.asarray(REWARDS.reshape(-1))[next_state]

    def terminal(self, state: Cell, rng: Array | None = None, params: None = None) -> Bool[Array, ""]:
        """Never."""
        return jnp.zeros_like(state, dtype=bool)

    def transition_table(self) -> Float[np.ndarray, "25 5 25"]:
        """P(s′ | s, a) from `move`, for planning and for tests."""
        states, actions = np.divmod(np.arange(SIZE * SIZE * len(MOVES)), len(MOVES))
        table = np.zeros((SIZE * SIZE, len(MOVES), SIZE * SIZE))
        moved = np.asarray(jax.vmap(self.move)(jnp.asarray(states), jnp.asarray(actions)))
        table[states, actions, states] += STAY_PROBABILITY
        table[states, actions, moved] += 1 - STAY_PROBABILITY
        return table

    def draw(self, observation: np.int64, axes: "Axes") -> None:
        """One position on the grid; the hidden reward is not shown, because who judges must not see it."""
        _draw_grid(axes)
        row, column = divmod(int(observation), SIZE)
        axes.scatter([column], [row], s=900, color="tab:blue", zorder=3)

    def draw_trajectory(self, trajectory: Drawn, axes: "Axes") -> None:
        """How often each cell was visited (shade and number) and the path from the centre (lines, dot at its end)."""
        counts = np.bincount(np.asarray(trajectory.states), minlength=SIZE * SIZE).reshape(SIZE, SIZE)
        axes.imshow(counts, cmap="Blues", vmin=0, vmax=max(1, 1.3 * counts.max()))
        _draw_grid(axes)
        rows, columns = np.divmod(np.asarray(trajectory.states), SIZE)
        axes.plot(columns, rows, color="tab:orange", alpha=0.6, linewidth=2)
        axes.scatter(columns[-1:], rows[-1:], s=120, color="tab:orange", zorder=3)
        for (row, column), count in np.ndenumerate(counts):
            axes.text(column + 0.42, row - 0.35, str(count), ha="right", va="center", fontsize=8)
        axes.set_title(f"visits in {len(trajectory)} steps")


def _draw_grid(axes: "Axes") -> None:
    axes.set(xlim=(-0.5, SIZE - 0.5), ylim=(SIZE - 0.5, -0.5), aspect="equal", xlabel="column", ylabel="row")
    axes.set_xticks(range(SIZE), [str(j + 1) for j in range(SIZE)])
    axes.set_yticks(range(SIZE), [str(i + 1) for i in range(SIZE)])
    axes.set_xticks(np.arange(SIZE + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(SIZE + 1) - 0.5, minor=True)
    axes.grid(which="minor", color="0.7")
    axes.tick_params(which="both", length=0)


DYNAMICS = GridworldDynamics()


class Gridworld(FunctionalEnv):
    """A walk on a 5×5 grid with slippery moves.

    ## Action space
    `Discrete(5)`. With probability ½ the action becomes *stay*; a move off the grid is clamped.

    | Num | Action |
    |-----|--------|
    | 0   | stay   |
    | 1   | left   |
    | 2   | down   |
    | 3   | right  |
    | 4   | up     |

    ## Observation space
    `Discrete(25)`: 5·row + column, rows from the top, both counted from 0.

    ## Reward
    2^−(4 − column + row) of the *next* cell: 1 at the top right, 1/256 at the bottom left; range [1/256, 1]. The
    optimal return of an episode is 294.8125 on average, the uniform policy's 44.34.

    ## Start
    The centre, cell 12.

    ## End
    No terminal state; truncated after 300 steps.

    ## Source
    Akrour, Schoenauer, Souplet, Sebag (2014), Programming by feedback; as used by Wirth, Fürnkranz, Neumann (2016).
    """

    def __init__(self, render_mode: str | None = None):
        super().__init__(DYNAMICS, render_mode)
