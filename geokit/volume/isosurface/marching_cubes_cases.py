"""The 256 ways in which a surface crosses a cell, derived from one rule for its faces.

Corners are numbered ``4 dx + 2 dy + dz``; bit c of a case says that corner c is inside. Edges along x are numbered
``2 dy + dz``, those along y ``4 + 2 dx + dz``, those along z ``8 + 2 dx + dy``.

The rule: on each face of a cell, the surface cuts off the inside corners. Two inside corners at the ends of a face's
diagonal are cut off separately, so that a face looks the same from both of its cells. The cuts of the faces join the
crossings of edges into closed loops. Each loop is one sheet of the surface in the cell.

Source:
    Lorensen and Cline, Marching Cubes (1987), for the cells; Nielson, Dual Marching Cubes (2004), for a vertex per
    loop; Wenger, Isosurfaces (2013), for faces where both cells have one loop through both cuts. Differs: no table is
    copied; loops and triangles follow from the rule.
"""

from __future__ import annotations

import functools
from itertools import product

import numpy as np
from numpy.typing import NDArray

CORNERS = tuple(product((0, 1), repeat=3))
# Corners at the ends of each edge, the lower one first.
EDGES = tuple(
    (4 * a[0] + 2 * a[1] + a[2], 4 * b[0] + 2 * b[1] + b[2])
    for axis in range(3)
    for u, v in product((0, 1), repeat=2)
    for a, b in [[(*(u, v)[:axis], end, *(u, v)[axis:]) for end in (0, 1)]]
)
# Faces as (axis, side): -x, +x, -y, +y, -z, +z.
FACES = tuple((axis, side) for axis in range(3) for side in (0, 1))

Loop = tuple[int, ...]


def _face_corners(face: int) -> tuple[int, ...]:
    """Corners of a face in counter-clockwise order, seen from outside the cell."""
    axis, side = FACES[face]
    u, v = [(axis + 1) % 3, (axis + 2) % 3]
    ring = [(0, 0), (1, 0), (1, 1), (0, 1)]
    corners = []
    for a, b in ring if side else reversed(ring):
        place = [0, 0, 0]
        place[axis], place[u], place[v] = side, a, b
        corners.append(4 * place[0] + 2 * place[1] + place[2])
    return tuple(corners)


@functools.cache
def _cuts(case: int, face: int, joined: bool) -> tuple[tuple[int, int], ...]:
    """Directed cuts of a face, from crossing to crossing; seen from outside the cell, the inside lies to their right.

    A face with both ends of a diagonal inside has two cuts: around each inside corner or, if ``joined``, around each
    outside corner.
    """
    ring = _face_corners(face)
    inside = [bool(case >> corner & 1) for corner in ring]
    edge_of = {frozenset(ends): number for number, ends in enumerate(EDGES)}
    edges = [edge_of[frozenset((ring[n], ring[(n + 1) % 4]))] for n in range(4)]
    # Counter-clockwise around the face, the inside is entered at some edges and left at others.
    entered = [n for n in range(4) if not inside[n] and inside[(n + 1) % 4]]
    left = [n for n in range(4) if inside[n] and not inside[(n + 1) % 4]]
    if len(entered) < 2:
        return tuple((edges[a], edges[b]) for a, b in zip(entered, left, strict=True))
    # An inside corner lies between the edge that enters it and the next edge, an outside corner before the edge.
    step = -1 if joined else 1
    return tuple((edges[a], edges[(a + step) % 4]) for a in entered)


def loops_of(case: int, joined_face: int = -1) -> tuple[Loop, ...]:
    """The loops of a case, sorted by their lowest edge; a loop lists its edges in turn, from the lowest.

    Args:
        case: Bit mask of the inside corners.
        joined_face: A face on which the inside corners of a diagonal are joined instead of being cut off separately.

    Returns:
        Loops whose triangles' normals, by the right-hand rule, point outside.
    """
    after = dict(cut for face in range(6) for cut in _cuts(case, face, face == joined_face))
    loops = []
    while after:
        edge = min(after)
        loop = [edge]
        while (edge := after.pop(edge)) != loop[0]:
            loop.append(edge)
        loops.append(tuple(loop))
    return tuple(loops)


