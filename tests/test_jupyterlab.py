"""The widget in JupyterLab, in a browser: a scripted person answers a whole run, and cells stay free."""

import json
import re
import socket
import subprocess
import sys
import urllib.request
from contextlib import suppress

import pytest
from playwright.sync_api import TimeoutError
from toys import QUICK, READY

import bayespbrl

KEYS = {"first": "ArrowLeft", "second": "ArrowRight", "tie": "ArrowDown"}
CELLS = [
    "import bayespbrl\n"  # a cell that may run twice, where a busy machine shows late that it runs
    "if 'learner' not in globals():\n"
    f"    learner = bayespbrl.start('gridworld', 'run', expert='other', **{QUICK!r})\n"
    "learner.widget()",
    "print('cells', 'stay', 'free')",
]


@pytest.fixture
def lab(tmp_path):
    """A JupyterLab server over a notebook of two cells: its address, and the folder."""
    empty = {"cell_type": "code", "execution_count": None, "metadata": {}, "outputs": []}
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    cells = [empty | {"id": f"cell{number}", "source": source} for number, source in enumerate(CELLS)]
    notebook = {"cells": cells, "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}
    (tmp_path / "people.ipynb").write_text(json.dumps(notebook))
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    options = ["--no-browser", "--allow-root", "--ServerApp.token=t", f"--port={port}", "--ServerApp.port_retries=0"]
    options += ["--expose-app-in-browser", "--LabApp.news_url=None", "--LabApp.check_for_updates_class="]
    options[-1] += "jupyterlab.handlers.announcements.NeverCheckForUpdate"
    options += ["--KernelManager.transport=ipc"]  # no TCP port that another may take before the kernel
    command = [sys.executable, "-m", "jupyterlab", *options]
    server = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        lines = iter(server.stdout.readline, "")
        assert any("is running at" in line for line in lines)
        yield f"http://127.0.0.1:{port}/lab/tree/people.ipynb?token=t", tmp_path
        urllib.request.urlopen(urllib.request.Request(f"http://127.0.0.1:{port}/api/shutdown?token=t", method="POST"))
        with suppress(subprocess.TimeoutExpired):  # what it still waits for without its kernels is not tested here
            server.communicate(timeout=20)
    finally:
        server.kill()
        server.communicate()


def close_dialogs(opened):
    """Whenever a dialog of JupyterLab is in the way, such as one about the kernel's connection, take what it offers."""

    def close(dialog):
        print("JupyterLab's dialog:", dialog.inner_text())
        dialog.locator(".jp-mod-accept").click()

    opened.add_locator_handler(opened.locator("dialog.jp-Dialog"), close)


def run_first_cell(opened):
    """Press the keys until the cell has a number or a star: a kernel that is only just there may miss them."""
    for again in range(6):
        opened.click(".jp-CodeCell >> nth=0 >> .cm-content")
        opened.keyboard.press("Control+Enter")
        try:
            opened.wait_for_selector(".jp-CodeCell >> nth=0 >> .jp-InputPrompt >> text=/\\[[*\\d]+\\]/", timeout=20_000)
            return
        except TimeoutError:
            assert again < 5


def give(opened, key, turn):
    """Press a key of the question, again where JupyterLab has taken the focus, as it may when a cell has ended."""
    for again in range(6):
        if again == 0 or opened.is_visible(f"{READY}[data-turn='{turn}']"):
            opened.keyboard.press(key)
        try:
            after = f"{READY}:not([data-turn='{turn}']), .bp-box[data-phase=finished]"
            opened.wait_for_selector(after, timeout=20_000)
            return
        except TimeoutError:
            assert again < 5
            opened.click(".bp-ask")


def practise(opened):
    """Begin the practice by the button, and answer its two questions by keys."""
    opened.click(".bp-box[data-phase=instructions][data-locked=false] [data-answer=begin]")
    for number in (1, 2):
        opened.wait_for_selector(f"{READY} >> text=Practice {number} of 2")
        opened.click(".bp-ask")
        give(opened, KEYS["tie"], opened.get_attribute(".bp-box", "data-turn"))
    opened.wait_for_selector(f"{READY} >> text=The practice is over")
    opened.click(".bp-ask")


@pytest.mark.slow
def test_a_scripted_person_answers_a_whole_run_in_jupyterlab(browser, lab):
    address, folder = lab
    expert = bayespbrl.ReturnExpert()
    plain = bayespbrl.Learner("gridworld", expert="other", **QUICK)
    opened = browser.new_page(viewport={"width": 1100, "height": 1000})
    opened.set_default_timeout(120_000)  # milliseconds; machines may be busy
    close_dialogs(opened)
    opened.goto(address)
    opened.wait_for_selector("[data-status=idle], .jp-Notebook-ExecutionIndicator[data-status=idle]")
    run_first_cell(opened)
    practise(opened)
    while questions := plain.ask():
        turn = opened.get_attribute(".bp-box", "data-turn")
        answer = str(expert(*questions[0].trajectories))
        give(opened, KEYS[answer], turn)
        plain.tell([answer])
        if plain.preferences.answers == 1:  # keys that JupyterLab would act on, and a cell while a question waits
            for key in ("a", "b", "x", "z"):
                opened.keyboard.press(key)
            opened.click(".jp-CodeCell >> nth=1 >> .cm-content")
            opened.keyboard.press("Control+Enter")
            opened.wait_for_selector("text=cells stay free")
            opened.click(".bp-ask")
    assert opened.locator(".jp-CodeCell").count() == len(CELLS)
    assert re.search("4 answers", opened.inner_text(".bp-ask"))
    assert bayespbrl.load(folder / "run").preferences == plain.preferences
