"""Shapes with known answers and ways to damage them, query points, and judgements: what the sweeps of meshes share."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.trials.model import Judgement, Sweeps, cases_of
from geokit.core import launcher
from geokit.mesh import _primitives
from geokit.mesh.model.triangle_mesh import TriangleMesh

if TYPE_CHECKING:
    from geokit.mesh.surfaces.surface import Surface

# Direction in which meshes are moved: along no axis and no diagonal, of length 1 up to rounding.
OBLIQUE = np.array([2.0, -1.0, 2.0]) / 3.0


def box(
    lower: tuple[float, float, float] = (-0.5, -0.5, -0.5), upper: tuple[float, float, float] = (0.5, 0.5, 0.5)
) -> TriangleMesh:
    """A closed box of 12 triangles between two corners [world]."""
    ends = np.array([lower, upper], np.float64)
    return _primitives.box(ends[1] - ends[0], center=ends.mean(axis=0))


def thin_plate(thickness: float) -> TriangleMesh:
    """A closed plate [-0.5, 0.5]^2 of this thickness about z = 0 [world]."""
    half = 0.5 * thickness
    plate = box((-0.5, -0.5, -half), (0.5, 0.5, half))
    return TriangleMesh(plate.vertices, plate.faces, name="thin_plate")


def icosphere(subdivisions: int = 3, radius: float = 1.0) -> TriangleMesh:
    """A closed sphere of ``20 * 4**subdivisions`` triangles, its vertices ``radius`` [world] from the origin."""
    angle = np.arange(5) * (2.0 * np.pi / 5.0)
    # Corners of an icosahedron standing on a corner: the two rings are at the heights +-1 / sqrt(5).
    rings = [
        np.stack([2.0 * np.cos(angle + turn), 2.0 * np.sin(angle + turn), np.full(5, height)], axis=1)
        for turn, height in ((0.0, 1.0), (np.pi / 5.0, -1.0))
    ]
    vertices = np.concatenate([[[0.0, 0.0, 1.0]], *(ring / np.sqrt(5.0) for ring in rings), [[0.0, 0.0, -1.0]]])
    up, low = np.arange(1, 6), np.arange(6, 11)
    next_up, next_low = np.roll(up, -1), np.roll(low, -1)
    top, bottom = np.zeros(5, int), np.full(5, 11)
    triangles = ((top, up, next_up), (up, low, next_up), (low, next_low, next_up), (bottom, next_low, low))
    faces = np.concatenate([np.stack(corners, axis=1) for corners in triangles])
    for _ in range(subdivisions):
        vertices, faces = _halved_edges(vertices, faces)
        vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return TriangleMesh(vertices * radius, faces, name="icosphere")


def _halved_edges(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> tuple[NDArray, NDArray]:
    """Each triangle split into four at the midpoints of its edges."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, edge = np.unique(edges, axis=0, return_inverse=True)
    middle = len(vertices) + edge.reshape(-1, 3)
    corners = [np.stack([faces[:, k], middle[:, k], middle[:, k - 1]], axis=1) for k in range(3)]
    return np.concatenate([vertices, vertices[unique].mean(axis=1)]), np.concatenate([*corners, middle])


def torus(around: int = 48, across: int = 24, major: float = 1.0, minor: float = 0.35) -> TriangleMesh:
    """A closed torus about the z axis of ``2 * around * across`` triangles, with vertices on the torus [world]."""
    return _primitives.torus(major, minor, segments=around, tube_segments=across)


def sliver_fan(count: int, aspect: float, slant: float = 0.0) -> TriangleMesh:
    """``count`` triangles from the origin to a segment that starts at (1, 0, 0), each ``1 / aspect`` wide in y.

    The mesh is open, in the plane z = 0. Together the slivers form the triangle of the origin, that corner, and the
    other end of the segment at ``(1 - slant, count / aspect, 0)``. The first corner of a face varies among them.
    """
    share = np.arange(count + 1) / count
    ends = np.stack([1.0 - slant * share, count / aspect * share, np.zeros(count + 1)], axis=1)
    second = np.arange(1, count + 1)
    faces = np.stack([np.zeros(count, int), second, second + 1], axis=1)
    for k in range(3):
        faces[k::3] = np.roll(faces[k::3], k, axis=1)
    return TriangleMesh(np.concatenate([np.zeros((1, 3)), ends]), faces, name="sliver_fan")


