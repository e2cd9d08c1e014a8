"""The results of many trials as tables: the figures of each iteration, and the balancing time of the final policies."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import xarray as xr

from bayespbrl import checks, rollouts
from bayespbrl.envs import bicycle
from bayespbrl.events import has_figures
from bayespbrl.learner import Learner
from bayespbrl.runs.directory import FIRST_POLICY_FILE, read_summary
from bayespbrl.runs.files import write_file, write_netcdf

COLUMNS = ("env", "utility", "seed", "iteration", "answers", "value", "value_newest")
SECONDS = ("seconds_utility", "seconds_improvement", "seconds_evaluation")
# The columns of a study's `iterations.csv` after the levels, the seed and the iteration, by the names in the summaries.
FIGURES = {
    "answers": "answers",
    "value": "value",
    "value_newest": "value_newest",
    "terminated": "terminated",
    "converged": "utility_converged",
    "rhat": "rhat_max",
    "effective_sample_size": "effective_sample_size_min",
    "signal": "schedule_signal",
    "kl": "kl",
    "kl_bound": "kl_bound",
    "seconds": "seconds",
}

BALANCING_FILE = "balancing.json"
BALANCING_EPISODES = 100


def collect(
    directories: Sequence[Path | str], read: Callable[[Path | str], dict[str, Any]] | None = None
) -> xr.Dataset:
    """The summaries of finished runs as one data set over (seed, iteration); `read` reads one, None for a run's.

    A run that ended earlier than others keeps its last figures, but for the seconds, until the last of them ends.
    Numbers are kept, and lists of numbers with a dimension of their own. Those of a nested entry have both names, as
    `seconds_utility`. Missing numbers are NaN.
    """
    summaries = [(read or read_trial)(path) for path in directories]
    seeds = [summary["seed"] for summary in summaries]
    length = max(len(summary["iterations"]) for summary in summaries)
    iterations = list(range(1, length + 1))
    rows = [_until(length, [_flat(entry) for entry in summary["iterations"]]) for summary in summaries]
    entries = [entry for summary in summaries for entry in summary["iterations"]]
    nested = {name for entry in entries for name, value in entry.items() if isinstance(value, dict)}
    variables: dict[str, Any] = {}
    for name in dict.fromkeys(name for row in rows for entry in row for name in entry):
        values = [[entry.get(name) for entry in row] for row in rows]
        if name not in {"iteration", *nested} and (figures := _figures(values)) is not None:
            variables[name] = (("seed", "iteration", f"{name}_dimension")[: figures.ndim], figures)
    if all((Path(path) / BALANCING_FILE).exists() for path in directories):
        lasted = [read_balancing(path) for path in directories]
        limits = {name: lasted[0][name] for name in ("max_steps", "episodes")}
        variables["balancing_steps"] = ("seed", np.array([entry["mean_steps"] for entry in lasted]), limits)
    attributes = {"env": summaries[0]["env"], "utility": summaries[0]["utility"]}
    return xr.Dataset(variables, {"seed": seeds, "iteration": iterations}, attributes)


def read_trial(directory: Path | str) -> dict[str, Any]:
    """The summary of a run as a trial (`checked_trial`)."""
    return checked_trial(read_summary(directory), Path(directory) / "summary.json")


def checked_trial(summary: Any, file: Path) -> dict[str, Any]:
    """The summary of a trial, or of what is told like one, with at least one iteration, each with its figures.

    Raises:
      ValueError: others; seconds that are missing, or `FIGURES` that are no numbers, would take a line or a column from
        the tables of all trials.
    """
    entries = summary.get("iterations") if isinstance(summary, dict) else None
    if not isinstance(entries, list) or not entries:
        raise ValueError(f"{file}: expected at least one iteration, got {str(entries)[:60]}")
    for number, entry in enumerate(entries, start=1):
        if not has_figures(entry):
            raise ValueError(f"{file}: expected answers and value in iteration {number}, got {str(entry)[:60]}")
        flat = _flat(entry)
        for name in (*SECONDS, *FIGURES.values()):
            value = flat.get(name)
            if not isinstance(value, int | float) and (value is not None or name in SECONDS):
                raise ValueError(f"{file}: expected a number as {name} in iteration {number}, got {str(value)[:60]}")
    if type(summary.get("seed")) is not int or not isinstance(summary.get("env"), str) or "utility" not in summary:
        figures = {name: summary.get(name) for name in ("seed", "env", "utility")}
        raise ValueError(f"{file}: expected seed, env and utility of a run, got {str(figures)[:120]}")
    return dict(summary)


def survival(table: xr.Dataset) -> xr.DataArray:
    """The share of evaluation episodes that survive under the policies whose values are told, (seed, iteration).

    Of each iteration the summary has the newest policy's, which is not always kept.
    """
    lasted = 1 - table["terminated"]
    if "kept" not in table:
        return lasted
    newest = np.broadcast_to(table["iteration"].values, lasted.shape)
    kept = np.where(table["kept"].isnull(), newest, table["kept"]).astype(int)
    return lasted.copy(data=np.take_along_axis(lasted.values, kept - 1, axis=1))


def took_place(table: xr.Dataset) -> xr.DataArray:
    """Which trials had which iterations, (seed, iteration) bool: those that were to come have no seconds."""
    return table["seconds_utility"].notnull()


def by_answers(answers: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values by the number of answers, for trials whose iterations ask different numbers of questions.

    Args:
      answers: in total up to each iteration, shape (S, I), never decreasing over iterations.
      values: of the policy after each iteration, shape (S, I).

    Returns:
      n numbers of answers, shape (n,), from the smallest that every trial has a policy for; and at each the value of a
      trial's last policy with no more answers, shape (S, n).
    """
    numbers = np.unique(answers[answers >= answers[:, 0].max()])
    last = (answers[:, :, None] <= numbers).sum(axis=1) - 1
    return numbers, np.take_along_axis(values, last, axis=1)


