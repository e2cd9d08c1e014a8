"""Step 4: which of the new trajectories to show against the best so far.

The paper's rule needs an estimate; the others need draws from its posterior. Each returns the new trajectories in order
of preference: the first is asked about, the next when that question is skipped, or when more are asked.
"""

from collections.abc import Sequence

import numpy as np
from scipy.special import entr

from bayespbrl.models.likelihoods import Likelihood, prob
from bayespbrl.preferences import Query
from bayespbrl.trajectories import Trajectory


def random_candidates(numbers: Sequence[int], *, rng: np.random.Generator) -> tuple[int, ...]:
    """`numbers` in random order: the first iteration, when there is no estimate yet to choose by (paper, step 4)."""
    return tuple(int(number) for number in rng.permutation(np.asarray(numbers)))


def highest_utility_candidates(numbers: Sequence[int], utilities: np.ndarray) -> tuple[int, ...]:
    """`numbers`, highest expected utility wᵀψ(τ) first (paper, step 4); equal ones in their order.

    Args:
      numbers: the n new trajectories.
      utilities: expected utility of each, shape (n,).
    """
    if utilities.shape != (len(numbers),):
        raise ValueError(f"utilities: expected one for each of {len(numbers)} trajectories, got {utilities.shape}")
    return tuple(int(numbers[index]) for index in np.argsort(-utilities, kind="stable"))


def posterior_candidates(
    rule: str,
    numbers: Sequence[int],
    utilities: np.ndarray,
    incumbent: np.ndarray,
    *,
    likelihood: Likelihood,
    rng: np.random.Generator,
) -> tuple[int, ...]:
    """`numbers` as a rule that looks at the posterior prefers them; equal ones by their mean utility.

    `probably-better`: the probability of being better than the incumbent; `thompson`: the utility in one posterior
    draw, which `rng` picks (Thompson 1933); `information`: `expected_information`; `disagreement`: the variance, over
    draws, of which of the two is better.

    Args:
      rule: one of the four.
      numbers: the n new trajectories.
      utilities: S posterior draws of the utility of each, shape (S, n).
      incumbent: the same draws of the utility of the best so far, shape (S,).
      likelihood: of an answer given its margin, the difference of the two utilities.
      rng: for `thompson`.

    Raises:
      ValueError: a rule there is not, or draws that do not fit or are not finite.
    """
    utilities, incumbent = _checked(utilities, incumbent)
    if utilities.shape[1] != len(numbers):
        raise ValueError(f"utilities: expected one for each of {len(numbers)} trajectories, got {utilities.shape}")
    match rule:
        case "probably-better":
            scores = probability_better(utilities, incumbent)
        case "thompson":
            scores = utilities[rng.integers(len(utilities))]
        case "information":
            scores = expected_information(utilities, incumbent, likelihood=likelihood)
        case "disagreement":
            better = probability_better(utilities, incumbent)
            scores = better * (1 - better)
        case _:
            expected = "probably-better, thompson, information or disagreement"
            raise ValueError(f"query: expected {expected}, got {rule!r}")
    return tuple(int(numbers[index]) for index in np.lexsort((-utilities.mean(axis=0), -scores)))


def probability_better(utilities: np.ndarray, incumbent: np.ndarray) -> np.ndarray:
    """Posterior probability that each of n trajectories is better than the incumbent; equal utilities count half.

    Args:
      utilities, incumbent: posterior draws, shapes (S, n) and (S,).

    Returns:
      shape (n,).
    """
    utilities, incumbent = _checked(utilities, incumbent)
    return np.mean((1 + np.sign(utilities - incumbent[:, None])) / 2, axis=0)


def expected_information(utilities: np.ndarray, incumbent: np.ndarray, *, likelihood: Likelihood) -> np.ndarray:
    """What the answer to "this one or the incumbent?" is expected to tell about the utility, in nats, ≤ log 2.

    The mutual information of answer and weights, H(E p) − E H(p), with p the likelihood of the one answer at each draw
    and H the entropy of a coin: it is large where the draws are each sure and do not agree. What no weights could
    predict, as the coin tosses of a lapse rate, does not count.

    Args:
      utilities, incumbent: posterior draws, shapes (S, n) and (S,).
      likelihood: of an answer given its margin, the difference of the two utilities.

    Returns:
      shape (n,).

    Source: Houlsby, Huszár, Ghahramani and Lengyel (2011), "Bayesian active learning for classification and preference
    learning", eq. 2.
    """
    utilities, incumbent = _checked(utilities, incumbent)
    p = prob(likelihood, utilities - incumbent[:, None])
    # the estimate from the same draws is never negative but for rounding
    return np.maximum(_entropy(p.mean(axis=0)) - _entropy(p).mean(axis=0), 0.0)


def _entropy(p: np.ndarray) -> np.ndarray:
    """Of a coin, nats."""
    return entr(p) + entr(np.maximum(1 - p, 0.0))


def _checked(utilities: np.ndarray, incumbent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    utilities, incumbent = np.asarray(utilities, dtype=np.float64), np.asarray(incumbent, dtype=np.float64)
    if utilities.ndim != 2 or len(utilities) == 0 or incumbent.shape != utilities.shape[:1]:
        raise ValueError(
            "utilities: expected draws of shapes (S, n) and (S,) of the new and of the incumbent, "
            f"got {utilities.shape} and {incumbent.shape}"
        )
    if not (np.isfinite(utilities).all() and np.isfinite(incumbent).all()):
        raise ValueError("utilities: expected finite draws, got NaN or infinity")
    return utilities, incumbent


def show(
    number: int, newcomer: int, incumbent: int, trajectories: Sequence[Trajectory], *, rng: np.random.Generator
) -> Query:
    """The question "newcomer or incumbent?", in an order drawn at random, so that no side is favoured."""
    first, second = (newcomer, incumbent) if rng.random() < 0.5 else (incumbent, newcomer)
    return Query(number, first, second, newcomer, (trajectories[first], trajectories[second]))
