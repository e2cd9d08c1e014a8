"""Results of studies: intervals against known values, tables against hand-made data, what is refused."""

import itertools
import json
import shutil
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pandas as pd
import pytest
from scipy import stats
from test_cli import call, refused
from test_trials import without_processes

from bayespbrl.diagnostics.report.contents import read_contents
from bayespbrl.results import (
    calibration_table,
    kept_table,
    pairs_table,
    read_study,
    runs_table,
    values_table,
    write_results,
)
from bayespbrl.results.intervals import (
    answers_for_good,
    benjamini_hochberg,
    failed_trials,
    holm,
    median_interval,
    paired_difference,
    performance_profile,
    signed_rank_test,
)
from bayespbrl.results.study_data import StudyData
from bayespbrl.studies import Study
from bayespbrl.studies.declaration import parsed
from bayespbrl.studies.tables import by_answers

STUDIES = Path(__file__).parents[1] / "benchmarks" / "studies"
DECLARATION = """
title = "Hand-made"
trials = 4
seed = 1
report_at = [3]
[options]
preset = "paper"
iterations = 4
[tasks.gridworld]
[methods.first]
[methods.second]
utility = "linear-program"
[methods.known]
utility = "known-reward"
[methods.random]
untrained = true
"""
# value by seed and iteration, one answer more each; random policy 0, known reward 100: 0.95 is 95, failed below 50
VALUES = {
    "first": [[10, 96, 90, 97], [20, 97, 96, 98], [30, 98, 97, 99], [40, 94, 96, 20]],
    "second": [[10, 20, 30, 40], [20, 30, 40, 60], [30, 40, 50, 70], [40, 50, 60, 80]],
    "known": [[90, 95, 100, 100]] * 4,
}


@pytest.fixture
def made(tmp_path):
    """A directory with the data of a study, made by hand."""
    directory = tmp_path / "made"
    directory.mkdir()
    kept = {
        "study": "made",
        "version": "0.0",
        "source": "abc",
        "command": "bayespbrl study made",
        "machine": "a machine",
    }
    (directory / "study.json").write_text(json.dumps(kept | {"date": "2026-01-01"}))
    (directory / "study.toml").write_text(DECLARATION)
    figures = {"terminated": 0, "converged": True, "rhat": 1.002, "effective_sample_size": 500, "signal": 0.7}
    figures |= {"kl": 0.2, "kl_bound": 0.4, "seconds": 30}
    names = {"tasks": "gridworld", "noise": None, "variants": None}
    lines = [
        names
        | {"methods": method, "seed": seed + 1, "iteration": i + 1, "answers": i + 2, "value": value}
        | {"value_newest": value, **figures}
        for method, trials in VALUES.items()
        for seed, trial in enumerate(trials)
        for i, value in enumerate(trial)
    ]
    lines += [
        names | {"methods": "random", "seed": seed, "iteration": 0, "answers": 0, "value": 0, "value_newest": 0}
        for seed in (1, 2, 3, 4)
    ]
    order = ["tasks", "methods", "noise", "variants", "seed", "iteration", "answers", "value", "value_newest"]
    pd.DataFrame(lines)[[*order, *figures]].to_csv(directory / "iterations.csv", index=False)
    return directory


def test_the_values_table_is_that_of_hand_made_trials(made):
    table = values_table(read_study(made)).set_index("methods")
    first, second = table.loc["first"], table.loc["second"]
    assert first["median"] == "97.5"
    assert first["after 3"] == "96.5 [95.5]"
    assert second["relative value"] == "0.650"
    # the median is at 96.5 after three answers, and not below 95 again
    assert first["answers to 0.95 for good"].startswith("3 [")
    assert second["answers to 0.95 for good"].startswith("never")
    assert first["failed"] == "1 of 4"
    bounds = stats.binomtest(1, 4).proportion_ci(method="exact")
    assert first["exact interval"] == f"[{bounds.low:.2f}, {bounds.high:.2f}]"
    assert (first["difference"], first["p (Holm)"]) == ("–", "–")
    assert second["difference"].startswith("-33.5 [")  # of −57, −38, −29, +60
    assert (second["against"], second["pairs"], second["at answers"]) == ("first", "4", "5")
    assert table.loc["known", "against"] == table.loc["known", "p (Holm)"] == "–"  # it defines the scale
    assert table.loc["random", "failed"] == "–"
    assert "noise" not in table.columns


def without(made, chosen):
    """The data without some lines."""
    lines = pd.read_csv(made / "iterations.csv")
    lines[~chosen(lines)].to_csv(made / "iterations.csv", index=False)


def test_trials_that_are_compared_need_not_have_used_all_answers(made):
    without(made, lambda lines: (lines["methods"] == "first") & (lines["seed"] == 4) & (lines["iteration"] > 1))
    second = values_table(read_study(made)).set_index("methods").loc["second"]
    assert second["at answers"] == "5"  # not 2, with which the first ended
    assert second["difference"].startswith("-33.5 [")  # of −57, −38, −29, +40


def test_a_value_after_more_answers_than_were_allowed_is_not_shown(made):
    declared = made / "study.toml"
    declared.write_text(DECLARATION.replace("[3]", "[5, 6]"))
    first = values_table(read_study(made)).set_index("methods").loc["first"]
    assert (first["after 5"], first["after 6"]) == ("97.5 [77.75]", "–")
    more = DECLARATION.replace("[methods.first]", "[methods.first]\niterations = 5")
    declared.write_text(more.replace("[3]", "[5, 6]"))
    first = values_table(read_study(made)).set_index("methods").loc["first"]
    assert first["after 6"] == first["after 5"]  # it might have asked once more


def test_the_budget_is_what_the_options_allow_where_all_trials_of_a_row_ended_before_it(made):
    without(made, lambda lines: (lines["methods"] == "first") & (lines["iteration"] > 1))
    for text, answers, difference in [
        (DECLARATION.replace("[methods.first]", "[methods.first]\niterations = 1"), "2", "+0 "),
        # with a budget of 20 answers, of which one iteration asks two
        (
            DECLARATION.replace("paper", "default").replace("[methods.first]", "[methods.first]\niterations = 1"),
            "2",
            "+0 ",
        ),
        (DECLARATION, "5", "+40 ["),  # the last values: of +30, +40, +40, +40
        (DECLARATION.replace("paper", "default").replace("iterations = 4", ""), "20", "+40 ["),
    ]:
        (made / "study.toml").write_text(text)
        second = values_table(read_study(made)).set_index("methods").loc["second"]
        assert (second["at answers"], second["difference"][: len(difference)]) == (answers, difference)


@pytest.mark.parametrize("option", ["queries_per_iteration = 12", "first_queries = 15", "against_kept = true"])
def test_an_option_that_is_legal_with_what_the_default_derives_of_a_task_is_read(made, option):
    # more trajectories an iteration, and policies without noise, are derived only where the task is known
    declared = DECLARATION.replace("paper", "default").replace("iterations = 4", "")
    (made / "study.toml").write_text(declared.replace("[methods.first]", f"[methods.first]\n{option}"))
    table = values_table(read_study(made)).set_index("methods")
    assert table.loc["second", "at answers"] == "20"


def test_trials_that_are_missing_are_counted_and_never_replaced_by_another_row(made):
    kept = json.loads((made / "study.json").read_text()) | {"trials": 4}
    (made / "study.json").write_text(json.dumps(kept))
    without(made, lambda lines: (lines["methods"] == "second") & (lines["seed"] == 2))
    second = values_table(read_study(made)).set_index("methods").loc["second"]
    assert (second["trials"], second["pairs"], second["seeds left out"]) == ("3 of 4", "3", "2")
    without(made, lambda lines: (lines["methods"] == "second") & (lines["seed"] == 4))
    assert values_table(read_study(made)).set_index("methods").loc["second", "seeds left out"] == "2, 4"
    without(made, lambda lines: lines["methods"] == "first")
    data = read_study(made)
    table = values_table(data)
    assert "against" not in table  # `first` has no trials, and no other row is put in its place
    assert "Without finished trials: gridworld/first." in data.source
    without(made, lambda lines: (lines["methods"] == "second") & (lines["seed"] > 1))
    assert "p (Holm)" not in values_table(read_study(made))


def test_a_value_that_is_no_number_is_a_failed_trial(made):
    lines = pd.read_csv(made / "iterations.csv")
    lines.loc[(lines["methods"] == "first") & (lines["seed"] == 1) & (lines["iteration"] == 4), "value"] = np.nan
    lines.to_csv(made / "iterations.csv", index=False)
    assert values_table(read_study(made)).set_index("methods").loc["first", "failed"] == "2 of 4"


def test_a_row_is_compared_under_the_same_noise_and_the_first_method_with_its_first_noise():
    text = DECLARATION + '[noise.none]\n[noise.mistaken]\nexpert = "mistaken"\n[noise.skipping]\nexpert = "skipping"'
    left_out = '\n[[leave_out]]\nmethods = ["first"]\nnoise = ["skipping"]'
    study = parsed(text + left_out, "made")
    data = StudyData(Path(), {}, study, (), None)
    found = {row.name: data.reference_of(row) for row in study.rows}
    assert {name: row and row.name for name, row in found.items() if "random" not in name and "known" not in name} == {
        "gridworld/first/none": None,
        "gridworld/first/mistaken": "gridworld/first/none",
        "gridworld/second/none": "gridworld/first/none",
        "gridworld/second/mistaken": "gridworld/first/mistaken",
        "gridworld/second/skipping": "gridworld/second/none",  # the first method there
    }


def test_the_page_names_study_command_version_date_and_machine_and_counts_comparisons(made, tmp_path):
    page, *files = write_results(made, tmp_path / "out")
    text = page.read_text()
    for part in ("Study `made`", "bayespbrl study made", "version 0.0", "2026-01-01", "a machine", "one comparison"):
        assert part in text
    assert "| gridworld | first | iterations=4 preset=paper | 16 | 0 | 1.002 | 500 | 0.70 | 0.200 | 0.50 | 2 |" in text
    assert (
        "| gridworld | second | iterations=4 preset=paper utility=linear-program | – | – |" in text
    )  # it has no posteriors
    assert {file.name for file in files} == {"values.csv", "runs.csv", "curves.png", "profiles.png"}
    assert sorted(path.name for path in made.iterdir()) == ["iterations.csv", "study.json", "study.toml"]


def test_kept_policies_stand_beside_the_newest_and_the_best_of_their_runs(made):
    assert kept_table(read_study(made)).empty  # the newest are kept
    lines = pd.read_csv(made / "iterations.csv")
    ended = (lines["methods"] == "first") & (lines["seed"] == 4)  # values 40, 94, 96, 20
    lines.loc[ended, "value"] = [40, 94, 94, 94]
    lines.to_csv(made / "iterations.csv", index=False)
    line, *others = kept_table(read_study(made)).to_dict("records")
    assert [other["methods"] for other in others] == ["second", "known"]
    assert (line["methods"], line["trials"], line["worst"]) == ("first", "4", "94")
    assert (line["kept"], line["newest"]) == ("97.5 [96.25]", "97.5 [77.75]")
    assert line["best of the run"] == "97.5 [96.75]"
    assert line["within 3 % of the best"] == "4 of 4"  # 94 of 96
    lines.loc[ended, "value"] = [40, 40, 40, 93]
    lines.to_csv(made / "iterations.csv", index=False)
    assert kept_table(read_study(made)).loc[0, "within 3 % of the best"] == "3 of 4"
    # a run whose best is worse than the random policy keeps it, or does not
    lines.loc[ended, ["value", "value_newest"]] = [[-40, -40], [-40, -60], [-40, -60], [-40, -60]]
    lines.to_csv(made / "iterations.csv", index=False)
    assert kept_table(read_study(made)).loc[0, "within 3 % of the best"] == "4 of 4"
    lines.loc[ended, "value"] = [-40, -60, -60, -60]
    lines.loc[lines["seed"] == 1, "value_newest"] = 11.0
    lines.to_csv(made / "iterations.csv", index=False)
    assert kept_table(read_study(made)).loc[0, "within 3 % of the best"] == "3 of 4"
    lines.loc[ended & (lines["iteration"] == 4), "value_newest"] = np.nan  # and not the one before it
    lines.to_csv(made / "iterations.csv", index=False)
    assert kept_table(read_study(made)).loc[0, ["newest", "best of the run"]].tolist() == ["nan [nan]"] * 2


def test_pairs_of_trials_are_counted_by_the_answers_that_they_needed(made):
    assert pairs_table(read_study(made)).empty  # no value is declared
    declared = made / "study.toml"
    declared.write_text(declared.read_text().replace("[tasks.gridworld]", "[tasks.gridworld]\ngood_above = 50"))
    (second,) = pairs_table(read_study(made)).to_dict("records")
    assert (second["pairs"], second["fewer in all"], second["more in all"], second["p in all"]) == ("4", "0", "0", "1")
    # `first` is above 50 from the third answer on, but for its last policy of seed 4
    assert (second["fewer to 50"], second["more to 50"], second["p to 50"]) == ("0", "4", "0.12")
    assert second["median to 50"] == "5 against 3"
    assert (second["fewer to 50 for good"], second["more to 50 for good"]) == ("1", "3")
    declared.write_text(declared.read_text().replace("good_above = 50", "good_above = 99"))
    assert pairs_table(read_study(made)).loc[0, "median to 99"] == "never against never"
    declared.write_text(f"{declared.read_text()}\n[tasks.again]\nenv = 'gridworld'\ngood_above = 50")
    lines = pd.read_csv(made / "iterations.csv")
    pd.concat([lines, lines.assign(tasks="again")]).to_csv(made / "iterations.csv", index=False)
    assert pairs_table(read_study(made)).loc[0, "median to 50"] == "–"  # its level is another


def test_a_trial_whose_first_policy_comes_late_does_not_delay_the_others_of_its_row(made):
    declared = made / "study.toml"
    declared.write_text(declared.read_text().replace("[tasks.gridworld]", "[tasks.gridworld]\ngood_above = 5"))
    lines = pd.read_csv(made / "iterations.csv")
    lines.loc[(lines["methods"] == "second") & (lines["seed"] == 2), "answers"] += 3  # its expert skipped questions
    lines.to_csv(made / "iterations.csv", index=False)
    (second,) = pairs_table(read_study(made)).to_dict("records")
    for level in ("5", "5 for good"):
        assert (second[f"median to {level}"], second[f"more to {level}"]) == ("2 against 2", "1")


def test_chains_that_stand_still_have_no_row_of_digits(made):
    lines = pd.read_csv(made / "iterations.csv")
    lines.loc[lines["methods"] == "known", "rhat"] = 1.0234
    lines.loc[(lines["methods"] == "first") & (lines["seed"] == 2), "rhat"] = 5.6199e15
    lines.to_csv(made / "iterations.csv", index=False)
    assert list(runs_table(read_study(made))["worst R̂"]) == ["5.6e+15", "1.002", "1.023"]


def test_of_iterations_with_as_many_answers_the_last_policy_counts(made):
    declared = made / "study.toml"
    declared.write_text(declared.read_text().replace("[tasks.gridworld]", "[tasks.gridworld]\ngood_above = 50"))
    lines = pd.read_csv(made / "iterations.csv")
    lines.loc[(lines["methods"] == "first") & (lines["iteration"] > 2), "answers"] = 4  # 90 and 97, but 96 and 20
    lines.to_csv(made / "iterations.csv", index=False)
    (second,) = pairs_table(read_study(made)).to_dict("records")
    assert second["more to 50 for good"] == "3"


def test_a_baseline_does_not_define_the_scale():
    text = DECLARATION + '[methods.pf]\nbaseline = "pf"\nutility = "known-reward"\n'
    rows = {row.name: row.of_scale for row in parsed(text, "made").rows}
    assert (rows["gridworld/known"], rows["gridworld/random"], rows["gridworld/pf"]) == (True, True, False)


def test_predictions_are_pooled_over_tasks_and_not_over_methods():
    *of_tasks, pooled = calibration_table(read_study(STUDIES / "tasks")).to_dict("records")
    assert (pooled["tasks"], len(of_tasks)) == ("all", 2)
    for count in ("runs", "answers predicted"):
        assert int(pooled[count]) == sum(int(line[count]) for line in of_tasks)
    errors = [float(line["ECE"]) for line in of_tasks]
    by_chance = [float(line["if calibrated"].split(" ± ")[0]) for line in of_tasks]
    assert float(pooled["if calibrated"].split(" ± ")[0]) < min(by_chance)  # of more answers
    assert float(pooled["ECE"]) < max(errors)
    assert "all" not in calibration_table(read_study(STUDIES / "sampler"))["methods"].to_list()


def test_for_good_is_not_first_touch():
    answers = np.array([2, 3, 4, 5, 6])
    values = np.array([[0, 1, 0, 1, 1], [0, 1, 0, 1, 1], [0, 1, 0, 1, 1]])
    assert answers_for_good(answers, values, 1.0) == (5, 5, 5)
    assert answers_for_good(answers, values[:, :3], 1.0) == (np.inf, np.inf, np.inf)
    assert answers_for_good(answers, np.ones((3, 5)), 1.0).estimate == 2


def test_p_values_are_adjusted_as_by_hand():
    p = [0.01, 0.04, 0.03, 0.005]
    np.testing.assert_allclose(holm(p), [0.03, 0.06, 0.06, 0.02])
    np.testing.assert_allclose(benjamini_hochberg(p), [0.02, 0.04, 0.04, 0.02])
    assert holm([]).shape == benjamini_hochberg([]).shape == (0,)
    np.testing.assert_array_equal(holm([0.7, 0.9]), [1.0, 1.0])


def test_exact_intervals_are_those_of_clopper_and_pearson():
    interval = failed_trials(0, 20)
    assert (interval.estimate, interval.low) == (0, 0)
    assert interval.high == pytest.approx(1 - 0.025 ** (1 / 20))


def test_the_bootstrap_interval_of_a_median_covers_it_as_often_as_it_says():
    rng, covered = np.random.default_rng(7), 0
    for _ in range(60):
        interval = median_interval(rng.normal(size=40))
        covered += interval.low <= 0 <= interval.high
    assert 51 <= covered <= 60  # 57 are expected
    assert median_interval(np.ones(5)) == (1, 1, 1)
    assert np.isnan(median_interval(np.ones(1)).low)


def test_equal_trials_do_not_differ_and_shifted_ones_do():
    values = np.arange(12.0)
    assert paired_difference(values, values) == ((0, 0, 0), 1.0)
    interval, p = paired_difference(values + 3, values)
    assert interval == (3, 3, 3)
    assert p < 0.001


@pytest.mark.parametrize("number", [3, 8, 12])
def test_the_p_value_of_a_paired_comparison_is_that_of_all_signs(number):
    rng = np.random.default_rng(number)
    for _ in range(10):
        differences = rng.integers(-2, 4, number) * 0.1  # some are zero, some equal
        unequal = differences != 0
        ranks = np.where(unequal, stats.rankdata(np.abs(np.round(differences, 9))), 0)
        sums = np.array(list(itertools.product((-1, 1), repeat=number))) @ ranks
        expected = np.mean(np.abs(sums) >= abs(np.sign(differences) @ ranks) - 1e-9)
        assert signed_rank_test(differences) == pytest.approx(expected)


