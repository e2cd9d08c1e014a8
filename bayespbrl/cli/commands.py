"""The command line: `bayespbrl run`, `resume`, `ask`, `report`, `trials`, `study`, `results`."""

import inspect
import shutil
import sys
from collections.abc import Callable
from contextlib import nullcontext
from functools import wraps
from importlib.metadata import version
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from bayespbrl import checks
from bayespbrl.cli.compiled import keep_compiled
from bayespbrl.cli.display import (
    PICTURE,
    ask_on_page,
    check_expert,
    console,
    progress_bar,
    run_to_the_end,
    show_run,
    show_trials,
)
from bayespbrl.cli.opening import Place
from bayespbrl.cli.studies import run_study, show_plan
from bayespbrl.envs import SHORT_NAMES
from bayespbrl.experts import SIMULATED
from bayespbrl.improvement.schedules import SCHEDULES
from bayespbrl.models.likelihoods import LIKELIHOODS
from bayespbrl.policies.choice import POLICIES
from bayespbrl.queries import QUERY_RULES
from bayespbrl.runs import run as runs
from bayespbrl.runs.directory import RunDirectory
from bayespbrl.runs.lock import continuing
from bayespbrl.settings import OPTIONS, PARTS, Settings
from bayespbrl.settings.presets import DEFAULT
from bayespbrl.studies import Study, declared, run_trials
from bayespbrl.studies.cluster import scheduler_executor
from bayespbrl.utility.inference import METHODS

app = typer.Typer(
    help="Preference-based reinforcement learning: a policy from answers to 'which of these two is better?'.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

Answerer = Annotated[
    list[str] | None,
    typer.Option(
        help="Name or pseudonym of the person who answers, kept with each answer and its time. Repeat the option "
        "for several people who answer on pages at once: each gets an address and a question of their own."
    ),
]
Practice = Annotated[
    bool,
    typer.Option(help="Show instructions and two practice questions to a person who is new to this run."),
]
Browser = Annotated[
    bool,
    typer.Option(
        help="Open the page in the browser: only for one person, at a terminal with a display, and not over SSH."
    ),
]
ImportPackage = Annotated[
    bool,
    typer.Option("--import-package", help="Import the package that the run's environment names; this runs its code."),
]
Env = Annotated[
    str, typer.Argument(help=f"{', '.join(SHORT_NAMES)}, or any gymnasium id, as Pendulum-v1, or Pendulum-v1,g=9.81.")
]


# The options of a run and of each trial, with their help. One left out has the value of the environment's preset.
RUN_OPTIONS = {
    "answers": "Budget: maximum number of answers, ties included; by default 20, and the iterations follow from it. "
    "With --preset paper there is none unless given: the iterations decide.",
    "preset": "default (for any task) or paper (the paper's protocol, with its constant KL bound).",
    "utility": f"Estimate of the utility: {', '.join(METHODS)}. The last is a reference run trained on the hidden "
    "reward.",
    "query": f"Rule that selects the trajectories to ask about: {', '.join(QUERY_RULES)}. The default is "
    f"{DEFAULT['query']}, the paper's highest-utility.",
    "schedule": f"KL bound of each update: {' or '.join(SCHEDULES)}. The default, {DEFAULT['schedule']}, scales it "
    "with the confidence that the update is an improvement; the paper's is constant.",
    "hyperparameters": "Length scales, steepness and lapse rate: inferred (part of the posterior, unless --steepness "
    "or --lapse-rate sets one) or given (as set, or the paper's).",
    "iterations": "Maximum number of cycles of the four steps; by default they follow from the answers.",
    "kl_bound": "KL bound of each policy update, in nats, with the schedule constant; with confidence only a cap while "
    "the posterior has not converged.",
    "updates_per_iteration": "Maximum number of policy updates per iteration; the paper's is 1.",
    "clip_steps": "Steps of the random part of each trajectory that a question shows; all of it if omitted.",
    "same_start": "Compare two trajectories from the same start, where resets of the environment by seed allow it.",
    "unasked_iterations": "How many iterations in a row ask nothing while the posterior is sure, with the schedule "
    "confidence (at most half the answers so far); more follow where no question is worth an answer. 0 in the paper "
    "and for people.",
    "likelihood": f"Likelihood of an answer: {', '.join(LIKELIHOODS)}. The default, mixed, is eq. 8.",
    "prior_scale": "Prior standard deviation of each utility weight.",
    "steepness": "Steepness of the likelihood, for feature differences of root mean square length 1; inferred if "
    "omitted, or 5 with --hyperparameters given.",
    "lapse_rate": "Share of answers modelled as given at random, in [0, 1); inferred if omitted, or 0 with "
    "--hyperparameters given.",
    "discount": "Discount of Q, in [0, 1); by default by the horizon, within 0.98 and 0.995; the paper's is 0.98.",
    "trajectory_discount": "Discount of the trajectory features, in [0, 1]: 1 by default, because experts judge whole "
    "trajectories. The paper's is the discount of Q, which gridworld, bicycle and acrobot have by default too, and "
    "with --preset paper all tasks but swing-up, Pendulum-v1 and CartPole-v1.",
    "wrong_answers": "Share of the simulated expert's answers that are reversed, in [0, 1].",
    "policy": f"Kind of policy: auto, {', '.join(POLICIES)}.",
    "centres": "Number of radial basis functions of each kind of feature.",
    "max_steps": "Maximum steps per episode; the environment's limit if omitted.",
    "repeats": "Share of the questions that repeat an earlier one with sides swapped, to measure how consistent a "
    "person is; 0.1 for people, 0 for a simulated expert and with --preset paper.",
    "shared_repeats": "Let repeated questions be other people's too, so that the report tells how well people agree.",
    "expert": "Who answers: return (simulated, always right), page (you, in a browser), terminal (you, at the prompt), "
    "or a simulated expert who errs: stochastic, myopic, skipping, equal, mistaken (B-Pref's teachers) or margin "
    "(the error model of Programming by Feedback).",
}


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"bayespbrl {version('bayespbrl')}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None: ...


def _takes_run_options(command: Callable[..., None]) -> Callable[..., None]:
    """`command` with a parameter for each of `RUN_OPTIONS`, of the type that its part of the settings has.

    It gets those that are on the command line.
    """
    env, *named = (p for p in inspect.signature(command).parameters.values() if p.kind is not p.VAR_KEYWORD)
    options = []
    for name, text in RUN_OPTIONS.items():
        kind = get_type_hints(PARTS.get(OPTIONS[name], Settings))[name] | None
        given = {"default": None, "annotation": Annotated[kind, typer.Option(help=text)]}
        options.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, **given))

    @wraps(command)
    def with_given(**values: Any) -> None:
        command(**{name: value for name, value in values.items() if value is not None or name not in RUN_OPTIONS})

    vars(with_given)["__signature__"] = inspect.Signature([env, *options, *named])
    return with_given


