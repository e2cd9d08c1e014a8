"""What can be read of a run directory, whether the run is finished, in progress or damaged.

A file that cannot be read costs only its own contents.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import xarray as xr
from gymnasium.experimental.functional import FuncEnv

from bayespbrl.diagnostics.estimates import first_preferred_probability, of_states, one_setting, sampled
from bayespbrl.diagnostics.predictions import fitted_model
from bayespbrl.diagnostics.report.document import ReportWarning
from bayespbrl.diagnostics.report.log import AnsweredQuestion, Summary, read_log
from bayespbrl.envs.opening import environment_attribute, open_environment
from bayespbrl.features import StateFeatures, checked_features
from bayespbrl.models import PreferenceModel
from bayespbrl.preferences import Preferences
from bayespbrl.runs.directory import RunDirectory
from bayespbrl.runs.iteration_files import read_parts
from bayespbrl.settings import Settings
from bayespbrl.trajectories import Trajectory
from bayespbrl.utility import UtilityEstimate
from bayespbrl.utility.inference import WITHOUT_POSTERIOR


@dataclass(frozen=True)
class RunContents:
    """The readable contents of a run directory.

    Attributes:
      path, settings: of the run.
      iterations: summaries of the completed iterations.
      answers: in their order, without those taken back.
      preferences: those that follow from the answers.
      trajectories: by number, those that can be read.
      estimate: the newest utility estimate that can be read, of iteration `estimate_iteration`; None and 0 without any.
      features_missing: why the estimate's φ, a function of the user's, cannot be used; empty where it can.
      environment: opened; None where it cannot be.
      open_question: number of the question that waits for an answer.
      damage: one warning for each thing that cannot be read.
    """

    path: Path
    settings: Settings
    iterations: tuple[Summary, ...] = ()
    answers: tuple[AnsweredQuestion, ...] = ()
    preferences: Preferences = field(default_factory=Preferences)
    trajectories: Mapping[int, Trajectory] = field(default_factory=dict)
    estimate: UtilityEstimate | None = None
    estimate_iteration: int = 0
    features_missing: str = ""
    environment: gymnasium.Env | None = None
    open_question: int | None = None
    damage: tuple[ReportWarning, ...] = ()

    @property
    def finished(self) -> bool:
        """Whether all iterations are completed."""
        return len(self.iterations) >= self.settings.iterations

    @property
    def posterior(self) -> xr.DataTree | None:
        """Draws of the sampled posterior; None without one."""
        fit = sampled(self.estimate)
        return None if fit is None else fit.posterior

    @property
    def without_posterior(self) -> bool:
        """Whether the run's estimation method has no posterior."""
        return self.settings.estimation.utility in WITHOUT_POSTERIOR

    @property
    def posterior_missing(self) -> str:
        """Why there is no posterior, as a sentence."""
        if self.without_posterior:
            return f"The estimation method {self.settings.estimation.utility} has no posterior: no uncertainty to show."
        return "No posterior can be read." if self.iterations else "No posterior yet."

    @property
    def model(self) -> PreferenceModel:
        """Prior and likelihood of the last fit, or of the settings without one."""
        return self.settings.model if self.posterior is None else fitted_model(self.posterior)

    def environment_attribute(self, name: str) -> Any:
        """`optimal_return` and the like of the environment; None where it has none."""
        return None if self.environment is None else environment_attribute(self.environment, name)


def read_contents(
    directory: Path | str, *, env: gymnasium.Env | FuncEnv | None = None, features: StateFeatures | None = None
) -> RunContents:
    """Read all that can be read of a run directory, and change nothing.

    Args:
      directory: of a run, finished or not, complete or not.
      env, features: the objects that the run was started with, where these were your own.

    Raises:
      ValueError: a directory that is no run, or one of a newer version.
    """
    run = RunDirectory.open(directory)
    log = read_log(run.path, run.settings)
    damage, answers = list(log.damage), list(log.answers)
    environment = _environment(run.settings, env, damage)
    reader = _IterationReader(run, features, damage)
    for number in range(1, max(log.collected, len(log.summaries)) + 1):
        answers = reader.read(number, answers, improved=number <= len(log.summaries))
    return RunContents(
        path=run.path,
        settings=run.settings,
        iterations=log.summaries,
        answers=tuple(answers),
        preferences=log.state.preferences,
        trajectories=reader.trajectories,
        estimate=reader.estimate,
        estimate_iteration=reader.estimate_iteration,
        features_missing=reader.features_missing,
        environment=environment,
        open_question=None if log.state.query is None else log.state.query.number,
        damage=tuple(damage),
    )


