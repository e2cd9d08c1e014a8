"""Angles on the circle."""

from typing import Any

import jax
import jax.numpy as jnp


def wrapped(angle: Any) -> jax.Array:
    """`angle` (rad) brought to [−π, π)."""
    return jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi
