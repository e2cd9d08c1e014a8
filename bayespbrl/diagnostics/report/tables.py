"""The tables of a report, each an xarray data set: iterations, answers, the utility of states, trajectories."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from gymnasium.spaces import Discrete

from bayespbrl.diagnostics.estimates import expect_estimate
from bayespbrl.diagnostics.prequential import score_predictions
from bayespbrl.diagnostics.report.contents import RunContents
from bayespbrl.diagnostics.report.log import AnsweredQuestion, Summary
from bayespbrl.diagnostics.uncertainty import ranking_probabilities, return_draws
from bayespbrl.models.posterior_tree import utility_margins
from bayespbrl.preferences import Answer
from bayespbrl.trajectories import Trajectory

MEASURED = (
    *(
        "answers",
        "pairs",
        "pairs_satisfied",
        "value",
        "value_newest",
        "kl_bound",
        "bound_active",
        "kl",
        "kl_fitted_policy",
        "updates",
    ),
    *("effective_samples", "temperature", "reps_converged", "policy_fit_converged"),
    *("entropy", "action_standard_deviation"),
    *("rhat_max", "effective_sample_size_min", "utility_converged", "log_evidence"),
)
ROUNDING = 1e-9  # of the largest margin
DRAWS = 1000  # a standard deviation is then known to a fortieth of itself
SHOWN_DRAWS, SHOWN_STATES, RESOLUTION = 3, 3000, 60
Variables = dict[str, tuple[str | tuple[str, ...], np.ndarray]]


def iterations_table(summaries: Sequence[Summary]) -> xr.Dataset:
    """The figures of each completed iteration, as float64 along `iteration`; NaN where one is missing.

    A list of numbers becomes its mean. What the schedule, the check of the newest policy and the choice of
    hyperparameters reported becomes variables `schedule …`, `check …` and `hyperparameters …`, texts where they are no
    numbers.
    """
    columns: dict[str, list[Any]] = {name: [_number(summary.get(name)) for summary in summaries] for name in MEASURED}
    for group in ("schedule", "check", "hyperparameters"):
        rows = [_flat(summary.get(group)) for summary in summaries]
        for number, row in enumerate(rows) if group == "check" else ():
            # its own policy is the best, and by no gain: none was compared
            if row.get("best") == number and row.get("gain") == row.get("standard_error") == 0:
                row |= {"gain": None, "standard_error": None}
        for key in dict.fromkeys(key for row in rows for key in row):
            values = [row.get(key) for row in rows]
            convert = _text if any(isinstance(value, str) for value in values) else _number
            columns[f"{group} {key}"] = [convert(value) for value in values]
    data = {name: ("iteration", np.asarray(values)) for name, values in columns.items()}
    return xr.Dataset(data, coords={"iteration": np.arange(1, len(summaries) + 1)})


def iterations_without_question(contents: RunContents, iterations: xr.Dataset) -> int:
    """How many iterations asked no question; one whose questions were all skipped asked."""
    without_answer = iterations["iteration"].values[1:][np.diff(iterations["answers"].values) == 0]
    return len(set(without_answer.tolist()) - {answer.iteration for answer in contents.answers})


def answers_table(contents: RunContents) -> xr.Dataset:
    """All answers, along `answer`, with their probabilities.

    Returns:
      `question`, `iteration`, `first`, `second`, `said`, the answer; `before`, its probability by the estimate that the
      learner had by then; `probability`, the same by the last posterior, which has seen the answer (NaN for a skip,
      for a tie where ties are not used, and for answers after the last estimate that can be read); `margin`, the
      utility of the preferred one less that of the other by the last estimate, and its posterior standard deviation
      `margin_sd` (NaN for a tie).
    """
    answers = contents.answers
    data: Variables = {
        name: ("answer", np.asarray([getattr(answer, name) for answer in answers]))
        for name in ("question", "iteration", "first", "second", "before")
    }
    data["said"] = ("answer", np.array([str(answer.answer) for answer in answers], dtype=np.str_))
    margins = None if contents.posterior is None else utility_margins(contents.posterior)
    columns = np.reshape([_by_last_estimate(contents, answer, margins) for answer in answers], (-1, 3)).T
    for name, column in zip(("probability", "margin", "margin_sd"), columns, strict=True):
        data[name] = ("answer", column)
    return xr.Dataset(data)


def contradicted(answers: xr.Dataset) -> np.ndarray:
    """Which answers of an `answers_table` the last estimate contradicts, shape (N,) bool; not those off by rounding."""
    margins = answers["margin"].values
    return np.asarray(margins < -ROUNDING * np.max(np.abs(margins), where=np.isfinite(margins), initial=0.0))


def _by_last_estimate(
    contents: RunContents, answer: AnsweredQuestion, margins: np.ndarray | None
) -> tuple[float, float, float]:
    """Probability of an answer that the estimate was fitted to, its margin and the margin's standard deviation.

    NaN where these are unknown: without a posterior, or where a trajectory or its features are missing.
    """
    estimate, tree = contents.estimate, contents.posterior
    if estimate is None or answer.row is None:
        return np.nan, np.nan, np.nan
    if tree is not None and not answer.states_order and "tie_threshold" not in tree["posterior"]:
        return np.nan, np.nan, np.nan  # a plain chain leaves ties out
    pairs = estimate.quality.pairs  # the rows of the ties come after them
    row, rows = (
        (answer.row, pairs) if answer.states_order else (pairs + answer.row, 0 if margins is None else margins.shape[2])
    )
    if row >= rows:
        return np.nan, np.nan, np.nan
    probability = spread = np.nan
    if tree is not None and margins is not None:
        margin = margins[:, :, row]
        probability = float(np.mean(np.exp(np.asarray(tree["log_likelihood"]["answers"])[:, :, row])))
        if not answer.states_order:
            return probability, np.nan, np.nan
        spread = float(margin.std())
        if contents.settings.estimation.utility == "posterior-mean":  # the margin of the utility that is acted on
            return probability, float(margin.mean()), spread
    both = _preferred_and_dominated(contents, answer)
    used = np.nan if both is None else float(np.subtract(*estimate.trajectory_utilities(both)))
    return probability, used, spread


def prequential_table(contents: RunContents) -> xr.Dataset:
    """Scores and reliability curve of the predictions that the learner made of the answers, before each was given.

    As of `score_predictions`, without ties, skips, answers that could not be predicted, and those of the first
    iteration, which has no posterior.
    """
    scored = contents.scored
    predicted = np.array([answer.predicted for answer in scored])
    observed = np.array([answer.answer is Answer.FIRST for answer in scored], dtype=bool)
    return score_predictions(np.clip(predicted, 0, 1), observed)


def utility_table(contents: RunContents) -> xr.Dataset:
    """The utility over the state space.

    Returns:
      along `state`: `used`, the utility that the learner used; where there is a posterior, its `mean` and `sd`,
      `prior_sd`, and `draws` (draw, state), three of them; `states`, the observations; `visits`, how often each was
      seen (discrete states); `reached`, whether it was (discrete states) or φ is more than a hundredth of its largest
      length, as it is near some centre.

      The attribute `kind` says what the states are: `grid` (the cells, row by row, of an environment with a
      `grid_shape`), `list` (discrete), `line` and `plane` (evenly spaced over what was observed in one or two
      dimensions) or `cloud` (observed states; `dimensions` are the two that they fill best). `shape` is that of a grid
      or plane.

    Raises:
      ValueError: no estimate, or features that were not passed again; no trajectory that can be read.
    """
    estimate = contents.estimate
    if not contents.trajectories:
        raise ValueError("trajectories: expected at least one that can be read, got none")
    if estimate is None or estimate.features is None:
        raise ValueError("utility: expected an estimate of the utility of states, got none")
    states = np.concatenate([trajectory.states for trajectory in contents.trajectories.values()])
    shown, attrs = _states_to_show(contents, states, np.random.default_rng(0))
    data: Variables = {"used": ("state", estimate.utilities(shown))}
    data["states"] = (("state",) if shown.ndim == 1 else ("state", "observation"), shown)
    if states.ndim == 1:
        visits = np.bincount(states, minlength=len(shown))
        data |= {"visits": ("state", visits), "reached": ("state", visits > 0)}
    else:
        lengths = np.linalg.norm(estimate.features(shown), axis=1)
        data["reached"] = ("state", lengths > 0.01 * np.max(lengths, initial=0.0))
    if estimate.posterior is not None:
        _, draws = estimate.utilities_and_draws(shown, number=DRAWS)
        chosen = np.linspace(0, len(draws) - 1, SHOWN_DRAWS).astype(int)
        data["mean"] = ("state", estimate.mean_utilities(shown))
        data["sd"] = ("state", draws.std(axis=0))
        data["draws"] = (("draw", "state"), draws[chosen])
        data["prior_sd"] = ("state", estimate.prior_deviations(shown))
    return xr.Dataset(data, attrs=attrs)


def trajectories_table(contents: RunContents) -> xr.Dataset:
    """Each trajectory that a question showed, along `trajectory` (their numbers).

    Returns:
      `utility`, its 90 % interval `lower`, `upper` where there is a posterior, and `hidden_return`, which the learner
      never sees.

    Raises:
      ValueError: no estimate, or features that were not passed again.
    """
    estimate = expect_estimate(contents.estimate)
    asked = {number for answer in contents.answers for number in (answer.first, answer.second)}
    numbers = sorted(asked & set(contents.compared))
    shown = [contents.compared[number] for number in numbers]
    data: Variables = {"hidden_return": ("trajectory", np.array([t.total_reward for t in shown]))}
    data["utility"] = ("trajectory", estimate.trajectory_utilities(shown) if shown else np.zeros(0))
    if contents.posterior is not None and shown:
        data |= _interval(estimate.trajectory_draws(shown, number=DRAWS), "trajectory")
    return xr.Dataset(data, coords={"trajectory": numbers})


def progress_table(contents: RunContents) -> xr.Dataset:
    """Utility of each iteration's trajectories by the last estimate: a learning curve that needs no reward.

    Returns:
      along `iteration`: `utility`, the mean over its trajectories less that of the last, and where there is a posterior
      `lower` and `upper`, the 90 % interval of that difference; only iterations whose trajectories can all be read.

    Raises:
      ValueError: no estimate; features that were not passed again.
    """
    estimate, size = expect_estimate(contents.estimate), contents.settings.rollouts.trajectories_per_iteration
    numbers = sorted(contents.trajectories)  # of whole iterations: the file of one is read or is not
    shown = [contents.trajectories[number] for number in numbers]

    def relative_to_last(utilities: np.ndarray) -> np.ndarray:
        means = utilities.reshape(*utilities.shape[:-1], -1, size).mean(axis=-1)
        return means - means[..., -1:]

    data: Variables = {"utility": ("iteration", relative_to_last(estimate.trajectory_utilities(shown)))}
    if contents.posterior is not None:
        data |= _interval(relative_to_last(estimate.trajectory_draws(shown, number=DRAWS)), "iteration")
    return xr.Dataset(data, coords={"iteration": [number // size + 1 for number in numbers[::size]]})


def ranking_table(contents: RunContents) -> xr.Dataset:
    """Posterior probabilities of the order of the newest iteration's trajectories and the undominated one.

    As of `ranking_probabilities`, with their numbers along `trajectory`; empty without features or posterior.
    """
    size = contents.settings.rollouts.trajectories_per_iteration
    newest = [n for n in sorted(contents.compared) if n >= (contents.estimate_iteration - 1) * size][:size]
    best = [n for n in contents.preferences.undominated[-1:] if n in contents.compared]
    numbers = sorted({*newest, *best}) if contents.posterior is not None and not contents.features_missing else []
    if not numbers:
        return xr.Dataset(coords={"trajectory": np.zeros(0, dtype=np.int64)})
    draws = return_draws(contents.estimate, [contents.compared[n] for n in numbers], number=DRAWS)
    return ranking_probabilities(draws.assign_coords(trajectory=numbers))


def _interval(draws: np.ndarray, dimension: str) -> Variables:
    """`lower` and `upper`, the ends of the interval that holds 90 % of the draws, (S, n), along `dimension`."""
    lower, upper = np.quantile(draws, [0.05, 0.95], axis=0)
    return {"lower": (dimension, lower), "upper": (dimension, upper)}


def _states_to_show(
    contents: RunContents, states: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, dict[str, str | tuple[int, ...]]]:
    if states.ndim == 1:
        space = None if contents.environment is None else contents.environment.observation_space
        number = int(space.n) if isinstance(space, Discrete) else int(states.max()) + 1
        shape = contents.environment_attribute("grid_shape")
        return np.arange(number), {"kind": "list"} if shape is None else {"kind": "grid", "shape": tuple(shape)}
    if states.shape[1] <= 2:
        least, most = states.min(axis=0), states.max(axis=0)
        beside = 0.5 * (least == most)  # a map has a height where a dimension is constant, too
        lines = [np.linspace(*ends, RESOLUTION) for ends in zip(least - beside, most + beside, strict=True)]
        grid = np.stack([axis.ravel() for axis in np.meshgrid(*lines)], axis=1)
        return grid, {"kind": "line"} if len(lines) == 1 else {"kind": "plane", "shape": (RESOLUTION, RESOLUTION)}
    spread = np.quantile(states, 0.9, axis=0) - np.quantile(states, 0.1, axis=0)
    whole = np.ptp(states, axis=0)
    filled = np.divide(spread, whole, out=np.zeros(len(whole)), where=whole > 0)
    dimensions = np.sort(np.argsort(-filled, kind="stable")[:2])
    chosen = rng.choice(len(states), size=min(SHOWN_STATES, len(states)), replace=False)
    return states[chosen], {"kind": "cloud", "dimensions": tuple(int(d) for d in dimensions)}


def _preferred_and_dominated(contents: RunContents, answer: AnsweredQuestion) -> tuple[Trajectory, Trajectory] | None:
    """The two trajectories of an answer; None where one of them, or the features, are missing."""
    preferred, dominated = answer.first, answer.second
    if answer.answer is not Answer.FIRST:
        preferred, dominated = dominated, preferred
    known = contents.compared
    if contents.features_missing or preferred not in known or dominated not in known:
        return None
    return known[preferred], known[dominated]


def _number(value: object) -> float:
    if isinstance(value, list) and value:
        return float(np.mean([_number(entry) for entry in value]))
    return float(value) if isinstance(value, int | float) else float("nan")


def _text(value: object) -> str:
    return "" if value is None else str(value)


def _flat(value: object) -> dict[str, Any]:
    """Nested mappings and lists as one mapping: {"a": {"b": 1}, "c": [2]} as {"a b": 1, "c 0": 2}."""
    if not isinstance(value, Mapping):
        return {}
    flat: dict[str, Any] = {}
    for key, entry in value.items():
        inner = _flat(dict(enumerate(entry)) if isinstance(entry, list) else entry)
        flat |= {f"{key} {name}": part for name, part in inner.items()} if inner else {str(key): entry}
    return flat
