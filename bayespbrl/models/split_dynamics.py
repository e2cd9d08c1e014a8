"""Hamiltonian dynamics split into a Gaussian part, a rotation, and a residual (Shahbaba et al. 2014).

Given many answers the posterior of a smooth likelihood is nearly the Gaussian reference. Whitened by it, a quarter of a
rotation forgets the start, and the gradient of the small residual is needed only a few times on the way.
"""

from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax, random
from jaxtyping import Float, PRNGKeyArray

from bayespbrl.models.likelihoods import Scalar, total_log_prob
from bayespbrl.models.preference_problem import PreferenceProblem

# Gradients in a quarter of a rotation.
GRADIENTS = 4
_State = tuple[Float[Array, " q"], Float[Array, " q"], Float[Array, ""], Float[Array, " q"]]


def split_move(key: PRNGKeyArray, z: Float[Array, " q"], problem: PreferenceProblem) -> Float[Array, " q"]:
    """z after a quarter of a rotation round the reference and a Metropolis test; the problem has an excess."""
    key_velocity, key_test = random.split(key)
    centre = problem.centre
    width, excess = cast(Scalar, problem.width), cast(Scalar, problem.excess)
    margins_at_centre = problem.loadings @ centre

    def residual(x: Float[Array, " q"]) -> Float[Array, ""]:
        """log(posterior / reference) up to a constant, as in `reference_ellipse`."""
        displacement = width * (problem.root @ x)
        margins = problem.loadings @ displacement
        log_likelihood = total_log_prob(problem.likelihood, margins_at_centre + margins, problem.used)
        squares = jnp.sum(problem.site_precisions * margins**2) + excess * jnp.sum(displacement**2)
        return log_likelihood + 0.5 * squares - centre @ displacement / problem.prior_scale**2

    angle = np.pi / 2 / GRADIENTS
    cos, sin = np.cos(angle), np.sin(angle)
    with_gradient = jax.value_and_grad(residual)

    def step(now: _State, _: None) -> tuple[_State, None]:
        x, velocity, _value, gradient = now
        # Shahbaba et al. (2014): half a step by the residual, the Gaussian's rotation, half a step by the residual
        velocity = velocity + angle / 2 * gradient
        x, velocity = x * cos + velocity * sin, velocity * cos - x * sin
        value, gradient = with_gradient(x)
        return (x, velocity + angle / 2 * gradient, value, gradient), None

    x = problem.inverse_root @ (z - centre) / width
    velocity = random.normal(key_velocity, x.shape, dtype=x.dtype)
    value, gradient = with_gradient(x)
    last, _ = lax.scan(step, (x, velocity, value, gradient), None, length=GRADIENTS)
    end, at_end, then, _ = last
    gained = then - value + 0.5 * jnp.sum(x**2 + velocity**2) - 0.5 * jnp.sum(end**2 + at_end**2)
    # the Metropolis test of Shahbaba et al. (2014); NaN compares as false, so that it is rejected
    accepted = jnp.log(random.uniform(key_test, dtype=x.dtype)) < gained
    return jnp.where(accepted, centre + width * (problem.root @ end), z)
