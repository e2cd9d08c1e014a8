"""The heavy parts of one iteration as one netCDF file: trajectories, policy, utility estimate and its posterior."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from bayespbrl.events import Entry
from bayespbrl.models import restored, stored
from bayespbrl.runs import stored_classes as records
from bayespbrl.runs.files import written_aside
from bayespbrl.trajectories import Trajectory
from bayespbrl.utility.averaging import AveragedUtility
from bayespbrl.utility.estimate import LinearUtility

POSTERIOR_GROUPS = ("posterior", "sample_stats", "log_likelihood", "observed_data", "constant_data")
ENGINE: Any = "h5netcdf"
PARTS = {"collected": ("trajectories",), "improved": ("trajectories", "policy", "estimate")}


def write_iteration(file: Path, entry: Entry) -> None:
    """The heavy parts of one iteration as one netCDF file, whole or not at all."""
    parts = entry.parts
    groups = {"trajectories": xr.DataTree(_trajectories_dataset(parts["trajectories"]))}
    if "policy" in parts:
        groups["policy"] = records.to_tree(parts["policy"])
        groups |= _estimate_groups(parts["estimate"])
    with written_aside(file) as aside:
        xr.DataTree.from_dict(groups).to_netcdf(aside, engine=ENGINE)


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
    if isinstance(estimate, AveragedUtility):
        groups["average"] = _average_group(estimate)
    if estimate.posterior is not None:
        small = stored(estimate.posterior)
        groups |= {name: small.children[name] for name in POSTERIOR_GROUPS if name in small.children}
        groups["fit"] = xr.DataTree(small.to_dataset())
    return groups


AVERAGE = {
    "multiples": ("component", "dimension"),
    "probabilities": ("component",),
    "means": ("component", "feature"),
    "components": ("draw",),
    "weight_draws": ("draw", "feature"),
}


def _average_group(estimate: AveragedUtility) -> xr.DataTree:
    data = xr.Dataset({name: (dimensions, getattr(estimate, name)) for name, dimensions in AVERAGE.items()})
    try:
        return xr.DataTree(data, children={"base": records.to_tree(estimate.base)})
    except ValueError:
        return xr.DataTree(data)  # the user's function: the estimate's own


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
    estimate = LinearUtility(
        features,
        utility.dataset["weights"].values,
        float(utility.attrs["discount"]),
        quality,
        posterior,
        float(utility.attrs["scale"]),
    )
    if "average" not in tree.children:
        return estimate
    average = tree.children["average"]
    base = records.from_tree(average.children["base"], known=known) if "base" in average.children else features
    arrays: dict[str, Any] = {name: average.dataset[name].values for name in AVERAGE}
    return AveragedUtility(**vars(estimate), base=base, **arrays)
