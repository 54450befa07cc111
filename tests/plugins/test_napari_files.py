"""napari's manifest, and the layers that its readers make."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit._packages import DISTRIBUTION
from geokit.formats.table import SPARSE, extensions
from geokit.plugins import napari_files

MANIFEST = Path(napari_files.__file__).with_name("napari.yaml")
BALL = mesh_catalog.icosphere(2)
VALUES = np.random.default_rng(1).random((4, 5, 6)).astype(np.float32) + 1.0
TURNED = np.array([[0.0, -0.5, 0.0, 3.0], [0.5, 0.0, 0.0, 4.0], [0.0, 0.0, 0.7, 5.0], [0.0, 0.0, 0.0, 1.0]])


def test_the_manifest_lists_every_format() -> None:
    found = re.findall(r'"\*(\.\w+)"', MANIFEST.read_text(encoding="utf-8"))
    assert found == [*SPARSE, *extensions("mesh", "r")]


def test_readers_take_what_they_can_read() -> None:
    assert napari_files.volume_reader("a.vdb") is napari_files.read_volumes
    assert napari_files.volume_reader([Path("a.vdb"), Path("B.NVDB")]) is napari_files.read_volumes
    assert napari_files.mesh_reader("a.ply") is napari_files.read_meshes
    assert napari_files.volume_reader("a.ply") is napari_files.mesh_reader(["a.ply", "a.tif"]) is None


def outward(vertices: np.ndarray[Any, Any], faces: np.ndarray[Any, Any]) -> bool:
    return float(np.linalg.det(vertices[faces]).sum()) > 0.0


def test_level_sets_are_surfaces(tmp_path: Path) -> None:
    path = tmp_path / "ball.nvdb"
    moved = gk.mesh.TriangleMesh(BALL.vertices + np.array([5.0, 0.0, 0.0]), BALL.faces)
    gk.volume.save(path, gk.volume.from_mesh(moved, 0.2, device="cpu"))
    (((vertices, faces), arguments, kind),) = napari_files.read_volumes(path)
    assert (kind, arguments) == ("surface", {"name": "ball"})
    np.testing.assert_allclose(vertices.mean(axis=0), [0.0, 0.0, 5.0], atol=0.01)
    assert outward(vertices - [0.0, 0.0, 5.0], faces)


def test_smoke_is_images(tmp_path: Path) -> None:
    path = tmp_path / "smoke.nvdb"
    grids = [
        gk.volume.from_dense(VALUES, voxel_size=(0.5, 1.0, 2.0), origin=(1, 2, 3), name="density"),
        gk.volume.from_dense(VALUES, transform=TURNED, origin=(1, 2, 3), name="turned"),
        gk.volume.from_dense(np.stack([VALUES] * 3, axis=3) * [1, 2, 3], background=(0, 0, 0), name="wind"),
        gk.volume.from_dense(np.full((2, 3, 4, 4), 9, np.uint8), background=(0, 0, 0, 0), name="paint"),
    ]
    gk.volume.save(path, *grids)
    layers = {arguments["name"]: (data, arguments) for data, arguments, _ in napari_files.read_volumes([path])}
    assert list(layers) == ["density", "turned", "wind x", "wind y", "wind z", "paint"]
    data, arguments = layers["density"]
    np.testing.assert_array_equal(data, VALUES.transpose(2, 1, 0))
    np.testing.assert_array_equal(arguments["scale"], [2.0, 1.0, 0.5])
    np.testing.assert_array_equal(arguments["translate"], [6.0, 2.0, 0.5])
    place = layers["turned"][1]["affine"] @ [2, 1, 0, 1]  # z, y, x
    np.testing.assert_allclose(place[:3], (TURNED @ [0 + 1, 1 + 2, 2 + 3, 1])[2::-1])
    np.testing.assert_allclose(layers["wind z"][0], 3.0 * VALUES.transpose(2, 1, 0), rtol=1e-6)
    assert layers["paint"][1]["rgb"]
    assert layers["paint"][0].shape == (4, 3, 2, 4)


def test_meshes_are_surfaces(tmp_path: Path) -> None:
    gk.mesh.save(tmp_path / "ball.ply", BALL)
    (((vertices, faces), arguments, kind),) = napari_files.read_meshes(str(tmp_path / "ball.ply"))
    assert (kind, arguments) == ("surface", {"name": "ball"})
    np.testing.assert_allclose(vertices, BALL.vertices[:, ::-1])
    assert outward(vertices, faces)


def test_a_large_box_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(napari_files, "MOST_BYTES", 100)
    gk.volume.save(tmp_path / "a.nvdb", gk.volume.from_dense(VALUES))
    with pytest.raises(gk.DeviceMemoryError, match="raise most_bytes, or read a part"):
        napari_files.read_volumes(tmp_path / "a.nvdb")


def test_npe2_reads_through_the_manifest(tmp_path: Path) -> None:
    npe2 = pytest.importorskip("npe2")
    manifest = npe2.PluginManifest.from_distribution(DISTRIBUTION)  # refused under another name
    manifest.validate_imports()
    gk.mesh.save(tmp_path / "ball.ply", BALL)
    gk.volume.save(tmp_path / "smoke.nvdb", gk.volume.from_dense(VALUES, name="density"))
    plugins = npe2.PluginManager.instance()
    plugins.register(manifest)
    try:
        found = [npe2.read([str(tmp_path / name)], stack=False) for name in ("ball.ply", "smoke.nvdb")]
    finally:
        plugins.unregister(DISTRIBUTION)
    assert [(layers[0][1]["name"], layers[0][2]) for layers in found] == [("ball", "surface"), ("density", "image")]
