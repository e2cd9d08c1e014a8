"""Linear PBIRL: the utility weights that violate the answers least (eq. 10), as a linear program."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from bayespbrl import checks


@dataclass(frozen=True)
class LinearProgramResult:
    """Solution of eq. 10.

    Attributes:
      weights: w, |w_j| ≤ 1.
      objective: Σ_k c(d_k), c(x) = x for x > 0 and 2x otherwise.
      status: the solver's own words.
      converged: whether the solver reports an optimum.
    """

    weights: Float[np.ndarray, " d"]
    objective: float
    status: str
    converged: bool


def linear_program(differences: ArrayLike) -> LinearProgramResult:
    """Maximise Σ_k c(d_k) over |w_j| ≤ 1 with d = differences @ w (eq. 10), by HiGHS through CasADi.

    c is concave, c(x) = min(x, 2x), so the maximum is a linear program: max Σ t_k, t_k ≤ d_k, t_k ≤ 2 d_k. With
    d_k = p_k − n_k, p, n ≥ 0, it is max Σ p_k − 2 n_k under K equations, half as many rows.

    The weight of a feature that is zero in all rows is free; the solver leaves it at its lower bound, −1. So a one-hot
    state that no trajectory visits is worth least, whereas the posterior mean is 0 there.

    Args:
      differences: ψ(preferred) − ψ(dominated), shape (K, D), used as given.

    Raises:
      ValueError: `differences` is not a finite matrix.
    """
    differences = checks.matrix("differences", differences)
    number, dimension = differences.shape
    if number == 0 or dimension == 0:
        return LinearProgramResult(np.zeros(dimension), 0.0, "nothing to solve", True)
    # eq. 10, with c of eq. 9; variables (w, p, n): Ψw − p + n = 0, cost −Σ p_k + 2 Σ n_k
    largest = float(np.max(np.abs(differences)))
    # the solver's tolerances are absolute; the weights are the same in any unit
    scale = largest if largest > 0 and not 1e-3 < largest < 1e3 else 1.0
    constraints = ca.DM(np.hstack([differences / scale, -np.eye(number), np.eye(number)]))
    cost = np.concatenate([np.zeros(dimension), -np.ones(number), 2 * np.ones(number)])
    solver = ca.conic(
        "linear_program",
        "highs",
        {"a": constraints.sparsity(), "h": ca.Sparsity(len(cost), len(cost))},
        {"error_on_fail": False, "highs": {"output_flag": False}},
    )
    lower = np.concatenate([-np.ones(dimension), np.zeros(2 * number)])  # eq. 9: |w_j| ≤ 1
    upper = np.concatenate([np.ones(dimension), np.full(2 * number, np.inf)])
    solution = solver(a=constraints, g=cost, lbx=lower, ubx=upper, lba=0, uba=0)
    statistics = solver.stats()
    # the bounds hold to the solver's tolerance; clipping makes them exact
    weights = np.clip(np.asarray(solution["x"]).ravel()[:dimension], -1, 1)
    margins = differences @ weights
    return LinearProgramResult(
        weights,
        float(np.sum(np.minimum(margins, 2 * margins))),  # eq. 10
        str(statistics["return_status"]),
        bool(statistics["success"]),
    )
