"""What meshes of other libraries carry besides positions and faces, in and out."""

from __future__ import annotations

import io
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import meshio
import numpy as np
import pytest
import pyvista
import trimesh
from numpy.typing import NDArray
from PIL import Image

import geokit as gk

PIXELS = np.arange(4 * 2 * 3, dtype=np.uint8).reshape(4, 2, 3) * 9


def _png(pixels: NDArray[np.uint8]) -> bytes:
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, "PNG")
    return data.getvalue()


def _rich() -> gk.mesh.TriangleMesh:
    """A box with a seam, two materials and faces without one, and arrays of its own on vertices and faces."""
    box = gk.mesh.box()
    random = np.random.default_rng(5)
    normal = random.normal(size=(len(box.vertices), 3))
    return gk.mesh.TriangleMesh(
        box.vertices,
        box.faces,
        name="crate",
        vertex_data={
            "normal": (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32),
            "color": random.integers(0, 255, (len(box.vertices), 4), np.uint8),
            "heat": random.random(len(box.vertices), np.float32),
        },
        face_data={"zone": np.arange(12, dtype=np.int16), "material": np.repeat([0, 1, -1], 4)},
        corner_data={"uv": random.random((12, 3, 2))},
        materials=[
            gk.mesh.Material("wood", None, gk.mesh.Texture("wood.png", _png(PIXELS))),
            gk.mesh.Material("glass", (1.0, 0.0, 0.2, 0.6)),
        ],
        meters_per_unit=0.001,
    )


def _at_corners(mesh: gk.mesh.TriangleMesh, name: str) -> NDArray[Any]:
    return mesh.corner_data[name] if name in mesh.corner_data else mesh.vertex_data[name][mesh.faces]


def test_trimesh_holds_everything() -> None:
    mesh = _rich()
    made = gk.mesh.to_trimesh(mesh)
    assert len(made.visual.material.materials) == 3
    assert made.units == "mm"
    back = gk.mesh.as_mesh(made)
    for name in ("normal", "uv", "color", "heat"):
        np.testing.assert_array_equal(_at_corners(back, name), _at_corners(mesh, name))
    assert {name: values.tolist() for name, values in back.face_data.items()} == {
        name: values.tolist() for name, values in mesh.face_data.items()
    }
    assert (back.materials, back.meters_per_unit, back.name) == (mesh.materials, 0.001, "crate")


@pytest.mark.parametrize("element", ["vertex", "face"])
def test_colors_of_trimesh(element: str) -> None:
    count = {"vertex": 8, "face": 12}[element]
    colors = np.random.default_rng(1).integers(0, 255, (count, 4), np.uint8)
    mesh = gk.mesh.TriangleMesh(gk.mesh.box().vertices, gk.mesh.box().faces, **{f"{element}_data": {"color": colors}})  # type: ignore[arg-type]
    made = gk.mesh.to_trimesh(mesh)
    assert made.visual.kind == element
    np.testing.assert_array_equal(getattr(gk.mesh.as_mesh(made), f"{element}_data")["color"], colors)
    shares = gk.mesh.TriangleMesh(mesh.vertices, mesh.faces, **{f"{element}_data": {"color": colors[:, :3] / 255.0}})  # type: ignore[arg-type]
    seen = np.asarray(getattr(gk.mesh.to_trimesh(shares).visual, f"{element}_colors"))
    np.testing.assert_array_equal(seen[:, :3], colors[:, :3])


def test_what_trimesh_made_itself() -> None:
    box = trimesh.creation.box()
    assert not gk.mesh.as_mesh(box).vertex_data  # nothing is computed for it
    image = Image.fromarray(PIXELS)
    box.visual = trimesh.visual.TextureVisuals(
        uv=np.random.default_rng(2).random((8, 2)),
        material=trimesh.visual.material.SimpleMaterial(image=image, diffuse=[255, 0, 51, 255]),
    )
    found = gk.mesh.as_mesh(box)
    np.testing.assert_array_equal(found.vertex_data["uv"], box.visual.uv)
    assert found.materials[0].color == (1.0, 0.0, 0.2, 1.0)
    texture = found.materials[0].texture
    assert texture is not None
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(texture.data))), PIXELS)
    assert gk.mesh.Surface(box, device="cpu").mesh.materials[0].texture is None


