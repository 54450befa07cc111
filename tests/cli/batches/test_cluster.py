"""``geokit batch`` on a Dask cluster: workers that are killed, differ, or are not there."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from geokit.cli import main
from tests.support.dask_cluster import cluster_client

pytest.importorskip("distributed")
pytestmark = [pytest.mark.process, pytest.mark.filterwarnings("default")]


def _batch(client: Any, recipe: Path, sources: list[Path], out: Path, *more: str) -> int:
    address = client if isinstance(client, str) else client.scheduler.address
    return main(["batch", str(recipe), *map(str, sources), "--out", str(out), "--scheduler", address, *more])


def test_no_file_is_lost_with_its_worker_and_none_is_done_twice(corners, recipe, tmp_path, records_in) -> None:
    sources, out = corners(80), tmp_path / "out"
    with cluster_client(3) as client:
        killed: list[int] = []
        ended = threading.Event()

        def kill() -> None:
            while not ended.wait(0.05) and len(killed) < 4:
                lines = (out / "manifest.jsonl").read_bytes().count(b"\n") if (out / "manifest.jsonl").is_file() else 0
                if lines > 3 + 8 * len(killed):
                    with contextlib.suppress(OSError):
                        pid = next(iter(client.run(os.getpid, on_error="ignore").values()), None)
                        if pid not in (None, *killed):
                            os.kill(pid, signal.SIGKILL)
                            killed.append(pid)

        killer = threading.Thread(target=kill)
        killer.start()
        try:
            assert _batch(client, recipe, sources, out) == 0
        finally:
            ended.set()
            killer.join()
        assert killed
    records = records_in(out / "manifest.jsonl")
    assert {record["input"] for record in records} == set(map(str, sources))
    assert {record["status"] for record in records} == {"done"}
    assert all(record["worker"].startswith("tcp://") for record in records)
    assert len(list(out.glob("*.off"))) == len(sources)


def test_workers_that_differ_are_named(corners, recipe, tmp_path, capfd) -> None:
    out = tmp_path / "out"
    with cluster_client(2) as client:
        odd = sorted(client.nthreads())[0]
        pretend = "import geokit.cli._batches.worker as w; w.versions = lambda: {'geokit': '0.0.1', 'warp': '1.0'}"
        client.run(exec, pretend, {}, workers=[odd])
        assert _batch(client, recipe, corners(3), out) == 1
        told = capfd.readouterr().err
        assert f"geokit: {odd} (" in told
        assert "geokit 0.0.1" in told
        assert "install the same there" in told
        assert not list(out.glob("*.off"))
        # The cluster has lost the odd one: the same command goes on.
        client.retire_workers([odd])
        assert _batch(client, recipe, corners(3), out) == 0


def test_no_scheduler_and_no_workers(corners, recipe, tmp_path, capfd, monkeypatch) -> None:
    monkeypatch.setattr("geokit.distributed._cluster.PATIENCE", 0.2)
    for address in ("tcp://127.0.0.1:9", "nonsense://a:b"):
        assert _batch(address, recipe, corners(1), tmp_path / "out") == 1
        assert f"{address}: no Dask scheduler answers there" in capfd.readouterr().err
    monkeypatch.undo()
    monkeypatch.setattr("geokit.distributed._cluster.WORKER_PATIENCE", 0.5)
    with cluster_client(0) as client:
        assert _batch(client, recipe, corners(1), tmp_path / "out") == 1
        assert "has no workers; start some with: dask worker tcp://" in capfd.readouterr().err


def test_a_scheduler_that_goes_away(corners, recipe, tmp_path, capfd, records_in) -> None:
    sources, out, facts = corners(150), tmp_path / "out", tmp_path / "scheduler.json"
    start = [sys.executable, "-m"]
    known = ["--scheduler-file", str(facts), "--no-dashboard"]
    with (
        subprocess.Popen([*start, "distributed.cli.dask_scheduler", "--port", "0", *known]) as scheduler,
        subprocess.Popen([*start, "distributed.cli.dask_worker", "--nthreads", "1", *known]) as worker,
    ):

        def kill() -> None:
            while not (out / "manifest.jsonl").is_file() or (out / "manifest.jsonl").read_bytes().count(b"\n") < 5:
                time.sleep(0.01)
            scheduler.kill()

        killer = threading.Thread(target=kill, daemon=True)
        try:
            while not facts.is_file():
                assert scheduler.poll() is None
                time.sleep(0.05)
            killer.start()
            assert _batch(json.loads(facts.read_text())["address"], recipe, sources, out) == 1
        finally:
            worker.kill()
            scheduler.kill()
    assert "goes on from here" in capfd.readouterr().err
    assert main(["batch", str(recipe), *map(str, sources), "--out", str(out), "--jobs", "1"]) == 0
    assert {record["input"] for record in records_in(out / "manifest.jsonl")} == set(map(str, sources))
