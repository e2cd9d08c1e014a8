"""Features of discrete states, which are numbers: one-hot, or smooth over the steps that join them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from bayespbrl.checks import indices
from bayespbrl.trajectories import Trajectory

DIFFUSION_STEPS = 1 / 3  # the length scale of a diffusion basis as drawn: states are nearly independent
MOST_CONNECTED = 1000  # discrete states of a diffusion basis; the eigenvectors of so many take a third of a second


@dataclass(frozen=True, eq=False)
class OneHot:
    """φ(s) = e_s for discrete states: the paper's tabular model, in which linear functions are exact (step 1).

    Attributes:
      number_of_states: S.
      lengths: c of φ(s) = c_s e_s, or one number for all.
    """

    number_of_states: int
    lengths: Float[np.ndarray, " s"] | float = 1.0

    def __call__(self, observations: ArrayLike) -> Float[np.ndarray, "n {self.number_of_states}"]:
        """Features of N integer observations."""
        observations = indices("observations", observations, self.number_of_states)
        features = np.zeros((len(observations), self.number_of_states))
        lengths = np.broadcast_to(self.lengths, self.number_of_states)
        features[np.arange(len(observations)), observations] = lengths[observations]
        return features


@dataclass(frozen=True, eq=False)
class DiffusionBasis:
    """φ(s) = V_s exp(−¼ b² Λ), divided by its length, for discrete states: VΛVᵀ is the Laplacian of a graph of them.

    A linear function of φ with independent standard normal weights is a Gaussian process whose covariance is the
    diffusion kernel exp(−½ b² L), scaled to a variance of one: states that few steps part have similar values. At b = 0
    all states are independent, as with `OneHot`.

    Attributes:
      eigenvectors, eigenvalues: V and Λ.
      bandwidths: b, the length scale in steps.

    Source: Kondor & Lafferty (2002).
    """

    eigenvectors: Float[np.ndarray, "d d"]
    eigenvalues: Float[np.ndarray, " d"]
    bandwidths: Float[np.ndarray, "1"]

    def __call__(self, observations: ArrayLike) -> Float[np.ndarray, "n d"]:
        """Features of N integer observations."""
        observations = indices("observations", observations, len(self.eigenvalues))
        rows = self.eigenvectors * np.exp(-0.25 * self.bandwidths**2 * self.eigenvalues)  # Kondor & Lafferty (2002)
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        return rows[observations]

    def rescaled(self, multiples: ArrayLike) -> Self:
        """The same graph with a length scale `multiples` times as long."""
        return replace(self, bandwidths=self.bandwidths * np.asarray(multiples))


def standardised(trajectories: Sequence[Trajectory], number_of_states: int) -> OneHot:
    """One-hot features that vary alike between trajectories: divided by the standard deviation of a state's visits.

    Where weights are alike a priori, a goal that few trajectories reach, once each, would hardly count beside states in
    which they stay. What all visit equally often, or none, is divided by what one visit in all would give.
    """
    paths = [indices("states", trajectory.states, number_of_states) for trajectory in trajectories]
    # utilities are of the states that steps lead to
    visits = np.array([np.bincount(states[1:], minlength=number_of_states) for states in paths])
    deviations = np.sqrt(np.maximum(visits.var(axis=0), 1 / len(trajectories)))
    return OneHot(number_of_states, 1 / deviations)


def diffusion_basis(trajectories: Sequence[Trajectory], number_of_states: int) -> DiffusionBasis:
    """The basis of the graph that joins two states where some trajectory stepped from one to the other."""
    edges = np.zeros((number_of_states, number_of_states))
    for trajectory in trajectories:
        states = indices("states", trajectory.states, number_of_states)
        edges[states[:-1], states[1:]] = 1.0
    edges = np.maximum(edges, edges.T)
    np.fill_diagonal(edges, 0.0)
    eigenvalues, eigenvectors = np.linalg.eigh(np.diag(edges.sum(axis=1)) - edges)  # Kondor & Lafferty (2002)
    return DiffusionBasis(eigenvectors, np.maximum(eigenvalues, 0.0), np.array([DIFFUSION_STEPS]))
