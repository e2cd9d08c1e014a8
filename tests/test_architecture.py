"""The import rule of the house, read from the imports themselves."""

import ast
from pathlib import Path

import pytest

import bayespbrl

ROOT = Path(bayespbrl.__file__).parent
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(ROOT.rglob("*.py"))
}

# Groups of modules, and the groups that each may import: a name in the table is a module, or a package with all in it
# that no other group names.
GROUPS = {
    "numerics": ["kernels", "lstd", "reps"],
    "convergence": ["diagnostics.convergence"],
    "environments": ["envs"],
    "models": ["models"],
    "policies": ["policies"],
    "what flows round": ["trajectories", "features", "preferences", "experts"],
    "critic": ["q_function"],
    "steps": ["utility", "improvement", "rollouts", "queries"],
    "evidence and averaging": ["evidence", "averaging"],
    "schedules": ["schedules"],
    "plain data": ["settings"],
    "memory": ["records"],
    "events": ["events"],
    "cycle": ["cycle"],
    "run directory": ["run_directory", "iteration_files"],
    "runs": ["runs"],
    "diagnostics": ["diagnostics"],
    "report": ["diagnostics.report"],
    "trials": ["trials", "trial_tables"],
    "film": ["film"],
    "command line": ["cli", "screen", "__main__"],
}
GROUND = ["numerics", "convergence", "environments"]
FLOWS = [*GROUND, "models", "policies", "what flows round"]
LEARNED = [
    *FLOWS,
    "critic",
    "steps",
    "evidence and averaging",
    "schedules",
    "plain data",
    "memory",
    "events",
    "cycle",
    "run directory",
    "runs",
]
ALLOWED = {
    "numerics": [],
    "convergence": [],
    "environments": [],
    "models": ["numerics", "convergence"],
    "policies": ["numerics"],
    "what flows round": ["numerics"],
    "critic": FLOWS,
    "steps": [*FLOWS, "critic"],
    "evidence and averaging": [*FLOWS, "steps"],
    "schedules": [*FLOWS, "steps", "diagnostics"],
    "plain data": [],
    "memory": [*FLOWS, "steps"],
    "events": ["what flows round"],
    "cycle": [*FLOWS, "steps", "evidence and averaging", "schedules", "plain data", "events"],
    "run directory": [*FLOWS, "steps", "evidence and averaging", "plain data", "memory", "events"],
    "runs": [*LEARNED, "report"],  # `Run.report` calls it, and imports it when called
    "diagnostics": [*LEARNED, "trials"],
    "report": [*LEARNED, "diagnostics", "trials"],
    "trials": LEARNED,
    "film": LEARNED,
    "command line": [*LEARNED, "diagnostics", "report", "trials", "film"],
}
# These import each other.
WITHIN = {
    "evidence and averaging",
    "environments",
    "models",
    "policies",
    "what flows round",
    "run directory",
    "diagnostics",
    "trials",
    "command line",
}


def group_of(module):
    """The group of the longest name in the table that `module` is, or lies in; None for the package itself."""
    matches = [
        (len(name), group) for group, names in GROUPS.items() for name in names if (module + ".").startswith(name + ".")
    ]
    return max(matches)[1] if matches else None


def imports(module):
    """Names of all modules that a module imports anywhere in it, and of ours without the package's name."""
    names = set()
    for node in ast.walk(ast.parse(MODULES[module].read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: a relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def ours(module):
    found = set()
    for name in imports(module):
        if name.split(".")[0] != "bayespbrl":
            continue
        inner = name.removeprefix("bayespbrl").removeprefix(".")
        while inner and inner not in MODULES:
            inner = inner.rpartition(".")[0]  # the last part was a function or a class
        found.add(inner)
    return found - {module}


INNER = sorted(set(MODULES) - {"__init__"})


def test_every_module_belongs_to_one_group():
    assert [module for module in INNER if group_of(module) is None] == []
    assert set(ALLOWED) == set(GROUPS)


@pytest.mark.parametrize("module", INNER)
def test_a_module_imports_only_what_its_group_may(module):
    group = group_of(module)
    for other in sorted(ours(module)):
        assert other, f"{module} imports the package itself, which imports everything"
        its_group = group_of(other)
        inside = its_group == group and (group in WITHIN)
        permitted = inside or its_group in ALLOWED[group]
        assert permitted, f"{module} ({group}) imports {other} ({its_group})"


def test_the_steps_never_import_each_other():
    steps = set(GROUPS["steps"])
    assert {module: ours(module) & steps for module in steps} == {module: set() for module in steps}


def test_only_the_cycle_and_what_stands_above_it_import_the_steps_together():
    together = {module for module in INNER if len(ours(module) & set(GROUPS["steps"])) == len(GROUPS["steps"])}
    assert together == {"cycle"}


@pytest.mark.parametrize("module", MODULES)
def test_nothing_imports_through_the_links_at_the_top_level(module):
    assert {name.split(".")[0] for name in imports(module)}.isdisjoint({"models", "diagnostics", "envs"})


@pytest.mark.parametrize("module", MODULES)
def test_a_modules_first_line_says_what_it_is(module):
    text = ast.get_docstring(ast.parse(MODULES[module].read_text()))
    assert text, f"{module} has no docstring"
    first = text.splitlines()[0]
    assert 10 < len(first) <= 117
    assert MODULES[module].read_text().startswith('"""')


def test_the_links_at_the_top_level_lead_into_the_package():
    for name in ("models", "diagnostics", "envs"):
        link = ROOT.parent / name
        if link.is_symlink():  # not every checkout can make links
            assert link.readlink() == Path("bayespbrl") / name


def test_the_rule_refuses_what_it_should():
    assert group_of("diagnostics.convergence") == "convergence"
    assert group_of("diagnostics.plots") == "diagnostics"
    assert group_of("envs.gridworld") == "environments"
    assert group_of("environment") is None
    assert "steps" not in ALLOWED["steps"]
    assert {"trajectories", "q_function", "reps"} <= ours("improvement")
