"""The report of a run: what it says, that it needs nothing else, and what it does with runs that are not whole."""

import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import bayespbrl
from bayespbrl import ReturnExpert
from bayespbrl.cli.commands import main
from bayespbrl.diagnostics.predictions import answer_probabilities
from bayespbrl.diagnostics.prequential import score_predictions
from bayespbrl.diagnostics.report import document as report_document
from bayespbrl.diagnostics.report import figures as report_figures
from bayespbrl.diagnostics.report import tables as report_tables
from bayespbrl.diagnostics.report import warnings as report_warnings
from bayespbrl.diagnostics.report.answers import surprise_order
from bayespbrl.diagnostics.report.contents import read_evidence
from bayespbrl.diagnostics.report.summary import figure
from bayespbrl.diagnostics.report.write import assembled, write_report
from bayespbrl.improvement.schedules import Bound
from bayespbrl.models.likelihoods import log_prob
from bayespbrl.runs.iteration_files import read_iteration
from bayespbrl.trajectories import trajectory_features
from bayespbrl.utility.estimate import LinearUtility

QUICK = {"iterations": 3, "max_steps": 20, "evaluation_episodes": 3, "seed": 7}


def start(directory, **changes):
    return bayespbrl.start("gridworld", directory, **(QUICK | changes))


@pytest.fixture
def drawn():
    """Asked for by tests that need real pictures."""


