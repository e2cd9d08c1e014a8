"""Gibbs moves over all unknowns but the weights: the setting of the features, steepness, lapse rates and tie threshold.

Steepness, lapse rates and threshold have a prior on a grid, and given the margins each is drawn exactly from its
conditional distribution. The setting (length scales) is drawn given the *whitened* weights ξ, z = m + A ξ, with the
Gaussian reference (m, A) of each setting: ξ means nearly the same under every setting, so that the move goes far. As
the weights change with it, its probabilities carry the volume |A| (reversible jump with a deterministic map; Green
1995). Between these moves the weights are sampled by elliptical slices. Tie threshold and setting are drawn together.

Where several people answer and contradict each other, one of them errs, and weights that follow another one need other
lapse rates. Then the setting is drawn with the lapse rates summed out, and the weights and their mirror image too.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, random
from jax.scipy.special import logsumexp
from jaxtyping import Float, Int, PRNGKeyArray, Shaped

from bayespbrl.models.likelihoods import (
    Likelihood,
    Margins,
    Ordered,
    Scalar,
    Values,
    WithLapses,
    WithTies,
    has_steps,
    log_prob,
)
from bayespbrl.models.preference_problem import PreferenceProblem

# Up to this many answers, padding included, the sampler makes more moves of other kinds.
FEW = 64
# So many others are tried in a move of setting and tie threshold: all would take twice the time and go no farther.
OTHER_THRESHOLDS = 3
STACKED = ("loadings", "used", "centre", "site_precisions", "root", "inverse_root")


class Table(NamedTuple):
    """A prior on a grid, for JAX."""

    values: Float[Array, " v"]
    log_probabilities: Float[Array, " v"]


class Surrogate(NamedTuple):
    """What `bayespbrl.models.surrogate_moves` needs for one noise τ of the margins.

    Attributes:
      noise: τ.
      root, inverse_root: A of each setting, upper triangular, with AAᵀ = (I/σ² + LᵀL/τ²)⁻¹, and A⁻¹.
    """

    noise: Scalar
    root: Float[Array, "s q q"]
    inverse_root: Float[Array, "s q q"]


class JointProblem(NamedTuple):
    """Data, priors and Gaussian references of the joint model.

    Attributes:
      settings: one problem for each of C settings, stacked.
      log_probabilities: of the settings, a priori.
      steepness, lapse_rate, tie_threshold: priors.
      answerers: who gave each answer, one-hot; zero in padded rows.
      fitted_steepness: at which the references were fitted. They are scaled for any other steepness m, by it over m,
        and m moves together with the weights. None: neither.
      surrogates: matrices of the moves that keep the margins, one for each τ; empty: no such moves.
    """

    settings: PreferenceProblem
    log_probabilities: Float[Array, " s"]
    steepness: Table
    lapse_rate: Table
    tie_threshold: Table
    answerers: Float[Array, "a c"]
    fitted_steepness: Scalar | None = None
    surrogates: tuple[Surrogate, ...] = ()


class Unknowns(NamedTuple):
    """The unknowns besides the weights: index of the setting and of each grid's value."""

    setting: Int[Array, "*chains"]
    steepness: Int[Array, "*chains"]
    lapse_rate: Int[Array, "*chains a"]
    tie_threshold: Int[Array, "*chains"]


class Point(NamedTuple):
    """The values of the unknowns; of λ one for each answer, zero in padded rows."""

    steepness: Values
    lapse_rate: Values
    tie_threshold: Values


def point_of(problem: JointProblem, unknowns: Unknowns) -> Point:
    return Point(
        problem.steepness.values[unknowns.steepness],
        problem.lapse_rate.values[unknowns.lapse_rate] @ problem.answerers,
        problem.tie_threshold.values[unknowns.tie_threshold],
    )


def prior_draws(problem: JointProblem, rng: np.random.Generator, number: int) -> list[Int[np.ndarray, "n ..."]]:
    """Numbers of the values of steepness, lapse rates and tie threshold, `number` draws from the priors of each."""

    def drawn(prior: Table, *shape: int) -> Int[np.ndarray, "n ..."]:
        probabilities = np.exp(np.asarray(prior.log_probabilities, dtype=np.float64))
        return rng.choice(len(prior.values), (number, *shape), p=probabilities / probabilities.sum())

    return [
        drawn(problem.steepness),
        drawn(problem.lapse_rate, len(problem.answerers)),
        drawn(problem.tie_threshold),
    ]


