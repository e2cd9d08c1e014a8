"""A run that is kept on disk: start it, resume it, load it."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import xarray as xr

from bayespbrl import rollouts
from bayespbrl.envs.opening import from_plain, to_plain
from bayespbrl.improvement.schedules import ConstantBound
from bayespbrl.learner import Learner
from bayespbrl.policies.actor import Actor
from bayespbrl.preferences import Preferences
from bayespbrl.runs.directory import RunDirectory, fresh_directory
from bayespbrl.settings import Settings
from bayespbrl.trajectories import Trajectory


def start(
    env: Any,
    directory: Path | str | None = None,
    *,
    features: Any = None,
    policy: Any = None,
    schedule: Any = None,
    **settings: Any,
) -> Learner:
    """A new learner that keeps everything it does in a run directory.

    Args:
      env: as of `Learner`.
      directory: must not exist; a fresh one under `runs/` when None.
      features, policy, schedule, **settings: as of `Learner`. `expert="other"` says that neither the simulated expert
        nor a person at a terminal answers, so that `bayespbrl resume` does not let one of them go on.

    Raises:
      ValueError: bad options, or a directory that exists; nothing is left behind then.
    """
    learner = Learner(env, features=features, policy=policy, schedule=schedule, **settings)
    log = RunDirectory.create(
        fresh_directory(learner.settings.env) if directory is None else directory, learner.settings
    )
    return learner.logged(log)


def resume(
    directory: Path | str, *, env: Any = None, features: Any = None, policy: Any = None, schedule: Any = None
) -> Learner:
    """The learner of a run directory as it was after its last complete event; it goes on writing there.

    Args:
      directory: a run directory, of a run that was stopped, killed or finished.
      env, features, policy, schedule: what the run was started with, where these were objects of the user's.

    Raises:
      ValueError: a directory that is no run, or a file in it that is truncated or foreign.
    """
    log = RunDirectory.open(directory)
    learner = _restored(log, env, features, policy, schedule)
    log.drop_partial_line()
    log.write_summary(learner.state)  # a process killed between an event and its summary left an old one
    return learner.logged(log)


def load(
    directory: Path | str, *, env: Any = None, features: Any = None, policy: Any = None, schedule: Any = None
) -> "Run":
    """Read a run, finished or in progress, without changing it. Arguments and errors as of `resume`.

    A schedule of the user's own is only needed to go on, not to read.
    """
    log = RunDirectory.open(directory)
    if log.settings.schedule == "other" and schedule is None:
        schedule = ConstantBound()
    return Run(log.path, _restored(log, env, features, policy, schedule))


def _restored(log: "RunDirectory", env: Any, features: Any, policy: Any, schedule: Any) -> Learner:
    settings = log.settings
    for part, own, given in (
        ("features", settings.features, features),
        ("policy", settings.policy, policy),
        ("schedule", settings.schedule, schedule),
    ):
        if (own == "other") != (given is not None):
            had, expected = ("with", "it again as") if own == "other" else ("without", "no")
            raise ValueError(f"{log.path}: a run {had} {part} of the user's own: expected {expected} {part}=")
    if settings.environment == "other" and env is None:
        raise ValueError(f"{log.path}: a run with an environment of the user's own: expected it again as env=")
    summarised = log.summarised()
    try:
        learner = Learner(
            settings.env if env is None else env,
            features=features,
            policy=policy,
            schedule=schedule,
            entries=log.entries(features=features, known=() if policy is None else (type(policy),)),
            kept=settings,
        )
        log.check_complete(learner.state, summarised)
    except ValueError as error:
        raise ValueError(f"{log.path}: {error}") from error
    return learner


@dataclass(frozen=True)
class Run:
    """A run as read from disk.

    Attributes:
      path: its directory.
      learner: the learner in its last state, detached from the directory.
    """

    path: Path
    learner: Learner

    @property
    def settings(self) -> Settings:
        return self.learner.settings

    @property
    def policy(self) -> Actor:
        """The last policy: `run.policy.act(observation)` is an action for the environment, as it was given."""
        environment, given = self.learner.environment, self.learner.given
        return Actor(
            self.learner.policy,
            environment.action_space,
            np.random.default_rng(),
            observe=partial(to_plain, given.observation_space),
            enact=partial(from_plain, given.action_space),
        )

    @property
    def preferences(self) -> Preferences:
        return self.learner.preferences

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        return self.learner.trajectories

    @property
    def iterations(self) -> list[dict[str, Any]]:
        """One summary for each completed iteration, as in `summary.json`."""
        return self.learner.iterations

    @property
    def estimate(self) -> Any:
        """The last utility estimate; None before the first."""
        return self.learner.estimate

    @property
    def posterior(self) -> xr.DataTree | None:
        """Draws of the last fit in ArviZ's schema; None where the utility is no posterior."""
        return getattr(self.estimate, "posterior", None)

    def evaluate(self, episodes: int = 100, seed: int = 0) -> float:
        """Mean undiscounted return of fresh episodes under the last, stochastic policy."""
        learner = self.learner
        return float(
            rollouts.returns(
                learner.environment,
                learner.policy,
                key=jax.random.key(seed),
                episodes=episodes,
                max_steps=learner.settings.max_steps,
            ).total.mean()
        )

    def report(self, format: str = "html") -> Path:
        """Write the diagnostic report into the run directory, as `report.html` or `report.md`, and return its path."""
        from bayespbrl.diagnostics.report import write_report  # stands above this module, and reads with it

        return write_report(self.path, format=format, env=self.learner.environment, features=self.learner.features)
