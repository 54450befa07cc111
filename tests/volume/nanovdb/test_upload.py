"""Threads that meet at a volume's first query: one copy on the device, which nobody frees."""

from __future__ import annotations

import gc
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import geokit as gk
from geokit.volume import SparseVolume
from geokit.volume.nanovdb import upload
from tests.support.devices import DEVICES
from tests.support.effort import of_all


@pytest.mark.parametrize("device", DEVICES)
def test_two_first_queries_have_the_same_copy(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    source = gk.volume.from_mesh(gk.mesh.torus(), voxel_size=0.2, device="cpu")
    volume = SparseVolume(source.nanovdb.copy(), source.info)
    # Both find no copy, and go on together.
    met = threading.Barrier(2)
    check = upload.check_volume

    def waiting(*given: object) -> None:
        met.wait(timeout=60.0)
        check(*given)

    monkeypatch.setattr(upload, "check_volume", waiting)
    with ThreadPoolExecutor(2) as pool:
        ids = [made.id for made in pool.map(lambda _: upload.upload(volume, device), range(2))]
    gc.collect()
    assert ids[0] == ids[1] == volume.on(device).id


@pytest.mark.slow
def test_first_queries_of_threads_are_those_of_one() -> None:
    rng = np.random.default_rng(11)
    points, directions = rng.uniform(-1.5, 1.5, (1000, 3)), rng.normal(size=(1000, 3))
    source = gk.volume.from_mesh(gk.mesh.torus(), voxel_size=0.05, device="cpu")
    expected = source.raycast(points, directions, device="cpu").t
    assert np.isfinite(expected).any()
    with ThreadPoolExecutor(3) as pool:
        for _ in range(of_all(60, 200)):
            volume = SparseVolume(source.nanovdb.copy(), source.info)
            asked = [slice(k, None, 3) for k in range(3)]
            found = pool.map(lambda rows, v=volume: v.raycast(points[rows], directions[rows], device="cpu").t, asked)
            for rows, t in zip(asked, found, strict=True):
                np.testing.assert_array_equal(t, expected[rows])