def _not_passed(states: np.ndarray) -> np.ndarray:
    raise ValueError("features: expected those that the run was started with, got none")


class _IterationReader:
    """Reads the iteration files in turn, and predicts the answers of each by the estimate of the one before."""

    def __init__(self, run: RunDirectory, features: StateFeatures | None, damage: list[ReportWarning]) -> None:
        self.run, self.damage, self.features, self.features_missing = run, damage, features, ""
        if features is None and run.settings.features.features == "other":
            self.features, self.features_missing = _not_passed, "it was not passed again"
        self.trajectories: dict[int, Trajectory] = {}
        self.estimate: UtilityEstimate | None = None
        self.estimate_iteration = 0

    def read(self, iteration: int, answers: Sequence[AnsweredQuestion], *, improved: bool) -> list[AnsweredQuestion]:
        """`answers` with the predictions of those of this iteration."""
        parts = self._parts(iteration, ("trajectories", "estimate") if improved else ("trajectories",))
        if not parts:
            return list(answers)
        first = (iteration - 1) * self.run.settings.rollouts.trajectories_per_iteration
        self.trajectories |= dict(enumerate(parts["trajectories"], start=first))
        if self.estimate_iteration == iteration - 1:
            answers = [self._predicted(answer) if answer.iteration == iteration else answer for answer in answers]
        if "estimate" in parts:
            self.estimate, self.estimate_iteration = parts["estimate"], iteration
            self.features_missing = self.features_missing or self._features_failure(parts["trajectories"][0])
        return list(answers)

    def _parts(self, iteration: int, names: tuple[str, ...]) -> dict[str, Any]:
        file = self.run.iteration_file(iteration)
        try:
            return read_parts(file, names, features=self.features)
        except ValueError as error:
            remedy = "Restore this file from a copy: its contents are missing here, and the run cannot continue."
            self.damage.append(ReportWarning(f"Missing data: iterations/{error}.", remedy))
        with suppress(ValueError):  # only the estimate may be unreadable
            return read_parts(file, ("trajectories",))
        return {}

    def _features_failure(self, trajectory: Trajectory) -> str:
        """What is wrong with features that were passed; empty if nothing."""
        if self.features is None or not of_states(self.estimate):
            return ""
        try:
            width = checked_features(self.features, trajectory.states).shape[1]
        except Exception as error:  # a function of the user's may raise anything
            return f"the one that was passed fails ({type(error).__name__}: {' '.join(str(error).split())})"
        expected = len(one_setting(self.estimate).weights)
        return "" if width == expected else f"the one that was passed has {width} features, the run's {expected}"

    def _predicted(self, answer: AnsweredQuestion) -> AnsweredQuestion:
        numbers = (answer.first, answer.second)
        both = [self.trajectories[number] for number in numbers if number in self.trajectories]
        if self.run.settings.estimation.utility in WITHOUT_POSTERIOR or len(both) < 2:
            return answer
        if self.estimate is None:
            return replace(answer, predicted=0.5)  # without any answer, either is equally probable
        if sampled(self.estimate) is None or self.features_missing:
            return answer
        return replace(answer, predicted=first_preferred_probability(self.estimate, *both))


def _environment(
    settings: Settings, env: gymnasium.Env | FuncEnv | None, damage: list[ReportWarning]
) -> gymnasium.Env | None:
    try:
        if env is None and settings.environment == "other":
            raise ValueError(f"{settings.env} is an object of your own: pass it to bayespbrl.load as env=")
        return open_environment(settings.env if env is None else env)
    except ValueError as error:
        what = f"The environment cannot be opened ({error}). What needs it is missing here."
        remedy = "Register it first, or call bayespbrl.load(directory, env=...).report() with the object."
        damage.append(ReportWarning(what, remedy))
        return None