def test_differences_are_as_large_as_their_digits_say():
    differences = np.array([1, 1, 1, -1, -1, -1, 2, 2, -2, -2])
    reference = np.linspace(294.0, 294.9, 10)
    _, p = paired_difference((reference + differences / 100).round(2), reference.round(2))
    assert p == signed_rank_test(differences) == 1.0


def test_three_unequal_pairs_of_twenty_show_nothing():
    assert signed_rank_test(np.r_[np.zeros(17), 1.0, 2.0, 3.0]) == 0.25  # a normal approximation has 0.08


def test_a_performance_profile_averages_tasks_and_not_trials():
    relative = {"easy": np.ones(30), "hard": np.array([0.0, 0.0, 1.0, 1.0])}
    profile = performance_profile(relative, np.array([-0.1, 0.5, 1.0]))
    np.testing.assert_allclose(profile.share, [1.0, 0.75, 0.0])
    assert profile.low[1] < 0.75 < profile.high[1]


def test_a_performance_profile_draws_the_trials_of_each_task_anew():
    """Otherwise the tasks below, one the other's mirror image, would have a share of one half in each resample."""
    values = np.repeat([0.0, 1.0], 10)
    profile = performance_profile({"one": values, "other": values[::-1]}, np.array([0.5]))
    assert profile.low[0] < 0.45 < 0.55 < profile.high[0]


def test_a_level_may_be_called_none(made):
    lines = pd.read_csv(made / "iterations.csv")
    lines.assign(methods=lines["methods"].replace("first", "None")).to_csv(made / "iterations.csv", index=False)
    declared = made / "study.toml"
    declared.write_text(declared.read_text().replace("methods.first", "methods.None"))
    assert values_table(read_study(made))["methods"].to_list()[0] == "None"


DAMAGE = {
    "study.json": ["", "[]", "[" * 100_000, '{"earlier": null}', '{"earlier": [1]}'],
    "study.toml": ["tasks = ", "[tasks.gridworld", "title = " + "[" * 7000],
    "iterations.csv": ["", "seed,value\n1,2", "\0\0\0"],
    "answers.csv": ["", "seed\n1"],
}


@pytest.mark.parametrize(("file", "content"), [(file, text) for file, texts in DAMAGE.items() for text in texts])
def test_damaged_data_is_one_line(monkeypatch, capsys, made, file, content):
    (made / file).write_text(content)
    assert str(made) in refused(monkeypatch, capsys, "results", made)
    (made / file).unlink()
    if file != "answers.csv":
        assert str(made) in refused(monkeypatch, capsys, "results", made)


def test_text_in_place_of_numbers_and_no_finished_trial_are_named(made):
    lines = (made / "iterations.csv").read_text()
    (made / "iterations.csv").write_text(lines.replace("97.0", "much").replace("97", "much"))
    with pytest.raises(ValueError, match="expected numbers as"):
        read_study(made)
    (made / "iterations.csv").write_text(lines.splitlines()[0] + "\n")
    with pytest.raises(ValueError, match="expected finished trials"):
        read_study(made)


def told_of(made, file, change):
    """What is said of a study after one change to the lines of a file."""
    lines = (made / file).read_text().splitlines()
    change(lines)
    (made / file).write_text("\n".join(lines) + "\n")
    with pytest.raises(ValueError) as refusal:  # noqa: PT011
        read_study(made)
    assert str(made / file) in str(refusal.value)
    return str(refusal.value)


