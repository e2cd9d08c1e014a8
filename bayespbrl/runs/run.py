"""A run on disk: start it, resume it, load it."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import xarray as xr

from bayespbrl import checks, rollouts
from bayespbrl.envs.names import check_permission
from bayespbrl.envs.opening import AnyEnvironment, identity, keywords_of, made_again, reopened
from bayespbrl.envs.spaces import check_of_space, spaces_of
from bayespbrl.envs.stepping import step_limit
from bayespbrl.features import StateFeatures
from bayespbrl.improvement.schedules import ConstantBound, Schedule
from bayespbrl.learner import Learner
from bayespbrl.policies import Policy
from bayespbrl.policies.actor import Actor
from bayespbrl.policies.choice import fitting
from bayespbrl.preferences import Preferences
from bayespbrl.queries import QueryRule, highest_utility
from bayespbrl.runs.answers_file import write_answers
from bayespbrl.runs.directory import RunDirectory
from bayespbrl.runs.iteration_files import read_parts
from bayespbrl.runs.stored_classes import classes_of, from_tree, to_tree
from bayespbrl.settings import Settings
from bayespbrl.trajectories import Trajectory
from bayespbrl.utility import UtilityEstimate


def start(
    env: AnyEnvironment,
    directory: Path | str | None = None,
    **options: Any,
) -> Learner:
    """A new learner that keeps its events in a run directory.

    Args:
      env: as in `Learner`.
      directory: must not exist; a fresh one under `runs/` when None.
      **options: as in `Learner`. With `expert="other"` a person answers through code of your own: the learner uses its
        settings for people, infers a side bias, and continues in Python or with `bayespbrl ask`, not with `resume`.
        The expert that the options `expert` and `wrong_answers` name is `expert_of(learner)`.

    Raises:
      ValueError: bad options, or a directory that exists; nothing is left behind then.
    """
    learner = Learner(env, **options)
    if learner.own_policy is not None:  # better now than after the first answers
        from_tree(to_tree(learner.own_policy), known=classes_of(learner.own_policy))
    place = RunDirectory.create_fresh if directory is None else partial(RunDirectory.create, directory)
    return learner.logged(place(learner.settings, _environment_of(learner)))


def resume(
    directory: Path | str,
    *,
    env: AnyEnvironment | None = None,
    features: StateFeatures | None = None,
    policy: Policy | None = None,
    schedule: Schedule | None = None,
    query: QueryRule | None = None,
    import_package: bool = False,
) -> Learner:
    """The learner of a run directory after its last complete event; it keeps further events there.

    Args:
      directory: of a run that was stopped, killed or finished.
      env, features, policy, schedule, query: the objects that the run was started with, where these were your own.
      import_package: whether a package that the environment's name has, as "package:Env-v0", may be imported. The run
        may be a stranger's, and importing runs code.

    Raises:
      ValueError: a package that may not be imported; an environment with other states or actions than the run's, or
        an object in place of a name or the other way round; a directory that is no run or cannot be written, or a file
        in it that is truncated or foreign; a run to which another learner has written since it was read.
    """
    log = _opened(directory, env, import_package)
    learner = _restored(log, env, features=features, policy=policy, schedule=schedule, query=query)
    if env is not None and (how := log.settings.environment) != "other" and reopened(env) != how:
        asked = f"{log.settings.env} by its name" if how == "named" else f"an object of {log.settings.env} as made"
        raise ValueError(f"{log.path}: expected no env=, or {asked}, got {env}, with which it would go on otherwise")
    try:
        log.take_over()
        log.write_summary(learner.state)  # outdated where a process was killed between an event and its summary
    except OSError as error:
        raise ValueError(f"{log.path}: expected a run that can be written to, got {error}") from error
    return learner.logged(log)


def load(
    directory: Path | str,
    *,
    env: AnyEnvironment | None = None,
    features: StateFeatures | None = None,
    policy: Policy | None = None,
    schedule: Schedule | None = None,
    query: QueryRule | None = None,
    import_package: bool = False,
) -> "Run":
    """A run, finished or in progress, read without changing it. Arguments and errors as in `resume`.

    A schedule and a query rule of your own are needed only to continue a run, not to read it.
    """
    log = _opened(directory, env, import_package)
    if log.settings.update.schedule == "other" and schedule is None:
        schedule = ConstantBound()
    if log.settings.questions.query == "other" and query is None:
        query = highest_utility
    return Run(log.path, _restored(log, env, features=features, policy=policy, schedule=schedule, query=query))


def _opened(directory: Path | str, env: AnyEnvironment | None, import_package: bool) -> RunDirectory:
    """The directory of a learner's run whose environment may be opened; `ValueError` for another."""
    log = RunDirectory.open(directory)
    log.check_learner()
    if env is None and not import_package:
        check_permission(log.settings.env, log.path)
    return log


