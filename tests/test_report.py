"""The report of a run: what it says, that it is self-contained, and what it does with damaged runs."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from toys import SHORT

import bayespbrl
from bayespbrl import ReturnExpert
from bayespbrl.cli.commands import main
from bayespbrl.diagnostics.estimates import predicted_answer
from bayespbrl.diagnostics.predictions import answer_probabilities
from bayespbrl.diagnostics.prequential import score_predictions
from bayespbrl.diagnostics.report import document as report_document
from bayespbrl.diagnostics.report import figures as report_figures
from bayespbrl.diagnostics.report import sections as report_sections
from bayespbrl.diagnostics.report import summary as report_summary
from bayespbrl.diagnostics.report import tables as report_tables
from bayespbrl.diagnostics.report import write as report_write
from bayespbrl.diagnostics.report.answers import surprise_order
from bayespbrl.diagnostics.report.contents import RunContents, read_contents
from bayespbrl.diagnostics.report.formatting import number
from bayespbrl.diagnostics.report.log import AnsweredQuestion
from bayespbrl.diagnostics.report.warnings import find_warnings
from bayespbrl.diagnostics.report.write import assembled, write_report
from bayespbrl.improvement.schedules import Bound
from bayespbrl.models.likelihoods import log_prob
from bayespbrl.preferences import Answer, Preferences
from bayespbrl.runs.iteration_files import read_iteration
from bayespbrl.trajectories import trajectory_features

QUICK = SHORT | {"iterations": 3, "seed": 7}


def start(directory, **changes):
    return bayespbrl.start("gridworld", directory, **(QUICK | changes))


def no_picture(*arguments, **options):
    """Stands in for the drawing, which takes most of a report's time."""
    return b"\x89PNG"


@pytest.fixture
def drawn():
    """Asked for by tests that need real pictures."""


@pytest.fixture(autouse=True)
def quick_pictures(request, monkeypatch):
    """Most tests read only the text."""
    if "drawn" not in request.fixturenames:
        monkeypatch.setattr(report_document, "_few_colours", no_picture)


class Reader(HTMLParser):
    """The text of a page, its images, its headings, and every address that it would fetch."""

    def __init__(self, page):
        super().__init__()
        self.text, self.images, self.addresses, self.open, self.headings = "", [], [], [], []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        named = dict(attributes)
        if tag not in ("meta", "img", "br", "link"):
            self.open.append(tag)
        if tag == "img":
            self.images.append(named)
        self.addresses += [named[name] for name in ("src", "href", "action") if name in named]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.text += data
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)


def read(path):
    reader = Reader(path.read_text(encoding="utf-8"))
    assert reader.open == []
    return reader


def files(directory):
    return {path: path.read_bytes() for path in directory.rglob("*") if path.is_file() and "report" not in path.name}


@pytest.fixture(scope="module")
def contents(gridworld_run):
    return read_contents(gridworld_run)


