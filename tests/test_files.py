"""Files are whole or not there, whatever goes wrong while they are written."""

import os
import stat
import subprocess
import sys
from unittest import mock

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


def test_what_a_killed_process_left_aside_is_deleted_once_it_is_old_and_nothing_else_is(tmp_path):
    killed = "from pathlib import Path; import os, sys; from bayespbrl.runs.files import written_aside\n"
    killed += "with written_aside(Path(sys.argv[1])) as aside: aside.write_text('half'); os._exit(9)"
    assert subprocess.run([sys.executable, "-c", killed, tmp_path / "file"], check=False).returncode == 9
    [left] = tmp_path.iterdir()
    assert left.name.startswith("file.")
    assert left.name.endswith(".part")
    others = [tmp_path / name for name in ("movie.part", "file.part", "file.12-0123abc.part", ".12-01234567.part")]
    for other in others:
        other.write_text("a stranger's")
        os.utime(other, (0, 0))
    write_file(tmp_path / "another", "new")
    assert left.read_text() == "half"  # it may be on its way
    os.utime(left, (0, 0))
    write_file(tmp_path / "another", "new")
    assert sorted(tmp_path.iterdir()) == sorted([tmp_path / "another", *others])


def test_two_writers_of_one_file_do_not_disturb_each_other(tmp_path):
    with written_aside(tmp_path / "file") as first:
        first.write_text("first")
        with written_aside(tmp_path / "file") as second:
            second.write_text("second")
        assert (tmp_path / "file").read_text() == "second"
    assert (tmp_path / "file").read_text() == "first"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_the_content_is_on_the_disk_before_it_takes_the_files_place(tmp_path, monkeypatch):
    file, synced = tmp_path / "file", []
    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.append((os.fstat(descriptor), file.exists())))
    write_file(file, "content")
    (content, before), (folder, after) = synced
    assert (content.st_size, before) == (7, False)
    assert (stat.S_ISDIR(folder.st_mode), after) == (True, True)  # the name is flushed too


def test_a_netcdf_file_has_all_groups_and_no_room_to_spare(tmp_path):
    numbers = xr.Dataset({"a": ("x", np.arange(5.0)), "b": ((), True)}, attrs={"class": "numbers"})
    tree = xr.DataTree.from_dict({"/": numbers, "/inner/text": xr.Dataset({"c": ("y", ["one", "three"])})})
    write_netcdf(tmp_path / "tree.nc", tree)
    with xr.open_datatree(tmp_path / "tree.nc", engine="h5netcdf") as opened:  # another library than the one that wrote
        assert opened.load().identical(tree)
    assert (tmp_path / "tree.nc").stat().st_size < 16_000


@pytest.mark.parametrize(("place", "value"), [(8, 0), (8, 1), (8, 4), (9, 4)])
def test_a_netcdf_file_whose_superblock_is_of_another_kind_is_not_cut(tmp_path, monkeypatch, place, value):
    content = bytearray(1000)
    content[8], content[9], content[28] = 2, 8, 100
    opened = mock.Mock(close=lambda: memoryview(content))
    monkeypatch.setattr("bayespbrl.runs.files.netCDF4.Dataset", lambda *arguments, **options: opened)
    monkeypatch.setattr(xr.Dataset, "dump_to_store", lambda *arguments: None)
    monkeypatch.setattr("bayespbrl.runs.files.NetCDF4DataStore", lambda group: None)
    write_netcdf(tmp_path / "cut.nc", xr.Dataset())
    content[place] = value
    write_netcdf(tmp_path / "whole.nc", xr.Dataset())
    assert [(tmp_path / name).stat().st_size for name in ("cut.nc", "whole.nc")] == [100, 1000]