Parts = TypeVar("Parts")


def at_setting(stacked_parts: Parts, setting: Int[Array, ""]) -> Parts:
    """The parts of one setting; without a copy where there is only one."""
    return jax.tree.map(lambda each: each[0] if len(each) == 1 else each[setting], stacked_parts)


def conditional(problem: JointProblem, unknowns: Unknowns) -> PreferenceProblem:
    """The problem of the weights given all other unknowns."""
    settings = problem.settings
    stacks = {name: getattr(settings, name) for name in STACKED}
    if settings.loadings.shape[1] <= FEW:
        parts: dict[str, Shaped[Array, "n ..."]] = {name: each[unknowns.setting] for name, each in stacks.items()}
    else:
        parts = at_setting(stacks, unknowns.setting)
        if not has_steps(settings.likelihood):
            scale = reference_scale(problem, unknowns)
            parts |= {"centre": parts["centre"] * scale, "site_precisions": parts["site_precisions"] / scale**2}
            parts |= {"width": scale, "excess": (1 / scale**2 - 1) / settings.prior_scale**2}
    return settings._replace(likelihood=_likelihood(problem, point_of(problem, unknowns)), **parts)


def reference_scale(problem: JointProblem, unknowns: Unknowns) -> Values:
    """Width of the references under these unknowns, relative to their width when fitted."""
    if problem.fitted_steepness is None:
        return jnp.ones(())
    return jnp.asarray(problem.fitted_steepness / problem.steepness.values[unknowns.steepness])


def moved(
    key: PRNGKeyArray, z: Float[Array, " q"], unknowns: Unknowns, problem: JointProblem
) -> tuple[Float[Array, " q"], Unknowns]:
    """New weights and unknowns after one move of each kind; fixed parameters have no move."""
    # never `fold_in` beside `split`: its keys are the same, and moves that share a key share their random numbers
    if _several_err(problem):
        key, key_mirror = random.split(key)
        z, unknowns = _mirror_move(key_mirror, z, unknowns, problem)
    key_setting, *keys, key_steepness, key_threshold = random.split(key, 6)
    if len(problem.log_probabilities) > 1:
        z, unknowns = _setting_move(key_setting, z, unknowns, problem)
    if problem.fitted_steepness is not None:
        z, unknowns = _steepness_move(key_steepness, z, unknowns, problem)
    if len(problem.tie_threshold.values) > 1:
        z, unknowns = _threshold_move(key_threshold, z, unknowns, problem)
    loadings = problem.settings.loadings
    few = loadings.shape[1] <= FEW
    margins = (loadings[unknowns.setting] if few else at_setting(loadings, unknowns.setting)) @ z
    for key, name in zip(keys, ("steepness", "lapse_rate", "tie_threshold"), strict=True):
        prior: Table = getattr(problem, name)
        if len(prior.values) > 1:
            every = point_of(problem, unknowns)._replace(**{name: prior.values[:, None]})
            log_p = log_probabilities(problem, every, margins)
            # each answerer's lapse rate is drawn from the answers of that one, all else from all answers
            log_p = problem.answerers @ log_p.T if name == "lapse_rate" else log_p.sum(axis=1)
            unknowns = unknowns._replace(**{name: random.categorical(key, log_p + prior.log_probabilities)})
    return z, unknowns