@pytest.fixture(scope="module")
def page(gridworld_run):
    """The report of `gridworld_run`, without pictures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report_document, "_few_colours", no_picture)
        return read(write_report(gridworld_run))


def warnings_of(contents):
    iterations = report_tables.iterations_table(contents.iterations)
    return find_warnings(
        contents, iterations, report_tables.answers_table(contents), report_tables.prequential_table(contents)
    )


def warned(contents):
    return [warning.what for warning in warnings_of(contents)]


def changed(contents, changes):
    """The contents with other figures in the summaries."""
    iterations = tuple(summary | change for summary, change in zip(contents.iterations, changes, strict=True))
    return replace(contents, iterations=iterations)


# What the report says.


@pytest.mark.slow
def test_the_report_is_one_file_that_fetches_nothing_and_changes_nothing_else(gridworld_run, drawn):
    before = files(gridworld_run)
    path = write_report(gridworld_run)
    assert files(gridworld_run) == before
    assert path == gridworld_run / "report.html"
    page = read(path)
    assert page.images
    assert all(address.startswith(("data:image/png;base64,", "#")) for address in page.addresses)
    assert not re.search(r"https?:|@import|url\(|<script", path.read_text())
    assert all(image["alt"] for image in page.images)


def test_the_sections_come_in_the_order_of_the_questions_a_reader_asks(page):
    assert page.headings == [
        "Summary",
        "Warnings and remedies",
        "Learning curve",
        "Convergence of the posterior",
        "Inferred utility",
        "Answers, most surprising first",
        "Calibration of the predictions",
        "Policy updates",
        "Sensitivity to prior and likelihood",
        "All iterations",
    ]
    assert "could not be made" not in page.text


def test_the_summary_has_the_value_and_the_convergence_of_the_posterior(page, contents):
    last = contents.iterations[-1]
    assert "Finished: 3 iterations." in page.text
    assert f"is {number(last['value'])}" in page.text
    assert f"largest R̂ {last['rhat_max']:.3f}" in page.text
    assert f"satisfies {last['pairs_satisfied']} of {last['pairs']} preferences" in page.text
    assert "anew" not in page.text


@pytest.mark.slow
@pytest.mark.parametrize(("kept", "of"), [(1, "the earlier one of iteration 1"), (3, "the one of iteration 3")])
def test_the_report_says_that_a_policy_was_started_anew_and_which_is_kept(contents, kept, of):
    report = assembled(changed(contents, [{}, {}, {"restarted": 2, "kept": kept}]))
    said = f"After iteration 2 the policy was restarted with the posterior by then; the run keeps {of}."
    assert said in report.summary
    (learning,) = [section for section in report.sections if section.name == "learning"]
    assert "begins again where the policy was restarted; the last" in str(learning.blocks)


def test_every_answer_is_drawn_with_both_trajectories_and_its_probability(page, contents):
    assert len(contents.answers) == 4
    for answer in contents.answers:
        assert f"Question {answer.question}:" in page.text
        for shown in (answer.first, answer.second):
            assert f"Drawing of trajectory {shown}." in [image["alt"] for image in page.images]


def test_probabilities_of_answers_are_those_of_the_posteriors_before_and_after(gridworld_run, contents):
    table = report_tables.answers_table(contents)
    run = bayespbrl.load(gridworld_run)
    likelihood = np.exp(run.posterior["log_likelihood"]["answers"].values).mean(axis=(0, 1))
    np.testing.assert_allclose(table["before"][:2], 0.5)  # the prior knows nothing
    np.testing.assert_array_equal(table["said"] == "tie", [False, False, True, False])
    assert np.isnan(table["before"][2])  # the first tie, which no posterior expected
    assert float(table["probability"][2]) == pytest.approx(likelihood[-1])
    np.testing.assert_allclose(table["probability"].values[[0, 1]], likelihood[:2])
    # the third iteration's answer, by the estimate of the second
    log = [json.loads(line) for line in (gridworld_run / "events.jsonl").read_text().splitlines()]
    asked = [event for event in log if event["event"] == "asked"][-1]
    said = [event for event in log if event["event"] == "answered"][-1]["answer"]
    parts = read_iteration(gridworld_run / "iterations" / "0002.nc", "improved")
    both = [run.trajectories[asked[name]] for name in ("first", "second")]
    sums = trajectory_features(both, parts["estimate"].features, discount=run.settings.critic.discount)
    difference = (sums[[0]] - sums[[1]]) / parts["estimate"].scales[0]
    first, second, tie = answer_probabilities(parts["estimate"].posterior, difference)[0]
    assert tie > 0.01
    assert float(table["before"][3]) == pytest.approx(first if said == "first" else second)
    answer = contents.answers[3]
    for other, probability in ((Answer.FIRST, first), (Answer.SECOND, second)):
        assert replace(answer, answer=other).before == pytest.approx(probability)
    # scored is which of the two was preferred
    assert answer.predicted == pytest.approx(first / (first + second))
    assert float(table["probability"][3]) == pytest.approx(
        likelihood[len(run.preferences.pairs) - 1]
    )  # the ties come last
    utilities = run.estimate.trajectory_utilities(both)
    margin = (utilities[0] - utilities[1]) * (1 if said == "first" else -1)
    assert float(table["margin"][3]) == pytest.approx(margin, rel=1e-6)  # in the units of the utility


def test_nothing_is_called_undominated_where_nothing_was_compared(tmp_path):
    learner = start(tmp_path / "run", iterations=1)
    while questions := learner.ask():
        learner.tell(["skip"] * len(questions))
    assert "Undominated" not in read(bayespbrl.load(tmp_path / "run").report()).text


@pytest.mark.slow
def test_a_person_without_a_name_beside_named_ones_is_predicted_as_that_person(tmp_path):
    learner = bayespbrl.start(
        "gridworld",
        tmp_path / "run",
        preset="paper",
        expert="other",
        answers=10,
        seed=3,
        repeats=0,
        evaluation_episodes=2,
        trajectories_per_iteration=4,
    )
    expert, turn = bayespbrl.ReturnExpert(), 0
    while queries := learner.ask():
        turn += 1
        if turn % 2:
            learner.tell(["first"])  # a strong side bias
        else:
            learner.tell([expert(*queries[0].trajectories)], answerer="Ada")
    contents, differences = read_contents(tmp_path / "run"), []
    for answer in contents.answers:
        if answer.answerer is None and answer.iteration > 2:
            before = read_iteration(contents.path / "iterations" / f"{answer.iteration - 1:04d}.nc", "improved")
            pair = [contents.compared[number] for number in (answer.first, answer.second)]
            assert answer.predicted == predicted_answer(before["estimate"], *pair, answerer="")[0]
            differences.append(answer.predicted - predicted_answer(before["estimate"], *pair)[0])  # without a side bias
    assert len(differences) >= 3
    assert max(map(abs, differences)) > 0.1


def test_the_first_answers_which_no_posterior_predicted_are_not_scored(contents):
    first = [answer for answer in contents.answers if answer.iteration == 1]
    assert first
    assert all(answer.predicted == 0.5 for answer in first)
    stated = [answer for answer in contents.answers if answer.iteration > 1 and answer.states_order]
    assert report_tables.prequential_table(contents).sizes["prediction"] == len(stated)


@pytest.mark.slow
def test_the_answers_have_the_probabilities_of_the_posterior_over_all_length_scales(swing_up_run):
    run, contents = bayespbrl.load(swing_up_run), read_contents(swing_up_run)
    table = report_tables.answers_table(contents)
    later = [k for k, answer in enumerate(contents.answers) if answer.iteration > 1]
    of_one_setting = []
    for k in later:
        answer = contents.answers[k]
        before = read_iteration(run.path / "iterations" / f"{answer.iteration - 1:04d}.nc", "improved")["estimate"]
        numbers = (answer.first, answer.second)[:: 1 if str(answer.answer) == "first" else -1]
        both = [run.trajectories[number] for number in numbers]
        for name, estimate, rounding in (("before", before, 0.02), ("probability", run.estimate, 1e-4)):
            margins = estimate.trajectory_draws(both) @ [1, -1]
            p = np.exp(log_prob(estimate.likelihood(), margins[:, None])).mean()
            assert float(table[name][k]) == pytest.approx(float(p), abs=rounding)
        assert float(table["margin"][k]) == pytest.approx(margins.mean(), rel=1e-6)
        assert float(table["margin_sd"][k]) == pytest.approx(margins.std(), rel=1e-6)
        numbers = before.posterior["posterior"]["setting"].values.ravel()
        likeliest = numbers == np.bincount(numbers).argmax()
        margins = before.trajectory_draws(both) @ [1, -1]
        of_one_setting.append(float(np.mean(margins[likeliest] > 0)))
    assert np.abs(table["before"].values[later] - of_one_setting).max() > 0.03  # else this could not distinguish them


@pytest.mark.slow
def test_the_probability_of_an_answer_before_it_was_given_is_of_the_posterior_that_the_run_kept(gridworld_copy):
    table = report_tables.answers_table(read_contents(gridworld_copy))
    log = [json.loads(line) for line in (gridworld_copy / "events.jsonl").read_text().splitlines()]
    said = [event for event in log if event["event"] == "answered"][-1]["answer"]
    contents = read_contents(gridworld_copy)
    tree = contents.posterior
    tree["posterior"]["coordinates"][:] = 0.0  # a posterior that knows nothing of what was asked
    tree["posterior"]["margins"][:] = 0.0
    tree["log_likelihood"]["answers"][:] = np.log(0.5)
    other = report_tables.answers_table(contents)
    assert said in ("first", "second")
    assert abs(float(table["probability"][3]) - 0.5) > 0.05
    assert float(other["probability"][3]) == pytest.approx(0.5)
    assert float(other["margin"][3]) == 0


@pytest.mark.slow
def test_a_run_keeps_the_posterior_over_length_scales_and_the_report_says_what_it_is_over(swing_up_learner):
    directory, learner = swing_up_learner
    estimate = read_iteration(directory / "iterations" / "0004.nc", "improved")["estimate"]
    states = learner.trajectories[0].states
    assert len(estimate.multiples) > 1
    np.testing.assert_array_equal(estimate.utilities(states), learner.estimate.utilities(states))
    for kept, learned in zip(
        estimate.utilities_and_draws(states), learner.estimate.utilities_and_draws(states), strict=True
    ):
        np.testing.assert_array_equal(kept, learned)
    text = read(write_report(directory)).text
    assert f"The posterior is over {len(estimate.multiples)} choices of length scales as well" in text
    found = learner.estimate.hyperparameters()
    for name in ("lapse_rate", "steepness"):
        low, high = (number(found[f"{name} {end}"]) for end in ("lower", "upper"))
        assert f"{name.replace('_', ' ')}: {number(found[name])} ({low} to {high})" in text.lower()
    assert learner.iterations[-1]["hyperparameters"] == found
    assert "What was inferred besides the weights" in text


def test_few_predictions_are_no_ground_for_a_warning(contents):
    tables = report_tables.iterations_table(contents.iterations), report_tables.answers_table(contents)
    for total, expected in ((9, False), (10, True)):
        scores = score_predictions(np.full(total, 0.999), np.zeros(total, dtype=bool))  # certain, and wrong
        found = [warning.what for warning in find_warnings(contents, *tables, scores)]
        assert any("overconfident" in what for what in found) == expected


def test_the_most_surprising_answer_comes_first_and_ties_last():
    columns = {"probability": [0.9, np.nan, 0.2, np.nan], "before": [0.5, np.nan, 0.6, 0.1], "margin": [1.0, 2, 3, 4]}
    table = xr.Dataset({name: ("answer", values) for name, values in columns.items()})
    np.testing.assert_array_equal(surprise_order(table), [3, 2, 0, 1])


def test_the_utility_of_states_is_that_of_the_estimate_with_the_spread_of_its_draws(gridworld_run, contents):
    run = bayespbrl.load(gridworld_run)
    table = report_tables.utility_table(contents)
    assert (table.attrs["kind"], table.attrs["shape"]) == ("grid", (5, 5))
    np.testing.assert_allclose(table["used"], run.estimate.utilities(np.arange(25)))
    np.testing.assert_allclose(table["mean"], table["used"])
    _, draws = run.estimate.utilities_and_draws(np.arange(25))
    np.testing.assert_allclose(table["sd"], draws.std(axis=0), rtol=0.15)
    np.testing.assert_allclose(table["prior_sd"], run.settings.model.prior_scale / run.estimate.scales[0])
    assert int(table["visits"].sum()) == sum(len(trajectory.states) for trajectory in run.trajectories)
    assert table.sizes["draw"] == 3


def test_progress_is_the_utility_of_each_iterations_trajectories_by_the_last_estimate(
    gridworld_run, gridworld_copy, contents
):
    run = bayespbrl.load(gridworld_run)
    draws = run.estimate.trajectory_draws(run.trajectories)
    by_iteration = draws.reshape(len(draws), 3, 10).mean(axis=2)
    relative = by_iteration - by_iteration[:, [2]]
    table = report_tables.progress_table(contents)
    assert table["iteration"].values.tolist() == [1, 2, 3]
    expected = run.estimate.trajectory_utilities(run.trajectories).reshape(3, 10).mean(axis=1)
    np.testing.assert_allclose(table["utility"], expected - expected[2])
    spread = relative.std(axis=0).max()
    np.testing.assert_allclose(table["lower"], np.quantile(relative, 0.05, axis=0), atol=0.1 * spread)
    np.testing.assert_allclose(table["upper"], np.quantile(relative, 0.95, axis=0), atol=0.1 * spread)
    assert float(table["lower"][0]) < float(table["utility"][0]) < float(table["upper"][0])
    (gridworld_copy / "iterations" / "0002.nc").unlink()
    assert report_tables.progress_table(read_contents(gridworld_copy))["iteration"].values.tolist() == [1, 3]


@pytest.mark.slow
def test_the_summary_counts_the_comparisons_since_the_undominated_trajectory(tmp_path):
    asked = []

    def expert(first, second):  # the newcomer of the third question is the best for good
        newcomer = learner.ask()[0].newcomer
        asked.append(newcomer)
        better = asked.index(newcomer) < 3
        return "first" if (first is learner.trajectories[newcomer]) == better else "second"

    learner = start(tmp_path / "run", utility="linear-program", iterations=5)
    learner.run(expert)
    best = asked[2]
    text = read(write_report(tmp_path / "run")).text
    assert f"Undominated among all compared trajectories: number {best} (of iteration 2)." in text
    assert "3 comparisons since then found nothing better." in text


@pytest.mark.slow
@pytest.mark.parametrize(("observations", "kind", "size"), [(1, "line", 60), (2, "plane", 3600), (4, "cloud", 11 * 30)])
def test_states_of_any_dimension_are_shown(tmp_path, observations, kind, size):
    env = Drift(observations)
    learner = bayespbrl.start(env, tmp_path / "run", **(QUICK | {"iterations": 1, "trajectories_per_iteration": 30}))
    learner.run(ReturnExpert())
    content = assembled(read_contents(tmp_path / "run", env=env))
    assert not any("could not be made" in paragraph for section in content.sections for paragraph in section.text)
    table = report_tables.utility_table(read_contents(tmp_path / "run", env=env))
    assert table.attrs["kind"] == kind
    assert table.sizes["state"] == size
    if kind == "cloud":
        assert table.attrs["dimensions"] == (1, 3)  # the others hardly leave their place


def test_a_dimension_that_is_constant_has_a_map_with_a_height():
    states = np.array([[-1.0, 0.5], [3.0, 0.5]])
    grid, _ = report_tables._states_to_show(None, states, np.random.default_rng(0))
    np.testing.assert_allclose([grid.min(axis=0), grid.max(axis=0)], [[-1.0, 0.0], [3.0, 1.0]])


class Drift(gymnasium.Env):
    """Ten steps; the odd dimensions (or the only one) go where the action says, the others stay but for one jump."""

    def __init__(self, observations):
        self.observation_space = gymnasium.spaces.Box(-100, 100, (observations,))
        self.action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.time = self.np_random.normal(size=self.observation_space.shape), 0
        self.state[0::2] *= 1.0 if self.state.size < 3 else 1e-3
        return self.state.astype(np.float32), {}

    def step(self, action):
        self.time += 1
        moving = slice(1, None, 2) if self.state.size > 1 else slice(None)
        self.state[moving] += 2 * int(action) - 1
        if self.state.size > 2 and self.time == 10 and self.np_random.random() < 0.1:
            self.state[0::2] += 50.0
        return self.state.astype(np.float32), float(self.state[-1]), False, self.time == 10, {}


def test_every_figure_takes_axes_and_returns_them_and_every_table_is_a_data_set(contents):
    iterations = report_tables.iterations_table(contents.iterations)
    states, answers = report_tables.utility_table(contents), report_tables.answers_table(contents)
    scores, compared = report_tables.prequential_table(contents), report_tables.trajectories_table(contents)
    ranking = report_tables.ranking_table(contents)
    progress = report_tables.progress_table(contents)
    tables = (iterations, states, answers, scores, compared, ranking, progress)
    assert all(isinstance(table, xr.Dataset) for table in tables)
    best = contents.preferences.undominated[-1]
    assert set(ranking["trajectory"].values.tolist()) == {*range(20, 30), best}  # the newest, and the undominated one
    line = states.assign_attrs(kind="line")
    calls = [(report_figures.plot_column, iterations, "kl"), (report_figures.plot_answers, answers)]
    calls += [(report_figures.plot_states, states, states["mean"].values), (report_figures.plot_state_bands, line)]
    calls += [(report_figures.plot_trajectories, compared), (report_figures.plot_progress, progress)]
    names = ("plot_value", "plot_rhat", "plot_effective_sample_size", "plot_bound", "plot_temperature", "plot_entropy")
    calls += [(getattr(report_figures, name), iterations) for name in names]
    drawers = {name for name in vars(report_figures) if name.startswith("plot_")}
    assert {call[0].__name__ for call in calls} == drawers
    for draw, *arguments in calls:
        axes = Figure().subplots()
        options = {"label": "utility"} if draw is report_figures.plot_states else {}
        assert draw(*arguments, axes, **options) is axes
        assert isinstance(axes, Axes)
        assert axes.has_data()


def test_the_bound_of_a_first_iteration_can_be_seen():
    table = xr.Dataset(
        {name: ("iteration", [0.3]) for name in ("kl_bound", "kl", "kl_fitted_policy")}, {"iteration": [1]}
    )
    bound, *others = report_figures.plot_bound(table, Figure().subplots()).lines
    assert bound.get_marker() != "None"
    assert bound.get_zorder() > max(other.get_zorder() for other in others)


def test_a_schedule_may_report_any_statistics(tmp_path):
    def clock(situation):
        return Bound(0.3, "by the clock", statistics={"iteration": float(situation.iteration), "kl": 0.5})

    start(tmp_path / "run", utility="linear-program", schedule=clock, iterations=2).run(ReturnExpert())
    page = write_report(tmp_path / "run").read_text(encoding="utf-8")
    assert "could not be made" not in page
    assert "by the clock" in page


# Warnings.


def test_every_warning_has_a_remedy_and_what_is_not_in_order_is_warned_of(contents):
    assert [summary["iteration"] for summary in contents.iterations] == [1, 2, 3]
    changes = [{"utility_converged": False, "rhat_max": 1.5}, {"reps_converged": False}, {"bound_active": False}]
    changes[1] |= {"policy_fit_converged": False}
    changes[2] |= {"entropy": 0.01, "value": -1000.0}
    warnings = warnings_of(changed(contents, changes))
    assert all(warning.remedy for warning in warnings)
    found = " ".join(warning.what for warning in warnings)
    assert "did not converge in iteration 1." in found
    assert "REPS did not converge in iteration 2:" in found
    assert "The fit of the policy did not converge in iteration 2:" in found
    assert "bound was inactive in iteration" in found
    assert "entropy collapsed" in found
    assert "value has fallen" in found


def test_of_several_updates_the_policys_kl_is_compared_with_the_bound_and_not_the_last_of_reps(contents):
    several = {"updates": 3, "kl_bound": 0.3, "kl": 0.005, "kl_fitted_policy": 0.12}

    def of_the_fitted_policy(**changes):
        found = warnings_of(changed(contents, 3 * [several | changes]))
        return [warning for warning in found if "fitted policy moved" in warning.what]

    assert not of_the_fitted_policy()
    for fitted, words in ((1.0, "more than three times as far"), (0.05, "less than a third as far")):
        (warning,) = of_the_fitted_policy(kl_fitted_policy=fitted)
        assert words in warning.what
        assert "--updates-per-iteration" not in warning.remedy
    # a refit moves a policy a little whatever the bound; where the bound is inactive REPS did not go as far
    assert not of_the_fitted_policy(kl_bound=0.004, kl_fitted_policy=0.06)
    assert not of_the_fitted_policy(kl_fitted_policy=0.0001, bound_active=False)
    (warning,) = of_the_fitted_policy(updates=1, kl=0.3, kl_fitted_policy=0.05)
    assert "--updates-per-iteration 3" in warning.remedy
    _, (picture, *_) = report_sections.updates(
        report_tables.iterations_table(changed(contents, 3 * [several]).iterations)
    )
    assert "Where an iteration had several updates" in picture.caption


@pytest.mark.slow
def test_iterations_without_a_question_are_counted(page, tmp_path):
    run = start(tmp_path / "run", utility="linear-program", unasked_iterations=1, iterations=4).run(ReturnExpert())
    text = read(bayespbrl.load(tmp_path / "run").report()).text
    assert run.preferences.answers == 3
    assert "After 3 answers and 4 iterations, 2 of them without a question, the policy's value" in text
    assert "most iterations in a row without a question, when sure1" in text
    assert "Points above one another" in text
    assert "of them without a question" not in page.text
    skipped = start(tmp_path / "skipped", utility="linear-program")
    while questions := skipped.ask():
        skipped.tell(["skip" if skipped.state.iteration == 1 else ReturnExpert()(*questions[0].trajectories)])
    assert [summary["answers"] for summary in skipped.iterations] == [2, 2, 3]
    assert "of them without a question" not in read(bayespbrl.load(tmp_path / "skipped").report()).text


def test_an_answer_that_the_estimate_contradicts_is_named(tmp_path):
    trick = iter(["first", "first", "second", "first"])
    directory = tmp_path / "run"
    learner = start(directory, utility="linear-program", iterations=1)
    learner.run(lambda first, second: next(trick))
    contents = read_contents(directory)
    table = report_tables.answers_table(contents)
    assert (table["margin"].values > 0).all()
    reversed_answers = tuple(replace(answer, answer="second") for answer in contents.answers)
    assert any("contradicts 2 answers: 1–2" in text for text in warned(replace(contents, answers=reversed_answers)))
    (warning,) = [
        each for each in warnings_of(replace(contents, answers=reversed_answers)) if "contradicts" in each.what
    ]
    assert "lapse rate" not in warning.remedy  # a linear program has none
    assert "features" in warning.remedy
    known = replace(contents.settings, estimation=replace(contents.settings.estimation, utility="known-reward"))
    told = warnings_of(replace(contents, answers=reversed_answers, settings=known))
    assert any("something else than the reward" in each.remedy for each in told)
    assert not any("features of your own" in each.remedy for each in told)
    rounded = table.assign(margin=("answer", np.array([1.0, -2e-16])))
    assert report_tables.contradicted(rounded).tolist() == [False, False]


@pytest.mark.slow
def test_a_tie_is_said_to_be_used_and_the_asked_pair_is_found_among_those_of_its_answer(tmp_path):
    said = iter(["first", "tie", "second"])
    directory = tmp_path / "run"
    start(directory, iterations=2).run(lambda first, second: next(said))
    contents = read_contents(directory)
    text = read(write_report(directory)).text
    assert "not used by the model" not in text
    assert any("ties: they say that two are alike" in each for each in warned(contents))
    for answer in contents.answers:
        among = contents.preferences.pairs if answer.states_order else contents.preferences.ties
        assert {*among[answer.row]} == {answer.first, answer.second}


@pytest.mark.slow
def test_where_all_answers_are_ties_each_after_the_first_has_a_probability_beforehand(tmp_path):
    directory = tmp_path / "run"
    start(directory, iterations=3).run(lambda first, second: "tie")
    contents = read_contents(directory)
    tied = contents.answers[-1]
    assert 0 < tied.before == 1 - tied.stated < 1
    assert 0.5 < float(report_tables.answers_table(contents)["probability"][-1]) < 1
    text = read(write_report(directory)).text
    assert "No answer that says which is better could be predicted before it was given." in text
    assert "ties" in text[text.index("Posterior predictive checks") :]
    assert "None of them says which is better." in text


@pytest.mark.parametrize(
    ("optimum", "words"), [(200.0, "of the optimum 200"), (0.0, "; the optimum is 0"), (-10.0, "; the optimum is −10")]
)
def test_the_value_is_a_share_of_a_positive_optimum_alone(contents, optimum, words):
    class Known:
        def __init__(self):
            self.optimum = optimum

        def __getattr__(self, name):
            return getattr(contents, name)

    text = report_summary._value(Known(), report_tables.iterations_table(contents.iterations))
    assert words in text
    assert ("%" in text) == (optimum > 0)


def test_a_run_without_reward_is_not_said_to_be_without_progress(contents):
    rows = [summary | {"value": 0.0} for summary in contents.iterations]
    text = report_summary._value(contents, report_tables.iterations_table(rows))
    assert text.endswith("the environment may give no reward.")


def test_a_run_in_progress_is_continued_by_those_who_answered(tmp_path):
    learner = start(tmp_path / "a run", expert="page")
    learner.ask()
    learner.tell(["first"], answerer="Ada")
    text = report_write._state(read_contents(tmp_path / "a run"))
    assert text.endswith(f"Continue it with: bayespbrl ask '{tmp_path / 'a run'}' --answerer=Ada")


def test_how_a_run_in_progress_is_continued_is_no_command_that_would_be_refused(tmp_path):
    for name, expert, end in (
        ("terminal", "terminal", f"bayespbrl resume {tmp_path / 'terminal'} --answerer=Bob"),  # one at a time
        ("simulated", "return", f"in Python, as it was begun, with bayespbrl.resume('{tmp_path / 'simulated'}')."),
    ):
        learner = start(tmp_path / name, expert=expert, iterations=3)
        for who in ("Ada", "Bob"):
            learner.ask()
            learner.tell(["first"], answerer=who)
        assert report_write._state(read_contents(tmp_path / name)).endswith(end)


def test_margins_are_of_the_utility_that_is_acted_on(tmp_path):
    learner = start(tmp_path / "run", utility="posterior-draw", iterations=3)
    learner.run(lambda first, second: "first")
    table = report_tables.answers_table(read_contents(tmp_path / "run"))
    for row, pair in enumerate(learner.preferences.pairs):
        preferred, dominated = learner.estimate.trajectory_utilities([learner.state.compared[each] for each in pair])
        assert float(table["margin"][row]) == pytest.approx(preferred - dominated)
    assert np.isfinite(table["margin_sd"]).all()


def test_pictures_are_not_written_through_a_link(gridworld_copy, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (gridworld_copy / "report_files").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ValueError, match="report_files: expected a folder of the run's own, got a link"):
        report_write.write_report(gridworld_copy, format="md")
    assert not list((tmp_path / "elsewhere").iterdir())


def test_an_interval_is_drawn_where_it_is_though_the_utility_lies_outside(drawn):
    data = {"hidden_return": [0.0, 1.0], "utility": [3.0, -1.0], "lower": [0.0, 0.0], "upper": [2.0, 2.0]}
    axes = Figure().subplots()
    report_figures.plot_trajectories(xr.Dataset({name: ("trajectory", each) for name, each in data.items()}), axes)
    (intervals,) = axes.collections
    assert [path.vertices[:, 1].tolist() for path in intervals.get_paths()] == [[0.0, 2.0]] * 2


@pytest.mark.slow
def test_what_a_schedule_and_the_choice_of_hyperparameters_reported_is_shown(gridworld_copy):
    rows = [
        {
            "schedule": {"statistic": 0.5 + i / 10, "reason": "<b>sure</b> enough", "diagnostics": {"rhat_max": 1.0}},
            "hyperparameters": {"bandwidth_factor": 2.0**i, "weights": [0.25, 0.75]},
            "action_standard_deviation": [0.3, 0.1],
        }
        for i in range(3)
    ]
    events = [json.loads(line) for line in (gridworld_copy / "events.jsonl").read_text().splitlines()]
    for event, row in zip((e for e in events if e["event"] == "improved"), rows, strict=True):
        event["summary"].update(row)
    (gridworld_copy / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events))
    table = report_tables.iterations_table(read_contents(gridworld_copy).iterations)
    np.testing.assert_allclose(table["schedule statistic"], [0.5, 0.6, 0.7])
    np.testing.assert_allclose(table["hyperparameters bandwidth_factor"], [1, 2, 4])
    np.testing.assert_allclose(table["hyperparameters weights 1"], 0.75)
    np.testing.assert_allclose(table["action_standard_deviation"], 0.2)
    path = write_report(gridworld_copy)
    assert "<b>sure</b> enough" in read(path).text  # as text,
    assert "<b>sure" not in path.read_text()  # not as markup
    assert "diagnostics rhat_max" in read(path).text


# Runs in progress, and damaged ones.


@pytest.mark.slow
def test_a_run_in_progress_has_a_report_at_every_stage(tmp_path):
    directory = tmp_path / "run"
    learner = start(directory, iterations=2)
    stages = ["no iteration is completed, 0 answers", "no iteration is completed, 0 answers have been given"]
    for stage in range(4):
        text = read(write_report(directory)).text
        assert "could not be made" not in text
        if stage < 2:
            assert stages[stage] in text
        if stage:
            assert f"Question {stage} waits for an answer." in text
        questions = learner.ask()
        if stage:
            learner.tell([ReturnExpert()(*query.trajectories) for query in questions])
    assert "Finished" in read(write_report(directory)).text


@pytest.mark.parametrize("utility", ["linear-program", "known-reward"])
def test_a_method_without_a_posterior_is_named(tmp_path, utility):
    start(tmp_path / "run", utility=utility).run(ReturnExpert())
    text = read(write_report(tmp_path / "run")).text
    assert f"method {utility} has no posterior" in text
    assert ("No reward enters" in text) == (utility == "linear-program")
    assert "could not be made" not in text


@pytest.mark.slow
def test_a_run_whose_answers_were_all_ties_has_a_report(tmp_path):
    start(tmp_path / "run", iterations=1).run(lambda first, second: "tie")
    text = read(write_report(tmp_path / "run")).text
    assert "could not be made" not in text
    assert "2 of 2 answers were ties" in text


@pytest.mark.parametrize(("answers", "skipped"), [(("first", "skip", "first"), ""), (("skip",) * 3, "3 of 3")])
def test_a_run_whose_questions_were_mostly_skipped_is_told_so(tmp_path, answers, skipped):
    learner = start(tmp_path / "run", iterations=3)
    for answer in answers:
        learner.tell([answer] * len(learner.ask()))
    text = read(write_report(tmp_path / "run")).text
    assert (f"{skipped} questions were skipped: they taught nothing." in text) == bool(skipped)


def test_a_plain_chain_says_nothing_of_ties_and_asks_for_more_draws(tmp_path):
    options = {"utility": "posterior-mean", "plain_draws": 400, "hyperparameters": "given", "evaluation_episodes": 2}
    learner = start(tmp_path / "run", **options)
    for answer in ("first", "tie", "skip", "tie", "second"):
        learner.tell([answer] * len(learner.ask()))
    answers = report_tables.answers_table(read_contents(tmp_path / "run"))
    tied = answers["said"].values == "tie"
    assert np.isnan(answers["probability"].values[tied]).all()
    assert np.isfinite(answers["probability"].values[answers["said"].values == "first"]).all()
    text = read(write_report(tmp_path / "run")).text
    assert "not used by the model" in text
    assert "rank plots" not in text.lower()
    assert "take more (--plain-draws), or leave that option out" in text
    given = int((answers["said"].values != "skip").sum())
    assert f"{tied.sum()} of {given} answers were ties" in text


@pytest.mark.parametrize(("again", "better"), [(2, True), (3, False)])
def test_what_is_undominated_says_what_it_leaves_out(contents, again, better):
    """A repeated question does not say whom later trajectories are compared with, and may contradict."""
    preferences = Preferences().start(1).add(2, 1, preferred=2).add(3, 2, preferred=2)
    preferences = preferences.add_repeated(3, 2, preferred=again)
    shown = ((1, 2, Answer.SECOND), (2, 3, Answer.FIRST), (3, 2, Answer.SECOND if again == 2 else Answer.FIRST))
    answers = tuple(AnsweredQuestion(k + 1, 1, *each, k) for k, each in enumerate(shown))
    (text,) = report_summary._undominated(replace(contents, preferences=preferences, answers=answers))
    assert ("found nothing better" in text) == better
    assert ("leaving out repeated questions" in text) == (not better)


def test_a_policy_that_was_compared_and_is_level_has_its_gain():
    check = {"trust": 1.0, "stepped_back": False, "gain": 0.0, "standard_error": 0.0}
    schedule = {"gain": 0.0, "standard_error": 0.0}  # of a user's own
    summaries = [{"check": check | {"best": best}, "schedule": schedule} for best in (0, 0, 2)]
    table = report_tables.iterations_table(summaries)
    np.testing.assert_array_equal(table["check gain"], [np.nan, 0, np.nan])
    np.testing.assert_array_equal(table["schedule gain"], [0, 0, 0])


@pytest.mark.slow
def test_features_of_the_users_are_asked_for_and_used_when_passed(tmp_path):
    def own(states):
        return np.stack([states % 5, states // 5], axis=1).astype(float)

    directory = tmp_path / "run"
    start(directory, features=own, iterations=2).run(ReturnExpert())
    without = read(write_report(directory)).text
    assert "features are a function of your own, and it was not passed again" in without
    assert "could not be made" not in without
    assert "largest R̂" in without  # what needs no features is there
    passed = read(bayespbrl.load(directory, features=own).report()).text
    assert "function of your own" not in passed
    assert "The utility over the cells of the grid" in passed


def test_a_run_that_the_command_line_cannot_continue_is_continued_in_python(tmp_path):
    learner = start(tmp_path / "mine", expert="other")
    learner.tell([ReturnExpert()(*query.trajectories) for query in learner.ask()])
    text = read(write_report(tmp_path / "mine")).text
    assert f"in Python with bayespbrl.resume('{tmp_path / 'mine'}')" in text
    assert "bayespbrl resume" not in text


def test_a_run_whose_answers_all_came_in_its_first_iteration_is_finished_by_the_summaries_alone():
    settings = bayespbrl.Learner("gridworld", preset="paper", answers=2, iterations=None).settings
    summaries = ({"answers": 2},) * 6
    contents = RunContents(Path(), settings, summaries)
    assert contents.finished == settings.finished(6, 2, 5, 0) is True
    assert not replace(contents, iterations=summaries[:2]).finished


def test_a_log_that_has_lost_iterations_is_not_called_intact(gridworld_copy):
    log = gridworld_copy / "events.jsonl"
    log.write_bytes(log.read_bytes()[:700])
    contents = read_contents(gridworld_copy)
    assert contents.finished  # by the summary
    found = {warning.what: warning.remedy for warning in warnings_of(contents)}
    lost = next(remedy for what, remedy in found.items() if "completed iterations, summary.json 3" in what)
    assert "the run cannot continue without it" in lost
    cut_off = next(remedy for what, remedy in found.items() if "last line is cut off" in what)
    assert cut_off.startswith("No action is needed if nothing else is damaged")


def test_an_environment_that_cannot_be_opened_costs_only_what_needs_it(gridworld_copy):
    settings = json.loads((gridworld_copy / "settings.json").read_text())
    (gridworld_copy / "settings.json").write_text(json.dumps(settings | {"env": "Mine-v0"}))
    text = read(write_report(gridworld_copy)).text
    assert "environment cannot be opened" in text
    assert "could not be made" not in text
    assert "largest R̂" in text


@pytest.mark.slow
def test_a_feature_function_that_fails_costs_only_its_sections(tmp_path):
    calls = []

    def own(states):
        if calls:
            raise RuntimeError("no more of this")
        return np.stack([states % 5, states // 5], axis=1).astype(float)

    directory = tmp_path / "run"
    start(directory, features=own, iterations=1).run(ReturnExpert())
    calls.append(1)
    text = read(write_report(directory, features=own)).text
    assert "the one that was passed fails (RuntimeError: no more of this)" in text
    assert "could not be made" not in text
    assert "largest R̂" in text
    other = read(write_report(directory, features=lambda states: np.ones((len(states), 3)))).text
    assert "has 3 features, the run's 2" in other


@pytest.mark.parametrize("iteration", [*(pytest.param(i, marks=pytest.mark.slow) for i in (1, 2)), 3])
def test_a_truncated_iteration_file_is_named_and_the_rest_is_reported(gridworld_copy, iteration):
    file = gridworld_copy / "iterations" / f"000{iteration}.nc"
    file.write_bytes(file.read_bytes()[:3000])
    before = files(gridworld_copy)
    text = read(write_report(gridworld_copy)).text
    assert files(gridworld_copy) == before
    assert f"Missing data: iterations/000{iteration}.nc" in text
    assert "could not be made" not in text
    assert "policy's value" in text
    assert ("utility estimate that can be read is that of iteration 2" in text) == (iteration == 3)


@pytest.mark.slow
def test_a_log_that_is_cut_off_or_damaged_is_read_up_to_there(gridworld_copy):
    file = gridworld_copy / "events.jsonl"
    lines = file.read_bytes().splitlines(keepends=True)
    file.write_bytes(b"".join(lines) + lines[-1][:20])
    assert any("last line is cut off" in text for text in warned(read_contents(gridworld_copy)))
    (gridworld_copy / "summary.json").unlink()
    file.write_bytes(b"".join(lines[:8]) + b"\xff\x00garbage\n" + b"".join(lines[8:]))
    contents = read_contents(gridworld_copy)
    assert len(contents.iterations) == 1
    assert any("line 9" in text for text in warned(contents))
    assert "could not be made" not in read(write_report(gridworld_copy)).text


@pytest.mark.parametrize(
    "damage",
    [
        "missing log",
        *(
            pytest.param(kind, marks=pytest.mark.slow)
            for kind in ("foreign log", "missing iterations", "broken summary")
        ),
    ],
)
def test_whatever_is_missing_there_is_a_report(gridworld_copy, damage):
    if damage == "missing log":
        (gridworld_copy / "events.jsonl").unlink()
    elif damage == "foreign log":
        (gridworld_copy / "events.jsonl").write_text('{"event": "answered"}\n[]\n')
    elif damage == "missing iterations":
        shutil.rmtree(gridworld_copy / "iterations")
    else:
        (gridworld_copy / "summary.json").write_text("{")
    text = read(write_report(gridworld_copy)).text
    assert "Missing data" in text
    assert "could not be made" not in text
    assert "policy's value" in text


@pytest.mark.slow
def test_an_iteration_that_is_no_number_ends_what_is_read_of_the_log(gridworld_copy):
    lines = (gridworld_copy / "events.jsonl").read_text().splitlines()
    broken = [
        line.replace('"event": "improved", "iteration": 2', '"event": "improved", "iteration": "2"') for line in lines
    ]
    assert broken != lines
    (gridworld_copy / "events.jsonl").write_text("".join(line + "\n" for line in broken))
    contents = read_contents(gridworld_copy)
    number = 1 + [line != whole for line, whole in zip(broken, lines, strict=True)].index(True)
    assert any(f"events.jsonl, line {number}: expected an event" in text for text in warned(contents))
    assert "could not be made" not in read(write_report(gridworld_copy)).text


@pytest.mark.slow
def test_summaries_without_answers_still_make_a_report(gridworld_copy):
    (gridworld_copy / "events.jsonl").unlink()
    summary = json.loads((gridworld_copy / "summary.json").read_text())
    for entry in summary["iterations"]:
        del entry["answers"]
    (gridworld_copy / "summary.json").write_text(json.dumps(summary))
    assert "policy's value" in read(write_report(gridworld_copy)).text


def test_a_run_without_any_readable_data_has_a_report(gridworld_copy):
    for name in ("events.jsonl", "summary.json"):
        (gridworld_copy / name).write_text("nothing\n")
    shutil.rmtree(gridworld_copy / "iterations")
    text = read(write_report(gridworld_copy)).text
    assert "Nothing has been learnt yet" in text
    assert "could not be made" not in text


@pytest.mark.parametrize("kind", ["nowhere", "empty", "foreign", "newer", "file"])
def test_a_directory_that_is_no_run_is_refused_in_one_line(monkeypatch, capsys, gridworld_copy, tmp_path, kind):
    path = tmp_path / kind
    if kind in ("empty", "foreign"):
        path.mkdir()
    if kind == "foreign":
        (path / "settings.json").write_text("[1, 2]")
    if kind == "file":
        path.write_text("a file")
    if kind == "newer":
        path = gridworld_copy
        settings = json.loads((gridworld_copy / "settings.json").read_text())
        (gridworld_copy / "settings.json").write_text(json.dumps(settings | {"format": 99}))
    monkeypatch.setattr(sys, "argv", ["bayespbrl", "report", str(path)])
    with pytest.raises(SystemExit) as stop:
        main()
    error = capsys.readouterr().err
    assert stop.value.code == 2
    assert error.count("\n") == 1
    assert "settings" in error
    assert str(path) in error
    assert not list(tmp_path.rglob("report*"))


# The command line, and Markdown.


@pytest.mark.slow
def test_the_command_line_writes_the_report_and_says_where(monkeypatch, capsys, gridworld_copy, drawn):
    monkeypatch.setattr(sys, "argv", ["bayespbrl", "report", str(gridworld_copy), "--format", "md"])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 0
    assert "report.md" in re.sub(r"\s", "", capsys.readouterr().out)
    text = (gridworld_copy / "report.md").read_text()
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)
    assert pictures
    assert all((gridworld_copy / picture).read_bytes().startswith(b"\x89PNG") for picture in pictures)
    assert not (gridworld_copy / "report.html").exists()
    for block in re.findall(r"(?:^\|.*\n)+", text, flags=re.MULTILINE):  # every table is whole
        assert len({line.count("|") for line in block.splitlines()}) == 1


def test_an_unknown_format_is_refused(gridworld_run):
    with pytest.raises(ValueError, match="format: expected one of html, md, got 'pdf'"):
        bayespbrl.load(gridworld_run).report("pdf")


def test_a_report_replaces_the_one_before(gridworld_copy):
    (gridworld_copy / "report.html").write_text("old")
    assert write_report(gridworld_copy).read_text() != "old"
    assert [path.name for path in gridworld_copy.glob("report*")] == ["report.html"]


@pytest.mark.slow
def test_importing_the_package_does_not_import_the_report():
    code = "import sys, bayespbrl; assert not any('report' in n or n == 'jinja2' for n in sys.modules if 'bayes' in n)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.slow
def test_a_report_of_a_swing_up_run_draws_the_utility_over_the_plane(swing_up_copy, drawn):
    path = write_report(swing_up_copy)
    text = read(path).text
    assert "over the observed range" in text
    assert "could not be made" not in text
    assert path.stat().st_size < 2e6


def test_a_run_whose_last_questions_were_all_skipped_is_not_called_finished(monkeypatch, tmp_path):
    monkeypatch.setattr("bayespbrl.settings.settings.MOST_UNASKED", 2)
    options = SHORT | {"utility": "linear-program", "answers": 9, "trajectories_per_iteration": 3}
    learner = bayespbrl.start("gridworld", tmp_path / "run", **options)
    while learner.state.iteration < 4:
        learner.tell(["first" if learner.state.iteration < 2 else "skip"] * len(learner.ask()))
    assert not learner.finished
    contents = read_contents(tmp_path / "run")
    given = [summary["answers"] for summary in contents.iterations]
    assert given[0] < given[1] == given[2] == given[3]
    assert not contents.finished