@pytest.mark.parametrize(
    ("library", "lost"),
    [("pyvista", "PyVista does not hold materials"), ("meshio", "meshio .* materials, the unit of 0.001 m")],
)
def test_arrays_of_pyvista_and_meshio(library: str, lost: str) -> None:
    mesh = _rich()
    with pytest.warns(UserWarning, match=f"^{lost}; left out$") as said:
        made = getattr(gk.mesh, f"to_{library}")(mesh)
    assert said[0].filename == __file__
    back = gk.mesh.as_mesh(made)
    for name in ("normal", "uv", "color", "heat"):
        found, given = _at_corners(back, name), _at_corners(mesh, name)
        np.testing.assert_array_equal(found, given)
        assert found.dtype == given.dtype
    for name, values in mesh.face_data.items():
        np.testing.assert_array_equal(back.face_data[name], values)


def test_pyvista_marks() -> None:
    with pytest.warns(UserWarning, match="materials"):
        made = gk.mesh.to_pyvista(_rich())
    assert (made.point_data.active_normals_name, made.point_data.active_texture_coordinates_name) == ("normal", "uv")
    sphere = pyvista.Sphere().texture_map_to_sphere()
    found = gk.mesh.as_mesh(sphere)
    np.testing.assert_array_equal(found.vertex_data["normal"], sphere.point_data["Normals"])
    np.testing.assert_array_equal(found.vertex_data["uv"], sphere.active_texture_coordinates)


@pytest.mark.filterwarnings("ignore:mesh. its .* are left out")
def test_cells_that_are_no_polygons_have_rows_of_their_own() -> None:
    points = [[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0]]
    mixed = pyvista.PolyData(np.array(points), lines=[2, 0, 1, 2, 1, 2], faces=[4, 0, 1, 2, 3, 3, 1, 4, 2])
    mixed.cell_data["row"] = np.arange(4)
    assert gk.mesh.as_mesh(mixed).face_data["row"].tolist() == [2, 2, 3]
    blocks = [("line", [[0, 1]]), ("quad", [[0, 1, 2, 3]]), ("triangle", [[1, 4, 2]])]
    told = meshio.Mesh(points, blocks, cell_data={"row": [[7], [8], [9]]}, point_data={"nx": np.zeros(5)})
    assert gk.mesh.as_mesh(told).face_data["row"].tolist() == [8, 8, 9]
    strips = pyvista.Plane(i_resolution=2, j_resolution=1).triangulate().strip()
    strips.point_data["heat"] = np.arange(strips.n_points)
    assert gk.mesh.as_mesh(strips).vertex_data["heat"].tolist() == list(range(strips.n_points))


OPEN3D: list[Callable[[], Any]] = [
    lambda: SimpleNamespace(
        vertices=np.eye(3),
        triangles=np.array([[0, 1, 2]]),
        vertex_normals=np.eye(3),
        vertex_colors=np.eye(3) / 2,
        triangle_uvs=np.arange(6.0).reshape(3, 2),
        triangle_normals=np.empty((0, 3)),
        textures=[PIXELS[::-1]],
    ),
    lambda: SimpleNamespace(
        vertex=SimpleNamespace(positions=np.eye(3), normals=np.eye(3), colors=np.eye(3) / 2),
        triangle=SimpleNamespace(indices=np.array([[0, 1, 2]]), texture_uvs=np.arange(6.0).reshape(1, 3, 2)),
    ),
]


