"""Programming by Feedback (PF): Bayesian utility, expected utility of selection, planning on a known model.

Source: Akrour, Schoenauer, Souplet & Sebag (2014), "Programming by feedback", ICML. The utility of a trajectory is
wᵀψ(τ), linear in how often it visits each state; the posterior of w has the error model of `preferred_probability`; the
next policy maximises the expected utility of selection against the best trajectory so far (Viappiani & Boutilier 2010);
policies are planned on the known transition probabilities.

Decisions, where the sources are silent or differ:
* ψ(τ) is the share of the steps that end in each state, so that it sums to one and M needs no unit of time.
* The prior of w is uniform on the unit sphere. Its draws are the directions of Gaussian vectors, moved by elliptical
  slices; they are kept from answer to answer.
* The candidates are the policies that are optimal for each posterior draw and for the posterior mean, deterministic and
  optimal for the discounted sum without end. The best of them by expected utility of selection is shown.
* A question compares two trajectories, not expected visits: the candidate's new one against the best one so far.
* A tie says nothing of w, and the best trajectory stays.
* After an answer the learner would act by the policy that is optimal for the posterior mean of w.
* M = 1/4 of a unit of w: small, because the expert here makes no errors.
"""

from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.special import xlogy

from bayespbrl import checks, rollouts
from bayespbrl.baselines.steps import MOST_QUESTIONS, Step
from bayespbrl.envs.opening import AnyEnvironment, open_environment
from bayespbrl.envs.stepping import step_limit
from bayespbrl.experts import Expert
from bayespbrl.policies import TabularPolicy
from bayespbrl.preferences import Answer, parse_answer
from bayespbrl.trajectories import DISCOUNT, Trajectory

ERROR_WIDTH = 0.25  # M, in units of w
DRAWS, MOVES = 300, 40  # of the posterior, and elliptical slices between two answers


def programming_by_feedback(
    environment: AnyEnvironment, expert: Expert, *, answers: int, seed: int, max_steps: int | None = None
) -> Iterator[Step]:
    """Ask until there are `answers`; yields a step with a `TabularPolicy` after each.

    Args:
      environment: as of `Learner`; its dynamics have a `transition_table`, P(s′ | s, a) of shape (S, A, S).
      expert: answers.
      answers: how many. A question that is skipped has none; at most ten times as many are asked.
      seed: of everything random.
      max_steps: of a trajectory; None: the environment's limit.

    Raises:
      ValueError: an environment whose transition probabilities are not known; no whole number >= 1 as `answers`, or
        none >= 0 as `seed`.
    """
    checks.whole("answers", answers)
    checks.seed(seed)
    environment = open_environment(environment)
    table, steps = transition_table(environment), step_limit(environment, max_steps)
    rng = np.random.default_rng([seed, 0])
    points = rng.standard_normal((DRAWS, len(table)))  # the prior
    differences: list[np.ndarray] = []

    def shown(policy: Int[np.ndarray, " s"], number: int) -> Trajectory:
        key = jax.random.key(int(np.random.default_rng([seed, 1, number]).integers(2**31)))
        return rollouts.rollout(environment, tabular(policy, table.shape[1]), key=key, episodes=1, max_steps=steps)[0]

    start = int(np.asarray(shown(np.zeros(len(table), int), 0).states[0]))
    best = shown(planned(table, unit(points[:1]))[0], 0)
    given = 0
    for number in range(1, MOST_QUESTIONS * answers + 1):
        weights = unit(points)
        newcomer = shown(chosen(table, weights, visits(best, len(table)), start=start, steps=steps), number)
        answer = parse_answer(expert(newcomer, best))
        if answer is Answer.SKIP:
            continue
        if answer in (Answer.FIRST, Answer.SECOND):
            sign = 1.0 if answer is Answer.FIRST else -1.0
            differences.append(sign * (visits(newcomer, len(table)) - visits(best, len(table))))
            best = newcomer if answer is Answer.FIRST else best
            points = moved(points, log_likelihood(np.array(differences)), rng, moves=MOVES)
        mean, given = unit(points).mean(axis=0), given + 1
        yield Step(given, len(differences), tabular(planned(table, mean[None])[0], table.shape[1]))
        if given == answers:
            return


def transition_table(environment: gymnasium.Env) -> Float[np.ndarray, "s a s"]:
    """P(s′ | s, a), known; `ValueError` for a task that does not tell it."""
    dynamics: Any = getattr(environment.unwrapped, "dynamics", None)
    if not hasattr(dynamics, "transition_table"):
        raise ValueError(f"baseline pf: expected a task with a known transition_table, got {environment}")
    return np.asarray(dynamics.transition_table())


def preferred_probability(margins: Float[np.ndarray, "..."], width: float = ERROR_WIDTH) -> Float[np.ndarray, "..."]:
    """P(y ≻ x | w) = ½ + z/2M · (1 + log(M/|z|)) where |z| < M, else whether z > 0.

    Args:
      margins: z = wᵀ(ψ(y) − ψ(x)).
      width: M > 0.

    Source: Akrour et al. (2014), section 3.2.
    """
    share = np.clip(np.asarray(margins) / width, -1.0, 1.0)
    return 0.5 + 0.5 * (share - xlogy(share, np.abs(share)))


