import csv
import json

import numpy as np
import pytest
import xarray as xr

from bayespbrl import load
from bayespbrl.trials import COLUMNS, collect, run_trials

QUICK = {"utility": "linear-program", "iterations": 2}


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return run_trials("gridworld", tmp_path_factory.mktemp("study"), trials=2, jobs=2, seed=5, **QUICK)


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


def test_summaries_become_arrays_lists_with_a_dimension_of_their_own_and_none_as_nan(tmp_path):
    for seed in (1, 2):
        rows = [
            {
                "iteration": i,
                "value": i + seed,
                "scale": None if i == 1 else 0.5,
                "spread": [i, 10.0 * seed],
                "kind": "x",
            }
            for i in (1, 2, 3)
        ]
        summary = {"env": "e", "utility": "u", "seed": seed, "finished": True, "iterations": rows}
        (tmp_path / str(seed)).mkdir()
        (tmp_path / str(seed) / "summary.json").write_text(json.dumps(summary))
    table = collect([tmp_path / "1", tmp_path / "2"])
    assert set(table.data_vars) == {"value", "scale", "spread"}
    np.testing.assert_array_equal(table["value"], [[2, 3, 4], [3, 4, 5]])
    np.testing.assert_array_equal(table["scale"], 2 * [[np.nan, 0.5, 0.5]])
    assert table["spread"].shape == (2, 3, 2)
    np.testing.assert_array_equal(table["spread"].sel(seed=2, iteration=3), [3, 20])


def test_a_trial_in_a_process_of_its_own_is_the_run_of_its_seed(study, tmp_path):
    from bayespbrl import ReturnExpert, start

    learner = start("gridworld", tmp_path / "run", seed=5, **QUICK).run(ReturnExpert())
    kept = json.loads((study.path / "seed-5" / "summary.json").read_text())["iterations"]
    assert [entry["value"] for entry in learner.iterations] == pytest.approx([entry["value"] for entry in kept])


def test_a_second_call_keeps_finished_trials_and_goes_on_with_unfinished_ones(study):
    import shutil

    finished, stopped = study.path / "seed-5", study.path / "seed-6"
    before = {file: file.stat().st_mtime_ns for file in finished.rglob("*") if file.is_file()}
    values = study.table["value"].values
    events = (stopped / "events.jsonl").read_text().splitlines(keepends=True)
    (stopped / "events.jsonl").write_text("".join(events[:4]))  # as if killed after the second question
    (stopped / "summary.json").unlink()
    shutil.rmtree(study.path / "trials.nc", ignore_errors=True)
    again = run_trials("gridworld", study.path, trials=2, jobs=1, seed=5, **QUICK)
    assert {file: file.stat().st_mtime_ns for file in finished.rglob("*") if file.is_file()} == before
    np.testing.assert_array_equal(again.table["value"].values, values)


def test_a_directory_with_other_settings_is_refused(study):
    with pytest.raises(ValueError, match="expected a trial with these settings"):
        run_trials("gridworld", study.path, trials=2, seed=5, **(QUICK | {"iterations": 3}))


@pytest.mark.parametrize("changes", [{"trials": 0}, {"jobs": 0}, {"expert": "terminal"}, {"kl_bound": -1.0}])
def test_bad_input_is_named_and_nothing_is_left(tmp_path, changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        run_trials("gridworld", tmp_path / "study", **({"trials": 1} | changes))
    assert not (tmp_path / "study").exists()