def problem_face(case: int) -> int:
    """The face whose two cuts belong to one loop, -1 for none; there is never more than one.

    If both cells at such a face have one loop through both cuts, one vertex per loop would give an edge with four
    faces. Joining the inside corners on that face splits both loops.
    """
    loops = loops_of(case)
    found = -1
    for face in range(6):
        cuts = _cuts(case, face, False)
        if len(cuts) == 2 and any(cuts[0][0] in loop and cuts[1][0] in loop for loop in loops):
            if found >= 0:
                raise AssertionError(f"case {case} has two faces with both cuts in one loop")
            found = face
    return found


@functools.lru_cache(maxsize=1)
def loop_table() -> NDArray[np.uint32]:
    """A word for each case and, from 256 on, for each case with its problem face joined; shape (512,).

    Bits ``2 e`` and ``2 e + 1`` are the loop of edge e, bits 24 to 26 the number of loops, bits 27 to 29 the problem
    face + 1, or 0. Joined cases have no problem face.
    """
    words = np.zeros(512, np.uint32)
    for case in range(256):
        face = problem_face(case)
        for row, joined in ((case, -1), (case + 256, face)):
            loops = loops_of(case, joined)
            word = len(loops) << 24 | (face + 1 if joined < 0 else 0) << 27
            for number, loop in enumerate(loops):
                word |= sum(number << 2 * edge for edge in loop)
            words[row] = word
    words.setflags(write=False)
    return words


@functools.lru_cache(maxsize=1)
def sum_table() -> NDArray[np.uint32]:
    """Counts and bit mask of the crossed edges of each case; shape (256,).

    Four bits each: the number of crossed edges at x = 1, at y = 1 and at z = 1 (along the other axes), and of all
    crossed edges. From bit 16 on, the bit mask of the crossed edges.
    """
    words = np.zeros(256, np.uint32)
    for case in range(256):
        crossed = [e for e, (low, high) in enumerate(EDGES) if (case >> low ^ case >> high) & 1]
        sums = [sum(CORNERS[EDGES[e][0]][axis] for e in crossed) for axis in range(3)]
        words[case] = sums[0] | sums[1] << 4 | sums[2] << 8 | len(crossed) << 12 | sum(1 << 16 + e for e in crossed)
    words.setflags(write=False)
    return words


def _faces_of_edge(edge: int) -> frozenset[int]:
    """The two faces that an edge belongs to."""
    return frozenset(face for face in range(6) if set(EDGES[edge]) <= set(_face_corners(face)))


def _fan(loop: Loop) -> list[tuple[int, int, int]]:
    """Triangle fan of a loop about one of its crossings, without a diagonal in a face of the cell.

    The cell beyond that face might have the same diagonal, which would give an edge with four faces.
    """
    for first in range(len(loop)):
        turned = loop[first:] + loop[:first]
        if all(not _faces_of_edge(turned[0]) & _faces_of_edge(other) for other in turned[2:-1]):
            return [(turned[0], turned[n], turned[n + 1]) for n in range(1, len(turned) - 1)]
    raise AssertionError(f"loop {loop} has no fan without a diagonal in a face")


@functools.lru_cache(maxsize=1)
def triangle_table() -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Triangles of each case.

    Returns:
        start: Case ``c`` has the triangles ``start[c]`` to ``start[c + 1] - 1``; shape (257,).
        edges: Edges of the corners of each triangle, in bits 0 to 3, 4 to 7 and 8 to 11; their normals point outside.
    """
    triangles = [[triangle for loop in loops_of(case) for triangle in _fan(loop)] for case in range(256)]
    start = np.concatenate([[0], np.cumsum([len(some) for some in triangles])]).astype(np.int32)
    edges = np.array([a | b << 4 | c << 8 for some in triangles for a, b, c in some], np.int32)
    for table in (start, edges):
        table.setflags(write=False)
    return start, edges