@pytest.fixture(autouse=True)
def quick_pictures(request, monkeypatch):
    """Drawing takes most of a report's time; most tests read its text."""
    if "drawn" not in request.fixturenames:
        monkeypatch.setattr(report_document, "_png", lambda *arguments, **options: b"\x89PNG")


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


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run with a posterior, its second answer wrong and its third a tie; only reports are to be written to it."""
    directory = tmp_path_factory.mktemp("runs") / "finished"
    answers = iter(["right", "wrong", "tie", "right"])

    def expert(first, second):
        right = ReturnExpert()(first, second)
        return {"right": right, "wrong": "second" if right == "first" else "first", "tie": "tie"}[next(answers)]

    start(directory).run(expert)
    return directory


@pytest.fixture
def copy(finished, tmp_path):
    without = shutil.ignore_patterns("report*")
    return Path(shutil.copytree(finished, tmp_path / "copy", ignore=without))


def contents(directory):
    return {path: path.read_bytes() for path in directory.rglob("*") if path.is_file() and "report" not in path.name}


def warned(evidence):
    return [warning.what for warning in assembled(evidence)["warnings"]]


# What the report says.


def test_the_report_is_one_file_that_fetches_nothing_and_changes_nothing_else(finished, drawn):
    before = contents(finished)
    path = write_report(finished)
    assert contents(finished) == before
    assert path == finished / "report.html"
    page = read(path)
    assert page.images
    assert all(address.startswith(("data:image/png;base64,", "#")) for address in page.addresses)
    assert not re.search(r"https?:|@import|url\(|<script", path.read_text())
    assert all(image["alt"] for image in page.images)


def test_the_sections_come_in_the_order_of_the_questions_a_reader_asks(finished):
    page = read(write_report(finished))
    order = ["What was learnt", "Warnings", "Learning curve", "converged", "thinks is good", "answers", "probabilities"]
    order += ["policy updates", "σ and m", "All iterations"]
    assert len(page.headings) == len(order)
    assert all(part in heading for part, heading in zip(order, page.headings, strict=True))
    assert "could not be made" not in page.text


def test_the_head_says_the_value_and_how_far_the_posterior_can_be_trusted(finished):
    run = bayespbrl.load(finished)
    text = read(run.report()).text
    last = run.iterations[-1]
    assert "Finished: 3 iterations." in text
    assert f"is {figure(last['value'])}" in text
    assert f"largest R̂ {last['rhat_max']:.3f}" in text
    assert f"agrees with {last['pairs_satisfied']} of {last['pairs']} preferences" in text


def test_every_answer_is_drawn_with_both_trajectories_and_its_probability(finished):
    page = read(write_report(finished))
    evidence = read_evidence(finished)
    assert len(evidence.answers) == 4
    for record in evidence.answers:
        assert f"Question {record.question}:" in page.text
        for number in (record.first, record.second):
            assert f"Drawing of trajectory {number}." in [image["alt"] for image in page.images]


def test_probabilities_of_answers_are_those_of_the_posteriors_before_and_after(finished):
    evidence = read_evidence(finished)
    table = report_tables.answers_table(evidence)
    run = bayespbrl.load(finished)
    likelihood = np.exp(run.posterior["log_likelihood"]["answers"].values).mean(axis=(0, 1))
    np.testing.assert_allclose(table["before"][:2], 0.5)  # the prior knows nothing
    np.testing.assert_array_equal(table["said"] == "tie", [False, False, True, False])
    assert np.isnan(table["before"][2])
    assert np.isnan(table["probability"][2])
    np.testing.assert_allclose(table["probability"].values[[0, 1]], likelihood[:2])
    # the third iteration's answer, by the estimate of the second
    log = [json.loads(line) for line in (finished / "events.jsonl").read_text().splitlines()]
    asked = [event for event in log if event["event"] == "asked"][-1]
    said = [event for event in log if event["event"] == "answered"][-1]["answer"]
    parts = read_iteration(finished / "iterations" / "0002.nc", "improved")
    both = [run.trajectories[asked[name]] for name in ("first", "second")]
    sums = trajectory_features(both, parts["estimate"].features, discount=run.settings.discount)
    difference = (sums[[0]] - sums[[1]]) / parts["estimate"].scale
    expected = answer_probabilities(parts["estimate"].posterior, difference)[0, 0 if said == "first" else 1]
    assert float(table["before"][3]) == pytest.approx(expected)
    assert float(table["probability"][3]) == pytest.approx(likelihood[-1])
    utilities = run.estimate.trajectory_utilities(both)
    margin = (utilities[0] - utilities[1]) * (1 if said == "first" else -1)
    assert float(table["margin"][3]) == pytest.approx(margin, rel=1e-6)  # in the units of the utility


def test_of_an_averaged_utility_the_answers_have_the_probabilities_of_the_average(tmp_path):
    options = {"iterations": 4, "max_steps": 20, "evaluation_episodes": 3, "centres": 30, "seed": 3}
    run = bayespbrl.start("swing-up", tmp_path / "run", hyperparameters="averaged", **options).run(ReturnExpert())
    evidence = read_evidence(tmp_path / "run")
    table = report_tables.answers_table(evidence)
    of_one_setting = []
    for k, record in list(enumerate(evidence.answers))[2:]:
        before = read_iteration(tmp_path / "run" / "iterations" / f"{record.iteration - 1:04d}.nc", "improved")[
            "estimate"
        ]
        numbers = (record.first, record.second)[:: 1 if str(record.answer) == "first" else -1]
        both = [run.trajectories[number] for number in numbers]
        for name, estimate in (("before", before), ("probability", run.estimate)):
            margins = -np.diff(estimate.trajectory_draws(both))[:, 0]
            expected = np.exp(log_prob(estimate.likelihood, jnp.asarray(margins))).mean()
            assert float(table[name][k]) == pytest.approx(float(expected), abs=1e-4)
        assert float(table["margin"][k]) == pytest.approx(margins.mean(), rel=1e-6)
        assert float(table["margin_sd"][k]) == pytest.approx(margins.std(), rel=1e-6)
        of_one_setting.append(float(np.mean(np.diff(LinearUtility.trajectory_draws(before, both)) < 0)))
    assert np.abs(table["before"].values[2:] - of_one_setting).max() > 0.03  # or this could not tell them apart
    assert "it gives the answers their probabilities" in read(write_report(tmp_path / "run")).text


def test_few_predictions_are_no_ground_for_a_warning(finished):
    evidence = read_evidence(finished)
    tables = report_tables.iterations_table(evidence.iterations), report_tables.answers_table(evidence)
    for number, warned in ((9, False), (10, True)):
        scores = score_predictions(np.full(number, 0.999), np.zeros(number, dtype=bool))  # sure, and wrong
        found = [caution.what for caution in report_warnings.warnings(evidence, *tables, scores)]
        assert any("surer than they should have been" in what for what in found) == warned


def test_the_most_surprising_answer_comes_first_and_ties_last():
    columns = {"probability": [0.9, np.nan, 0.2, np.nan], "before": [0.5, np.nan, 0.6, 0.1], "margin": [1.0, 2, 3, 4]}
    table = xr.Dataset({name: ("answer", values) for name, values in columns.items()})
    np.testing.assert_array_equal(surprise_order(table), [3, 2, 0, 1])


def test_the_utility_of_states_is_that_of_the_estimate_with_the_spread_of_its_draws(finished):
    run = bayespbrl.load(finished)
    table = report_tables.utility_table(read_evidence(finished))
    assert (table.attrs["kind"], table.attrs["shape"]) == ("grid", (5, 5))
    np.testing.assert_allclose(table["used"], run.estimate.utilities(np.arange(25)))
    np.testing.assert_allclose(table["mean"], table["used"])
    draws = run.estimate.draws(np.eye(25))
    np.testing.assert_allclose(table["sd"], draws.std(axis=(0, 1)), rtol=0.15)
    np.testing.assert_allclose(table["prior_sd"], run.settings.prior_scale / run.estimate.scale)
    assert int(table["visits"].sum()) == sum(len(trajectory.states) for trajectory in run.trajectories)
    assert table.sizes["draw"] == 3


def test_progress_is_what_the_last_estimate_thinks_of_each_iterations_trajectories(finished, copy):
    run = bayespbrl.load(finished)
    draws = run.estimate.trajectory_draws(run.trajectories)
    by_iteration = draws.reshape(len(draws), 3, 10).mean(axis=2)
    over_the_last = by_iteration - by_iteration[:, [2]]
    table = report_tables.progress_table(read_evidence(finished))
    assert table["iteration"].values.tolist() == [1, 2, 3]
    expected = run.estimate.trajectory_utilities(run.trajectories).reshape(3, 10).mean(axis=1)
    np.testing.assert_allclose(table["utility"], expected - expected[2])
    spread = over_the_last.std(axis=0).max()
    np.testing.assert_allclose(table["lower"], np.quantile(over_the_last, 0.05, axis=0), atol=0.1 * spread)
    np.testing.assert_allclose(table["upper"], np.quantile(over_the_last, 0.95, axis=0), atol=0.1 * spread)
    assert float(table["lower"][0]) < float(table["utility"][0]) < float(table["upper"][0])
    (copy / "iterations" / "0002.nc").unlink()
    assert report_tables.progress_table(read_evidence(copy))["iteration"].values.tolist() == [1, 3]


def test_the_head_says_for_how_long_nothing_better_has_come(tmp_path):
    asked = []

    def expert(first, second):  # the newcomer of the third question is the best for good
        newcomer = learner.ask()[0].newcomer
        asked.append(newcomer)
        better = asked.index(newcomer) < 3
        return "first" if (first is learner.trajectories[newcomer]) == better else "second"

    learner = start(tmp_path / "run", iterations=5)
    learner.run(expert)
    best = asked[2]
    text = read(write_report(tmp_path / "run")).text
    assert f"Undominated among all trajectories that were compared: number {best} (of iteration 2)." in text
    assert "3 comparisons since then brought nothing better." in text


@pytest.mark.parametrize(("observations", "kind", "size"), [(1, "line", 60), (2, "plane", 3600), (4, "cloud", 11 * 30)])
def test_states_of_any_dimension_are_shown(tmp_path, observations, kind, size):
    env = Drift(observations)
    learner = bayespbrl.start(env, tmp_path / "run", **(QUICK | {"iterations": 1, "trajectories_per_iteration": 30}))
    learner.run(ReturnExpert())
    content = assembled(read_evidence(tmp_path / "run", env=env))
    assert not any("could not be made" in paragraph for section in content["sections"] for paragraph in section.text)
    table = report_tables.utility_table(read_evidence(tmp_path / "run", env=env))
    assert table.attrs["kind"] == kind
    assert table.sizes["state"] == size
    if kind == "cloud":
        assert table.attrs["dimensions"] == (1, 3)  # the others hardly leave their place


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


def test_every_figure_takes_axes_and_returns_them_and_every_table_is_a_data_set(finished):
    evidence = read_evidence(finished)
    iterations = report_tables.iterations_table(evidence.iterations)
    states, answers = report_tables.utility_table(evidence), report_tables.answers_table(evidence)
    scores, compared = report_tables.prequential_table(evidence), report_tables.trajectories_table(evidence)
    ranking = report_tables.ranking_table(evidence)
    progress = report_tables.progress_table(evidence)
    tables = (iterations, states, answers, scores, compared, ranking, progress)
    assert all(isinstance(table, xr.Dataset) for table in tables)
    best = bayespbrl.load(finished).preferences.undominated[-1]
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


def test_a_schedule_may_record_what_it_likes(tmp_path):
    def clock(situation):
        return Bound(0.3, "by the clock", {"iteration": float(situation.iteration), "kl": 0.5})

    start(tmp_path / "run", schedule=clock, iterations=2).run(ReturnExpert())
    page = write_report(tmp_path / "run").read_text(encoding="utf-8")
    assert "could not be made" not in page
    assert "by the clock" in page


# Warnings.


def test_a_run_in_order_has_no_warning_and_one_that_is_not_says_what_to_do(finished, copy):
    content = assembled(read_evidence(finished))
    assert all(warning.do for warning in content["warnings"])
    summary = json.loads((copy / "summary.json").read_text())
    assert [s["iteration"] for s in summary["iterations"]] == [1, 2, 3]
    changed = [{"utility_converged": False, "rhat_max": 1.5}, {"reps_converged": False}, {"bound_active": False}]
    changed[2] |= {"entropy": 0.01, "value": -1000.0}
    rewrite(copy, changed)
    found = " ".join(warned(read_evidence(copy)))
    assert "did not converge in iteration 1." in found
    assert "REPS did not converge in iteration 2:" in found
    assert "bound was inactive in iteration" in found
    assert "entropy collapsed" in found
    assert "value has fallen" in found


def rewrite(directory, changes, **more):
    """Put other numbers into the summaries of a run."""
    lines = [json.loads(line) for line in (directory / "events.jsonl").read_text().splitlines()]
    improved = [event for event in lines if event["event"] == "improved"]
    for event, change in zip(improved, changes, strict=True):
        event["summary"].update(change)
    (directory / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in lines))


def test_of_several_updates_the_policys_kl_is_held_against_the_bound_and_not_the_last_of_reps(copy):
    several = {"updates": 3, "kl_bound": 0.3, "kl": 0.005, "kl_fitted_policy": 0.12}

    def cautions(**changes):
        rewrite(copy, 3 * [several | changes])
        return [w for w in assembled(read_evidence(copy))["warnings"] if "fitted policy went" in w.what]

    assert not cautions()
    assert "Where an iteration had several updates" in write_report(copy).read_text(encoding="utf-8")
    for fitted, words in ((1.0, "more than three times as far"), (0.05, "less than a third as far")):
        (warning,) = cautions(kl_fitted_policy=fitted)
        assert words in warning.what
        assert "--updates-per-iteration" not in warning.do
    (warning,) = cautions(updates=1, kl=0.3, kl_fitted_policy=0.05)
    assert "--updates-per-iteration 3" in warning.do


def test_iterations_that_asked_nothing_are_told(finished, tmp_path):
    run = start(tmp_path / "run", utility="linear-program", unasked_iterations=1, iterations=4).run(ReturnExpert())
    text = read(bayespbrl.load(tmp_path / "run").report()).text
    assert run.preferences.answers == 3
    assert "After 3 answers and 4 iterations, 2 of which asked nothing, the policy's value" in text
    assert ("iterations in a row without a question, at most", "1") in assembled(read_evidence(tmp_path / "run"))[
        "facts"
    ]
    assert "Points above one another" in text
    assert "asked nothing" not in read(bayespbrl.load(finished).report()).text
    skipped = start(tmp_path / "skipped", utility="linear-program")
    while questions := skipped.ask():
        skipped.tell(["skip" if skipped.state.iteration == 1 else ReturnExpert()(*questions[0].trajectories)])
    assert [summary["answers"] for summary in skipped.iterations] == [2, 2, 3]
    assert "asked nothing" not in read(bayespbrl.load(tmp_path / "skipped").report()).text


def test_an_answer_that_the_estimate_contradicts_is_named(tmp_path):
    trick = iter(["first", "first", "second", "first"])
    directory = tmp_path / "run"
    learner = start(directory, utility="linear-program", iterations=1)
    learner.run(lambda first, second: next(trick))
    evidence = read_evidence(directory)
    table = report_tables.answers_table(evidence)
    assert (table["margin"].values > 0).all()
    swapped = [record.__class__(**{**vars(record), "answer": "second"}) for record in evidence.answers]
    turned = evidence.__class__(**{**vars(evidence), "answers": tuple(swapped)})
    assert any("contradicts 2 answers: 1–2" in text for text in warned(turned))


def test_what_a_schedule_and_the_choice_of_hyperparameters_said_is_shown(copy):
    rows = [
        {
            "schedule": {"statistic": 0.5 + i / 10, "reason": "<b>sure</b> enough", "diagnostics": {"rhat_max": 1.0}},
            "hyperparameters": {"bandwidth_factor": 2.0**i, "weights": [0.25, 0.75]},
            "action_standard_deviation": [0.3, 0.1],
        }
        for i in range(3)
    ]
    rewrite(copy, rows)
    table = report_tables.iterations_table(read_evidence(copy).iterations)
    np.testing.assert_allclose(table["schedule statistic"], [0.5, 0.6, 0.7])
    np.testing.assert_allclose(table["hyperparameters bandwidth_factor"], [1, 2, 4])
    np.testing.assert_allclose(table["hyperparameters weights 1"], 0.75)
    np.testing.assert_allclose(table["action_standard_deviation"], 0.2)
    path = write_report(copy)
    assert "<b>sure</b> enough" in read(path).text  # as text,
    assert "<b>sure" not in path.read_text()  # not as markup
    assert "diagnostics rhat_max" in read(path).text


# Runs that are not whole.


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
def test_a_utility_without_a_posterior_is_said_to_have_none(tmp_path, utility):
    start(tmp_path / "run", utility=utility).run(ReturnExpert())
    text = read(write_report(tmp_path / "run")).text
    assert f"utility is {utility}, which has no posterior" in text
    assert ("No reward enters" in text) == (utility == "linear-program")
    assert "could not be made" not in text


def test_a_run_whose_answers_were_all_ties_has_a_report(tmp_path):
    start(tmp_path / "run", iterations=1).run(lambda first, second: "tie")
    text = read(write_report(tmp_path / "run")).text
    assert "could not be made" not in text
    assert "2 of 2 answers were ties" in text


def test_features_of_ones_own_are_asked_for_and_used_when_passed(tmp_path):
    def own(states):
        return np.stack([states % 5, states // 5], axis=1).astype(float)

    directory = tmp_path / "run"
    bayespbrl.start("gridworld", directory, features=own, **QUICK).run(ReturnExpert())
    without = read(write_report(directory)).text
    assert "features are a function of your own, and it was not passed again" in without
    assert "could not be made" not in without
    assert "largest R̂" in without  # what needs no features is there
    passed = read(bayespbrl.load(directory, features=own).report()).text
    assert "function of your own" not in passed
    assert "The utility over the cells of the grid" in passed


def test_a_run_that_the_command_line_cannot_go_on_with_is_sent_to_python(tmp_path):
    learner = start(tmp_path / "mine", expert="other")
    learner.tell([ReturnExpert()(*query.trajectories) for query in learner.ask()])
    text = read(write_report(tmp_path / "mine")).text
    assert f"bayespbrl.resume('{tmp_path / 'mine'}') goes on in Python" in text
    assert "bayespbrl resume" not in text


def test_a_log_that_has_lost_iterations_is_not_said_to_be_in_order(copy):
    log = copy / "events.jsonl"
    log.write_bytes(log.read_bytes()[:700])
    cautions = {warning.what: warning.do for warning in assembled(read_evidence(copy))["warnings"]}
    lost = next(do for what, do in cautions.items() if "completed iterations, summary.json 3" in what)
    assert "without it the run cannot go on" in lost
    assert not any(do.startswith("Nothing to do") for do in cautions.values())


def test_an_environment_that_cannot_be_opened_costs_only_what_needs_it(copy):
    settings = json.loads((copy / "settings.json").read_text())
    (copy / "settings.json").write_text(json.dumps(settings | {"env": "Mine-v0"}))
    text = read(write_report(copy)).text
    assert "environment cannot be opened" in text
    assert "could not be made" not in text
    assert "largest R̂" in text


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


@pytest.mark.parametrize("number", [1, 2, 3])
def test_a_truncated_iteration_file_is_named_and_the_rest_is_reported(copy, number):
    file = copy / "iterations" / f"000{number}.nc"
    file.write_bytes(file.read_bytes()[:3000])
    before = contents(copy)
    text = read(write_report(copy)).text
    assert contents(copy) == before
    assert f"Broken: iterations/000{number}.nc" in text
    assert "could not be made" not in text
    assert "policy's value" in text
    assert ("utility estimate that can be read is that of iteration 2" in text) == (number == 3)


def test_a_log_that_is_cut_off_or_damaged_is_read_up_to_there(copy):
    file = copy / "events.jsonl"
    lines = file.read_bytes().splitlines(keepends=True)
    file.write_bytes(b"".join(lines) + lines[-1][:20])
    assert any("last line is cut off" in text for text in warned(read_evidence(copy)))
    (copy / "summary.json").unlink()
    file.write_bytes(b"".join(lines[:8]) + b"\xff\x00garbage\n" + b"".join(lines[8:]))
    evidence = read_evidence(copy)
    assert len(evidence.iterations) == 1
    assert any("line 9" in text for text in warned(evidence))
    assert "could not be made" not in read(write_report(copy)).text


@pytest.mark.parametrize("damage", ["missing log", "foreign log", "missing iterations", "broken summary"])
def test_whatever_is_missing_there_is_a_report(copy, damage):
    if damage == "missing log":
        (copy / "events.jsonl").unlink()
    elif damage == "foreign log":
        (copy / "events.jsonl").write_text('{"event": "answered"}\n[]\n')
    elif damage == "missing iterations":
        shutil.rmtree(copy / "iterations")
    else:
        (copy / "summary.json").write_text("{")
    text = read(write_report(copy)).text
    assert "Broken" in text
    assert "could not be made" not in text
    assert "policy's value" in text


def test_an_iteration_that_is_no_number_ends_what_is_read_of_the_log(copy):
    lines = (copy / "events.jsonl").read_text().splitlines()
    broken = [
        line.replace('"event": "improved", "iteration": 2', '"event": "improved", "iteration": "2"') for line in lines
    ]
    assert broken != lines
    (copy / "events.jsonl").write_text("".join(line + "\n" for line in broken))
    evidence = read_evidence(copy)
    assert any("events.jsonl: event: expected a complete one" in text for text in warned(evidence))
    assert "could not be made" not in read(write_report(copy)).text


def test_summaries_without_answers_still_make_a_report(copy):
    (copy / "events.jsonl").unlink()
    summary = json.loads((copy / "summary.json").read_text())
    for entry in summary["iterations"]:
        del entry["answers"]
    (copy / "summary.json").write_text(json.dumps(summary))
    assert "policy's value" in read(write_report(copy)).text


def test_a_wholly_gutted_run_has_a_report(copy):
    for name in ("events.jsonl", "summary.json"):
        (copy / name).write_text("nothing\n")
    shutil.rmtree(copy / "iterations")
    text = read(write_report(copy)).text
    assert "Nothing has been learnt yet" in text
    assert "could not be made" not in text


@pytest.mark.parametrize("kind", ["nowhere", "empty", "foreign", "newer", "file"])
def test_what_is_no_run_is_refused_in_one_line(monkeypatch, capsys, copy, tmp_path, kind):
    path = tmp_path / kind
    if kind in ("empty", "foreign"):
        path.mkdir()
    if kind == "foreign":
        (path / "settings.json").write_text("[1, 2]")
    if kind == "file":
        path.write_text("a file")
    if kind == "newer":
        path = copy
        settings = json.loads((copy / "settings.json").read_text())
        (copy / "settings.json").write_text(json.dumps(settings | {"format": 99}))
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


def test_the_command_line_writes_the_report_and_says_where(monkeypatch, capsys, copy, drawn):
    monkeypatch.setattr(sys, "argv", ["bayespbrl", "report", str(copy), "--format", "md"])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 0
    assert "report.md" in re.sub(r"\s", "", capsys.readouterr().out)
    text = (copy / "report.md").read_text()
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)
    assert pictures
    assert all((copy / picture).read_bytes().startswith(b"\x89PNG") for picture in pictures)
    assert not (copy / "report.html").exists()
    for block in re.findall(r"(?:^\|.*\n)+", text, flags=re.MULTILINE):  # every table is whole
        assert len({line.count("|") for line in block.splitlines()}) == 1


def test_a_format_that_there_is_not_is_refused(finished):
    with pytest.raises(ValueError, match="format: expected html or md, got 'pdf'"):
        bayespbrl.load(finished).report("pdf")


def test_a_report_takes_the_place_of_the_one_before(copy):
    (copy / "report.html").write_text("old")
    assert write_report(copy).read_text() != "old"
    assert [path.name for path in copy.glob("report*")] == ["report.html"]


def test_importing_the_package_does_not_import_the_report():
    code = "import sys, bayespbrl; assert not any('report' in n or n == 'jinja2' for n in sys.modules if 'bayes' in n)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.slow
def test_a_report_of_a_swing_up_run_draws_the_utility_over_the_plane(tmp_path, drawn):
    directory = tmp_path / "run"
    bayespbrl.start("swing-up", directory, iterations=3, centres=100, evaluation_episodes=5).run(ReturnExpert())
    path = write_report(directory)
    text = read(path).text
    assert "over the range of what was observed" in text
    assert "could not be made" not in text
    assert path.stat().st_size < 2e6