def _until(length: int, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows, and the last one again for each that is missing."""
    kept = {name: value for name, value in rows[-1].items() if not name.startswith("seconds")}
    return rows + [kept] * (length - len(rows))


def _flat(entry: dict[str, Any]) -> dict[str, Any]:
    inner = {
        f"{name}_{key}": part for name, value in entry.items() if isinstance(value, dict) for key, part in value.items()
    }
    return {name: value for name, value in entry.items() if not isinstance(value, dict)} | inner


def _figures(values: Sequence[Sequence[Any]]) -> np.ndarray | None:
    """Numbers, or lists of numbers of equal length, as one array; None for anything else."""
    flat = [value for row in values for value in row if value is not None]
    lengths = {len(value) if isinstance(value, list) else 0 for value in flat}
    if len(lengths) > 1 or not all(isinstance(value, int | float | list) for value in flat):
        return None
    missing = [np.nan] * length if (length := max(lengths, default=0)) else np.nan
    return np.array([[missing if value is None else value for value in row] for row in values])


def measure_balancing(learner: Learner, directory: Path, *, max_steps: int) -> None:
    """Measure the steps of a learner's final policy before a terminal state, over fresh episodes; in `balancing.json`.

    An episode that reaches `max_steps` counts as that many.
    """
    key = jax.random.key(learner.settings.seed)
    lasted = rollouts.returns(
        learner.environment, learner.policy, key=key, episodes=BALANCING_EPISODES, max_steps=max_steps
    )
    content = {
        "episodes": BALANCING_EPISODES,
        "max_steps": max_steps,
        "mean_steps": float(lasted.steps.mean()),
        "terminated": float(lasted.terminated.mean()),
    }
    write_file(directory / BALANCING_FILE, json.dumps(content, indent=1) + "\n")


def measure_first_policy(learner: Learner, directory: Path) -> None:
    """Measure the value of a learner's first policy, which is random, as an iteration's; in `first-policy.json`."""
    returned = learner.cycle.evaluated(learner.state.first_policy)  # with its noise: without, it is not random
    content = {"episodes": len(returned.total), "value": float(returned.total.mean())}
    write_file(directory / FIRST_POLICY_FILE, json.dumps(content, indent=1) + "\n")


def read_balancing(directory: Path | str) -> dict[str, float]:
    """What `measure_balancing` wrote; `ValueError` where it is missing or damaged."""
    return _figures_in(Path(directory) / BALANCING_FILE, "max_steps", "episodes", "mean_steps")


def read_first_policy(directory: Path | str) -> dict[str, float]:
    """What `measure_first_policy` wrote; `ValueError` where it is missing or damaged."""
    return _figures_in(Path(directory) / FIRST_POLICY_FILE, "value")


def _figures_in(file: Path, *names: str) -> dict[str, float]:
    """The figures of these names in a file; `ValueError` where it has others, or cannot be read."""
    try:
        content = json.loads(file.read_text())
        if not isinstance(content, dict) or not set(names) <= set(content):
            raise ValueError(checks.shortened(content))
        return {name: checks.number(name, content[name]) for name in names}
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{file}: expected {', '.join(names)}, got {checks.reason(error)}") from error


def collect_first_policies(directories: Sequence[Path | str], env: str) -> xr.Dataset:
    """The values of first policies as one data set over (seed, iteration), the iteration being 0."""
    values = [read_first_policy(path)["value"] for path in directories]
    seeds = [int(Path(path).name.rpartition("-")[2]) for path in directories]
    column = np.array(values)[:, None]
    names = {"value": column, "value_newest": column, "answers": np.zeros_like(column, dtype=int)}
    variables = {name: (("seed", "iteration"), entries) for name, entries in names.items()}
    return xr.Dataset(variables, {"seed": seeds, "iteration": [0]}, {"env": env, "utility": "none"})


def write_tables(table: xr.Dataset, directory: Path) -> None:
    """Write `trials.csv`, one row per trial and iteration that it had, and `trials.nc`, each whole or not at all.

    Where a balancing time was measured there are three more columns: the `survival`, and the balancing time of the
    final policy in steps and in seconds, in the row of the last iteration.
    """
    names, had = ["answers", "value", "value_newest"], took_place(table).values.ravel()
    rows = table[names].to_dataframe(["seed", "iteration"]).reset_index()[had]
    rows = rows.astype({"answers": int}).assign(env=table.attrs["env"], utility=table.attrs["utility"])[[*COLUMNS]]
    if "balancing_steps" in table:
        last = ~rows.duplicated("seed", keep="last")
        steps = rows["seed"].map(table["balancing_steps"].to_series())
        rows["survival"] = [f"{share:g}" for share in survival(table).values.ravel()[had]]
        rows["balancing_steps"] = steps.where(last)
        rows["balancing_seconds"] = [round(number * bicycle.STEP_SECONDS, 6) for number in rows["balancing_steps"]]
    write_file(directory / "trials.csv", rows.to_csv(index=False, lineterminator="\r\n"))
    write_netcdf(directory / "trials.nc", table)
