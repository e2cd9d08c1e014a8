"""Expectation propagation: a Gaussian close to the posterior of z given margins t = L z, and its evidence (Minka 2001).

Each answer's factor p_k(t_k) is replaced by a Gaussian in t_k; all factors are updated at once, damped. NumPy is fast
enough: a fit is a handful of small dense factorisations.

Answers about the same margin up to a factor, as when two trajectories are compared again, share one Gaussian, whose
moments are found by quadrature. With a Gaussian each, every one would be fitted to what the others leave, and of twelve
answers for and four against a margin only those of the four might remain.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import log_ndtr, ndtr

from bayespbrl.models.likelihoods import ProbitMixture

MAX_SWEEPS = 200  # updates of all factors
DAMPING = 0.85  # share of each update that is taken, in (0, 1]; reduced whenever the changes grow
TOLERANCE = 1e-6  # change of the margins' moments, in standard deviations, that counts as none
# Prior variance of a margin over that of its site, beyond which the site is taken for a runaway. A step has no scale:
# answers that contradict each other about nearly the same margin each cut a part off whatever the others leave. Their
# sites grow by a factor at every sweep, until the linear algebra breaks down near 1e16.
RUNAWAY = 1e12
SAME = 1e-10  # of the cosine between two rows of L, below 1, where they are about the same margin
FAR = 700.0  # exp of more is no number
LOST = 1e-11  # of a tie's probability, over its two terms: less is rounding
# Panels on which one factor of several answers is integrated: to where the Gaussian ends, in its standard deviations,
# and narrower ones towards the offsets.
WIDE, GROWTH = np.linspace(-12, 12, 49), 1.5
NODES, NODE_WEIGHTS = np.polynomial.legendre.leggauss(10)


@dataclass(frozen=True)
class GaussianApproximation:
    """N(mean, covariance) in r dimensions, as expectation propagation left it.

    Attributes:
      mean, covariance: of z.
      site_precisions: τ of the factors exp(−τ t²/2 + ν t) that stand for the answers. Of several answers about the same
        margin the first has the factor of all. Zero where there is none, because the answer is contradicted by others
        about nearly the same margin.
      log_evidence: the estimate of log ∫ p(answers | z) p(z) dz, nats.
      converged: whether the last update changed the margins' means and standard deviations by less than the tolerance,
        and every answer has a part in a factor.
    """

    mean: Float[np.ndarray, " r"]
    covariance: Float[np.ndarray, "r r"]
    site_precisions: Float[np.ndarray, " k"]
    log_evidence: float
    converged: bool


class _Gaussian(NamedTuple):
    """Moments of z and of the margins t, and log ∫ N(z; 0, σ²I) Π exp(−τ t²/2 + ν t) dz."""

    mean: Float[np.ndarray, " r"]
    covariance: Float[np.ndarray, "r r"]
    t_mean: Float[np.ndarray, " k"]
    t_variance: Float[np.ndarray, " k"]
    log_normaliser: float


class _Sites(NamedTuple):
    """The factors exp(−τ t²/2 + ν t)."""

    precisions: Float[np.ndarray, " k"]
    shifts: Float[np.ndarray, " k"]


def tilted_moments(
    means: Float[np.ndarray, " k"], variances: Float[np.ndarray, " k"], mixture: ProbitMixture
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """log Z, mean and variance of N(t; mean, variance) p(t) / Z for each of K margins, in closed form.

    Z(μ) = c + Σⱼ aⱼ Φ(xⱼ), xⱼ = (μ − oⱼ)/√(s² + hⱼ²); the moments are its first two derivatives in μ.

    Source: Rasmussen & Williams (2006), section 3.9, for one probit.
    """
    spread = np.sqrt(variances[:, None] + mixture.scales**2)
    x = (means[:, None] - mixture.offsets) / spread
    weights = np.broadcast_to(mixture.weights, x.shape)
    # a tie is a difference of two terms, precise in the lower tail: Σⱼ aⱼ = 0, so that Z = −Σⱼ aⱼ Φ(−xⱼ) as well
    upper = (np.abs(np.sum(weights, axis=1)) < 1e-12) & (means > 0)
    sign = np.where(upper, -1.0, 1.0)[:, None]
    # terms relative to the largest keep their precision where all of Z is tiny
    log_cdf = log_ndtr(sign * x)
    top = np.max(np.where(weights != 0, log_cdf, -np.inf), axis=1, keepdims=True)
    constant = mixture.constant * np.exp(np.minimum(-top[:, 0], FAR))
    used = weights != 0  # what is not may be larger than any number relative to the largest that is
    density = weights * np.exp(np.where(used, -0.5 * x**2 - 0.5 * np.log(2 * np.pi) - top, 0)) / spread
    terms = sign * weights * np.exp(np.where(used, log_cdf - top, 0))
    z = np.maximum(constant + np.sum(terms, axis=1), np.finfo(float).tiny)
    # where nothing is left of a tie but rounding, it has no direction either
    lost = z <= LOST * (constant + np.sum(np.abs(terms), axis=1))
    # Rasmussen & Williams (2006), section 3.9: ∂ log Z/∂μ, ∂² log Z/∂μ², and the moments by both
    slope = np.where(lost, 0, np.sum(density, axis=1)) / z
    curvature = np.where(lost, 0, np.sum(-density * x / spread, axis=1)) / z - slope**2
    tilted_variance = variances + variances**2 * curvature
    with np.errstate(divide="ignore"):
        alone = (top[:, 0] < -FAR) & (mixture.constant > 0)  # all else is nothing beside the constant
        log_z = np.where(alone, np.log(mixture.constant), top[:, 0] + np.log(z))
    return log_z, means + variances * slope, np.maximum(tilted_variance, 1e-12 * variances)


def repeated_moments(
    mean: float, variance: float, ratios: Float[np.ndarray, " n"], mixture: ProbitMixture
) -> tuple[float, float, float]:
    """log Z, mean and variance of N(t; mean, variance) Πₖ pₖ(ratiosₖ t) / Z by quadrature: n answers about one margin.

    Gauss-Legendre on panels that end where a factor has a kink. `mixture` is of the n answers.
    """
    deviation = np.sqrt(np.maximum(variance, np.finfo(float).tiny))
    offsets = np.unique(mixture.offsets / ratios[:, None])
    span = np.max(np.abs(offsets)) + abs(mean) + 12 * deviation
    smooth = mixture.scales[mixture.scales > 0]  # a step ends a panel, and needs no narrow ones
    narrowest = 0.2 * np.min(smooth) / np.max(np.abs(ratios)) if len(smooth) else span
    near = span / GROWTH ** np.arange(max(1, int(np.log(span / narrowest) / np.log(GROWTH)) + 1))
    around = np.concatenate([-near, [0.0], near])
    edges = np.unique(np.concatenate([(offsets[:, None] + around).ravel(), mean + deviation * WIDE]))
    edges = edges[np.abs(edges - mean) <= 12 * deviation]
    halves = np.diff(edges)[:, None] / 2
    t, widths = ((edges[:-1, None] + halves) + halves * NODES).ravel(), (halves * NODE_WEIGHTS).ravel()
    log_density = -0.5 * ((t - mean) / deviation) ** 2 - 0.5 * np.log(2 * np.pi) - np.log(deviation)
    constants = np.broadcast_to(mixture.constant, ratios.shape)
    rows = np.broadcast_to(mixture.weights, (len(ratios), len(mixture.scales)))
    kinds = np.column_stack([ratios, constants, rows])
    for (ratio, constant, *weights), count in zip(*np.unique(kinds, axis=0, return_counts=True), strict=True):
        distance = ratio * t[:, None] - mixture.offsets
        with np.errstate(divide="ignore", invalid="ignore"):
            cdf = np.where(mixture.scales > 0, ndtr(distance / mixture.scales), distance > 0)
        log_density += count * np.log(np.maximum(constant + cdf @ weights, np.finfo(float).tiny))
    top = log_density.max()
    density = np.exp(log_density - top) * widths
    z = density.sum()
    tilted = density @ t / z
    return float(top + np.log(z)), float(tilted), float(density @ (t - tilted) ** 2 / z)


def same_margins(
    loadings: Float[np.ndarray, "k r"],
) -> list[tuple[Int[np.ndarray, " _"], Float[np.ndarray, " _"]]]:
    """The rows of L in groups that are parallel, in the order of the first of each, and their ratios to it.

    A row of zeros is a group of its own, of ratio 0.
    """
    tiny = np.finfo(float).tiny
    largest = np.maximum(np.max(np.abs(loadings), axis=1, initial=0.0, keepdims=True), tiny)
    units = loadings / largest  # entries near the smallest numbers have no squares
    lengths = np.maximum(np.linalg.norm(units, axis=1, keepdims=True), tiny)
    units, lengths = units / lengths, (lengths * largest)[:, 0]
    cosines = units @ units.T
    groups, free = [], np.ones(len(loadings), dtype=bool)
    for row in range(len(loadings)):
        if free[row]:
            alike = free & (np.abs(cosines[row]) >= 1 - SAME)
            alike[row] = True
            group = np.flatnonzero(alike)
            ratios = lengths[group] / max(lengths[row], tiny)  # a row of zeros has none
            groups.append((group, np.sign(cosines[row, group]) * ratios))
            free[group] = False
    return groups


class _Factors:
    """The likelihood as a function of one margin for each of G groups of answers."""

    def __init__(self, loadings: Float[np.ndarray, "k r"], mixture: ProbitMixture) -> None:
        groups = same_margins(loadings)
        self.first = np.array([group[0] for group, _ in groups], dtype=int)
        self.single = np.array([len(group) == 1 for group, _ in groups], dtype=bool)
        self.mixture = mixture.of(self.first)
        self.repeated = [
            (number, ratios, mixture.of(group)) for number, (group, ratios) in enumerate(groups) if len(group) > 1
        ]

    def moments(
        self, means: Float[np.ndarray, " g"], variances: Float[np.ndarray, " g"]
    ) -> tuple[Float[np.ndarray, " g"], Float[np.ndarray, " g"], Float[np.ndarray, " g"]]:
        """`tilted_moments` of each group's margin, that of its first answer."""
        log_z, tilted, narrowed = tilted_moments(means, variances, self.mixture)
        for number, ratios, mixture in self.repeated:
            log_z[number], tilted[number], narrowed[number] = repeated_moments(
                means[number], variances[number], ratios, mixture
            )
        return log_z, tilted, narrowed