@pytest.mark.parametrize("make", OPEN3D, ids=["legacy", "tensors"])
def test_objects_like_those_of_open3d(make: Callable[[], Any]) -> None:
    found = gk.mesh.as_mesh(make())
    np.testing.assert_array_equal(found.vertex_data["normal"], np.eye(3))
    np.testing.assert_array_equal(found.vertex_data["color"], np.eye(3) / 2)
    np.testing.assert_array_equal(found.corner_data["uv"], np.arange(6.0).reshape(1, 3, 2))
    assert "normal" not in found.face_data
    for material in found.materials:
        assert material.texture is not None
        np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(material.texture.data))), PIXELS)


def test_open3d_out_and_in_again() -> None:
    o3d = pytest.importorskip("open3d")
    mesh = _rich()
    with pytest.warns(UserWarning, match="^Open3D does not hold") as said:
        made = gk.mesh.to_open3d(mesh)
    for text in ("vertex 'heat'", "face 'zone'", "the alpha of vertex 'color'", "names and colors of materials"):
        assert text in str(said[0].message)
    back = gk.mesh.as_mesh(made)
    np.testing.assert_array_equal(_at_corners(back, "normal"), _at_corners(mesh, "normal"))
    np.testing.assert_allclose(_at_corners(back, "color") * 255, _at_corners(mesh, "color")[..., :3], atol=1e-12)
    np.testing.assert_array_equal(back.corner_data["uv"], mesh.corner_data["uv"])
    np.testing.assert_array_equal(back.face_data["material"], mesh.face_data["material"])
    texture = back.materials[0].texture
    assert texture is not None
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(texture.data))), PIXELS)
    tensors = gk.mesh.as_mesh(o3d.t.geometry.TriangleMesh.from_legacy(made))
    np.testing.assert_allclose(tensors.corner_data["uv"], mesh.corner_data["uv"], atol=1e-7)


def test_open3d_reads_a_texture_the_right_way_up(tmp_path: Any) -> None:
    o3d = pytest.importorskip("open3d")
    mesh = gk.mesh.TriangleMesh(
        np.eye(3), [[0, 1, 2]], vertex_data={"uv": np.eye(3)[:, :2]}, face_data={"material": [0]},
        materials=[gk.mesh.Material("m", None, gk.mesh.Texture("t.png", _png(PIXELS)))],
    )  # fmt: skip
    gk.mesh.save(tmp_path / "a.obj", mesh)
    for module in (o3d.io, o3d.t.io):
        found = gk.mesh.as_mesh(module.read_triangle_mesh(str(tmp_path / "a.obj")))
        # Open3D's reader may put a material of its own before those of the file.
        texture = found.materials[found.face_data["material"][0]].texture
        assert texture is not None
        np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(texture.data)).convert("RGB")), PIXELS)


def test_what_cannot_be_carried_is_said() -> None:
    plane = pyvista.Plane(i_resolution=1, j_resolution=1)
    plane.point_data["label"] = np.array(["a", "b", "c", "d"])
    with pytest.warns(UserWarning, match=r"mesh: the array 'label' of shape \(4,\) and type <U1 is left out"):
        gk.mesh.as_mesh(plane)
    like = SimpleNamespace(
        vertices=np.eye(3), triangles=np.array([[0, 1, 2]]), textures=[PIXELS], triangle_material_ids=np.array([4])
    )
    with pytest.warns(UserWarning, match="faces name materials that are not there"):
        assert "material" not in gk.mesh.as_mesh(like).face_data

    class Failing(SimpleNamespace):
        @property
        def vertex_normals(self) -> Any:
            return SimpleNamespace(__array__=None)

    with pytest.warns(UserWarning, match="mesh"):
        found = gk.mesh.as_mesh(Failing(vertices=np.eye(3), triangles=np.array([[0, 1, 2]])))
    assert found.face_count == 1
    broken = gk.mesh.TriangleMesh(
        np.eye(3), [[0, 1, 2]], face_data={"material": [0]},
        materials=[gk.mesh.Material("m", None, gk.mesh.Texture("t.png", b"no image"))],
    )  # fmt: skip
    with pytest.warns(UserWarning, match="trimesh does not hold the texture 't.png': cannot be decoded"):
        gk.mesh.to_trimesh(broken)
