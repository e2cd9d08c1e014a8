"""Checks of arguments, one for each kind: a `ValueError` says which argument it is, what was expected and what came."""

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

MOST_SEED = 2**63 - 1


def whole(name: str, value: Any, least: int = 1, *, most: int | None = None) -> int:
    """`value` as an int, where it is a whole number >= `least`, and <= `most` unless that is None."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{name}: expected a whole number >= {least}, got {value!r}")
    if most is not None and value > most:
        raise ValueError(f"{name}: expected at most {most}, got {value}")
    return int(value)


def seed(value: Any) -> int:
    """A seed as an int, where it is a whole number that a run can keep."""
    return whole("seed", value, 0, most=MOST_SEED)


def path(name: str, value: Any) -> Path:
    """`value` as a path, where it is one or a string."""
    if not isinstance(value, str | os.PathLike):
        raise ValueError(f"{name}: expected a path, got {shortened(value)}")
    return Path(value)


def boolean(name: str, value: Any) -> bool:
    """`value`, where it is true or false."""
    if not isinstance(value, bool):
        raise ValueError(f"{name}: expected true or false, got {value!r}")
    return value


def number(name: str, value: Any) -> float:
    """`value` as a float, where it is finite."""
    if not _is_number(value):
        raise ValueError(f"{name}: expected a finite number, got {value!r}")
    return float(value)


def optional(check: Callable[..., Any], name: str, value: Any, **limits: Any) -> None:
    """`check` of `value`, unless it is None."""
    if value is not None:
        check(name, value, **limits)


def positive(name: str, value: Any) -> float:
    """`value` as a float, where it is finite and > 0."""
    if not (_is_number(value) and value > 0):
        raise ValueError(f"{name}: expected a positive finite number, got {value!r}")
    return float(value)


def between(name: str, value: Any, least: float, most: float) -> float:
    """`value` as a float, where it is a number in [`least`, `most`]."""
    if not (_is_number(value) and least <= value <= most):
        raise ValueError(f"{name}: expected a number from {least:g} to {most:g}, got {value!r}")
    return float(value)


def non_negative(name: str, value: Any) -> float:
    """`value` as a float, where it is finite and >= 0."""
    if not (_is_number(value) and value >= 0):
        raise ValueError(f"{name}: expected a non-negative finite number, got {value!r}")
    return float(value)


def share(name: str, value: Any, *, below_one: bool = False) -> float:
    """`value` as a float, where it is in [0, 1], or in [0, 1)."""
    if not (_is_number(value) and 0 <= value <= 1) or (below_one and value == 1):
        raise ValueError(f"{name}: expected a number in [0, 1{')' if below_one else ']'}, got {value!r}")
    return float(value)


def one_of(name: str, value: Any, choices: Sequence[str]) -> str:
    """`value`, where it is one of `choices`."""
    if not isinstance(value, str) or value not in choices:
        named = [choice for choice in choices if choice != "other"]  # an object of the user's, which no name can give
        raise ValueError(f"{name}: expected one of {', '.join(named)}, got {value!r}")
    return str(value)


def function(name: str, value: Any, of: str = "") -> None:
    """`value` can be called, and is no class, which a user may pass for its instance; `of` says what it takes."""
    if not callable(value) or isinstance(value, type):
        raise ValueError(f"{name}: expected a function{of}, got {value!r}")


Choice = TypeVar("Choice")


def function_or_name(option: str, given: Choice | str | None, name: str, known: Mapping[str, Choice]) -> Choice:
    """The user's own function where `given` is one, else the known one with the name that the settings have."""
    if given is not None and not isinstance(given, str):
        return given
    if name not in known:
        came = "none" if given in (None, name) else repr(given)
        raise ValueError(f"{option}: expected a function, because the settings say {name!r}, got {came}")
    return known[name]


LONGEST_NAME = 64


def short_name(name: str, value: Any) -> str:
    """`value`, where it is a printable string of 1 to `LONGEST_NAME` characters without spaces at its ends."""
    fits = isinstance(value, str) and 0 < len(value) <= LONGEST_NAME and value.isprintable() and value == value.strip()
    if not fits:
        raise ValueError(f"{name}: expected a printable name of 1 to {LONGEST_NAME} characters, got {value!r}")
    return str(value)


