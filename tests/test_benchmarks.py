"""The benchmark of the cycle runs, and its seconds add up; the reference posterior agrees about the evidence."""

import importlib.util
import json
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pandas as pd
import pytest
from toys import QUICK

import bayespbrl
from bayespbrl.models import PreferenceModel, fit_gaussian, sample_posterior
from bayespbrl.models.convergence import chain_convergence

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
CYCLE = BENCHMARKS / "cycle.py"


sys.path.append(str(BENCHMARKS))  # where a script looks for what it shares with others


def benchmark(name):
    spec = importlib.util.spec_from_file_location(f"benchmark_{name}", BENCHMARKS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def printed(monkeypatch, capsys):
    """A function of a benchmark's name and arguments that returns the lines it prints, in this process."""

    def run(name, *arguments):
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *map(str, arguments)])
        benchmark(name).main()
        return capsys.readouterr().out.splitlines()

    return run


@pytest.mark.slow
@pytest.mark.parametrize(("prior_scale", "steepness"), [(1.0, 5.0), (3.0, 0.5)])
def test_log_evidence_of_41_answers_agrees_with_annealed_particles_within_a_nat(prior_scale, steepness):
    differences = benchmark("elliptical_slice").smooth_differences(41, 700, seed=2)
    loadings = differences @ np.linalg.qr(differences.T)[0]
    tempered = benchmark("reference_posterior").tempered
    settings = {"prior_scale": prior_scale, "steepness": steepness}
    runs = [tempered(loadings, **settings, particles=800, moves=25, seed=seed)[1] for seed in range(3)]
    tree = sample_posterior(differences, **settings, num_samples=25, max_samples=25)
    assert np.ptp(runs) < 1.0
    assert abs(np.mean(runs) - tree.attrs["log_evidence"]) < 1.0
    # and the comparison could have failed: the first answer turned round is more than a nat away
    turned = np.where(np.arange(41) == 0, -1.0, 1.0)[:, None] * differences
    other = fit_gaussian(turned, PreferenceModel(**settings))
    assert abs(np.mean(runs) - other.log_evidence) > 1.0


@pytest.mark.slow
def test_the_seconds_of_the_steps_of_a_trial_add_up():
    arguments = ["bicycle", "--iterations", "1", "--centres", "60", "--seed", "4"]
    run = subprocess.run([sys.executable, str(CYCLE), *arguments], capture_output=True, text=True, check=True)
    *table, line = run.stdout.splitlines()
    result = json.loads(line)
    steps = result["seconds_by_step"]
    named = {"features", "sampler", "LSTD", "dual", "policy fit", "CMA-ES", "rollouts", "evaluation", "compilation"}
    assert named <= set(steps)
    assert all(seconds > 0 for seconds in steps.values())
    assert sum(steps.values()) == pytest.approx(result["seconds"], abs=0.01)  # one clock: what rounding leaves
    assert steps["rest"] < 0.1 * result["seconds"]
    assert len(result["seconds_by_iteration"]) == result["iterations"] == 1
    assert result["answers"] == 2
    assert 100 < result["peak_memory_mib"] < 2048
    assert all(any(f"  {step} " in row for row in table) for step in steps)


@pytest.mark.slow
def test_a_schedule_costs_what_updates_with_it_take_longer(printed):
    result = json.loads(printed("schedule", "gridworld", "--iterations", "1")[0])
    assert 0 < result["updates_without"] < result["seconds_without"]
    longer = result["updates_with"] - result["updates_without"]
    assert result["overhead"] == pytest.approx(longer / result["seconds_without"], abs=0.02 / result["seconds_without"])


@pytest.mark.slow
def test_the_posterior_of_many_answers_is_timed_beside_that_of_nuts(tmp_path, printed):
    printed("many_answers", "--answers", 8, "--features", 3, "--draws", 400, "--out", tmp_path / "table.csv")
    (line,) = pd.read_csv(tmp_path / "table.csv").to_dict("records")
    assert (line["answers"], line["features"]) == (8, 3)
    for name in ("ours", "nuts"):
        assert line[f"{name}_rhat"] < 1.05
        assert line[f"{name}_effective"] > 50
        assert line[f"{name}_seconds_compiled"] > 0
        assert line[f"{name}_seconds_compiling"] > 0
        rate = line[f"{name}_effective"] / line[f"{name}_seconds_compiled"]
        assert line[f"{name}_effective_per_second_compiled"] == pytest.approx(rate, rel=0.01)
    ratio = line["ours_effective_per_second_compiled"] / line["nuts_effective_per_second_compiled"]
    assert line["ratio_compiled"] == pytest.approx(ratio, rel=0.01)
    module = benchmark("many_answers")
    differences = module.answers(8, 3, seed=0)
    of_both = [module.ours(differences, 1), module.theirs(draws=400)(differences, 1)]
    error = np.hypot(*(chain_convergence(margins).monte_carlo_error for margins in of_both))
    assert np.all(np.abs(of_both[0].mean((0, 1)) - of_both[1].mean((0, 1))) < 4 * error)


@pytest.mark.slow
def test_the_posterior_of_answers_with_coin_tosses_is_timed_until_it_converges(tmp_path, printed):
    options = ["--alone", "--answers", 8, "--features", 0, "--tosses", 0, 0.5]
    printed("many_answers", *options, "--out", tmp_path / "table.csv")
    table = pd.read_csv(tmp_path / "table.csv")
    assert table["tosses"].tolist() == [0.0, 0.5]
    assert (table["features"] == "one-hot").all()
    assert table["converged_compiled"].all()
    assert (table["effective_compiled"] >= 400).all()
    module = benchmark("many_answers")
    right, tossed = (module.tossed_answers(400, 5, tosses, seed=1) for tosses in (0.0, 0.5))
    np.testing.assert_allclose(np.mean(np.sum(right**2, axis=1)), 1.0)
    same = np.all(right == tossed, axis=1)
    assert np.all(right[~same] == -tossed[~same])
    assert 0.65 < same.mean() < 0.85  # half of the answers are tossed, and half of those come out right


def test_the_index_of_the_results_names_every_file_once_and_nothing_else():
    results = BENCHMARKS / "results"
    named = re.findall(r"^\| \[([^\]]+)\]\(\1\) \|", (results / "README.md").read_text(), flags=re.MULTILINE)
    assert sorted(named) == sorted(path.name for path in results.iterdir() if path.name != "README.md")


@pytest.mark.slow
def test_results_follow_from_the_committed_data_and_a_changed_figure_is_found(tmp_path):
    page = benchmark("results_page")
    studies = page.committed()
    text = page.page(studies)
    assert text == page.PAGE.read_text()
    changed = tmp_path / "RESULTS.md"
    assert "-99999" not in text
    figure = r"\| -9\d\d(\.\d)? \|"  # of the SwingUp
    changed.write_text(re.sub(figure, "| -99999 |", text, count=1))
    page.differences_of_a_cell = lambda data, processes: []  # run again in the test below
    page.page = lambda studies: text
    assert page.check(studies) == []
    assert any("-99999" in line for line in page.check(studies, changed))
    for folder in (BENCHMARKS / "studies").iterdir():
        assert f"](benchmarks/studies/{folder.name}/" in text


def test_a_published_curve_stands_beside_the_values_after_as_many_answers():
    page = benchmark("results_page")
    table = page.published(page.committed()["pf"], "gridworld", "pf-gridworld.csv", 294.8125).splitlines()
    lines = pd.read_csv(BENCHMARKS / "studies" / "pf" / "iterations.csv")
    after = lines[(lines["methods"] == "pf") & (lines["answers"] == 13)]["value"] / 294.8125
    low, middle, high = np.quantile(after, [0.25, 0.5, 0.75])
    assert len(after) == 20
    (line,) = [line.split(" | ") for line in table if line.startswith("| 13 |")]
    assert line[1] == "0.503 [0.503 … 0.503]"
    assert line[table[0].split(" | ").index("pf, here")] == f"{middle:.3f} [{low:.3f} … {high:.3f}]"


def test_the_cell_that_is_run_again_is_of_what_a_study_is_about():
    page = benchmark("results_page")
    rows = {name: page.cheapest(data).declared for name, data in page.committed().items()}
    assert {name for name, row in rows.items() if row.baseline} == {"pf", "epmc"}
    assert not [name for name, row in rows.items() if row.options.get("utility") in ("known-reward", "linear-program")]


@pytest.mark.slow
def test_of_a_long_trial_the_first_iterations_are_run_again(capsys):
    page = benchmark("results_page")
    data = page.committed()["smoke"]
    for row in data.rows:
        row.lines["seconds"] = 0.4 * page.LONGEST
    with page.trial_processes(1) as processes:
        row = page.cheapest(data)
        assert [entry["iteration"] for entry in page.again(row, processes)] == [1, 2]
        assert page.differences_of_a_cell(data, processes) == []
        assert "in its first 2 iterations" in capsys.readouterr().out
        row.lines.loc[row.lines["iteration"] == 2, "answers"] += 1
        (found,) = page.differences_of_a_cell(data, processes)
    assert "iteration 2: expected answers" in found


@pytest.mark.slow
def test_a_cell_is_reproduced_and_another_value_is_found():
    page = benchmark("results_page")
    data = page.committed()["smoke"]
    row = page.cheapest(data)
    with page.trial_processes(1) as processes:
        entries = page.again(row, processes)
    page.again = lambda row, processes: entries
    page.differences_of_a_cell = partial(page.differences_of_a_cell, processes=None)
    assert page.differences_of_a_cell(data) == []
    row.lines.loc[row.lines["iteration"] == 5, "value"] += 1.0
    data.description["rounding"] = page.rounding()
    (later,) = page.differences_of_a_cell(data)
    assert re.match(r"study smoke, gridworld/\S+, seed \d+, iteration 5: expected value ", later)
    data.description["rounding"] = {"processor": "another"}
    assert page.differences_of_a_cell(data) == []
    second = row.lines["iteration"] == 2
    row.lines.loc[second, "value"] *= 1 + 1e-4  # as rounding makes it
    assert page.differences_of_a_cell(data) == []
    row.lines.loc[second, "value"] *= 1.01
    found, *_ = page.differences_of_a_cell(data)
    assert re.match(r"study smoke, gridworld/\S+, seed \d+, iteration 2: expected value ", found)
    row.lines.loc[row.lines["iteration"] == 1, "value"] *= 1 + 1e-4
    first, *_ = page.differences_of_a_cell(data)
    assert re.match(r"study smoke, gridworld/\S+, seed \d+, iteration 1: expected value ", first)
    smooth = replace(row.declared, options={**row.declared.options, "diffusion_utility": True})
    page.cheapest = lambda data: replace(row, declared=smooth)
    assert page.differences_of_a_cell(data) == []  # its eigenvectors are turned otherwise there


def test_simulated_people_answer_as_their_parameters_say():
    study = benchmark("simulated_people")
    someone = study.People(steepness=2.0, threshold=0.5, lapse_rates=(0.0, 0.4), biases=(0.3, -0.2))
    number = 20_000
    margins, rng = np.full(number, 0.4), np.random.default_rng(1)
    for who in (0, 1):
        answers = someone.answers(rng, margins, np.full(number, who))
        seen, lapse = 0.4 + someone.biases[who], someone.lapse_rates[who]
        first, second = (1 / (1 + np.exp(-2 * (side * seen - 0.5))) for side in (1, -1))
        expected = [
            lapse / 3 + (1 - lapse) * second,
            lapse / 3 + (1 - lapse) * (1 - first - second),
            lapse / 3 + (1 - lapse) * first,
        ]
        np.testing.assert_allclose([np.mean(answers == a) for a in (-1, 0, 1)], expected, atol=0.015)


