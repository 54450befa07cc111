"""A file has the bytes of the calls in memory whatever the cloud and the memory: ties, equal points, scales, strays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import geokit as gk
from geokit.points.streamed import process_file
from tests.support.effort import of_all


@st.composite
def clouds(draw: st.DrawFn) -> np.ndarray:
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    count = draw(st.integers(1, 1500))
    kind = draw(st.sampled_from(["lattice", "random", "line", "clumps", "strays"]))
    if kind == "lattice":  # many neighbors at equal distances, many points in one place
        points = rng.integers(0, draw(st.integers(1, 12)), (count, 3)).astype(float)
    elif kind == "line":
        points = np.outer(rng.random(count), [1.0, 2.0, -3.0])
    elif kind == "clumps":
        points = rng.integers(0, 3, (count, 1)) * 100.0 + 1e-3 * rng.normal(size=(count, 3))
    else:
        points = rng.random((count, 3))
        if kind == "strays":
            points[:: max(1, count // 7)] *= 10.0 ** rng.integers(1, 6)
    return points * 10.0 ** draw(st.integers(-4, 4)) + draw(st.sampled_from([0.0, -7.5, 1e6]))


@pytest.mark.slow
@settings(max_examples=of_all(15, 30), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(points=clouds(), k=st.integers(3, 20), share=st.sampled_from([0.02, 0.1, 0.7]), least=st.sampled_from([60, 400]))
def test_bytes_are_those_of_the_calls_in_memory(
    points: np.ndarray, k: int, share: float, least: int, tmp_path: Path
) -> None:
    data = {"own": np.arange(len(points))}
    gk.points.save(tmp_path / "a.ply", points, data=data)
    given_points = gk.points.load(tmp_path / "a.ply").points
    extent = float((points.max(axis=0) - points.min(axis=0)).max()) or 1.0
    thin = gk.points.downsample(given_points, voxel_size=share * extent, device="cpu")
    planes = gk.points.normals(points, k=k, orientation="none", device="cpu")._asdict()
    expected = {
        "thin": (thin.points, {"own": data["own"][thin.indices]}, {"voxel_size": share * extent}),
        "planes": (points, {**data, **planes}, {"normals": {"k": k}}),
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(process_file, "AT_A_TIME", 100)
        patch.setattr(process_file, "BYTES_AT_A_TIME", (1 << 28) - least * 1000)
        for name, (kept, arrays, how) in expected.items():
            gk.points.save(tmp_path / f"{name}.ply", kept, data=arrays)
            gk.points.process_file(tmp_path / "a.ply", tmp_path / "b.ply", **how, memory_limit=1 << 28, device="cpu")
            assert (tmp_path / "b.ply").read_bytes() == (tmp_path / f"{name}.ply").read_bytes()