def _setting_move(
    key: PRNGKeyArray, z: Float[Array, " q"], unknowns: Unknowns, problem: JointProblem
) -> tuple[Float[Array, " q"], Unknowns]:
    """Setting and tie threshold drawn from their distribution given the whitened weights, and the weights under it.

    Together, because settings of different scale need different thresholds, and neither alone could then move.
    """
    settings, now = problem.settings, unknowns.setting
    key, key_thresholds = random.split(key) if len(problem.tie_threshold.values) > 1 else (key, key)
    whitened = settings.inverse_root[now] @ (z - settings.centre[now])
    points = settings.centre + settings.root @ whitened
    margins = jnp.einsum("skq,sq->sk", settings.loadings, points)
    log_prior = -0.5 * jnp.sum(points**2, axis=1) / settings.prior_scale**2  # eq. 7: log N(z; 0, σ²I)
    log_prior += jnp.sum(jnp.log(jnp.diagonal(settings.root, axis1=1, axis2=2)), axis=1)  # log |A| (Green 1995)
    log_prior += problem.log_probabilities
    number, (numbers, thresholds) = len(log_prior), _some_thresholds(key_thresholds, unknowns, problem)
    log_prior = (log_prior + thresholds.log_probabilities[:, None]).ravel()
    margins = jnp.tile(margins, (len(numbers), 1))
    point = point_of(problem, unknowns)._replace(tie_threshold=jnp.repeat(thresholds.values, number)[:, None])
    if _several_err(problem):
        chosen, lapse_rate = _chosen_with_lapses(key, log_prior, margins, point, problem)
    else:
        log_p = jnp.sum(log_probabilities(problem, point, margins), axis=1) + log_prior
        chosen, lapse_rate = random.categorical(key, log_p), unknowns.lapse_rate
    threshold, setting = numbers[chosen // number], chosen % number
    return points[setting], unknowns._replace(setting=setting, lapse_rate=lapse_rate, tie_threshold=threshold)


def _some_thresholds(key: PRNGKeyArray, unknowns: Unknowns, problem: JointProblem) -> tuple[Int[Array, " t"], Table]:
    """The tie threshold as it is and some others at random, their numbers and their part of the prior.

    Such a set is as probable whichever of its members was the present one, so that a draw among them is exact.
    """
    values, log_probabilities = problem.tie_threshold
    others = 1 + random.permutation(key, len(values) - 1)[:OTHER_THRESHOLDS]
    numbers = (unknowns.tie_threshold + jnp.append(others, 0)) % len(values)
    return numbers, Table(values[numbers], log_probabilities[numbers])


def _mirror_move(
    key: PRNGKeyArray, z: Float[Array, " q"], unknowns: Unknowns, problem: JointProblem
) -> tuple[Float[Array, " q"], Unknowns]:
    """The weights or their mirror image −z, equally probable a priori, and lapse rates.

    Of two people who contradict each other either may be the one who errs: one who has the buttons the wrong way round,
    say. No ellipse passes between the two parts of the posterior, because between them both err.
    """
    points = jnp.stack([z, -z])
    margins = points @ at_setting(problem.settings.loadings, unknowns.setting).T
    chosen, lapse_rate = _chosen_with_lapses(key, jnp.zeros(2), margins, point_of(problem, unknowns), problem)
    return points[chosen], unknowns._replace(lapse_rate=lapse_rate)


def _several_err(problem: JointProblem) -> bool:
    """Whether there are several answerers, each with a lapse rate to infer."""
    return len(problem.answerers) > 1 and len(problem.lapse_rate.values) > 1


def _chosen_with_lapses(
    key: PRNGKeyArray, log_p: Values, margins: Float[Array, "n k"], point: Point, problem: JointProblem
) -> tuple[Int[Array, ""], Int[Array, " a"]]:
    """One of n points, with its log probability but for the answers', and all lapse rates given it: drawn together.

    The answers' probability at each point is summed over the lapse rates, which do not depend on each other.
    """
    key_point, key_lapses = random.split(key)
    every = point._replace(lapse_rate=problem.lapse_rate.values[:, None, None])
    answers = jnp.einsum("ak,vnk->nav", problem.answerers, log_probabilities(problem, every, margins))
    answers += problem.lapse_rate.log_probabilities
    chosen = random.categorical(key_point, log_p + jnp.sum(logsumexp(answers, axis=2), axis=1))
    return chosen, random.categorical(key_lapses, answers[chosen], axis=1)


def _steepness_move(
    key: PRNGKeyArray, z: Float[Array, " q"], unknowns: Unknowns, problem: JointProblem
) -> tuple[Float[Array, " q"], Unknowns]:
    """Steepness m and weights z m₀/m drawn together, so that their product stays.

    Many answers determine the product well, and neither m given z nor z given m could then move.
    """
    values, loadings = problem.steepness.values, at_setting(problem.settings.loadings, unknowns.setting)
    every = point_of(problem, unknowns)._replace(steepness=values[:, None])
    scales = values[unknowns.steepness] / values
    margins = scales[:, None] * (loadings @ z)
    log_p = jnp.sum(log_probabilities(problem, every, margins), axis=1) + problem.steepness.log_probabilities
    z, chosen = _scaled(key, z, scales, log_p, unknowns, problem)
    return z, unknowns._replace(steepness=chosen)


def _threshold_move(
    key: PRNGKeyArray, z: Float[Array, " q"], unknowns: Unknowns, problem: JointProblem
) -> tuple[Float[Array, " q"], Unknowns]:
    """Tie threshold δ and weights z δ/δ₀ drawn together: which answers are ties determines their ratio well."""
    values = problem.tie_threshold.values
    every = point_of(problem, unknowns)._replace(tie_threshold=values[:, None])
    scales = values / values[unknowns.tie_threshold]
    loadings = problem.settings.loadings[unknowns.setting]
    points = jnp.where(jnp.any(loadings != 0, axis=0), scales[:, None] * z, z)
    log_p = jnp.sum(log_probabilities(problem, every, points @ loadings.T), axis=1)
    log_p += problem.tie_threshold.log_probabilities
    z, chosen = _scaled(key, z, scales, log_p, unknowns, problem)
    return z, unknowns._replace(tie_threshold=chosen)


def _scaled(
    key: PRNGKeyArray,
    z: Float[Array, " q"],
    scales: Values,
    log_p: Values,
    unknowns: Unknowns,
    problem: JointProblem,
) -> tuple[Float[Array, " q"], Int[Array, ""]]:
    """The weights times one of the scales, and its number; r coordinates have the volume scale^r.

    `log_p` is that of the answers, and of the scale a priori.
    """
    scaled = jnp.any(problem.settings.loadings[unknowns.setting] != 0, axis=0)  # all but padding
    points = jnp.where(scaled, scales[:, None] * z, z)
    log_p -= 0.5 * jnp.sum(points**2, axis=1) / problem.settings.prior_scale**2  # eq. 7: log N(z; 0, σ²I)
    chosen = random.categorical(key, log_p + jnp.sum(scaled) * jnp.log(scales))  # Green (1995): the volume scale^r
    return points[chosen], chosen


def log_likelihood(problem: JointProblem, unknowns: Unknowns, margins: Margins) -> Values:
    """Σ log p of the answers, those of padded rows left out."""
    return jnp.sum(log_probabilities(problem, point_of(problem, unknowns), margins), axis=-1)


def log_probabilities(problem: JointProblem, point: Point, margins: Margins) -> Values:
    """log p of each answer, 0 in padded rows."""
    real = problem.answerers.sum(axis=0) > 0
    return jnp.where(real, log_prob(_likelihood(problem, point), margins), 0)


def _likelihood(problem: JointProblem, point: Point) -> Likelihood:
    return likelihood_with(problem.settings.likelihood, point)


def likelihood_with(template: Likelihood, point: Point) -> Likelihood:
    """The likelihood with the parameters of `point`."""
    if isinstance(template, WithTies):
        ordered = cast(Ordered, likelihood_with(template.ordered, point))
        return replace(template, ordered=ordered, threshold=point.tie_threshold)
    if isinstance(template, WithLapses):
        return replace(template, attentive=likelihood_with(template.attentive, point), lapse_rate=point.lapse_rate)
    return replace(cast(Ordered, template), steepness=point.steepness)


def stacked(problems: Sequence[PreferenceProblem]) -> PreferenceProblem:
    """Problems of one capacity as one with a leading axis; likelihood and prior scale are the first's."""
    arrays: dict[str, Any] = {name: np.stack([getattr(each, name) for each in problems]) for name in STACKED}
    return problems[0]._replace(**jax.device_put(arrays))
