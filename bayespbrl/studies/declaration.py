"""A declared study: tasks × methods × noise × variants × seeds in a TOML file, with the options of each.

title = "What is compared, as a noun phrase"
trials = 20                      # of each row, one a seed
seed = 6000                      # of the first trial

[options]                        # of every row, as on the command line of `bayespbrl trials`
preset = "paper"

[tasks.gridworld]                # the task's name, or `env = "..."`
minutes = 1.5                    # of a trial on one core, for --dry-run
failed_below = 150               # a trial that ends below this value has failed
good_above = 280                 # after how many answers a trial's kept policy is better than this is counted in pairs

[methods.posterior-mean]         # the first method is what the others are compared with
[methods.random-policy]
untrained = true                 # only the value of the first policy is measured

[methods.pf]
baseline = "pf"                  # another algorithm, of bayespbrl.baselines, as many answers as the options come to

[noise.mistaken]
expert = "mistaken"

[[leave_out]]                    # combinations that are not run
methods = ["random-policy"]
noise = ["mistaken"]
"""

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import Any

from bayespbrl import checks
from bayespbrl.baselines import BASELINES
from bayespbrl.settings import OPTIONS

AXES = ("tasks", "methods", "noise", "variants")
OWN = ("title", "trials", "seed", "report_at", "options", "leave_out", *AXES)
OF_A_LEVEL = {
    "tasks": ("env", "minutes", "failed_below", "good_above"),
    "methods": ("untrained", "baseline", "minutes"),
    "variants": ("minutes",),
}
LEVEL = re.compile(r"(?!.*\.(?:csv|json|md|png|toml)$)[A-Za-z0-9][A-Za-z0-9._-]*")  # no file of the study's
Options = Mapping[str, Any]


@dataclass(frozen=True)
class DeclaredRow:
    """One combination of the axes.

    Attributes:
      levels: of tasks, methods, noise and variants; empty where the study has no such axis.
      env: a short name or a gymnasium id.
      options: of each trial, but for its seed.
      untrained: whether only the first policy's value is measured.
      baseline: the algorithm of `bayespbrl.baselines` that runs instead of the learner; None: the learner.
      minutes: of a trial on one core, as declared; None: not known.
      failed_below: a trial that ends below this value has failed; None: not declared.
      good_above: value of a policy that counts as good; None: not declared.
    """

    levels: tuple[str, str, str, str]
    env: str
    options: Options
    untrained: bool = False
    minutes: float | None = None
    failed_below: float | None = None
    baseline: str | None = None
    good_above: float | None = None

    @property
    def name(self) -> str:
        """The levels, joined: where the row's run directories are."""
        return "/".join(level for level in self.levels if level)

    @property
    def of_scale(self) -> bool:
        """Whether the row is an end of the relative value's scale: the random policy, or learning from the reward."""
        return self.untrained or (self.baseline is None and self.options.get("utility") == "known-reward")


@dataclass(frozen=True)
class Declaration:
    """A study as declared.

    Attributes:
      name: that of its file.
      title: what is compared.
      trials, seed: of each row.
      rows: in their order.
      text: the TOML.
      report_at: numbers of answers after which the tables give values, too.
    """

    name: str
    title: str
    trials: int
    seed: int
    rows: tuple[DeclaredRow, ...]
    text: str
    report_at: tuple[int, ...] = ()


def shipped() -> list[str]:
    """The names of the studies in the package."""
    folder = files("bayespbrl.studies") / "declared"
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def declared(name_or_file: str) -> Declaration:
    """The study of that name in the package, or of a TOML file.

    Raises:
      ValueError: an unknown name; a file that cannot be read; a declaration that is none.
    """
    if name_or_file in shipped():
        text = (files("bayespbrl.studies") / "declared" / f"{name_or_file}.toml").read_text(encoding="utf-8")
        return parsed(text, name_or_file)
    file = Path(name_or_file)
    if file.suffix != ".toml":
        raise ValueError(f"study: expected one of {', '.join(shipped())}, or a TOML file, got {name_or_file!r}")
    try:
        return parsed(file.read_text(encoding="utf-8"), file.stem)
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"study {name_or_file}: expected a readable file, got {error}") from error


