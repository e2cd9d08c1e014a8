"""What is built and installed is the one package and nothing else."""

import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
LINKS = ("models", "diagnostics", "envs")
MODULES = {path.relative_to(ROOT).as_posix() for path in (ROOT / "bayespbrl").rglob("*.py")}
TEMPLATES = {f"bayespbrl/diagnostics/report/templates/report.{form}.jinja" for form in ("html", "md")}
TEMPLATES |= {path.relative_to(ROOT).as_posix() for path in (ROOT / "bayespbrl/studies/declared").glob("*.toml")}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Wheel and sdist, built from a copy of the checkout by the build back end that pyproject.toml asks for."""
    folder = tmp_path_factory.mktemp("build")
    source, back_end = folder / "source", folder / "back end"
    anywhere = shutil.ignore_patterns(".venv*", ".git", ".*_cache", "build", "dist", "__pycache__", "*.egg-info")

    def left_out(folder, names):  # `runs` of the checkout's root, and not the package of that name
        return anywhere(folder, names) | ({"runs"} if Path(folder) == ROOT else set())

    shutil.copytree(ROOT, source, symlinks=True, ignore=left_out)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--target", str(back_end)]
    subprocess.run([*pip, "setuptools>=77"], check=True)
    for kind in ("wheel", "sdist"):
        command = f"import setuptools.build_meta as back_end; back_end.build_{kind}({str(folder)!r})"
        options = {"cwd": source, "env": {"PYTHONPATH": str(back_end), "PATH": "/usr/bin:/bin"}}
        done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=False, **options)
        assert done.returncode == 0, done.stderr
    return next(folder.glob("*.whl")), next(folder.glob("*.tar.gz"))


@pytest.mark.slow
def test_the_wheel_holds_the_package_and_nothing_else(built):
    names = zipfile.ZipFile(built[0]).namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"bayespbrl"}
    assert {name for name in names if name.endswith(".py")} == MODULES
    assert {"bayespbrl/py.typed", *TEMPLATES} <= set(names)
    assert any(name.endswith("LICENSE") for name in names)


@pytest.mark.slow
def test_the_sdist_holds_no_link_and_no_second_copy(built):
    with tarfile.open(built[1]) as archive:
        members = archive.getmembers()
    inner = {member.name.partition("/")[2] for member in members}
    assert not any(member.issym() or member.islnk() for member in members)
    assert not any(name.split("/")[0] in LINKS for name in inner)
    assert {name for name in inner if name.startswith("bayespbrl/") and name.endswith(".py")} == MODULES
    assert {"pyproject.toml", "README.md", "LICENSE", "bayespbrl/py.typed", *TEMPLATES} <= inner


@pytest.mark.slow
def test_an_installed_package_puts_no_models_diagnostics_or_envs_on_the_path(tmp_path):
    command = f"import importlib.util as u, bayespbrl; print([n for n in {LINKS} if u.find_spec(n)])"
    done = subprocess.run([sys.executable, "-c", command], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_version_is_that_of_the_installed_package():
    from importlib.metadata import version

    assert f'version = "{version("bayespbrl")}"' in (ROOT / "pyproject.toml").read_text()