def dense(name: str, values: Any) -> np.ndarray:
    """`values` as an array, of SciPy's sparse ones too; neither rows of different lengths nor masked entries."""
    if np.ma.is_masked(values):
        raise ValueError(f"{name}: expected numbers, got masked entries")
    try:
        return np.asarray(values.toarray() if hasattr(values, "toarray") else values)
    except ValueError as error:
        raise ValueError(f"{name}: expected rows of numbers, all equally long, got {shortened(values)}") from error


def finite(name: str, values: Any) -> None:
    """Check that an array holds numbers, and neither NaN nor infinity."""
    try:
        fits = bool(np.all(np.isfinite(values)))
    except (TypeError, ValueError) as error:  # text, None, rows of different lengths
        raise ValueError(f"{name}: expected finite numbers, got {shortened(values)}") from error
    if not fits:
        raise ValueError(f"{name}: expected finite entries, got NaN or infinity")


def matrix(name: str, values: Any, *, columns: int | None = None) -> np.ndarray:
    """`values` as a finite float64 array of shape (N, columns); any number of columns when None."""
    array = reals(name, values)
    if array.ndim != 2 or (columns is not None and array.shape[1] != columns):
        raise ValueError(f"{name}: expected shape (N, {'D' if columns is None else columns}), got {array.shape}")
    finite(name, array)
    return array


def reals(name: str, values: Any) -> np.ndarray:
    """`values` as a float64 array of any shape, where they are real numbers, NaN and infinity among them."""
    try:
        given = np.asarray(values)
        array = np.asarray(given.real, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected rows of numbers, all equally long, got {shortened(values)}") from error
    if np.ma.is_masked(values) or np.iscomplexobj(given):
        raise ValueError(f"{name}: expected real numbers, got masked or complex entries")
    if given.dtype.kind in "mM":
        raise ValueError(f"{name}: expected real numbers, got dates or times; say in which unit, from which day")
    return array


def index(name: str, value: Any, number: int) -> int:
    """`value` as an int, where it is one of 0 … `number` − 1."""
    if not isinstance(value, int | np.integer) or not 0 <= value < number:
        raise ValueError(f"{name}: expected a number in 0 … {number - 1}, got {value!r}")
    return int(value)


def flags(name: str, values: Any, number: int) -> np.ndarray:
    """`values` as an array, where it is bool of shape (`number`,)."""
    array = np.asarray(values, dtype=None if np.size(values) else bool)  # an empty list has no type
    if array.shape != (number,) or array.dtype != bool:
        raise ValueError(f"{name}: expected bool of shape ({number},), got {array.dtype} of shape {array.shape}")
    return array


def indices(name: str, values: Any, number: int) -> np.ndarray:
    """`values` as an int64 array of shape (N,), where they are integers in 0 … `number` − 1."""
    array = np.asarray(values)
    if array.ndim != 1 or not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"{name}: expected integers of shape (N,), got {array.dtype} of shape {array.shape}")
    if array.size and not (array.min() >= 0 and array.max() < number):
        raise ValueError(f"{name}: expected numbers in 0 … {number - 1}, got {array.min()} … {array.max()}")
    return array.astype(np.int64)


def pairs(name: str, values: Any) -> np.ndarray:
    """`values` as an int64 array of shape (K, 2), where they are K pairs of integers."""
    try:
        array = np.asarray(values)
    except ValueError as error:  # rows of different lengths
        raise ValueError(f"{name}: expected pairs of integers, got {shortened(values)}") from error
    if array.shape in ((0,), (0, 2)):
        return np.zeros((0, 2), dtype=np.int64)
    if array.ndim != 2 or array.shape[1] != 2 or not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"{name}: expected pairs of integers, got {shortened(values)}")
    return array.astype(np.int64)


def one_line(value: object) -> str:
    """The text of a value or an error without line breaks."""
    return " ".join(str(value).split())


def reason(error: Exception) -> str:
    """What an error says, in one line; its type where it says nothing."""
    return one_line(error) or type(error).__name__


def shortened(values: Any) -> str:
    """The representation of a value in one line of at most 61 characters."""
    text = one_line(repr(values))
    return text if len(text) <= 60 else text[:60] + "…"


def _is_number(value: Any) -> bool:
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool | np.timedelta64)
    value = float(value) if isinstance(value, np.floating) else value  # else float32 overflows in the comparison
    return number and -sys.float_info.max <= value <= sys.float_info.max  # a whole number may be larger than any float
