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

# Rounds end when one takes less than this share of the faces.
ROUND_GAIN = 0.03
# Edges of a part that one launch tries: between launches Ctrl-C is answered.
STEPS = 1 << 11
# Faces of a part.
PART = 1 << 14
# Parts of a mesh that is to have a number of faces are one again before the last ones go, as a share of that number.
LAST = 0.15


def collapsed(
    mesh: TriangleMesh,
    limit: NDArray[np.float64] | float,
    face_count: int,
    *,
    fixed: NDArray[np.bool_] | None = None,
    tell: Callable[[int], None] | None = None,
) -> tuple[TriangleMesh, NDArray[np.int64]]:
    """Collapse edges until none keeps the limit or ``face_count`` faces are left.

    The limit is held at points: vertices and middles of faces of the input against the new faces around an edge, and
    points of these against faces of the input. Elsewhere the distance may be larger.

    Args:
        mesh: About unit-sized and near the origin; one vertex for each position.
        limit: Distance, also one around each face (F,); inf for none.
        face_count: Wanted number of faces.
        fixed: Whether each vertex stays as it is (V,).
        tell: Called with the number of faces that are left, many times.
    Returns:
        TriangleMesh without unused vertices, with the topology of the input, and the face of the input that each of its
        faces was. Corners of flat sides keep their bits.
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
    stays = np.zeros(vertices, np.bool_) if fixed is None else fixed
    hold(fixed=stays.copy())
    hold(error=np.empty(vertices), partner=np.empty(vertices, np.int32))
    hold(tried=np.empty(vertices), tried_partner=np.full(vertices, -1, np.int32))
    sample, sample_face = np.empty((0, 3)), corner[:0]
    limited = np.ndim(limit) > 0 or math.isfinite(limit)
    hold(limit=np.broadcast_to(np.square(limit), faces if limited else 0))
    if limited:
        # Vertices and middles of faces, each with one of its faces.
        used = np.flatnonzero(first_corner >= 0)
        sample = np.concatenate([mesh.vertices[used], mesh.vertices[mesh.faces].mean(axis=1)])
        sample_face = np.concatenate([first_corner[used] // 3, np.arange(faces, dtype=np.int32)])
    first_sample, next_sample = _lists(sample_face, faces)
    hold(sample=sample, sample_face=sample_face, first_sample=first_sample, next_sample=next_sample)
    hold(input_position=mesh.vertices, input_face=corner)
    hold(heap=np.empty(vertices, np.int32), heap_place=np.empty(vertices, np.int32))
    left, before, turn, size = faces, math.inf, 0, PART
    # Each round has quadrics of the faces that are left: the edges that the last one stopped at may cost less now, and
    # those between two parts lie within one.
    while left > face_count:
        ends = left > (1.0 - ROUND_GAIN) * before
        if ends and (limited or size == faces):
            break
        if not limited and (ends or left < (1.0 + LAST) * face_count):
            size = faces
        before = left
        part, sizes = _parts(kept["position"], kept["face"], size, turn % 2 == 1)
        np.logical_or(stays, part < 0, out=kept["fixed"])
        begin = np.cumsum([0, *np.bincount(part[part >= 0], minlength=len(sizes))])
        kept["quadric"][:] = 0.0
        kept["tried"][:] = -1.0
        launcher.launch(kernels.prepare_kernel, vertices, [], [state], device)
        launcher.launch(kernels.choose_kernel, vertices, [], [state], device)
        # Sorted is one way to be a heap.
        order = np.flatnonzero((part >= 0) & (kept["partner"] >= 0))
        order = order[np.lexsort([kept["error"][order], part[order]])]
        waiting = np.bincount(part[order], minlength=len(sizes))
        place = np.arange(len(order)) - np.repeat(np.cumsum(waiting) - waiting, waiting)
        kept["heap"][begin[part[order]] + place] = order
        kept["heap_place"][:] = -1
        kept["heap_place"][order] = place
        hold(heap_begin=begin[:-1].astype(np.int32))
        shared = not limited and len(sizes) > 1
        wanted = np.maximum(-(-sizes * face_count // left), sizes // 2 * (len(sizes) > 1))
        hold(count=np.stack([waiting, sizes, wanted, waiting * (not shared)], axis=1).astype(np.int32).reshape(-1))
        count = kept["count"].reshape(-1, 4).T
        worst = last = math.inf
        while True:
            if not count[3].any():
                rows = np.flatnonzero(kept["heap_place"] >= 0)
                some = min((left - face_count) // 2, len(rows) // 2)
                if not shared or not some or left < (1.0 + LAST) * face_count or left > (1.0 - ROUND_GAIN) * last:
                    break
                # Each part loses those of its edges that would go next if the parts were one.
                worst, last = float(np.partition(kept["error"][rows], some)[some]), left
                share = np.bincount(part[rows[kept["error"][rows] <= worst]], minlength=len(sizes))
                count[2] = np.maximum(count[1] - 2 * (share * some // share.sum()), sizes // 2)
            launcher.launch(kernels.collapse_kernel, len(sizes), [STEPS, worst], [state], device, grain=1)
            left = int(count[1].sum())
            if tell:
                tell(left)
        turn += 1
    source = np.flatnonzero(kept["face"][::3] >= 0)
    used, at = np.unique(kept["face"].reshape(-1, 3)[source], return_inverse=True)
    return TriangleMesh(kept["position"][used], at.reshape(-1, 3).astype(np.int32)), source


def _parts(
    position: NDArray[np.float64], face: NDArray[np.int32], size: int, shifted: bool
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The part of each vertex, -1 for those of several parts and of none (V,), and the faces of each part.

    Parts are neighbors along a Morton curve; shifted by half, most borders lie within parts.
    """
    corners = face.reshape(-1, 3)
    corners = corners[corners[:, 0] >= 0]
    part = np.full(len(position), -1)
    if len(corners) < 2 * size:
        part[corners] = 0
        return part, np.array([len(corners)])
    place = position[corners[:, 0]]
    low = place.min(axis=0)
    device = launcher.resolve_device("cpu")
    order = launcher.morton_order(HostArray(place).warp, low, float((place.max(axis=0) - low).max()), device)
    of_face = np.empty(len(corners), np.int64)
    of_face[order.numpy()[: len(corners)]] = (np.arange(len(corners)) + size // 2 * shifted) // size
    at_corner = of_face.repeat(3)
    part[corners.reshape(-1)] = at_corner
    part[corners.reshape(-1)[part[corners.reshape(-1)] != at_corner]] = -1
    return part, np.bincount(of_face)


def _lists(owner: NDArray[Any], count: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """The first item of each owner and the next item of each item; -1 ends a list."""
    order = np.argsort(owner, kind="stable").astype(np.int32)
    same = owner[order[1:]] == owner[order[:-1]]
    first, following = np.full(count, -1, np.int32), np.full(len(owner), -1, np.int32)
    start = order[np.concatenate([[True], ~same])] if len(order) else order
    first[owner[start]] = start
    following[order[:-1][same]] = order[1:][same]
    return first, following
