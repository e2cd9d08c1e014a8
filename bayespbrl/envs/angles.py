"""Angles on the circle."""

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike


def wrapped(angle: ArrayLike) -> Array:
    """`angle` (rad) brought to [−π, π)."""
    return jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi
