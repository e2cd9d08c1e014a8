"""The diagnostic report of a run: read the run, assemble the report, write it as one file."""

from collections.abc import Callable
from datetime import datetime
from importlib.metadata import version
from importlib.resources import files
from itertools import groupby
from operator import attrgetter
from pathlib import Path

import gymnasium
from gymnasium.experimental.functional import FuncEnv
from jinja2 import Environment, StrictUndefined

from bayespbrl import checks
from bayespbrl.diagnostics.report import answers, sections, tables, utility
from bayespbrl.diagnostics.report.contents import RunContents, read_contents
from bayespbrl.diagnostics.report.document import Body, Comparison, Picture, Report, ReportWarning, Section
from bayespbrl.diagnostics.report.people import has_people, people_section
from bayespbrl.diagnostics.report.summary import summary
from bayespbrl.diagnostics.report.warnings import find_warnings
from bayespbrl.experts import SIMULATED
from bayespbrl.features import StateFeatures
from bayespbrl.runs.directory import command_to_continue
from bayespbrl.runs.files import check_folder, write_file


def write_report(
    directory: Path | str,
    *,
    format: str = "html",
    env: gymnasium.Env | FuncEnv | None = None,
    features: StateFeatures | None = None,
    import_package: bool = False,
) -> Path:
    """Write the report of a run into its directory, without changing anything else there.

    Args:
      directory: of a run: finished, in progress, or with files that cannot be read, which the report then names.
      format: `html`, one file with its pictures in it, `report.html`; or `md`, `report.md` with its pictures in
        `report_files/`.
      env, features: the objects that the run was started with, where these were your own. Without them the report
        leaves out what needs them, and says so.
      import_package: whether the package that the environment's name has may be imported (`bayespbrl.resume`).

    Returns:
      the path of the file.

    Raises:
      ValueError: an unknown format; a directory that is no run, is one of a newer version, or cannot be written.
    """
    checks.one_of("format", format, ("html", "md"))
    report = assembled(read_contents(directory, env=env, features=features, import_package=import_package))
    path = Path(directory) / f"report.{format}"
    try:
        if format == "md":
            check_folder(Path(directory) / "report_files")
            _write_pictures(Path(directory) / "report_files", report)
        write_file(path, _rendered(report, format))
    except OSError as error:
        raise ValueError(f"{path}: expected a place where the report can be written, got {error}") from error
    return path


