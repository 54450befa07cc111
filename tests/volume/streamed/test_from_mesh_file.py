"""A band from file to file has the bytes of the band in memory, whole or in cells; what cannot be read is named."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit import DeviceMemoryError, FileAccessError, FileFormatError, InputError
from geokit.mesh import TriangleMesh
from geokit.volume.streamed import cell_band
from tests.support.effort import of_all, spread

CPU = {"device": "cpu"}
# Along no face of a mesh of the catalog, so that no voxel lies on the surface and every sign is certain.
ASIDE = [0.0123, 0.0371, 0.0219]


@pytest.fixture
def in_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leaves that seem to need so much memory that the cells of a lower node are split too."""
    monkeypatch.setattr(cell_band, "BYTES_PER_LEAF", 2_000_000)


def saved(mesh: TriangleMesh, path: Path, aside: bool = True) -> Path:
    gk.mesh.save(path, TriangleMesh(mesh.vertices + (ASIDE if aside else 0.0), mesh.faces))
    return path


def both(path: Path, size: float, **how: object) -> tuple[gk.volume.SparseVolume, gk.volume.SparseVolume]:
    """The band from file to file, and that in memory."""
    out = path.with_suffix(".nvdb")
    info = gk.volume.from_mesh_file(path, out, size, **how, **CPU)
    found, expected = gk.volume.load(out), gk.volume.from_mesh(gk.mesh.load(path), size, interior="keep", **how, **CPU)
    assert info.byte_count == len(found.nanovdb)
    assert info.active_voxel_count == expected.info.active_voxel_count
    assert sorted(file.name for file in path.parent.iterdir()) == sorted([path.name, out.name])
    return found, expected


def same_grid(found: gk.volume.SparseVolume, expected: gk.volume.SparseVolume) -> None:
    # The checksum covers all nodes in the file, and headers alone in memory.
    np.testing.assert_array_equal(found.nanovdb[16:], expected.nanovdb[16:])


def sized(mesh: TriangleMesh, voxels: float) -> float:
    return float((mesh.bounds[1] - mesh.bounds[0]).max()) / voxels


@pytest.mark.slow
@pytest.mark.parametrize("mesh", [make() for make in mesh_catalog.CLOSED], ids=lambda mesh: mesh.name)
def test_the_grid_is_that_in_memory(mesh: TriangleMesh, tmp_path: Path) -> None:
    same_grid(*both(saved(mesh, tmp_path / "a.stl"), sized(mesh, 37.3)))


@pytest.mark.slow
@pytest.mark.usefixtures("in_cells")
@pytest.mark.parametrize("mesh", [make() for make in spread(mesh_catalog.CLOSED, 4)], ids=lambda mesh: mesh.name)
def test_so_it_is_in_cells(mesh: TriangleMesh, tmp_path: Path) -> None:
    """Also inside a large solid, in tiles of 8^3, 128^3 and 4096^3 voxels far from all triangles."""
    same_grid(*both(saved(mesh, tmp_path / "a.ply"), sized(mesh, of_all(130.7, 150.7))))


@pytest.mark.slow
@pytest.mark.usefixtures("in_cells")
@pytest.mark.parametrize(
    "how",
    [{"half_width": 1.0}, {"half_width": (2.0, 5.0)}, {"sign": "none"}, {"thickness": 0.3}, {"half_width": 9.5}],
    ids=str,
)
def test_widths_shells_and_unsigned_distances(how: dict[str, object], tmp_path: Path) -> None:
    mesh = mesh_catalog.torus()
    found, expected = both(saved(mesh, tmp_path / "a.ply"), sized(mesh, 40), **how)
    same_grid(found, expected)
    kept = ("geokit:voxel_size", "geokit:version", "geokit:source")
    assert [found.info.metadata[key] for key in kept] == [expected.info.metadata[key] for key in kept]


def test_upper_nodes_and_the_gap_between_them(tmp_path: Path) -> None:
    """Two boxes 13,000 voxels apart along z: a root tile stands for each upper node between theirs."""
    mesh = mesh_catalog.box()
    far = TriangleMesh(mesh.vertices + np.array([0.0, 0.0, 1300.0]), mesh.faces)
    found, expected = both(saved(mesh_catalog.join(mesh, far), tmp_path / "a.ply"), 0.1)
    same_grid(found, expected)


@pytest.mark.slow
def test_voxels_on_the_surface_differ_in_nothing_but_the_sign_of_rounding(tmp_path: Path) -> None:
    for mesh in (mesh_catalog.box(), mesh_catalog.tetrahedron(), mesh_catalog.nested_boxes(), mesh_catalog.l_profile()):
        found, expected = both(saved(mesh, tmp_path / "a.ply", aside=False), sized(mesh, 40))
        one, other = gk.volume.active_voxels(found), gk.volume.active_voxels(expected)
        np.testing.assert_array_equal(one.coordinates, other.coordinates)
        size = float(np.abs(mesh.bounds).max())
        np.testing.assert_allclose(one.values, other.values, rtol=0, atol=2e-15 * size)
        np.testing.assert_array_equal(np.abs(one.values), np.abs(other.values))


