"""A run on disk, and back: settings, an append-only log of events, one netCDF file an iteration, a summary.

settings.json         what the run was asked to do; the directory appears with it in one step
events.jsonl          every question and every answer, flushed before the learner moves on
iterations/0001.nc    trajectories, policy, utility estimate and posterior, renamed into place
summary.json          one object for each completed iteration
"""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np
import xarray as xr

from bayespbrl import records, rollouts
from bayespbrl.cycle import Learner
from bayespbrl.events import Entry, LearnerState, surviving
from bayespbrl.models import restored, stored
from bayespbrl.policies.actor import Actor
from bayespbrl.preferences import Preferences
from bayespbrl.schedules import ConstantBound
from bayespbrl.settings import Settings
from bayespbrl.trajectories import Trajectory
from bayespbrl.utility import LinearUtility

FORMAT = 1
POSTERIOR_GROUPS = ("posterior", "sample_stats", "log_likelihood", "observed_data", "constant_data")
ENGINE: Any = "h5netcdf"
PARTS = {"collected": ("trajectories",), "improved": ("trajectories", "policy", "estimate")}


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
      features, policy, schedule, **settings: as of `Learner`.

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
    settings = asdict(log.settings)
    name, kind = settings.pop("env"), settings.pop("policy")
    bounds = settings.pop("schedule")
    for part, own, given in (
        ("features", settings.pop("features"), features),
        ("policy", kind, policy),
        ("schedule", bounds, schedule),
    ):
        if (own == "other") != (given is not None):
            had, expected = ("with", "it again as") if own == "other" else ("without", "no")
            raise ValueError(f"{log.path}: a run {had} {part} of the user's own: expected {expected} {part}=")
    try:
        return Learner(
            name if env is None else env,
            features=features,
            policy=kind if policy is None else policy,
            schedule=bounds if schedule is None else schedule,
            entries=log.entries(features=features, known=() if policy is None else (type(policy),)),
            **settings,
        )
    except ValueError as error:
        raise ValueError(f"{log.path}: {error}") from error


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
        """The last policy: `run.policy.act(observation)` is an action for the environment."""
        return Actor(self.learner.policy, self.learner.environment.action_space, np.random.default_rng())

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


