"""The command line: `bayespbrl run`, `resume`, `report`, `trials`."""

import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypedDict, Unpack, get_type_hints

import typer

from bayespbrl.cli.display import PICTURE, console, draw_trials, print_trials, progress_bar, run_to_the_end, show_run

app = typer.Typer(
    help="Preference-based reinforcement learning: a policy from answers to 'which of these two is better?'.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

Env = Annotated[str, typer.Argument(help="gridworld, bicycle, swing-up, acrobot, or any gymnasium id.")]


class RunOptions(TypedDict, total=False):
    """Of a run, and of each trial; where one is left out the preset of the environment decides."""

    utility: Annotated[
        str | None,
        typer.Option(help="posterior-mean, most-likely, posterior-draw, linear-program or known-reward (the ceiling)."),
    ]
    query: Annotated[
        str | None,
        typer.Option(
            help="highest-utility (the paper's), probably-better, thompson, information, disagreement or "
            "information-when-unsure."
        ),
    ]
    schedule: Annotated[
        str | None,
        typer.Option(help="constant (the paper's), or confidence: the bound follows the posterior's certainty."),
    ]
    hyperparameters: Annotated[
        str | None,
        typer.Option(
            help="evidence: length scales, steepness and lapse rate by the answers; averaged over the first two; or "
            "given."
        ),
    ]
    iterations: Annotated[int | None, typer.Option(help="Cycles of the four steps.")]
    kl_bound: Annotated[float | None, typer.Option(help="Bound on each policy update, in nats.")]
    updates_per_iteration: Annotated[
        int | None, typer.Option(help="Policy updates from the same trajectories and answers; the paper's is 1.")
    ]
    unasked_iterations: Annotated[
        int | None,
        typer.Option(
            help="Iterations in a row, at most, that ask nothing, and no more than half the answers so far: with the "
            "schedule confidence while it is sure, with constant always; 0 is the paper's."
        ),
    ]
    likelihood: Annotated[str | None, typer.Option(help="mixed (eq. 8), logistic or probit.")]
    prior_scale: Annotated[float | None, typer.Option(help="Prior standard deviation of a utility weight.")]
    steepness: Annotated[float | None, typer.Option(help="Of the likelihood, in units of the largest difference.")]
    lapse_rate: Annotated[float | None, typer.Option(help="Share of answers that the model takes for coin tosses.")]
    discount: Annotated[
        float | None, typer.Option(help="Of Q, and of ψ(τ) unless told, in [0, 1); the paper's is 0.98.")
    ]
    trajectory_discount: Annotated[
        float | None, typer.Option(help="Of ψ(τ), by which answers are explained, in [0, 1]; the paper's is that of Q.")
    ]
    wrong_answers: Annotated[float | None, typer.Option(help="Share of the simulated expert's answers turned round.")]
    policy: Annotated[str | None, typer.Option(help="auto, tabular, softmax, linear-gaussian or gaussian-process.")]
    centres: Annotated[int | None, typer.Option(help="Radial basis functions of each kind of feature.")]
    max_steps: Annotated[int | None, typer.Option(help="Steps an episode, in place of the environment's own limit.")]
    expert: Annotated[str | None, typer.Option(help="return (simulated) or terminal (you).")]


def _takes_run_options(command: Callable[..., None]) -> Callable[..., None]:
    """`command` with its `**options` spelled out one by one, as Typer wants them."""
    parameters = inspect.signature(command).parameters.values()
    named = [p for p in parameters if p.kind is not p.VAR_KEYWORD]
    options = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=kind)
        for name, kind in get_type_hints(RunOptions, include_extras=True).items()
    ]
    vars(command)["__signature__"] = inspect.Signature([named[0], *options, *named[1:]])
    return command


@app.command()
@_takes_run_options
def run(
    env: Env,
    *,
    seed: Annotated[int, typer.Option(help="Of every random choice.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Run directory; a fresh one under runs/ when left out.")] = None,
    **options: Unpack[RunOptions],
) -> None:
    """Learn a task from preferences and keep the run in a directory."""
    from bayespbrl import runs

    _expect_an_expert(options.get("expert"))
    run_to_the_end(runs.start(env, out, seed=seed, **options))


@app.command()
def resume(directory: Annotated[Path, typer.Argument(help="Directory of a run that was stopped.")]) -> None:
    """Go on with a run where it stopped; no answer is asked for twice."""
    from bayespbrl import runs

    learner = runs.resume(directory)
    if not learner.finished:
        _expect_an_expert(learner.settings.expert)
        run_to_the_end(learner)
    elif not (directory / PICTURE).exists():  # stopped while it was drawn, or run in Python
        show_run(learner)
    else:
        console.print(f"{directory}: this run is finished; nothing is left to do.")


@app.command()
def report(
    directory: Annotated[Path, typer.Argument(help="Directory of a run: finished, in progress or broken.")],
    format: Annotated[str, typer.Option(help="html (one file) or md (pictures beside it).")] = "html",
) -> None:
    """Write a diagnostic report of a run into its directory."""
    from bayespbrl.diagnostics.report import write_report

    console.print(f"Report: {write_report(directory, format=format)}")


@app.command()
@_takes_run_options
def trials(
    env: Env,
    *,
    number: Annotated[int, typer.Option("--trials", help="How many seeds.")] = 20,
    jobs: Annotated[int, typer.Option(help="Trials at a time, each in a process of its own.")] = 1,
    seed: Annotated[int, typer.Option(help="The first seed.")] = 1000,
    out: Annotated[Path | None, typer.Option(help="Directory of the study; under runs/ when left out.")] = None,
    **options: Unpack[RunOptions],
) -> None:
    """Run many seeds side by side and print median and quartiles; a second call does only what is missing."""
    from bayespbrl.studies.trials import run_trials

    utility = options.get("utility") or "posterior-mean"
    directory = out or Path("runs") / f"trials-{env.replace('/', '-').lower()}-{utility}"
    with progress_bar() as bar:
        task = bar.add_task("trials", total=number, state=f"{directory}")
        try:
            study = run_trials(
                env, directory, trials=number, jobs=jobs, seed=seed, progress=lambda _: bar.advance(task), **options
            )
        except KeyboardInterrupt:
            console.print("Stopped. Nothing is lost: the same command goes on.")
            raise
        bar.update(task, completed=number)
    print_trials(study)
    draw_trials(study)


def main() -> None:
    """Entry point: bad input is one line on standard error and exit status 2."""
    try:
        status = app(standalone_mode=False)
    except (ValueError, OSError) as error:
        status = _complain(str(error))
    except (KeyboardInterrupt, typer.Abort):
        status = 130
    except typer.Exit as stop:
        status = stop.exit_code
    except Exception as error:
        if not hasattr(error, "format_message"):  # Typer's usage errors, whose common class it does not export
            raise
        status = _complain(error.format_message())
    sys.exit(status if isinstance(status, int) else 0)


def _expect_an_expert(name: str | None) -> None:
    """Nobody answers here for an expert of the user's own.

    Raises:
      ValueError: it is such a run.
    """
    if name == "other":
        raise ValueError("expert: expected return or terminal, got other: such a run goes on in Python, Learner.run")


def _complain(message: str) -> int:
    print(f"bayespbrl: {' '.join(message.split())}", file=sys.stderr)
    return 2