def test_a_mesh_that_is_inside_out_is_turned_and_one_with_such_a_part_warns(tmp_path: Path) -> None:
    mesh = mesh_catalog.inside_out_box()
    same_grid(*both(saved(mesh, tmp_path / "a.stl"), sized(mesh, 20.3)))
    good = mesh_catalog.icosphere(2)
    bad = TriangleMesh(0.5 * good.vertices + 3.0, good.faces[:, ::-1])
    path = saved(mesh_catalog.join(good, bad), tmp_path / "a.ply")
    with pytest.warns(UserWarning, match="negative winding number"):
        gk.volume.from_mesh_file(path, tmp_path / "a.nvdb", 0.1, **CPU)
    field = gk.volume.load(tmp_path / "a.nvdb")
    values = field.sample(np.array([[0.0, 0.0, 0.9], [3.0, 3.0, 3.4]]) + ASIDE, **CPU)
    assert values[0] < 0.0 < values[1]


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize("faces_first", [False, True])
def test_ply_files_of_other_programs(order: str, kind: str, faces_first: bool, tmp_path: Path) -> None:
    mesh = mesh_catalog.icosphere(2)
    points = (mesh.vertices + ASIDE).astype(kind)
    vertices = np.zeros(len(points), [("q", "u1"), *((axis, order + kind) for axis in "xyz"), ("s", order + "f4")])
    faces = np.zeros(len(mesh.faces), [("flag", "u1"), ("n", "u1"), ("v", order + "i4", 3), ("w", order + "f4")])
    for k, axis in enumerate("xyz"):
        vertices[axis] = points[:, k]
    faces["n"], faces["v"] = 3, mesh.faces
    number = "float" if kind == "f4" else "double"
    header = ["ply", f"format binary_{'little' if order == '<' else 'big'}_endian 1.0", "comment x"]
    first = [f"element vertex {len(points)}", "property uchar q", *(f"property {number} {axis}" for axis in "xyz")]
    first += ["property float s"]
    second = [f"element face {len(faces)}", "property uchar flag", "property list uchar int vertex_indices"]
    second += ["property float w"]
    content = vertices.tobytes(), faces.tobytes()
    if faces_first:
        first, second, content = second, first, content[::-1]
    path = tmp_path / "a.ply"
    path.write_bytes("\n".join([*header, *first, *second, "end_header", ""]).encode() + b"".join(content))
    same_grid(*both(path, 0.05))
    assert gk.mesh.audit_file(path).watertight


def test_the_file_is_that_of_save(tmp_path: Path) -> None:
    """Byte for byte, checksum and all, where the metadata are the same."""
    mesh = mesh_catalog.l_profile()
    path = saved(mesh, tmp_path / "a.ply")
    found, expected = both(path, sized(mesh, 37.3), half_width=2)
    gk.volume.save(tmp_path / "b.nvdb", gk.volume.SparseVolume(expected.nanovdb, found.info))
    assert (tmp_path / "a.nvdb").read_bytes() == (tmp_path / "b.nvdb").read_bytes()


@pytest.mark.slow
def test_progress_and_names(tmp_path: Path) -> None:
    done: list[int] = []
    path = saved(mesh_catalog.torus(), tmp_path / "ring.stl")
    info = gk.volume.from_mesh_file(
        path, tmp_path / "a.nvdb", 0.1, name="other", progress=lambda at, of: done.append(at), **CPU
    )
    assert info.name == "other"
    assert done == sorted(done)
    assert 99 <= done[-1] <= 100
    assert gk.volume.from_mesh_file(path, tmp_path / "a.nvdb", 0.1, **CPU).name == "ring"


def of_ply(faces: bytes, count: int, vertices: int = 3, faces_first: bool = False) -> bytes:
    head = f"element vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
    of_faces = f"element face {count}\nproperty list uchar int vertex_indices\n"
    parts = [(head, np.arange(9, dtype="<f4").tobytes()), (of_faces, faces)][:: -1 if faces_first else 1]
    header = "ply\nformat binary_little_endian 1.0\n" + parts[0][0] + parts[1][0] + "end_header\n"
    return header.encode() + parts[0][1] + parts[1][1]


