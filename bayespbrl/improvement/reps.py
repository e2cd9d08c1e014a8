"""Actor-critic REPS: sample weights that raise Q within a KL bound (paper, step 2, eqs. 11-13)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float, Int, Shaped
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from bayespbrl import checks
from bayespbrl.improvement.whitening import PerSample, WhitenedFeatures, regressed, whitened

TEMPERATURE_FLOOR = 1e-3  # in standard deviations of Q; a bound that asks for less is not active
TEMPERATURE_CEILING = 1e9  # KL is 1e-18 there, less than its rounding
HIGHER_FLOORS = (1e-2, 1e-1)  # where the solver does not finish near the floor
LEAST_ADVANTAGE = 5e-3  # spread of the advantages over that of Q; with less, the floor would end each step too early
ITERATIONS = 500  # cap of the solver; some twenty are usual
CONSTANT = "constant Q: nothing to gain"


@dataclass(frozen=True)
class RepsSolution:
    """Solution of the REPS dual and how well it meets its two conditions.

    Attributes:
      sample_weights: wᵢ = pᵢ/Wᵢ for the weighted fit of eq. 14, mean 1 under W.
      probabilities: pᵢ of eq. 12, sum 1.
      value_weights: v with V(s) = vᵀφ(s) up to a constant, in the units of Q.
      temperature: η in the units of Q.
      kl: KL(p‖W) in nats.
      kl_bound: ε that was asked for, in nats.
      feature_gap: largest |Σ pᵢφᵢ − φ̂| in the whitened features.
      feature_gap_raw: the same in the features as given, the dropped directions among them.
      rank_kept: number of whitened directions.
      converged: whether the solver met its tolerance.
      status: the solver's message.
    """

    sample_weights: PerSample
    probabilities: PerSample
    value_weights: Float[np.ndarray, " d"]
    temperature: float
    kl: float
    kl_bound: float
    feature_gap: float
    feature_gap_raw: float
    rank_kept: int
    converged: bool
    status: str

    @property
    def bound_active(self) -> bool:
        """Whether the bound holds with equality; otherwise no admissible p is that far from W."""
        return bool(abs(self.kl - self.kl_bound) <= 0.01 * self.kl_bound)

    @property
    def effective_samples(self) -> float:
        """The effective sample size 1/Σ pᵢ² (Kish 1965)."""
        return float(1 / np.sum(self.probabilities**2))


def reps_weights(
    q_values: ArrayLike,
    state_features: ArrayLike,
    base_weights: ArrayLike,
    *,
    kl_bound: float,
    constraint: WhitenedFeatures | None = None,
) -> RepsSolution:
    """Maximise Σ pᵢQᵢ subject to KL(p‖W) ≤ ε and Σ pᵢφᵢ = φ̂ by the dual of eq. 13.

    The dual in raw radial basis features is ill-conditioned, so the features are whitened and Q is standardised.
    CasADi's IPOPT with limited-memory Hessian then needs some twenty iterations.

    Args:
      q_values: Qᵢ, shape (N,).
      state_features: φ(sᵢ), shape (N, D).
      base_weights: Wᵢ > 0 with sum 1, shape (N,): 1/N for fresh samples of the policy, q(a|s) × visits for all actions
        of each visited state.
      kl_bound: ε > 0, nats.
      constraint: φ `whitened` under W, where it is at hand.

    Raises:
      ValueError: shapes that do not fit, a bound that is not positive and finite, entries that are not finite.

    Source: paper, eqs. 11-13; Daniel, Neumann and Peters (2012) for the feature constraint.
    """
    q, phi, base = _checked_samples(q_values, state_features, base_weights, kl_bound)
    if phi.ndim != 2:
        raise ValueError(f"state_features: expected shape (N, D), got {phi.shape}")
    constraint = whitened(phi, base) if constraint is None else constraint
    features = constraint.features
    scaled, scale, known = _standardised(q, features, base)
    temperature, converged, status = 1.0, True, CONSTANT
    standardised, dual = np.zeros_like(q), np.zeros(features.shape[1])  # the weights that change nothing
    if scaled.any():
        reached, multipliers, converged, status = _solve_dual(scaled, features, base, kl_bound)
        if converged:  # what an unfinished solver leaves is no update: stay where we are, and say so
            temperature, dual, standardised = reached, multipliers, scaled
    logits = np.log(base) + (standardised - features @ dual) / temperature  # eq. 12
    probabilities = np.exp(logits - np.max(logits))
    probabilities /= np.sum(probabilities)  # eq. 12
    positive = probabilities > 0
    return RepsSolution(
        sample_weights=probabilities / base,  # eq. 14; mean Σ W·p/W = 1 by construction
        probabilities=probabilities,
        value_weights=constraint.mapping @ (known + scale * dual),  # eq. 12: V(s) = vᵀφ(s) + constant
        temperature=scale * temperature,
        kl=float(probabilities[positive] @ np.log((probabilities / base)[positive])),  # eq. 11
        kl_bound=kl_bound,
        feature_gap=float(np.max(np.abs(probabilities @ features), initial=0.0)),  # eq. 11
        feature_gap_raw=float(np.max(np.abs((probabilities - base) @ phi), initial=0.0)),  # eq. 11
        rank_kept=features.shape[1],
        converged=converged,
        status=status,
    )


def _standardised(
    q_values: PerSample, features: Float[np.ndarray, "n r"], base_weights: PerSample
) -> tuple[PerSample, float, Float[np.ndarray, " r"]]:
    """Q centred and divided by its spread, that spread, and the weights of a part of V(s) that was taken off before.

    It is taken off where Q differs far more between states than between actions: it is the same for all admissible p,
    and beside it nothing else would be seen. All is zero where only rounding is left: what LSTD's penalties leave of a
    constant Q is noise, and must not be blown up to the size of the bound.
    """
    centred, of_states, advantage = regressed(q_values, features, base_weights)
    spread, gain = (float(np.sqrt(base_weights @ each**2)) for each in (centred, advantage))
    if spread > 1e-8 * np.abs(base_weights @ q_values) and gain >= LEAST_ADVANTAGE * spread:
        return centred / spread, spread, np.zeros_like(of_states)
    if gain > 1e-8 * np.max(np.abs(q_values)):
        return advantage / gain, gain, of_states
    return np.zeros_like(q_values), 1.0, of_states


def reps_weights_by_state(
    q_values: ArrayLike, states: ArrayLike, base_weights: ArrayLike, *, kl_bound: float
) -> RepsSolution:
    """Maximise Σ pᵢQᵢ subject to KL(p‖W) ≤ ε and p(s) = W(s) for every single state: `reps_weights` with one-hot φ.

    For all actions of each visited state, where that leaves the actions free. Then p(a|s) ∝ q(a|s) exp(Q(s, a)/η) and
    V(s) = η log Σₐ q(a|s) exp(Q(s, a)/η), and one number is left to find, the temperature.

    Args:
      q_values: Qᵢ, shape (N,).
      states: number of the state of each sample, shape (N,) int; 0 … n − 1, and each of them occurs.
      base_weights: Wᵢ = q(a|s) × visits > 0 with sum 1, shape (N,).
      kl_bound: ε > 0, nats.

    Raises:
      ValueError: as `reps_weights`.

    Source: paper, eqs. 11-13, in the limit of features that tell all states apart.
    """
    q, states, base = _checked_samples(q_values, states, base_weights, kl_bound)
    if states.ndim != 1 or states.dtype.kind not in "iu" or np.any(states < 0):
        raise ValueError(f"states: expected whole numbers from 0, shape (N,), got {states.dtype} of {states.shape}")
    visits = np.bincount(states, weights=base)
    if np.any(visits == 0):
        raise ValueError(f"states: expected each of 0 … {len(visits) - 1}, got no {np.argmin(visits)}")
    means = np.bincount(states, weights=base * q) / visits
    spread = np.sqrt(base @ (q - means[states]) ** 2)
    constant = not spread > 1e-8 * np.max(np.abs(q))
    scaled = np.zeros_like(q) if constant else (q - means[states]) / spread
    logarithms = np.log(base / visits[states])
    by_state = partial(_exponential, logarithms=logarithms, q_values=scaled, states=states, visits=visits)
    temperature = 1.0 if constant else _temperature(lambda eta: by_state(eta)[2], kl_bound)
    chances, values, kl = by_state(temperature)
    probabilities = visits[states] * chances  # eq. 12
    gap = float(np.max(np.abs(np.bincount(states, weights=probabilities) - visits)))  # eq. 11
    return RepsSolution(
        sample_weights=probabilities / base,  # eq. 14
        probabilities=probabilities,
        value_weights=means if constant else means + spread * values,
        temperature=1.0 if constant else float(spread * temperature),
        kl=kl,
        kl_bound=kl_bound,
        feature_gap=gap,
        feature_gap_raw=gap,
        rank_kept=int(np.sum(visits > 0)) - 1,
        converged=True,
        status=CONSTANT if constant else "a root of one equation",
    )


def _exponential(
    temperature: float,
    logarithms: PerSample,
    q_values: PerSample,
    states: Int[np.ndarray, " n"],
    visits: Float[np.ndarray, " s"],
) -> tuple[PerSample, Float[np.ndarray, " s"], float]:
    """p(a|s) ∝ q(a|s) exp(Q(s, a)/η), V(s) and KL(p‖W), from log q(a|s), Q, the number of each state and W(s)."""
    logits = logarithms + q_values / temperature  # eq. 12
    highest = np.full(len(visits), -np.inf)
    np.maximum.at(highest, states, logits)
    normaliser = highest + np.log(np.bincount(states, weights=np.exp(logits - highest[states])))
    logits = logits - normaliser[states]
    chances = np.exp(logits)
    # V(s) that normalises eq. 12 in every state, and KL of eq. 11
    return chances, temperature * normaliser, float((visits[states] * chances) @ (logits - logarithms))


def _temperature(kl: Callable[[float], float], kl_bound: float) -> float:
    """The η at which KL(p‖W) = ε, where the dual of eq. 13 has its minimum; the floor where no η reaches ε.

    A bound below the rounding of KL gets an η at which nothing moves.
    """
    low, high = TEMPERATURE_FLOOR, 1.0
    if kl(low) <= kl_bound:
        return low
    while kl(high) > kl_bound:  # KL falls as 1/η²
        high *= 10
        if high >= TEMPERATURE_CEILING:
            return high
    # eq. 11, with equality
    logarithm = brentq(lambda value: kl(float(np.exp(value))) - kl_bound, np.log(low), np.log(high), xtol=1e-12)
    return float(np.exp(logarithm))


def advantages(
    q_values: PerSample, constraint: WhitenedFeatures | Int[np.ndarray, " n"], base_weights: PerSample
) -> PerSample:
    """Aᵢ = Qᵢ − V(sᵢ) of eq. 12, with V the regression of Q on the constraint's features under W.

    The limit of REPS at small bounds: p − W → √(2ε/E[A²])·W·A. Zero where only rounding is left of it.

    Args:
      q_values: Qᵢ.
      constraint: the whitened features, or the number of each sample's state where it is to hold for each.
      base_weights: Wᵢ.
    """
    if isinstance(constraint, WhitenedFeatures):
        *_, advantage = regressed(q_values, constraint.features, base_weights)
    else:
        visits = np.bincount(constraint, weights=base_weights)
        advantage = q_values - (np.bincount(constraint, weights=base_weights * q_values) / visits)[constraint]
    rounding = not np.sqrt(base_weights @ advantage**2) > 1e-8 * np.max(np.abs(q_values))
    return np.zeros_like(q_values) if rounding else advantage


def _checked_samples(
    q_values: ArrayLike, states: ArrayLike, base_weights: ArrayLike, kl_bound: float
) -> tuple[PerSample, Shaped[np.ndarray, "n ..."], PerSample]:
    q_values, states, base_weights = np.asarray(q_values), np.asarray(states), np.asarray(base_weights)
    size = q_values.size
    if size == 0 or q_values.shape != (size,) or base_weights.shape != (size,) or states.shape[:1] != (size,):
        raise ValueError(
            "reps_weights: expected q_values (N,), state_features (N, D) and base_weights (N,), N > 0, got "
            f"{q_values.shape}, {states.shape} and {base_weights.shape}"
        )
    checks.positive("kl_bound", kl_bound)
    for name, array in (("q_values", q_values), ("state_features", states), ("base_weights", base_weights)):
        checks.finite(name, array)
    if np.any(base_weights <= 0) or abs(np.sum(base_weights) - 1) > 1e-6:
        least, total = np.min(base_weights), np.sum(base_weights)
        raise ValueError(f"base_weights: expected positive entries with sum 1, got least {least:g} and sum {total:g}")
    return q_values, states, base_weights


def _solve_dual(
    q_values: PerSample, features: Float[np.ndarray, "n r"], base_weights: PerSample, kl_bound: float
) -> tuple[float, Float[np.ndarray, " r"], bool, str]:
    """Minimise g(η, v) = ηε + η log Σ Wᵢ exp((Qᵢ − vᵀφᵢ)/η) (eq. 13 with φ̂ = 0) over η ≥ floor and v.

    Near the floor, where a large bound leads, g is nearly a maximum of linear functions, and the solver may not finish.
    A higher floor then takes nearly as greedy a step.
    """
    rank = features.shape[1]
    unknown: Any = ca.MX.sym("eta_and_v", 1 + rank)
    eta = unknown[0]
    advantage: Any = ca.DM(q_values)
    if rank:
        advantage = advantage - ca.mtimes(ca.DM(features), unknown[1:])  # eq. 13: Q − vᵀφ
    logits = ca.DM(np.log(base_weights)) + advantage / eta
    dual = eta * kl_bound + eta * ca.logsumexp(logits)  # eq. 13
    options: dict[str, Any] = {
        "print_time": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.hessian_approximation": "limited-memory",
        "ipopt.limited_memory_max_history": 6,  # a longer one saves no iterations
        "ipopt.tol": 1e-8,
        "ipopt.max_iter": ITERATIONS,
    }
    problem: Any = {"x": unknown, "f": dual}
    solver = ca.nlpsol("reps_dual", "ipopt", problem, options)
    start = np.concatenate([[1.0], np.zeros(rank)])
    for floor in (TEMPERATURE_FLOOR, *HIGHER_FLOORS):
        lower = np.concatenate([[floor], np.full(rank, -np.inf)])
        solution = np.asarray(solver(x0=start, lbx=lower, ubx=np.inf)["x"]).ravel()
        statistics = solver.stats()
        if statistics["success"] or solution[0] > 2 * floor:
            break
    return float(solution[0]), solution[1:], bool(statistics["success"]), str(statistics["return_status"])
