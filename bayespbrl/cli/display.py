"""What the command line shows: progress, tables and pictures of runs and studies, and questions to a person."""

from collections.abc import Sequence
from pathlib import Path

import gymnasium
import numpy as np
import xarray as xr
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Column, Table

from bayespbrl import checks
from bayespbrl.cli.opening import Place, open_in_browser, somebody_looks
from bayespbrl.envs.opening import open_environment
from bayespbrl.envs.stepping import of_whole_episodes
from bayespbrl.experts import Expert, TerminalExpert
from bayespbrl.figures import new_figure, png
from bayespbrl.learner import Learner
from bayespbrl.runs.directory import command_to_continue
from bayespbrl.runs.files import write_file
from bayespbrl.runs.film import film_policy
from bayespbrl.runs.simulated import expert_of
from bayespbrl.studies import Trials
from bayespbrl.studies.tables import survival, took_place
from bayespbrl.trajectories import Trajectory

console = Console(soft_wrap=True, markup=False, emoji=False)  # a path may contain square brackets
PICTURE = "run.png"
PLACE = Place()


def run_to_the_end(
    learner: Learner,
    directory: Path,
    *,
    answerers: Sequence[str] = (),
    practice: bool = True,
    place: Place = PLACE,
) -> None:
    """Run a learner that keeps its events in `directory` to its end, with its progress, then `show_run`.

    `answerers` are the names of the people who answer, at most one at the terminal; `practice` and `place` as in
    `ask_on_page`.
    """
    if learner.settings.expert == "page":
        return ask_on_page(learner, directory, answerers=answerers, practice=practice, place=place)
    console.print(f"Run directory: {directory}")
    try:
        if learner.settings.expert == "terminal":
            person = _person(learner, directory)
            learner.run(person, answerer=next(iter(answerers), None), progress=lambda now: console.print(_state(now)))
        else:
            _run_with_bar(learner, expert_of(learner))
        show_run(learner, directory)
    except KeyboardInterrupt:
        again = command_to_continue("resume", learner.settings, directory, answerers)
        console.print(f"\nStopped. Nothing is lost: {again}")
        raise


def ask_on_page(
    learner: Learner,
    directory: Path,
    *,
    answers: int | None = None,
    answerers: Sequence[str] = (),
    practice: bool = True,
    place: Place = PLACE,
) -> None:
    """Ask a person the questions of a run on a page, until it is finished or the person stops.

    Args:
      learner: keeps its events in `directory`.
      answers: most answers of this sitting.
      answerers: the names of those who answer at once, each on a page of their own; kept beside the answers.
      practice: whether a person who has not answered in this run yet gets instructions and practice first.
      place: where the page listens, and whether it is opened in the browser, which it is for one person alone.

    Raises:
      ValueError: the extra is not installed, or the port is in use.
    """
    check_page_installed()
    from bayespbrl.people.page import Page
    from bayespbrl.people.session import Session

    again = command_to_continue("ask", learner.settings, directory, answerers)
    session = Session(learner, most_answers=answers, answerer=answerers or None, practice=practice)
    page = Page(session, host=place.host, port=place.port)
    console.print(f"Run directory: {directory}\nOpen this page in a browser; Ctrl-C ends it:")
    for name, address in zip(answerers or [""], page.addresses, strict=True):
        console.print(f"{name}: {address}" if len(answerers) > 1 else address)
    if place.browser and len(page.addresses) == 1 and somebody_looks():
        open_in_browser(page.address)
    try:
        page.serve()
        view = page.session.view
        if view["phase"] == "failed":
            raise ValueError(view["say"])
        console.print(view["say"])
        if learner.finished:
            show_run(learner, directory)
        else:
            console.print(f"This continues: {again}")
    except KeyboardInterrupt:
        if learner.finished:  # only the pictures are missing
            again = command_to_continue("resume", learner.settings, directory)
        console.print(f"\nStopped. Nothing is lost: {again}")
        raise


