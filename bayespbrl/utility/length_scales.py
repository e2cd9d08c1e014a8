"""The settings of the features that the posterior is over: multiples of the bandwidths, and whether effort counts.

A few answers hardly tell "high is good" from "fast is good". Under one choice of length scales the posterior would be
sure of the one or the other; over all of them it says how sure the answers make it (Hoeting, Madigan, Raftery and
Volinsky 1999).
"""

import itertools
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from bayespbrl.features import DiffusionBasis, RadialBasis, StateFeatures, linear
from bayespbrl.models.threads import in_threads, one_blas_thread
from bayespbrl.trajectories import Trajectory, step_features, trajectory_features

# The prior: a uniform distribution over settings of these multiples of the bandwidths as given; up to three dimensions,
# over all of them. Functions hardly change along a dimension with the last.
MULTIPLES = (1.0, 3.0, 9.0)
ROWS_AT_A_TIME = 256  # keeps the factors of all settings in the processor's cache
# Entries of a kernel matrix from which threads pay: with smaller ones they wait for each other in the interpreter.
WORTH_A_THREAD = 20_000
MOST_SETTINGS = 27
MANY = 6  # dimensions; beyond, the prior has settings in which one alone matters


def bandwidth_multiples(
    features: StateFeatures, *, inferred: bool, rng: np.random.Generator
) -> Float[np.ndarray, "c s"]:
    """Multiples of the bandwidths of φ, one row for each of C settings; one row of ones where nothing is inferred.

    With a feature of the effort there is one column more, by which that is multiplied, and each row occurs twice: with
    0, where effort does not count, and with 1.

    Decision: because in many tasks it does not, and a few answers about actions at random seem to say that it does
    (docs/tuning.md). Each with and without, because else some length scales would tell whether effort counts.
    """
    dimensions = len(features.bandwidths) if isinstance(features, RadialBasis | DiffusionBasis) else 0
    effort = isinstance(features, RadialBasis) and bool(features.effort)
    if not inferred or not dimensions:
        return np.ones((1, dimensions + effort))
    multiples = _length_scales(dimensions, rng)
    if not effort:
        return multiples
    return np.column_stack([np.repeat(multiples, 2, axis=0), np.tile([0.0, 1.0], len(multiples))])


def _length_scales(dimensions: int, rng: np.random.Generator) -> Float[np.ndarray, "c s"]:
    """Multiples of the bandwidths in lexicographic order."""
    if len(MULTIPLES) ** dimensions <= MOST_SETTINGS:
        return np.array(list(itertools.product(MULTIPLES, repeat=dimensions)))
    chosen = {(multiple,) * dimensions for multiple in MULTIPLES}
    if dimensions > MANY:
        chosen |= _alone(dimensions, MOST_SETTINGS - len(chosen), rng)
    while len(chosen) < MOST_SETTINGS:  # always as many: another number would compile the sampler anew
        chosen.add(tuple(rng.choice(MULTIPLES, size=dimensions).tolist()))
    return np.array(sorted(chosen))


def _alone(dimensions: int, most: int, rng: np.random.Generator) -> set[tuple[float, ...]]:
    """At most `most` settings in which the function changes along one dimension only, each in turn.

    Decision: of many dimensions few matter, and hardly any setting at random has the right ones alone. From 20 answers
    about Swimmer's eight the utility's correlation with the return was 0.47 without these settings, with them 0.90. In
    four and six dimensions the default learned no better with them (docs/tuning.md).
    """
    *narrower, broadest = MULTIPLES
    which = [(multiple, alone) for multiple in reversed(narrower) for alone in rng.permutation(dimensions)]
    return {tuple(multiple if j == alone else broadest for j in range(dimensions)) for multiple, alone in which[:most]}


def rescaled(features: StateFeatures, multiples: ArrayLike) -> StateFeatures:
    """φ with `multiples` of its bandwidths, where it has any."""
    return features.rescaled(multiples) if isinstance(features, RadialBasis | DiffusionBasis) else features


@one_blas_thread()
def values_under(
    features: StateFeatures,
    multiples: Float[np.ndarray, "c s"],
    states: np.ndarray,
    weights: Sequence[Float[np.ndarray, "d _"]],
    *,
    actions: np.ndarray | None = None,
) -> list[Float[np.ndarray, "n _"]]:
    """φᵀw of n states under each of C settings, with the weights of each side by side; with `actions` of n steps."""
    if not isinstance(features, RadialBasis) or len(multiples) == 1:
        return [
            linear(step_features(rescaled(features, row), states, actions), columns)
            for row, columns in zip(multiples, weights, strict=True)
        ]
    efforts = None if actions is None or not features.effort else features.efforts(actions)
    counts = features.effort_multiples(multiples)
    values = [np.empty((len(states), columns.shape[1])) for columns in weights]

    def fill(start: int) -> None:
        rows = slice(start, start + ROWS_AT_A_TIME)
        for number, (kernel, shares) in enumerate(features.under(multiples, states[rows])):
            values[number][rows] = shares[:, None] * (kernel @ weights[number][: kernel.shape[1]])
            if features.constant:
                values[number][rows] += features.constant * weights[number][kernel.shape[1]]
            if efforts is not None:
                values[number][rows] += counts[number] * efforts[rows, None] * weights[number][-1]

    _for_each(fill, range(0, len(states), ROWS_AT_A_TIME), rows=len(states), functions=len(features.centres))
    return values


@one_blas_thread()
def sums_under(
    features: StateFeatures,
    multiples: Float[np.ndarray, "c s"],
    trajectories: Sequence[Trajectory],
    *,
    discount: float,
) -> Sequence[Float[np.ndarray, "n d"]]:
    """ψ(τ) of n trajectories under each of C settings, as `trajectory_features`."""
    if not isinstance(features, RadialBasis) or len(multiples) == 1:
        return [trajectory_features(trajectories, rescaled(features, row), discount=discount) for row in multiples]
    functions = len(features.centres)
    constant, effort = bool(features.constant), bool(features.effort)
    counts = features.effort_multiples(multiples)
    sums = np.zeros((len(multiples), len(trajectories), functions + constant + effort))

    def add(i: int) -> None:
        trajectory = trajectories[i]
        discounts = discount ** np.arange(len(trajectory))
        sums[:, i, functions : functions + constant] = features.constant * discounts.sum()  # eq. 1
        if effort:
            sums[:, i, -1] = counts * (discounts @ features.efforts(trajectory.actions))  # eq. 1
        for start in range(0, len(trajectory), ROWS_AT_A_TIME):
            rows = slice(start, start + ROWS_AT_A_TIME)
            for number, (kernel, shares) in enumerate(features.under(multiples, trajectory.states[1:][rows])):
                sums[number, i, :functions] += (discounts[rows] * shares) @ kernel  # eq. 1

    rows = sum(map(len, trajectories)) // max(len(trajectories), 1)
    _for_each(add, range(len(trajectories)), rows=rows, functions=functions)
    return list(sums)


def _for_each(function: Callable[[int], None], parts: Sequence[int], *, rows: int, functions: int) -> None:
    """Call a function of each part, in threads where the kernel matrices of so many rows are large enough."""
    if min(rows, ROWS_AT_A_TIME) * functions >= WORTH_A_THREAD:
        in_threads(function, parts)
    else:
        for part in parts:
            function(part)
