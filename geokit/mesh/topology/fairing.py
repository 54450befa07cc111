"""Patches over holes made fair: points as dense as those around them, and a curvature that goes on evenly."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.mesh.topology.connectivity import Topology, next_half_edge
from geokit.mesh.topology.normals import cross, unit

# A triangle is split where its center is farther from its corners than this share of the edges around them.
DENSITY = 2.0**-0.5
# Triangles of a patch at most: the solver's memory grows faster than they do.
MOST_FACES = 1 << 17
# Rounds of splits and of flips at most; flips of many edges at once may chase each other.
ROUNDS = 50
# Normals and weights are those of the surface before, so it is made so many times: half a sphere takes five.
SOLVES = 6
# Weights of edges, areas at points (all is about 1 wide), sums of cotangents: beyond are those of needles, or rounding.
LIGHTEST, HEAVIEST, LEAST_AREA, FLAT = 1e-3, 50.0, 1e-30, 1e-9


def fair_patches(
    topology: Topology, points: NDArray[np.float64], patch: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Patches with points as dense as around their rims, and a curvature between those at their rims.

    Args:
        topology: The faces around the holes.
        points: Where its positions are, all about 1 wide (P, 3).
        patch: Corners of the patches' triangles (T, 3, 3): the position, what a new point takes from a corner beside
            it, and the hole.
    Returns:
        The corners of other triangles, wound as those were, without holes that would have too many; and all points,
        those of the positions and new ones behind them.
    Source:
        Liepa, Filling holes in meshes (2003), for the points. Schneider and Kobbelt, Geometric fairing of irregular
        meshes for free-form surface design (2001), for the surface. Differs: least squares at the points of rims too.
    """
    ring, fixed = topology.faces[np.isin(topology.faces, patch[..., 0]).any(axis=1)], len(points)
    start, end = ring.reshape(-1), ring[:, (1, 2, 0)].reshape(-1)
    ends, length = np.append(start, end), np.tile(np.linalg.norm(points[start] - points[end], axis=1), 2)
    size = np.bincount(ends, length, fixed) / np.maximum(np.bincount(ends, minlength=fixed), 1)
    for _ in range(SOLVES):
        for _ in range(ROUNDS):
            corners = points[patch[..., 0]]
            reach = np.linalg.norm(corners - corners.mean(axis=1, keepdims=True), axis=2).min(axis=1)
            split = np.flatnonzero(reach > DENSITY * size[patch[..., 0]].max(axis=1))
            if not len(split):
                break
            a, b, c = patch[split].swapaxes(0, 1)
            new = np.column_stack([len(points) + np.arange(len(split)), a[:, 1:]])
            points, size = (np.concatenate([v, v[patch[split, :, 0]].mean(axis=1)]) for v in (points, size))
            parts = (np.stack([*side, new], axis=1) for side in ((a, b), (b, c), (c, a)))
            patch = np.concatenate([np.delete(patch, split, axis=0), *parts])
            few = np.bincount(patch[:, 0, 2]) <= MOST_FACES
            patch = _flipped(patch[few[patch[:, 0, 2]]], ring, points)
        points = _evenly_curved(points, np.concatenate([patch[..., 0], ring]), fixed)
        patch = _flipped(patch, ring, points)
    return patch, points


