"""Meshes of other libraries in and out, and what is refused."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import meshio
import numpy as np
import pytest
import pyvista
import trimesh

import geokit as gk
from geokit.errors import InputError

CUBE = trimesh.creation.box()
VERTICES, FACES = np.array(CUBE.vertices) + 1e6 / 3.0, np.array(CUBE.faces)
GRID = pyvista.Sphere().cast_to_unstructured_grid()
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


def _scene() -> Any:
    scene = trimesh.Scene()
    body = trimesh.Trimesh(VERTICES, FACES, process=False)
    scene.add_geometry(body, node_name="a")
    scene.add_geometry(body, node_name="b", transform=trimesh.transformations.translation_matrix([3.0, 0.0, 0.0]))
    return scene


def _tensors() -> Any:
    torch = pytest.importorskip("torch")
    return torch.tensor(VERTICES), torch.tensor(FACES)


def _open3d() -> Any:
    o3d = pytest.importorskip("open3d")
    return o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(VERTICES), o3d.utility.Vector3iVector(FACES))


def _open3d_tensors() -> Any:
    o3d = pytest.importorskip("open3d")
    mesh = o3d.t.geometry.TriangleMesh()
    mesh.vertex.positions, mesh.triangle.indices = o3d.core.Tensor(VERTICES), o3d.core.Tensor(FACES)
    return mesh


SAME: dict[str, Callable[[], Any]] = {
    "trimesh": lambda: trimesh.Trimesh(VERTICES, FACES, process=False),
    "pyvista": lambda: pyvista.PolyData.from_regular_faces(VERTICES, FACES),
    "meshio": lambda: meshio.Mesh(VERTICES, [("triangle", FACES)]),
    "pair": lambda: (VERTICES, FACES),
    "lists": lambda: [VERTICES.tolist(), FACES.tolist()],
    "tensors": _tensors,
    "open3d": _open3d,
    "open3d tensors": _open3d_tensors,
    "like open3d": lambda: SimpleNamespace(vertices=VERTICES.tolist(), triangles=FACES.tolist()),
    "like open3d tensors": lambda: SimpleNamespace(
        vertex=SimpleNamespace(positions=VERTICES), triangle=SimpleNamespace(indices=FACES)
    ),
}


@pytest.mark.parametrize("kind", SAME)
def test_the_same_mesh_from_each_library(kind: str) -> None:
    found = gk.mesh.as_mesh(SAME[kind]())
    np.testing.assert_array_equal(found.vertices, VERTICES)
    np.testing.assert_array_equal(found.faces, FACES)


@pytest.mark.parametrize(
    "polygons",
    [
        pyvista.PolyData(VERTICES, np.insert(QUADS, 0, 4, axis=1).ravel()),
        pyvista.PolyData(VERTICES, [*np.insert(QUADS[:3], 0, 4, axis=1).ravel(), 3, 2, 3, 7, 3, 2, 7, 6,
                                    *np.insert(QUADS[4:], 0, 4, axis=1).ravel()]),
        meshio.Mesh(VERTICES, [("quad", QUADS[:2]), ("polygon", QUADS[2:])]),
        (VERTICES, QUADS),
    ],
    ids=["pyvista", "mixed", "meshio", "pair"],
)  # fmt: skip
def test_polygons_are_split(polygons: Any) -> None:
    report = gk.mesh.audit(polygons)
    assert (report.face_count, report.watertight, report.oriented) == (12, True, True)


def test_strips_of_pyvista() -> None:
    sphere = pyvista.Sphere()
    found = gk.mesh.audit(sphere.strip())
    assert (found.face_count, found.watertight) == (sphere.n_cells, True)


def test_scenes_are_joined_at_their_places() -> None:
    found = gk.mesh.as_mesh(_scene())
    assert found.face_count == 24
    np.testing.assert_allclose(found.bounds[1] - found.bounds[0], [4.0, 1.0, 1.0], atol=1e-9)


def test_every_function_takes_them() -> None:
    box = SAME["trimesh"]()
    own = gk.mesh.as_mesh(box)
    point = VERTICES.mean(axis=0)
    assert gk.mesh.Surface(box, device="cpu").signed_distance(point).distance == pytest.approx(-0.5)
    assert gk.mesh.orient(box).mesh.face_count == gk.mesh.merge_vertices(box).face_count == 12
    assert gk.mesh.hausdorff(box, SAME["pyvista"](), device="cpu").max == 0.0
    made = [gk.volume.from_mesh(mesh, 0.1, device="cpu").nanovdb for mesh in (own, box)]
    np.testing.assert_array_equal(*made)
    found = gk.points.register(VERTICES + 1e-3, box, device="cpu", max_iterations=2)
    assert found.transform.shape == (4, 4)


def test_parts_that_are_no_faces_are_told() -> None:
    lines = np.array([[0, 1], [1, 2]])
    scene = _scene()
    scene.add_geometry(trimesh.PointCloud(VERTICES))
    padded = [np.insert(rows, 0, rows.shape[1], axis=1).ravel() for rows in (FACES, lines)]
    blocks = [("line", lines), ("triangle", FACES), ("tetra", np.array([[0, 1, 2, 4]]))]
    for given, told in [
        (pyvista.PolyData(VERTICES, faces=padded[0], lines=padded[1]), "lines (2)"),
        (meshio.Mesh(VERTICES, blocks), "line cells (2), tetra cells (1)"),
        (scene, "PointCloud (1)"),
    ]:
        for take in (gk.mesh.as_mesh, gk.mesh.Surface):
            with pytest.warns(UserWarning, match=re.escape(f"mesh: its {told} are left out")) as said:
                take(given)
            assert len(said) == 1


def test_saving(tmp_path: Any) -> None:
    gk.mesh.save(tmp_path / "box.ply", SAME["meshio"]())
    np.testing.assert_array_equal(gk.mesh.load(tmp_path / "box.ply").vertices, VERTICES)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (3, "mesh: int is not a TriangleMesh"),
        (CUBE.vertices, "mesh: trimesh's TrackedArray is not a TriangleMesh"),
        (GRID, "mesh: pyvista's UnstructuredGrid is not a TriangleMesh; give its surface"),
        (trimesh.PointCloud(VERTICES), "mesh: trimesh's PointCloud is not a TriangleMesh"),
        (gk.points.PointCloud(VERTICES), "mesh: PointCloud is not a TriangleMesh"),
        (meshio.Mesh(VERTICES, [("tetra", [[0, 1, 2, 4]])]), "mesh: meshio's Mesh holds tetra and no polygons"),
        ((VERTICES, [[0, 1, 9]]), r"mesh.faces: row 0 is \[0, 1, 9\], outside the 8 vertices"),
        ((VERTICES, [[0, 1, 2, 9]]), "mesh.faces: row 0 uses vertex 9 of 8"),
        ((VERTICES, FACES + 0.5), "mesh.faces: dtype float64 is not an integer type"),
        ((VERTICES * np.nan, FACES), "mesh.vertices: row 0 is not finite"),
        ((VERTICES[:, :2], FACES), r"mesh.vertices: shape \(8, 2\) is not"),
        ((VERTICES, "faces"), "mesh"),
        ((3, FACES), "mesh.vertices"),
    ],
)  # fmt: skip
def test_what_is_no_mesh(given: Any, message: str) -> None:
    with pytest.raises(gk.InputError, match=message):
        gk.mesh.as_mesh(given)


def test_an_object_that_fails_is_refused_by_name() -> None:
    class Failing:
        @property
        def vertices(self) -> Any:
            raise RuntimeError("no")

    with pytest.raises(gk.InputError, match="Failing is not a TriangleMesh"):
        gk.mesh.audit(Failing())  # type: ignore[arg-type]


@pytest.mark.parametrize("library", ["trimesh", "pyvista", "meshio", "open3d"])
def test_out_and_in_again(library: str) -> None:
    pytest.importorskip(library)
    mesh = gk.mesh.TriangleMesh(VERTICES, FACES, name="box")
    made = getattr(gk.mesh, f"to_{library}")(mesh)
    assert type(made).__module__.startswith(library)
    back = gk.mesh.as_mesh(made)
    np.testing.assert_array_equal(back.vertices, VERTICES)
    np.testing.assert_array_equal(back.faces, FACES)


def test_arrays_are_copies() -> None:
    mesh = gk.mesh.TriangleMesh(VERTICES, FACES)
    gk.mesh.to_trimesh(mesh).vertices[:] = 0.0
    gk.mesh.to_pyvista(mesh).points[:] = 0.0
    gk.mesh.to_meshio(mesh).points[:] = 0.0
    np.testing.assert_array_equal(mesh.vertices, VERTICES)


@pytest.mark.slow
def test_nothing_is_imported_for_it() -> None:
    import subprocess
    import sys

    code = """