def expectation_propagation(
    loadings: Float[np.ndarray, "k r"],
    mixture: ProbitMixture,
    *,
    prior_scale: float,
    widening: bool = False,
) -> GaussianApproximation:
    """Fit the posterior of z ~ N(0, σ²I_r) given answers to the margins t = L z.

    Args:
      loadings: L.
      mixture: the answers' likelihood.
      prior_scale: σ > 0.
      widening: whether the factor of a violated answer may widen its margin, down to a precision of 0 of all factors
        together. Of many contradicting answers the fit is else too narrow, by a factor of two in the standard
        deviation; of few it may not converge.
    """
    factors, answers = _Factors(loadings, mixture), len(loadings)
    loadings = loadings[factors.first]
    number = len(loadings)
    sites = none = _Sites(np.zeros(number), np.zeros(number))
    gaussian = prior = _moments(loadings, sites, prior_scale)
    converged, sweeps, last, damping = False, 0, np.inf, DAMPING
    held = np.zeros(number, dtype=bool)
    while sweeps < MAX_SWEEPS and not converged and number:
        sweeps += 1
        matched = _matched_sites(factors, gaussian, sites, widening)
        narrowed = np.where(factors.single, matched.precisions * prior.t_variance, 0.0)  # of several none can run away
        if np.any(narrowed[~held] > RUNAWAY):
            held |= narrowed > 0.01 * RUNAWAY
            sites, gaussian, damping, last = none, prior, DAMPING, np.inf
            continue
        matched.precisions[held] = matched.shifts[held] = 0.0
        sites = _Sites(*(old + damping * (new - old) for old, new in zip(sites, matched, strict=True)))
        before, gaussian = gaussian, _moments(loadings, sites, prior_scale)
        moved = np.abs(gaussian.t_mean - before.t_mean)
        moved += np.abs(np.sqrt(gaussian.t_variance) - np.sqrt(before.t_variance))
        change = float(np.max(moved / np.sqrt(before.t_variance)))
        converged = change <= TOLERANCE
        damping, last = (0.8 * damping if change > last else damping), change
    evidence = _log_evidence(gaussian, sites, factors) if number else 0.0
    site_precisions = np.zeros(answers)
    site_precisions[factors.first] = sites.precisions
    converged = not number or (converged and not bool(held.any()))
    return GaussianApproximation(gaussian.mean, gaussian.covariance, site_precisions, evidence, converged)