def _environment_of(learner: Learner) -> dict[str, str]:
    """What is known of a learner's environment, in words: its spaces, and how an object of the user's was made."""
    known = spaces_of(learner.given)
    if learner.settings.environment == "other" and (keywords := keywords_of(learner.given)) is not None:
        known["keywords"] = keywords
    return known


def _restored(log: RunDirectory, env: AnyEnvironment | None, **own: Any) -> Learner:
    """The learner rebuilt from the log of a run; `own` holds the user's objects, by option name."""
    settings = log.settings
    options = settings.options()
    for name, given in own.items():
        if given is not None and options[name] != "other":
            raise ValueError(f"{log.path}: expected no {name}=, got {given!r}")
    missing = ["env"] if env is None and settings.environment == "other" else []
    missing += [name for name, given in own.items() if given is None and options[name] == "other"]
    if missing:
        again = ", ".join(f"{name}=" for name in missing)
        raise ValueError(
            f"{log.path}: expected {again} again, which the run was started with, got None (only Python can give it)"
        )
    if settings.environment != "other" and env is not None and identity(env) != identity(settings.env):
        raise ValueError(f"{log.path}: expected no env=, or {settings.env}, which the run was started with, got {env}")
    summarised, policy = log.summarised(), own["policy"]
    entries = log.entries(features=own["features"], known=() if policy is None else classes_of(policy))
    try:
        if env is None:
            env = made_again(settings.env) if settings.environment == "object" else settings.env
        learner = Learner(env, **own, entries=entries, kept=settings)
        for name, own_now in _environment_of(learner).items():
            if log.spaces.get(name, own_now) != own_now:
                raise ValueError(f"env: expected the run's {name}, {log.spaces[name]}, got {own_now}")
        log.check_complete(learner.state, summarised)
        limit = step_limit(learner.environment, settings.rollouts.max_steps)
        for trajectory in learner.trajectories:  # of another environment, where env= is a wrong one
            if len(trajectory) > limit:
                raise ValueError(f"env: expected a time limit of {len(trajectory)} steps or more, got {limit}")
            check_of_space("states of the run", trajectory.states, learner.environment.observation_space)
            check_of_space("actions of the run", trajectory.actions, learner.environment.action_space)
        # of more states or actions than the run's, which those of the trajectories are among
        fitting(learner.last_policy, learner.environment.observation_space, learner.environment.action_space)
        if own["features"] is not None:
            _check_features(learner)
    except ValueError as error:
        raise ValueError(f"{log.path}: {error}") from error
    return learner


