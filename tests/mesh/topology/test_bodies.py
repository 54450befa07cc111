"""Closed bodies of a mesh, also where they share edges, faces and walls."""

from __future__ import annotations

import numpy as np
import pytest

from geokit.mesh import TriangleMesh, box, drop_degenerate, merge_vertices, torus
from geokit.mesh.topology.bodies import closed_bodies
from tests.support.assemblies import blocks, concatenated, sheet, turned


def volumes(mesh: TriangleMesh) -> list[float]:
    """Volumes of the bodies as shares of the largest one's, ascending."""
    found = np.sort(closed_bodies(mesh)[0].volume)
    return [round(float(volume / np.abs(found).max()), 9) for volume in found]


@pytest.mark.parametrize("welded", [False, True])
@pytest.mark.parametrize("seed", [None, 0, 1])
@pytest.mark.parametrize(
    ("places", "bodies"),
    [
        ([(0, 0, 0)], 1),
        ([(0, 0, 0), (0, 0, 1)], 2),
        ([(0, 0, 0), (0, 1, 1)], 2),
        ([(0, 0, 0), (1, 1, 1)], 2),
        ([(0, 0, 0), (0, 1, 1), (0, 1, 0), (0, 0, 1)], 4),
        ([(i, j, k) for i in range(3) for j in range(3) for k in range(3)], 27),
    ],
)
def test_blocks_are_found_one_by_one(
    places: list[tuple[int, int, int]], bodies: int, seed: int | None, welded: bool
) -> None:
    mesh = blocks(places)
    if seed is not None:
        mesh = turned(mesh, seed)
    (found,) = closed_bodies(merge_vertices(mesh) if welded else mesh)
    assert len(found.volume) == bodies
    assert np.allclose(found.volume, found.volume[0], rtol=1e-9)
    assert np.bincount(found.label).tolist() == [12] * bodies
    # No two bodies share a vertex, and each edge of a body has two faces.
    owners = [set(found.corners[found.label == body].ravel().tolist()) for body in range(bodies)]
    assert sum(map(len, owners)) == len(set.union(*owners)) == 8 * bodies


def test_copies_are_bodies_of_their_own() -> None:
    assert volumes(merge_vertices(blocks([(0, 0, 0)] * 3))) == [1.0, 1.0, 1.0]


def test_a_wall_that_is_there_once_belongs_to_no_body() -> None:
    two = drop_degenerate(merge_vertices(blocks([(0, 0, 0), (0, 0, 1)])), duplicates=True)
    found = closed_bodies(two)[0]
    assert len(found.volume) == 1
    assert np.count_nonzero(found.label < 0) == 2


@pytest.mark.parametrize("way", [1, -1])
def test_a_fin_on_an_edge_leaves_the_body_closed(way: int) -> None:
    fin = TriangleMesh([[0.5, 0.5, -0.5], [0.5, 0.5, 0.5], [1.5, 1.5, 0.5]], [[0, 1, 2][::way]])
    found = closed_bodies(concatenated(box(), fin))[0]
    assert found.label.tolist() == [0] * 12 + [-1]


def test_cavities_have_negative_volumes_and_sheets_none() -> None:
    hole = box()
    hole = TriangleMesh(hole.vertices, hole.faces[:, ::-1])
    both_sides = concatenated(sheet(5.0), TriangleMesh(sheet(5.0).vertices, sheet(5.0).faces[:, ::-1]))
    mesh = concatenated(box((2, 2, 2)), hole, sheet(), both_sides)
    assert volumes(mesh) == [-0.125, 1.0]
    assert np.count_nonzero(closed_bodies(mesh)[0].label < 0) == 6


def test_a_face_with_two_equal_corners_is_left_out() -> None:
    ring = torus(segments=8, tube_segments=6)
    mesh = TriangleMesh(ring.vertices, np.concatenate([ring.faces, [[0, 0, 1]]]))
    assert closed_bodies(mesh)[0].label.tolist() == [0] * ring.face_count + [-1]


def test_nothing_is_closed_in_an_open_mesh() -> None:
    (found,) = closed_bodies(sheet())
    assert len(found.volume) == 0
    assert found.label.tolist() == [-1, -1]