@app.command()
@_takes_run_options
def run(
    env: Env,
    *,
    seed: Annotated[int, typer.Option(help="Seed of every random choice.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Run directory; a new one under runs/ if omitted.")] = None,
    answerer: Answerer = None,
    practice: Practice = True,
    browser: Browser = True,
    **options: Any,
) -> None:
    """Learn a task from preferences; the run is kept in a directory."""
    check_expert(options.get("expert"), answerer or [])
    for name, wanted in (("practice", practice), ("browser", browser)):
        if not wanted and (expert := options.get("expert")) != "page":
            raise ValueError(
                f"{name}: expected --no-{name} only with the expert page, got the expert {expert or 'return'}"
            )
    learner = runs.start(env, out, seed=seed, **options)
    assert isinstance(learner.log, RunDirectory)
    directory = out or learner.log.path.relative_to(Path.cwd())
    with continuing(directory):
        place = Place(browser=browser)
        try:
            run_to_the_end(learner, directory, answerers=answerer or [], practice=practice, place=place)
        except ValueError:  # no simulated expert can be made where all returns are equal, say
            if not learner.trajectories:
                shutil.rmtree(directory)
            raise


@app.command()
def resume(
    directory: Annotated[Path, typer.Argument(help="Directory of an interrupted run.")],
    *,
    answerer: Answerer = None,
    import_package: ImportPackage = False,
) -> None:
    """Continue an interrupted run; no question is asked twice."""
    with continuing(directory):
        learner = runs.resume(directory, import_package=import_package)
        if not learner.finished:
            check_expert(learner.settings.expert, answerer or [])
            run_to_the_end(learner, directory, answerers=answerer or [])
        elif not (directory / PICTURE).exists():  # interrupted before it was drawn, or run in Python
            show_run(learner, directory)
        else:
            console.print(f"{directory}: this run is finished; there is nothing left to do.")


@app.command()
def ask(
    directory: Annotated[Path, typer.Argument(help="Directory of a run that a person answers.")],
    *,
    answers: Annotated[int | None, typer.Option(help="Maximum number of answers in this sitting.")] = None,
    answerer: Answerer = None,
    practice: Practice = True,
    host: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0 accepts other machines.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on; a free one if omitted.")] = 0,
    browser: Browser = True,
    import_package: ImportPackage = False,
) -> None:
    """Ask a person the questions of a run on a page in the browser; repeat the command to go on later."""
    with continuing(directory):
        learner = runs.resume(directory, import_package=import_package)
        if learner.finished:
            raise ValueError(f"{directory}: expected a run with questions left, got a finished run")
        if (expert := learner.settings.expert) in SIMULATED:
            raise ValueError(f"{directory}: expected a run that a person answers, got the simulated expert {expert}")
        options: dict[str, Any] = {"answers": answers, "answerers": answerer or [], "practice": practice}
        ask_on_page(learner, directory, **options, place=Place(host, port, browser))