def test_a_row_of_an_answer_is_the_preferred_less_the_other_with_its_side():
    study = benchmark("simulated_people")
    given = study.Questions(np.array([[1.0], [2.0], [3.0]]), np.array([0, 1, 0]), np.array([1, -1, 0]))
    assert given.rows.ravel().tolist() == [1.0, -2.0, 3.0]
    assert given.sides.tolist() == [1, -1, 1]


def test_rows_by_seed_go_on_where_they_were_cut(tmp_path):
    rows_by_seed, file, columns = benchmark("rows_by_seed"), tmp_path / "rows.csv", ["seed", "square"]
    computed = []

    def square(seed):
        computed.append(seed)
        return {"seed": seed, "square": seed**2}

    (first,) = rows_by_seed.run([5], file, columns, square)
    with file.open("a") as rows:
        rows.write("6,3")  # killed while it wrote 36
    assert rows_by_seed.done(file, columns) == [first]
    rows = rows_by_seed.run([5, 6], file, columns, square)
    assert rows == [{"seed": 5, "square": 25}, {"seed": 6, "square": 36}] == rows_by_seed.done(file, columns)
    assert computed == [5, 6]
    assert rows_by_seed.run([6], file, columns, square) == rows[1:]
    with pytest.raises(SystemExit, match="expected rows with square 36, got 25; choose another --out"):
        rows_by_seed.run([6], file, columns, square, {"square": 36})
    with pytest.raises(SystemExit, match="expected a column cube, got none; choose another --out"):
        rows_by_seed.run([6], file, [*columns, "cube"], square)


def test_a_figure_that_is_none_is_kept_and_rows_of_another_task_are_refused(tmp_path):
    rows_by_seed, file, columns = benchmark("rows_by_seed"), tmp_path / "rows.csv", ["seed", "value"]
    computed = []

    def nothing(seed):
        computed.append(seed)
        return {"seed": seed, "value": float("nan")}

    for _ in range(3):
        (row,) = rows_by_seed.run([5], file, columns, nothing, about={"task": "CartPole-v1"})
        assert row["seed"] == 5
        assert np.isnan(row["value"])
    assert computed == [5]
    assert file.read_text().splitlines()[0] == "task,seed,value"
    with pytest.raises(SystemExit, match="expected rows with task Acrobot-v1, got CartPole-v1; choose another --out"):
        rows_by_seed.run([5], file, columns, nothing, about={"task": "Acrobot-v1"})


def waited(seed):
    time.sleep(1.0 if seed == 1 else 0.0)
    return {"seed": seed}


@pytest.mark.slow
def test_rows_of_several_processes_are_written_as_they_end(tmp_path):
    rows = benchmark("rows_by_seed").run([1, 2, 3], tmp_path / "rows.csv", ["seed"], waited, jobs=2)
    assert [row["seed"] for row in rows] == [2, 3, 1]


def test_ranks_of_another_model_are_not_taken_for_those_of_this_one(tmp_path):
    study, kept = benchmark("simulation_based_calibration"), "results/simulation-based-calibration.csv"
    file = Path(shutil.copy(Path(__file__).parents[1] / "benchmarks" / kept, tmp_path))
    ranks = study.run(range(5600, 5603), file, ["seed", "ties", "bug", "margin"], None, {"ties": 1.0, "bug": 0.0})
    assert [row["seed"] for row in ranks] == [5600, 5601, 5602]
    with pytest.raises(SystemExit, match="expected rows with bug 8, got 0"):
        study.run(range(5600, 5603), file, ["seed", "ties", "bug", "margin"], None, {"ties": 1.0, "bug": 8.0})


@pytest.mark.slow
@pytest.mark.parametrize(("name", "options"), [("simulated_people", {}), ("wrong_answers", {"wrong": 0.2})])
def test_a_run_gives_its_row_and_rows_are_summed_up(name, options, capsys, monkeypatch):
    study = benchmark(name)
    monkeypatch.setattr(study, "ANSWERS", 8)
    if name == "wrong_answers":
        monkeypatch.setattr(study, "MARKS", (3, 6))
    row = study.one_run(5, **options)
    assert set(row) <= set(study.COLUMNS)
    assert row["converged"]
    study.show([row, row | {"seed": 6, "log score": -0.3}])
    assert capsys.readouterr().out.startswith("2 runs, 2 ")


@pytest.fixture(scope="module")
def neighbours():
    return benchmark("neighbours")


@pytest.fixture
def cells(neighbours):
    return [neighbours.Cell("gridworld", 3, seed, method) for seed in (7, 8) for method in neighbours.METHODS]


@pytest.mark.slow
def test_a_learner_is_charged_for_its_trajectories_and_for_the_trials_of_its_policies(neighbours, cells, tmp_path):
    directory = tmp_path / "run"
    options = {name: option for name, option in QUICK.items() if name != "seed"}
    figures = neighbours.bayespbrl_cell(cells[0], directory, **options, checked=True, check_episodes=2)
    run = bayespbrl.load(directory)
    assert run.settings.seed == 7
    assert figures["steps"] == 3 * (10 + 2) * 20  # iterations, their trajectories and trials, steps of each
    assert figures["answered"] == run.preferences.answers > 0
    assert figures["cpu_seconds"] > 0
    # the same 100 starts, and the finished run is read, not made again
    changed = (directory / "events.jsonl").stat().st_mtime_ns
    assert neighbours.bayespbrl_cell(cells[0], directory)["value"] == figures["value"]
    assert (directory / "events.jsonl").stat().st_mtime_ns == changed


def test_a_value_is_the_mean_return_of_episodes_of_different_lengths(neighbours):
    def act(observations):
        return (observations[:, 2] > 0).astype(int)  # after the pole

    returns = []
    for seed in (3, 4, 5):
        env, total, over = gymnasium.make("CartPole-v1"), 0.0, False
        seen, _ = env.reset(seed=seed)
        while not over:
            seen, reward, terminated, truncated, _ = env.step(act(seen[None])[0])
            total, over = total + reward, terminated or truncated
        returns.append(total)
    assert len(set(returns)) > 1
    assert neighbours.value("CartPole-v1", range(3, 6), act) == pytest.approx(np.mean(returns))


def test_a_cell_of_the_neighbours_is_computed_once(neighbours, cells, tmp_path, capsys):
    file, asked = tmp_path / "rows.csv", []

    def measure(cell):
        asked.append(cell)
        if cell.seed == 8 and cell.method != "imitation":
            raise RuntimeError("no luck")
        number = list(neighbours.METHODS).index(cell.method)
        return {"answered": 3, "value": -number, "steps": 100 + number, "cpu_seconds": 60 + number}

    assert neighbours.run(cells[:2], file, measure) == []
    first, second = neighbours.done(file)
    assert first == cells[0]._asdict() | {"answered": 3, "value": 0, "steps": 100, "cpu_seconds": 60}
    # PPO on the utility of a run needs that run
    assert second == cells[1]._asdict() | {"answered": 3, "value": -1, "steps": 201, "cpu_seconds": 121}
    with file.open("a") as rows:
        rows.write("gridworld,3,7,imitation,3")  # killed while it wrote
    assert neighbours.run(cells, file, measure) == [cells[3], cells[4]]
    assert asked == [*cells[:4], cells[5]]  # what needs a failed run is not begun
    printed = capsys.readouterr().err.splitlines()
    assert printed[0] == "failed: gridworld 3 8 bayespbrl: no luck"
    assert printed[1] == "failed: gridworld 3 8 posterior-ppo: the run of bayespbrl that it needs has failed"
    assert neighbours.table(neighbours.done(file))[2:] == [
        "| gridworld | 3 | bayespbrl | 1 | 0.0 [0.0, 0.0] | 0.0 | 3 | 100 | 1.0 |",
        "| gridworld | 3 | posterior-ppo | 1 | -1.0 [-1.0, -1.0] | -1.0 | 3 | 201 | 2.0 |",
        "| gridworld | 3 | imitation | 2 | -2.0 [-2.0, -2.0] | -2.0 | 3 | 102 | 1.0 |",
    ]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--tasks", "Pendulum"], "argument --tasks: invalid choice: 'Pendulum'"),
        (["--answers", "0"], "argument --answers: expected a whole number from 1 up, got 0"),
        (["--seeds", "first"], "argument --seeds: invalid int value: 'first'"),
        ([], "expected the methods' environments, got none; `make neighbours` builds them"),
    ],
)
def test_wrong_options_of_the_neighbours_are_one_line(neighbours, tmp_path, monkeypatch, capsys, options, message):
    monkeypatch.setattr(neighbours, "ENVIRONMENTS", tmp_path / "none")
    monkeypatch.setattr(sys, "argv", ["neighbours.py", "run", "--out", str(tmp_path / "rows.csv"), *options])
    with pytest.raises(SystemExit) as refused:
        neighbours.main()
    assert refused.value.code == 2
    assert message in capsys.readouterr().err.splitlines()[-1]


