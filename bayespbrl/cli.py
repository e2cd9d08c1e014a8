"""The command line: `bayespbrl run`, `resume`, `report`, `trials`."""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

app = typer.Typer(
    help="Preference-based reinforcement learning: a policy from answers to 'which of these two is better?'.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
console = Console(soft_wrap=True)

Env = Annotated[str, typer.Argument(help="gridworld, bicycle, swing-up, acrobot, or any gymnasium id.")]
Utility = Annotated[
    str | None,
    typer.Option(help="posterior-mean, most-likely, posterior-draw, linear-program or known-reward (the ceiling)."),
]
Query = Annotated[
    str | None,
    typer.Option(
        help="highest-utility (the paper's), probably-better, thompson, information, disagreement or "
        "information-when-unsure."
    ),
]
Schedule = Annotated[
    str | None, typer.Option(help="constant (the paper's), or confidence: the bound follows the posterior's certainty.")
]
Hyperparameters = Annotated[
    str | None,
    typer.Option(
        help="evidence: length scales, steepness and lapse rate by the answers; averaged over them; or given."
    ),
]
Iterations = Annotated[int | None, typer.Option(help="Cycles of the four steps.")]
KLBound = Annotated[float | None, typer.Option("--kl-bound", help="Bound on each policy update, in nats.")]
UpdatesPerIteration = Annotated[
    int | None, typer.Option(help="Policy updates from the same trajectories and answers; the paper's is 1.")
]
UnaskedIterations = Annotated[
    int | None,
    typer.Option(
        help="Iterations in a row, at most, that ask nothing: with the schedule confidence while it is sure, with "
        "constant always; 0 is the paper's."
    ),
]
Likelihood = Annotated[str | None, typer.Option(help="mixed (eq. 8), logistic or probit.")]
PriorScale = Annotated[float | None, typer.Option(help="Prior standard deviation of a utility weight.")]
Steepness = Annotated[float | None, typer.Option(help="Of the likelihood, in units of the largest difference.")]
LapseRate = Annotated[float | None, typer.Option(help="Share of answers that the model takes for coin tosses.")]
Discount = Annotated[float | None, typer.Option(help="Of Q, and of ψ(τ) unless told, in [0, 1); the paper's is 0.98.")]
TrajectoryDiscount = Annotated[
    float | None, typer.Option(help="Of ψ(τ), by which answers are explained, in [0, 1]; the paper's is that of Q.")
]
WrongAnswers = Annotated[float | None, typer.Option(help="Share of the simulated expert's answers turned round.")]
PolicyKind = Annotated[
    str | None, typer.Option("--policy", help="auto, tabular, softmax, linear-gaussian or gaussian-process.")
]
Centres = Annotated[int | None, typer.Option(help="Radial basis functions of each kind of feature.")]
MaxSteps = Annotated[int | None, typer.Option(help="Steps an episode, where the environment sets no limit.")]
Expert = Annotated[str | None, typer.Option(help="return (simulated) or terminal (you).")]


@app.command()
def run(
    env: Env,
    utility: Utility = None,
    query: Query = None,
    schedule: Schedule = None,
    hyperparameters: Hyperparameters = None,
    iterations: Iterations = None,
    kl_bound: KLBound = None,
    updates_per_iteration: UpdatesPerIteration = None,
    unasked_iterations: UnaskedIterations = None,
    likelihood: Likelihood = None,
    prior_scale: PriorScale = None,
    steepness: Steepness = None,
    lapse_rate: LapseRate = None,
    discount: Discount = None,
    trajectory_discount: TrajectoryDiscount = None,
    wrong_answers: WrongAnswers = None,
    policy: PolicyKind = None,
    centres: Centres = None,
    max_steps: MaxSteps = None,
    expert: Expert = None,
    seed: Annotated[int, typer.Option(help="Of every random choice.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Run directory; a fresh one under runs/ when left out.")] = None,
) -> None:
    """Learn a task from preferences and keep the run in a directory."""
    options = _without(locals(), "env", "out")
    from bayespbrl import runs

    _carry_on(runs.start(env, out, **options))


@app.command()
def resume(directory: Annotated[Path, typer.Argument(help="Directory of a run that was stopped.")]) -> None:
    """Go on with a run where it stopped; no answer is asked for twice."""
    from bayespbrl import runs

    learner = runs.resume(directory)
    if learner.finished:
        console.print(f"{directory}: this run is finished; nothing is left to do.")
        return
    _carry_on(learner)


@app.command()
def report(
    directory: Annotated[Path, typer.Argument(help="Directory of a run: finished, in progress or broken.")],
    format: Annotated[str, typer.Option(help="html (one file) or md (pictures beside it).")] = "html",
) -> None:
    """Write a diagnostic report of a run into its directory."""
    from bayespbrl.diagnostics.report import write_report

    console.print(f"Report: {write_report(directory, format=format)}")


@app.command()
def trials(
    env: Env,
    utility: Utility = None,
    query: Query = None,
    schedule: Schedule = None,
    hyperparameters: Hyperparameters = None,
    iterations: Iterations = None,
    kl_bound: KLBound = None,
    updates_per_iteration: UpdatesPerIteration = None,
    unasked_iterations: UnaskedIterations = None,
    likelihood: Likelihood = None,
    prior_scale: PriorScale = None,
    steepness: Steepness = None,
    lapse_rate: LapseRate = None,
    discount: Discount = None,
    trajectory_discount: TrajectoryDiscount = None,
    wrong_answers: WrongAnswers = None,
    policy: PolicyKind = None,
    centres: Centres = None,
    max_steps: MaxSteps = None,
    expert: Expert = None,
    number: Annotated[int, typer.Option("--trials", help="How many seeds.")] = 20,
    jobs: Annotated[int, typer.Option(help="Trials at a time, each in a process of its own.")] = 1,
    seed: Annotated[int, typer.Option(help="The first seed.")] = 1000,
    out: Annotated[Path | None, typer.Option(help="Directory of the study; under runs/ when left out.")] = None,
) -> None:
    """Run many seeds side by side and print median and quartiles; a second call does only what is missing."""
    options = _without(locals(), "env", "number", "jobs", "out")
    from bayespbrl.trials import run_trials

    directory = out or Path("runs") / f"trials-{env.replace('/', '-').lower()}-{utility or 'posterior-mean'}"
    with _progress("{task.fields[state]}") as bar:
        task = bar.add_task("trials", total=number, state=f"{directory}")
        study = run_trials(env, directory, trials=number, jobs=jobs, progress=lambda _: bar.advance(task), **options)
        bar.update(task, completed=number)
    _print_trials(study)
    from bayespbrl.diagnostics.plots import trials_figure
    from bayespbrl.rollouts import open_environment

    title = f"{env}, {study.table.attrs['utility']}, {number} trials"
    picture = directory / "trials.png"
    trials_figure(study.quartiles(), open_environment(env), title).savefig(picture, dpi=110)
    console.print(f"Picture: {picture}")


def main() -> None:
    """Entry point: bad input is one line on standard error and exit status 2."""
    try:
        status = app(standalone_mode=False)
    except ValueError as error:
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


def _without(options: dict[str, Any], *names: str) -> dict[str, Any]:
    """The options of a run among a command's parameters."""
    return {name: value for name, value in options.items() if name not in names}


def _complain(message: str) -> int:
    print(f"bayespbrl: {' '.join(message.split())}", file=sys.stderr)
    return 2


def _carry_on(learner: Any) -> None:
    """Run a logged learner to its end, showing how it goes, and say where everything is."""
    directory = learner.log.path
    console.print(f"Run directory: {directory}")
    try:
        if learner.settings.expert == "terminal":
            learner.run(_person(learner, directory), progress=_say)
        else:
            _run_with_bar(learner)
    except KeyboardInterrupt:
        console.print(f"\nStopped. Nothing is lost: bayespbrl resume {directory}")
        raise
    _print_iterations(learner)
    from bayespbrl.diagnostics.plots import run_figure

    picture = directory / "run.png"
    run_figure(learner).savefig(picture, dpi=110)
    console.print(f"Run directory: {directory}\nPicture: {picture}\n{_film(learner, directory)}")


def _film(learner: Any, directory: Path) -> str:
    """Film the final policy, and say where or why not: not every environment can be rendered."""
    from bayespbrl.film import film_policy

    try:
        film, strip = film_policy(learner, directory)
    except ValueError as error:
        return f"No film of the final policy: {error}"
    return f"Final policy: {film} and {strip}"


def _run_with_bar(learner: Any) -> None:
    from bayespbrl.experts import simulated_expert

    with _progress("{task.fields[state]}") as bar:
        total, done = learner.settings.iterations, learner.state.iteration
        task = bar.add_task("iterations", total=total, completed=done, state=_state(learner))
        learner.run(
            simulated_expert(learner.settings.wrong_answers, seed=learner.settings.seed),
            progress=lambda now: bar.update(task, completed=now.state.iteration, state=_state(now)),
        )
        bar.update(task, completed=learner.state.iteration, state=_state(learner))


def _progress(state: str) -> Progress:
    columns = (TextColumn("{task.description} {task.completed}/{task.total}"), BarColumn(), TimeElapsedColumn())
    return Progress(*columns, TextColumn(state), console=console)


def _state(learner: Any) -> str:
    text = f"answers {learner.preferences.answers}"
    if learner.iterations:
        last = learner.iterations[-1]
        text += f"  value {last['value']:.2f}  R̂ {_number(last['rhat_max'], '.3f')}"
    return text


def _say(learner: Any) -> None:
    console.print(_state(learner))


def _person(learner: Any, directory: Path) -> Any:
    """The person at this terminal, who sees pictures of the two trajectories."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from bayespbrl.envs.pictures import draw_trajectory
    from bayespbrl.experts import TerminalExpert

    def draw(first: Any, second: Any, path: Path) -> None:
        figure = Figure(figsize=(11, 5), layout="constrained")
        FigureCanvasAgg(figure)
        for axes, trajectory, name in zip(figure.subplots(1, 2), (first, second), ("first", "second"), strict=True):
            draw_trajectory(learner.environment, trajectory, axes)
            axes.set_title(f"{name}: {axes.get_title()}")
        figure.savefig(path, dpi=100)

    return TerminalExpert(draw, directory)


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def _table(title: str, columns: list[str], rows: list[list[str]]) -> None:
    table = Table(title=title, title_justify="left")
    for column in columns:
        table.add_column(column, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    console.print(table)


def _optimum(environment: Any) -> float | None:
    return getattr(getattr(environment.unwrapped, "dynamics", None), "optimal_return", None)


def _print_iterations(learner: Any) -> None:
    """A row for the first iteration, every fifth and the last, narrow enough for eighty columns."""
    optimum = _optimum(learner.environment)
    quiet = len({s["answers"] for s in learner.iterations}) < len(learner.iterations)  # answers do not tell them apart
    rows = [
        [
            *([str(s["iteration"])] if quiet else []),
            str(s["answers"]),
            f"{s['value']:.2f}",
            *([] if optimum is None else [f"{s['value'] / optimum:.1%}"]),
            f"{s['pairs_satisfied']}/{s['pairs']}",
            f"{s['kl']:.3f}/{s['kl_bound']:.2g}",
            _number(s["rhat_max"], ".3f"),
            _number(s["effective_sample_size_min"], ".0f"),
        ]
        for s in learner.iterations
        if s["iteration"] % 5 == 0 or s["iteration"] in (1, len(learner.iterations))
    ]
    share = [] if optimum is None else ["optimum"]
    columns = ["iteration"] * quiet + ["answers", "value", *share, "pairs", "KL/bound", "R̂", "draws"]
    _table(f"{learner.settings.env}, {learner.settings.utility}, seed {learner.settings.seed}", columns, rows)


def _print_trials(study: Any) -> None:
    """Median and quartiles by number of answers, and how honest the numerics were."""
    from bayespbrl.rollouts import open_environment

    table, quartiles = study.table, study.quartiles()
    optimum = _optimum(open_environment(table.attrs["env"]))
    names = ("lower_quartile", "median", "upper_quartile")
    rows = []
    for answers in quartiles["answers"].values:
        at = quartiles.sel(answers=answers)
        shares = [] if optimum is None else [f"{float(at[name]) / optimum:.3f}" for name in names]
        rows.append([f"{answers:g}", *(f"{float(at[name]):.2f}" for name in names), *shares])
    columns = ["answers", "25 %", "median", "75 %"] + ([] if optimum is None else ["25 %", "median", "75 %"])
    title = f"{table.attrs['env']}, {table.attrs['utility']}, {table.sizes['seed']} trials: quartiles of the value"
    _table(title + ("" if optimum is None else ", and as a fraction of the optimum"), columns, rows)
    if table.attrs["redraws"]:
        seeds = table.attrs["redrawn_seeds"].replace(" ", ", ")
        console.print(f"Redrawn for want of a preference: {table.attrs['redraws']} trials, seeds {seeds}.")
    if "balancing_steps" in table:
        survival, steps = 1 - table["terminated"].isel(iteration=-1), table["balancing_steps"]
        console.print(
            f"Final policies: {float(survival.mean()):.1%} of the evaluation episodes survive "
            f"(worst trial {float(survival.min()):.1%}); they balance for {float(steps.median()):.0f} steps in the "
            f"median trial, {float(steps.min()):.0f} in the worst, of {steps.attrs['max_steps']} at most."
        )
    active = table["bound_active"].values.astype(bool)
    deviation = abs(table["kl"] / table["kl_bound"] - 1).values[active].max(initial=0.0)
    console.print(
        f"KL bound active in {active.sum()} of {active.size} iterations, met within {deviation:.2%} there; "
        f"whitened feature gap at most {float(table['feature_gap'].max()):.1e}, raw "
        f"{float(table['feature_gap_raw'].max()):.1e}; rank kept {int(table['rank_kept'].min())} to "
        f"{int(table['rank_kept'].max())}; utility fits not converged: "
        f"{int((~table['utility_converged'].values.astype(bool)).sum())}."
    )
    console.print(f"Tables: {study.path / 'trials.csv'}, {study.path / 'trials.nc'}")