def _rendered(report: Report, format: str) -> str:
    template = files("bayespbrl.diagnostics.report") / "templates" / f"report.{format}.jinja"
    # in HTML names and messages of a run are text, never markup; Markdown shows them as they are
    engine = Environment(autoescape=format == "html", undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    engine.filters["groupby_adjacent"] = lambda blocks: [
        (kind, list(group)) for kind, group in groupby(blocks, key=attrgetter("kind"))
    ]
    engine.filters["cell"] = lambda text: str(text).replace("|", "\\|").replace("\n", " ")
    return engine.from_string(template.read_text(encoding="utf-8")).render(vars(report))


def _write_pictures(folder: Path, report: Report) -> None:
    folder.mkdir(exist_ok=True)
    for block in (block for section in report.sections for block in section.blocks):
        pictures = block.pictures if isinstance(block, Comparison) else (block,) if isinstance(block, Picture) else ()
        for picture in pictures:
            write_file(folder / f"{picture.name}.png", picture.png)


def assembled(contents: RunContents) -> Report:
    """The report: facts, summary, warnings and sections."""
    iterations = tables.iterations_table(contents.iterations)
    answered = tables.answers_table(contents)
    scores, ranking = tables.prequential_table(contents), tables.ranking_table(contents)
    parts: list[tuple[str, str, Callable[[], Body]]] = [
        ("learning", "Learning curve", lambda: sections.learning_curve(contents, iterations)),
        ("convergence", "Convergence of the posterior", lambda: sections.convergence_of_fits(contents, iterations)),
        ("utility", "Inferred utility", lambda: utility.utility(contents, ranking)),
        ("answers", "Answers, most surprising first", lambda: answers.answers(contents, answered)),
        *([("people", "People", lambda: people_section(contents))] if has_people(contents) else []),
        ("calibration", "Calibration of the predictions", lambda: sections.calibration(contents, scores)),
        ("updates", "Policy updates", lambda: sections.updates(iterations)),
        ("sensitivity", "Sensitivity to prior and likelihood", lambda: sections.sensitivity_to_model(contents)),
        ("iterations", "All iterations", lambda: sections.all_iterations(iterations)),
    ]
    failures: list[ReportWarning] = []
    settings = contents.settings
    return Report(
        title=f"{settings.env}, {settings.estimation.utility}, seed {settings.seed}",
        state=_state(contents),
        facts=_facts(contents),
        sections=[_section(name, title, build, failures) for name, title, build in parts],
        summary=summary(contents, iterations, answered, scores, ranking),
        warnings=find_warnings(contents, iterations, answered, scores) + failures,
        made=f"Made by bayespbrl {version('bayespbrl')} on {datetime.now():%Y-%m-%d %H:%M} from {contents.path}.",
    )


def _section(name: str, title: str, build: Callable[[], Body], failures: list[ReportWarning]) -> Section:
    """A section, or one that says why it could not be made: the user's environment or features may raise anything."""
    try:
        return Section(name, title, *build())
    except Exception as error:
        reason = f"{type(error).__name__}: {checks.one_line(error)}"
        what = f"The section “{title}” could not be made ({reason})."
        failures.append(ReportWarning(what, "The other sections are unaffected."))
        return Section(name, title, [f"This section could not be made: {reason}."], [])


def _state(contents: RunContents) -> str:
    done, wanted = len(contents.iterations), contents.settings.with_confirmations
    if contents.finished:
        return f"Finished: {done} iterations."
    question = "" if contents.open_question is None else f" Question {contents.open_question} waits for an answer."
    text = f"In progress: {done} of at most {wanted} iterations.{question} "
    if contents.settings.own_parts:
        return text + f"Continue it in Python with bayespbrl.resume({str(contents.path)!r}) and your own objects."
    people = [name for name in contents.preferences.answerers if name is not None]
    expert = contents.settings.expert
    if expert in SIMULATED and people:  # the command would let the simulated expert answer the rest
        return text + f"Continue it in Python, as it was begun, with bayespbrl.resume({str(contents.path)!r})."
    if expert == "terminal":
        people = people[-1:]  # one at a time
    command = "ask" if expert == "page" else "resume"
    return text + f"Continue it with: {command_to_continue(command, contents.settings, contents.path, people)}"


def _facts(contents: RunContents) -> list[tuple[str, str]]:
    settings, model = contents.settings, contents.model
    expert = settings.expert + (f", {settings.wrong_answers:.0%} wrong" if settings.wrong_answers else "")
    return [
        ("likelihood", settings.model.likelihood),
        ("prior scale σ", f"{model.prior_scale:g}"),
        ("steepness m", "inferred" if model.steepness is None else f"{model.steepness:g}"),
        ("lapse rate λ", "inferred" if model.lapse_rate is None else f"{model.lapse_rate:g}"),
        ("KL bound ε", f"{settings.update.kl_bound:g}"),
        ("most updates per iteration", str(settings.update.updates_per_iteration)),
        ("most iterations in a row without a question, when sure", str(settings.questions.unasked_iterations)),
        ("discount γ of Q", f"{settings.critic.discount:g}"),
        ("discount γ of ψ", f"{settings.trajectory_discount:g}"),
        ("policy", settings.rollouts.policy),
        ("expert", expert),
        ("schedule", settings.update.schedule),
        ("query", settings.questions.query),
        ("hyperparameters", settings.estimation.hyperparameters),
    ]
