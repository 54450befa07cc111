"""Point clouds of other libraries in and out, and geokit's own, wherever points are taken."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import meshio
import numpy as np
import pytest
import pyvista
import trimesh

import geokit as gk

POINTS = np.random.default_rng(4).random((60, 3))
CLOUD = gk.points.PointCloud(POINTS, {"normals": POINTS + 1.0, "rgb": (POINTS * 255).astype(np.uint8)})


def _open3d() -> Any:
    o3d = pytest.importorskip("open3d")
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS))


def _open3d_tensors() -> Any:
    o3d = pytest.importorskip("open3d")
    return o3d.t.geometry.PointCloud(o3d.core.Tensor(POINTS))


SAME: dict[str, Callable[[], Any]] = {
    "geokit": lambda: CLOUD,
    "trimesh": lambda: trimesh.PointCloud(POINTS),
    "pyvista": lambda: pyvista.PolyData(POINTS),
    "meshio": lambda: meshio.Mesh(POINTS, []),
    "open3d": _open3d,
    "open3d tensors": _open3d_tensors,
    "like open3d tensors": lambda: SimpleNamespace(point=SimpleNamespace(positions=POINTS)),
}


COLORS, NORMALS, HEAT = POINTS[::-1], POINTS + 1.0, np.arange(60.0)


def _painted_open3d() -> Any:
    o3d, found = pytest.importorskip("open3d"), _open3d()
    found.colors, found.normals = (o3d.utility.Vector3dVector(values) for values in (COLORS, NORMALS))
    return found


def _painted_tensors() -> Any:
    o3d, found = pytest.importorskip("open3d"), _open3d_tensors()
    for name, values in {"colors": COLORS, "normals": NORMALS, "heat": HEAT[:, None]}.items():
        found.point[name] = o3d.core.Tensor(values)
    return found


def _painted_pyvista() -> Any:
    found = pyvista.PolyData(POINTS)
    found.point_data.update({"rgb": COLORS, "Normals": NORMALS, "heat": HEAT})
    found.point_data.active_normals_name = "Normals"
    return found


PAINTED: dict[str, tuple[Callable[[], Any], dict[str, Any]]] = {
    "open3d": (_painted_open3d, {"rgb": COLORS, "normals": NORMALS}),
    "open3d tensors": (_painted_tensors, {"rgb": COLORS, "normals": NORMALS, "heat": HEAT}),
    "like open3d": (
        lambda: SimpleNamespace(points=POINTS, colors=COLORS, normals=np.empty((0, 3))),
        {"rgb": COLORS},
    ),
    "like open3d tensors": (
        lambda: SimpleNamespace(point=SimpleNamespace(positions=POINTS, colors=COLORS, heat=HEAT[:, None])),
        {"rgb": COLORS, "heat": HEAT},
    ),
    "pyvista": (_painted_pyvista, {"rgb": COLORS, "normals": NORMALS, "heat": HEAT}),
    "meshio": (lambda: meshio.Mesh(POINTS, [], {"heat": HEAT}), {"heat": HEAT}),
    "trimesh": (lambda: trimesh.PointCloud(POINTS, [[1, 2, 3, 4]] * 60), {"rgba": np.array([[1, 2, 3, 4]] * 60)}),
    "geokit": (lambda: CLOUD, dict(CLOUD.data)),
}


@pytest.mark.parametrize("kind", PAINTED)
def test_clouds_come_with_their_arrays(kind: str, tmp_path: Any) -> None:
    make, expected = PAINTED[kind]
    found = gk.points.PointCloud(make())
    gk.points.save(tmp_path / "a.npz", make())
    for cloud in (found, gk.points.load(tmp_path / "a.npz")):
        assert set(cloud.data) == set(expected)
        for name, values in expected.items():
            np.testing.assert_array_equal(cloud.data[name], values)
    assert not gk.points.PointCloud(make(), {}).data


def test_arrays_that_do_not_fit_are_named() -> None:
    given = SimpleNamespace(point=SimpleNamespace(positions=POINTS, words=np.array(["a"] * 60), short=HEAT[:3]))
    with pytest.warns(UserWarning, match="points: 'words', 'short' of SimpleNamespace are left out"):
        assert not gk.points.PointCloud(given).data


@pytest.mark.parametrize(("kind", "full"), [(".las", 65535), (".pts", 255), (".pcd", 255)])
def test_shares_of_colors_are_rounded_where_files_hold_integers(kind: str, full: int, tmp_path: Any) -> None:
    if kind == ".las":
        pytest.importorskip("laspy")
    gk.points.save(tmp_path / f"a{kind}", POINTS, data={"rgb": np.where(COLORS > 0.9, 1.0 + 1e-15, COLORS)})
    expected = np.rint(np.where(COLORS > 0.9, 1.0, COLORS) * full)
    np.testing.assert_array_equal(gk.points.load(tmp_path / f"a{kind}").data["rgb"], expected)
    if kind == ".pcd":  # what is no share stays as it is
        return
    with pytest.raises(gk.errors.InputError, match="uint8"):
        gk.points.save(tmp_path / f"b{kind}", POINTS, data={"rgb": COLORS + 0.5})


@pytest.mark.parametrize("kind", SAME)
def test_the_same_cloud_from_each_library(kind: str) -> None:
    given = SAME[kind]()
    np.testing.assert_array_equal(gk.points.PointCloud(given).points, POINTS)
    grid = gk.points.NeighborGrid(given, 0.3, device="cpu")
    expected = gk.points.NeighborGrid(POINTS, 0.3, device="cpu").count()
    np.testing.assert_array_equal(np.asarray(grid.count(POINTS)), expected)


@pytest.mark.parametrize(
    "ask",
    [
        lambda cloud: gk.points.normals(cloud, k=8, device="cpu")[0],
        lambda cloud: gk.points.density(cloud, radius=0.3, device="cpu"),
        lambda cloud: gk.points.outliers(cloud, device="cpu"),
        lambda cloud: gk.points.cluster(cloud, radius=0.3, device="cpu"),
        lambda cloud: gk.points.downsample(cloud, count=9, device="cpu")[0],
        lambda cloud: gk.points.cover(cloud, tolerance=0.2, device="cpu")[0],
        lambda cloud: gk.points.register(cloud, cloud, max_iterations=2, device="cpu").transform,
        lambda cloud: gk.points.chamfer(cloud, POINTS[:9], device="cpu")[0],
        lambda cloud: gk.points.NeighborGrid(POINTS, device="cpu").knn(cloud, 2).indices,
        lambda cloud: gk.volume.from_points(cloud, radius=0.1, voxel_size=0.05, device="cpu").nanovdb,
        lambda cloud: gk.mesh.Surface(trimesh.creation.box(), device="cpu").contains(cloud),
        lambda cloud: gk.volume.from_dense(np.ones((3, 3, 3))).sample(cloud, device="cpu"),
    ],
)
def test_geokits_own_cloud_where_points_go(ask: Callable[[Any], Any]) -> None:
    np.testing.assert_array_equal(ask(CLOUD), ask(POINTS))


@pytest.mark.parametrize("ask", [gk.points.PointCloud, gk.mesh.as_mesh])
def test_truths_of_another_library_are_no_positions(ask: Callable[[Any], Any]) -> None:
    import warp as wp

    truths = wp.zeros((2, 3), dtype=wp.bool, device="cpu")
    given = truths if ask is gk.points.PointCloud else SimpleNamespace(vertices=truths, faces=np.array([[0, 1, 1]]))
    with pytest.raises(gk.InputError, match="dtype bool is not a real number type"):
        ask(given)


def test_saving_keeps_the_arrays(tmp_path: Any) -> None:
    gk.points.save(tmp_path / "cloud.ply", CLOUD)
    back = gk.points.load(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(back.points, POINTS)
    assert {name: values.dtype for name, values in back.data.items()} == {"normals": np.float64, "rgb": np.uint8}


@pytest.mark.parametrize("mesh", [trimesh.creation.box(), gk.mesh.TriangleMesh(np.eye(3), [[0, 1, 2]])])
def test_a_mesh_is_no_cloud(mesh: Any) -> None:
    with pytest.raises(gk.InputError, match="is a mesh; give its vertices, or points on its surface"):
        gk.points.normals(mesh, k=3)


def test_out_to_pyvista() -> None:
    found = gk.points.to_pyvista(CLOUD)
    np.testing.assert_array_equal(found.points, POINTS)
    np.testing.assert_array_equal(found["rgb"], CLOUD.data["rgb"])
    assert gk.points.to_pyvista(np.zeros((0, 3))).n_points == 0


def test_out_to_trimesh() -> None:
    with pytest.warns(UserWarning, match="^trimesh has no place for 'normals' of points; left out$"):
        found = gk.points.to_trimesh(CLOUD)
    np.testing.assert_array_equal(found.vertices, POINTS)
    np.testing.assert_array_equal(found.colors[:, :3], CLOUD.data["rgb"])


@pytest.mark.parametrize(
    ("name", "values"),
    [("rgba", np.uint8([200, 30, 0, 9])), ("rgb", np.uint16([51400, 7710, 0])), ("rgb", np.uint16([200, 30, 0]))],
)
def test_colors_of_trimesh_have_8_bits(name: str, values: np.ndarray) -> None:
    found = gk.points.to_trimesh(gk.points.PointCloud(POINTS, {name: np.tile(values, (len(POINTS), 1))}))
    assert found.colors[0].tolist() == [200, 30, 0, 9 if name == "rgba" else 255]


def test_out_to_open3d() -> None:
    pytest.importorskip("open3d")
    more = gk.points.PointCloud(POINTS, {**CLOUD.data, "heat": np.arange(len(POINTS))})
    with pytest.warns(UserWarning, match="^Open3D has no place for 'heat' of points; left out$"):
        found = gk.points.to_open3d(more)
    np.testing.assert_array_equal(np.asarray(found.points), POINTS)
    np.testing.assert_array_equal(np.asarray(found.normals), POINTS + 1.0)
    np.testing.assert_allclose(np.asarray(found.colors), CLOUD.data["rgb"] / 255.0)