def test_an_earlier_version_is_compared_pair_by_pair_with_the_policies_that_the_default_kept(tmp_path):
    study = BENCHMARKS / "studies" / "earlier-version"
    kept = pd.read_csv(study / "iterations.csv").query("tasks == 'gridworld' and methods == 'default'")
    kept = kept.drop_duplicates("seed", keep="last").set_index("seed")["value"].iloc[:6]
    earlier = pd.DataFrame({"seed": kept.index, "answers": 12, "iterations": 11, "value": kept.to_numpy() - 1.5})
    earlier.loc[0, "value"] = 10.0
    others = pd.DataFrame(
        {"seed": [1], "answers": [12], "iterations": [11], "value": [0.0]}
    )  # of no trial of the study
    module = benchmark("earlier_version")
    file = module.rows_of("gridworld", tmp_path)
    pd.concat([earlier, others]).assign(with_noise=lambda rows: rows["value"]).to_csv(file, index=False)
    table = module.table(study, tmp_path)
    assert table["task"].tolist() == ["gridworld"]  # the others have no rows of the earlier version
    assert table["pairs"].tolist() == ["6"]
    assert table["default − earlier"].str.startswith("1.5 [1.5, ").all()
    assert table["earlier"].str.endswith(", 1 fail").all()
    assert table["default"].str.startswith(f"{np.median(kept):.4g} [").all()


@pytest.mark.slow
def test_kept_policies_are_compared_with_the_best_by_other_episodes(printed, tmp_path):
    options = QUICK | {"preset": "default", "utility": "posterior-mean", "checked": True, "iterations": 3}
    bayespbrl.start("gridworld", tmp_path / "row" / "seed-5", **options | {"seed": 5}).run(bayespbrl.ReturnExpert())
    lines = printed("kept_policies", tmp_path / "row", "--out", tmp_path / "kept.csv", "--episodes", "20")
    (row,) = pd.read_csv(tmp_path / "kept.csv").to_dict("records")
    run = bayespbrl.load(tmp_path / "row" / "seed-5")
    assert (row["seed"], row["policies"], row["kept"]) == (5, 3, run.iterations[-1]["kept"])
    assert row["seemed best"] == pytest.approx(max(each["value_newest"] for each in run.iterations), abs=1e-4)
    assert row["value best"] > row["value first"]
    assert any(line.startswith("fresh episodes: close in") for line in lines)


@pytest.mark.slow
def test_an_answer_that_states_no_order_is_not_scored(tmp_path):
    said = iter(["first", "first", "tie", "second"])
    options = QUICK | {"utility": "posterior-mean", "iterations": 3}
    bayespbrl.start("gridworld", tmp_path / "run", **options).run(lambda first, second: next(said))
    predicted, first_preferred, runs = benchmark("calibration").predictions(tmp_path)
    assert (predicted.shape, first_preferred.tolist(), runs) == ((1,), [False], 1)
    assert 0 < predicted[0] < 1