TRIANGLE = b"\3" + np.array([0, 1, 2], "<i4").tobytes()
WRONG = {
    "text.stl": b"solid a\nendsolid a\n",
    "text.ply": b"ply\nformat ascii 1.0\nelement vertex 0\nelement face 0\nend_header\n",
    "short.stl": bytes(80) + (2).to_bytes(4, "little") + bytes(60),
    "short.ply": of_ply(TRIANGLE, 2),
    "vertices.ply": of_ply(b"", 1, vertices=9),
    "index.ply": of_ply(TRIANGLE + b"\3" + np.array([0, 1, 3], "<i4").tobytes(), 2),
    "quad.ply": of_ply(b"\4" + np.array([0, 1, 2, 0], "<i4").tobytes() + TRIANGLE, 2),
    "quad behind faces.ply": of_ply(b"\4" + np.array([0, 1, 2, 0], "<i4").tobytes() + TRIANGLE, 2, faces_first=True),
    "short behind faces.ply": of_ply(TRIANGLE, 2, faces_first=True),
    "vertices behind faces.ply": of_ply(TRIANGLE, 1, vertices=9, faces_first=True),
    "cloud.ply": of_ply(b"", 0).replace(b"element face 0\nproperty list uchar int vertex_indices\n", b""),
    "nan.stl": bytes(80) + (1).to_bytes(4, "little") + np.full(12, np.nan, "<f4").tobytes() + bytes(2),
    "empty.stl": b"",
}


@pytest.mark.parametrize("name", WRONG)
def test_files_that_cannot_be_read_are_named(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(WRONG[name])
    with pytest.raises(FileFormatError, match=name) as error:
        gk.volume.from_mesh_file(path, tmp_path / "a.nvdb", 0.1, **CPU)
    assert len(str(error.value)) < 300
    assert [file.name for file in tmp_path.iterdir()] == [name]


def test_bad_arguments_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good, out = saved(mesh_catalog.box(), tmp_path / "a.ply"), tmp_path / "a.nvdb"

    def refused(kind: type[Exception], text: str, *given: object, **how: object) -> None:
        with pytest.raises(kind, match=text):
            gk.volume.from_mesh_file(*(given or (good, out, 0.1)), **how, **CPU)

    refused(FileAccessError, "no such file", tmp_path / "b.ply", out, 0.1)
    refused(InputError, r"\.obj' is not a binary mesh format", tmp_path / "b.obj", out, 0.1)
    refused(InputError, r"\.vdb' is not a streamed volume format", good, tmp_path / "a.vdb", 0.1)
    refused(InputError, "voxel_size", good, out, 0.0)
    refused(InputError, r"voxel_size: the band is .* use at least \d", good, out, 1e-9)
    refused(InputError, "half_width: the band is .* use a smaller half_width or thickness", half_width=1e9)
    refused(InputError, "half_width", half_width=0.5)
    refused(FileAccessError, "GiB that are free there", half_width=1e6)
    refused(FileAccessError, "GiB that are free there", good, out, 1e-6)
    refused(InputError, "sign: 'parity'", sign="parity")
    refused(InputError, "thickness", thickness=-1.0)
    refused(InputError, "memory_limit", memory_limit=1000)
    refused(FileAccessError, "does not exist", good, tmp_path / "none" / "a.nvdb", 0.1)
    for make in (*mesh_catalog.OPEN, mesh_catalog.flipped_faces):
        refused(InputError, "is open, or its faces are not wound alike", saved(make(), tmp_path / "b.ply"), out, 0.1)
    (tmp_path / "c.stl").write_bytes(bytes(84))
    refused(InputError, "has no faces", tmp_path / "c.stl", out, 0.1)
    assert not out.exists()
    monkeypatch.setattr(cell_band, "BYTES_PER_TRIANGLE", 1 << 29)
    refused(DeviceMemoryError, r"memory_limit: \d+ triangles lie near the 8\^3 voxels", memory_limit=1 << 28)
    assert not out.exists()


PEAK = """
import sys, threading, time
import geokit as gk
gk.mesh.save(sys.argv[1] + "/warm.ply", gk.mesh.sphere())
gk.volume.from_mesh_file(sys.argv[1] + "/warm.ply", sys.argv[1] + "/warm.nvdb", 0.1, device="cpu")
def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096
before, most, done = resident(), [0], []
def watch():
    while not done:
        most[0] = max(most[0], resident())
        time.sleep(0.005)
thread = threading.Thread(target=watch)
thread.start()
gk.volume.from_mesh_file(sys.argv[1] + "/a.stl", sys.argv[1] + "/a.nvdb", float(sys.argv[2]), memory_limit=1 << 28,
                         device="cpu")
done.append(1)
thread.join()
print(most[0] - before)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("size", of_all([0.05, 0.0024], [0.05, 0.0013]))
def test_memory_stays_below_the_limit(size: float, tmp_path: Path) -> None:
    """Many triangles for few voxels, and many voxels: in memory the call takes 330 MB and 0.6 GB (all: 2 GB)."""
    mesh = gk.mesh.torus(segments=1200 if size > 0.01 else 60, tube_segments=340 if size > 0.01 else 30)
    gk.mesh.save(tmp_path / "a.stl", mesh)
    done = subprocess.run(
        [sys.executable, "-c", PEAK, str(tmp_path), str(size)], capture_output=True, text=True, timeout=900, check=False
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 1 << 28


def test_no_warning_escapes(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        both(saved(mesh_catalog.two_boxes_touching_at_a_vertex(), tmp_path / "a.ply"), 0.07)
