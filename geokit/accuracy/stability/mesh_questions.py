"""Helpers shared by the sweeps of meshes: query points, rotations, judgements, and the sweeps of size."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.stability.shapes import rotation, scaled
from geokit.accuracy.trials.model import Judgement, Sweeps, cases_of
from geokit.mesh.model.triangle_mesh import TriangleMesh

if TYPE_CHECKING:
    from geokit.mesh.surfaces.surface import Surface

__all__ = [
    "OBLIQUE",
    "around_and_near",
    "judged",
    "on_gpu",
    "powers",
    "size_sweeps",
    "surface_of",
    "turned",
    "unit_sized",
]

# Direction in which meshes are moved: along no axis and no diagonal, of length 1 up to rounding.
OBLIQUE = np.array([2.0, -1.0, 2.0]) / 3.0


def powers(first: int, last: int, step: int = 1) -> tuple[float, ...]:
    """Powers of ten, with both ends if the step reaches the last."""
    return tuple(float(f"1e{k}") for k in range(first, last + (1 if step > 0 else -1), step))


def size_sweeps(
    sweeps: Sweeps, name: str, method: str, large: tuple[float, ...], small: tuple[float, ...], subject: str
) -> Callable[[Callable[..., Judgement]], Callable[..., Judgement]]:
    """Decorator that adds sweeps towards large and small meshes; what ``subject`` names keeps its digits up to 1e70."""
    ends = (("large", large, 1e70, "up to 1e70"), ("small", small, 1e-70, "down to 1e-70"))
    return sweeps.add(
        method,
        "sizes of the mesh",
        f"{name}_{{end}}",
        "size of the mesh [world]",
        cases=cases_of("end values last reach", *ends),
        error=1e-14,
        statement=f"{subject} an error of at most 1e-14 of the mesh's size for sizes {{reach}}.",
    )


def judged(errors: Any, wrong: Any, positions: NDArray[np.float64] | None = None) -> Judgement:
    """A Judgement with errors where answers are right in kind; NaN counts as an infinite error, one number for all."""
    numbers, missed = np.broadcast_arrays(np.nan_to_num(np.abs(errors), nan=np.inf, posinf=np.inf), wrong)
    return Judgement(np.where(missed, 0.0, numbers), missed.copy(), positions)


def unit_sized(mesh: TriangleMesh) -> TriangleMesh:
    """The mesh scaled to a bounding box of diagonal 1, so that errors are shares of its size."""
    return scaled(mesh, 1.0 / mesh.diagonal)


def around_and_near(mesh: TriangleMesh, count: int, seed: int) -> NDArray[np.float64]:
    """Points, half of them in twice the bounding box, half at 1e-3 of the size from the surface."""
    rng = np.random.default_rng(seed)
    lower, upper = mesh.bounds
    around = lower + (2.0 * rng.random((count - count // 2, 3)) - 0.5) * (upper - lower)
    weights = rng.dirichlet(np.ones(3), count // 2)
    corners = mesh.vertices[mesh.faces[rng.integers(len(mesh.faces), size=count // 2)]]
    near = np.einsum("nk,nkd->nd", weights, corners) + rng.normal(size=(count // 2, 3)) * 1e-3 * mesh.diagonal
    return np.concatenate([around, near])


def turned(points: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Points rotated as by :func:`geokit.accuracy.stability.shapes.rotated`."""
    return points @ rotation(seed).T


def on_gpu(device: Any) -> bool:
    """Whether queries run on a GPU, where some envelopes are narrower."""
    from geokit.core import launcher

    return bool(launcher.resolve_device(device).is_cuda)


def surface_of(mesh: TriangleMesh, device: Any) -> Surface:
    """The mesh prepared for queries."""
    from geokit.mesh.surfaces.surface import Surface

    return Surface(mesh, device=device)
