"""``geokit doctor --latency``."""

from __future__ import annotations

import pytest

from geokit.cli import _latency


@pytest.mark.slow
def test_every_query_of_the_table_is_answered(tmp_path):
    made = [f"{name} = {text}" for name, text in _latency.INPUTS.items()]
    script = "\n".join([_latency._START, _latency._PREPARE, *made, *_latency.QUERIES.values()])
    _latency._run(script, "cpu", tmp_path, {})


@pytest.mark.slow
def test_a_row_tells_the_first_call_from_the_second(monkeypatch):
    monkeypatch.setenv("GEOKIT_KERNELS", "")
    monkeypatch.setattr(_latency, "_PREPARE", "")
    call = "NeighborGrid.count"
    monkeypatch.setattr(_latency, "QUERIES", {call: _latency.QUERIES[call], "mesh.audit": "gk.mesh.audit(mesh)"})
    said: list[str] = []
    rows = _latency.measure_latency("cpu", said.append)
    assert [tuple(row) for row in rows] == [_latency.COLUMNS] * 2
    counted, audited = (list(row.values()) for row in rows)
    assert counted[0] == call
    assert counted[4] >= 3
    assert audited[4] == 0
    assert len(said) == 2