def _flipped(patch: NDArray[np.int64], ring: NDArray[np.int32], points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Triangles with edges flipped until the two angles opposite of none are more than half a turn."""
    patch, code = patch.copy(), np.array([len(points), 1])
    for _ in range(ROUNDS):
        edges = Topology(np.concatenate([patch[..., 0], ring]).astype(np.int32), len(points))
        one, other = np.stack(edges.pairs)[:, edges.pairs[1] < 3 * len(patch)]
        opposite = (next_half_edge(next_half_edge(side)) for side in (one, other))
        a, b, c, d = (patch.reshape(-1, 3)[at] for at in (one, other, *opposite))
        p, q, r, s = (points[corner[:, 0]] for corner in (a, b, c, d))
        sums = _cotangents(r, p, q) + _cotangents(s, p, q)
        side = edges.order[edges.starts]
        there = np.stack([edges.start[side], edges.start[next_half_edge(side)]]).astype(np.int64)
        there, made = (np.sort(pair, axis=0).T @ code for pair in (there, np.stack([c[:, 0], d[:, 0]])))
        flat = (cross(s - p, r - p) * cross(q - s, r - s)).sum(axis=1) > 0.0
        row = np.flatnonzero((sums < -FLAT) & flat & ~np.isin(made, there))
        # Of the edges of a triangle, and of those that would be one, the one with the largest angles.
        row = row[np.argsort(sums[row], kind="stable")]
        row = row[np.sort(np.unique(made[row], return_index=True)[1])]
        faces, rank, best = np.stack([one, other])[:, row] // 3, np.arange(len(row)), np.full(len(patch), len(row))
        np.minimum.at(best, faces.reshape(-1), np.tile(rank, 2))
        first = (best[faces] == rank).all(axis=0)
        if not first.any():
            break
        for face, corners in zip(faces[:, first], ((a, d, c), (d, b, c)), strict=True):
            patch[face] = np.stack(corners, axis=1)[row[first]]
    return patch


def _evenly_curved(points: NDArray[np.float64], faces: NDArray[np.int64], fixed: int) -> NDArray[np.float64]:
    """The points, those from ``fixed`` on where their Laplacian is nearest to the curvature times the normals given.

    The mean curvature of fixed points is as it is, and harmonic in between.
    """
    sparse, linalg = require_package("scipy.sparse"), require_package("scipy.sparse.linalg")
    edges, every, count = Topology(faces.astype(np.int32), len(points)), np.arange(faces.size), len(points)
    ends = edges.start, edges.start[next_half_edge(every)]
    cotangents = _cotangents(*(points[at] for at in (edges.start[next_half_edge(next_half_edge(every))], *ends)))
    weight = np.clip(np.add.reduceat(cotangents[edges.order], edges.starts) / 2.0, LIGHTEST, HEAVIEST)
    a, b = (end[edges.order[edges.starts]] for end in ends)
    joined = sparse.coo_array((np.tile(weight, 2), (np.append(a, b), np.append(b, a))), (count, count))
    laplacian = (sparse.diags_array(joined.sum(axis=1)) - joined).tocsr()
    p, q, r = points[faces].swapaxes(0, 1)
    normals = cross(q - p, r - p).repeat(3, axis=0)
    area = np.bincount(edges.start, np.linalg.norm(normals, axis=1), count).clip(LEAST_AREA)
    normals = unit(np.stack([np.bincount(edges.start, normals[:, k], count) for k in range(3)], axis=1))
    # At a border there is but a part of a Laplacian.
    whole = np.bincount(edges.start, minlength=count) > 0
    whole[a[edges.uses == 1]] = whole[b[edges.uses == 1]] = False
    row = np.flatnonzero(whole)
    free = row[row >= fixed]
    if not len(free):
        return points
    factors = partial(linalg.splu, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    curvature = ((laplacian @ points) * normals).sum(axis=1) / area
    curvature[~whole | (np.arange(count) >= fixed)] = 0.0
    curvature[free] = -factors(laplacian[free][:, free].tocsc()).solve(laplacian[free] @ curvature)
    found = points.copy()
    found[free] = 0.0
    scaled = sparse.diags_array(area[row] ** -0.5) @ laplacian[row]
    system = scaled[:, free]
    wanted = (curvature * area**0.5)[row, None] * normals[row] - scaled @ found
    found[free] = factors((system.T @ system).tocsc()).solve(system.T @ wanted)
    return found


def _cotangents(at: NDArray[np.float64], one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    area = np.linalg.norm(cross(one - at, other - at), axis=1)
    return ((one - at) * (other - at)).sum(axis=1) / np.maximum(area, np.finfo(float).tiny)
