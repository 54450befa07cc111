"""What other libraries find of geokit: by entry points, and on request."""

from __future__ import annotations

import importlib
import importlib.util
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import geokit as gk

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]
ENTRY_POINTS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]


def test_there_is_an_entry_point_for_each_library() -> None:
    assert {group: sorted(names) for group, names in ENTRY_POINTS.items()} == {
        "pyvista.readers": [".nvdb", ".vdb"],
        "pyvista.writers": [".nvdb", ".vdb"],
        "pyvista.accessors": ["geokit"],
        "xarray.backends": ["geokit"],
        "napari.manifest": ["geokit"],
    }


@pytest.mark.parametrize("group", ENTRY_POINTS)
def test_entry_points_lead_somewhere(group: str) -> None:
    for target in ENTRY_POINTS[group].values():
        module, _, name = target.partition(":")
        if group == "xarray.backends":
            pytest.importorskip("xarray")
        found = importlib.import_module(module)
        if group == "napari.manifest":
            assert Path(found.__path__[0], name).is_file()
        elif name:
            assert callable(getattr(found, name))


@pytest.fixture
def clean() -> Iterator[None]:
    """trimesh and meshio without geokit, before and after."""
    import meshio
    from trimesh.exchange.load import mesh_loaders, voxel_loaders

    def remove() -> None:
        for kind in ("vdb", "nvdb"):
            mesh_loaders.pop(kind, None)
            voxel_loaders.pop(f"{kind}_voxels", None)
            meshio.deregister_format(kind)

    remove()
    yield
    remove()


@pytest.mark.usefixtures("clean")
def test_it_names_what_it_registered_and_twice_is_once() -> None:
    import meshio

    expected = {
        "trimesh": ("vdb", "nvdb", "vdb_voxels", "nvdb_voxels"),
        "meshio": (".vdb", ".nvdb"),
        "pyvista": ("PolyData.geokit", "ImageData.geokit"),
    }
    assert gk.register() == expected
    assert gk.register() == expected
    assert meshio.extension_to_filetypes[".vdb"] == ["vdb"]
    assert gk.register("meshio") == {"meshio": (".vdb", ".nvdb")}


@pytest.mark.usefixtures("clean")
def test_what_others_registered_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    import meshio
    from trimesh.exchange.load import mesh_loaders

    monkeypatch.setitem(mesh_loaders, "vdb", print)
    monkeypatch.setitem(meshio.extension_to_filetypes, ".nvdb", ["other"])
    assert gk.register("trimesh", "meshio") == {"trimesh": ("nvdb", "vdb_voxels", "nvdb_voxels"), "meshio": (".vdb",)}
    assert mesh_loaders["vdb"] is print


@pytest.mark.usefixtures("clean")
def test_libraries_that_are_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "meshio", None)
    assert set(gk.register()) == {"trimesh", "pyvista"}
    with pytest.raises(gk.MissingDependencyError, match="register needs the package meshio; install it with"):
        gk.register("meshio")
    with pytest.raises(gk.InputError, match="libraries: 'numpy' is not known; use one of 'trimesh', 'meshio'"):
        gk.register("numpy")


@pytest.mark.slow
def test_importing_geokit_changes_nothing_in_other_libraries() -> None:
    code = """
import geokit as gk, meshio, pyvista
from trimesh.exchange.load import mesh_loaders, voxel_loaders
gk.mesh.Surface, gk.volume.load, gk.register
assert not {"vdb", "nvdb", "vdb_voxels", "nvdb_voxels"} & {*mesh_loaders, *voxel_loaders}
assert not {".vdb", ".nvdb"} & set(meshio.extension_to_filetypes)
assert "geokit" not in vars(pyvista.PolyData) and "geokit" not in vars(pyvista.ImageData)
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