@app.command()
def report(
    directory: Annotated[Path, typer.Argument(help="Directory of a run: finished, in progress or damaged.")],
    format: Annotated[str, typer.Option(help="html (one file) or md (with a folder of pictures).")] = "html",
    import_package: ImportPackage = False,
) -> None:
    """Write the diagnostic report of a run into its directory."""
    from bayespbrl.diagnostics.report import write_report

    console.print(f"Report: {write_report(directory, format=format, import_package=import_package)}")


@app.command()
@_takes_run_options
def trials(
    env: Env,
    *,
    number: Annotated[int, typer.Option("--trials", help="Number of trials, one per seed.")] = 20,
    jobs: Annotated[int, typer.Option(help="Number of trials at a time, each in its own process.")] = 1,
    seed: Annotated[int, typer.Option(help="Seed of the first trial.")] = 1000,
    out: Annotated[Path | None, typer.Option(help="Directory of the study; under runs/ if omitted.")] = None,
    **options: Any,
) -> None:
    """Run many seeds and print median and quartiles of the value; finished trials are not repeated."""
    checks.whole("trials", number)
    utility = options.get("utility") or "posterior-mean"
    directory = out or Path("runs") / f"trials-{env.replace('/', '-').lower()}-{utility}"
    with progress_bar() as bar:
        task = bar.add_task("trials", total=number, state=f"{directory}")
        try:
            seeds = range(seed, seed + number)
            study = run_trials(env, directory, seeds=seeds, jobs=jobs, progress=lambda _: bar.advance(task), **options)
        except KeyboardInterrupt:
            console.print("Stopped. Nothing is lost: repeat the command to continue.")
            raise
        bar.update(task, completed=number)
    show_trials(study, options.get("max_steps"))


Scheduler = Annotated[str | None, typer.Option(help="Address of a Dask scheduler, such as tcp://host:8786.")]


@app.command()
def study(
    name: Annotated[str, typer.Argument(help="A shipped study, or a TOML file.", metavar="NAME|FILE.toml")],
    *,
    number: Annotated[int | None, typer.Option("--trials", help="Trials of each row; as declared if omitted.")] = None,
    jobs: Annotated[int, typer.Option(help="Number of trials at a time, each in its own process.")] = 1,
    scheduler: Scheduler = None,
    out: Annotated[Path | None, typer.Option(help="Directory of the study; runs/study-NAME if omitted.")] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the number of cells and the estimated time; run nothing.")
    ] = False,
) -> None:
    """Run a declared study: tasks, methods, noise, seeds. Finished cells are not repeated."""
    checks.whole("jobs", jobs)
    if scheduler and jobs > 1:
        raise ValueError(f"jobs: expected none with a scheduler, whose workers run the trials, got {jobs}")
    declaration = declared(name)
    prepared = Study.prepare(declaration, out or Path("runs") / f"study-{declaration.name}", trials=number)
    show_plan(prepared, jobs)
    if dry_run:
        return
    options = f" --trials {number}" if number is not None else ""
    options += f" --scheduler {scheduler}" if scheduler else f" --jobs {jobs}"
    with scheduler_executor(scheduler) if scheduler else nullcontext(jobs) as where:
        failures = run_study(prepared, where, f"bayespbrl study {name}{options}")
    if failures:
        raise ValueError(f"{len(failures)} of {prepared.cells} trials failed; the first: {failures[0]}")


@app.command()
def results(
    directories: Annotated[list[Path], typer.Argument(help="Directories of studies.", metavar="DIR...")],
    *,
    out: Annotated[
        Path | None, typer.Option(help="Where to write, the study staying as it is; into its directory if omitted.")
    ] = None,
    import_package: ImportPackage = False,
) -> None:
    """Write tables (Markdown, CSV) and figures of studies, with intervals and counted comparisons."""
    from bayespbrl.results import write_results

    names = [directory.resolve().name for directory in directories]
    if out is not None and (again := sorted({name for name in names if names.count(name) > 1})):
        raise ValueError(
            f"out: expected studies in directories of different names, got {', '.join(again)} more than once"
        )
    for directory, name in zip(directories, names, strict=True):
        folder = out / name if out is not None and len(directories) > 1 else out
        page, *others = write_results(directory, folder, import_package=import_package)
        console.print(f"Results: {page}; {', '.join(path.name for path in others)}")


def main() -> None:
    """Entry point. Bad input gives one line on standard error and exit status 2."""
    keep_compiled()
    for stream in (sys.stdout, sys.stderr):  # R̂ in a file that is not UTF-8
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        status = app(standalone_mode=False)
    except (ValueError, OSError) as error:
        status = _print_error(str(error))
    except MemoryError as error:
        status = _print_error(f"memory: expected less to be asked for, got {error or 'no more'}")
    except (KeyboardInterrupt, typer.Abort):
        status = 130
    except typer.Exit as stop:
        status = stop.exit_code
    except Exception as error:
        if not hasattr(error, "format_message"):  # Typer's usage errors, whose common class it does not export
            raise
        status = _print_error(error.format_message())
    sys.exit(status if isinstance(status, int) else 0)


def _print_error(message: str) -> int:
    print(f"bayespbrl: {checks.one_line(message)}", file=sys.stderr)
    return 2
