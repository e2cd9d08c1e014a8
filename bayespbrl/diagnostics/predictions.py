"""Posterior predictive probabilities of answers that the posterior was not fitted to, by exact refits (eqs. 7-8).

Eq. 8 depends on the number of preferences K. Decision: each refit keeps the K of all answers. All refits then belong to
one model: the log probabilities of the answers, each given those before it, sum to its log marginal likelihood.
"""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import xarray as xr

from bayespbrl.models import NOTHING_ELSE, Answers, PreferenceModel, posterior_draws
from bayespbrl.models.likelihoods import likelihood_of, smoothed_probability
from bayespbrl.models.posterior import SamplerOptions
from bayespbrl.models.posterior_tree import (
    answers_of,
    bases_of,
    check_posterior,
    next_lapse_rates,
    number_of_preferences,
    settings_of,
)
from bayespbrl.utility.posterior_utility import spacing

PREFERRED, DOMINATED, TIED = 0, 1, 2
MOST_DRAWS = 2000  # a probability is then known to a hundredth


def if_stated(probabilities: np.ndarray, preferred: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of n comparisons, the probability of one order given that either is stated, and that either is.

    Args:
      probabilities: of `answer_probabilities`, shape (n, 3).
      preferred: `PREFERRED` or `DOMINATED` for each, shape (n,).

    Returns:
      both of shape (n,); the first is ½ where the model rules out either order.
    """
    stated = probabilities[:, PREFERRED] + probabilities[:, DOMINATED]
    asked = np.take_along_axis(probabilities, preferred[:, None], axis=1)[:, 0]
    return np.divide(asked, stated, out=np.full(len(asked), 0.5), where=stated > 0), stated


def answer_probabilities(tree: xr.DataTree, differences: np.ndarray, answers: Answers = NOTHING_ELSE) -> np.ndarray:
    """Probability of each possible answer to comparisons that the posterior was not fitted to.

    Only the part of a difference in the span of the fitted ones is averaged over draws. The utility of the rest has the
    prior's normal distribution and is integrated exactly.

    Args:
      tree: what `sample_posterior` returned.
      differences: ψ(one) − ψ(other) of n comparisons, in the units of the fitted differences, shape (n, D), or
        (C, n, D) where the fitted ones have settings.
      answers: who answers, of those known to the tree, and which side the one is shown on. Without a side there is no
        side bias; without an answerer the lapse rate is that of `next_lapse_rates`, and where the tree knows names
        there is no side bias either.

    Returns:
      shape (n, 3): the one is preferred, the other is preferred, no difference (0 where nothing was tied).

    Raises:
      ValueError: differences of another shape or not finite; sides or answerers that are none.
    """
    check_posterior(tree)
    fitted = settings_of(np.asarray(tree["constant_data"]["differences"]))
    asked = settings_of(differences)
    if asked.shape[0] != fitted.shape[0] or asked.shape[2] != fitted.shape[2]:
        expected = ("C", "n", fitted.shape[2]) if len(fitted) > 1 else ("n", fitted.shape[2])
        raise ValueError(f"differences: expected shape {expected}, got {np.shape(differences)}")
    shown = Answers(shown_first=answers.shown_first).checked(asked.shape[1]).shown_first
    draws, model, who = _every(tree), fitted_model(tree), None
    fitted_to = answers_of(tree)
    if answers.answerers is not None and fitted_to.names is not None:
        who = np.asarray(replace(answers, names=fitted_to.names).checked(asked.shape[1]).answerers)
        draws["lapse_rate"] = draws["lapse_rates"][:, who]
    if fitted_to.shown_first is not None:  # features more: the sides
        sides = np.zeros(asked.shape[1], int) if shown is None else shown
        asked = replace(fitted_to, shown_first=sides, answerers=who).with_sides(asked, model.prior_scale)
    probabilities = np.zeros((asked.shape[1], 3))
    for number, (basis, rows) in enumerate(zip(bases_of(tree), asked, strict=True)):
        chosen = draws["setting"] == number
        if not chosen.any():
            continue
        inside = rows @ basis
        margins = draws["coordinates"][chosen][:, : basis.shape[1]] @ inside.T
        spread = model.prior_scale * np.linalg.norm(rows - inside @ basis.T, axis=1)
        values = {name: draws[name][chosen] for name in PARAMETERS if name in draws}
        values = {name: value if value.ndim == 2 else value[:, None] for name, value in values.items()}
        stated = np.zeros(len(spread), dtype=bool)
        likelihood = likelihood_of(model.likelihood, number_of_preferences(tree), indifferent=stated, **values)
        for column, side in ((PREFERRED, 1.0), (DOMINATED, -1.0)):
            probabilities[:, column] += smoothed_probability(likelihood, side * margins, spread).sum(axis=0)
    probabilities /= len(draws["setting"])
    left = np.maximum(1 - probabilities[:, :TIED].sum(axis=1), 0.0)  # rounding may take a little too much
    probabilities[:, TIED] = left if "tie_threshold" in draws else 0.0
    return probabilities


PARAMETERS = ("steepness", "lapse_rate", "tie_threshold")


def _every(tree: xr.DataTree) -> dict[str, np.ndarray]:
    """Draws of all chains, thinned, along the first axis."""
    drawn = tree.children["posterior"].dataset
    apart = spacing(drawn["setting"].size, MOST_DRAWS)
    names = [name for name in ("setting", "coordinates", *PARAMETERS) if name in drawn]
    parts = {name: drawn[name].values[:, ::apart] for name in names}
    parts["lapse_rates"], parts["lapse_rate"] = parts["lapse_rate"], next_lapse_rates(tree)[:, ::apart]
    draws = parts["setting"].size
    return {name: part.reshape(draws, *part.shape[2:]) for name, part in parts.items()}


def held_out_probabilities(
    differences: np.ndarray,
    model: PreferenceModel,
    used: np.ndarray,
    asked: np.ndarray,
    *,
    answers: Answers = NOTHING_ELSE,
    number_of_preferences: int | None = None,
    **sampling_options: int,
) -> tuple[np.ndarray, bool]:
    """Fit a model to some rows of `differences` and predict the answers of others.

    Args:
      differences: shape (K, D) or (C, K, D).
      model: prior and likelihood.
      used, asked: the fitted rows and the n predicted ones: bool (K,), or row numbers.
      answers: ties, sides and answerers of the rows.
      number_of_preferences: K of eq. 8; all rows by default.
      sampling_options: `seed`, `num_samples` and the like of `sample_posterior`.

    Returns:
      `answer_probabilities` (n, 3) of the asked rows, and whether the sampler converged.
    """
    number = differences.shape[-2] if number_of_preferences is None else number_of_preferences
    answers = answers.checked(differences.shape[-2])
    tree = _fit(differences[..., used, :], model, answers.of(used), number, **sampling_options)
    probabilities = answer_probabilities(tree, differences[..., asked, :], answers.of(asked))
    return probabilities, bool(tree.attrs["converged"])


def refit(tree: xr.DataTree, used: np.ndarray, **sampling_options: int) -> xr.DataTree:
    """The posterior of the same model given only the answers `used`, shape (K,) bool; eq. 8 keeps its K.

    `sampling_options` are `seed`, `num_samples` and the like of `sample_posterior`; the seed is the tree's by default.
    """
    known = np.asarray(tree["constant_data"]["differences"])[..., used, :]
    options = {"seed": int(tree.attrs["seed"]), **sampling_options}
    return _fit(known, fitted_model(tree), answers_of(tree).of(used), number_of_preferences(tree), **options)


def fitted_model(tree: xr.DataTree) -> PreferenceModel:
    """The model of a tree's draws."""
    options: dict[str, Any] = {field.name: tree.attrs[field.name] for field in fields(PreferenceModel)}
    for name, value in options.items():
        options[name] = None if value != value else value  # NaN: inferred
    return PreferenceModel(**options)


def tied_rows(tree: xr.DataTree) -> np.ndarray:
    """Rows with the answer "no difference", shape (K,) bool."""
    return np.asarray(tree["observed_data"]["answers"]) == 0


def answer_groups(groups: np.ndarray | None, number: int) -> np.ndarray:
    """The number of the answer that each of K rows follows from, shape (K,): 0 … K−1 by default.

    Raises:
      ValueError: numbers that are no integers, of another shape, or that decrease.
    """
    if groups is None:
        return np.arange(number)
    groups = np.asarray(groups)
    if groups.shape != (number,) or not np.issubdtype(groups.dtype, np.integer) or np.any(np.diff(groups) < 0):
        raise ValueError(f"groups: expected {number} integers that never decrease, got {groups}")
    return groups


def _fit(
    known: np.ndarray, model: PreferenceModel, answers: Answers, number: int, *, seed: int = 0, **sampler: int
) -> xr.DataTree:
    return posterior_draws(
        known, model, seed=seed, answers=answers, number_of_preferences=number, sampler=SamplerOptions(**sampler)
    )
