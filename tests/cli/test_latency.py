"""``geokit doctor --latency``."""

from __future__ import annotations

import pytest

from geokit.cli import _latency
from tests.support.scripts import run_script


@pytest.mark.slow
def test_every_query_of_the_table_is_answered(tmp_path):
    made = [f"{name} = {text}" for name, text in _latency.INPUTS.items()]
    script = "\n".join([_latency._START, _latency._PREPARE, *made, *_latency.QUERIES.values()])
    (tmp_path / "script.py").write_text(script)
    run_script(tmp_path / "script.py", "cpu", tmp_path, folder=tmp_path)


@pytest.mark.slow
def test_a_row_tells_the_first_call_from_the_second(monkeypatch):
    monkeypatch.setenv("GEOKIT_KERNELS", "")
    monkeypatch.setattr(_latency, "_PREPARE", "")
    # Of one small kernel, since it is compiled.
    call = "mesh.sample_surface, Poisson disk"
    monkeypatch.setattr(_latency, "QUERIES", {call: _latency.QUERIES[call], "mesh.audit": "gk.mesh.audit(mesh)"})
    said: list[str] = []
    rows = _latency.measure_latency("cpu", said.append)
    assert [tuple(row) for row in rows] == [_latency.COLUMNS] * 2
    counted, audited = (list(row.values()) for row in rows)
    assert counted[0] == call
    assert counted[4] >= 1
    assert audited[4] == 0
    assert len(said) == 2
