"""Peers for mesh queries, each in its best configuration: prebuilt trees, all threads, float32 in its own containers.

A factory prepares everything and returns an ``Asked``: ``run`` is the timed call, ``read`` converts its answer to an
array afterwards. A peer that is not installed raises ImportError. Queries keep the order of the user.

- Open3D's scene is Embree with RTC_SCENE_FLAG_ROBUST (cpp/open3d/t/geometry/RaycastingScene.cpp); the parity of one
  ray decides its signs. It builds at its first query, and uses all threads.
- embreex releases the GIL: slices go to a pool of threads. It is robust only if requested.
- fcpw needs columns (Fortran order), libigl rows of float64. libigl's AABB is prebuilt; its ``signed_distance`` builds
  trees at each call, and multiplies distances by 1 - 2w with w the fast winding number, which is not exactly 0 or 1.
- point-cloud-utils builds its tree at each call; its rays run on one thread and hold the GIL.
- raw warp is written as its users would, in slices over all threads, with the faster of two leaf sizes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from benchmarks.measure import Asked
from geokit.core import launcher
from geokit.mesh import TriangleMesh

# Leaf sizes of a warp Mesh: the best ones on CPUs; which one is faster depends on the mesh and the queries.
LEAF_SIZES = (8, 4)
# Queries that choose between them.
LEAF_TRIAL = 20_000
# More slices than threads, so that a hard slice does not delay the end; fewer cost less call overhead.
SLICES_PER_THREAD = 8


def _single(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float32)


# Open3D


def _open3d_scene(mesh: TriangleMesh) -> tuple[Any, Callable[[], Any]]:
    import open3d as o3d

    vertices = o3d.core.Tensor(_single(mesh.vertices))
    faces = o3d.core.Tensor(mesh.faces.astype(np.uint32))

    def build() -> Any:
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(vertices, faces)
        return scene

    return o3d, build


def _open3d_points(mesh: TriangleMesh, points: np.ndarray, method: str) -> Asked:
    o3d, build = _open3d_scene(mesh)
    scene, query = build(), o3d.core.Tensor(_single(points))
    return Asked(lambda: getattr(scene, method)(query), lambda found: found.numpy())


def open3d_distance(mesh: TriangleMesh, points: np.ndarray) -> Asked:
    return _open3d_points(mesh, points, "compute_distance")


def open3d_signed(mesh: TriangleMesh, points: np.ndarray) -> Asked:
    return _open3d_points(mesh, points, "compute_signed_distance")


def open3d_first_hit(mesh: TriangleMesh, origins: np.ndarray, directions: np.ndarray) -> Asked:
    o3d, build = _open3d_scene(mesh)
    scene, rays = build(), o3d.core.Tensor(_single(np.concatenate([origins, directions], axis=1)))
    return Asked(lambda: scene.cast_rays(rays), lambda found: found["t_hit"].numpy())


def open3d_occluded(mesh: TriangleMesh, origins: np.ndarray, directions: np.ndarray) -> Asked:
    o3d, build = _open3d_scene(mesh)
    scene, rays = build(), o3d.core.Tensor(_single(np.concatenate([origins, directions], axis=1)))
    return Asked(lambda: scene.test_occlusions(rays), lambda found: found.numpy())


def open3d_build(mesh: TriangleMesh, point: np.ndarray, signed: bool = False) -> Asked:
    o3d, build = _open3d_scene(mesh)
    query, method = o3d.core.Tensor(_single(point)), "compute_signed_distance" if signed else "compute_distance"
    return Asked(lambda: getattr(build(), method)(query), lambda found: found.numpy())


# embreex


def _embreex_scene(mesh: TriangleMesh, robust: bool) -> Callable[[], Any]:
    from embreex.mesh_construction import TriangleMesh as EmbreexMesh
    from embreex.rtcore_scene import EmbreeScene

    vertices, faces = _single(mesh.vertices), np.ascontiguousarray(mesh.faces, np.int32)

    def build() -> Any:
        scene = EmbreeScene(robust=robust)
        EmbreexMesh(scene, vertices, faces)
        return scene

    return build


def _embreex_rays(
    mesh: TriangleMesh, origins: np.ndarray, directions: np.ndarray, robust: bool, query: str
) -> Callable[[], list[np.ndarray]]:
    scene = _embreex_scene(mesh, robust)()
    origins, directions = _single(origins), _single(directions)
    scene.run(origins[:1], directions[:1], query=query)  # commits the scene: threads must not each try to
    threads = launcher.thread_count()
    size = -(-len(origins) // (threads * SLICES_PER_THREAD))
    pool = ThreadPoolExecutor(threads)
    slices = [slice(first, first + size) for first in range(0, len(origins), size)]

    def run() -> list[np.ndarray]:
        return list(pool.map(lambda rows: scene.run(origins[rows], directions[rows], query=query), slices))

    return run


def embreex_first_hit(mesh: TriangleMesh, origins: np.ndarray, directions: np.ndarray, robust: bool) -> Asked:
    def read(found: list[np.ndarray]) -> np.ndarray:
        t = np.concatenate(found)
        return np.where(t > 1e36, np.inf, t)  # 1e37 is embreex's miss

    return Asked(_embreex_rays(mesh, origins, directions, robust, "DISTANCE"), read)


def embreex_occluded(mesh: TriangleMesh, origins: np.ndarray, directions: np.ndarray, robust: bool) -> Asked:
    run = _embreex_rays(mesh, origins, directions, robust, "OCCLUDED")
    return Asked(run, lambda found: np.concatenate(found) != -1)


def embreex_build(mesh: TriangleMesh, origins: np.ndarray, directions: np.ndarray) -> Asked:
    build = _embreex_scene(mesh, robust=True)
    origins, directions = _single(origins), _single(directions)
    return Asked(lambda: build().run(origins, directions, query="DISTANCE"))


# trueform (its license is for noncommercial use)


def trueform_build(mesh: TriangleMesh, point: np.ndarray) -> Asked:
    import trueform

    vertices, faces, query = mesh.vertices.copy(), mesh.faces.copy(), trueform.Point(np.float64(point))

    def run() -> Any:
        tree = trueform.Mesh(faces, vertices)
        tree.build_tree()
        return trueform.neighbor_search(tree, query)

    return Asked(run, lambda found: np.sqrt(found[1]))


# fcpw


def _fcpw_scene(mesh: TriangleMesh) -> tuple[Any, Callable[[], Any]]:
    import fcpw

    vertices, faces = np.asfortranarray(mesh.vertices, np.float32), np.asfortranarray(mesh.faces, np.int32)

    def build() -> Any:
        scene = fcpw.scene_3D()
        scene.set_object_count(1)
        scene.set_object_vertices(vertices, 0)
        scene.set_object_triangles(faces, 0)
        scene.build(fcpw.aggregate_type.bvh_surface_area, True, False, False)
        return scene

    return fcpw, build


def _fcpw_depths(found: Any) -> np.ndarray:
    depths = np.array([interaction.d for interaction in found], np.float64)
    return np.where(depths > 1e38, np.inf, depths)  # the largest float is fcpw's miss


def fcpw_distance(mesh: TriangleMesh, points: np.ndarray) -> Asked:
    fcpw, build = _fcpw_scene(mesh)
    scene, found = build(), fcpw.interaction_3D_list()
    queries, radii = np.asfortranarray(points, np.float32), np.full(len(points), np.inf, np.float32)

    def run() -> Any:
        scene.find_closest_points(queries, radii, found, False)
        return found

    return Asked(run, _fcpw_depths)


def fcpw_first_hit(mesh: TriangleMesh, origins: np.ndarray, directions: np.ndarray) -> Asked:
    fcpw, build = _fcpw_scene(mesh)
    scene, found = build(), fcpw.interaction_3D_list()
    reach = np.full(len(origins), np.inf, np.float32)
    # fcpw takes directions of unit length and gives lengths.
    lengths = np.linalg.norm(directions, axis=1)
    starts = np.asfortranarray(origins, np.float32)
    headings = np.asfortranarray(directions / lengths[:, None], np.float32)

    def run() -> Any:
        scene.intersect(starts, headings, reach, found, False)
        return found

    return Asked(run, lambda found: _fcpw_depths(found) / lengths)


def fcpw_build(mesh: TriangleMesh, point: np.ndarray) -> Asked:
    fcpw, build = _fcpw_scene(mesh)
    query, radii = np.asfortranarray(point, np.float32), np.full(len(point), np.inf, np.float32)

    def run() -> Any:
        found = fcpw.interaction_3D_list()
        build().find_closest_points(query, radii, found, False)
        return found

    return Asked(run, _fcpw_depths)


# libigl


def _libigl_trees(mesh: TriangleMesh, signs: bool) -> tuple[np.ndarray, np.ndarray, Callable[[], tuple[Any, Any]]]:
    import igl

    vertices, faces = np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces, np.int64)

    def build() -> tuple[Any, Any]:
        tree = igl.AABB()
        tree.init(vertices, faces)
        winding = igl.FastWindingNumberBVH() if signs else None
        if winding is not None:
            winding.init(vertices, faces, 2)
        return tree, winding

    return vertices, faces, build


def libigl_distance(mesh: TriangleMesh, points: np.ndarray) -> Asked:
    vertices, faces, build = _libigl_trees(mesh, signs=False)
    tree, _ = build()
    return Asked(lambda: tree.squared_distance(vertices, faces, points), lambda found: np.sqrt(found[0]))


def libigl_signed(mesh: TriangleMesh, points: np.ndarray) -> Asked:
    """Its exact distance and its fast winding number (order 2, accuracy 2), both trees prebuilt."""
    vertices, faces, build = _libigl_trees(mesh, signs=True)
    tree, winding = build()

    def run() -> tuple[Any, np.ndarray]:
        return tree.squared_distance(vertices, faces, points), winding.winding_number(points, 2.0)

    return Asked(run, lambda found: np.where(found[1] > 0.5, -1.0, 1.0) * np.sqrt(found[0][0]))


def libigl_signed_call(mesh: TriangleMesh, points: np.ndarray, method: str) -> Asked:
    """``igl.signed_distance``: "PSEUDONORMAL" or "FAST_WINDING_NUMBER"."""
    import igl

    vertices, faces, _ = _libigl_trees(mesh, signs=False)
    kind = getattr(igl, f"SIGNED_DISTANCE_TYPE_{method}")
    return Asked(lambda: igl.signed_distance(points, vertices, faces, kind), lambda found: np.asarray(found[0]))


def libigl_exact_winding(mesh: TriangleMesh, points: np.ndarray) -> np.ndarray:
    """The sum over all triangles: the independent reference for signs on broken meshes."""
    import igl

    return igl.winding_number(np.ascontiguousarray(mesh.vertices), mesh.faces.astype(np.int64), points)


def libigl_build(mesh: TriangleMesh, point: np.ndarray, signs: bool = False) -> Asked:
    vertices, faces, build = _libigl_trees(mesh, signs)

    def run() -> tuple[Any, float]:
        tree, winding = build()
        return tree.squared_distance(vertices, faces, point), winding.winding_number(point, 2.0) if signs else 0.0

    return Asked(run, lambda found: np.where(found[1] > 0.5, -1.0, 1.0) * np.sqrt(found[0][0]))


# point-cloud-utils


def pcu_distance(mesh: TriangleMesh, points: np.ndarray) -> Asked:
    import point_cloud_utils

    faces = np.ascontiguousarray(mesh.faces)
    return Asked(lambda: point_cloud_utils.closest_points_on_mesh(points, mesh.vertices, faces), lambda found: found[0])


def pcu_signed(mesh: TriangleMesh, points: np.ndarray) -> Asked:
    import point_cloud_utils

    faces = np.ascontiguousarray(mesh.faces)
    return Asked(
        lambda: point_cloud_utils.signed_distance_to_mesh(points, mesh.vertices, faces), lambda found: found[0]
    )


def pcu_first_hit(mesh: TriangleMesh, origins: np.ndarray, directions: np.ndarray) -> Asked:
    import point_cloud_utils

    scene = point_cloud_utils.RayMeshIntersector(_single(mesh.vertices), np.ascontiguousarray(mesh.faces))
    origins, directions = _single(origins), _single(directions)
    return Asked(lambda: scene.intersect_rays(origins, directions), lambda found: found[2])


# raw warp


def _warp_builder(mesh: TriangleMesh, device: str, signs: bool = False) -> Callable[[int], Any]:
    import warp as wp

    vertices = wp.array(_single(mesh.vertices), dtype=wp.vec3, device=device)
    faces = wp.array(np.ascontiguousarray(mesh.faces, np.int32).ravel(), dtype=int, device=device)
    return lambda leaf: wp.Mesh(vertices, faces, support_winding_number=signs, bvh_leaf_size=leaf)


def _warp_queries(
    mesh: TriangleMesh, kernel: str, queries: tuple[np.ndarray, ...], kind: Any, device: str, signs: bool = False
) -> Asked:
    import warp as wp

    from benchmarks import raw_kernels

    count, on = len(queries[0]), wp.get_device(device)
    chosen = getattr(raw_kernels, kernel)
    given = [wp.array(_single(values), dtype=wp.vec3, device=on) for values in queries]
    out = wp.empty(count, dtype=kind, device=on)
    build = _warp_builder(mesh, device, signs)

    def ask(tree: Any, number: int) -> None:
        # In slices over all threads, as geokit launches its own.
        launcher.launch(chosen, number, [tree.id, *given], [out], on)
        wp.synchronize_device(on)

    def seconds(tree: Any) -> float:
        ask(tree, min(count, LEAF_TRIAL))
        start = time.perf_counter()
        ask(tree, min(count, LEAF_TRIAL))
        return time.perf_counter() - start

    # One triangle a leaf is best on GPUs, and the default.
    trees = [build(leaf) for leaf in (LEAF_SIZES if on.is_cpu else (1,))]
    tree = min(trees, key=seconds) if len(trees) > 1 else trees[0]

    def run() -> Any:
        ask(tree, count)
        return out

    return Asked(run, lambda found: found.numpy().copy())


def warp_distance(mesh: TriangleMesh, points: np.ndarray, device: str = "cpu") -> Asked:
    import warp as wp

    return _warp_queries(mesh, "raw_closest_slice_kernel", (points,), wp.float32, device)


def warp_signed(mesh: TriangleMesh, points: np.ndarray, method: str, device: str = "cpu") -> Asked:
    """``method``: "normal", "parity" or "winding"."""
    import warp as wp

    kernel = f"raw_signed_{method}_slice_kernel"
    return _warp_queries(mesh, kernel, (points,), wp.float32, device, signs=method == "winding")


def warp_first_hit(mesh: TriangleMesh, origins: np.ndarray, directions: np.ndarray, device: str = "cpu") -> Asked:
    import warp as wp

    return _warp_queries(mesh, "raw_ray_slice_kernel", (origins, directions), wp.float32, device)


def warp_occluded(mesh: TriangleMesh, origins: np.ndarray, directions: np.ndarray, device: str = "cpu") -> Asked:
    import warp as wp

    return _warp_queries(mesh, "raw_occluded_slice_kernel", (origins, directions), wp.bool, device)


def warp_build(mesh: TriangleMesh, point: np.ndarray, signs: bool = False) -> Asked:
    import warp as wp

    from benchmarks import raw_kernels

    build, device = _warp_builder(mesh, "cpu", signs), wp.get_device("cpu")
    kernel = raw_kernels.raw_signed_winding_slice_kernel if signs else raw_kernels.raw_closest_slice_kernel
    query, out = (
        wp.array(_single(point), dtype=wp.vec3, device=device),
        wp.empty(len(point), dtype=float, device=device),
    )

    def run() -> Any:
        tree = build(LEAF_SIZES[0])  # a reference is kept: otherwise the mesh is freed before the launch
        launcher.launch(kernel, len(point), [tree.id, query], [out], device)
        return out

    return Asked(run, lambda found: found.numpy().copy())
