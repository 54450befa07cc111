"""The tables of the 256 cases: loops are closed, sheets of neighbors fit together, triangles turn outward."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from geokit.volume.isosurface.marching_cubes_cases import (
    CORNERS,
    EDGES,
    loop_table,
    loops_of,
    problem_face,
    sum_table,
    triangle_table,
)

MIDDLES = np.array([(np.array(CORNERS[a]) + CORNERS[b]) / 2 for a, b in EDGES])


def crossed_edges(case):
    return [e for e, (a, b) in enumerate(EDGES) if (case >> a ^ case >> b) & 1]


def on_face(edge, axis, side):
    return MIDDLES[edge][axis] == side


def cuts_of(loops, axis, side):
    """Pairs of edges of one face that follow each other in a loop."""
    pairs = set()
    for loop in loops:
        for a, b in zip(loop, loop[1:] + loop[:1], strict=True):
            if on_face(a, axis, side) and on_face(b, axis, side):
                pairs.add(frozenset((a, b)))
    return pairs


def test_corners_and_edges():
    assert tuple(itertools.product((0, 1), repeat=3)) == CORNERS
    assert len(set(EDGES)) == 12
    for number, (a, b) in enumerate(EDGES):
        step = np.subtract(CORNERS[b], CORNERS[a])
        assert step.sum() == 1
        assert step[number // 4] == 1


@pytest.mark.parametrize("case", range(256))
def test_each_crossed_edge_is_in_one_loop(case):
    loops = loops_of(case)
    assert sorted(itertools.chain(*loops)) == crossed_edges(case)
    assert all(len(loop) >= 3 for loop in loops)
    assert len(loops) <= 4


@pytest.mark.parametrize("axis", range(3))
def test_cells_on_both_sides_of_a_face_cut_it_alike(axis):
    others = [k for k in range(3) if k != axis]
    seen = {}
    for case in range(256):
        for side in (0, 1):
            signs = tuple(case >> c & 1 for c in range(8) if CORNERS[c][axis] == side)
            # Edges of the face by where they lie in it.
            cuts = {frozenset(tuple(MIDDLES[e][others]) for e in cut) for cut in cuts_of(loops_of(case), axis, side)}
            assert seen.setdefault(signs, cuts) == cuts
    assert len(seen) == 16


def test_joining_the_problem_face_splits_its_loop():
    cases = [case for case in range(256) if problem_face(case) >= 0]
    assert len(cases) == 36
    for case in cases:
        face = problem_face(case)
        before, after = loops_of(case), loops_of(case, face)
        assert len(after) == len(before) + 1
        axis, side = divmod(face, 2)
        for loop in after:
            on = [e for e in loop if on_face(e, axis, side)]
            assert len(on) in (0, 2)
        for other in range(6):
            if other != face:
                assert cuts_of(before, *divmod(other, 2)) == cuts_of(after, *divmod(other, 2))


@pytest.mark.parametrize("case", range(256))
def test_words_say_what_the_loops_are(case):
    words, sums = loop_table(), sum_table()
    for row, loops in ((case, loops_of(case)), (case + 256, loops_of(case, problem_face(case)))):
        word = int(words[row])
        assert word >> 24 & 7 == len(loops)
        for number, loop in enumerate(loops):
            assert all(word >> 2 * edge & 3 == number for edge in loop)
    assert int(words[case]) >> 27 == problem_face(case) + 1
    assert int(words[case + 256]) >> 27 == 0
    edges = crossed_edges(case)
    assert int(sums[case]) >> 16 == sum(1 << e for e in edges)
    assert int(sums[case]) >> 12 & 15 == len(edges)
    for axis in range(3):
        assert int(sums[case]) >> 4 * axis & 15 == sum(MIDDLES[e][axis] == 1 for e in edges)


@pytest.mark.parametrize("case", range(256))
def test_triangles_close_the_loops_and_turn_outward(case):
    start, edges = triangle_table()
    triangles = [(int(word) & 15, int(word) >> 4 & 15, int(word) >> 8) for word in edges[start[case] : start[case + 1]]]
    assert len(triangles) == sum(len(loop) - 2 for loop in loops_of(case))
    used = [pair for a, b, c in triangles for pair in ((a, b), (b, c), (c, a))]
    assert len(set(used)) == len(used)
    border = {(a, b) for a, b in used if (b, a) not in used}
    loop_sides = {pair for loop in loops_of(case) for pair in zip(loop, loop[1:] + loop[:1], strict=True)}
    assert border == loop_sides
    # No diagonal in a face of the cell: the cell beyond might have the same.
    for a, b in set(used) - border:
        assert not any(on_face(a, axis, side) and on_face(b, axis, side) for axis in range(3) for side in (0, 1))
    for loop in loops_of(case):
        outward = np.zeros(3)
        for edge in loop:
            a, b = EDGES[edge]
            outward += (1 if case >> a & 1 else -1) * np.subtract(CORNERS[b], CORNERS[a])
        corners = MIDDLES[[triangle for triangle in triangles if triangle[0] in loop]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(axis=0)
        assert normal @ outward > 0