import sys, numpy as np, types, geokit as gk
gk.mesh.as_mesh(types.SimpleNamespace(vertices=np.eye(3), faces=np.array([[0, 1, 2]])))
assert not {"trimesh", "pyvista", "meshio", "open3d", "xarray", "vtkmodules"} & set(sys.modules), sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.slow
def test_tensors_are_the_first_thing_of_a_process() -> None:
    """Sharing a tensor does not start warp by itself."""
    pytest.importorskip("torch")
    code = (
        "import geokit as gk, torch\n"
        "pair = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2]])\n"
        "print(gk.mesh.audit(pair).area)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout == "0.5\n", done.stderr


def test_vertices_that_require_gradients_are_refused() -> None:
    torch = pytest.importorskip("torch")
    pair = torch.tensor(VERTICES, requires_grad=True), torch.tensor(FACES)
    for call in (gk.mesh.as_mesh, gk.mesh.audit, lambda mesh: gk.mesh.sample_surface(mesh, 10)):
        with pytest.raises(InputError, match=r"vertices: require gradients.*geokit\.torch.*detach\(\)"):
            call(pair)


def test_an_empty_mesh_of_tensors_is_called_so() -> None:
    class TriangleMesh:
        """As Open3D's, whose tensors are missing while it is empty."""

    with pytest.raises(InputError, match="TriangleMesh has no vertices and faces"):
        gk.mesh.as_mesh(TriangleMesh())
