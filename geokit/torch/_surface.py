"""Meshes whose vertices are a tensor: queries and samples carry gradients with respect to them."""

from __future__ import annotations

from typing import Any

import torch

from geokit import mesh
from geokit.core.blocks.several_devices import shows_arguments
from geokit.core.gradients.rules import hold, split
from geokit.core.gradients.with_torch import LIBRARY
from geokit.core.interop.types import Device, Rows
from geokit.core.require import require_instance, require_memory
from geokit.errors import InputError


@shows_arguments
class Surface(mesh.Surface):
    """A mesh prepared for queries, whose answers carry gradients with respect to its vertices.

    All queries are those of :class:`geokit.mesh.Surface`. Closest points, signed distances, first hits and winding
    numbers carry gradients; answers are tensors then, also for NumPy queries. :meth:`update` takes the next vertices.

    Args:
        vertices: Positions [world], a tensor (V, 3) of float32 or float64.
        faces: Three vertices of each face, whole numbers (F, 3).
        device: Where queries run; None for the device of ``vertices``.
    Raises:
        InputError: ``vertices`` is no tensor of float32 or float64, or the arrays do not make a mesh.
        DeviceMemoryError: The device cannot hold the mesh.
    Example:
        >>> vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], requires_grad=True)
        >>> surface = gk.torch.Surface(vertices, [[0, 1, 2]])
        >>> surface.closest_point(torch.tensor([[0.25, 0.25, 2.0]])).distance.sum().backward()
        >>> vertices.grad[:, 2]
        tensor([-0.5000, -0.2500, -0.2500])
    """

    def __init__(self, vertices: torch.Tensor, faces: Rows, *, device: Device = None) -> None:
        _require_tensor(vertices, "take geokit.mesh.Surface for other arrays")
        plain, tracked = split(vertices)
        super().__init__(_mesh(plain, faces), device=str(plain.device) if device is None else device)
        if tracked is not None:
            hold(self, vertices=tracked)

    def __reduce__(self) -> Any:
        return mesh.Surface, (self.mesh,)


def sample_surface(
    vertices: torch.Tensor,
    faces: Rows,
    count: int | None = None,
    *,
    method: str = "uniform",
    radius: float | None = None,
    seed: int = 0,
) -> mesh.SurfaceSamples:
    """Random points on a mesh, which move with its vertices: :func:`geokit.mesh.sample_surface` with gradients.

    Triangles and barycentric weights are constants; a point is the weighted sum of its triangle's corners.

    Args:
        vertices: Positions [world], a tensor (V, 3) of float32 or float64.
        faces: Three vertices of each face, whole numbers (F, 3).
        count, method, radius, seed: As in :func:`geokit.mesh.sample_surface`.
    Returns:
        SurfaceSamples with tensors: points (N, 3) [world] in the precision of ``vertices``, triangle_id (N,),
        barycentric (N, 3); radius.
    Raises:
        InputError: ``vertices`` is no tensor of float32 or float64, or as :func:`geokit.mesh.sample_surface`.
    """
    _require_tensor(vertices, "take geokit.mesh.sample_surface for other arrays")
    made = _mesh(vertices.detach(), faces)
    found = mesh.sample_surface(made, count, method=method, radius=radius, seed=seed)
    triangle_id: Any = torch.tensor(found.triangle_id, device=vertices.device)
    weights: Any = torch.tensor(found.barycentric, device=vertices.device)
    corners = torch.tensor(made.faces, device=vertices.device)[triangle_id.long()].long()
    points = (LIBRARY.take(vertices.double(), corners) * weights[..., None]).sum(1).to(vertices.dtype)
    return mesh.SurfaceSamples(points, triangle_id, weights, found.radius)


def _require_tensor(vertices: Any, remedy: str) -> None:
    require_instance(vertices, "vertices", torch.Tensor, remedy)
    if vertices.dtype not in (torch.float32, torch.float64):
        raise InputError(f"vertices: {vertices.dtype} has no gradients here; give float32 or float64")


def _mesh(vertices: Any, faces: Any) -> mesh.TriangleMesh:
    plain = _on_host(faces, "faces") if isinstance(faces, torch.Tensor) else faces
    return mesh.TriangleMesh(_on_host(vertices, "vertices"), plain)


def _on_host(values: torch.Tensor, name: str) -> Any:
    try:
        require_memory(values)
        return values.numpy(force=True)
    except (RuntimeError, TypeError, ValueError) as error:
        raise InputError(f"{name}: the tensor cannot be read ({error}); give a dense one with memory") from error
