"""Writers on failing disks: a named error, the old file kept, nothing left behind, and the process lives on."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import warnings

import pytest

from geokit import FileFormatError, mesh, points
from geokit.formats.table import FORMATS
from tests.support.all_writers import OLD, holds, place, writers
from tests.support.effort import of_all, spread
from tests.support.forked import ForkServer

TRIANGLE = mesh.TriangleMesh([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [[0, 1, 2]])


# Of what writers import, the slowest. Nothing has written before a fork.
IMPORTS = (
    "import numpy, scipy.spatial, warp, pyvista, matplotlib.figure, meshio, trimesh, zarr, nibabel\n"
    "import geokit, tests.support.all_writers"
)


@pytest.fixture(scope="module")
def server():
    with ForkServer(IMPORTS) as server:
        yield server


def _lines(server, folder, *how):
    done = server.run("import runpy; runpy.run_module('tests.support.all_writers', run_name='__main__')", folder, *how)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stderr == ""  # libraries do not print either
    return [json.loads(line) for line in done.stdout.splitlines()]


def _failed(folder, line):
    # The voxels of an .mhd are a file of their own.
    names = line["name"], line["name"].replace(".mhd", ".raw")
    return line["outcome"].startswith(tuple(f"FileAccessError: {folder / name}: writing failed (" for name in names))


@pytest.mark.slow
def test_past_a_limit_on_file_sizes(server, tmp_path):
    lines = _lines(server, tmp_path, "limits")
    assert len(lines) == of_all(3, 6) * len(writers())
    for line in lines:
        assert _failed(tmp_path, line), line
        assert line["kept"], line
        assert line["left"] == [], line


@pytest.mark.slow
def test_in_a_folder_that_vanished(server, tmp_path):
    lines = _lines(server, tmp_path / "gone", "vanished")
    assert len(lines) == len(writers())
    for line in lines:
        assert line["outcome"].startswith(f"FileAccessError: {tmp_path / 'gone' / line['name']}: the folder"), line


@pytest.fixture
def disk(tmp_path):
    """A file system of 64 KiB, and a function that makes it read-only."""
    folder = tmp_path / "disk"
    folder.mkdir()
    made = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", folder], capture_output=True, text=True)
    if made.returncode:
        pytest.skip(f"a file system cannot be mounted here: {made.stderr.strip()}")
    yield folder, lambda: subprocess.run(["mount", "-o", "remount,ro", folder], check=True)
    subprocess.run(["umount", folder], check=True)


@pytest.mark.slow
def test_on_a_full_disk_and_on_a_read_only_one(server, disk):
    folder, make_read_only = disk
    for name in writers():
        place(folder / name, b"")
    # Files of no length take no room: the two largest formats keep an old file.
    for name in ("mesh.vtp", "volume_none.nvdb"):
        place(folder / name, OLD)
    for line in _lines(server, folder, "plain"):
        # What writes more than its result asks for room first.
        refused = line["name"].startswith("processed") and line["outcome"].endswith("use another disk")
        assert refused or _failed(folder, line), line
        assert line["left"] == [], line
    make_read_only()
    for line in _lines(server, folder, "plain"):
        assert line["outcome"].startswith(f"FileAccessError: {folder / line['name']}: cannot write there (Read-o"), line
    for name in writers():
        assert holds(folder / name, OLD if name in ("mesh.vtp", "volume_none.nvdb") else b"")


@pytest.mark.slow
def test_killed_writers_leave_a_whole_file_and_the_next_save_removes_their_rest(server, tmp_path):
    few = ["mesh.vtp", "volume_zip.zarr"]
    names = of_all(few, [*few, "mesh.usdc", "volume_zip.vdb", "volume_zip.nvdb"])
    lines = _lines(server, tmp_path, "killed", *names)
    assert [line["name"] for line in lines] == [name for name in names for _ in spread(range(6), 3)]
    for line in lines:
        assert line == {"name": line["name"], "ended": -signal.SIGKILL, "kept": True, "left": [line["name"]]}


@pytest.mark.parametrize("kind", [kind for kind, row in FORMATS.items() if "w" in row.mesh])
def test_meshes_under_names_in_no_encoding(tmp_path, kind):
    folder = tmp_path / "caf\udce9"
    folder.mkdir()
    target = os.fsencode(folder / f"mod\udce8le{kind}")
    mesh.save(target, TRIANGLE)
    if FORMATS[kind].module == "usd":
        with pytest.raises(FileFormatError, match="UTF-8"):
            mesh.load(target)
    else:
        assert len(mesh.load(target).faces) == 1


@pytest.mark.parametrize("kind", [kind for kind, row in FORMATS.items() if "w" in row.mesh])
def test_meshes_that_have_their_names_from_such_files(tmp_path, kind):
    image = mesh.Texture("a.png", b"\x89PNG")
    named = mesh.TriangleMesh(
        TRIANGLE.vertices,
        TRIANGLE.faces,
        name="mod\udce8le",
        face_data={"material": [0]},
        materials=[mesh.Material("m", None, image)],
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # some hold no materials
        mesh.save(os.fsencode(tmp_path / f"mod\udce8le{kind}"), named)
        mesh.save(tmp_path / f"a{kind}", named)
    mesh.save(tmp_path / f"b{kind}", mesh.TriangleMesh(named.vertices, named.faces, name=named.name))
    assert len(mesh.load(tmp_path / f"b{kind}").faces) == 1
    again = mesh.load(tmp_path / f"a{kind}")
    assert len(again.faces) == 1
    if FORMATS[kind].materials:
        assert again.materials[0].texture.data == image.data


@pytest.mark.parametrize("kind", [kind for kind, row in FORMATS.items() if "w" in row.points])
def test_points_under_names_in_no_encoding(tmp_path, kind):
    target = os.fsencode(tmp_path / f"mod\udce8le{kind}")
    points.save(target, TRIANGLE.vertices)
    assert len(points.load(target)) == 3
