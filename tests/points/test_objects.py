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
