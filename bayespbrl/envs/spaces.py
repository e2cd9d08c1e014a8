"""Observations and actions as policies and features meet them: rows of numbers, or whole numbers from 0, and back."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import Env
from gymnasium.spaces import (
    Box,
    Dict,
    Discrete,
    MultiBinary,
    MultiDiscrete,
    OneOf,
    Space,
    Tuple,
    flatten,
    flatten_space,
)
from gymnasium.vector.utils import batch_space, iterate

from bayespbrl import checks

NO_BOUND = 1e30  # an action's bound beyond it stands for none


def plain_space(space: Space[Any], actions: Space[Any] | None = None) -> Box | Discrete:
    """The space of `to_plain`: a 1-D `Box`, or a `Discrete` that counts from 0."""
    if isinstance(space, Discrete) and isinstance(actions, Box):  # no policy is a table of continuous actions
        return Box(0.0, 1.0, (int(space.n),), np.float64)
    if isinstance(space, Discrete):
        return space if space.start == 0 else Discrete(int(space.n))
    if isinstance(space, Box):
        if len(space.shape) == 1:
            return space
        return Box(space.low.reshape(-1), space.high.reshape(-1), dtype=space.dtype.type)
    parts: Any = flatten_space(space)
    return Box(parts.low.astype(np.float64), parts.high.astype(np.float64), dtype=np.float64)


def bounded(space: Box | Discrete) -> Box | Discrete:
    """The space without bounds that stand for none, such as the largest number: no exploration could reach them."""
    if isinstance(space, Discrete):
        return space
    bounds = np.array([space.low, space.high])
    none = np.isfinite(bounds) & (np.abs(bounds.astype(np.float64)) > NO_BOUND)
    if not none.any():
        return space
    low, high = np.where(none, np.copysign(np.inf, bounds), bounds)
    return Box(low, high, dtype=space.dtype.type)


def spaces_of(env: Env) -> dict[str, str]:
    """The observation and the action space of an environment in words, by name."""
    return {name: in_words(getattr(env, name)) for name in ("observation_space", "action_space")}


def in_words(space: Space[Any]) -> str:
    """A space in words that differ where the bounds, numbers, shapes or names differ."""
    if isinstance(space, Box):
        low, high = (
            each.flat[0].item() if np.unique(each).size == 1 else each.tolist() for each in (space.low, space.high)
        )
        return f"Box({low}, {high}, {space.shape})"
    if isinstance(space, Dict):
        return f"Dict({', '.join(f'{name}: {in_words(part)}' for name, part in space.spaces.items())})"
    if isinstance(space, Tuple):
        return f"Tuple({', '.join(map(in_words, space.spaces))})"
    return str(space)


def check_of_space(name: str, values: np.ndarray, space: Space[Any]) -> None:
    """Check that rows are of a flattened space: shape (N, n), or whole numbers below its size."""
    if isinstance(space, Discrete):
        fits = values.ndim == 1 and values.dtype.kind in "iu" and bool(np.all((values >= 0) & (values < space.n)))
    else:
        fits = values.ndim == 2 and values.dtype.kind == "f" and values.shape[1:] == space.shape
    if not fits:
        raise ValueError(f"{name}: expected entries of {space}, got {values.dtype} of shape {values.shape}")


def to_plain(space: Space[Any], value: Any, actions: Space[Any] | None = None) -> np.ndarray | np.int64:
    """An observation of `space`, flattened, one-hot where it is discrete and `actions` are not.

    Raises:
      ValueError: one that cannot be one-hot, or whose parts are not those of the space.
    """
    if isinstance(space, Discrete) and isinstance(actions, Box):
        _check_number(space, value)
        return np.asarray(flatten(space, int(value)), np.float64)
    if isinstance(space, Discrete):
        _check_number(space, value, within=False)
        return np.int64(value - space.start)
    if isinstance(space, Box):
        return np.reshape(value, -1)
    try:
        if _parts_within(space, value):
            return np.asarray(flatten(space, value), np.float64)
        why = None
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        why = error
    raise ValueError(f"observation: expected one of {space}, got {checks.one_line(value)}") from why


def unbatched(space: Space[Any], value: Any) -> list[Any] | None:
    """The observations of a batch, each of whose parts has a leading axis; None where it is no batch."""
    try:
        shapes = [(np.shape(each), part.shape) for part, each in _parts(space, value)]
    except (LookupError, TypeError, ValueError):  # not of this space
        return None
    numbers = {shape[:1] for shape, _ in shapes}
    if len(numbers) > 1 or any(shape[1:] != one or len(shape) != len(one) + 1 for shape, one in shapes):
        return None
    return list(iterate(batch_space(space, numbers.pop()[0]), value))


def _parts(space: Any, value: Any) -> Iterator[tuple[Any, Any]]:
    """The spaces that an observation's is made of, with what it has of each."""
    if isinstance(space, Dict):
        for name, part in space.spaces.items():
            yield from _parts(part, value[name])
    elif isinstance(space, Tuple):
        for part, each in zip(space.spaces, value, strict=True):
            yield from _parts(part, each)
    elif isinstance(space, OneOf):
        number, each = value
        yield from _parts(space.spaces[number], each)
    else:
        yield space, value


def _parts_within(space: Any, value: Any) -> bool:
    """Whether the parts of an observation are of their spaces: gymnasium takes others for some that are."""
    return all(_within(part, each) for part, each in _parts(space, value))


def _within(space: Any, value: Any) -> bool:
    values = np.asarray(value)
    if isinstance(space, MultiBinary):
        return bool(np.all((values == 0) | (values == 1)))
    if isinstance(space, Discrete | MultiDiscrete):
        number = space.n if isinstance(space, Discrete) else space.nvec
        return bool(np.all((values >= space.start) & (values < space.start + number)))
    return not isinstance(space, Box) or values.size == np.prod(space.shape)


def given_to_plain(space: Space[Any], value: Any, actions: Space[Any]) -> np.ndarray | np.int64:
    """`to_plain` of an observation that the user gives; `ValueError` also for one outside a discrete space."""
    if isinstance(space, Discrete):
        _check_number(space, value)
    return to_plain(space, value, actions)


def _check_number(space: Discrete, value: Any, *, within: bool = True) -> None:
    """Check that `value` is a whole number, and one of `space` unless that is looked at elsewhere."""
    number = np.ndim(value) == 0 and np.asarray(value).dtype.kind in "biuf"
    outside = number and within and not _parts_within(space, value)
    if not number or outside or not np.isfinite(value) or value != int(value):
        raise ValueError(f"observation: expected one of {space}, got {checks.one_line(value)}")


def from_plain(space: Any, value: Any) -> np.ndarray | np.int64:
    """An action of `space`, from a flattened one."""
    return np.reshape(value, space.shape) if isinstance(space, Box) else np.int64(value + space.start)