def test_a_damaged_line_is_no_answer(made):
    """One bad cell makes texts of a column of true and false, and each text is true."""
    columns = ["tasks", "methods", "noise", "variants", "seed", "question", "iteration", "predicted", "first"]
    kept = f"{','.join(columns)}\nt,first,,,2,3,2,0.4,True\nt,first,,,2,4,3,0.3,False\n"
    (made / "answers.csv").write_text(kept)
    read_study(made)

    def with_cell(place, text):
        def change(lines):
            cells = lines[1].split(",")
            lines[1] = ",".join([*cells[:place], text, *cells[place + 1 :]])

        return change

    for column, text, told in (
        ("first", "1.7", "expected True or False as first"),
        ("first", "", "expected True or False as first"),
        ("predicted", "1.7", "expected probabilities as predicted, got 1.7"),
        ("predicted", "-0.5", "expected probabilities as predicted, got -0.5"),
        ("predicted", "", "expected a number as predicted in each line, got none in 1 line"),
        ("seed", "", "expected a number as seed in each line, got none in 1 line"),
        ("seed", "inf", "expected a number as seed in each line, got none in 1 line"),
    ):
        assert told in told_of(made, "answers.csv", with_cell(columns.index(column), text))
        (made / "answers.csv").write_text(kept)
    assert "expected one line for each question, got two" in told_of(
        made, "answers.csv", lambda lines: lines.append(lines[1])
    )
    (made / "answers.csv").write_text(kept)
    whole = (made / "iterations.csv").read_text()
    assert "expected one line for each iteration, got two" in told_of(
        made, "iterations.csv", lambda lines: lines.append(lines[1])
    )
    columns = whole.splitlines()[0].split(",")
    for column, text, told in (
        *((name, "x", f"expected numbers as {name}") for name in ("value_newest", "rhat", "kl", "seconds", "signal")),
        ("answers", "", "expected a number as answers"),
    ):
        (made / "iterations.csv").write_text(whole)
        assert told in told_of(made, "iterations.csv", with_cell(columns.index(column), text))


RUN = """
trials = 1
seed = 2970
[options]
preset = "paper"
iterations = 4
max_steps = 20
evaluation_episodes = 3
[tasks.gridworld]
"""


@pytest.mark.slow
def test_predictions_are_those_that_the_report_shows_and_old_runs_are_read_anew(monkeypatch, tmp_path):
    without_processes(monkeypatch)
    study = Study.prepare(parsed(RUN, "run"), tmp_path / "run")
    assert study.run() == []
    (tmp_path / "run" / "iterations.csv").unlink()  # as if it had been stopped
    before = {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()}
    assert call(monkeypatch, "results", tmp_path / "run", "--out", tmp_path / "out") == 0
    assert {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()} == before
    assert call(monkeypatch, "results", tmp_path / "run") == 0
    kept = pd.read_csv(tmp_path / "run" / "answers.csv")
    shown = [a for a in read_contents(tmp_path / "run" / "gridworld" / "seed-2970").answers if a.iteration > 1]
    np.testing.assert_allclose(kept["predicted"], [a.predicted for a in shown if a.states_order], rtol=1e-5)
    page = (tmp_path / "run" / "results.md").read_text()
    assert "Calibration" in page
    assert (tmp_path / "out" / "results.md").read_text() == page
    data = shutil.copytree(tmp_path / "run", tmp_path / "data", ignore=shutil.ignore_patterns("gridworld", "results*"))
    assert call(monkeypatch, "results", data) == 0  # the four files are enough
    assert (data / "results.md").read_text() == (tmp_path / "run" / "results.md").read_text()