def check_expert(name: str | None, answerers: Sequence[str]) -> None:
    """Refuse an expert who cannot answer here, a name for a simulated one, and a page without its extra."""
    for answerer in answerers:
        checks.short_name("answerer", answerer)
        if name not in ("terminal", "page"):
            raise ValueError(
                f"answerer: expected a name only with the expert page or terminal, got {answerer!r} with "
                f"{name or 'return'}"
            )
    if len(set(answerers)) < len(answerers) or (name == "terminal" and len(answerers) > 1):
        raise ValueError(
            f"answerer: expected a different name for each person, and one person at the terminal, got {answerers}"
        )
    if name == "other":
        raise ValueError(
            "expert: expected a simulated expert, page or terminal, got other; continue in Python or by bayespbrl ask"
        )
    if name == "page":
        check_page_installed()


def check_page_installed() -> None:
    """`ValueError` where the extra `people` is not installed."""
    try:
        from bayespbrl.people import page  # noqa: F401
    except ImportError as error:
        raise ValueError(f"page: expected the extra people (pip install '.[people]'), got {error}") from error


def show_run(learner: Learner, directory: Path) -> None:
    """Print the iterations of a run, draw its picture and film into `directory`, and print their paths."""
    from bayespbrl.diagnostics.plots import run_figure

    _print_iterations(learner)
    if learner.comparable_starts is False:
        console.print("Equal seeds did not start alike here: trajectories from different starts were compared.")
    film, picture = _film(learner, directory), directory / PICTURE
    write_file(picture, png(run_figure(learner)))
    console.print(f"Run directory: {directory}\nPicture: {picture}\n{film}")


def _film(learner: Learner, directory: Path) -> str:
    """Film the final policy; returns a line with the paths, or why there is no film."""
    try:
        film, strip = film_policy(learner, directory)
    except ValueError as error:
        return f"No film of the final policy: {error}"
    return f"Final policy: {film} and {strip}"


def _run_with_bar(learner: Learner, expert: Expert) -> None:
    console.print("The simulated expert answers according to the hidden reward.")
    with progress_bar() as bar:
        total, done = learner.settings.with_confirmations, learner.state.iteration
        task = bar.add_task("iterations", total=total, completed=done, state=_state(learner))
        learner.run(
            expert,
            progress=lambda now: bar.update(task, completed=now.state.iteration, state=_state(now)),
        )
        ended = learner.state.iteration  # before the limit, where the answers are used up
        bar.update(task, total=ended, completed=ended, state=_state(learner))


def progress_bar() -> Progress:
    """A bar with the number of steps done and the task's field `state` after it."""
    done = TextColumn("{task.description} {task.completed}/{task.total}")
    return Progress(
        done, BarColumn(), TimeElapsedColumn(), TextColumn("{task.fields[state]}", markup=False), console=console
    )


def _state(learner: Learner) -> str:
    text = f"answers {learner.preferences.answers}"
    if learner.iterations:
        last = learner.iterations[-1]
        text += f"  value {last['value']:.2f}  R̂ {_number(last['rhat_max'], '.3f')}"
    return text


def _person(learner: Learner, directory: Path) -> TerminalExpert:
    """The person at this terminal, who looks at a picture of the two trajectories."""
    from bayespbrl.envs.pictures import draw_trajectory

    def draw(first: Trajectory, second: Trajectory, path: Path) -> None:
        figure = new_figure(11, 5)
        for axes, trajectory, name in zip(figure.subplots(1, 2), (first, second), ("first", "second"), strict=True):
            draw_trajectory(learner.environment, trajectory, axes)
            axes.set_title(f"{name}: {axes.get_title()}")
        write_file(path, png(figure, dpi=100))

    return TerminalExpert(draw, directory)


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def _table(title: str, columns: list[str], rows: list[list[str]]) -> None:
    headers = (Column(name, justify="right", no_wrap=True) for name in columns)
    table = Table(*headers, title=title, title_justify="left")
    for row in rows:
        table.add_row(*row)
    console.print(table)


def _positive_optimum(environment: gymnasium.Env, max_steps: int | None) -> float | None:
    """The environment's optimal return, where a value is a share of it."""
    optimum = of_whole_episodes(environment, "optimal_return", max_steps)
    return float(optimum) if optimum is not None and optimum > 0 else None


