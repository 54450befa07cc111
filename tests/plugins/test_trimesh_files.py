"""trimesh reads volumes through geokit: as meshes and as voxels."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.exchange.load import mesh_loaders, voxel_loaders

import geokit as gk
from benchmarks.catalog import mesh_catalog

BALL = mesh_catalog.icosphere(3)
VALUES = np.random.default_rng(1).random((4, 5, 6)).astype(np.float32) + 1.0
TURNED = np.array([[0.0, -0.5, 0.0, 3.0], [0.5, 0.0, 0.0, 4.0], [0.0, 0.0, 0.5, 5.0], [0.0, 0.0, 0.0, 1.0]])


@pytest.fixture(autouse=True)
def _registered() -> Iterator[None]:
    gk.register("trimesh")
    yield
    for table in (mesh_loaders, voxel_loaders):
        for kind in ("vdb", "nvdb", "vdb_voxels", "nvdb_voxels"):
            table.pop(kind, None)


@pytest.fixture
def ball(tmp_path: Path) -> Path:
    gk.volume.save(tmp_path / "ball.nvdb", gk.volume.from_mesh(BALL, 0.1, device="cpu", name="ball"))
    return tmp_path / "ball.nvdb"


@pytest.fixture
def smoke(tmp_path: Path) -> Path:
    density = gk.volume.from_dense(VALUES, transform=TURNED, origin=(7, 8, 9), name="density", grid_class="fog volume")
    wind = gk.volume.from_dense(np.ones((2, 2, 2, 3)), background=(0, 0, 0), name="wind")
    gk.volume.save(tmp_path / "smoke.nvdb", density, wind)
    return tmp_path / "smoke.nvdb"


def test_a_level_set_is_a_mesh(ball: Path) -> None:
    mesh = trimesh.load_mesh(ball)
    assert mesh.is_watertight
    assert mesh.metadata["name"] == "ball"
    assert mesh.volume == pytest.approx(4 / 3 * np.pi, rel=0.02)
    # Of bytes, as trimesh reads archives, and with an option.
    smaller = trimesh.load_mesh(io.BytesIO(ball.read_bytes()), file_type="nvdb", isovalue=-0.1)
    assert np.linalg.norm(smaller.vertices, axis=1).max() < 0.92


def test_a_level_set_is_voxels(ball: Path) -> None:
    (voxels,) = trimesh.load(ball, file_type="nvdb_voxels").geometry.values()
    assert np.linalg.norm(voxels.points, axis=1).max() <= 1.0 + 1e-12
    assert voxels.volume == pytest.approx(4 / 3 * np.pi, rel=0.02)


def test_smoke_is_voxels_above_a_value(smoke: Path) -> None:
    scene = trimesh.load(smoke, file_type="nvdb_voxels", isovalue=1.5)
    (voxels,) = scene.geometry.values()
    places = np.argwhere(VALUES > 1.5) + np.array([7, 8, 9])
    np.testing.assert_allclose(voxels.points, places @ TURNED[:3, :3].T + TURNED[:3, 3])
    np.testing.assert_array_equal(voxels.filled_count, len(places))


def test_smoke_is_a_mesh_at_a_value(smoke: Path) -> None:
    with pytest.raises(gk.InputError, match=r"'density' is no level set; give isovalue=, or .*file_type='nvdb_voxels'"):
        trimesh.load_mesh(smoke)
    assert trimesh.load_mesh(smoke, isovalue=0.5, grid="density").volume > 0.5**3 * VALUES.size


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"grid": "heat"}, "no grid named 'heat'"),
        ({"grid": "wind"}, "'wind' holds vectors, which fill nothing"),
        ({"grid": "density", "most_bytes": 100}, "120 voxels, 0 MiB; raise most_bytes, or read a part"),
        ({"isovalue": "a"}, "isovalue: 'a'"),
    ],
)
def test_refusals(smoke: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(gk.GeokitError, match=message):
        trimesh.load(smoke, file_type="nvdb_voxels", **options)


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.nvdb").write_bytes(b"no grid")
    with pytest.raises(gk.FileFormatError, match=r"a\.nvdb"):
        trimesh.load_mesh(tmp_path / "a.nvdb")
