import json
import re
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
LARGEST = 300_000  # bytes
# What a notebook is about having of one's own does not belong in the package.
OWN = {"03_uncertainty_and_exploration": ["cautious"], "04_your_own_environment": ["features", "expert"]}
# An absolute path of two parts or more (not an address), or one with a drive's letter.
MACHINE_PATH = re.compile(r"(?<![\w.:/)])/\w[\w.-]*/\w[^\s\"]*|\b[A-Z]:\\\\\w+")

# An empty namespace, and as few collections of garbage as in the test processes.
BEFORE = "%reset -f\n__import__('gc').set_threshold(100_000, 20, 1_000)"

each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def read(path):
    """The notebook as it is kept. Importing nbformat would take longer than these tests."""
    return json.loads(path.read_text(encoding="utf-8"))


def code_cells(notebook):
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def without_pictures(notebook):
    for cell in notebook["cells"]:
        for output in cell.get("outputs", []):
            output.get("data", {}).pop("image/png", None)
    return json.dumps(notebook).replace(r"\n", " ")  # else the n would look like a letter before a path


def test_there_is_a_notebook():
    assert NOTEBOOKS


@pytest.fixture(scope="module")
def kernel(tmp_path_factory):
    """One kernel for all notebooks: importing the package and tracing its programs takes longer than most cells."""
    from jupyter_client.manager import KernelManager

    with pytest.MonkeyPatch.context() as environment:
        environment.delenv("BAYESPBRL_FULL", raising=False)
        sockets = str(tmp_path_factory.mktemp("kernel") / "ipc")  # no TCP port that another may take first
        manager = KernelManager(kernel_name="python3", transport="ipc", ip=sockets)
        manager.start_kernel(cwd=NOTEBOOKS[0].parent)
    yield manager
    manager.shutdown_kernel(now=True)


@pytest.mark.slow
@each_notebook
def test_every_notebook_runs_from_an_empty_namespace_without_error_or_warning(path, kernel):
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    for cell in code_cells(notebook):
        cell.outputs = []
    notebook.cells.insert(0, nbformat.v4.new_code_cell(BEFORE))
    client = NotebookClient(notebook, km=kernel, timeout=300)
    client.execute()
    client.kc.stop_channels()
    outputs = [output for cell in code_cells(notebook) for output in cell.outputs]
    assert outputs
    assert [output for output in outputs if output.output_type == "error" or output.get("name") == "stderr"] == []


@each_notebook
def test_every_kept_notebook_holds_the_outputs_of_one_run_from_top_to_bottom(path):
    notebook = read(path)
    counts = [cell["execution_count"] for cell in code_cells(notebook)]
    assert counts == list(range(1, len(counts) + 1))
    outputs = [output for cell in code_cells(notebook) for output in cell["outputs"]]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert [output for output in outputs if output["output_type"] == "error" or output.get("name") == "stderr"] == []


@each_notebook
def test_every_kept_notebook_is_small_and_names_no_machine(path):
    notebook = read(path)
    assert path.stat().st_size < LARGEST
    assert notebook["metadata"]["kernelspec"]["name"] == "python3"
    assert MACHINE_PATH.findall(without_pictures(notebook)) == []


@each_notebook
def test_no_notebook_defines_what_belongs_in_the_package(path):
    source = "\n".join("".join(cell["source"]) for cell in code_cells(read(path)))
    defined = re.findall(r"^\s*(?:async\s+def|def|class)\s+(\w+)", source, flags=re.MULTILINE)
    assert defined == OWN.get(path.stem, [])
