"""Whatever metadata a .vdb file can hold, an .nvdb file holds too, value by value and type by type."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.catalog.sphere_volumes import sphere
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.file import read
from geokit.volume.nanovdb.header import info_of
from geokit.volume.nanovdb.write import write
from tests.support.effort import of_all

pytestmark = pytest.mark.slow

SETTINGS = settings(
    max_examples=of_all(30, 60), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
FLOATS = st.floats(allow_nan=False)
SINGLES = st.floats(width=32, allow_nan=False).map(np.float32)
VALUES = st.one_of(
    st.text(max_size=30),
    st.booleans(),
    st.integers(-(2**63), 2**63 - 1),
    FLOATS,
    SINGLES,
    st.integers(-(2**31), 2**31 - 1).map(np.int32),
    st.binary(max_size=30),
    st.tuples(FLOATS, FLOATS, FLOATS),
    st.tuples(SINGLES, SINGLES),
    st.tuples(*[st.integers(-(2**31), 2**31 - 1)] * 4),
)
SPHERES = [sphere(2.0, name=name) for name in "abc"]


@SETTINGS
@given(st.lists(st.dictionaries(st.text(max_size=20), VALUES, max_size=6), min_size=1, max_size=3), st.data())
def test_round_trip(tmp_path, tables, data):
    volumes = [SparseVolume(s.nanovdb, info_of(s.nanovdb, t)) for s, t in zip(SPHERES, tables, strict=False)]
    path = tmp_path / "x.nvdb"
    write(path, volumes, codec=data.draw(st.sampled_from(["none", "zip", "blosc"])))
    for grid, table, original in zip(read(path), tables, SPHERES, strict=False):
        assert grid.metadata == table
        assert list(grid.metadata) == list(table)
        assert [type(v) for v in grid.metadata.values()] == [type(v) for v in table.values()]
        assert [repr(v) for v in grid.metadata.values()] == [repr(v) for v in table.values()]
        assert np.array_equal(grid.buffer[736:], original.nanovdb[736:])
