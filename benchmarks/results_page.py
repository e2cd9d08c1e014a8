"""RESULTS.md from the committed data: written, or compared with what the data give.

    python benchmarks/results_page.py            # writes RESULTS.md and the studies' figures
    python benchmarks/results_page.py --check    # compares its text, and runs one cell of each study again

The text is `benchmarks/RESULTS.md.jinja`; the tables are of the studies in `benchmarks/studies` (the four data files of
each, as `bayespbrl study` and `bayespbrl results` leave them).
"""

import argparse
import difflib
import os
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import earlier_version
import jinja2
import numpy as np
import pandas as pd

from bayespbrl.results.figures import curves_figure, profiles_figure
from bayespbrl.results.study_data import RowData, StudyData, read_study
from bayespbrl.results.tables import MISSING, markdown
from bayespbrl.results.write import NOTES, columns_of, tables_of, titled
from bayespbrl.runs.directory import read_summary
from bayespbrl.studies.baseline_trials import read_baseline
from bayespbrl.studies.declaration import declared
from bayespbrl.studies.machine import rounding
from bayespbrl.studies.processes import trial_processes
from bayespbrl.studies.rows import row_of, run_trial
from bayespbrl.utility.inference import WITHOUT_POSTERIOR

HERE = Path(__file__).parent
PAGE = HERE.parent / "RESULTS.md"
STUDIES, PUBLISHED = HERE / "studies", HERE / "published"
TOLERANCE = 1e-5  # relative: the data have six digits
# Of a cell that is run again on another machine: rounding does not show in the first iteration, and little in the
# second (2e-5 of the value in `levers`, on a processor of another kind).
EXACT_ITERATIONS, ROUNDED = 2, 1e-3
# On another processor the value of its first iteration is off already, by 0.002 of itself.
ROUNDED_AT_ONCE = ("reacher",)
# Seconds, as committed, of the iterations that are run again; the rest of a trial that took longer is not.
LONGEST = 200.0


def committed() -> dict[str, StudyData]:
    """The studies with data, by name."""
    return {path.parent.name: read_study(path.parent) for path in sorted(STUDIES.glob("*/study.json"))}


def page(studies: dict[str, StudyData]) -> str:
    """The text of RESULTS.md."""

    def tables(name: str, *kinds: str) -> str:
        if name not in studies:
            title = declared(name).title
            return f"**Not run yet.** `bayespbrl study {name}`: {title}. `--dry-run` says how long it takes."
        found = tables_of(studies[name])
        shown = [titled(studies[name], kind, found[kind]) for kind in kinds if kind in found]
        return "\n\n".join([studies[name].source, *shown])

    def figures(name: str) -> str:
        made = [kind for kind, make in FIGURES.items() if name in studies and make(studies[name]) is not None]
        return "\n".join(f"![{kind} of the study {name}](benchmarks/studies/{name}/{kind}.png)" for kind in made)

    def beside(name: str, task: str, file: str, unit: float) -> str:
        return published(studies[name], task, file, unit) if name in studies else ""

    def beside_earlier_version() -> str:
        name = "earlier-version"
        return markdown(earlier_version.table(STUDIES / name, HERE / "results")) if name in studies else ""

    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, keep_trailing_newline=True, autoescape=False)
    template = environment.from_string((HERE / "RESULTS.md.jinja").read_text())
    functions = {
        "tables": tables,
        "figures": figures,
        "beside": beside,
        "beside_earlier_version": beside_earlier_version,
    }
    return template.render(**functions, columns=columns_of(NOTES))


FIGURES = {"curves": curves_figure, "profiles": profiles_figure}


def published(data: StudyData, task: str, file: str, unit: float) -> str:
    """Medians and quartiles of a published curve and, after as many answers, of the rows of a task, over `unit`."""
    lines = []
    for _, known in pd.read_csv(PUBLISHED / file).iterrows():
        line = {"answers": f"{known['answers']:g}"}
        line["published"] = _quartiles(known["lower"], known["median"], known["upper"])
        for row in data.of_task(task):
            if not row.declared.untrained:
                values = row.at(known["answers"])
                shown = MISSING if values is None else _quartiles(*np.quantile(values / unit, [0.25, 0.5, 0.75]))
                line[f"{row.declared.name.partition('/')[2]}, here"] = shown
        lines.append(line)
    return markdown(pd.DataFrame(lines))


def _quartiles(low: float, middle: float, high: float) -> str:
    return f"{middle:.3f} [{low:.3f} … {high:.3f}]"


def write_figures(studies: dict[str, StudyData]) -> None:
    """The figures of each study, beside its data."""
    for name, data in studies.items():
        for kind, make in FIGURES.items():
            if (figure := make(data)) is not None:
                figure.savefig(STUDIES / name / f"{kind}.png", dpi=90)


