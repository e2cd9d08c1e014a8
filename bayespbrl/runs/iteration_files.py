"""The netCDF file of one iteration: its trajectories, the policy and what was tried of it, the utility estimate."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from bayespbrl import checks
from bayespbrl.events import Entry
from bayespbrl.features import OwnFeatures, StateFeatures
from bayespbrl.models import restored, stored
from bayespbrl.runs.files import NETCDF, check_file, write_netcdf
from bayespbrl.runs.stored_classes import from_tree, to_tree
from bayespbrl.trajectories import Trajectory
from bayespbrl.utility import UtilityEstimate

POSTERIOR_GROUPS = ("posterior", "sample_stats", "log_likelihood", "observed_data", "constant_data")
MOST_BYTES_A_BYTE = 16  # arrays of a file in bytes, by its size
PARTS = {"collected": ("trajectories",), "improved": ("trajectories", "tried", "policy", "estimate")}


def write_iteration(file: Path, entry: Entry) -> None:
    """Write the heavy parts of one iteration to a netCDF file, whole or not at all."""
    parts = entry.parts
    groups = {"trajectories": xr.DataTree(_trajectories_dataset(parts["trajectories"]))}
    if parts.get("tried"):
        groups["tried"] = xr.DataTree(_trajectories_dataset(parts["tried"]))
    if "policy" in parts:
        groups["policy"] = to_tree(parts["policy"])
        groups |= _estimate_groups(parts["estimate"])
    write_netcdf(file, xr.DataTree.from_dict(groups))


def read_iteration(
    file: Path, event: str, *, features: StateFeatures | None = None, known: Sequence[type] = ()
) -> dict[str, Any]:
    """The heavy parts of an event, `collected` or `improved`. Arguments and errors as in `read_parts`."""
    return read_parts(file, PARTS[event], features=features, known=known)


def read_parts(
    file: Path, names: Sequence[str], *, features: StateFeatures | None = None, known: Sequence[type] = ()
) -> dict[str, Any]:
    """Some of the parts of an iteration by name: `trajectories`, `tried`, `policy`, `estimate`.

    Args:
      file: as written by `write_iteration`.
      names: of the parts to read.
      features: φ(s) of the user's, where the run was started with it.
      known: classes of the user's that the file may name.

    Raises:
      ValueError: a file that is missing, truncated or foreign.
    """
    read = {
        "trajectories": lambda tree: _read_trajectories(tree.children["trajectories"].to_dataset()),
        "tried": lambda tree: (
            _read_trajectories(tree.children["tried"].to_dataset()) if "tried" in tree.children else ()
        ),
        "policy": lambda tree: from_tree(tree.children["policy"], known=known),
        "estimate": lambda tree: _read_estimate(tree, features, known),
    }
    # to look at the other groups takes ten times as long
    alone = "trajectories" if tuple(names) == ("trajectories",) else None
    try:
        check_file(file)
        with NETCDF, xr.open_datatree(file, engine="netcdf4", decode_times=False, group=alone) as opened:
            _check_size(file, opened)
            tree = opened.load()
        tree = tree if alone is None else xr.DataTree(children={alone: tree})
        _check_numbers(tree)
        parts = {name: read[name](tree) for name in names}
    except (OSError, KeyError, RuntimeError, AttributeError, TypeError, ValueError, MemoryError, IndexError) as error:
        reason = checks.reason(error)
        raise ValueError(f"{file.name}: expected the netCDF file of an iteration, got {reason}") from error
    return parts


def _check_size(file: Path, tree: xr.DataTree) -> None:
    """Check that a file does not claim more than it holds: what a run writes is not compressed."""
    claimed, held = sum(node.dataset.nbytes for node in tree.subtree), file.stat().st_size
    if claimed > MOST_BYTES_A_BYTE * held:
        raise ValueError(f"{claimed} bytes of arrays in a file of {held} bytes")


def _check_numbers(tree: xr.DataTree) -> None:
    """Check that all arrays are numbers; labels of the posterior's dimensions may be text."""
    for node in tree.subtree:
        for name, variable in node.data_vars.items():
            if variable.dtype.kind not in "biuf":
                raise ValueError(f"{variable.dtype} instead of numbers as {name}")


def _trajectories_dataset(trajectories: Sequence[Trajectory]) -> xr.Dataset:
    """Trajectories as one table, each filled up with zeros to the length of the longest."""
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
    if np.any(data["length"].values > actions.shape[1]):
        raise ValueError(f"a trajectory of {data['length'].values.max()} steps in a table of {actions.shape[1]}")
    return tuple(
        Trajectory(
            states[i, : length + 1], actions[i, :length], rewards[i, :length], bool(data["terminated"].values[i])
        )
        for i, length in enumerate(data["length"].values)
    )


def _estimate_groups(estimate: UtilityEstimate) -> dict[str, xr.DataTree]:
    """An estimate as groups: its own, and those of its posterior in ArviZ's schema."""
    features = getattr(estimate, "features", None)
    without = ("posterior", "features") if isinstance(features, OwnFeatures) else ("posterior",)
    groups = {"utility": to_tree(estimate, without=without)}
    if isinstance(features, OwnFeatures):  # φ is a function of the user's, which has to be passed again
        groups["utility"].attrs |= {"features": "other", "feature_units": json.dumps(features.units)}
    if estimate.posterior is not None:
        small = stored(estimate.posterior)
        groups |= {name: small.children[name] for name in POSTERIOR_GROUPS if name in small.children}
        groups["fit"] = xr.DataTree(small.to_dataset())
    return groups


def _read_estimate(tree: xr.DataTree, features: StateFeatures | None, known: Sequence[type]) -> UtilityEstimate:
    utility, given = tree.children["utility"], dict[str, Any]()
    if "fit" in tree.children:
        groups = {name: tree.children[name] for name in POSTERIOR_GROUPS if name in tree.children}
        given["posterior"] = restored(xr.DataTree(tree.children["fit"].to_dataset(), children=groups))
    if utility.attrs.get("features") == "other":
        if features is None:
            raise ValueError("an estimate with features of your own: pass them again as features=")
        units = json.loads(utility.attrs.get("feature_units", "[]"))  # none of earlier versions
        given["features"] = OwnFeatures(features, tuple(units))  # as while the run learned
    if "class" not in utility.attrs:  # by an earlier version: the posterior's groups say which of two it is
        numbers = {name: float(utility.attrs[name]) for name in ("discount", "scale") if name in utility.attrs}
        kind = "posterior" if "posterior" in given else "linear-program"
        utility.attrs |= {"class": kind, "fields": json.dumps(numbers)}
    return from_tree(utility, known=known, given=given)
