"""Tempered transitions: a walk through flatter and flatter distributions and back, accepted or refused as a whole.

Answers that contradict each other leave a posterior with several modes, each of which violates others of them. Between
two modes many are violated at once. A walk on which violations cost less and less, and then more and more again, leads
from one mode to another; what it costs on the way is paid in a Metropolis test (Neal 1996).
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

import jax.numpy as jnp
import numpy as np
from jax import Array, lax, random
from jaxtyping import Float, PRNGKeyArray

# Of the log likelihood at the flattest level, and number of levels: of a few tried, these gave most effective draws a
# second.
LEAST_SHARE, LEVELS = 0.4, 8
SHARES = np.linspace(1.0, LEAST_SHARE, LEVELS + 1)[1:]

State = TypeVar("State")
Move = Callable[[PRNGKeyArray, State, Float[Array, ""]], State]


def walked(
    key: PRNGKeyArray, start: State, moves: Sequence[Move[State]], height: Callable[[State], Float[Array, ""]]
) -> tuple[State, Float[Array, ""]]:
    """The state at the end of a walk, and the logarithm of the ratio that a Metropolis test compares with 1.

    Args:
      key: random key.
      start: the state at the start.
      moves: made at each level in this order, on the way back in the other; each is reversible with respect to
        prior × exp(share × height), for a share of `SHARES`.
      height: the log likelihood of a state.
    """
    shares = jnp.asarray(np.concatenate([[1.0], SHARES]))

    def level(
        now: tuple[State, Float[Array, ""]],
        step: tuple[PRNGKeyArray, Float[Array, ""], Float[Array, ""]],
        *,
        back: bool,
    ) -> tuple[tuple[State, Float[Array, ""]], None]:
        """To the flatter share and the moves there; or these, and from it."""
        (state, gained), (key, share, flatter) = now, step
        each = list(zip(moves, random.split(key, len(moves)), strict=True))
        # Neal (1996): log p(x) after a change of the share, less that before
        if not back:
            gained += (flatter - share) * height(state)
        for move, its in reversed(each) if back else each:
            state = move(its, state, flatter)
        if back:
            gained += (share - flatter) * height(state)
        return (state, gained), None

    key_forth, key_back = random.split(key)
    forth = random.split(key_forth, LEVELS), shares[:-1], shares[1:]
    now, _ = lax.scan(partial(level, back=False), (start, jnp.zeros(())), forth)
    back = random.split(key_back, LEVELS), shares[-2::-1], shares[:0:-1]
    (end, gained), _ = lax.scan(partial(level, back=True), now, back)
    return end, gained
