"""PyVista reads and writes volumes through geokit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.plugins import pyvista_files

BALL = mesh_catalog.icosphere(2)


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the entry points register it with an installed package."""
    if not hasattr(pyvista, "register_reader") or not hasattr(pyvista, "register_writer"):
        pytest.skip("this PyVista takes no readers of others")
    pyvista.register_reader(".nvdb", pyvista_files.read, override=True)
    pyvista.register_writer(".nvdb", pyvista_files.write, override=True)


@pytest.mark.usefixtures("registered")
def test_smoke_is_an_image(tmp_path: Path) -> None:
    values = np.random.default_rng(1).random((4, 5, 6)).astype(np.float32) + 1.0
    gk.volume.save(tmp_path / "smoke.nvdb", gk.volume.from_dense(values, voxel_size=0.5, name="density"))
    image = pyvista.read(tmp_path / "smoke.nvdb")
    assert (image.dimensions, image.spacing) == ((4, 5, 6), (0.5, 0.5, 0.5))
    np.testing.assert_array_equal(image["density"], values.ravel(order="F"))


@pytest.mark.usefixtures("registered")
def test_a_level_set_is_a_surface_or_an_image(tmp_path: Path) -> None:
    path = tmp_path / "ball.nvdb"
    gk.volume.save(path, gk.volume.from_mesh(BALL, 0.1, device="cpu"))
    surface = pyvista.read(path)
    assert isinstance(surface, pyvista.PolyData)
    assert surface.is_manifold
    assert isinstance(pyvista_files.read(path, kind="image"), pyvista.ImageData)


@pytest.mark.usefixtures("registered")
def test_images_and_surfaces_are_written(tmp_path: Path) -> None:
    image = pyvista.ImageData(dimensions=(3, 3, 3), spacing=(2.0, 2.0, 2.0))
    image["heat"] = np.arange(27.0) + 1.0
    image.save(tmp_path / "a.nvdb")
    back = gk.volume.load(tmp_path / "a.nvdb")
    assert (back.info.name, back.info.voxel_size[0], back.info.active_voxel_count) == ("heat", 2.0, 27)
    pyvista_files.write(gk.mesh.to_pyvista(BALL), tmp_path / "b.nvdb", voxel_size=0.2)
    assert gk.volume.load(tmp_path / "b.nvdb").info.grid_class == "level set"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda path: pyvista_files.read(path, kind="cloud"), "kind: 'cloud' is not known"),
        (lambda path: pyvista_files.read(path, kind="image", most_bytes=100), "raise most_bytes, or read a part"),
        (lambda path: pyvista_files.write(pyvista.PolyData(np.eye(3)), path), "neither an image nor a surface"),
        (lambda path: pyvista_files.write(gk.mesh.to_pyvista(BALL), path, size=1), "options: .*size"),
        (lambda path: pyvista_files.write(gk.mesh.to_pyvista(BALL), path), "voxel_size: nothing given"),
    ],
)
def test_refusals(tmp_path: Path, call: Any, message: str) -> None:
    path = tmp_path / "ball.nvdb"
    gk.volume.save(path, gk.volume.from_mesh(BALL, 0.2, device="cpu"))
    with pytest.raises(gk.GeokitError, match=message):
        call(path)