class RunDirectory:
    """The log of a run (see the module's first lines). Made by `create` or `open`."""

    def __init__(self, path: Path, settings: Settings):
        self.path = path
        self.settings = settings

    @classmethod
    def create(cls, path: Path | str, settings: Settings) -> "RunDirectory":
        """A new run directory, which appears at once with its settings in it.

        Raises:
          ValueError: the path exists, or cannot be written.
        """
        path = Path(path)
        if path.exists() or path.is_symlink():
            raise ValueError(f"{path}: expected a run directory that does not exist yet, got an existing one")
        content = {"format": FORMAT, "version": version("bayespbrl"), **asdict(settings)}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            building = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
            try:
                building.chmod(0o755)
                _write(building / "settings.json", json.dumps(content, indent=2) + "\n")
                (building / "iterations").mkdir()
                building.rename(path)
            except OSError:
                shutil.rmtree(building, ignore_errors=True)
                raise
        except OSError as error:
            raise ValueError(f"{path}: cannot make a run directory there ({error})") from error
        return cls(path, settings)

    @classmethod
    def open(cls, path: Path | str) -> "RunDirectory":
        """The run directory at `path`; `ValueError` if it is none or of a newer format."""
        path = Path(path)
        file = path / "settings.json"
        try:
            content = json.loads(file.read_text())
        except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise ValueError(f"{path}: expected a run directory with its settings.json, got {error}") from error
        if not isinstance(content, dict) or not isinstance(content.get("format"), int):
            raise ValueError(f"{file}: expected the settings of a run, got a foreign file")
        if content["format"] > FORMAT:
            raise ValueError(f"{file}: expected format {FORMAT} or older, got {content['format']} of a newer version")
        names = {field.name for field in fields(Settings)}
        try:
            return cls(path, Settings(**{name: value for name, value in content.items() if name in names}))
        except (TypeError, ValueError) as error:
            raise ValueError(f"{file}: {error}") from error

    def append(self, entry: Entry, state: LearnerState) -> None:
        """Keep one event: first its heavy parts, then its line, flushed to the disk."""
        if entry.parts:
            write_iteration(self.iteration_file(entry.event["iteration"]), entry)
        line = (json.dumps(dict(entry.event), allow_nan=False) + "\n").encode()
        with (self.path / "events.jsonl").open("ab", buffering=0) as file:
            before = file.tell()
            try:
                if file.write(line) != len(line):
                    raise OSError(f"{file.name}: the line was not written whole")
                os.fsync(file.fileno())
                if entry.event["event"] in ("improved", "undone"):
                    self.write_summary(state)
            except BaseException:  # a full disk or Ctrl-C: the learner will not have moved on either
                file.truncate(before)
                raise

    def finished(self) -> bool:
        """Whether the run has completed all its iterations, by its summary."""
        return (self.path / "summary.json").exists() and bool(read_summary(self.path)["finished"])

    def entries(self, *, features: Any = None, known: Sequence[type] = ()) -> Iterator[Entry]:
        """The events so far, what was undone left out, with their heavy parts; neither is a last line cut off."""
        for event in surviving(self._events()):
            parts = {}
            if event["event"] in ("collected", "improved"):
                parts = read_iteration(
                    self.iteration_file(event["iteration"]), event["event"], features=features, known=known
                )
            yield Entry(event, parts)

    def _events(self) -> Iterator[dict[str, Any]]:
        for number, line in enumerate(self._complete_lines(), start=1):
            try:
                event = json.loads(line)
            except ValueError:
                event = None
            heavy = isinstance(event, dict) and event.get("event") in ("collected", "improved")
            if (
                not isinstance(event, dict)
                or "event" not in event
                or (heavy and type(event.get("iteration")) is not int)
            ):
                raise ValueError(f"events.jsonl, line {number}: expected an event, got {line[:60]!r}")
            yield event

    def drop_partial_line(self) -> None:
        """Cut off a last line that a killed process left half-written, so that the next event starts a new one."""
        file = self.path / "events.jsonl"
        if file.exists():
            whole = file.read_bytes()
            complete = whole[: whole.rfind(b"\n") + 1]
            if complete != whole:
                os.truncate(file, len(complete))

    def _complete_lines(self) -> list[str]:
        file = self.path / "events.jsonl"
        if not file.exists():
            return []
        try:
            return file.read_text(encoding="utf-8").split("\n")[:-1]
        except UnicodeDecodeError as error:
            raise ValueError(f"events.jsonl: expected lines of JSON, got {error}") from error

    def iteration_file(self, number: int) -> Path:
        """Where the heavy parts of an iteration are kept."""
        return self.path / "iterations" / f"{number:04d}.nc"

    def write_summary(self, state: LearnerState) -> None:
        """Write `summary.json` anew."""
        summary = {
            "env": self.settings.env,
            "utility": self.settings.utility,
            "seed": self.settings.seed,
            "finished": state.iteration >= self.settings.iterations,
            "answers": state.preferences.answers,
            "iterations": list(state.summaries),
        }
        _write(self.path / "summary.json", json.dumps(summary, indent=1) + "\n")


def read_summary(directory: Path | str) -> dict[str, Any]:
    """`summary.json` of a run; `ValueError` if it is missing, truncated or foreign."""
    file = Path(directory) / "summary.json"
    try:
        summary = json.loads(file.read_text())
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{file}: expected the summary of a run, got {error}") from error
    if not isinstance(summary, dict) or not {"seed", "finished", "iterations"} <= set(summary):
        raise ValueError(f"{file}: expected the summary of a run, got a foreign file")
    return summary


def fresh_directory(env: str) -> Path:
    """A path under `runs/` that does not exist yet, named by environment and time."""
    stem = f"{env.replace('/', '-').lower()}-{datetime.now().strftime('%Y%m%d-%H%M%S')}"
    path, count = Path("runs") / stem, 1
    while path.exists():
        count += 1
        path = Path("runs") / f"{stem}-{count}"
    return path


def write_iteration(file: Path, entry: Entry) -> None:
    """The heavy parts of one iteration as one netCDF file, written aside and renamed into place."""
    parts = entry.parts
    groups = {"trajectories": xr.DataTree(_trajectories_dataset(parts["trajectories"]))}
    if "policy" in parts:
        groups["policy"] = records.to_tree(parts["policy"])
        groups |= _estimate_groups(parts["estimate"])
    aside = file.with_suffix(".nc.part")
    aside.unlink(missing_ok=True)  # HDF5 refuses a file that an interrupted write left open
    xr.DataTree.from_dict(groups).to_netcdf(aside, engine=ENGINE)
    with aside.open("rb") as written:
        os.fsync(written.fileno())
    aside.replace(file)


