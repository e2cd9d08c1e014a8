"""Files are whole or not there, whatever goes wrong while they are written."""

import os

import numpy as np
import pytest
import xarray as xr

from bayespbrl.runs.files import write_file, write_netcdf, written_aside


@pytest.mark.parametrize(("content", "expected"), [("σ = 1\n", "σ = 1\n".encode()), (b"\x89PNG\r\n", b"\x89PNG\r\n")])
def test_text_and_bytes_are_written_as_they_are_and_nothing_else_is_left(tmp_path, content, expected):
    write_file(tmp_path / "file", "before")
    write_file(tmp_path / "file", content)
    assert (tmp_path / "file").read_bytes() == expected
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
@pytest.mark.parametrize("moment", ["write", "fsync"])
def test_an_error_leaves_the_file_as_it_was_and_nothing_beside_it(tmp_path, monkeypatch, moment, error):
    def fail(*arguments):
        raise error("stopped")

    write_file(tmp_path / "file", "before")
    if moment == "fsync":
        monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(error, match="stopped"), written_aside(tmp_path / "file") as aside:  # noqa: PT012
        aside.write_text("half")
        if moment == "write":
            fail()
    assert (tmp_path / "file").read_text() == "before"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_what_a_killed_process_left_aside_does_not_hinder_the_next_write(tmp_path):
    (tmp_path / "file.part").write_text("left over, and longer than what follows")
    write_file(tmp_path / "file", "new")
    assert (tmp_path / "file").read_text() == "new"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_the_content_is_on_the_disk_before_it_takes_the_files_place(tmp_path, monkeypatch):
    file, synced = tmp_path / "file", []
    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.append((os.fstat(descriptor).st_size, file.exists())))
    write_file(file, "content")
    assert synced == [(7, False)]


def test_a_netcdf_file_has_all_groups_and_no_room_to_spare(tmp_path):
    numbers = xr.Dataset({"a": ("x", np.arange(5.0)), "b": ((), True)}, attrs={"class": "numbers"})
    tree = xr.DataTree.from_dict({"/": numbers, "/inner/text": xr.Dataset({"c": ("y", ["one", "three"])})})
    write_netcdf(tmp_path / "tree.nc", tree)
    with xr.open_datatree(tmp_path / "tree.nc", engine="h5netcdf") as opened:  # another library than the one that wrote
        assert opened.load().identical(tree)
    assert (tmp_path / "tree.nc").stat().st_size < 16_000