def cheapest(data: StudyData) -> RowData | None:
    """The row whose trials take the least time, of what the study is about; None where none learns.

    That is a baseline where it has one, else a method with a posterior; and on the Gridworld where that is a task, for
    there the rounding of another processor shows last (on the Acrobot of `paper` in the first iteration).
    """
    learned = [row for row in data.rows if not row.declared.untrained]
    chosen = [row for row in learned if row.declared.baseline is not None] or [
        row for row in learned if row.declared.options.get("utility") not in WITHOUT_POSTERIOR
    ]
    chosen = [row for row in chosen if row.declared.env == "gridworld"] or chosen
    return min(chosen or learned, key=lambda row: float(row.lines["seconds"].sum() / len(row.seeds)), default=None)


def repeated(row: RowData) -> int | None:
    """How many iterations of a row's first trial are run again, those of its first `LONGEST` seconds; None: all.

    A baseline's trial is run whole.
    """
    seconds = row.lines.loc[row.lines["seed"] == row.seeds[0], "seconds"].cumsum()
    number = max(EXACT_ITERATIONS, int((seconds <= LONGEST).sum()))
    return None if row.declared.baseline is not None or number >= len(seconds) else number


def again(row: RowData, processes: Executor) -> list[dict[str, Any]]:
    """The iterations of the first trial of a row, run anew in one of the processes, as many as are `repeated`."""
    seed, most = row.seeds[0], repeated(row)
    with tempfile.TemporaryDirectory() as folder:
        learner = row_of(row.declared.env, Path(folder) / "row", row.declared.options, seed=seed)
        cell = replace(learner, baseline=row.declared.baseline)
        processes.submit(run_trial, cell, seed, iterations=most).result()
        entries: list[dict[str, Any]]
        entries = (read_summary if cell.baseline is None else read_baseline)(cell.path(seed))["iterations"]
        return entries[:most]


def differences_of_a_cell(data: StudyData, processes: Executor) -> list[str]:
    """What differs where the first trial of the cheapest row is run again; empty where nothing does.

    A study of another version is not run again: it would differ. Another processor or library rounds sums otherwise,
    and learning makes much of it: there, what differs only after the first iterations, or hardly in the second, is
    printed, and is no difference; nor is the KL. Some differ at once: `ROUNDED_AT_ONCE`, and with a smooth utility of
    discrete states all, because eigenvectors of equal eigenvalues are turned otherwise there, and with them the draws.
    """
    row = cheapest(data)
    if row is None or data.description.get("version") != version("bayespbrl"):
        print(f"study {data.name}: nothing is run again (version {data.description.get('version')}).")
        return []
    seed, entries = row.seeds[0], again(row, processes)
    most = repeated(row)
    kept = row.lines[row.lines["seed"] == seed].iloc[:most]
    where = f"study {data.name}, {row.declared.name}, seed {seed}"
    parts = [data.description, *data.description.get("earlier", [])]
    same = all(part.get("rounding") == rounding() for part in parts)  # studies that began before it was kept have none
    found = [
        (
            entry["iteration"],
            abs(expected - float(entry[name])) / max(abs(expected), 1e-9),
            f"{where}, iteration {entry['iteration']}: expected {name} {expected}, got {entry[name]}",
        )
        for entry, (_, line) in zip(entries, kept.iterrows(), strict=False)
        for name in ("answers", "value", "value_newest", *(["kl"] if same else []))
        if name in entry
        and not np.isclose(expected := float(line[name]), float(entry[name]), rtol=TOLERANCE, atol=1e-9)
    ]
    at_once = bool(row.declared.options.get("diffusion_utility")) or data.name in ROUNDED_AT_ONCE
    by_rounding = (number > EXACT_ITERATIONS or at_once or (number > 1 and off < ROUNDED) for number, off, _ in found)
    if found and not same and all(by_rounding):
        print(f"{where}: iterations before {found[0][0]} are as kept; from there on this machine's rounding shows.")
        return []
    if not found and len(entries) != len(kept):
        found = [(0, np.inf, f"{where}: expected {len(kept)} iterations, got {len(entries)}")]
    if not found:
        print(f"{where}: as kept{'' if most is None else f' in its first {most} iterations'}.")
    return [text for *_, text in found]


def check(studies: dict[str, StudyData], page_file: Path = PAGE) -> list[str]:
    """What differs between RESULTS.md, the data and the software."""
    kept = page_file.read_text().splitlines()
    found = list(
        difflib.unified_diff(kept, page(studies).splitlines(), "RESULTS.md", "from the data", lineterm="", n=0)
    )
    # with as many threads of linear algebra as in a study: others round sums otherwise
    cores = os.cpu_count() or 1
    with trial_processes(cores) as processes, ThreadPoolExecutor(cores) as threads:
        for differences in threads.map(partial(differences_of_a_cell, processes=processes), studies.values()):
            found += differences
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Write or check the page; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="compare only")
    studies = committed()
    if not parser.parse_args(arguments).check:
        write_figures(studies)
        PAGE.write_text(page(studies))
        return 0
    found = check(studies)
    print("\n".join(found) if found else f"RESULTS.md follows from the data; {len(studies)} studies checked.")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
