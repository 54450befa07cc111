"""Cells made by the workers of an executor: the same bytes, and a named error for what goes wrong there."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit import DeviceMemoryError, InputError, WorkerError
from geokit.volume.streamed import cell_band, from_mesh_file
from tests.support.dask_cluster import cluster_client


def processes(count: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("fork"))


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    path = tmp_path / "scan.ply"
    gk.mesh.save(path, mesh_catalog.torus())
    return path


def banded(scan: Path, executor: Any = None, size: float = 0.011, **how: Any) -> bytes:
    out = scan.with_suffix(".nvdb")
    gk.volume.from_mesh_file(scan, out, size, device="cpu", executor=executor, **how)
    assert sorted(file.name for file in scan.parent.iterdir()) == [out.name, scan.name]
    return out.read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("pool", [processes, ThreadPoolExecutor])
def test_the_file_has_the_same_bytes(pool: Callable[[int], Executor], scan: Path) -> None:
    done: list[int] = []
    with pool(2) as executor:
        found = banded(scan, executor, progress=lambda at, of: done.append(at))
    assert found == banded(scan)
    assert done == sorted(done)
    assert done[-1] >= 99


@pytest.mark.slow
def test_so_it_has_if_cells_are_split_there(scan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = banded(scan, size=0.009)
    monkeypatch.setattr(from_mesh_file, "MOST_CELLS", 2)
    monkeypatch.setattr(cell_band, "LARGEST_SPAN", 128)
    tasks: list[int] = []
    made = cell_band.CellBands.make
    monkeypatch.setattr(
        cell_band.CellBands, "make", lambda self, cell, folder: tasks.append(cell.span) or made(self, cell, folder)
    )
    with ThreadPoolExecutor(2) as executor:
        assert banded(scan, executor, 0.009) == expected
    assert max(tasks) > 128
    assert tasks.count(128) > 4
    # So do parts of lower nodes, in the task of their node.
    monkeypatch.setattr(cell_band, "BYTES_PER_LEAF", 2_000_000)
    with processes(2) as pool:
        assert banded(scan, pool, 0.009) == expected


@pytest.mark.slow
def test_dask_s_client_is_one_and_a_worker_that_is_killed_costs_nothing(scan: Path) -> None:
    expected = banded(scan)
    with cluster_client() as client:
        assert banded(scan, client) == expected
        killed: list[int] = []

        def kill(at: int, _: int) -> None:
            if at > 0 and not killed:
                killed.append(next(iter(client.run(os.getpid).values())))
                os.kill(killed[0], 9)

        assert banded(scan, client, progress=kill) == expected
        assert killed


@pytest.mark.slow
def test_a_worker_that_dies_is_named_and_nothing_is_left(scan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cell_band.CellBands, "make", lambda *_: os._exit(3))
    with processes(2) as executor, pytest.raises(WorkerError, match="was not done"):
        banded(scan, executor)
    assert [file.name for file in scan.parent.iterdir()] == [scan.name]


@pytest.mark.slow
def test_what_a_cell_raises_is_raised_here(scan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cell_band, "BYTES_PER_TRIANGLE", 1 << 29)
    with processes(2) as executor, pytest.raises(DeviceMemoryError, match="triangles lie near the") as error:
        banded(scan, executor, memory_limit=1 << 28)
    assert error.value.need is not None
    assert error.value.need > 1 << 29
    assert [file.name for file in scan.parent.iterdir()] == [scan.name]


def test_what_still_runs_is_waited_for(scan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    running: list[str] = []

    def make(_: Any, cell: Any, folder: Path) -> None:
        running.append("begun")
        if len(running) == 1:
            raise MemoryError
        time.sleep(0.2)
        assert folder.exists()
        running.append("ended")

    monkeypatch.setattr(cell_band.CellBands, "make", make)
    with ThreadPoolExecutor(3) as executor, pytest.raises(WorkerError, match="MemoryError"):
        banded(scan, executor)
    assert running.count("begun") == running.count("ended") + 1
    assert [file.name for file in scan.parent.iterdir()] == [scan.name]


class Elsewhere(ThreadPoolExecutor):
    """Workers of a machine that does not have the folder."""

    def submit(self, function: Any, *given: Any) -> Future[Any]:  # type: ignore[override]
        saved, cell = given
        return super().submit(function, Path("/none") / saved.name, cell)


def test_a_folder_that_workers_do_not_see_and_what_is_no_executor(scan: Path) -> None:
    with Elsewhere(1) as executor, pytest.raises(WorkerError, match="in a folder that all workers share"):
        banded(scan, executor)
    with pytest.raises(InputError, match="executor: a str has no submit"):
        banded(scan, "tcp://here:1")