def _check_features(learner: Learner) -> None:
    """`ValueError` where the user's features are as many as before, but others; or not as many."""
    estimate, state = learner.estimate, learner.state
    if estimate is None or estimate.features is None:
        return
    estimate.utilities(state.trajectories[0].states[:1])
    if estimate.posterior is None or not estimate.quality.pairs:
        return
    now = estimate.differences([state.compared[number] for number in state.preferences.pairs[0]])[:, 0]
    then = estimate.posterior.children["constant_data"].dataset["differences"].values[:, 0]
    away = float(np.max(np.abs(now - then)) / (np.max(np.abs(then)) or 1.0))
    if not away < 1e-3:  # the same features may be rounded otherwise on another machine
        raise ValueError(
            "features: expected the features of the run, got others: the difference of the first two that were "
            f"compared, in features, is off by {away:.2g} of its largest part"
        )


@dataclass(frozen=True)
class Run:
    """A run as read from disk.

    Attributes:
      path: its directory.
      learner: the learner in its last state; it keeps no events.
    """

    path: Path
    learner: Learner

    @property
    def settings(self) -> Settings:
        """All options of the run."""
        return self.learner.settings

    @property
    def policy(self) -> Actor:
        """The policy that the posterior thinks best of those tried, without its noise.

        Where updates are not checked, as under the paper preset, the newest, with its noise.
        `run.policy.act(observation)` is an action; both are of the environment as it was given.
        """
        return self.learner.actor()

    @property
    def last_policy(self) -> Actor:
        """The newest policy, with its noise."""
        return self.learner.actor(self.learner.last_policy)

    @property
    def preferences(self) -> Preferences:
        """All answers, as ordered pairs and ties."""
        return self.learner.preferences

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """All trajectories, by their numbers."""
        return self.learner.trajectories

    @property
    def iterations(self) -> list[dict[str, Any]]:
        """One summary for each completed iteration, as in `summary.json`."""
        return self.learner.iterations

    @property
    def estimate(self) -> UtilityEstimate | None:
        """The last utility estimate; None before the first."""
        return self.learner.estimate

    @property
    def posterior(self) -> xr.DataTree | None:
        """Posterior draws of the last fit in ArviZ's schema; None where the estimate is no posterior."""
        return None if self.estimate is None else self.estimate.posterior

    def estimate_of(self, iteration: int) -> UtilityEstimate:
        """The utility estimate of a completed iteration, from 1 as in `iterations`, read from its file.

        Raises:
          ValueError: no number of a completed iteration; a file that cannot be read.
        """
        if not self.iterations:
            raise ValueError(f"iteration: expected a run with a completed iteration, got {self.path} without")
        number = checks.whole("iteration", iteration, most=len(self.iterations))
        file, features = RunDirectory.open(self.path).iteration_file(number), self.learner.cycle.feature_source.own
        estimate: UtilityEstimate = read_parts(file, ["estimate"], features=features)["estimate"]
        return estimate

    def estimate_without(self, answerer: str | None) -> UtilityEstimate:
        """The utility inferred without one person's answers; the run is not changed. None is who gave no name.

        Raises:
          ValueError: a name that nobody who answered has.
        """
        state = self.learner.state
        return self.learner.cycle.estimate(replace(state, preferences=state.preferences.without(answerer)))

    def write_answers(self, file: Path | str | None = None) -> Path:
        """Write every answer as one line of a CSV file, `preferences.csv` of the run directory by default."""
        return write_answers(self.path / "preferences.csv" if file is None else file, self.learner.state.past)

    def evaluate(self, episodes: int = 100, seed: int = 0) -> float:
        """Mean undiscounted return of `policy` over fresh episodes."""
        learner = self.learner
        return float(
            rollouts.returns(
                learner.environment,
                learner.policy,
                key=jax.random.key(checks.seed(seed)),
                episodes=episodes,
                max_steps=learner.settings.rollouts.max_steps,
            ).total.mean()
        )

    def report(self, format: str = "html") -> Path:
        """Write the diagnostic report, `report.html` or `report.md`, into the run directory and return its path."""
        from bayespbrl.diagnostics.report import write_report  # here, since few runs need matplotlib's time

        return write_report(self.path, format=format, env=self.learner.environment, features=self.learner.features)
