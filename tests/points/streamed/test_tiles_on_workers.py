"""Tiles answered by the workers of an executor: the same bytes, and a named error for what goes wrong there."""

from __future__ import annotations

import itertools
import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import geokit as gk
from geokit import InputError, WorkerError
from geokit.points.streamed import process_file
from tests.support.dask_cluster import cluster_client
from tests.support.effort import of_all


def processes(count: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("fork"))


@pytest.fixture
def scan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cloud of some twenty tiles."""
    monkeypatch.setattr(process_file, "OWN_SHARE", 1e-3)
    rng = np.random.default_rng(3)
    path = tmp_path / "scan.ply"
    gk.points.save(path, rng.random((9000, 3)), data={"intensity": rng.random(9000).astype(np.float32)})
    return path


def processed(scan: Path, executor: Any = None, **how: Any) -> bytes:
    out = scan.with_name("out.ply")
    how = {"normals": {"k": 9}, "density": {"radius": 0.07}, "memory_limit": 1 << 28, **how}
    gk.points.process_file(scan, out, executor=executor, device="cpu", **how)
    assert sorted(file.name for file in scan.parent.iterdir()) == [out.name, scan.name]
    return out.read_bytes()


THINNED: dict[str, Any] = {"voxel_size": 0.06, "normals": {"radius": 0.2}}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pool", "how"),
    of_all(
        [(processes, THINNED), (ThreadPoolExecutor, {})],
        list(itertools.product([processes, ThreadPoolExecutor], [{}, THINNED])),
    ),
)
def test_the_file_has_the_same_bytes(
    pool: Callable[[int], Executor], how: dict[str, Any], scan: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[int] = []
    tiles: list[int] = []
    make = process_file.TileAnswers.make
    monkeypatch.setattr(
        process_file.TileAnswers, "make", lambda self, at, where: tiles.append(at) or make(self, at, where)
    )
    with pool(2) as executor:
        found = processed(scan, executor, progress=lambda at, of: done.append(at), **how)
    assert found == processed(scan, **how)
    assert done == sorted(done)
    assert done[-1] >= 99
    assert len(set(tiles)) > 8


@pytest.mark.slow
def test_dask_s_client_is_one(scan: Path) -> None:
    with cluster_client() as client:
        assert processed(scan, client) == processed(scan)


@pytest.mark.slow
def test_a_worker_that_dies_is_named_and_nothing_is_left(scan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process_file.TileAnswers, "make", lambda *_: os._exit(3))
    with processes(2) as executor, pytest.raises(WorkerError, match="was not done"):
        processed(scan, executor)
    assert [file.name for file in scan.parent.iterdir()] == [scan.name]


def test_what_is_no_executor(scan: Path) -> None:
    with pytest.raises(InputError, match="executor: a int has no submit"):
        processed(scan, 4)
