"""The plan of the house, read from the source: who may import whom, and how large a room may be."""

import ast
import re
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import TypeCheckError

import bayespbrl
from bayespbrl import kernels

ROOT = Path(bayespbrl.__file__).parent
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(ROOT.rglob("*.py"))
}

# The floors of the house from the ground up, and the rooms on each: modules, or packages with all in them that no other
# floor names. A module imports from its own floor and from those that its floor names.
ROOMS = {
    "numerics": ["kernels", "checks", "figures"],
    "environments": ["envs"],
    "models": ["models"],
    "policies": ["policies"],
    "what flows round": ["trajectories", "features", "preferences", "experts"],
    "estimate": ["utility.estimate", "utility.length_scales", "utility.posterior_utility", "utility.quality"],
    "step 1": ["utility"],
    "step 2": ["improvement"],
    "step 3": ["rollouts"],
    "step 4": ["queries", "questions"],
    "baselines": ["baselines"],
    "settings": ["settings"],
    "events": ["events"],
    "learner": ["learner", "cycle", "collection"],
    "runs": ["runs"],
    "people": ["people"],
    "diagnostics": ["diagnostics"],
    "report": ["diagnostics.report"],
    "a run": ["runs.run", "runs.utility_reward"],
    "studies": ["studies"],
    "results": ["results"],
    "command line": ["cli", "__main__"],
}
STEPS = ["step 1", "step 2", "step 3", "step 4"]
FLOWS = ["numerics", "environments", "models", "policies", "what flows round", "estimate"]
LEARNED = [*FLOWS, *STEPS, "settings", "events", "learner"]
BELOW = {
    "numerics": [],
    "environments": ["numerics"],
    "models": ["numerics"],
    "policies": ["numerics", "environments"],
    "what flows round": ["numerics"],
    "estimate": ["numerics", "models", "what flows round"],
    **dict.fromkeys(STEPS, FLOWS),
    "baselines": [*FLOWS, "step 3"],
    "settings": [*FLOWS, *STEPS],
    "events": [*FLOWS, *STEPS, "settings"],
    "learner": LEARNED,
    "runs": LEARNED,
    "people": [*LEARNED, "runs"],
    "diagnostics": LEARNED,
    "report": [*LEARNED, "runs", "diagnostics"],
    "a run": [*LEARNED, "runs", "report"],
    "studies": [*LEARNED, "runs", "a run", "baselines"],
    "results": [*LEARNED, "runs", "studies", "diagnostics", "report"],
    "command line": [*LEARNED, "runs", "a run", "people", "studies", "diagnostics", "report", "results"],
}
# `Learner.widget` imports what stands above it when it is called.
DOORS = {("learner", "people.widget")}


def floor_of(module):
    """The floor of the longest name in the table that `module` is, or lies in; None for the package itself."""
    matches = [
        (len(name), floor) for floor, names in ROOMS.items() for name in names if (module + ".").startswith(name + ".")
    ]
    return max(matches)[1] if matches else None


def tree_of(module):
    return ast.parse(MODULES[module].read_text())


