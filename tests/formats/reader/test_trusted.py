"""Files that the caller trusts are read in this process, with the answers and errors of the separate one."""

from __future__ import annotations

import io
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.formats.reader import process as reader_process
from geokit.formats.table import FORMATS, extensions

MESH = mesh_catalog.l_profile()
PROCESSED = [kind for kind in extensions("mesh", "w") if FORMATS[kind].process]
CLOUD = np.random.default_rng(1).random((50, 3))


@pytest.fixture
def here(monkeypatch):
    """Without the separate process."""

    def refuse(*_):
        raise AssertionError("a process was asked")

    monkeypatch.setattr(reader_process, "read_mesh", refuse)
    monkeypatch.setattr(reader_process, "read_points", refuse)


@pytest.mark.slow
@pytest.mark.parametrize("kind", PROCESSED)
def test_meshes_are_the_same(tmp_path, kind):
    path = tmp_path / f"a{kind}"
    gk.mesh.save(path, MESH)
    theirs = gk.mesh.load(path)
    before = os.getcwd()
    ours = gk.mesh.load(path, trusted=True)
    assert os.getcwd() == before
    np.testing.assert_array_equal(ours.vertices, theirs.vertices)
    np.testing.assert_array_equal(ours.faces, theirs.faces)
    assert (ours.name, ours.parts) == (theirs.name, theirs.parts)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [".vtp", ".laz"])
def test_points_are_the_same(tmp_path, kind):
    path = tmp_path / f"a{kind}"
    gk.points.save(path, CLOUD)
    theirs, ours = gk.points.load(path), gk.points.load(path, trusted=True)
    np.testing.assert_array_equal(ours.points, theirs.points)
    assert set(ours.data) == set(theirs.data)


def test_no_process_is_started(tmp_path, here):
    gk.mesh.save(tmp_path / "a.vtp", MESH)
    assert gk.mesh.load(tmp_path / "a.vtp", trusted=True).face_count == MESH.face_count
    assert len(gk.points.load(tmp_path / "a.vtp", trusted=True)) == len(MESH.vertices)
    with pytest.raises(gk.InputError, match="trusted"):
        gk.mesh.load(tmp_path / "a.vtp", trusted="yes")
    with pytest.raises(gk.InputError, match="trusted"):
        gk.points.load(tmp_path / "a.vtp", trusted="yes")


@pytest.mark.slow
@pytest.mark.parametrize("kind", PROCESSED)
def test_damage_is_an_error_and_nothing_is_printed(tmp_path, here, kind, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with open(f"a{kind}", "wb") as file:
        file.write(b"this is not a mesh\n" * 20)
    with pytest.raises(gk.FileFormatError, match=f"^a{kind}: "):
        gk.mesh.load(f"a{kind}", trusted=True)
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
@pytest.mark.parametrize("kind", [".glb", ".vtu", ".msh", ".xdmf", ".usda"])
def test_threads(tmp_path, here, kind):
    sizes = range(1, 9)
    for size in sizes:
        gk.mesh.save(tmp_path / f"{size}{kind}", mesh_catalog.scaled(MESH, size))
        (tmp_path / f"bad{size}{kind}").write_bytes(b"nonsense")

    def load(size):
        with pytest.raises(gk.FileFormatError):
            gk.mesh.load(tmp_path / f"bad{size}{kind}", trusted=True)
        return gk.mesh.load(tmp_path / f"{size}{kind}", trusted=True).vertices

    with ThreadPoolExecutor(8) as threads:
        for size, found in zip(sizes, threads.map(load, sizes), strict=True):
            np.testing.assert_allclose(found, MESH.vertices * size, rtol=1e-6)


def test_plain_numbers_of_xdmf_are_relative_to_the_file(tmp_path, here, monkeypatch):
    item = '<DataItem DataType="{}" Dimensions="{} 3" Format="Binary" Precision="8">{}</DataItem>'
    (tmp_path / "sub").mkdir()
    MESH.vertices.tofile(tmp_path / "sub" / "points")
    MESH.faces.astype(np.int64).tofile(tmp_path / "sub" / "faces")
    text = io.StringIO()
    text.write('<Xdmf Version="3.0"><Domain><Grid Name="g"><Geometry GeometryType="XYZ">')
    text.write(item.format("Float", len(MESH.vertices), " points "))
    text.write('</Geometry><Topology TopologyType="Triangle">')
    text.write(item.format("Int", len(MESH.faces), str(tmp_path / "sub" / "faces")))
    text.write("</Topology></Grid></Domain></Xdmf>")
    (tmp_path / "sub" / "a.xdmf").write_text(text.getvalue())
    (tmp_path / "link.xdmf").symlink_to(tmp_path / "sub" / "a.xdmf")
    monkeypatch.chdir(tmp_path)
    for path in ("sub/a.xdmf", "link.xdmf"):
        np.testing.assert_array_equal(gk.mesh.load(path, trusted=True).vertices, MESH.vertices)