def log_likelihood(differences: Float[np.ndarray, "k s"]) -> Callable[[np.ndarray], Float[np.ndarray, " n"]]:
    """Log likelihood of N Gaussian points, whose directions are the utilities; rows are ψ(preferred) − ψ(other)."""

    def of(points: Float[np.ndarray, "n s"]) -> Float[np.ndarray, " n"]:
        with np.errstate(divide="ignore"):
            return np.log(preferred_probability(unit(points) @ differences.T)).sum(axis=1)

    return of


def moved(
    points: Float[np.ndarray, "n s"],
    log_p: Callable[[np.ndarray], Float[np.ndarray, " n"]],
    rng: np.random.Generator,
    *,
    moves: int,
) -> Float[np.ndarray, "n s"]:
    """N chains after `moves` elliptical slices each, round the prior N(0, I) (Murray, Adams & MacKay 2010, figure 2).

    A point that the newest answer made impossible moves to any that is possible.
    """
    for _ in range(moves):
        fresh = rng.standard_normal(points.shape)  # figure 2, step 1
        height = np.maximum(log_p(points), -1e9) + np.log(rng.uniform(size=len(points)))  # figure 2, step 2
        angle = rng.uniform(0, 2 * np.pi, len(points))
        low, high = angle - 2 * np.pi, angle  # figure 2, step 3
        while True:
            # figure 2, steps 4 and 5
            turned = points * np.cos(angle)[:, None] + fresh * np.sin(angle)[:, None]
            outside = ~(log_p(turned) > height) & (high - low > 1e-9)
            if not outside.any():
                break
            # figure 2, steps 8 and 9
            low, high = np.where(outside & (angle < 0), angle, low), np.where(outside & (angle >= 0), angle, high)
            angle = np.where(outside, rng.uniform(low, high), angle)
        points = turned
    return points


def planned(
    table: Float[np.ndarray, "s a s"], utilities: Float[np.ndarray, "n s"], discount: float = DISCOUNT
) -> Int[np.ndarray, "n s"]:
    """The optimal action of each state for each of N utilities of the next state, by policy iteration.

    Source: Sutton & Barto (1998), section 4.3.

    Args:
      table: P(s′ | s, a).
      utilities: u(s′).
      discount: γ < 1 of the sum of utilities without end.
    """
    states = np.arange(len(table))
    policies = np.zeros(utilities.shape, dtype=int)
    while True:
        moves = table[states, policies]  # (N, S, S): P of each policy
        rewards = np.einsum("nst,nt->ns", moves, utilities)
        values = np.linalg.solve(np.eye(len(table)) - discount * moves, rewards[..., None])[..., 0]
        q = np.einsum("sat,nt->nsa", table, utilities + discount * values)
        kept = np.take_along_axis(q, policies[..., None], axis=2)[..., 0]
        # rounding must not make two equally good actions change places for ever
        better = np.where(q.max(axis=2) > kept + 1e-10, q.argmax(axis=2), policies)
        if np.array_equal(better, policies):
            return policies
        policies = better


def chosen(
    table: Float[np.ndarray, "s a s"],
    weights: Float[np.ndarray, "n s"],
    best: Float[np.ndarray, " s"],
    *,
    start: int,
    steps: int,
) -> Int[np.ndarray, " s"]:
    """The candidate of highest expected utility of selection against a trajectory with the visits `best`.

    EUS = E_w[wᵀψ(y) P(y ≻ x | w) + wᵀψ(x) P(x ≻ y | w)] over the draws of w; ψ of a candidate are its expected visits.
    """
    policies = np.unique(planned(table, np.vstack([weights, weights.mean(axis=0)])), axis=0)
    utilities = weights @ expected_visits(table, policies, start=start, steps=steps).T
    reached = (weights @ best)[:, None]
    wins = preferred_probability(utilities - reached)
    # Viappiani & Boutilier (2010), with the error model of Akrour et al. (2014)
    return policies[np.argmax((utilities * wins + reached * (1 - wins)).mean(axis=0))]


def expected_visits(
    table: Float[np.ndarray, "s a s"], policies: Int[np.ndarray, "n s"], *, start: int, steps: int
) -> Float[np.ndarray, "n s"]:
    """The expected share of `steps` steps that end in each state, for each policy, from the state `start`."""
    moves = table[np.arange(len(table)), policies]
    now = np.zeros(policies.shape)
    now[:, start] = 1.0
    total = np.zeros(policies.shape)
    for _ in range(steps):
        now = np.matmul(now[:, None], moves)[:, 0]
        total += now
    return total / steps


def visits(trajectory: Trajectory, states: int) -> Float[np.ndarray, " s"]:
    """ψ(τ): the share of the steps that end in each state."""
    return np.bincount(np.asarray(trajectory.states[1:]), minlength=states) / len(trajectory)


def unit(points: Float[np.ndarray, "n s"]) -> Float[np.ndarray, "n s"]:
    """The directions of points."""
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


def tabular(policy: Int[np.ndarray, " s"], actions: int) -> TabularPolicy:
    """A deterministic policy as a table of probabilities."""
    return TabularPolicy(np.eye(actions)[policy])
