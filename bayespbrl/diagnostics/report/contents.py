"""The readable contents of a run directory: finished, in progress or damaged.

A file that cannot be read costs only its own contents.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import xarray as xr
from gymnasium.experimental.functional import FuncEnv

from bayespbrl import checks
from bayespbrl.diagnostics.estimates import predicted_answer
from bayespbrl.diagnostics.predictions import fitted_model
from bayespbrl.diagnostics.report.document import ReportWarning
from bayespbrl.diagnostics.report.log import AnsweredQuestion, Summary, read_log
from bayespbrl.envs.names import imported_by_name
from bayespbrl.envs.opening import environment_attribute, open_environment
from bayespbrl.envs.spaces import check_of_space
from bayespbrl.envs.stepping import of_whole_episodes
from bayespbrl.features import StateFeatures, checked_features
from bayespbrl.models import PreferenceModel
from bayespbrl.preferences import PastQuestion, Preferences
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
      answers: in their order, without those taken back; `past` are the same, as the learner keeps them.
      preferences: those that follow from the answers.
      trajectories: by number, those that can be read.
      clips: first step and number of steps of the part of each that questions are about; () where they are about all.
      estimate: the newest utility estimate that can be read, of iteration `estimate_iteration`; None and 0 without any.
      features_missing: why the estimate's φ, a function of the user's, cannot be used; empty where it can.
      environment: opened; None where it cannot be.
      open_question: number of the question that waits for an answer.
      finished_by_log: whether the run is finished; None where `summary.json` holds more iterations than the log.
      damage: one warning for each thing that cannot be read.
    """

    path: Path
    settings: Settings
    iterations: tuple[Summary, ...] = ()
    answers: tuple[AnsweredQuestion, ...] = ()
    past: tuple[PastQuestion, ...] = ()
    preferences: Preferences = field(default_factory=Preferences)
    trajectories: Mapping[int, Trajectory] = field(default_factory=dict)
    clips: tuple[tuple[int, int], ...] = ()
    estimate: UtilityEstimate | None = None
    estimate_iteration: int = 0
    features_missing: str = ""
    environment: gymnasium.Env | None = None
    open_question: int | None = None
    finished_by_log: bool | None = None
    damage: tuple[ReportWarning, ...] = ()

    @property
    def finished(self) -> bool:
        """Whether the run is finished.

        By the summaries alone, an iteration whose questions were all skipped counts as one without a question.
        """
        if self.finished_by_log is not None:
            return self.finished_by_log
        number = len(self.iterations)
        answers = [0, *(summary.get("answers", 0) for summary in self.iterations)]  # none in a damaged summary
        unasked = next((n for n, before in enumerate(reversed(answers[:-1])) if before != answers[-1]), number)
        return self.settings.finished(number, answers[-1], unasked, self.started)

    @property
    def started(self) -> int:
        """Iterations completed when the policy was started anew; 0: it was not."""
        started = self.iterations[-1].get("restarted") if self.iterations else None
        return started if type(started) is int and 0 < started <= len(self.iterations) else 0

    @cached_property
    def compared(self) -> Mapping[int, Trajectory]:
        """The compared trajectories that can be read, or the compared part of each, by number."""
        if not self.clips:
            return self.trajectories
        return {n: one.clip(*self.clips[n]) for n, one in self.trajectories.items() if n < len(self.clips)}

    @property
    def posterior(self) -> xr.DataTree | None:
        """Draws of the posterior; None without one."""
        return None if self.estimate is None else self.estimate.posterior

    @property
    def scored(self) -> list[AnsweredQuestion]:
        """The answers that a posterior predicted: none without an order, and none of the first iteration."""
        return [a for a in self.answers if a.iteration > 1 and a.states_order and np.isfinite(a.predicted)]

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

    @property
    def optimum(self) -> float | None:
        """The return of an optimal policy, where the environment says so."""
        if self.environment is None:
            return None
        optimum = of_whole_episodes(self.environment, "optimal_return", self.settings.rollouts.max_steps)
        return None if optimum is None else float(optimum)

    def environment_attribute(self, name: str) -> Any:
        """`grid_shape` and the like of the environment; None where it has none."""
        return None if self.environment is None else environment_attribute(self.environment, name)


def read_contents(
    directory: Path | str,
    *,
    env: gymnasium.Env | FuncEnv | None = None,
    features: StateFeatures | None = None,
    import_package: bool = False,
) -> RunContents:
    """Read the readable contents of a run directory, and change nothing.

    Args:
      directory: of a run, finished or not, complete or not.
      env, features: the objects that the run was started with, where these were your own.
      import_package: whether the package that the environment's name has may be imported.

    Raises:
      ValueError: a directory that is no run, or one of a newer version.
    """
    run = RunDirectory.open(directory)
    run.check_learner()
    log = read_log(run.path, run.settings)
    contents = RunContents(
        path=run.path,
        settings=run.settings,
        iterations=log.summaries,
        answers=log.answers,
        past=log.state.past,
        preferences=log.state.preferences,
        clips=log.state.clips,
        open_question=None if log.state.query is None else log.state.query.number,
        finished_by_log=log.state.finished(run.settings) if len(log.summaries) <= log.state.iteration else None,
        damage=log.damage,
    )
    contents = _with_environment(contents, env, import_package)
    if features is None and run.settings.features.features == "other":
        features, contents = _not_passed, replace(contents, features_missing="it was not passed again")
    collected = len(log.state.trajectories) // run.settings.rollouts.trajectories_per_iteration
    for number in range(1, max(collected, len(log.summaries)) + 1):
        contents = _with_iteration(contents, number, run.iteration_file(number), features)
    return contents


