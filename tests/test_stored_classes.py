"""Dataclasses as trees and back, through a file, without loss and without pickle."""

import dataclasses
import math
import re
from dataclasses import dataclass

import jax
import numpy as np
import pytest
import xarray as xr

from bayespbrl.features import DiffusionBasis, OneHot, RadialBasis
from bayespbrl.policies import LinearGaussianPolicy, TabularPolicy
from bayespbrl.runs.stored_classes import STORED, from_tree, to_tree
from bayespbrl.utility.estimate import FitQuality


@dataclass(frozen=True)
class Inner:
    values: np.ndarray


@dataclass(frozen=True)
class Outer:
    inner: Inner
    table: object
    scalar: np.ndarray
    empty: np.ndarray
    number: float
    count: int
    flag: bool
    name: str
    nothing: None
    pair: tuple


def through_a_file(instance, tmp_path, known=()):
    file = tmp_path / "instance.nc"
    xr.DataTree.from_dict({"instance": to_tree(instance)}).to_netcdf(file, engine="h5netcdf")
    with xr.open_datatree(file, engine="h5netcdf") as tree:
        return from_tree(tree.load().children["instance"], known=known)


def test_a_field_that_was_left_out_has_to_be_given(tmp_path):
    tree = to_tree(Inner(np.arange(3.0)), without=("values",))
    assert not tree.data_vars
    assert list(from_tree(tree, known=(Inner,), given={"values": np.ones(2)}).values) == [1.0, 1.0]
    with pytest.raises(ValueError, match="stored class: expected the fields of Inner, got others"):
        from_tree(tree, known=(Inner,))


def test_everything_comes_back_exactly(tmp_path):
    rng = np.random.default_rng(0)
    instance = Outer(
        inner=Inner(rng.normal(size=(3, 2)) * 10.0 ** rng.integers(-300, 300, (3, 2))),
        table=np.arange(6, dtype=np.int64).reshape(2, 3),
        scalar=np.asarray(1 / 3),
        empty=np.zeros((0, 4)),
        number=0.1 + 0.2,
        count=2**40,
        flag=True,
        name="swing-up – «β»",
        nothing=None,
        pair=(1, 2.5),
    )
    back = through_a_file(instance, tmp_path, known=(Outer, Inner))
    assert type(back) is Outer
    assert type(back.inner) is Inner
    for name in ("table", "scalar", "empty"):
        stored, given = getattr(back, name), getattr(instance, name)
        assert (stored.dtype, stored.shape, stored.tobytes()) == (given.dtype, given.shape, given.tobytes())
    assert back.inner.values.tobytes() == instance.inner.values.tobytes()
    for name in ("number", "count", "flag", "name", "nothing", "pair"):
        assert getattr(back, name) == getattr(instance, name)
        assert type(getattr(back, name)) is type(getattr(instance, name))


def test_what_is_not_finite_comes_back(tmp_path):
    quality = FitQuality(True, "Optimal", 3, 2, effective_sample_size_min=math.inf)
    back = through_a_file(quality, tmp_path)
    assert math.isnan(back.rhat_max)
    assert back.effective_sample_size_min == math.inf
    assert (back.converged, back.pairs_satisfied) == (True, 2)


@pytest.mark.parametrize(
    "instance",
    [
        OneHot(25),
        DiffusionBasis(np.eye(3), np.arange(3.0), np.array([0.5])),
        RadialBasis(np.random.default_rng(1).normal(size=(4, 2)), np.array([0.3, 0.7]), np.array([np.inf, 6.28])),
        TabularPolicy(np.random.default_rng(2).dirichlet(np.ones(3), 5)),
        LinearGaussianPolicy(np.ones((1, 3)), np.zeros(2), np.ones(2), np.eye(1), np.ones(1), np.asarray(0.01)),
    ],
)
def test_features_and_policies_come_back_exactly(instance, tmp_path):
    back = through_a_file(instance, tmp_path)
    assert type(back) is type(instance)
    for name, value in vars(instance).items():
        np.testing.assert_array_equal(getattr(back, name), value)


def test_arrays_of_jax_come_back_as_numpy(tmp_path):
    with jax.enable_x64(True):
        table = jax.numpy.full((2, 2), 0.5)
    back = through_a_file(TabularPolicy(table), tmp_path)
    assert isinstance(back.table, np.ndarray)
    assert back.table.dtype == np.float64


@pytest.mark.parametrize("instance", [lambda states: states, Inner, Inner([1, 2]), Inner({"a": 1}), 3.0])
def test_what_cannot_be_stored_is_refused(instance):
    with pytest.raises(ValueError, match="stored class: "):
        to_tree(instance)


def test_a_class_of_somebody_elses_is_not_made_unless_it_is_passed():
    tree = to_tree(Inner(np.ones(2)))
    with pytest.raises(ValueError, match="stored class: expected a class of bayespbrl or one of the objects passed"):
        from_tree(tree)
    assert isinstance(from_tree(tree, known=(Inner,)), Inner)


@pytest.mark.parametrize(
    "name",
    [
        "os:system",
        "bayespbrl.features:OneHot",
        "OneHot",
        "own:OneHot",
        "",
    ],
)
def test_a_foreign_file_cannot_name_anything_but_our_dataclasses(name):
    tree = to_tree(OneHot(3))
    tree.attrs["class"] = name
    with pytest.raises(ValueError, match="stored class: expected"):
        from_tree(tree)


def test_files_name_classes_by_short_names_that_say_nothing_of_modules():
    assert to_tree(OneHot(3)).attrs["class"] == "one-hot"
    assert to_tree(Inner(np.ones(2))).attrs["class"] == "own:Inner"
    for name, kind in STORED.items():
        assert re.fullmatch("[a-z-]+", name)
        assert dataclasses.is_dataclass(kind)


@pytest.mark.parametrize("fields", ['{"number_of_states": 3, "colour": 1}', "{}", "not json"])
def test_fields_that_do_not_fit_are_refused(fields):
    tree = to_tree(OneHot(3))
    tree.attrs["fields"] = fields
    with pytest.raises(ValueError):  # noqa: PT011
        from_tree(tree)