def read_iteration(file: Path, event: str, *, features: Any = None, known: Sequence[type] = ()) -> dict[str, Any]:
    """The parts that `event`, `collected` or `improved`, brought; `ValueError` for a truncated or foreign file."""
    return read_parts(file, PARTS[event], features=features, known=known)


def read_parts(file: Path, names: Sequence[str], *, features: Any = None, known: Sequence[type] = ()) -> dict[str, Any]:
    """Some of the `trajectories`, `policy` and `estimate` of an iteration; errors as of `read_iteration`."""
    read = {
        "trajectories": lambda tree: _read_trajectories(tree.children["trajectories"].to_dataset()),
        "policy": lambda tree: records.from_tree(tree.children["policy"], known=known),
        "estimate": lambda tree: _read_estimate(tree, features, known),
    }
    try:
        with xr.open_datatree(file, engine=ENGINE) as opened:
            tree = opened.load()
        parts = {name: read[name](tree) for name in names}
    except (OSError, KeyError, RuntimeError, AttributeError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{file.name}: expected the netCDF file of an iteration, got {reason}") from error
    return parts


def _trajectories_dataset(trajectories: Sequence[Trajectory]) -> xr.Dataset:
    """Trajectories side by side, filled up with zeros to the longest."""
    lengths = np.array([len(trajectory) for trajectory in trajectories])

    def filled(arrays: list[np.ndarray], extra: int) -> np.ndarray:
        block = np.zeros((len(arrays), lengths.max() + extra, *arrays[0].shape[1:]), dtype=arrays[0].dtype)
        for row, array in zip(block, arrays, strict=True):
            row[: len(array)] = array
        return block

    states = filled([t.states for t in trajectories], 1)
    actions = filled([t.actions for t in trajectories], 0)
    return xr.Dataset(
        {
            "states": (("trajectory", "time", "observation")[: states.ndim], states),
            "actions": (("trajectory", "step", "action")[: actions.ndim], actions),
            "rewards": (("trajectory", "step"), filled([t.rewards for t in trajectories], 0)),
            "length": ("trajectory", lengths),
            "terminated": ("trajectory", np.array([t.terminated for t in trajectories])),
        }
    )


def _read_trajectories(data: xr.Dataset) -> tuple[Trajectory, ...]:
    states, actions, rewards = data["states"].values, data["actions"].values, data["rewards"].values
    return tuple(
        Trajectory(
            states[i, : length + 1], actions[i, :length], rewards[i, :length], bool(data["terminated"].values[i])
        )
        for i, length in enumerate(data["length"].values)
    )


def _estimate_groups(estimate: Any) -> dict[str, xr.DataTree]:
    """An estimate as groups: its own, and those of its posterior in ArviZ's schema."""
    if not isinstance(estimate, LinearUtility):
        return {"utility": records.to_tree(estimate)}
    data = xr.Dataset(
        {"weights": ("feature", estimate.weights)}, attrs={"discount": estimate.discount, "scale": estimate.scale}
    )
    children = {"quality": records.to_tree(estimate.quality)}
    try:
        children["features"] = records.to_tree(estimate.features)
    except ValueError:
        data.attrs["features"] = "other"  # the user's function, which has to be passed again
    groups = {"utility": xr.DataTree(data, children=children)}
    if estimate.posterior is not None:
        small = stored(estimate.posterior)
        groups |= {name: small.children[name] for name in POSTERIOR_GROUPS if name in small.children}
        groups["fit"] = xr.DataTree(small.to_dataset())
    return groups


def _read_estimate(tree: xr.DataTree, features: Any, known: Sequence[type]) -> Any:
    utility = tree.children["utility"]
    if "class" in utility.attrs:
        return records.from_tree(utility, known=known)
    if "features" in utility.children:
        features = records.from_tree(utility.children["features"], known=known)
    elif features is None:
        raise ValueError("a run with features of the user's own: pass them again as features=")
    posterior = None
    if "fit" in tree.children:
        groups = {name: tree.children[name] for name in POSTERIOR_GROUPS if name in tree.children}
        posterior = restored(xr.DataTree(tree.children["fit"].to_dataset(), children=groups))
    quality = records.from_tree(utility.children["quality"])
    return LinearUtility(
        features,
        utility.dataset["weights"].values,
        float(utility.attrs["discount"]),
        quality,
        posterior,
        float(utility.attrs["scale"]),
    )


def _write(file: Path, text: str) -> None:
    """Write aside, flush to the disk, rename into place."""
    aside = file.with_name(file.name + ".part")
    with aside.open("w", encoding="utf-8") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())
    aside.replace(file)
