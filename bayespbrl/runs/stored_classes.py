"""Frozen dataclasses of arrays and numbers as xarray trees, and back: how policies, features and estimates are stored.

Arrays become variables, everything else becomes one JSON attribute, dataclasses within become groups. No pickle: what
is read back are arrays and numbers, put into a class that `STORED` names or that the caller passed.
"""

import dataclasses
import json
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np
import xarray as xr

from bayespbrl.features import JointRadialBasis, OneHot, RadialBasis, StateActionProduct
from bayespbrl.policies import GaussianProcessPolicy, LinearGaussianPolicy, SoftmaxPolicy, TabularPolicy
from bayespbrl.utility.estimate import FitQuality, KnownReward

# The names by which files know our classes. A name never changes; the class behind it may move.
STORED: dict[str, type] = {
    "fit-quality": FitQuality,
    "gaussian-process": GaussianProcessPolicy,
    "joint-radial-basis": JointRadialBasis,
    "known-reward": KnownReward,
    "linear-gaussian": LinearGaussianPolicy,
    "one-hot": OneHot,
    "radial-basis": RadialBasis,
    "softmax": SoftmaxPolicy,
    "state-action-product": StateActionProduct,
    "tabular": TabularPolicy,
}
NAMES = {kind: name for name, kind in STORED.items()}
OWN = "own:"  # stands before the name of a class of the user's


def to_tree(record: Any) -> xr.DataTree:
    """A dataclass instance as a tree.

    Raises:
      ValueError: something that is no dataclass, or a field that is no array, number, text, None or dataclass.
    """
    if not dataclasses.is_dataclass(record) or isinstance(record, type):
        raise ValueError(f"record: expected a dataclass to store, got {type(record).__name__}")
    arrays, plain, children = {}, {}, {}
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if isinstance(value, np.ndarray | jax.Array):
            array = np.asarray(value)
            arrays[field.name] = ([f"{field.name}_{axis}" for axis in range(array.ndim)], array)
        elif dataclasses.is_dataclass(value):
            children[field.name] = to_tree(value)
        elif value is None or isinstance(value, bool | int | float | str | tuple | np.generic):
            plain[field.name] = value.item() if isinstance(value, np.generic) else value
        else:
            kind = type(value).__name__
            raise ValueError(f"record: {type(record).__name__}.{field.name} is a {kind}, which cannot be stored")
    attributes = {"class": stored_name(type(record)), "fields": json.dumps(plain)}
    return xr.DataTree(xr.Dataset(arrays, attrs=attributes), children=children)


def from_tree(tree: xr.DataTree, *, known: Iterable[type] = ()) -> Any:
    """The dataclass instance that `to_tree` made the tree from.

    Args:
      tree: loaded into memory.
      known: classes outside this package that may be made.

    Raises:
      ValueError: a class that is neither ours nor known, or fields that it does not take.
    """
    kind = _class(str(tree.attrs.get("class", "")), tuple(known))
    fields = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in json.loads(tree.attrs["fields"]).items()
    }
    arrays = {str(name): variable.values for name, variable in tree.data_vars.items()}
    children = {name: from_tree(child, known=known) for name, child in tree.children.items()}
    try:
        return kind(**fields, **arrays, **children)
    except TypeError as error:
        raise ValueError(f"record: stored {kind.__name__} does not fit this version's ({error})") from error


def stored_name(kind: type) -> str:
    """The name by which files know a class: ours by `STORED`, the user's by its own name."""
    return NAMES.get(kind, OWN + kind.__qualname__)


def _class(name: str, known: tuple[type, ...]) -> type:
    for candidate in known:
        if name == stored_name(candidate):
            return candidate
    if name in STORED:
        return STORED[name]
    raise ValueError(f"record: expected a class of bayespbrl or one that was passed again, got {name!r}")
