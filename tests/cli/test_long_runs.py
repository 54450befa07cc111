"""Many files through one ``geokit convert``: its memory, open files and what is left."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.effort import of_all
from tests.support.limits.long_runs import convert_many

# Growth after the first tenth of the files [bytes].
MOST_GROWTH = 50 << 20


@pytest.mark.slow
@pytest.mark.parametrize("jobs", of_all([3], [1, 3]))
def test_many_files_leave_nothing(tmp_path: Path, jobs: int) -> None:
    found = convert_many(150, tmp_path, jobs=jobs)
    assert found["exit"] == 1  # one file is damaged
    assert found["made"] == 149
    assert found["most_bytes"] - found["warm_bytes"] < MOST_GROWTH
    assert found["open_files"][1] <= found["open_files"][0] + 8 * jobs
    assert found["left_processes"] == []
    assert found["left_files"] == []
