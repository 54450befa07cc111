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

# Rounds end when one takes less than this share of the faces.
ROUND_GAIN = 0.03
# Edges of a part that one launch tries: between launches Ctrl-C is answered.
STEPS = 1 << 11
# Faces of a part.
PART = 1 << 14
# Trials begin after rounds that took this share of the faces if so many more followed: errors are about a quarter of
# the limit then. That is so unless a limit is below a share of the largest one.
HALVED, LATE, EARLY = 0.45, 2, 0.3
# What collapses change.
CHANGED = ("position", "face", "first_corner", "next_corner", "first_sample", "next_sample")
# Parts of a mesh that is to have a number of faces are one again before the last ones go, as a share of that number.
LAST = 0.15


class Past:
    """What a trial did: the next one repeats it where the limit is the same or still kept."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self.limit = np.zeros(len(mesh.faces))
        # The vertex that each became, and where. Of each round those that went, where each part begins, and its length.
        self.into, self.new_place = np.arange(len(mesh.vertices), dtype=np.int32), np.empty(mesh.vertices.shape)
        self.rounds: list[tuple[NDArray[np.int32], ...]] = []
        # The mesh after each of the rounds that halve it, and how many rounds these were.
        self.early: list[tuple[dict[str, NDArray[Any]], int]] = []


def collapsed(
    mesh: TriangleMesh,
    limit: NDArray[np.float64] | float,
    face_count: int,
    *,
    fixed: NDArray[np.bool_] | None = None,
    past: Past | None = None,
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
        past: The last trial with this mesh, with no lower limit and nothing fixed that is not now; it becomes this one.
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

    corner, limited = mesh.faces.reshape(-1), np.ndim(limit) > 0 or math.isfinite(limit)
    limits = np.array(np.broadcast_to(limit, faces if limited else 0))
    # What is fixed later may have gone in an early round.
    is_first, past = past is not None and not past.rounds and fixed is None, past or Past(mesh)
    stays = np.zeros(vertices, np.bool_) if fixed is None else fixed
    if past.early[LATE:] and limited and limits.min() > EARLY * limits.max():
        arrays, repeated = past.early[-1 - LATE]
        hold(**(arrays | {name: arrays[name].copy() for name in CHANGED}))
    else:
        past.early, repeated = [], 0
        first_corner, next_corner = _lists(corner, vertices)
        hold(position=mesh.vertices.copy(), face=corner.copy(), first_corner=first_corner, next_corner=next_corner)
        sample, sample_face = np.empty((0, 3)), corner[:0]
        if limited:
            # Vertices and middles of faces, each with one of its faces.
            used = np.flatnonzero(first_corner >= 0)
            sample = np.concatenate([mesh.vertices[used], mesh.vertices[mesh.faces].mean(axis=1)])
            sample_face = np.concatenate([first_corner[used] // 3, np.arange(faces, dtype=np.int32)])
        first_sample, next_sample = _lists(sample_face, faces)
        hold(sample=sample, sample_face=sample_face, first_sample=first_sample, next_sample=next_sample)
    hold(quadric=np.empty(10 * vertices), locked=np.zeros(vertices, np.int32))
    hold(fixed=stays.copy())
    hold(error=np.empty(vertices), partner=np.empty(vertices, np.int32))
    hold(tried=np.empty(vertices), tried_partner=np.full(vertices, -1, np.int32))
    hold(input_position=mesh.vertices, input_face=corner)
    hold(heap=np.empty(vertices, np.int32), heap_place=np.empty(vertices, np.int32))
    changed, became = np.zeros(vertices, np.int32), past.into
    hold(into=past.into, new_place=past.new_place, changed=changed, limit=np.square(limits))
    if past.rounds:
        # Of two vertices the one of higher number goes.
        while (became[became] != became).any():
            became = became[became]
        if limited:
            changed[np.isin(became, became[mesh.faces[limits < past.limit]])] = kernels.WATCHED
        changed[stays] = kernels.SKIPPED
    past.limit = limits

    def counts(log: NDArray[np.int32], begin: NDArray[np.int32]) -> NDArray[np.int32]:
        hold(log=log, heap_begin=begin, count=np.zeros(kernels.COUNTS * len(begin), np.int32))
        return kept["count"].reshape(-1, kernels.COUNTS).T

    for number, (log, begin, again) in enumerate(past.rounds[repeated:], repeated):
        count = counts(log, begin)
        count[3] = count[5] = again
        while count[3].any():
            launcher.launch(kernels.collapse_kernel, len(begin), [STEPS, 0.0], [state], device, grain=1)
        past.rounds[number] = log, begin, count[4]
    if past.rounds:
        # All others were tried in vain, and nothing around them is different.
        corners = kept["face"].reshape(-1, 3)
        awake = np.zeros(vertices, np.bool_)
        awake[corners[(corners[:, 0] >= 0) & (changed[corners] == kernels.SKIPPED).any(axis=1)]] = True
        stays = stays | ~awake
    left, gained, turn, size = int((kept["face"][::3] >= 0).sum()), 1.0, 0, PART
    # Each round has quadrics of the faces that are left: the edges that the last one stopped at may cost less now, and
    # those between two parts lie within one.
    while left > face_count:
        if gained < ROUND_GAIN and (limited or size == faces):
            break
        size = PART if limited or (gained > ROUND_GAIN and left > (1.0 + LAST) * face_count) else faces
        part, sizes = _parts(kept["position"], kept["face"], stays, size, turn % 2 == 1)
        before, tried = left, max(int(sizes.sum()), 1)
        np.logical_or(stays, part < 0, out=kept["fixed"])
        begin = np.cumsum([0, *np.bincount(part[part >= 0], minlength=len(sizes))], dtype=np.int32)
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
        shared = not limited and len(sizes) > 1
        wanted = np.maximum(sizes - (left - face_count) * sizes // tried, sizes // 2 * (len(sizes) > 1))
        count = counts(np.empty(begin[-1], np.int32), begin[:-1])
        count[:4] = waiting, sizes, wanted, waiting * (not shared)
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
            left = before - int((sizes - count[1]).sum())
            if tell:
                tell(left)
        past.rounds.append((kept["log"], begin[:-1], count[4]))
        gained = (before - left) / tried
        turn += 1
        if is_first and gained > HALVED and len(sizes) > 1:
            past.early.append((kept | {name: kept[name].copy() for name in CHANGED}, turn))
    source = np.flatnonzero(kept["face"][::3] >= 0)
    used, at = np.unique(kept["face"].reshape(-1, 3)[source], return_inverse=True)
    return TriangleMesh(kept["position"][used], at.reshape(-1, 3).astype(np.int32)), source


def _parts(
    position: NDArray[np.float64], face: NDArray[np.int32], stays: NDArray[np.bool_], size: int, shifted: bool
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The part of each vertex, -1 for those of several parts and of none (V,), and the faces of each part.

    Faces of which all corners stay are in none. Parts are neighbors along a Morton curve; shifted by half, most borders
    lie within parts.
    """
    corners = face.reshape(-1, 3)
    corners = corners[(corners[:, 0] >= 0) & ~stays[corners].all(axis=1)]
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
