"""Policies, features and estimates as xarray trees, and back: how a run stores frozen dataclasses.

Arrays become variables, nested dataclasses become groups, and all other fields together become one JSON attribute.
Nothing is pickled: a file holds arrays and numbers, for a class that `STORED` names or that the caller passed.
"""

import dataclasses
import json
from collections.abc import Collection, Iterable, Mapping
from typing import Any

import jax
import numpy as np
import xarray as xr

from bayespbrl.features import DiffusionBasis, JointRadialBasis, OneHot, RadialBasis, StateActionProduct
from bayespbrl.policies import GaussianProcessPolicy, LinearGaussianPolicy, SoftmaxPolicy, TabularPolicy
from bayespbrl.utility import FitQuality, KnownReward, LinearProgramUtility, PosteriorUtility

# The names of our classes in files. A name never changes; the class may move to another module.
STORED: dict[str, type] = {
    "diffusion-basis": DiffusionBasis,
    "fit-quality": FitQuality,
    "gaussian-process": GaussianProcessPolicy,
    "joint-radial-basis": JointRadialBasis,
    "known-reward": KnownReward,
    "linear-gaussian": LinearGaussianPolicy,
    "linear-program": LinearProgramUtility,
    "one-hot": OneHot,
    "posterior": PosteriorUtility,
    "radial-basis": RadialBasis,
    "softmax": SoftmaxPolicy,
    "state-action-product": StateActionProduct,
    "tabular": TabularPolicy,
}
NAMES = {kind: name for name, kind in STORED.items()}
OWN = "own:"  # prefix of the name of a user's class


def to_tree(instance: Any, *, without: Collection[str] = ()) -> xr.DataTree:
    """The tree of a dataclass instance, `without` some of its fields.

    Raises:
      ValueError: not a dataclass instance; a field that is no array, number, text, tuple, None or dataclass.
    """
    if not dataclasses.is_dataclass(instance) or isinstance(instance, type):
        raise ValueError(f"stored class: expected an instance of a dataclass, got {type(instance).__name__}")
    arrays, plain, children = {}, {}, {}
    for name in [field.name for field in dataclasses.fields(instance) if field.name not in without]:
        value = getattr(instance, name)
        if isinstance(value, np.ndarray | jax.Array):
            array = np.asarray(value)
            if array.dtype.kind == "c" or array.dtype == np.float16:  # which netCDF has not
                raise ValueError(
                    f"stored class: expected real numbers of 32 or 64 bits in {type(instance).__name__}.{name}, got "
                    f"{array.dtype}"
                )
            arrays[name] = ([f"{name}_{axis}" for axis in range(array.ndim)], array)
        elif dataclasses.is_dataclass(value):
            children[name] = to_tree(value)
        elif value is None or isinstance(value, bool | int | float | str | tuple | np.generic):
            plain[name] = value.item() if isinstance(value, np.generic) else value
        else:
            raise ValueError(
                f"stored class: expected an array, number or text in {type(instance).__name__}.{name}, "
                f"got {type(value).__name__}"
            )
    try:
        attributes = {"class": stored_name(type(instance)), "fields": json.dumps(plain)}
    except TypeError as error:
        name = type(instance).__name__
        raise ValueError(
            f"stored class: expected tuples of numbers and texts in {name}, got others: {error}"
        ) from error
    return xr.DataTree(xr.Dataset(arrays, attrs=attributes), children=children)


def classes_of(instance: Any) -> tuple[type, ...]:
    """The class of a dataclass instance, and those of the dataclasses in its fields."""
    fields = dataclasses.fields(instance) if dataclasses.is_dataclass(instance) else ()
    parts = [getattr(instance, field.name) for field in fields]
    inner = [kind for part in parts if dataclasses.is_dataclass(part) for kind in classes_of(part)]
    return tuple(dict.fromkeys([type(instance), *inner]))


def from_tree(tree: xr.DataTree, *, known: Iterable[type] = (), given: Mapping[str, Any] | None = None) -> Any:
    """The dataclass instance of a tree that `to_tree` returned.

    Args:
      tree: loaded into memory.
      known: classes of the user's that the tree may name.
      given: the fields that it was stored without.

    Raises:
      ValueError: a class that is neither ours nor in `known`, or fields that do not fit the class.
    """
    kind = _class_named(str(tree.attrs.get("class", "")), tuple(known))
    fields = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in json.loads(tree.attrs["fields"]).items()
    }
    arrays = {str(name): variable.values for name, variable in tree.data_vars.items()}
    children = {name: from_tree(child, known=known) for name, child in tree.children.items()}
    try:
        return kind(**fields, **arrays, **children, **(given or {}))
    except TypeError as error:
        raise ValueError(f"stored class: expected the fields of {kind.__name__}, got others ({error})") from error


def stored_name(kind: type) -> str:
    """The name of a class in files: its name in `STORED`, or the qualified name of a user's class."""
    return NAMES.get(kind, OWN + kind.__qualname__)


def _class_named(name: str, known: tuple[type, ...]) -> type:
    for candidate in known:
        if name == stored_name(candidate):
            return candidate
    if name in STORED:
        return STORED[name]
    raise ValueError(f"stored class: expected a class of bayespbrl or one of the objects passed, got {name!r}")