def _cavity(gaussian: _Gaussian, sites: _Sites) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Mean and variance of each margin without its own site (Rasmussen & Williams 2006, eq. 3.56)."""
    cavity = 1 / np.maximum(1 - gaussian.t_variance * sites.precisions, 1e-10)  # eq. 3.56
    return (gaussian.t_mean - gaussian.t_variance * sites.shifts) * cavity, gaussian.t_variance * cavity


def _matched_sites(factors: _Factors, gaussian: _Gaussian, sites: _Sites, widening: bool) -> _Sites:
    """The sites whose product with the cavities has the tilted moments (Rasmussen & Williams 2006, eq. 3.59)."""
    cavity_mean, cavity_variance = _cavity(gaussian, sites)
    _, mean, variance = factors.moments(cavity_mean, cavity_variance)
    # a violated answer's factor can widen its margin: its precision is held at 0, its shift keeps the tilted mean
    precisions = np.maximum(1 / variance - 1 / cavity_variance, -np.inf if widening else 0.0)
    return _Sites(precisions, mean * (precisions + 1 / cavity_variance) - cavity_mean / cavity_variance)  # eq. 3.59


def _moments(loadings: Float[np.ndarray, "k r"], sites: _Sites, prior_scale: float) -> _Gaussian:
    """The prior times the sites (Rasmussen & Williams 2006, eq. 3.53)."""
    rank = loadings.shape[1]
    # scaled by σ, the precision is at least the identity: always well conditioned enough for Cholesky
    scaled = prior_scale * loadings
    factor = np.linalg.cholesky(np.eye(rank) + (scaled.T * sites.precisions) @ scaled)
    # one small general inverse: threaded triangular solves cost ten times as much where other threads are busy
    inverse = np.linalg.inv(factor)
    half = inverse @ scaled.T
    direction = half @ sites.shifts
    mean = prior_scale * inverse.T @ direction  # eq. 3.53
    covariance = prior_scale**2 * inverse.T @ inverse
    log_normaliser = 0.5 * direction @ direction - np.sum(np.log(np.diag(factor)))
    return _Gaussian(mean, covariance, half.T @ direction, np.sum(half**2, axis=0), float(log_normaliser))


def _log_evidence(gaussian: _Gaussian, sites: _Sites, factors: _Factors) -> float:
    """Σ_k [log Z_k(cavity) − log ∫ cavity · site] + log ∫ prior · sites (Rasmussen & Williams 2006, eq. 3.65)."""
    precisions, shifts = sites
    mean, variance = _cavity(gaussian, sites)
    log_tilted, _, _ = factors.moments(mean, variance)
    grown = 1 + variance * precisions
    # ∫ N(t; mean, variance) exp(−τ t²/2 + ν t) dt
    log_site = -0.5 * np.log(grown) + (shifts * mean + 0.5 * variance * shifts**2 - 0.5 * precisions * mean**2) / grown
    return float(np.sum(log_tilted - log_site) + gaussian.log_normaliser)
