"""The answerers: lapse rate, side bias, consistency and response time of each."""

from collections.abc import Sequence

import numpy as np
import xarray as xr
from scipy import stats

from bayespbrl.models.posterior_tree import check_posterior
from bayespbrl.preferences import Answer, PastQuestion

LEVEL = 0.9  # of all intervals


def people(past: Sequence[PastQuestion], posterior: xr.DataTree | None = None) -> xr.Dataset:
    """The figures of each answerer, along `answerer`, by name; "" is whoever gave no name.

    Args:
      past: the questions that were answered, `learner.state.past`.
      posterior: fitted to these answers, `learner.estimate.posterior`; None: without lapse rates and side biases, as is
        one that was fitted to several people's answers without their names.

    Returns:
      `answers`, of which `ties`, and `cannot_tell`, which are no answers; `lapse_rate` and `side_bias`, posterior
      means, with `…_lower` and `…_upper`, their 90 % intervals (the bias is positive towards the first shown, in the
      unit of the margins, whose prior has the standard deviation `prior_scale`; NaN where it is not inferred);
      `repeated`, how many of their answers were asked for again from them and answered, and `consistent`, how many of
      these said the same, with `consistency_lower` and `consistency_upper`, the exact 90 % interval of its share
      (Clopper and Pearson 1934);
      `shared`, how many of their questions somebody else answered too, and `agreed`, how many of these alike, with
      `agreement_lower` and `agreement_upper`;
      `seconds`, the median response time, NaN where none is known, with `seconds_lower` and `seconds_upper`, two order
      statistics between which the median lies with a probability of at least 90 %, NaN with fewer than five times.
    """
    names = list(dict.fromkeys(question.answerer or "" for question in past))
    fitted_to = () if posterior is None else _fitted_to(posterior, past)
    pairs = _asked_twice(past)
    rows = [
        _figures(name, [q for q in past if (q.answerer or "") == name], pairs, posterior if name in fitted_to else None)
        for name in names
    ]
    columns = rows[0] if rows else _figures("", [], [], None)
    data = {name: ("answerer", np.array([row[name] for row in rows])) for name in columns}
    return xr.Dataset(data, coords={"answerer": np.array(names, dtype=object)})


def _asked_twice(past: Sequence[PastQuestion]) -> list[tuple[PastQuestion, PastQuestion]]:
    """The questions that were answered twice, each with the one that repeats it."""
    earlier = {question.number: question for question in past if question.answer is not Answer.SKIP}
    return [(earlier[each.repeats], each) for each in earlier.values() if each.repeats in earlier]


def _alike(pairs: Sequence[tuple[PastQuestion, PastQuestion]]) -> tuple[int, float, float]:
    """How many pairs of answers say the same, and the exact interval of their share (Clopper and Pearson 1934)."""
    same = sum(one.preferred == other.preferred for one, other in pairs)
    interval = stats.binomtest(same, len(pairs)).proportion_ci(LEVEL, method="exact") if pairs else (0.0, 1.0)
    return same, float(interval[0]), float(interval[1])


def _figures(
    name: str,
    past: Sequence[PastQuestion],
    twice: Sequence[tuple[PastQuestion, PastQuestion]],
    posterior: xr.DataTree | None,
) -> dict[str, float]:
    given = [question for question in past if question.answer is not Answer.SKIP]
    theirs = [pair for pair in twice if name in (pair[0].answerer or "", pair[1].answerer or "")]
    again = [pair for pair in theirs if pair[0].answerer == pair[1].answerer]
    shared = [pair for pair in theirs if pair[0].answerer != pair[1].answerer]
    times = [question.seconds for question in past if question.seconds is not None]
    figures: dict[str, float] = {
        "answers": len(given),
        "ties": sum(question.answer is Answer.TIE for question in given),
        "cannot_tell": len(past) - len(given),
        "repeated": len(again),
        "shared": len(shared),
        "seconds": float(np.median(times)) if times else np.nan,
    }
    figures["consistent"], figures["consistency_lower"], figures["consistency_upper"] = _alike(again)
    figures["agreed"], figures["agreement_lower"], figures["agreement_upper"] = _alike(shared)
    figures["seconds_lower"], figures["seconds_upper"] = _around_median(times)
    for quantity in ("lapse_rate", "side_bias"):
        draws = _draws(name, quantity, posterior)
        figures[quantity] = float(np.mean(draws))
        figures[f"{quantity}_lower"], figures[f"{quantity}_upper"] = (
            float(end) for end in np.quantile(draws, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
        )
    return figures


def _around_median(times: Sequence[float]) -> tuple[float, float]:
    """The narrowest symmetric pair of order statistics that holds the median with at least `LEVEL`; NaN without one."""
    outside = int(stats.binom.ppf((1 - LEVEL) / 2, len(times), 0.5))  # its ends, counted from 1 from either side
    if outside == 0:
        return np.nan, np.nan
    ordered = sorted(times)
    return float(ordered[outside - 1]), float(ordered[-outside])


def _fitted_to(posterior: xr.DataTree, past: Sequence[PastQuestion]) -> Sequence[str]:
    """The people of whose answers the posterior says how often they are wrong."""
    check_posterior(posterior)
    drawn = posterior.children["posterior"].dataset
    if "answerer" in drawn.coords:
        return [str(name) for name in drawn["answerer"].values]
    given = [question.answerer or "" for question in past if question.answer is not Answer.SKIP]
    # without names: to whoever answered first, before another did, or to all as if they were one
    pooled = len(set(given)) > 1 and drawn["margins"].shape[-1] >= len(given)
    return [] if pooled else given[:1]


def _draws(name: str, quantity: str, posterior: xr.DataTree | None) -> np.ndarray:
    """Posterior draws of one answerer's lapse rate or side bias; NaN where there are none."""
    drawn = None if posterior is None else posterior.children["posterior"].dataset
    if drawn is None or quantity not in drawn:
        return np.array([np.nan])
    if "answerer" in drawn.coords:
        return np.asarray(drawn[quantity].sel(answerer=name).values.ravel())
    return np.asarray(drawn[quantity].values).ravel()
