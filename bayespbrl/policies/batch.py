"""A policy at many observations: any N, in chunks of one size, so that each function compiles once per policy type."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Key, Shaped
from numpy.typing import ArrayLike

from bayespbrl.policies.policy import AnyArray, Policy, Sampler, WithDensity

CHUNK = 1024


def sample_rows(
    policy: Sampler, keys: Key[Array, " n"], observations: Shaped[AnyArray, "n ..."]
) -> Shaped[Array, "n ..."]:
    """One action for each key and observation, traceable; an action may be a list of numbers."""
    return jax.vmap(lambda key, observation: jnp.asarray(policy.sample(key, observation)))(keys, observations)


@jax.jit
def _sample_chunk(
    policy: Sampler, key: Key[Array, ""], start: Shaped[AnyArray, ""], observations: Shaped[AnyArray, "n ..."]
) -> Shaped[Array, "n ..."]:
    rows = start + jnp.arange(CHUNK, dtype=jnp.uint32)
    # one key per row, made from the row's number: the padding and the chunk size cannot change what a row draws
    keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, rows)
    return sample_rows(policy, keys, observations)


@jax.jit
def _log_prob_chunk(
    policy: WithDensity, observations: Shaped[AnyArray, "n ..."], actions: Shaped[AnyArray, "n ..."]
) -> Float[Array, " n"]:
    return jax.vmap(policy.log_prob)(observations, actions)


@jax.jit
def _entropy_chunk(policy: Policy, observations: Shaped[AnyArray, "n ..."]) -> Float[Array, " n"]:
    return jax.vmap(policy.entropy)(observations)


def sample_actions(policy: Sampler, key: Key[Array, ""], observations: ArrayLike) -> Shaped[np.ndarray, "n ..."]:
    """One action aᵢ ~ π(·|sᵢ) for each observation, float64 vectors, or int64 where actions are discrete.

    Row i depends on `key` and i alone, not on N. Continuous actions are not clipped.
    """
    with jax.enable_x64(True):
        return _in_chunks(lambda start, rows: _sample_chunk(policy, key, np.uint32(start), rows), observations)


def log_probabilities(policy: WithDensity, observations: ArrayLike, actions: ArrayLike) -> Float[np.ndarray, " n"]:
    """log π(aᵢ|sᵢ) for each row."""
    observations, actions = np.asarray(observations), np.asarray(actions)
    if len(observations) != len(actions):
        raise ValueError(f"actions: expected {len(observations)} rows, one for each observation, got {len(actions)}")
    with jax.enable_x64(True):
        return _in_chunks(lambda _, *rows: _log_prob_chunk(policy, *rows), observations, actions)


def entropies(policy: Policy, observations: ArrayLike) -> Float[np.ndarray, " n"]:
    """Entropy of π(·|sᵢ) in nats for each observation."""
    with jax.enable_x64(True):
        return _in_chunks(lambda _, rows: _entropy_chunk(policy, rows), observations)


def _in_chunks(function: Callable[..., Shaped[Array, "n ..."]], *given: ArrayLike) -> Shaped[np.ndarray, "n ..."]:
    """`function(start, *rows)` of CHUNK rows of `given` at a time; the last chunk repeats the last row."""
    arrays = [np.asarray(a) for a in given]
    number = len(arrays[0])
    if number == 0:
        raise ValueError("observations: expected at least one row, got none")
    results = []
    for start in range(0, number, CHUNK):
        chunk = np.minimum(np.arange(start, start + CHUNK), number - 1)
        results.append(np.asarray(function(start, *(a[chunk] for a in arrays))))
    return np.concatenate(results)[:number]
