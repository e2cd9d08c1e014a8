import threading

import pytest

from bayespbrl.models.threads import VARIABLE, in_threads, most_threads


def test_results_come_in_the_order_of_the_parts(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    assert in_threads(lambda part: part**2, range(50)) == [part**2 for part in range(50)]
    assert in_threads(str, []) == []


def test_parts_run_side_by_side_where_there_is_more_than_one_core(monkeypatch):
    monkeypatch.setattr("bayespbrl.models.threads.most_threads", lambda: 2)
    meeting = threading.Barrier(2, timeout=20)  # each waits for the other
    assert sorted(in_threads(lambda _: meeting.wait(), range(2))) == [0, 1]


def test_an_error_of_one_part_is_raised(monkeypatch):
    monkeypatch.setattr("bayespbrl.models.threads.most_threads", lambda: 3)
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda part: 1 / part, [1, 0, 2])


def test_the_number_of_threads_follows_the_variable_of_linear_algebra(monkeypatch):
    monkeypatch.setenv(VARIABLE, "1")
    assert most_threads() == 1
    monkeypatch.delenv(VARIABLE)
    cores = most_threads()
    for text in ("0", "many", str(10 * cores)):  # none that means fewer
        monkeypatch.setenv(VARIABLE, text)
        assert most_threads() == cores