def without_faces(mesh: TriangleMesh, share: float, seed: int = 0) -> TriangleMesh:
    """The mesh without random faces that make up this share of the area: many small holes."""
    order = np.random.default_rng(seed).permutation(len(mesh.faces))
    return _without_first(mesh, order, share)


def without_cap(mesh: TriangleMesh, share: float) -> TriangleMesh:
    """The mesh without its highest faces, up to this share of the area: one round hole in a sphere."""
    height = mesh.vertices[mesh.faces].mean(axis=1)[:, 2]
    return _without_first(mesh, np.argsort(-height, kind="stable"), share)


def _without_first(mesh: TriangleMesh, order: NDArray[np.int64], share: float) -> TriangleMesh:
    a, b, c = (mesh.vertices[mesh.faces[order, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    removed = order[: int(np.searchsorted(np.cumsum(area), share * area.sum()))]
    return TriangleMesh(mesh.vertices, np.delete(mesh.faces, removed, axis=0), name=mesh.name)


def flipped_faces(mesh: TriangleMesh, share: float, seed: int = 0) -> TriangleMesh:
    """The mesh with this share of its faces, drawn at random, wound the wrong way."""
    chosen = np.random.default_rng(seed).permutation(len(mesh.faces))[: round(share * len(mesh.faces))]
    faces = mesh.faces.copy()
    faces[chosen] = faces[chosen, ::-1]
    return TriangleMesh(mesh.vertices, faces, name=mesh.name)


def copied_faces(mesh: TriangleMesh, share: float, seed: int = 0) -> TriangleMesh:
    """The mesh with this share of its faces, drawn at random, appended a second time."""
    chosen = np.random.default_rng(seed).permutation(len(mesh.faces))[: round(share * len(mesh.faces))]
    return TriangleMesh(mesh.vertices, np.concatenate([mesh.faces, mesh.faces[chosen]]), name=mesh.name)


def join(*meshes: TriangleMesh) -> TriangleMesh:
    """The union of the vertices and faces of all meshes."""
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, first, strict=False)]
    return TriangleMesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces), name=meshes[0].name)


def moved(mesh: TriangleMesh, offset: tuple[float, float, float] | NDArray[np.float64]) -> TriangleMesh:
    """The mesh translated by ``offset`` [world]."""
    return TriangleMesh(mesh.vertices + np.asarray(offset, np.float64), mesh.faces, name=mesh.name)


def scaled(mesh: TriangleMesh, factor: float) -> TriangleMesh:
    """The mesh scaled by ``factor`` about the origin."""
    return TriangleMesh(mesh.vertices * factor, mesh.faces, name=mesh.name)


def rotated(mesh: TriangleMesh, seed: int) -> TriangleMesh:
    """The mesh rotated by :func:`rotation` about the origin."""
    return TriangleMesh(mesh.vertices @ rotation(seed).T, mesh.faces, name=mesh.name)


def rotation(seed: int) -> NDArray[np.float64]:
    """A random rotation matrix (3, 3), so that nothing stays aligned with the axes."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def sphere_distance(points: NDArray[np.float64], radius: float = 1.0) -> NDArray[np.float64]:
    """Signed distance (N,) to the true sphere about the origin, negative inside [world]."""
    return np.linalg.norm(points, axis=1) - radius


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
    return bool(launcher.resolve_device(device).is_cuda)


def surface_of(mesh: TriangleMesh, device: Any) -> Surface:
    """The mesh prepared for queries."""
    from geokit.mesh.surfaces.surface import Surface

    return Surface(mesh, device=device)