def imports(module):
    """Names of all modules that a module imports anywhere in it."""
    names = set()
    for node in ast.walk(tree_of(module)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: a relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def ours(module):
    """Those of this package, without its name."""
    found = set()
    for name in imports(module):
        if name.split(".")[0] != "bayespbrl":
            continue
        inner = name.removeprefix("bayespbrl").removeprefix(".")
        while inner and inner not in MODULES:
            inner = inner.rpartition(".")[0]  # the last part was a function or a class
        found.add(inner)
    return found - {module}


def permitted(module, other):
    its_floor = floor_of(other)
    return its_floor == floor_of(module) or its_floor in BELOW[floor_of(module)] or (module, other) in DOORS


INNER = sorted(set(MODULES) - {"", "__init__"})


def test_every_module_belongs_to_one_floor():
    assert [module for module in INNER if floor_of(module) is None] == []
    assert set(BELOW) == set(ROOMS)


def test_a_module_imports_only_what_its_floor_may():
    assert [
        f"{module} ({floor_of(module)}) imports {other} ({floor_of(other)})"
        for module in INNER
        for other in sorted(ours(module))
        if not other or not permitted(module, other)
    ] == []


def test_no_imports_go_round_in_circles():
    below = {module: {other for other in ours(module) if (module, other) not in DOORS} for module in INNER}
    left = dict(below)
    while free := [module for module, others in left.items() if not others & set(left)]:
        for module in free:
            del left[module]
    assert left == {}


def test_the_steps_never_import_each_other_and_only_the_learner_orders_them():
    steps = {module: {floor_of(other) for other in ours(module)} & set(STEPS) for module in INNER}
    assert [module for module in INNER if floor_of(module) in STEPS and steps[module] - {floor_of(module)}] == []
    above = ("learner", "runs", "a run", "people", "studies", "diagnostics", "report", "results", "command line")
    assert [module for module in INNER if steps[module] >= set(STEPS) and floor_of(module) not in above] == []


def test_nothing_imports_through_the_links_at_the_top_level():
    assert [m for m in MODULES if {n.split(".")[0] for n in imports(m)} & {"models", "diagnostics", "envs"}] == []


def test_a_modules_first_line_says_what_it_is():
    for module, path in MODULES.items():
        text = ast.get_docstring(tree_of(module)) or ""
        assert 10 < len(text.partition("\n")[0]) <= 117, module
        assert path.read_text().startswith('"""'), module


def test_a_package_of_several_modules_mentions_each_of_them_and_lists_no_other():
    for package in ROOT.rglob("__init__.py"):
        rooms = {path.stem for path in package.parent.glob("*.py")} - {"__init__"}
        overview = ast.get_docstring(ast.parse(package.read_text())) or ""
        if len(rooms) > 3 and package.parent != ROOT:  # README has the map of the whole
            assert rooms <= set(re.findall(r"\w+", overview)), package
        starts = re.findall(r"^([a-z_]+(?:, [a-z_]+)*)(?: {2,}|$)", overview, flags=re.MULTILINE)
        named = {name for start in starts for name in start.split(", ")}
        assert named <= rooms | {path.name for path in package.parent.iterdir()}, package


def test_the_links_at_the_top_level_lead_into_the_package():
    for name in ("models", "diagnostics", "envs"):
        link = ROOT.parent / name
        if link.is_symlink():  # not every checkout can make links
            assert link.readlink() == Path("bayespbrl") / name


def test_the_rule_refuses_what_it_should():
    assert floor_of("diagnostics.report.tables") == "report"
    assert floor_of("diagnostics.plots") == "diagnostics"
    assert floor_of("envs.gridworld") == "environments"
    assert floor_of("environment") is None
    assert not permitted("utility.inference", "improvement.reps")
    assert not permitted("models.posterior", "utility.estimate")
    assert permitted("learner", "utility.inference")
    assert {"policies", "improvement.q_function", "improvement.reps"} <= ours("improvement.update")


MOST_LINES, MOST_BODY, MOST_PARAMETERS, MOST_ROOMS = 350, 45, 7, 14
# Where a user's keyword options are the convenience.
MANY_PARAMETERS = {"infer_utility", "sample_posterior"}


def functions():
    for module in MODULES:
        for node in ast.walk(tree_of(module)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                yield module, node


def test_the_rooms_are_small():
    assert {m: n for m, p in MODULES.items() if (n := len(p.read_text().splitlines())) > MOST_LINES} == {}
    assert len(list(ROOT.glob("*.py"))) <= MOST_ROOMS


def test_functions_are_short_and_take_few_parameters():
    long, wide = [], []
    for module, node in functions():
        documented = ast.get_docstring(node) is not None and len(node.body) > 1
        body = node.end_lineno - node.body[documented].lineno + 1
        if body > MOST_BODY:
            long.append(f"{module}.{node.name}: {body} lines")
        arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        number = len(arguments) - bool(arguments and arguments[0].arg in ("self", "cls"))
        door = node.name in MANY_PARAMETERS or floor_of(module) == "command line"
        if number > MOST_PARAMETERS and not node.name.startswith("_") and not door:
            wide.append(f"{module}.{node.name}: {number} parameters")
    assert (long, wide) == ([], [])


def test_arrays_are_checked_against_their_annotations_while_the_tests_run():
    with pytest.raises(TypeCheckError):
        kernels.inverse_bandwidths(np.ones(2, dtype=int), np.ones(2))
