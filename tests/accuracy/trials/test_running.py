"""Lines of progress: nothing for short runs, then the parts that are done and the time for the others."""

from __future__ import annotations

import time

import pytest

from geokit.accuracy.trials.running import PATIENCE, time_left


@pytest.mark.parametrize(("passed", "done"), [(PATIENCE / 2, 3), (10.0, 0)])
def test_nothing_is_said_at_the_start(passed, done):
    assert time_left(time.perf_counter() - passed, done, 5, "charts") == ""


def test_the_others_take_as_long():
    assert time_left(time.perf_counter() - 10.0, 2, 8, "charts") == " [2 of 8 charts, about 30 s left]"
