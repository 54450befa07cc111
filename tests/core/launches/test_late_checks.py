"""Checks that wait for a GPU are made at the end of a call that gathers them, and elsewhere at once."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from geokit.core.launches.late_checks import AtEnd, later

CPU: Any = SimpleNamespace(is_cpu=True)
GPU: Any = SimpleNamespace(is_cpu=False)


def test_at_once_outside_and_on_a_cpu():
    made: list[str] = []
    later(lambda: made.append("outside"), GPU)
    assert made == ["outside"]
    with AtEnd():
        later(lambda: made.append("on a CPU"), CPU)
        assert made[1:] == ["on a CPU"]


def test_in_order_at_the_end():
    made: list[int] = []
    with AtEnd():
        later(lambda: made.append(1), GPU)
        with AtEnd():
            later(lambda: made.append(2), GPU)
            assert made == []
        later(lambda: made.append(3), GPU)
        assert made == [2]
    assert made == [2, 1, 3]
    later(lambda: made.append(4), GPU)
    assert made[3:] == [4]


def test_none_after_an_error():
    made: list[int] = []

    def query() -> None:
        with AtEnd():
            later(lambda: made.append(1), GPU)
            raise KeyError

    with pytest.raises(KeyError):
        query()
    later(lambda: made.append(2), GPU)
    assert made == [2]


def test_an_error_of_a_check_reaches_the_caller():
    def check() -> None:
        raise ValueError("row 3")

    with pytest.raises(ValueError, match="row 3"), AtEnd():
        later(check, GPU)
