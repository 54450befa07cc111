"""Angle-weighted pseudonormals of faces, edges and vertices, which tell inside from outside."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory.host_array import HostArray
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.topology.connectivity import MeshTopology


def pseudonormal_tables(
    mesh: TriangleMesh, topology: MeshTopology, flipped: NDArray[np.bool_], vertices: "wp.array", faces: "wp.array"
) -> Any:
    """The :class:`Pseudonormals` of a surface.

    Args:
        mesh: The mesh.
        topology: Its connectivity.
        flipped: Faces that count as flipped, (F,) bool.
        vertices: Its vertices on the target device, (V,) of vec3d.
        faces: Its faces on the target device, (3 F,) of int32.
    Source:
        Baerentzen, Aanaes, "Signed Distance Computation Using the Angle Weighted Pseudonormal" (2005).
    """
    from geokit.mesh.sign.pseudonormals_kernels import Pseudonormals

    device = vertices.device

    def on_device(values: NDArray[Any], dtype: Any) -> "wp.array":
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

    corners, position_count = topology.corners, topology.position_count
    normals = _vertex_normals(mesh, flipped, corners, position_count)
    tables = Pseudonormals()
    tables.vertices = vertices
    tables.faces = faces
    tables.flipped = on_device(flipped, wp.bool)
    tables.across = on_device(_across(topology), wp.int32)
    tables.corner_normal = on_device(corners.ravel(), wp.int32)
    tables.vertex_normals = on_device(normals, wp.vec3d)
    return tables


def _across(topology: MeshTopology) -> NDArray[np.int64]:
    """The triangle across each half-edge, (3 F,); -1 if there is none, or more than one."""
    twin = topology.edges.twin
    if not topology.collapsed.any():
        return np.where(twin < 0, -1, twin // 3)
    kept = np.flatnonzero(~topology.collapsed)
    across = np.full(topology.corners.shape, -1, np.int64)
    across[kept] = np.where(twin < 0, -1, kept[twin // 3]).reshape(-1, 3)
    return across.ravel()


def _vertex_normals(
    mesh: TriangleMesh, flipped: NDArray[np.bool_], corners: NDArray[np.int32], position_count: int
) -> NDArray[np.float64]:
    """Vertex normals, computed on the host in the order of the corners, so that all devices get the same bits."""
    from geokit.mesh.sign.pseudonormals_kernels import corner_normals_kernel

    host = wp.get_device("cpu")
    weighted = np.empty((len(mesh.faces) * 3, 3))
    inputs = [HostArray(mesh.vertices), HostArray(mesh.faces.reshape(-1)), HostArray(flipped)]
    launcher.launch(corner_normals_kernel, len(mesh.faces), inputs, [HostArray(weighted)], host)
    at = corners.ravel()
    return np.stack([np.bincount(at, weighted[:, axis], minlength=position_count) for axis in range(3)], axis=1)
