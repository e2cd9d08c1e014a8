"""Studies: the trials of a study, its tables, what is kept and redrawn, and that its processes end with it."""

import contextlib
import csv
import json
import os
import shutil
import signal
import subprocess
import time
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import jax
import numpy as np
import pytest
import xarray as xr
from toys import INTERRUPTIBLE, SHORT

from bayespbrl import ReturnExpert, load, resume, start
from bayespbrl.rollouts import returns
from bayespbrl.studies import Trials, rows, run_trials
from bayespbrl.studies import trials as trials_module
from bayespbrl.studies.tables import COLUMNS, SECONDS, collect, collect_first_policies, survival, write_tables

PARTS = ("utility", "improvement", "evaluation")
QUICK = SHORT | {"utility": "linear-program", "iterations": 2}


class ThisProcess:
    """A pool without processes, which take most of the time of a short trial."""

    def submit(self, function, *arguments):
        future = Future()
        try:
            future.set_result(function(*arguments))
        except Exception as error:
            future.set_exception(error)
        return future


def without_processes(monkeypatch):
    monkeypatch.setattr(trials_module, "trial_processes", lambda jobs: contextlib.nullcontext(ThisProcess()))


@pytest.fixture
def in_this_process(monkeypatch):
    without_processes(monkeypatch)


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """Of two trials, in this process."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        without_processes(monkeypatch)
        return run_trials("gridworld", tmp_path_factory.mktemp("study"), seeds=range(5, 7), **QUICK)


def test_every_trial_is_a_run_that_load_reads(study):
    for seed in (5, 6):
        run = load(study.path / f"seed-{seed}")
        assert run.settings.seed == seed
        assert run.iterations[-1]["value"] == float(study.table["value"].sel(seed=seed, iteration=2))


def test_the_tables_hold_a_row_a_trial_and_iteration(study):
    with (study.path / "trials.csv").open() as file:
        rows = list(csv.reader(file))
    assert tuple(rows[0]) == COLUMNS
    assert [(row[0], row[1], row[2], row[3], row[4]) for row in rows[1:]] == [
        ("gridworld", "linear-program", str(seed), str(iteration), str(iteration + 1))
        for seed in (5, 6)
        for iteration in (1, 2)
    ]
    stored = xr.load_dataset(study.path / "trials.nc", engine="h5netcdf")
    np.testing.assert_array_equal(stored["value"], study.table["value"])
    assert stored.attrs["utility"] == "linear-program"


def test_quartiles_are_those_of_the_values(study):
    values = study.table["value"].values
    quartiles = study.quartiles()
    np.testing.assert_allclose(quartiles["median"], np.median(values, axis=0))
    np.testing.assert_allclose(quartiles["lower_quartile"], np.quantile(values, 0.25, axis=0))
    np.testing.assert_array_equal(quartiles["answers"], [2, 3])


def test_quartiles_follow_the_answers_that_each_trial_gave():
    # asks in the first and the third iteration; in every one; in the first alone
    answers = np.array([[2, 2, 3, 3], [2, 3, 4, 5], [2, 2, 2, 2]])
    values = np.array([[1.0, 2.0, 30.0, 40.0], [5.0, 6.0, 7.0, 8.0], [9.0, 11.0, 13.0, 15.0]])
    table = xr.Dataset({"answers": (("seed", "iteration"), answers), "value": (("seed", "iteration"), values)})
    quartiles = Trials(table, Path("study")).quartiles()
    np.testing.assert_array_equal(quartiles["answers"], [2, 3, 4, 5])
    columns = [[2, 5, 15], [40, 6, 15], [40, 7, 15], [40, 8, 15]]  # the last policy before the next question, or at all
    np.testing.assert_allclose(quartiles["median"], np.median(columns, axis=1))
    np.testing.assert_allclose(quartiles["upper_quartile"], np.quantile(columns, 0.75, axis=1))


def test_summaries_become_arrays_lists_with_a_dimension_of_their_own_and_none_as_nan(tmp_path):
    for seed in (1, 2):
        rows = [
            {
                "iteration": i,
                "answers": 2 * i,
                "value": i + seed,
                "scale": None if i == 1 else 0.5,
                "spread": [i, 10.0 * seed],
                "kind": "x",
                "seconds": {"utility": 0.1 * i, "improvement": 1.0, "evaluation": 2.0, "kind": "y"},
                "chosen": None if i == 1 else {"multiples": [1.0, 2.0, i]},
            }
            for i in (1, 2, 3)
        ]
        summary = {"env": "e", "utility": "u", "seed": seed, "finished": True, "iterations": rows}
        (tmp_path / str(seed)).mkdir()
        (tmp_path / str(seed) / "summary.json").write_text(json.dumps(summary))
    table = collect([tmp_path / "1", tmp_path / "2"])
    assert set(table.data_vars) == {"answers", "value", "scale", "spread", *SECONDS, "chosen_multiples"}
    np.testing.assert_allclose(table["seconds_utility"], 2 * [[0.1, 0.2, 0.3]])
    assert table["chosen_multiples"].sel(seed=1, iteration=3).values.tolist() == [1, 2, 3]
    assert table["chosen_multiples"].sel(seed=1, iteration=1).isnull().all()
    np.testing.assert_array_equal(table["value"], [[2, 3, 4], [3, 4, 5]])
    np.testing.assert_array_equal(table["scale"], 2 * [[np.nan, 0.5, 0.5]])
    assert table["spread"].shape == (2, 3, 2)
    np.testing.assert_array_equal(table["spread"].sel(seed=2, iteration=3), [3, 20])


def test_a_run_that_ends_earlier_keeps_its_last_figures(tmp_path):
    for seed, length in ((1, 3), (2, 1)):
        rows = [
            {"iteration": i, "answers": i, "value": 10.0 * seed + i, "seconds": dict.fromkeys(PARTS, 1.0)}
            for i in range(1, length + 1)
        ]
        summary = {"env": "e", "utility": "u", "seed": seed, "finished": True, "iterations": rows}
        (tmp_path / str(seed)).mkdir()
        (tmp_path / str(seed) / "summary.json").write_text(json.dumps(summary))
    table = collect([tmp_path / "2", tmp_path / "1"])
    np.testing.assert_array_equal(table["value"].sel(seed=2), [21, 21, 21])
    np.testing.assert_array_equal(table["value"].sel(seed=1), [11, 12, 13])
    np.testing.assert_array_equal(table["seconds_utility"].sel(seed=2), [1, np.nan, np.nan])
    write_tables(table.assign(value_newest=table["value"]), tmp_path)
    with (tmp_path / "trials.csv").open() as file:  # only what took place
        assert [(row["seed"], row["iteration"]) for row in csv.DictReader(file)] == [
            ("2", "1"),
            *(("1", str(iteration)) for iteration in (1, 2, 3)),
        ]


def test_a_trial_is_the_run_of_its_seed(study, tmp_path):
    learner = start("gridworld", tmp_path / "run", seed=5, **QUICK).run(ReturnExpert())
    kept = json.loads((study.path / "seed-5" / "summary.json").read_text())["iterations"]
    assert [entry["value"] for entry in learner.iterations] == pytest.approx([entry["value"] for entry in kept])


@pytest.mark.slow
def test_trials_in_processes_of_their_own_are_those_in_this_one(study, tmp_path):
    apart = run_trials("gridworld", tmp_path / "study", seeds=range(5, 7), jobs=2, **QUICK)
    assert load(apart.path / "seed-6").learner.finished
    np.testing.assert_allclose(apart.table["value"], study.table["value"], rtol=1e-6)


@pytest.mark.usefixtures("in_this_process")
def test_a_second_call_keeps_finished_trials_and_goes_on_with_unfinished_ones(study):
    finished, stopped = study.path / "seed-5", study.path / "seed-6"
    before = {file: file.stat().st_mtime_ns for file in finished.rglob("*") if file.is_file()}
    values = study.table["value"].values
    events = (stopped / "events.jsonl").read_text().splitlines(keepends=True)
    (stopped / "events.jsonl").write_text("".join(events[:4]))  # as if killed after the second question
    (stopped / "summary.json").unlink()
    (study.path / "trials.nc").unlink()
    again = run_trials("gridworld", study.path, seeds=range(5, 7), **QUICK)
    assert (study.path / "trials.nc").exists()
    assert {file: file.stat().st_mtime_ns for file in finished.rglob("*") if file.is_file()} == before
    np.testing.assert_array_equal(again.table["value"].values, values)


class Chance(gymnasium.Env):
    """A walk that ends outside; no seed decides it."""

    observation_space, action_space = gymnasium.spaces.Box(-10, 10, (1,)), gymnasium.spaces.Box(-1, 1, (1,))
    rng = np.random.default_rng(8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.rng.normal(0, 0.5, 1)
        return self.x.astype(np.float32), {}

    def step(self, action):
        self.x = np.clip(self.x + 0.3 * action + self.rng.normal(0, 0.3, 1), -10, 10)
        return self.x.astype(np.float32), -abs(self.x[0]), bool(abs(self.x[0]) > 1), False, {}


def test_trials_of_a_task_that_no_seed_decides_share_what_was_measured(tmp_path):
    gymnasium.register("Chance-v0", entry_point=Chance, max_episode_steps=100)
    options = {"answers": 1, "evaluation_episodes": 1, "utility": "linear-program", "restart_iterations": 0}
    try:
        row = rows.row_of("Chance-v0", tmp_path / "row", options, seed=1)
        measured = row.settings.rollouts.trajectories_per_iteration
        again = [rows.row_of("Chance-v0", tmp_path / "row", options, seed=1) for _ in range(3)]
        assert {each.settings.rollouts.trajectories_per_iteration for each in again} != {measured}
        assert rows.run_trial(row, 1)
        assert load(row.path(1), env="Chance-v0").settings == row.settings
        assert [each.outcome(1) for each in (row, *again)] == [True] * 4
        later = [rows.row_of("Chance-v0", tmp_path / "row", options, seed=1) for _ in range(3)]
        assert {each.settings.rollouts.trajectories_per_iteration for each in later} == {measured}
    finally:
        del gymnasium.registry["Chance-v0"]


def test_trials_with_another_number_of_trajectories_are_refused_where_it_is_not_measured(tmp_path):
    rows.run_trial(rows.row_of("gridworld", tmp_path / "row", QUICK | {"trajectories_per_iteration": 4}, seed=5), 5)
    with pytest.raises(ValueError, match=r"got others: trajectories_per_iteration 4 instead of 10$"):
        rows.row_of("gridworld", tmp_path / "row", QUICK, seed=5).outcome(5)


def test_a_trial_of_another_task_is_named(study):
    with pytest.raises(
        ValueError, match=r"with these settings, got others: env 'gridworld' instead of 'FrozenLake-v1'"
    ):
        rows.row_of("FrozenLake-v1", study.path, QUICK, seed=5).outcome(5)


def test_the_directory_of_a_run_takes_no_trials(study):
    run = next(study.path.glob("seed-*"))
    before = sorted(path.name for path in run.iterdir())
    with pytest.raises(ValueError, match="expected a directory for trials, got a run"):
        run_trials("gridworld", run, seeds=range(2990, 2991), **QUICK)
    assert sorted(path.name for path in run.iterdir()) == before


def test_a_directory_with_other_settings_is_refused(study):
    wrong = f"expected a trial with these settings, got others: iterations {QUICK['iterations']} instead of 3$"
    with pytest.raises(ValueError, match=wrong):
        run_trials("gridworld", study.path, seeds=range(5, 7), **(QUICK | {"iterations": 3}))
    with pytest.raises(ValueError, match=wrong):  # all but the first seed differ from the row's
        rows.row_of("gridworld", study.path, QUICK | {"iterations": 3}, seed=5).outcome(6)


# A single step from the centre of the grid often brings three times the same reward: in seeds 6 and 7 the first answers
# are both ties, in 5, 8 and 9 they are not.
TIED = QUICK | {"max_steps": 1, "evaluation_episodes": 2, "preference_within": 1}


@pytest.fixture(scope="module")
def redrawn(tmp_path_factory):
    with pytest.MonkeyPatch.context() as monkeypatch:
        without_processes(monkeypatch)
        return run_trials("gridworld", tmp_path_factory.mktemp("redrawn"), seeds=range(5, 8), **TIED)


@pytest.mark.slow
def test_a_trial_that_meets_no_preference_is_left_and_the_next_unused_seed_takes_its_place(redrawn):
    assert redrawn.table["seed"].values.tolist() == [5, 8, 9]
    assert redrawn.table.attrs["redraws"] == 2
    assert redrawn.table.attrs["redrawn_seeds"] == "6 7"
    assert (redrawn.table["pairs"].values > 0).all()
    for seed in (6, 7):
        left = load(redrawn.path / f"seed-{seed}")
        assert len(left.iterations) == 1
        assert left.preferences.pairs == ()
    stored = xr.load_dataset(redrawn.path / "trials.nc", engine="h5netcdf")
    assert stored.attrs["redraws"] == 2
    with (redrawn.path / "trials.csv").open() as file:
        assert {row["seed"] for row in csv.DictReader(file)} == {"5", "8", "9"}


@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
def test_a_second_call_redraws_nothing_again_and_a_lost_trial_comes_back(redrawn):
    before = {file: file.stat().st_mtime_ns for file in redrawn.path.rglob("seed-[5679]/**/*") if file.is_file()}
    values = redrawn.table["value"].values
    shutil.rmtree(redrawn.path / "seed-8")
    finished = []
    again = run_trials("gridworld", redrawn.path, seeds=range(5, 8), progress=finished.append, **TIED)
    assert sorted(finished) == [5, 8, 9]  # two of them from before
    assert {file: file.stat().st_mtime_ns for file in before} == before
    np.testing.assert_array_equal(again.table["value"].values, values)


@pytest.mark.parametrize("order", [[0, 1, 2, 3, 4, 5], [2, 1, 0, 3, 5, 4], [1, 0, 2, 4, 3, 5]])
def test_the_seeds_of_a_study_do_not_depend_on_which_trial_ends_first(order):
    outcomes = {10: True, 11: False, 12: False, 13: False, 14: True, 15: True, 16: True}
    row = SimpleNamespace(settings=SimpleNamespace(seed=10), outcome=lambda seed: None, preference_within=3)
    seeds = rows.Seeds(row, trials=3)
    while to_do := seeds.to_do():
        seed = next(10 + place for place in order if 10 + place in to_do)
        seeds.outcomes[seed] = outcomes[seed]
    assert seeds.with_outcome(True) == [10, 14, 15]
    assert seeds.with_outcome(False) == [11, 12, 13]


@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
def test_a_study_that_hardly_ever_meets_a_preference_gives_up(tmp_path, monkeypatch):
    monkeypatch.setattr(rows, "MOST_SEEDS_A_TRIAL", 2)
    with pytest.raises(ValueError, match="expected 1 trials with a preference within 1 iterations, got none in 2 of 2"):
        run_trials("gridworld", tmp_path, seeds=range(6, 7), **TIED)


@pytest.mark.usefixtures("in_this_process")
def test_a_trial_that_fails_is_named_by_its_seed_and_the_others_are_finished(study, tmp_path):
    shutil.copytree(study.path / "seed-5", tmp_path / "seed-5")
    (tmp_path / "seed-5" / "summary.json").unlink()
    (tmp_path / "seed-5" / "iterations" / "0001.nc").write_text("hello")
    with pytest.raises(ValueError, match=r"1 of 2 trials failed; the first: seed 5: .*0001\.nc: expected the netCDF"):
        run_trials("gridworld", tmp_path, seeds=range(5, 7), **QUICK)
    assert load(tmp_path / "seed-6").learner.finished


@pytest.mark.parametrize("iterations", [[{}], [1], {"1": 2}])
@pytest.mark.usefixtures("in_this_process")
def test_a_trial_with_a_foreign_summary_is_named(study, tmp_path, iterations):
    shutil.copytree(study.path / "seed-5", tmp_path / "seed-5")
    summary = json.loads((tmp_path / "seed-5" / "summary.json").read_text())
    (tmp_path / "seed-5" / "summary.json").write_text(json.dumps(summary | {"iterations": iterations}))
    with pytest.raises(ValueError, match=r"seed-5/summary\.json: expected pairs in each iteration, got"):
        run_trials("gridworld", tmp_path, seeds=range(5, 6), **QUICK)


@pytest.mark.parametrize("content", ["{", "[]", '{"episodes": 3}', '{"value": "high"}'])
def test_a_foreign_value_of_a_first_policy_is_named(tmp_path, content):
    (tmp_path / "seed-5").mkdir()
    file = tmp_path / "seed-5" / "first-policy.json"
    file.write_text(content)
    with pytest.raises(ValueError, match=r"first-policy\.json: expected value, got "):
        collect_first_policies([file.parent], "gridworld")
    file.write_text('{"value": 2.5}')
    assert collect_first_policies([file.parent], "gridworld")["value"].item() == 2.5


def test_only_the_acrobot_needs_a_preference_and_within_three_iterations(tmp_path):
    names = ("acrobot", "bayespbrl/Acrobot-v0", "gridworld", "CartPole-v1")
    made = [rows.row_of(env, tmp_path, {}, seed=1000) for env in names]
    assert [row.preference_within for row in made] == [3, 3, None, None]


def test_a_trial_stopped_while_it_computes_is_redrawn_as_one_that_was_not(tmp_path, monkeypatch):
    """Whether an order came in time is looked at when the iteration is complete, however often the process died."""
    answered = []
    monkeypatch.setattr(
        rows, "expert_of", lambda learner: lambda *shown: answered.append(shown) or answers[len(answered)]
    )
    answers = {number: "tie" if number <= 4 else "first" for number in range(1, 20)}  # two, one, one, and then an order
    options = QUICK | {"iterations": 6, "evaluation_episodes": 2}
    row = rows.row_of("gridworld", tmp_path, options, seed=10, preference_within=3)
    assert rows.run_trial(row, 10) is False
    run = row.path(10)
    lines = (run / "events.jsonl").read_text().splitlines(keepends=True)
    last = max(number for number, line in enumerate(lines) if json.loads(line)["event"] == "answered")
    (run / "events.jsonl").write_text("".join(lines[: last + 1]))  # as if killed in the third iteration
    (run / "summary.json").unlink()
    assert row.outcome(10) is None
    assert rows.run_trial(row, 10) is False
    assert row.outcome(10) is False
    assert len(answered) == 4


def test_survival_is_of_the_policy_whose_value_is_told():
    ended = np.array([[0.9, 0.1, 0.6], [0.8, 0.4, 0.2]])
    kept = np.array([[1, 2, 2], [1, 2, np.nan]])  # an earlier version did not say
    names = ("seed", "iteration")
    table = xr.Dataset({"terminated": (names, ended)}, {"seed": [1, 2], "iteration": [1, 2, 3]})
    np.testing.assert_allclose(survival(table), 1 - ended)
    told = survival(table.assign(kept=(names, kept)))
    np.testing.assert_allclose(told, [[0.1, 0.9, 0.9], [0.2, 0.6, 0.8]])


@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
def test_bicycle_trials_tell_survival_and_balancing_time(tmp_path):
    options = {
        "preset": "paper",
        "utility": "linear-program",
        "iterations": 2,
        "centres": 20,
        "evaluation_episodes": 10,
    }
    study = run_trials("bicycle", tmp_path, seeds=range(1, 2), policy="linear-gaussian", **options)
    run = load(tmp_path / "seed-1")
    last = returns("bicycle", run.learner.policy, key=jax.random.key(1), episodes=100, max_steps=3000)
    steps = study.table["balancing_steps"]
    assert steps.values.tolist() == [last.steps.mean()]
    assert steps.attrs == {"max_steps": 3000, "episodes": 100}
    with (tmp_path / "trials.csv").open() as file:
        first, second = csv.DictReader(file)
    assert float(second["survival"]) == pytest.approx(1 - run.iterations[-1]["terminated"])
    assert float(second["balancing_steps"]) == last.steps.mean()
    assert float(second["balancing_seconds"]) == pytest.approx(0.01 * last.steps.mean())
    assert (first["balancing_steps"], first["balancing_seconds"]) == ("", "")
    (tmp_path / "seed-1" / "balancing.json").unlink()  # as if killed before it was measured
    again = run_trials("bicycle", tmp_path, seeds=range(1, 2), policy="linear-gaussian", **options)
    np.testing.assert_array_equal(again.table["balancing_steps"], steps)


@pytest.mark.parametrize(
    "changes",
    [
        *({"seeds": seeds} for seeds in (range(5, 5), range(0, 8, 2), [5, 6], 5)),
        *({"jobs": 0}, {"preference_within": 0}, {"expert": "terminal"}, {"kl_bound": -1.0}),
    ],
)
def test_bad_input_is_named_and_nothing_is_left(tmp_path, changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        run_trials("gridworld", tmp_path / "study", **({"seeds": range(1000, 1001)} | changes))
    assert not (tmp_path / "study").exists()


@pytest.mark.slow
@pytest.mark.parametrize("how", ["killed", "interrupted"])
def test_a_study_that_is_stopped_takes_its_trials_with_it(tmp_path, how):
    command = [*INTERRUPTIBLE, "trials", "gridworld"]
    options = [
        "--preset",
        "paper",
        "--utility",
        "linear-program",
        "--iterations",
        "100000",
        "--trials",
        "3",
        "--jobs",
        "2",
    ]
    options += ["--out", str(tmp_path / "study")]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([*command, *options], **streams, start_new_session=True) as study:
        try:
            logs = [tmp_path / "study" / f"seed-{seed}" / "events.jsonl" for seed in (1000, 1001)]
            waited = time.monotonic() + 120
            while not all(log.exists() and log.stat().st_size for log in logs):
                assert time.monotonic() < waited
                assert study.poll() is None
                time.sleep(0.1)
            if how == "interrupted":
                os.killpg(study.pid, signal.SIGINT)  # as the terminal does: to the trials too
                shown, _ = study.communicate(timeout=60)
        finally:
            study.kill()
        study.communicate(timeout=60)  # their end of the pipe is closed: they have ended
    if how == "interrupted":
        assert study.returncode == 130
        assert b"Nothing is lost" in shown
        assert not (tmp_path / "study" / "seed-1002").exists()
    lengths = [log.stat().st_size for log in logs]
    time.sleep(1.0)
    assert [log.stat().st_size for log in logs] == lengths
    assert not resume(tmp_path / "study" / "seed-1000").finished
