"""Names of environments: "gridworld", "CartPole-v1", "package:Maze-v0", "FrozenLake-v1,is_slippery=False"."""

import sys
from copy import deepcopy
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import gymnasium
from gymnasium.envs.registration import EnvSpec

from bayespbrl import checks
from bayespbrl.envs import SHORT_NAMES

Plain = bool | int | float | str | None
WORDS: dict[str, Plain] = {"True": True, "true": True, "False": False, "false": False, "None": None}
# Arguments of `gymnasium.make` that are not an environment's own.
NO_ARGUMENTS = {"render_mode": "pictures choose it", "max_episode_steps": "the option max_steps ends trajectories"}


class Name(NamedTuple):
    """The parts of a name.

    Attributes:
      module: to import before, as gymnasium's "module:Env-v0" has it; empty for none.
      id: gymnasium's.
      arguments: of `gymnasium.make`, by name.
    """

    module: str
    id: str
    arguments: dict[str, Plain]


def parsed(name: str) -> Name:
    """The parts of a name.

    A value is a number, one of `WORDS`, or a text, which has no comma; in quotes it is a text in any case.

    Raises:
      ValueError: what follows a comma is no NAME=VALUE, or a name comes twice.
    """
    called, *given = name.split(",")
    module, _, identity = SHORT_NAMES.get(called, called).rpartition(":")
    arguments: dict[str, Plain] = {}
    for each in given:
        argument, equals, value = each.partition("=")
        if not (equals and argument.isidentifier() and argument not in arguments):
            raise ValueError(f"environment {called}: expected NAME=VALUE after each comma, each once, got {each!r}")
        if argument in NO_ARGUMENTS:
            raise ValueError(
                f"environment {called}: expected no {argument}, as {NO_ARGUMENTS[argument]}, got {value!r}"
            )
        arguments[argument] = _value(value)
    return Name(module, identity, arguments)


def _value(text: str) -> Plain:
    if text in WORDS:
        return WORDS[text]
    for number in (int, float):
        try:
            return number(text)
        except ValueError:
            continue
    quoted = len(text) > 1 and text[0] == text[-1] and text[0] in "'\""
    return text[1:-1] if quoted else text


def spec_named(name: str) -> EnvSpec:
    """gymnasium's spec of a name, with its arguments; imports the package of "package:Env-v0".

    Raises:
      ValueError: an unknown name; a package that cannot be imported; arguments that are none.
    """
    module, identity, arguments = parsed(name)
    try:
        if module:
            import_module(module)
        spec = gymnasium.spec(identity)
    except Exception as error:  # a module of the user's may raise anything
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        here = missing == module and module in {path.stem for path in Path().glob("*.py")}
        hint = "; PYTHONPATH=. lets it be found" if here else ""
        raise ValueError(
            f"environment: expected {', '.join(SHORT_NAMES)} or a registered gymnasium id, got {name!r} "
            f"({checks.one_line(error)}{hint})"
        ) from error
    if arguments:
        spec = deepcopy(spec)  # gymnasium's own is for all
        spec.kwargs.update(arguments)
    return spec


def imported_by_name(environment: object) -> str:
    """The module that opening `environment` would import; empty for none, or one that is imported already."""
    module = parsed(environment).module if isinstance(environment, str) else ""
    return "" if module in sys.modules else module


def check_permission(name: str, directory: Path) -> None:
    """`ValueError` where opening a directory's environment by name would import a package, which runs its code."""
    if package := imported_by_name(name):
        raise ValueError(
            f"{directory}: expected permission to import {package!r}, which {name} needs, got none: "
            "import_package=True, or --import-package on the command line"
        )
