"""Meshes whose arrays stay on the device that made them until they are first read."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.forks import Lock
from geokit.core.base.late_warp import wp
from geokit.core.download import download
from geokit.core.memory.pinned import host_arrays
from geokit.mesh.model.triangle_mesh import TriangleMesh

# Boxes after each round of the reduction: enough to fill a GPU, then few enough for the host.
ROUNDS = 1 << 16, 1 << 8


class DeviceArrays:
    """The arrays of a mesh on a device, in place of NumPy arrays.

    Args:
        vertices: Positions [world], (V,) of vec3d, finite, each used by a face.
        faces: Vertex indices, (3 F,) of int32.
    """

    __slots__ = ("faces", "lock", "vertices")

    def __init__(self, vertices: "wp.array", faces: "wp.array") -> None:
        self.vertices, self.faces, self.lock = vertices, faces, Lock()

    def download(self) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Vertices (V, 3) and faces (F, 3) on the host."""
        vertices, faces = (array.reshape(-1, 3) for array in download(self.vertices, self.faces))
        return vertices, faces

    def bounds(self) -> NDArray[np.float64]:
        """Bounding box of the vertices, shape (2, 3); NaN for a mesh without faces."""
        if len(self.faces) == 0:
            return np.full((2, 3), np.nan)
        if self.vertices.device.is_cuda:
            return box_of(self.vertices)
        axes = self.vertices.numpy().T
        return np.array([[axis.min() for axis in axes], [axis.max() for axis in axes]])


def box_of(points: "wp.array") -> NDArray[np.float64]:
    """Bounding box of points, (N,) of vec3d with N at least 1, as shape (2, 3); minimum and maximum need no order."""
    from geokit.core.frame_kernels import boxes_kernel

    device = points.device
    many, few = (min(most, len(points)) for most in ROUNDS)
    boxes = [wp.empty(many, dtype=wp.vec3d, device=device) for _ in range(2)]
    launcher.launch(boxes_kernel, many, [many, points, points], boxes, device)
    found = host_arrays(device, *[((few, 3), np.float64)] * 2)
    launcher.launch(boxes_kernel, few, [few, *boxes], found, device)
    lower, upper = (box.numpy() for box in found)
    return np.stack([lower.min(axis=0), upper.max(axis=0)])


def mesh_on_device(vertices: "wp.array", faces: "wp.array", name: str, **said: Any) -> TriangleMesh:
    """A mesh over arrays on a device, which must not be written to afterwards.

    Args:
        vertices: Positions [world], (V,) of vec3d, finite, each used by a face.
        faces: Vertex indices, (3 F,) of int32.
        name: The mesh's name.
        said: ``meters_per_unit`` and ``up_axis``, where they are known.
    """
    mesh = TriangleMesh.__new__(TriangleMesh)
    mesh.__dict__.update(name=name, parts=(), _on_device=DeviceArrays(vertices, faces), **said)
    return mesh


def arrays_on(mesh: TriangleMesh, device: "wp.Device") -> tuple["wp.array", "wp.array"]:
    """Vertices, (V,) of vec3d, and faces, (3 F,) of int32, on a device: the mesh's own arrays if they are there."""
    held = mesh._on_device
    if held is not None and held.vertices.device == device:
        return held.vertices, held.faces
    vertices = wp.array(mesh.vertices, dtype=wp.vec3d, device=device)
    return vertices, wp.array(mesh.faces.reshape(-1), dtype=wp.int32, device=device)


def vertices_near(mesh: TriangleMesh, device: Any) -> Any:
    """The vertices for a query on a device: a warp array if they are still there, else a NumPy array."""
    held = mesh._on_device
    return mesh.vertices if held is None or held.vertices.device != launcher.resolve_device(device) else held.vertices
