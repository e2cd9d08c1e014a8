"""Trajectories τ = (s₀, a₀, s₁, …, s_T): what step 3 produces and what experts compare (paper, MDP\\R)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Shaped

from bayespbrl.checks import finite

DISCOUNT = 0.98  # γ of Q, and of ψ(τ) where no learner says otherwise; the paper's


@dataclass(frozen=True, repr=False, eq=False)
class Trajectory:
    """One trajectory of T steps; lists become arrays, which are read-only. It equals itself alone.

    Attributes:
      states: s₀ … s_T as the learner observes them; shape (T+1, S) float, or (T+1,) int, counted from 0, where
        observations are discrete. Of several parts or dimensions they are flattened as gymnasium does, discrete parts
        one-hot; so are discrete observations where actions are continuous.
      actions: a₀ … a_{T−1}; shape (T, A) float, or (T,) int, counted from 0, where actions are discrete.
      rewards: the environment's hidden reward of each step. Only experts and evaluation read it.
      terminated: whether s_T is terminal (a time limit is not).

    Raises:
      ValueError: lengths that do not fit together, or an entry that is no finite number.
    """

    states: Shaped[np.ndarray, "t1 ..."]
    actions: Shaped[np.ndarray, "t ..."]
    rewards: Float[np.ndarray, " t"]
    terminated: bool = False

    def __post_init__(self) -> None:
        for name in ("states", "actions", "rewards"):
            given = getattr(self, name)
            finite(f"trajectory: {name}", given)
            if np.ndim(given) == 0:
                raise ValueError(f"trajectory: {name}: expected one entry for each step, got {given!r}")
            values = np.asarray(given)
            whole = values.dtype.kind in "iub" and (values.ndim == 2 or name == "rewards")
            kept = np.array(values, dtype=np.float64 if whole else None)  # whose buffers may be filled anew
            kept.flags.writeable = False  # experts, query rules and schedules of the user's see what is learned from
            object.__setattr__(self, name, kept)  # how a frozen dataclass sets an attribute
        steps = len(self.actions)
        if steps == 0:
            raise ValueError("trajectory: expected at least one step, got none")
        if len(self.states) != steps + 1 or len(self.rewards) != steps:
            raise ValueError(
                f"trajectory: expected T+1 states, T actions and T rewards, got {len(self.states)} states, "
                f"{steps} actions and {len(self.rewards)} rewards"
            )

    def __repr__(self) -> str:
        return f"Trajectory(steps={len(self)}, terminated={self.terminated})"

    def __len__(self) -> int:
        """Number of steps T."""
        return len(self.actions)

    def clip(self, first: int, steps: int) -> "Trajectory":
        """The part of at most `steps` steps that begins with step `first`, from 0."""
        last = min(first + steps, len(self))
        ends = self.terminated and last == len(self)
        return Trajectory(self.states[first : last + 1], self.actions[first:last], self.rewards[first:last], ends)

    @property
    def total_reward(self) -> float:
        """Undiscounted sum of the hidden reward."""
        return float(np.sum(self.rewards))


def clips_of(trajectories: Sequence[Trajectory], clips: Sequence[Sequence[int]] | None) -> tuple[Trajectory, ...]:
    """The part of each trajectory with this first step and number of steps; None: the trajectories."""
    if clips is None:
        return tuple(trajectories)
    return tuple(one.clip(first, steps) for one, (first, steps) in zip(trajectories, clips, strict=True))


@dataclass(frozen=True)
class Transitions:
    """All steps (sᵢ, aᵢ, sᵢ′) of several trajectories, one row each, in their order.

    Attributes:
      states, actions, next_states: shapes (N, S), (N, A), (N, S), or (N,) where discrete.
      rewards: hidden reward.
      terminal: whether sᵢ′ is terminal.
    """

    states: Shaped[np.ndarray, "n ..."]
    actions: Shaped[np.ndarray, "n ..."]
    next_states: Shaped[np.ndarray, "n ..."]
    rewards: Float[np.ndarray, " n"]
    terminal: Bool[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.actions)

    def at(self, rows: Shaped[np.ndarray, " m"]) -> "Transitions":
        """These rows of the table, by index or as a mask."""
        return Transitions(*(column[rows] for column in vars(self).values()))


def transitions(trajectories: Sequence[Trajectory]) -> Transitions:
    """The steps of `trajectories` as one table."""
    if not trajectories:
        raise ValueError("transitions: expected at least one trajectory, got none")
    terminal = [np.arange(len(t)) == (len(t) - 1 if t.terminated else -1) for t in trajectories]
    return Transitions(
        states=np.concatenate([t.states[:-1] for t in trajectories]),
        actions=np.concatenate([t.actions for t in trajectories]),
        next_states=np.concatenate([t.states[1:] for t in trajectories]),
        rewards=np.concatenate([t.rewards for t in trajectories]),
        terminal=np.concatenate(terminal),
    )


Features = Callable[[Shaped[np.ndarray, "n ..."]], Shaped[np.ndarray, "n d"]]


def step_features(
    features: Features, next_states: Shaped[np.ndarray, "n ..."], actions: Shaped[np.ndarray, "n ..."] | None
) -> Shaped[np.ndarray, "n d"]:
    """φ of n steps: of the next state, and of the action where φ has a feature of it (`of_steps`); None: of states."""
    of_steps = None if actions is None else getattr(features, "of_steps", None)
    return features(next_states) if of_steps is None else of_steps(next_states, actions)


def trajectory_features(
    trajectories: Sequence[Trajectory],
    features: Features,
    *,
    discount: float,
) -> Float[np.ndarray, "m d"]:
    """ψ(τ) = Σₜ γᵗ φ(sₜ₊₁), t = 0 … T−1, of each trajectory.

    Decision: features of the *next* state, as in the authors' published implementation and as in LSTD here. The paper
    (eq. 1) sums from s₀, which no choice of the policy can change.

    Args:
      trajectories: of any lengths.
      features: φ(s), or that of steps (`step_features`).
      discount: γ in [0, 1].
    """
    if not trajectories:
        raise ValueError("trajectory_features: expected at least one trajectory, got none")
    states, actions = (
        np.concatenate([t.states[1:] for t in trajectories]),
        np.concatenate([t.actions for t in trajectories]),
    )
    table = step_features(features, states, actions)
    discounts = np.concatenate([discount ** np.arange(len(t)) for t in trajectories])
    starts = np.cumsum([0] + [len(t) for t in trajectories[:-1]])
    return np.add.reduceat(table * discounts[:, None], starts, axis=0)  # eq. 1


def same_starts(trajectories: Sequence[Trajectory]) -> list[list[int]]:
    """The numbers of the trajectories, grouped by their start."""
    groups: dict[bytes, list[int]] = {}
    for number, trajectory in enumerate(trajectories):
        groups.setdefault(np.asarray(trajectory.states[0]).tobytes(), []).append(number)
    return list(groups.values())