def parsed(text: str, name: str) -> Declaration:
    """The study of a TOML text.

    Raises:
      ValueError: no TOML, an unknown entry, option or level, no row.
    """
    where = f"study {name}"
    try:
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ValueError(f"{where}: expected TOML, got {error}") from error
    _known(where, content, OWN)
    axes = [_axis(where, axis, content) for axis in AXES]
    if not content.get("tasks"):
        raise ValueError(f"{where}: expected at least one task, got none")
    common = _options(f"{where}, options", _table(f"{where}, options", content.get("options", {})))
    if not isinstance(entries := content.get("leave_out", []), list):
        raise ValueError(f"{where}, leave_out: expected a list of tables, got {entries!r}")
    left_out = [_left_out(where, entry, axes) for entry in entries]
    rows = tuple(
        _row(common, chosen)
        for chosen in product(*(axis.items() for axis in axes))
        if not any(_matches([level for level, _ in chosen], combination) for combination in left_out)
    )
    if not rows:
        raise ValueError(f"{where}: expected at least one row, got none, because all are left out")
    title = content.get("title", name)
    if not isinstance(title, str):
        raise ValueError(f"{where}: expected a title, got {title!r}")
    trials = checks.whole(f"{where}, trials", content.get("trials", 20))
    seed = checks.whole(f"{where}, seed", content.get("seed", 1000), 0)
    if not isinstance(report_at := content.get("report_at", []), list):
        raise ValueError(f"{where}, report_at: expected a list of numbers of answers, got {report_at!r}")
    numbers = tuple(checks.whole(f"{where}, report_at", number) for number in report_at)
    return Declaration(name, title, trials, seed, rows, text, numbers)


def _axis(where: str, axis: str, content: Mapping[str, Any]) -> dict[str, Options]:
    """The levels of an axis with their options; one without a name where the study does not have the axis."""
    levels = _table(f"{where}, {axis}", content.get(axis, {}))
    for level, options in levels.items():
        place = f"{where}, {axis}.{level}"
        if not LEVEL.fullmatch(level):
            raise ValueError(f"{place}: expected a name of letters, digits, dots and dashes, got {level!r}")
        _options(place, _table(place, options), OF_A_LEVEL.get(axis, ()))
        for name in {"failed_below", "good_above"} & set(options):
            checks.number(f"{place}, {name}", options[name])
        if "minutes" in options:
            checks.positive(f"{place}, minutes", options["minutes"])
        if not isinstance(env := options.get("env", level), str) or not env:
            raise ValueError(f"{place}, env: expected a short name or a gymnasium id, got {env!r}")
        untrained = checks.boolean(f"{place}, untrained", options.get("untrained", False))
        if "baseline" in options:
            checks.one_of(f"{place}, baseline", options["baseline"], tuple(BASELINES))
            if untrained:
                raise ValueError(f"{place}: expected untrained or a baseline, got both")
    return dict(levels) or {"": {}}


def _table(where: str, value: object) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{where}: expected a table, got {value!r}")
    return value


def _known(where: str, given: Mapping[str, Any], known: tuple[str, ...]) -> None:
    if unknown := sorted(set(given) - set(known)):
        raise ValueError(f"{where}: expected entries among {', '.join(known)}, got {', '.join(unknown)}")


def _options(where: str, options: dict[str, Any], own: tuple[str, ...] = ()) -> dict[str, Any]:
    """Options of a run and a level's own; the environment and the seed have their own places."""
    _known(where, options, (*own, *(name for name in sorted(OPTIONS) if name not in ("seed", "environment"))))
    return options


def _left_out(where: str, entry: Any, axes: list[dict[str, Options]]) -> list[list[str]]:
    """A combination as the levels of each axis, all where it names none."""
    place = f"{where}, leave_out"
    _known(place, _table(place, entry), AXES)
    chosen = []
    for axis, levels in zip(AXES, axes, strict=True):
        names = entry.get(axis, list(levels))
        if not isinstance(names, list) or not names or any(name not in list(levels) for name in names):
            declared = (
                f"a list of {axis} among {', '.join(levels)}" if levels != {"": {}} else f"no {axis}: none declared"
            )
            raise ValueError(f"{place}: expected {declared}, got {names!r}")
        chosen.append(names)
    return chosen


def _matches(levels: list[str], combination: list[list[str]]) -> bool:
    return all(level in among for level, among in zip(levels, combination, strict=True))


def _row(common: Options, chosen: tuple[tuple[str, Options], ...]) -> DeclaredRow:
    levels = tuple(level for level, _ in chosen)
    merged = dict(common)
    for _, options in chosen:
        merged |= options
    own = {name: merged.pop(name, None) for name in set().union(*OF_A_LEVEL.values())}
    return DeclaredRow(
        (levels[0], levels[1], levels[2], levels[3]),
        own["env"] or levels[0],
        merged,
        bool(own["untrained"]),
        own["minutes"],
        own["failed_below"],
        own["baseline"],
        own["good_above"],
    )