def _print_iterations(learner: Learner) -> None:
    """A row for the first iteration, every fifth and the last, narrow enough for eighty columns."""
    optimum = _positive_optimum(learner.environment, learner.settings.rollouts.max_steps)
    # the number of answers does not identify an iteration where some ask nothing
    numbered = len({s["answers"] for s in learner.iterations}) < len(learner.iterations)
    rows = [
        [
            *([str(s["iteration"])] if numbered else []),
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
    columns = ["iteration"] * numbered + ["answers", "value", *share, "pairs", "KL/bound", "R̂", "draws"]
    settings = learner.settings
    _table(f"{settings.env}, {settings.estimation.utility}, seed {settings.seed}", columns, rows)


def show_trials(study: Trials, max_steps: int | None = None) -> None:
    """Print the results of a study, draw its learning curves beside its tables, and print their paths.

    `max_steps` is the time limit of its episodes; None: the environment's.
    """
    from bayespbrl.diagnostics.plots import trials_figure

    table, quartiles = study.table, study.quartiles()
    environment = open_environment(table.attrs["env"])
    title = f"{table.attrs['env']}, {table.attrs['utility']}, {table.sizes['seed']} trials"
    _print_quartiles(quartiles, _positive_optimum(environment, max_steps), title)
    if table.attrs["redraws"]:
        seeds = table.attrs["redrawn_seeds"].replace(" ", ", ")
        console.print(f"Trials redrawn because they met no preference: {table.attrs['redraws']}, seeds {seeds}.")
    if "balancing_steps" in table:
        _print_balancing(survival(table).isel(iteration=-1), table["balancing_steps"])
    _print_numerics(table)
    console.print(f"Tables: {study.path / 'trials.csv'}, {study.path / 'trials.nc'}")
    picture = study.path / "trials.png"
    write_file(picture, png(trials_figure(quartiles, environment, title, max_steps)))
    console.print(f"Picture: {picture}")


def _print_quartiles(quartiles: xr.Dataset, optimum: float | None, title: str) -> None:
    names = ("lower_quartile", "median", "upper_quartile")
    rows = []
    for answers, *values in zip(quartiles["answers"].values, *(quartiles[name].values for name in names), strict=True):
        shares = [] if optimum is None else [f"{value / optimum:.3f}" for value in values]
        rows.append([f"{answers:g}", *(f"{value:.2f}" for value in values), *shares])
    columns = ["answers", *["25 %", "median", "75 %"] * (1 if optimum is None else 2)]
    fraction = "" if optimum is None else ", and as a fraction of the optimum"
    _table(f"{title}: quartiles of the value{fraction}", columns, rows)


def _print_balancing(survival: xr.DataArray, steps: xr.DataArray) -> None:
    """The share of evaluation episodes that survive and the balancing time, each over seeds."""
    console.print(
        f"Final policies: {float(survival.mean()):.1%} of the evaluation episodes survive "
        f"(worst trial {float(survival.min()):.1%}); the balancing time is {float(steps.median()):.0f} steps in the "
        f"median trial, {float(steps.min()):.0f} in the worst, at most {steps.attrs['max_steps']}."
    )


def _print_numerics(table: xr.Dataset) -> None:
    """How closely the updates met their bounds and constraints, and whether the fits converged."""
    had = took_place(table).values
    active = had & table["bound_active"].values.astype(bool)
    deviation = abs(table["kl"] / table["kl_bound"] - 1).values[active].max(initial=0.0)
    failed = np.sum(had & ~table["utility_converged"].values.astype(bool))
    console.print(
        f"KL bound active in {active.sum()} of {had.sum()} iterations and met there within {deviation:.2%}; "
        f"feature gap at most {float(table['feature_gap'].max()):.1e} whitened, "
        f"{float(table['feature_gap_raw'].max()):.1e} raw; rank kept {int(table['rank_kept'].min())} to "
        f"{int(table['rank_kept'].max())}; utility fits that did not converge: {failed}."
    )
