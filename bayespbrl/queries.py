"""Step 4: which of the new trajectories to show against the best so far."""

from collections.abc import Sequence

import numpy as np

from bayespbrl.preferences import Query
from bayespbrl.trajectories import Trajectory


def random_candidates(numbers: Sequence[int], *, rng: np.random.Generator) -> tuple[int, ...]:
    """`numbers` in random order: the first iteration, when there is no estimate yet to choose by (paper, step 4)."""
    return tuple(int(number) for number in rng.permutation(np.asarray(numbers)))


def highest_utility_candidates(numbers: Sequence[int], utilities: np.ndarray) -> tuple[int, ...]:
    """`numbers`, highest expected utility wᵀψ(τ) first (paper, step 4); equal ones in their order.

    Args:
      numbers: the n new trajectories.
      utilities: expected utility of each, shape (n,).
    """
    if utilities.shape != (len(numbers),):
        raise ValueError(f"utilities: expected one for each of {len(numbers)} trajectories, got {utilities.shape}")
    return tuple(int(numbers[index]) for index in np.argsort(-utilities, kind="stable"))


def show(
    number: int, newcomer: int, incumbent: int, trajectories: Sequence[Trajectory], *, rng: np.random.Generator
) -> Query:
    """The question "newcomer or incumbent?", in an order drawn at random, so that no side is favoured."""
    first, second = (newcomer, incumbent) if rng.random() < 0.5 else (incumbent, newcomer)
    return Query(number, first, second, newcomer, (trajectories[first], trajectories[second]))
