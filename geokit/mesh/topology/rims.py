"""Rims: edges of a mesh that only one face has, one after another around each hole; triangles between their points."""

from __future__ import annotations

from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.mesh.topology.connectivity import Topology, next_half_edge

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
# Rims with more sides lose ears first: the time for the least area goes with the third power of the sides.
MOST_SIDES = 256
# What a triangle costs that is no higher than its corners are rounded: it may point anywhere, so there are as few as
# can be, and those of a straight side reach into the hole.
THIN = 10.0
# An ear does not fold back onto what lies beside it: the cosine between their normals is above the first of these;
# where all do, as at the rim of a cone, above the second.
FOLDED = -0.5, -0.95
# Numbers in a table of the rims that are filled at once.
BLOCK = 1 << 20


class Rims(NamedTuple):
    """The rims of a mesh.

    Attributes:
        half_edges: Half-edges of all rims, in the direction of their faces, rim after rim (R,).
        begin: Where each rim begins in ``half_edges``, and their number (H + 1,).
        is_loop: Whether each rim is a loop that meets no position twice; False for a chain that ends at an edge of more
            than two faces, or of two faces that are wound against each other (H,).
    """

    half_edges: NDArray[np.int64]
    begin: NDArray[np.int64]
    is_loop: NDArray[np.bool_]


def find_rims(topology: Topology) -> Rims:
    """The rims of a mesh. Where one meets a position again, what lies between is a rim of its own."""
    border = topology.order[topology.starts[topology.uses == 1]].astype(np.int64)
    row = np.full(len(topology.order), -1)
    row[border] = np.arange(len(border))
    across = topology.twin.copy()
    for alike in topology.pairs:
        across[alike[~topology.opposed]] = -1
    # Around the end of each half-edge, from face to face, to where the fan ends.
    last = next_half_edge(border)
    inside = np.arange(len(border))
    while len(inside):
        over = across[last[inside]]
        inside, over = inside[over >= 0], over[over >= 0]
        last[inside] = next_half_edge(over)
    follower = row[last]
    is_followed = np.zeros(len(border), bool)
    is_followed[follower[follower >= 0]] = True
    rims = _walks(follower.tolist(), np.flatnonzero(~is_followed).tolist(), topology.start[border].tolist())
    sizes = [len(rim) for rim, _ in rims]
    rows = np.fromiter(chain.from_iterable(rim for rim, _ in rims), np.int64, sum(sizes))
    return Rims(border[rows], np.cumsum([0, *sizes]), np.array([is_loop for _, is_loop in rims], bool))


def edges_within(topology: Topology, begin: NDArray[np.int64], position: NDArray[Any]) -> NDArray[np.int64]:
    """Edges between two points of one rim that are no sides of it: two rows of the rims, in both orders (K, 2).

    They are ascending by their first row. ``position`` is where the rims' half-edges start (R,), as numbered by the
    topology; each rim begins in it at ``begin`` (H + 1,).
    """
    sizes = np.diff(begin)
    rim = np.repeat(np.arange(len(sizes)), sizes)
    position = position.astype(np.int64)
    code = position * len(sizes) + rim
    order = np.argsort(code)
    count = np.bincount(position, minlength=topology.position_count)
    edge = topology.order[topology.starts]
    ends = np.stack([topology.start[edge], topology.start[next_half_edge(edge)]], axis=1)
    ends = ends[(count[ends] > 0).all(axis=1)]
    ends = np.concatenate([ends, ends[:, ::-1]])
    # Each rim of the first end is one that the second may have too.
    times = count[ends[:, 0]]
    first = np.searchsorted(position[order], ends[:, 0])
    within = np.arange(times.sum()) - np.repeat(np.cumsum(times) - times, times)
    one = order[np.repeat(first, times) + within]
    sought = np.repeat(ends[:, 1], times) * len(sizes) + rim[one]
    at = np.minimum(np.searchsorted(code[order], sought), len(order) - 1)
    other = order[at]
    apart = (other - one) % sizes[rim[one]]
    found = (code[other] == sought) & (apart > 1) & (apart < sizes[rim[one]] - 1)
    pairs = np.stack([one, other], axis=1)[found]
    return pairs[np.argsort(pairs[:, 0], kind="stable")]


