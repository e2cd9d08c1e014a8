"""`bayespbrl results`: the tables of a study in Markdown and CSV, and its figures, beside its data."""

import shutil
import warnings
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas as pd

from bayespbrl.envs.names import check_permission
from bayespbrl.figures import png
from bayespbrl.results.figures import curves_figure, profiles_figure
from bayespbrl.results.predictions import write_predictions
from bayespbrl.results.study_data import StudyData, read_study
from bayespbrl.results.tables import (
    MISSING,
    calibration_table,
    kept_table,
    markdown,
    pairs_table,
    runs_table,
    values_table,
)
from bayespbrl.runs.files import write_file
from bayespbrl.studies.declaration import parsed
from bayespbrl.studies.study import Study, read_study_json

TITLES = {
    "values": "Values",
    "kept": "The kept policies",
    "pairs": "Answers needed, in pairs of trials",
    "calibration": "Calibration of the predicted answers",
    "runs": "Settings, convergence and updates of the runs",
}

NOTES = {
    "values": "value of the kept policy at the end of a trial, and after so many answers, median [lower quartile]. "
    "Relative value: 0 is the random policy, 1 the median of the reference runs on the hidden reward. Seeds left out: "
    "their trials met no preference at first and were drawn again, were given up, or are not finished. Difference: "
    "median difference in pairs of the same seed, against the first method with the same noise and variant (of the "
    "first method: against its first noise), after the answers that both were allowed; a trial that ended with fewer "
    "keeps its policy. p values (Wilcoxon) are adjusted for the comparisons of the table by Holm, and by Benjamini and "
    "Hochberg (false discovery). Brackets elsewhere: 95 % intervals, bootstrap over trials, of failed trials exact "
    "(Clopper and Pearson).",
    "kept": "value, median [lower quartile], of the policy that a run keeps, of its newest, and of the best of the "
    "run, which only the hidden reward knows. Within 3 % of the best: of what that gains over the random policy. "
    "The highest of some thirty evaluations is also the luckiest, so where episodes differ this counts too few.",
    "pairs": "pairs of the same seed: in how many the trial needed fewer answers than the one it is compared with, and "
    "more; in all, until its kept policy is better than the value, and until it stays so. p: two-sided sign tests, not "
    "adjusted for their number.",
    "calibration": "each answer was predicted before it was given. `z` below −2: overconfident, above 2: "
    "underconfident. ECE: expected calibration error, and that of calibrated predictions, by chance.",
    "runs": "fits: posteriors over all trials and iterations. ESS: effective sample size of what mixes worst. Signal, "
    "KL: medians over updates. Minutes: of estimates, updates and evaluations, without those of the "
    "trajectories shown and of choosing the questions.",
}  # what the columns of a table mean


def columns_of(names: Iterable[str]) -> str:
    """What the columns of these tables mean, an item each."""
    return "\n".join(f"- **{TITLES[name]}**: {NOTES[name]}" for name in names)


def refreshed(directory: Path, out: Path, *, import_package: bool = False) -> tuple[StudyData, list[str]]:
    """The data of a study, from its run directories where this version made them.

    Args:
      directory: of the study.
      out: where its tables are written anew, if they are: `directory`, or a folder of their own, which leaves it as it
        is.
      import_package: as of `write_results`.

    Returns:
      the data, and what could not be read, a line each: what the tables had of it stands.
    """
    unread = []
    description = read_study_json(directory)
    declaration = parsed(
        (directory / "study.toml").read_text(encoding="utf-8"), str(description.get("study", directory.name))
    )
    ours = description.get("version") == version("bayespbrl")
    if ours and any((directory / row.name).is_dir() for row in declaration.rows):
        for row in () if import_package else declaration.rows:
            check_permission(row.env, directory)
        trials = description.get("trials")
        try:
            study = Study.prepare(declaration, directory, trials=trials if isinstance(trials, int) else None)
        except ValueError as error:  # as of presets that have changed since
            if not (directory / "iterations.csv").exists():
                raise
            return read_study(directory), [f"the run directories: {error}"]
        study.write_table(out)
        unread = [f"{seeds.row.path(seed)}: {why}" for seeds in study.rows for seed, why in seeds.damaged.items()]
        unread += write_predictions(study, out)
    if out == directory or not (out / "iterations.csv").exists():
        return read_study(directory), unread
    for name in ("study.json", "study.toml"):
        shutil.copy(directory / name, out / name)
    return read_study(out), unread


def tables_of(data: StudyData) -> dict[str, pd.DataFrame]:
    """The non-empty tables of a study, by name."""
    makers = {
        "values": values_table,
        "kept": kept_table,
        "pairs": pairs_table,
        "calibration": calibration_table,
        "runs": runs_table,
    }
    tables = {name: make(data) for name, make in makers.items()}
    return {name: table for name, table in tables.items() if len(table)}


def titled(data: StudyData, name: str, table: pd.DataFrame) -> str:
    """A table in Markdown under its title, with the number of its comparisons."""
    compared = int((table["p (Holm)"] != MISSING).sum()) if "p (Holm)" in table else 0
    number = {0: "", 1: "; one comparison"}.get(compared, f"; p values adjusted for {compared} comparisons")
    return f"**{TITLES[name]}** (study `{data.name}`{number})\n\n{markdown(table)}"


def write_results(directory: Path | str, out: Path | str | None = None, *, import_package: bool = False) -> list[Path]:
    """Write `results.md`, a CSV for each table and the figures of a study.

    Args:
      directory: of the study, or of its four data files.
      out: where to write; None: into `directory`. Otherwise `directory` stays as it is.
      import_package: whether a package that an environment's name has, as "package:Env-v0", may be imported.

    Returns:
      the files, `results.md` first.

    Raises:
      ValueError: no study, none of its trials finished, or damaged data.
    """
    directory = Path(directory)
    with TemporaryDirectory() as aside:
        data, unread = refreshed(directory, directory if out is None else Path(aside), import_package=import_package)
    if unread:
        warnings.warn(f"not read: {'; '.join(unread)}", stacklevel=2)
    out = Path(directory if out is None else out)
    out.mkdir(parents=True, exist_ok=True)
    written, tables = [], tables_of(data)
    sections = [f"# {data.declaration.title}", data.source]
    if unread:
        sections.append("Not read, so that only what the tables had of it counts:")
        sections.append("\n".join(f"- {line}" for line in unread))
    for name, table in tables.items():
        written.append(out / f"{name}.csv")
        write_file(written[-1], table.to_csv(index=False, lineterminator="\n"))
        sections.append(titled(data, name, table))
    sections.append(columns_of(tables))
    for name, figure in (("curves", curves_figure(data)), ("profiles", profiles_figure(data))):
        if figure is not None:
            written.append(out / f"{name}.png")
            write_file(written[-1], png(figure))
            sections.append(f"![{name}]({name}.png)")
    write_file(out / "results.md", "\n\n".join(sections) + "\n")
    return [out / "results.md", *written]
