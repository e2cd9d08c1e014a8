"""What can be read of a run directory, finished, in progress or broken: the evidence that the report is made of.

A file that cannot be read costs what is in it and nothing more.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from bayespbrl.diagnostics.predictions import PREFERRED, answer_probabilities
from bayespbrl.diagnostics.report.log import AnswerRecord, read_log
from bayespbrl.envs.opening import open_environment
from bayespbrl.features import checked_features
from bayespbrl.models.likelihoods import prob
from bayespbrl.preferences import Preferences
from bayespbrl.runs.directory import RunDirectory
from bayespbrl.runs.iteration_files import read_parts
from bayespbrl.settings import WITHOUT_POSTERIOR, Settings
from bayespbrl.trajectories import Trajectory, trajectory_features
from bayespbrl.utility.averaging import AveragedUtility


@dataclass(frozen=True)
class Evidence:
    """What a run left behind.

    Attributes:
      path, settings: of the run.
      iterations: summaries of the completed iterations.
      answers: in their order, those taken back left out.
      preferences: what follows from them.
      trajectories: by number, those that can be read.
      estimate: the newest utility estimate that can be read, which is that after iteration `estimate_iteration`; None
        and 0 without any.
      features_missing: why the estimate's φ, a function of the user's, cannot be used; empty where it can.
      environment: opened; None where it cannot be.
      waiting: the number of the question that waits for an answer.
      broken: what could not be read, a sentence each.
    """

    path: Path
    settings: Settings
    iterations: tuple[Mapping[str, Any], ...] = ()
    answers: tuple[AnswerRecord, ...] = ()
    preferences: Preferences = field(default_factory=Preferences)
    trajectories: Mapping[int, Trajectory] = field(default_factory=dict)
    estimate: Any = None
    estimate_iteration: int = 0
    features_missing: str = ""
    environment: Any = None
    waiting: int | None = None
    broken: tuple[str, ...] = ()

    @property
    def finished(self) -> bool:
        return len(self.iterations) >= self.settings.iterations

    @property
    def posterior(self) -> xr.DataTree | None:
        """Draws of the estimate; None where it is no posterior."""
        return getattr(self.estimate, "posterior", None)

    def fitted_with(self, name: str) -> float:
        """`prior_scale`, `steepness` or `lapse_rate` of the last fit, by evidence perhaps; else by settings."""
        posterior = self.posterior
        return float(getattr(self.settings, name) if posterior is None else posterior.attrs[name])

    @property
    def dynamics(self) -> Any:
        """The environment's pure functions, where it has some."""
        return getattr(getattr(self.environment, "unwrapped", None), "dynamics", None)


def read_evidence(directory: Path | str, *, env: Any = None, features: Any = None) -> Evidence:
    """Read all that can be read of a run directory, and change nothing.

    Args:
      directory: of a run, finished or not, whole or not.
      env, features: what the run was started with, where these were objects of the user's.

    Raises:
      ValueError: a directory that is no run, or one of a newer version.
    """
    run = RunDirectory.open(directory)
    log = read_log(run.path, run.settings)
    broken, records = list(log.broken), list(log.answers)
    environment = _environment(run.settings, env, broken)
    reader = _Reader(run, features, broken)
    for number in range(1, max(log.collected, len(log.summaries)) + 1):
        records = reader.read(number, records, improved=number <= len(log.summaries))
    return Evidence(
        path=run.path,
        settings=run.settings,
        iterations=log.summaries,
        answers=tuple(records),
        preferences=log.state.preferences,
        trajectories=reader.trajectories,
        estimate=reader.estimate,
        estimate_iteration=reader.estimate_iteration,
        features_missing=reader.features_missing,
        environment=environment,
        waiting=None if log.state.query is None else log.state.query.number,
        broken=tuple(broken),
    )


def _not_passed(states: np.ndarray) -> np.ndarray:
    raise ValueError("features: expected those that the run was started with, got none")


class _Reader:
    """Reads one iteration's file after the other, and predicts its answers by the estimate from before them."""

    def __init__(self, run: RunDirectory, features: Callable[[np.ndarray], np.ndarray] | None, broken: list[str]):
        self.run, self.broken, self.features, self.features_missing = run, broken, features, ""
        if features is None and run.settings.features == "other":
            self.features, self.features_missing = _not_passed, "it was not passed again"
        self.trajectories: dict[int, Trajectory] = {}
        self.estimate: Any = None
        self.estimate_iteration = 0

    def read(self, number: int, records: list[AnswerRecord], *, improved: bool) -> list[AnswerRecord]:
        """`records` with the predictions of the answers of iteration `number`."""
        file = self.run.iteration_file(number)
        parts: dict[str, Any] = {}
        try:
            parts = read_parts(
                file, ("trajectories", "estimate") if improved else ("trajectories",), features=self.features
            )
        except ValueError as error:
            self.broken.append(f"iterations/{error}.")
            with suppress(ValueError):  # it may be only the estimate that cannot be read
                parts = read_parts(file, ("trajectories",))
        if not parts:
            return records
        first = (number - 1) * self.run.settings.trajectories_per_iteration
        self.trajectories |= dict(enumerate(parts["trajectories"], start=first))
        if self.estimate_iteration == number - 1:
            records = [self._predicted(record) if record.iteration == number else record for record in records]
        if "estimate" in parts:
            self.estimate, self.estimate_iteration = parts["estimate"], number
            self.features_missing = self.features_missing or self._failure(parts["trajectories"][0])
        return records

    def _failure(self, trajectory: Trajectory) -> str:
        """What is wrong with features that were passed."""
        if self.features is None or not hasattr(self.estimate, "weights"):
            return ""
        try:
            number = checked_features(self.features, trajectory.states).shape[1]
        except Exception as error:  # a function of the user's may raise anything
            return f"the one that was passed fails ({type(error).__name__}: {' '.join(str(error).split())})"
        expected = len(self.estimate.weights)
        return "" if number == expected else f"the one that was passed has {number} features, the run's {expected}"

    def _predicted(self, record: AnswerRecord) -> AnswerRecord:
        numbers = (record.first, record.second)
        both = [self.trajectories[number] for number in numbers if number in self.trajectories]
        if self.run.settings.utility in WITHOUT_POSTERIOR or len(both) < 2:
            return record
        if self.estimate is None:
            probability = 0.5  # before any answer, the prior says nothing of which is better
        elif getattr(self.estimate, "posterior", None) is None or self.features_missing:
            return record
        elif isinstance(self.estimate, AveragedUtility):
            margins = self.estimate.margin_draws(*both)
            probability = float(prob(self.estimate.likelihood, margins).mean())
        else:
            sums = trajectory_features(both, self.estimate.features, discount=self.estimate.discount)
            difference = (sums[[0]] - sums[[1]]) / self.estimate.scale
            probability = float(answer_probabilities(self.estimate.posterior, difference)[0, PREFERRED])
        return AnswerRecord(**{**vars(record), "predicted": probability})


def _environment(settings: Settings, env: Any, broken: list[str]) -> Any:
    try:
        if env is None and settings.environment == "other":
            raise ValueError(f"{settings.env} was an object of the user's, and is passed to bayespbrl.load as env=")
        return open_environment(settings.env if env is None else env)
    except ValueError as error:
        broken.append(f"The environment cannot be opened ({error}): what needs it is left out.")
        return None
