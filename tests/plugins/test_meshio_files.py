"""meshio reads and writes volumes through geokit: surfaces of level sets, hexahedra of other grids."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.plugins import meshio_files

BALL = mesh_catalog.icosphere(2)
# Sheared and mirrored: no image could hold it.
TRANSFORM = np.array([[0.5, 0.1, 0.0, 3.0], [0.0, 0.5, 0.0, 4.0], [0.0, 0.0, -0.5, 5.0], [0.0, 0.0, 0.0, 1.0]])


@pytest.fixture(autouse=True)
def _registered() -> Iterator[None]:
    gk.register("meshio")
    yield
    for name in ("vdb", "nvdb"):
        meshio.deregister_format(name)


def saved(path: Path, values: Any, **options: Any) -> Path:
    gk.volume.save(path, gk.volume.from_dense(values, **options))
    return path


def test_surfaces_are_written_and_read(tmp_path: Path) -> None:
    gk.mesh.to_meshio(BALL).write(tmp_path / "ball.nvdb", voxel_size=0.1)
    assert gk.volume.load(tmp_path / "ball.nvdb").info.grid_class == "level set"
    found = meshio.read(tmp_path / "ball.nvdb")
    assert [block.type for block in found.cells] == ["triangle"]
    assert gk.mesh.audit(found).watertight
    assert np.abs(np.linalg.norm(found.points, axis=1) - 1.0).max() < 0.05


def test_voxels_are_hexahedra(tmp_path: Path) -> None:
    values = np.zeros((4, 5, 6), np.float32)
    places = np.array([[0, 0, 0], [1, 0, 0], [3, 4, 5]])
    values[tuple(places.T)] = [2.0, 3.0, 4.0]
    found = meshio.read(saved(tmp_path / "a.nvdb", values, transform=TRANSFORM, origin=(7, 8, 9), name="heat"))
    (block,) = found.cells
    assert block.type == "hexahedron"
    np.testing.assert_array_equal(found.cell_data["heat"], [[2.0, 3.0, 4.0]])
    # The first two share a side.
    assert len(found.points) == 12 + 8
    corners = found.points[block.data]
    middles = (places + np.array([7, 8, 9])) @ TRANSFORM[:3, :3].T + TRANSFORM[:3, 3]
    np.testing.assert_allclose(corners.mean(axis=1), middles)
    edges = corners[:, [1, 3, 4]] - corners[:, [0]]
    np.testing.assert_allclose(edges, np.broadcast_to(TRANSFORM[:3, :3].T, (3, 3, 3)), atol=1e-12)


def test_hexahedra_are_those_of_vtk(tmp_path: Path) -> None:
    import pyvista

    path = saved(tmp_path / "a.nvdb", np.ones((3, 4, 5), np.float32), voxel_size=0.5)
    meshio.read(path).write(tmp_path / "a.vtu")
    assert pyvista.read(tmp_path / "a.vtu").volume == pytest.approx(60 * 0.5**3)


def test_other_types(tmp_path: Path) -> None:
    mask = meshio.read(saved(tmp_path / "a.nvdb", np.ones((2, 2, 2), bool), background=False))
    assert (mask.cell_data["value"][0].dtype, mask.cell_data["value"][0].sum()) == (np.uint8, 8)
    wind = np.zeros((2, 2, 2, 3))
    wind[0, 0, 0, 2] = 5.0
    found = meshio.read(saved(tmp_path / "b.nvdb", wind, background=(0, 0, 0), name="wind"))
    np.testing.assert_array_equal(found.cell_data["wind"], [[[0.0, 0.0, 5.0]]])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda path: meshio_files.read(path, kind="cloud"), "kind: 'cloud' is not known"),
        (lambda path: meshio_files.read(path, most_bytes=100), "60 voxels, 0 MiB; raise most_bytes, or read a part"),
        (lambda path: meshio_files.read(path, most_bytes=300), "hexahedra of 60 voxels need 0 MiB; raise most_bytes"),
        (lambda path: meshio.read(path).write(path, voxel_size=0.1), "holds hexahedron and no polygons"),
        (lambda path: gk.mesh.to_meshio(BALL).write(path), "voxel_size: nothing given"),
    ],
)
def test_refusals(tmp_path: Path, call: Any, message: str) -> None:
    with pytest.raises(gk.GeokitError, match=message):
        call(saved(tmp_path / "a.nvdb", np.ones((3, 4, 5), np.float32)))
