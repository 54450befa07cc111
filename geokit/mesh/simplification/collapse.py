"""Collapse edges of least quadric error, each only where the surface stays within a distance of the input."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.memory.host_array import HostArray
from geokit.mesh.model.triangle_mesh import TriangleMesh

__all__ = ["collapsed"]

# Points at which a face of the input and a new face are looked at: those whose barycentric weights are multiples of one
# divided by these numbers, coarse and fine. Each point costs time, and few of the coarse ones miss anything.
INPUT_LATTICE = 1, 4
NEW_LATTICE = 3, 6
# Most points of the input, unless the coarse ones alone are more.
MOST_SAMPLES = 200_000
# Rounds end when one takes less than this share of the faces.
ROUND_GAIN = 0.03
# Edges that one launch tries: between launches Ctrl-C is answered.
STEPS = 1 << 14


def collapsed(
    mesh: TriangleMesh,
    limit: float,
    face_count: int,
    *,
    fixed: NDArray[np.bool_] | None = None,
    fine: bool = False,
    tell: Callable[[int], None] | None = None,
) -> TriangleMesh:
    """Collapse edges until none keeps the limit or ``face_count`` faces are left.

    The limit is held at points: vertices and other points of the input against the new faces around an edge, and points
    of these against faces of the input. Elsewhere the distance may be larger.

    Args:
        mesh: About unit-sized and near the origin; one vertex for each position.
        limit: Distance; inf for none.
        face_count: Wanted number of faces.
        fixed: Whether each vertex stays as it is (V,).
        fine: Whether to look at more points, which takes several times as long.
        tell: Called with the number of faces that are left, many times.
    Returns:
        TriangleMesh without unused vertices, with the topology of the input. Corners of flat sides keep their bits.
    Source:
        Garland and Heckbert, "Surface simplification using quadric error metrics" (1997). Differs: an edge that would
        pass the limit, flip a face or change the topology (link condition) is left out, and tried again when the faces
        around it have changed; vertices that are not manifold stay.
    """
    from geokit.mesh.simplification import collapse_cpu_kernels as kernels

    device = launcher.resolve_device("cpu")
    vertices, faces = len(mesh.vertices), len(mesh.faces)
    state: Any = kernels.Decimation()
    kept: dict[str, NDArray[Any]] = {}

    def hold(**arrays: NDArray[Any]) -> None:
        for name, values in arrays.items():
            kept[name] = np.ascontiguousarray(values)
            setattr(state, name, HostArray(kept[name]).warp)

    corner = mesh.faces.reshape(-1)
    first_corner, next_corner = _lists(corner, vertices)
    hold(position=mesh.vertices.copy(), face=corner.copy(), first_corner=first_corner, next_corner=next_corner)
    hold(quadric=np.empty(10 * vertices), locked=np.zeros(vertices, np.int32))
    hold(fixed=np.zeros(vertices, np.bool_) if fixed is None else fixed)
    hold(error=np.empty(vertices), partner=np.empty(vertices, np.int32))
    hold(tried=np.empty(vertices), tried_partner=np.full(vertices, -1, np.int32))
    sample, sample_face = np.empty((0, 3)), corner[:0]
    if math.isfinite(limit):
        sample, sample_face = _samples(mesh, first_corner, INPUT_LATTICE[fine])
    first_sample, next_sample = _lists(sample_face, faces)
    hold(sample=sample, sample_face=sample_face, first_sample=first_sample, next_sample=next_sample)
    hold(input_position=mesh.vertices, input_face=corner)
    state.limit, state.lattice = limit, NEW_LATTICE[fine]
    hold(heap=np.empty(vertices, np.int32), heap_place=np.empty(vertices, np.int32))
    hold(count=np.array([0, faces], np.int32))
    count, before = kept["count"], math.inf
    # Each round has quadrics of the faces that are left: the edges that the last one stopped at may cost less now.
    while count[1] > face_count and count[1] < (1.0 - ROUND_GAIN) * before:
        before = count[1]
        kept["quadric"][:] = 0.0
        kept["tried"][:] = -1.0
        launcher.launch(kernels.prepare_kernel, vertices, [], [state], device)
        launcher.launch(kernels.choose_kernel, vertices, [], [state], device)
        # Sorted is one way to be a heap.
        order = np.argsort(kept["error"], kind="stable").astype(np.int32)
        order = order[kept["partner"][order] >= 0]
        kept["heap"][: len(order)] = order
        kept["heap_place"][:] = -1
        kept["heap_place"][order] = np.arange(len(order), dtype=np.int32)
        count[0] = len(order)
        while count[0] and count[1] > face_count:
            launcher.launch(kernels.collapse_kernel, 1, [face_count, STEPS], [state], device)
            if tell:
                tell(int(count[1]))
    left = kept["face"].reshape(-1, 3)
    used, at = np.unique(left[left[:, 0] >= 0], return_inverse=True)
    return TriangleMesh(kept["position"][used], at.reshape(-1, 3).astype(np.int32))


def _lists(owner: NDArray[Any], count: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """The first item of each owner and the next item of each item; -1 ends a list."""
    order = np.argsort(owner, kind="stable").astype(np.int32)
    same = owner[order[1:]] == owner[order[:-1]]
    first, following = np.full(count, -1, np.int32), np.full(len(owner), -1, np.int32)
    start = order[np.concatenate([[True], ~same])] if len(order) else order
    first[owner[start]] = start
    following[order[:-1][same]] = order[1:][same]
    return first, following


def _samples(
    mesh: TriangleMesh, first_corner: NDArray[np.int32], lattice: int
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Vertices, middles of faces and points of a lattice, each with one of its faces."""
    used = np.flatnonzero(first_corner >= 0)
    corners, face = mesh.vertices[mesh.faces], np.arange(len(mesh.faces), dtype=np.int32)
    points, owner = [mesh.vertices[used], corners.mean(axis=1)], [first_corner[used] // 3, face]
    # Half of the lattice's square are points of one face alone.
    while lattice > 1 and lattice * lattice * len(face) > 2 * MOST_SAMPLES:
        lattice -= 1
    for i in range(lattice):
        for j in range(1, lattice - i + (i > 0)):
            k = lattice - i - j
            # Points of an edge belong to the face that has it from the lower vertex to the higher one.
            own = mesh.faces[:, 1] < mesh.faces[:, 2] if i == 0 else slice(None)
            own = mesh.faces[:, 0] < mesh.faces[:, 1] if k == 0 else own
            points.append(np.einsum("fvk,v->fk", corners[own], np.array([i, j, k]) / lattice))
            owner.append(face[own])
    return np.concatenate(points), np.concatenate(owner)
