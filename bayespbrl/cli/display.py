"""What the command line shows: the bar of a run, its tables and pictures, and a person's questions."""

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from bayespbrl.envs.opening import environment_attribute

console = Console(soft_wrap=True, markup=False, emoji=False)  # a path may hold square brackets
PICTURE = "run.png"


def run_to_the_end(learner: Any) -> None:
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
    show_run(learner)


def show_run(learner: Any) -> None:
    """The iterations of a logged learner, its film and its picture: where that is, all is."""
    from bayespbrl.diagnostics.plots import run_figure

    directory = learner.log.path
    _print_iterations(learner)
    film, picture = _film(learner, directory), directory / PICTURE
    run_figure(learner).savefig(picture, dpi=110)
    console.print(f"Run directory: {directory}\nPicture: {picture}\n{film}")


def _film(learner: Any, directory: Path) -> str:
    """Film the final policy, and say where or why not: not every environment can be rendered."""
    from bayespbrl.runs.film import film_policy

    try:
        film, strip = film_policy(learner, directory)
    except ValueError as error:
        return f"No film of the final policy: {error}"
    return f"Final policy: {film} and {strip}"


def _run_with_bar(learner: Any) -> None:
    from bayespbrl.experts import simulated_expert

    console.print("The simulated expert answers, by the hidden reward.")
    with progress_bar() as bar:
        total, done = learner.settings.iterations, learner.state.iteration
        task = bar.add_task("iterations", total=total, completed=done, state=_state(learner))
        learner.run(
            simulated_expert(learner.settings.wrong_answers, seed=learner.settings.seed),
            progress=lambda now: bar.update(task, completed=now.state.iteration, state=_state(now)),
        )
        bar.update(task, completed=learner.state.iteration, state=_state(learner))


def progress_bar() -> Progress:
    """Of so many done of so many, with the task's field `state` behind it."""
    done = TextColumn("{task.description} {task.completed}/{task.total}")
    return Progress(
        done, BarColumn(), TimeElapsedColumn(), TextColumn("{task.fields[state]}", markup=False), console=console
    )


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


def _print_iterations(learner: Any) -> None:
    """A row for the first iteration, every fifth and the last, narrow enough for eighty columns."""
    optimum = environment_attribute(learner.environment, "optimal_return")
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


def print_trials(study: Any) -> None:
    """Median and quartiles by number of answers, and how honest the numerics were."""
    from bayespbrl.rollouts import open_environment

    table, quartiles = study.table, study.quartiles()
    optimum = environment_attribute(open_environment(table.attrs["env"]), "optimal_return")
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


def draw_trials(study: Any) -> None:
    """The learning curves of a study, beside its tables."""
    from bayespbrl.diagnostics.plots import trials_figure
    from bayespbrl.rollouts import open_environment

    about = study.table.attrs
    title = f"{about['env']}, {about['utility']}, {study.table.sizes['seed']} trials"
    picture = study.path / "trials.png"
    trials_figure(study.quartiles(), open_environment(about["env"]), title).savefig(picture, dpi=110)
    console.print(f"Picture: {picture}")
