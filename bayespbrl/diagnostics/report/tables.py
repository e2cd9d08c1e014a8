"""The tables of a report, each an xarray data set: iterations, answers, the utility over the states, trajectories."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from gymnasium.spaces import Discrete

from bayespbrl.diagnostics.prequential import score_predictions
from bayespbrl.diagnostics.report.contents import Evidence
from bayespbrl.diagnostics.report.log import AnswerRecord
from bayespbrl.diagnostics.uncertainty import ranking_probabilities, return_draws
from bayespbrl.models.likelihoods import prob
from bayespbrl.preferences import Answer
from bayespbrl.trajectories import Trajectory
from bayespbrl.utility.averaging import AveragedUtility

MEASURED = (
    "answers",
    "pairs",
    "pairs_satisfied",
    "value",
    "kl_bound",
    "bound_active",
    "kl",
    "kl_fitted_policy",
    "updates",
    "effective_samples",
    "temperature",
    "reps_converged",
    "entropy",
    "action_standard_deviation",
    "rhat_max",
    "effective_sample_size_min",
    "utility_converged",
    "log_evidence",
)
# A thousand draws tell a standard deviation to a fortieth of itself.
DRAWS, CLOUD, RESOLUTION, SHOWN_DRAWS = 1000, 3000, 60, 3


def iterations_table(summaries: Sequence[Mapping[str, Any]]) -> xr.Dataset:
    """What each completed iteration reported, as float64 along `iteration`; NaN where it said nothing.

    A list of numbers is averaged there. What a schedule or the choice of hyper-parameters said becomes variables
    `schedule …` and `hyperparameters …`, texts where they are no numbers.
    """
    columns: dict[str, Any] = {name: [_number(summary.get(name)) for summary in summaries] for name in MEASURED}
    for group in ("schedule", "hyperparameters"):
        rows = [_flat(summary.get(group)) for summary in summaries]
        for key in dict.fromkeys(key for row in rows for key in row):
            values = [row.get(key) for row in rows]
            texts = any(isinstance(value, str) for value in values)
            columns[f"{group} {key}"] = (
                ["" if v is None else str(v) for v in values] if texts else [_number(v) for v in values]
            )
    data = {name: ("iteration", np.asarray(values)) for name, values in columns.items()}
    return xr.Dataset(data, coords={"iteration": np.arange(1, len(summaries) + 1)})


def answers_table(evidence: Evidence) -> xr.Dataset:
    """Every answer, along `answer`, and what was and is expected of it.

    Returns:
      `question`, `iteration`, `first`, `second`, `said`; `before`, the probability of what was said by the estimate
      that the learner had when it asked; `probability`, the same by the last posterior, which has seen the answer (NaN
      for a tie or a skip, and for what came after the last estimate that can be read); `margin`, how much higher the
      last estimate puts the preferred one, and its posterior standard deviation `margin_sd`.
    """
    records, tree = evidence.answers, evidence.posterior
    number = len(records)
    names = ("before", "probability", "margin", "margin_sd")
    columns = {name: np.full(number, np.nan) for name in names}
    known = 0 if evidence.estimate is None else evidence.estimate.quality.pairs
    for k, record in enumerate(records):
        if record.row is None:
            continue
        columns["before"][k] = record.predicted if record.answer is Answer.FIRST else 1 - record.predicted
        if record.row >= known:
            continue
        if isinstance(evidence.estimate, AveragedUtility):
            if (both := _preferred_and_dominated(evidence, record)) is not None:
                margins = evidence.estimate.margin_draws(*both)
                columns["probability"][k] = np.mean(prob(evidence.estimate.likelihood, margins))
                columns["margin"][k], columns["margin_sd"][k] = margins.mean(), margins.std()
        elif tree is not None:
            margins = np.asarray(tree["posterior"]["margins"])[:, :, record.row]
            log_likelihood = np.asarray(tree["log_likelihood"]["answers"])[:, :, record.row]
            columns["probability"][k] = np.mean(np.exp(log_likelihood))
            columns["margin"][k], columns["margin_sd"][k] = margins.mean(), margins.std()
        else:
            columns["margin"][k] = _margin(evidence, record)
    data: dict[str, Any] = {name: [getattr(r, name) for r in records] for name in ("question", "iteration")}
    data |= {name: [getattr(r, name) for r in records] for name in ("first", "second")}
    data["said"] = np.array([str(r.answer) for r in records], dtype=np.str_)
    return xr.Dataset({name: ("answer", np.asarray(values)) for name, values in (data | columns).items()})


def prequential_table(evidence: Evidence) -> xr.Dataset:
    """Scores and reliability curve of the predictions that the learner made of the answers, before each was given.

    As of `score_predictions`; ties, skips and what could not be predicted are left out.
    """
    scored = [r for r in evidence.answers if r.row is not None and np.isfinite(r.predicted)]
    predicted = np.array([record.predicted for record in scored])
    observed = np.array([record.answer is Answer.FIRST for record in scored], dtype=bool)
    return score_predictions(np.clip(predicted, 0, 1), observed)


def utility_table(evidence: Evidence, *, seed: int = 0) -> xr.Dataset:
    """The utility over the state space.

    Returns:
      along `state`: `used`, what the learner took for the utility (of an `AveragedUtility` the average, and all else
      of its likeliest setting); where there is a posterior, its `mean` and `sd`,
      `prior_sd`, and `draws` (draw, state), three of them; all in the units of the weights; `states`, the observations;
      `visits`, how often each was seen (discrete states); `reached`, whether φ is more than next to nothing there, as
      it is not far from every centre.

      The attribute `kind` says what the states are: `grid` (the cells, row by row, of an environment that has a
      `grid_shape`), `list` (discrete), `line` and `plane` (evenly spaced over what was observed in one or two
      dimensions) or `cloud` (observed states; `dimensions` are the two that they fill best). `shape` is that of a grid
      or plane.

    Raises:
      ValueError: no estimate, or features that were not passed again; no trajectory that can be read.
    """
    estimate, states = evidence.estimate, _observed(evidence)
    if not hasattr(estimate, "utilities"):
        raise ValueError("utility: expected an estimate of the utility of states, got none")
    shown, attrs = _states_to_show(evidence, states, np.random.default_rng(seed))
    features = estimate.features(shown)
    lengths = np.linalg.norm(features, axis=1)
    data: dict[str, Any] = {"used": ("state", estimate.utilities(shown))}
    data["reached"] = ("state", lengths > 0.01 * np.max(lengths, initial=0.0))
    data["states"] = (("state",) if shown.ndim == 1 else ("state", "observation"), shown)
    if states.ndim == 1:
        data["visits"] = ("state", np.bincount(states, minlength=len(shown)))
    if evidence.posterior is not None:
        draws = estimate.draws(features, number=DRAWS).reshape(-1, len(shown))
        chosen = np.linspace(0, len(draws) - 1, SHOWN_DRAWS).astype(int)
        mean = np.asarray(evidence.posterior["utility_weights_mean"]) / estimate.scale
        data["mean"], data["sd"] = ("state", features @ mean), ("state", draws.std(axis=0))
        data["draws"] = (("draw", "state"), draws[chosen])
        scale = float(evidence.posterior.attrs["prior_scale"]) / estimate.scale
        data["prior_sd"] = ("state", scale * lengths)
    return xr.Dataset(data, attrs=attrs)


def trajectories_table(evidence: Evidence) -> xr.Dataset:
    """Each trajectory that was asked about, along `trajectory` (their numbers): `utility`, its 90 % interval `lower`,
    `upper` where there is a posterior, and `hidden_return`, which the learner never sees.

    Raises:
      ValueError: no estimate, or features that were not passed again.
    """
    estimate = _estimate(evidence)
    asked = {number for record in evidence.answers for number in (record.first, record.second)}
    numbers = sorted(asked & set(evidence.trajectories))
    shown = [evidence.trajectories[number] for number in numbers]
    data: dict[str, Any] = {"hidden_return": ("trajectory", np.array([t.total_reward for t in shown]))}
    data["utility"] = ("trajectory", estimate.trajectory_utilities(shown) if shown else np.zeros(0))
    if evidence.posterior is not None and shown:
        data |= _interval(estimate.trajectory_draws(shown, number=DRAWS), "trajectory")
    return xr.Dataset(data, coords={"trajectory": numbers})


def progress_table(evidence: Evidence) -> xr.Dataset:
    """What the last estimate thinks of each iteration's trajectories, along `iteration`: a learning curve that needs no
    reward.

    Returns:
      `utility`, the mean over the iteration's trajectories less that of the last, and where there is a posterior
      `lower` and `upper`, the 90 % interval of that difference; only iterations whose trajectories can all be read.

    Raises:
      ValueError: no estimate; features that were not passed again.
    """
    estimate, size = _estimate(evidence), evidence.settings.trajectories_per_iteration
    numbers = sorted(evidence.trajectories)  # of whole iterations, for the file of one is read or is not
    shown = [evidence.trajectories[number] for number in numbers]

    def over_the_last(utilities: np.ndarray) -> np.ndarray:
        means = utilities.reshape(*utilities.shape[:-1], -1, size).mean(axis=-1)
        return means - means[..., -1:]

    data: dict[str, Any] = {"utility": ("iteration", over_the_last(estimate.trajectory_utilities(shown)))}
    if evidence.posterior is not None:
        data |= _interval(over_the_last(estimate.trajectory_draws(shown, number=DRAWS)), "iteration")
    return xr.Dataset(data, coords={"iteration": [number // size + 1 for number in numbers[::size]]})


def ranking_table(evidence: Evidence) -> xr.Dataset:
    """What the posterior says about the order of the newest iteration's trajectories and the undominated one.

    As of `ranking_probabilities`, with their numbers along `trajectory`; none of them without features or posterior.
    """
    size = evidence.settings.trajectories_per_iteration
    newest = [n for n in sorted(evidence.trajectories) if n >= (evidence.estimate_iteration - 1) * size][:size]
    best = [n for n in evidence.preferences.undominated[-1:] if n in evidence.trajectories]
    numbers = sorted({*newest, *best}) if evidence.posterior is not None and not evidence.features_missing else []
    if not numbers:
        return xr.Dataset(coords={"trajectory": np.zeros(0, dtype=np.int64)})
    draws = return_draws(evidence.estimate, [evidence.trajectories[n] for n in numbers], number=DRAWS)
    return ranking_probabilities(draws.assign_coords(trajectory=numbers))


def _estimate(evidence: Evidence) -> Any:
    """The estimate of a run that has one; a `ValueError` otherwise."""
    if not hasattr(evidence.estimate, "trajectory_utilities"):
        raise ValueError("utility: expected an estimate, got none")
    return evidence.estimate


def _interval(draws: np.ndarray, dimension: str) -> dict[str, Any]:
    """`lower` and `upper`, the ends of the interval that holds 90 % of the draws, (S, n), along `dimension`."""
    lower, upper = np.quantile(draws, [0.05, 0.95], axis=0)
    return {"lower": (dimension, lower), "upper": (dimension, upper)}


def _states_to_show(
    evidence: Evidence, states: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, dict[str, Any]]:
    if states.ndim == 1:
        space = getattr(evidence.environment, "observation_space", None)
        number = int(space.n) if isinstance(space, Discrete) else int(states.max()) + 1
        shape = getattr(evidence.dynamics, "grid_shape", None)
        kind = {"kind": "list"} if shape is None else {"kind": "grid", "shape": tuple(shape)}
        return np.arange(number), kind
    if states.shape[1] <= 2:
        lines = [np.linspace(low, high, RESOLUTION) for low, high in zip(states.min(0), states.max(0), strict=True)]
        grid = np.meshgrid(*lines)
        kind = {"kind": "line"} if len(lines) == 1 else {"kind": "plane", "shape": (RESOLUTION, RESOLUTION)}
        return np.stack([axis.ravel() for axis in grid], axis=1), kind
    spread = np.quantile(states, 0.9, axis=0) - np.quantile(states, 0.1, axis=0)
    whole = np.ptp(states, axis=0)
    filled = np.divide(spread, whole, out=np.zeros(len(whole)), where=whole > 0)
    dimensions = np.sort(np.argsort(-filled, kind="stable")[:2])
    chosen = rng.choice(len(states), size=min(CLOUD, len(states)), replace=False)
    return states[chosen], {"kind": "cloud", "dimensions": tuple(int(d) for d in dimensions)}


def _observed(evidence: Evidence) -> np.ndarray:
    if not evidence.trajectories:
        raise ValueError("trajectories: expected at least one that can be read, got none")
    return np.concatenate([trajectory.states for trajectory in evidence.trajectories.values()])


def _margin(evidence: Evidence, record: AnswerRecord) -> float:
    """By an estimate without draws, in its own units; NaN where a trajectory or its features are missing."""
    both = _preferred_and_dominated(evidence, record)
    if both is None:
        return float("nan")
    preferred, dominated = evidence.estimate.trajectory_utilities(both)
    return float(preferred - dominated)


def _preferred_and_dominated(evidence: Evidence, record: AnswerRecord) -> list[Trajectory] | None:
    """The two that an answer was about; None where one, or what their utility rests on, is missing."""
    numbers = (record.first, record.second) if record.answer is Answer.FIRST else (record.second, record.first)
    both = [evidence.trajectories[number] for number in numbers if number in evidence.trajectories]
    return None if len(both) < 2 or evidence.features_missing else both


def _number(value: Any) -> float:
    if isinstance(value, list) and value:
        return float(np.mean([_number(entry) for entry in value]))
    return float(value) if isinstance(value, int | float) else float("nan")


def _flat(value: Any) -> dict[str, Any]:
    """A mapping with mappings and lists within it joined on: {"a": {"b": 1}, "c": [2]} as {"a b": 1, "c 0": 2}."""
    if not isinstance(value, Mapping):
        return {}
    flat: dict[str, Any] = {}
    for key, entry in value.items():
        inner = _flat(dict(enumerate(entry)) if isinstance(entry, list) else entry)
        flat |= {f"{key} {name}": part for name, part in inner.items()} if inner else {str(key): entry}
    return flat