@pytest.mark.slow
def test_the_package_of_an_environment_is_imported_with_permission_alone(monkeypatch, tmp_path, capsys):
    """In the processes that read many runs, too."""
    (tmp_path / "grid_of_mine.py").write_text(
        "import gymnasium\n"
        "gymnasium.register('GridOfMine-v0', entry_point='bayespbrl.envs.gridworld:Gridworld', max_episode_steps=20)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    text = RUN.replace("[tasks.gridworld]", "[tasks.mine]\nenv = 'grid_of_mine:GridOfMine-v0'")
    assert Study.prepare(parsed(text, "run"), tmp_path / "run").run() == []
    monkeypatch.delitem(sys.modules, "grid_of_mine")
    monkeypatch.delitem(gymnasium.registry, "GridOfMine-v0")
    line = refused(monkeypatch, capsys, "results", tmp_path / "run")
    assert "expected permission to import 'grid_of_mine', which grid_of_mine:GridOfMine-v0 needs" in line
    assert "grid_of_mine" not in sys.modules
    monkeypatch.setattr("bayespbrl.results.predictions.FEW", 0)
    assert call(monkeypatch, "results", tmp_path / "run", "--import-package") == 0
    page = (tmp_path / "run" / "results.md").read_text()
    assert "Calibration" in page
    assert "Not read" not in page


@pytest.mark.slow
def test_runs_of_other_settings_leave_the_tables_as_they_are(monkeypatch, tmp_path):
    """As where a preset has changed since."""
    without_processes(monkeypatch)
    study = Study.prepare(parsed(RUN, "run"), tmp_path / "run")
    assert study.run() == []
    settings = tmp_path / "run" / "gridworld" / "seed-2970" / "settings.json"
    settings.write_text(settings.read_text().replace('"max_steps": 20', '"max_steps": 19'))
    with pytest.warns(UserWarning, match=r"not read: the run directories: .* got others: max_steps 19 instead of 20$"):
        page = write_results(tmp_path / "run")[0].read_text()
    assert "**Values** (study `run`" in page


@pytest.mark.slow
def test_what_the_tables_have_of_trials_that_are_damaged_or_gone_stays_and_is_named(monkeypatch, tmp_path):
    without_processes(monkeypatch)
    text = RUN.replace("trials = 1", "trials = 2").replace("iterations = 4", "iterations = 3")
    study = Study.prepare(parsed(text, "run"), tmp_path / "run")
    assert study.run() == []
    write_results(tmp_path / "run")
    before = {name: (tmp_path / "run" / name).read_text() for name in ("iterations.csv", "answers.csv")}
    trial = sorted((tmp_path / "run" / "gridworld").iterdir())[0]
    assert f",{trial.name.removeprefix('seed-')}," in before["answers.csv"]

    def after(harm):
        harm()
        page = write_results(tmp_path / "run")[0].read_text()
        assert {name: (tmp_path / "run" / name).read_text() for name in before} == before
        return page

    def cut():
        with (trial / "iterations" / "0002.nc").open("r+b") as file:
            file.truncate(2000)

    with pytest.warns(UserWarning, match=f"{trial.name}: .*0002.nc"):
        assert "Not read" in after(cut)
    with pytest.warns(UserWarning, match=f"not read: .*{trial.name}"):
        assert trial.name in after(lambda: (trial / "settings.json").write_text("{"))
    assert "Not read" not in after(lambda: shutil.rmtree(trial))


def test_studies_whose_results_would_overwrite_each_other_are_refused(made, tmp_path, monkeypatch, capsys):
    other = tmp_path / "elsewhere" / "made"
    shutil.copytree(made, other)
    line = refused(monkeypatch, capsys, "results", made, other, "--out", tmp_path / "out")
    assert "out: expected studies in directories of different names, got made more than once" in line
    assert not (tmp_path / "out").exists()


def test_the_ceiling_of_a_task_is_the_better_of_two_runs_on_the_hidden_reward(made):
    (made / "study.toml").write_text(DECLARATION + '[methods.worse]\nutility = "known-reward"\n')
    table = pd.read_csv(made / "iterations.csv")
    more = table[table["methods"] == "known"].assign(methods="worse", value=40, value_newest=40)
    pd.concat([table, more]).to_csv(made / "iterations.csv", index=False)
    assert read_study(made).floor_and_ceiling("gridworld") == (0, 100)


def test_values_by_answers_begin_where_every_trial_has_a_policy():
    answers, values = np.array([[1, 2, 4], [2, 3, 4]]), np.array([[10.0, 20, 40], [21, 31, 41]])
    numbers, each = by_answers(answers, values)
    np.testing.assert_array_equal(numbers, [2, 3, 4])
    np.testing.assert_array_equal(each, [[20, 20, 40], [21, 31, 41]])
