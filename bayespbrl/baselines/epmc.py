"""EPMC: every-visit preference Monte Carlo, which estimates for each state which of two actions is the better one.

Source: Wirth & Fürnkranz (2013), "EPMC: Every visit preference Monte Carlo for reinforcement learning", ACML. Two
trajectories are compared. Of the n states that both visited one may have decided, so that an action of the preferred
trajectory is better than another one of the other with probability (n+1)/2n in each (`sampled`). The estimates move
towards these with a learning rate; pairwise coupling turns them into a value of each action (`action_values`); EXP3
(Auer et al. 1995) explores by it. The first trajectory explores. The second explores in the states of the first and is
greedy in all others, so that decisions in shared states differ and the rest is as good as can be.

Decisions, where the sources are silent or differ:
* Observations are numbered by a grid of equal cells, actions are the least, the middle and the greatest.
* n counts the cells that both trajectories visited, whichever actions they took there.
* The mean over all pairs of visits of a cell is one sample for it.
* At a preference the gains of EXP3 grow for every action of every cell by its value over its probability. EXP3 itself
  does so for the action that was drawn; its gains then settle at more exploitation than these.
* A tie changes nothing.
* After an answer the learner would act by the greedy policy, any of the best actions with equal probability.
* Learning rate, exploration and the number of cells were chosen among a few on seeds 0 to 7, after 75 answers.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box
from jax import Array
from jaxtyping import Float, Int, Key

from bayespbrl import checks, rollouts
from bayespbrl.baselines.steps import MOST_QUESTIONS, Step
from bayespbrl.envs.opening import AnyEnvironment, open_environment
from bayespbrl.experts import Expert
from bayespbrl.policies.policy import AnyArray
from bayespbrl.preferences import Answer, parse_answer
from bayespbrl.trajectories import Trajectory

CELLS = 6  # per dimension of the observation
MOST_DIMENSIONS = 8  # 1.7 million cells
LEARNING_RATE = 0.2  # α
EXPLORATION = 0.1  # η of EXP3


def every_visit_preferences(
    environment: AnyEnvironment, expert: Expert, *, answers: int, seed: int, max_steps: int | None = None
) -> Iterator[Step]:
    """Ask until there are `answers`; yields a step with a `GridPolicy` after each.

    Args:
      environment: as of `Learner`; observations in a bounded `Box`, actions in a bounded `Box` of one dimension.
      expert: answers.
      answers: how many, each on two new trajectories. A question that is skipped has none; at most ten times as many
        are asked.
      seed: of everything random.
      max_steps: of a trajectory; None: the environment's limit.

    Raises:
      ValueError: other spaces; no whole number >= 1 as `answers`, or none >= 0 as `seed`.
    """
    checks.whole("answers", answers)
    checks.seed(seed)
    environment = open_environment(environment)
    policy = GridPolicy.initial(environment)
    cells, actions = np.asarray(policy.table).shape
    better = np.full((cells, actions, actions), 0.5)  # P(a ≻ a′ | s)
    gains = np.zeros((cells, actions))  # of EXP3
    pairs = given = 0
    for number in range(1, MOST_QUESTIONS * answers + 1):
        keys = jax.random.split(jax.random.key(int(np.random.default_rng([seed, number]).integers(2**31))))
        exploring, greedy = exp3(gains), best_actions(better)
        first = rollouts.rollout(
            environment, policy.with_table(exploring), key=keys[0], episodes=1, max_steps=max_steps
        )
        seen = np.isin(np.arange(cells), policy.visited(first[0])[0])
        mixed = policy.with_table(np.where(seen[:, None], exploring, greedy))
        second = rollouts.rollout(environment, mixed, key=keys[1], episodes=1, max_steps=max_steps)
        shown = [first[0], second[0]]
        answer = parse_answer(expert(*shown))
        if answer is Answer.SKIP:
            continue
        if answer in (Answer.FIRST, Answer.SECOND):
            visited = [policy.visited(each) for each in shown]
            preferred, other = visited if answer is Answer.FIRST else visited[::-1]
            # Wirth & Fürnkranz (2013): towards the sample, by the learning rate
            better += LEARNING_RATE * (sampled(preferred, other, better) - better)
            gains += action_values(better) / exploring  # EXP3 (Auer et al. 1995)
            pairs += 1
        given += 1
        yield Step(given, pairs, policy.with_table(best_actions(better)))
        if given == answers:
            return


Visits = tuple[Int[np.ndarray, " t"], Int[np.ndarray, " t"]]  # cells and numbers of actions


def sampled(preferred: Visits, other: Visits, before: Float[np.ndarray, "c a a"]) -> Float[np.ndarray, "c a a"]:
    """P(a ≻ a′ | s) by one preference: (n+1)/2n for actions of the preferred trajectory against those of the other.

    Args:
      preferred, other: what the two trajectories visited.
      before: kept where the two say nothing.
    """
    number, actions = before.shape[:2]
    counts = [np.zeros((number, actions)) for _ in range(2)]
    for count, visited in zip(counts, (preferred, other), strict=True):
        np.add.at(count, visited, 1)
    shared = max(1, int(np.sum(counts[0].any(axis=1) & counts[1].any(axis=1))))
    wins = counts[0][:, :, None] * counts[1][:, None, :]  # pairs of visits with a of the preferred and a′ of the other
    losses = wins.transpose(0, 2, 1)
    said = (wins + losses > 0) & ~np.eye(actions, dtype=bool)
    mean = 0.5 + (wins - losses) / np.maximum(wins + losses, 1) / (2 * shared)  # Wirth & Fürnkranz (2013): (n+1)/2n
    return np.where(said, mean, before)


def action_values(better: Float[np.ndarray, "c a a"]) -> Float[np.ndarray, "c a"]:
    """The probability that an action is the best: 1 / (Σ_{a′≠a} 1/P(a ≻ a′) − (A − 2)) (Price et al. 1994)."""
    actions = better.shape[-1]
    inverse = np.where(np.eye(actions, dtype=bool), 0.0, 1 / np.maximum(better, 1e-12))
    return 1 / (inverse.sum(axis=-1) - (actions - 2))  # Price et al. (1994)


def exp3(gains: Float[np.ndarray, "c a"]) -> Float[np.ndarray, "c a"]:
    """The probabilities of EXP3 (Auer et al. 1995): a share η uniform, the rest ∝ exp(η/A · gains)."""
    actions = gains.shape[1]
    powers = EXPLORATION / actions * (gains - gains.max(axis=1, keepdims=True))
    return EXPLORATION / actions + (1 - EXPLORATION) * np.exp(powers) / np.exp(powers).sum(axis=1, keepdims=True)


def best_actions(better: Float[np.ndarray, "c a a"]) -> Float[np.ndarray, "c a"]:
    """The greedy policy: equal probability for all actions of the highest value."""
    values = action_values(better)
    best = values >= values.max(axis=1, keepdims=True) - 1e-12
    return best / best.sum(axis=1, keepdims=True)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class GridPolicy:
    """π(a|s) = table[cell of s, a] for a few actions, on a grid of equal cells.

    Attributes:
      table: probabilities, rows sum to one.
      low, high: bounds of the observations.
      actions: the values of the actions, shape (A, 1).
      per_dimension: cells along each dimension.
    """

    table: Float[AnyArray, "c a"]
    low: Float[AnyArray, " s"]
    high: Float[AnyArray, " s"]
    actions: Float[AnyArray, "a 1"]
    per_dimension: int = field(metadata={"static": True})

    @classmethod
    def initial(cls, environment: gymnasium.Env) -> "GridPolicy":
        """The uniform policy for an environment; `ValueError` unless its spaces are bounded boxes, and not large."""
        seen = _bounded("observations", environment.observation_space)
        acts = _bounded("actions", environment.action_space)
        if acts.shape != (1,):
            raise ValueError(f"baseline epmc: expected actions of one dimension, got {acts.shape[0]}")
        values = np.linspace(acts.low.astype(float), acts.high.astype(float), 3)
        if seen.shape[0] > MOST_DIMENSIONS:
            raise ValueError(
                f"baseline epmc: expected observations of at most {MOST_DIMENSIONS} dimensions, as each has {CELLS} "
                f"cells, got {seen.shape[0]}"
            )
        table = np.full((CELLS ** seen.shape[0], len(values)), 1 / len(values))
        return cls(table, seen.low.astype(float), seen.high.astype(float), values, CELLS)

    def with_table(self, table: Float[np.ndarray, "c a"]) -> "GridPolicy":
        """The same cells and actions with other probabilities."""
        return GridPolicy(table, self.low, self.high, self.actions, self.per_dimension)

    def cells(self, observations: Float[AnyArray, "... s"]) -> Int[Array, "..."]:
        """The number of the cell of each observation."""
        width = jnp.asarray(self.high) - self.low
        share = (jnp.asarray(observations) - self.low) / jnp.where(width > 0, width, 1)
        places = jnp.clip((share * self.per_dimension).astype(int), 0, self.per_dimension - 1)
        return places @ (self.per_dimension ** jnp.arange(places.shape[-1]))

    def visited(self, trajectory: Trajectory) -> Visits:
        """The cells that a trajectory visited, and the number of the action that it took in each."""
        with jax.enable_x64(True):  # as rollouts do, or states on a border would be in another cell
            cells = np.asarray(self.cells(trajectory.states[:-1]))
        return cells, np.argmin(np.abs(trajectory.actions - np.asarray(self.actions)[:, 0]), axis=1)

    def sample(self, key: Key[Array, ""], observation: Float[AnyArray, " s"]) -> Float[Array, "1"]:
        """a ~ π(·|s)."""
        chances = jnp.asarray(self.table)[self.cells(observation)]
        return jnp.asarray(self.actions)[jax.random.categorical(key, jnp.log(chances))]


def _bounded(name: str, space: gymnasium.Space[Any]) -> Box:
    if not (isinstance(space, Box) and space.is_bounded() and len(space.shape) == 1):
        raise ValueError(f"baseline epmc: expected {name} in a bounded Box of shape (n,), got {space}")
    return space
