"""The diagnostic report of a run: one self-contained file that a person reads from top to bottom."""

from collections.abc import Callable
from datetime import datetime
from importlib.metadata import version
from importlib.resources import files
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from bayespbrl.diagnostics.report import answers, sections, summary, tables, utility, warnings
from bayespbrl.diagnostics.report.contents import Evidence, read_evidence
from bayespbrl.diagnostics.report.document import Comparison, Picture, Section

FORMATS = ("html", "md")


def write_report(directory: Path | str, *, format: str = "html", env: Any = None, features: Any = None) -> Path:
    """Write the report of a run into its directory; nothing else there is changed.

    Args:
      directory: of a run: finished, in progress, or with files that cannot be read, which the report then says.
      format: `html`, one file with its pictures in it, `report.html`; or `md`, `report.md` with its pictures in
        `report_files/`.
      env, features: what the run was started with, where these were objects of the user's; what needs them is left out,
        and said to be, without them.

    Returns:
      the path of the file.

    Raises:
      ValueError: a format there is not; a directory that is no run, is one of a newer version, or cannot be written.
    """
    if format not in FORMATS:
        raise ValueError(f"format: expected {' or '.join(FORMATS)}, got {format!r}")
    content = assembled(read_evidence(directory, env=env, features=features))
    template = (
        files("bayespbrl.diagnostics.report")
        .joinpath("templates", f"report.{format}.jinja")
        .read_text(encoding="utf-8")
    )
    # what comes from a run (names, messages) is text and never markup
    engine = Environment(autoescape=format == "html", undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    engine.filters["groupby_adjacent"] = lambda blocks: [
        (kind, list(group)) for kind, group in groupby(blocks, key=attrgetter("kind"))
    ]
    engine.filters["cell"] = lambda text: str(text).replace("|", "\\|").replace("\n", " ")
    path = Path(directory) / f"report.{format}"
    try:
        if format == "md":
            _write_pictures(Path(directory) / "report_files", content["sections"])
        aside = path.with_name(path.name + ".part")
        aside.write_text(engine.from_string(template).render(**content), encoding="utf-8")
        aside.replace(path)
    except OSError as error:
        raise ValueError(f"{path}: cannot write the report there ({error})") from error
    return path


def assembled(evidence: Evidence) -> dict[str, Any]:
    """Everything that the templates name: facts, sentences, warnings and sections."""
    iterations = tables.iterations_table(evidence.iterations)
    answered = tables.answers_table(evidence)
    scores, ranking = tables.prequential_table(evidence), tables.ranking_table(evidence)
    failures: list[warnings.Caution] = []
    parts: list[tuple[str, Callable[[], Section]]] = [
        ("Learning curve", lambda: sections.learning(evidence, iterations)),
        ("Have the fits converged?", lambda: sections.fits(evidence, iterations)),
        ("What it thinks is good", lambda: utility.utility(evidence, ranking)),
        ("The answers", lambda: answers.answers(evidence, answered)),
        ("Are its probabilities right?", lambda: sections.calibration(evidence, scores)),
        ("The policy updates", lambda: sections.updates(evidence, iterations)),
        ("How much leans on σ and m", lambda: sections.leaning(evidence)),
        ("All iterations in figures", lambda: sections.numbers(iterations)),
    ]
    made = [_built(title, build, failures) for title, build in parts]
    return {
        "title": f"{evidence.settings.env}, {evidence.settings.utility}, seed {evidence.settings.seed}",
        "state": _state(evidence),
        "facts": _facts(evidence),
        "learnt": summary.learnt(evidence, iterations, answered, scores, ranking),
        "warnings": warnings.warnings(evidence, iterations, answered, scores) + failures,
        "sections": made,
        "made": f"Made by bayespbrl {version('bayespbrl')} on {datetime.now():%Y-%m-%d %H:%M} from {evidence.path}.",
    }


def _built(title: str, build: Callable[[], Section], failures: list[warnings.Caution]) -> Section:
    """A section, or one that says why it could not be made: whatever an environment or features of the user's raise."""
    try:
        return build()
    except Exception as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        failures.append(
            warnings.Caution(f"The section “{title}” could not be made ({reason}).", "The others are unaffected.")
        )
        name = "".join(letter for letter in title.lower() if letter.isalpha())
        return Section(name, title, [f"This section could not be made: {reason}."])


def _state(evidence: Evidence) -> str:
    done, wanted = len(evidence.iterations), evidence.settings.iterations
    if evidence.finished:
        return f"Finished: {done} iterations."
    waiting = "" if evidence.waiting is None else f" Question {evidence.waiting} waits for an answer."
    text = f"In progress: {done} of {wanted} iterations.{waiting} "
    if evidence.settings.own_parts:
        return text + f"bayespbrl.resume({str(evidence.path)!r}) goes on in Python, given what was the user's own."
    return text + f"bayespbrl resume {evidence.path} goes on."


def _facts(evidence: Evidence) -> list[tuple[str, str]]:
    settings = evidence.settings
    expert = settings.expert + (f", {settings.wrong_answers:.0%} wrong" if settings.wrong_answers else "")
    return [
        ("likelihood", settings.likelihood),
        ("prior scale σ", f"{evidence.fitted_with('prior_scale'):g}"),
        ("steepness m", f"{evidence.fitted_with('steepness'):g}"),
        ("lapse rate λ", f"{evidence.fitted_with('lapse_rate'):g}"),
        ("KL bound ε", f"{settings.kl_bound:g}"),
        ("updates an iteration, at most", str(settings.updates_per_iteration)),
        ("iterations in a row without a question, at most", str(settings.unasked_iterations)),
        ("discount γ of Q", f"{settings.discount:g}"),
        ("discount γ of ψ", f"{settings.psi_discount:g}"),
        ("policy", settings.policy),
        ("expert", expert),
        ("schedule", settings.schedule),
        ("query", settings.query),
        ("hyperparameters", settings.hyperparameters),
    ]


def _write_pictures(folder: Path, sections: list[Section]) -> None:
    folder.mkdir(exist_ok=True)
    for section in sections:
        for block in section.blocks:
            pictures = (
                block.pictures if isinstance(block, Comparison) else (block,) if isinstance(block, Picture) else ()
            )
            for picture in pictures:
                (folder / f"{picture.name}.png").write_bytes(picture.png)
