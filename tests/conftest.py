"""What the test files share: shapes checked at run time, one thread a process, and finished runs of each kind."""

import functools
import gc
import importlib
import os
import shutil
from collections import Counter
from importlib.metadata import version
from pathlib import Path
from typing import get_args

import jaxtyping
import pytest
from beartype import BeartypeConf, beartype
from threadpoolctl import threadpool_limits

# Modules, and packages with all in them, whose shapes (`Float[Array, "k d"]`) are checked at each call. They must not
# be imported before the hook is installed; processes that tests start are not checked.
CHECKED = ["bayespbrl.kernels", "bayespbrl.models", "bayespbrl.improvement", "bayespbrl.policies"]


def has_shape(hint):
    """Whether a type annotation names an array with a shape."""
    shape = isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray)
    return shape or any(map(has_shape, get_args(hint)))


# Calls of each function that are checked in each test: a sampler's or a fit's inner loop makes thousands alike.
CHECKED_CALLS = 20
calls = Counter()
jaxtyped = jaxtyping.jaxtyped


def check_shapes(function):
    """`function`, which refuses arrays of other shapes and leaves all other annotations alone.

    Those are the static type checker's, and what a user may get wrong is refused by the function itself.
    """
    hints = function.__annotations__
    function.__annotations__ = {name: hint for name, hint in hints.items() if has_shape(hint)}
    return beartype(conf=BeartypeConf(is_pep484_tower=True))(function)  # an int may stand for a float


def first_calls_checked(*, typechecker):
    """What the hook decorates with instead of `jaxtyped`: the shapes of the first calls of each function are checked.

    Otherwise a tenth of the time would go to binding the arguments of all the others.
    """

    def decorate(function):
        if isinstance(function, type):
            return jaxtyped(function, typechecker=typechecker)
        if not any(isinstance(hint, str) or has_shape(hint) for hint in function.__annotations__.values()):
            return function
        checked = jaxtyped(function, typechecker=typechecker)  # which reads what stands in quotes

        @functools.wraps(function)
        def first_calls(*arguments, **options):
            calls[function] += 1
            return (checked if calls[function] <= CHECKED_CALLS else function)(*arguments, **options)

        return first_calls

    return decorate


def pytest_runtest_setup():
    calls.clear()


LONGEST = {"test_readme.py", "test_notebooks.py"}  # begun first, so that no process works on while the others are done


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: (item.get_closest_marker("empties_caches") is not None, item.path.name not in LONGEST))


# What the modules with checked shapes import. Imported first, else it would be compiled from its source: while it loads
# such a module, the hook looks for the compiled form of every other one under a name of its own.
LIBRARIES = ["arviz_stats", "cmaes", "gymnasium", "jax", "matplotlib", "numpyro.infer", "xarray"]


def pytest_sessionstart(session):
    if session.config.getoption("dist", "no") == "no":  # not where tests are only handed out to other processes
        for name in LIBRARIES:
            importlib.import_module(name)
        jaxtyping.jaxtyped = first_calls_checked
        jaxtyping.install_import_hook(CHECKED, "conftest.check_shapes")


# An eighth of the time would go to looking for garbage among the objects of JAX's programs.
gc.set_threshold(100_000, 20, 1_000)

# Test processes run side by side. With one thread each, the linear algebra of one does not wait for that of another.
threadpool_limits(1)  # here, where NumPy has its threads already
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # in what tests start
# Nor does XLA share its loops over small vectors among threads: that took half as much CPU time again.
os.environ["PJRT_NPROC"] = "1"
# All of them, later sessions and other checkouts share what JAX has compiled. A file cut short is compiled again.
HOME = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(HOME / "bayespbrl" / "tests"))
os.environ |= {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0", "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1"}
os.environ["PYTHONWARNINGS"] = "ignore:Error reading persistent compilation cache entry"
# Compilation is most of the work of a first session: the older of two generators of code takes half as long. XLA ends
# the process where it does not know an option, so only the versions that were tried get it.
COMPILER = (
    "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1 --xla_backend_optimization_level=1"
)
if version("jaxlib").startswith("0.10.") and COMPILER not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {COMPILER}".strip()


@pytest.fixture(scope="session")
def gridworld_run(tmp_path_factory):
    """Directory of a finished Gridworld run, posterior mean, second answer wrong, third a tie; not to be changed."""
    from toys import SHORT

    import bayespbrl

    directory = tmp_path_factory.mktemp("runs") / "gridworld"
    right, wrong = bayespbrl.ReturnExpert(), bayespbrl.NoisyExpert(bayespbrl.ReturnExpert(), wrong_answers=1.0, seed=0)
    answers = iter([right, wrong, lambda first, second: "tie", right])
    learner = bayespbrl.start("gridworld", directory, iterations=3, seed=7, **SHORT)
    learner.run(lambda first, second: next(answers)(first, second))
    return directory


@pytest.fixture
def gridworld_copy(gridworld_run, tmp_path):
    """A copy of `gridworld_run`, without its reports, to be changed."""
    return Path(shutil.copytree(gridworld_run, tmp_path / "copy", ignore=shutil.ignore_patterns("report*")))


@pytest.fixture(scope="session")
def swing_up_learner(tmp_path_factory):
    """A finished swing-up run with all options of uncertainty: its directory and its learner; not to be changed."""
    from toys import SHORT

    import bayespbrl

    directory = tmp_path_factory.mktemp("runs") / "swing-up"
    uncertainty = {"schedule": "confidence", "query": "information-when-unsure", "hyperparameters": "inferred"}
    options = {"updates_per_iteration": 2, "unasked_iterations": 1, "iterations": 4, "centres": 30, "seed": 3}
    learner = bayespbrl.start("swing-up", directory, **uncertainty, **options, **SHORT)
    return directory, learner.run(bayespbrl.ReturnExpert())


@pytest.fixture(scope="session")
def swing_up_run(swing_up_learner):
    """The directory of `swing_up_learner`'s run."""
    return swing_up_learner[0]


@pytest.fixture
def swing_up_copy(swing_up_run, tmp_path):
    """A copy of `swing_up_run`, without its reports, to be changed."""
    return Path(shutil.copytree(swing_up_run, tmp_path / "copy", ignore=shutil.ignore_patterns("report*")))


FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


@pytest.fixture(scope="module")
def browser():
    """The system's Chromium, headless."""
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium")
    assert chromium, "no chromium on the PATH: install it, for example with `apt-get install chromium`"
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        yield started
        started.close()