def _not_passed(states: np.ndarray) -> np.ndarray:
    raise ValueError("features: expected those that the run was started with, got none")


def _with_iteration(contents: RunContents, iteration: int, file: Path, features: StateFeatures | None) -> RunContents:
    """`contents` with what an iteration's file holds, and its answers predicted by the estimate of the one before."""
    parts: dict[str, Any] = {}
    try:
        names = ("trajectories", "estimate") if iteration <= len(contents.iterations) else ("trajectories",)
        parts = _fitting_parts(contents, file, names, features)
    except ValueError as error:
        remedy = "Restore this file from a copy: its contents are missing here, and the run cannot continue."
        contents = _damaged(contents, f"Missing data: iterations/{error}.", remedy)
        with suppress(ValueError):  # only the estimate may be unreadable
            parts = _fitting_parts(contents, file, ("trajectories",), None)
    if not parts:
        return contents
    first = (iteration - 1) * contents.settings.rollouts.trajectories_per_iteration
    trajectories = {**contents.trajectories, **dict(enumerate(parts["trajectories"], start=first))}
    contents = replace(contents, trajectories=trajectories)
    if contents.estimate_iteration == iteration - 1:
        answers = (_predicted(contents, a) if a.iteration == iteration else a for a in contents.answers)
        contents = replace(contents, answers=tuple(answers))
    if "estimate" in parts:
        contents = replace(contents, estimate=parts["estimate"], estimate_iteration=iteration)
        missing = contents.features_missing or _features_failure(parts["estimate"], features, parts["trajectories"][0])
        contents = replace(contents, features_missing=missing)
    return contents


def _fitting_parts(
    contents: RunContents, file: Path, names: tuple[str, ...], features: StateFeatures | None
) -> dict[str, Any]:
    """Parts of an iteration's file, where they fit the run; `ValueError` with the file's name otherwise."""
    parts = read_parts(file, names, features=features)
    try:
        _check_fitting(contents, parts, features)
    except ValueError as error:
        raise ValueError(f"{file.name}: {error}") from error
    return parts


def _check_fitting(contents: RunContents, parts: Mapping[str, Any], features: StateFeatures | None) -> None:
    """Check that trajectories are of the run's environment, and that the estimate applies to them.

    Raises:
      ValueError: they are not; the file may be a stranger's, or damaged.
    """
    trajectories = parts["trajectories"]
    number = contents.settings.rollouts.trajectories_per_iteration
    if len(trajectories) != number:
        raise ValueError(f"expected {number} trajectories, got {len(trajectories)}")
    if contents.environment is not None:
        for trajectory in trajectories:
            check_of_space("states", trajectory.states, contents.environment.observation_space)
            check_of_space("actions", trajectory.actions, contents.environment.action_space)
    if (estimate := parts.get("estimate")) is None or contents.features_missing:
        return
    if _features_failure(estimate, features, trajectories[0]):
        return  # said of the features, not of the file
    try:
        estimate.trajectory_utilities(trajectories[:1])
        if estimate.posterior is not None:
            estimate.trajectory_draws(trajectories[:1], number=2)
    except Exception as error:  # of damaged arrays, anything
        raise ValueError(
            f"expected an estimate that fits, got {type(error).__name__}: {checks.one_line(error)}"
        ) from error


def _features_failure(estimate: UtilityEstimate, features: StateFeatures | None, trajectory: Trajectory) -> str:
    """The reason why the passed features cannot be used; empty if they can."""
    if features is None or estimate.features is None:
        return ""
    try:
        width = checked_features(features, trajectory.states).shape[1]
    except Exception as error:  # a function of the user's may raise anything
        return f"the one that was passed fails ({type(error).__name__}: {checks.one_line(error)})"
    expected = estimate.number_of_features
    return "" if width == expected else f"the one that was passed has {width} features, the run's {expected}"


def _predicted(contents: RunContents, answer: AnsweredQuestion) -> AnsweredQuestion:
    both = [contents.compared[n] for n in (answer.first, answer.second) if n in contents.compared]
    if contents.without_posterior or len(both) < 2:
        return answer
    if contents.estimate is None:
        return replace(answer, predicted=0.5)  # without any answer, either is equally probable
    if contents.posterior is None or contents.features_missing:
        return answer
    predicted, stated = predicted_answer(contents.estimate, *both, answerer=answer.answerer or "")
    return replace(answer, predicted=predicted, stated=stated)


def _damaged(contents: RunContents, what: str, remedy: str) -> RunContents:
    return replace(contents, damage=(*contents.damage, ReportWarning(what, remedy)))


def _with_environment(contents: RunContents, env: gymnasium.Env | FuncEnv | None, import_package: bool) -> RunContents:
    settings = contents.settings
    try:
        if env is None and settings.environment == "other":
            raise ValueError(f"expected your own environment {settings.env} as env= of bayespbrl.load, got none")
        if env is None and not import_package and (package := imported_by_name(settings.env)):
            raise ValueError(
                f"expected permission to import {package!r} (import_package or --import-package), got none"
            )
        return replace(contents, environment=open_environment(settings.env if env is None else env))
    except ValueError as error:
        what = f"The environment cannot be opened ({error}). What needs it is missing here."
        remedy = "Register it first, or call bayespbrl.load(directory, env=...).report() with the object."
        return _damaged(contents, what, remedy)