def _walks(follower: list[int], heads: list[int], position: list[int]) -> list[tuple[list[int], bool]]:
    """Rows from each to its follower, -1 where there is none, and whether each walk is a loop; chains from heads."""
    rims: list[tuple[list[int], bool]] = []
    taken = [False] * len(follower)
    for head in chain(heads, range(len(follower))):
        walk: list[int] = []
        place: dict[int, int] = {}
        row = head
        while row >= 0 and not taken[row]:
            taken[row] = True
            begin = place.get(position[row], len(walk))
            if begin < len(walk):
                rims.append((walk[begin:], True))
                for between in walk[begin:]:
                    del place[position[between]]
                del walk[begin:]
            place[position[row]] = len(walk)
            walk.append(row)
            row = follower[row]
        if walk:
            rims.append((walk, row == head))
    return rims


def patches(
    rims: Rims,
    points: Floats,
    wanted: NDArray[np.bool_],
    refused: Indices,
    barred: Indices,
    beside: Floats,
    rounded: Floats,
    edge_share: float,
) -> tuple[Indices, Indices]:
    """Triangles that fill rims, wound against them.

    Args:
        rims: The rims.
        points: Where each half-edge of them starts, in units in which the rim is about 1 wide (R, 3).
        wanted: The rims to fill, loops of three sides or more (H,).
        refused: Triangles that may not be made (M, 3), as they were returned.
        barred: Pairs of points of a rim that may not be joined (K, 2): :func:`geokit.mesh.topology.rims.edges_within`.
        beside: Unit normals of the faces at the half-edges (R, 3).
        rounded: How far the points of each rim may be from where they were meant to be (H,).
        edge_share: What an edge adds to the area, in shares of its square: of flat patches, all of one area, one has no
            slivers. So much area may lie outside of a flat rim.
    Returns:
        Corners of the triangles as rows of ``points`` (T, 3), and the rim of each (T,); none for rims that cannot be
        filled.
    """
    begin, left = rims.begin, np.diff(rims.begin)
    rim = np.repeat(np.arange(len(left)), left)
    local = points - points[begin[rim]]
    # The place of each point among those that are left of its rim; -1 for those that ears have cut off.
    slot = np.arange(len(rim)) - begin[rim]
    ears = [np.zeros((0, 3), np.int64)]
    for long in np.flatnonzero(wanted & (left > MOST_SIDES)):
        rows = slice(begin[long], begin[long + 1])
        pairs = barred[slice(*np.searchsorted(barred[:, 0], [rows.start, rows.stop]))] - rows.start
        cut, kept = _cut_ears(
            local[rows], pairs, refused[rim[refused[:, 0]] == long] - rows.start, beside[rows], rounded[long]
        )
        slot[rows] = -1
        slot[rows.start + kept] = np.arange(len(kept))
        left[long] = len(kept)
        ears.append(rows.start + cut)
    row = np.flatnonzero((slot >= 0) & (wanted & (left <= MOST_SIDES))[rim])
    row = row[np.argsort(left[rim[row]], kind="stable")]
    made = []
    for sides, count in zip(*np.unique(left[rim[row]], return_counts=True), strict=True):
        group, row = row[:count].reshape(-1, sides), row[count:]
        for first in range(0, len(group), max(1, BLOCK // sides**2)):
            table = group[first : first + max(1, BLOCK // sides**2)]
            number = rim[table[:, 0]]
            barred_here, refused_here = (_within(number, rim, slot, of) for of in (barred, refused))
            triangles, possible = _least_area(local[table], barred_here, refused_here, rounded[number], edge_share)
            made.append(np.take_along_axis(table, triangles.reshape(len(table), -1), 1)[possible].reshape(-1, 3))
    found = np.concatenate([np.zeros((0, 3), np.int64), *made])
    cut = np.concatenate(ears)
    found = np.concatenate([found, cut[np.isin(rim[cut[:, 0]], rim[found[:, 0]])]])
    return found, rim[found[:, 0]]


def _within(number: Indices, rim: Indices, slot: Indices, points: Indices) -> Indices:
    """Of rows of points, those of the given rims: the rim's place among them, and the places of the points in it."""
    place = np.searchsorted(number, rim[points[:, 0]])
    here = (number[np.minimum(place, len(number) - 1)] == rim[points[:, 0]]) & (slot[points] >= 0).all(axis=1)
    return np.concatenate([place[here, None], slot[points[here]]], axis=1)


def _least_area(
    points: Floats, barred: Indices, refused: Indices, rounded: Floats, edge_share: float
) -> tuple[Indices, NDArray[np.bool_]]:
    """The triangles over rims of equally many sides whose area is least.

    Args:
        points: Corners of the rims, in order (B, N, 3), about 1 in size.
        barred: Rims and pairs of their corners that may not be joined (K, 3), in both orders.
        refused: Rims and triangles that may not be made (M, 4).
        rounded: Heights of triangles that are thin (B,).
        edge_share: As for :func:`patches`.
    Returns:
        Corners of the triangles (B, N - 2, 3), wound against the rims, and whether there are any for each rim (B,).
    Source:
        Barequet and Sharir, Filling gaps in the boundary of a polyhedron (1995). Differs: edges have a small cost too.
    """
    count, sides, _ = points.shape
    # The least cost of the part of a rim from a corner to the one so many sides further on, or so many before.
    after, before = (np.full((count, sides, sides), np.inf) for _ in range(2))
    after[:, :-1, 1] = before[:, 1:, 1] = 0.0
    best = np.zeros((count, sides, sides), np.int16)
    is_barred = np.zeros((count, sides, sides), bool)
    is_barred[tuple(barred.T)] = True
    low, middle, high = np.sort(refused[:, 1:], axis=1).T
    for span in range(2, sides):
        first = np.arange(sides - span)
        along = points[:, first + span] - points[:, first]
        spoke = points[:, first[:, None] + np.arange(1, span)] - points[:, first, None]
        area = 0.5 * np.linalg.norm(np.cross(spoke, along[:, :, None]), axis=-1)
        # The rim is about 1 wide, and so are its triangles at most.
        thin = np.nonzero(area < 0.5 * rounded[:, None, None])
        sides_of = spoke[thin], along[thin[:2]], along[thin[:2]] - spoke[thin]
        longest = np.sqrt(np.max([(side**2).sum(-1) for side in sides_of], axis=0))
        area[thin] += THIN * (2.0 * area[thin] < rounded[thin[0]] * longest)
        area += after[:, : sides - span, 1:span]
        area += before[:, span:, span - 1 : 0 : -1]
        now = high - low == span
        area[refused[now, 0], low[now], middle[now] - low[now] - 1] = np.inf
        apex = area.argmin(-1)
        best[:, : sides - span, span] = apex + 1
        cost = np.take_along_axis(area, apex[..., None], -1)[..., 0] + edge_share * (along**2).sum(-1)
        if span < sides - 1:
            cost[is_barred[:, first, first + span]] = np.inf
        after[:, : sides - span, span] = before[:, span:, span] = cost
    part = np.stack([np.arange(count), np.zeros(count, np.int64), np.full(count, sides - 1)], axis=1)
    made = []
    while len(part):
        rim, first, span = part.T
        apex = best[rim, first, span].astype(np.int64)
        made.append(np.stack([rim, first + apex, first, first + span], axis=1))
        part = np.concatenate([np.stack([rim, first, apex], 1), np.stack([rim, first + apex, span - apex], 1)])
        part = part[part[:, 2] > 1]
    rows = np.concatenate(made)
    triangles = rows[np.argsort(rows[:, 0], kind="stable"), 1:].reshape(count, sides - 2, 3)
    return triangles, np.isfinite(after[:, 0, sides - 1])


def _cut_ears(
    points: Floats, barred: Indices, refused: Indices, beside: Floats, rounded: float
) -> tuple[Indices, Indices]:
    """Triangles over two neighboring sides of one rim each, until few sides are left.

    In each round those are cut off whose new edge is shorter than that of their neighbors.

    Args:
        points: Corners of the rim, in order (N, 3), about 1 in size.
        barred: Pairs of corners that may not be joined (K, 2), in both orders.
        refused: Triangles that may not be made (M, 3).
        beside: Unit normals of the faces along the sides, side i from corner i to the next (N, 3).
        rounded: Height of triangles that are thin.
    Returns:
        Corners of the triangles (T, 3), wound against the rim, and the corners that are left in order; more than
        ``MOST_SIDES`` where no more ears can be cut.
    """
    left = np.arange(len(points))
    made = [np.zeros((0, 3), np.int64)]
    # Twice the area that the rim encloses, as a vector: patches face its other side.
    facing = -np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    flat = points @ _across(facing)
    codes = [np.array([len(points), 1]), len(points) ** np.arange(2, -1, -1)]
    barred, refused = barred @ codes[0], refused @ codes[1]
    while len(left) > MOST_SIDES:
        one, other = np.roll(left, 1), np.roll(left, -1)
        normal = np.cross(points[one] - points[left], points[other] - points[left])
        size = np.linalg.norm(normal, axis=1)
        normal /= np.where(size > 0.0, size, 1.0)[:, None]
        length = np.linalg.norm(points[other] - points[one], axis=1)
        cosine = np.minimum((normal * beside).sum(1), (normal * np.roll(beside, 1, axis=0)).sum(1))
        ears = np.stack([left, one, other], axis=1)
        usable = ~(np.isin(ears[:, 1:] @ codes[0], barred) | np.isin(ears @ codes[1], refused))
        usable &= (size > 0.0) & (normal @ facing > 0.0)
        usable[usable] = ~_covers(flat, ears[usable], left[normal @ facing <= 0.0])
        plump = usable & (size >= rounded * length)
        tiers = plump & (cosine > FOLDED[0]), plump & (cosine > FOLDED[1]), usable & (cosine > FOLDED[1])
        length[~next((tier for tier in tiers if tier.any()), tiers[-1])] = np.inf
        # Of equal ones the lowest, so that there always is one.
        order = np.empty(len(left), np.int64)
        order[np.argsort(length, kind="stable")] = np.arange(len(left))
        ear = np.isfinite(length) & (order < np.roll(order, 1)) & (order < np.roll(order, -1))
        ear &= np.cumsum(ear) <= len(left) - MOST_SIDES
        if not ear.any():
            break
        made.append(ears[ear])
        # The new side takes the place of that before the ear.
        beside = np.where(np.roll(ear, -1)[:, None], np.roll(normal, -1, axis=0), beside)[~ear]
        left = left[~ear]
    return np.concatenate(made), left


def _across(normal: Floats) -> Floats:
    """Two directions across a normal, as columns (3, 2); straight sides of a rim are seldom along one of them."""
    other = np.cross(normal, np.roll(normal, 1) + np.array([0.3, 0.5, 0.7]))
    axes = np.stack([other, np.cross(normal, other)], axis=1)
    length = np.linalg.norm(axes, axis=0)
    return np.asarray(axes / np.where(length > 0.0, length, 1.0))


def _covers(points: Floats, ears: Indices, corners: Indices) -> NDArray[np.bool_]:
    """Whether one of some corners of a flat rim lies in each ear or on its border (E,).

    Args:
        points: The rim in a plane (N, 2).
        ears: Corners of triangles (E, 3).
        corners: Rows of the rim: those where it is straight or turns inward.
    """
    across = points[corners, 0]
    order = np.argsort(across)
    sides = points[ears]
    first = np.searchsorted(across[order], sides[..., 0].min(axis=1))
    count = np.searchsorted(across[order], sides[..., 0].max(axis=1), side="right") - first
    found = np.zeros(len(ears), bool)
    for block in np.split(np.arange(len(ears)), np.flatnonzero(np.diff(np.cumsum(count) // BLOCK)) + 1):
        ear = np.repeat(block, count[block])
        place = np.arange(len(ear)) - np.repeat(np.cumsum(count[block]) - count[block], count[block])
        corner = corners[order[first[ear] + place]]
        away = points[corner][:, None] - sides[ear]
        along = np.roll(sides, -1, axis=1)[ear] - sides[ear]
        turn = along[..., 0] * away[..., 1] - along[..., 1] * away[..., 0]
        inside = ((turn >= 0.0).all(axis=1) | (turn <= 0.0).all(axis=1)) & (ears[ear] != corner[:, None]).all(axis=1)
        found[ear[inside]] = True
    return found
