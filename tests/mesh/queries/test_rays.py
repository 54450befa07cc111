"""All hits, crossings, starts and lengths of rays, on meshes with answers known by hand."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from tests.support import reference


@pytest.fixture(scope="module")
def box():
    return gk.mesh.Surface(mesh_catalog.box(), device="cpu")


@pytest.fixture(scope="module")
def nested():
    return gk.mesh.Surface(mesh_catalog.nested_boxes(), device="cpu")


def test_all_hits_come_in_order_of_t(nested):
    hits = nested.raycast_all([[-1.0, 1.4, 1.7], [9.0, 9.0, 9.0]], [[2.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(hits.offsets, [0, 4, 4])
    np.testing.assert_allclose(hits.t, [0.5, 1.0, 1.5, 2.0], atol=1e-15)
    corners = nested.mesh.vertices[nested.mesh.faces[hits.triangle_id]]
    np.testing.assert_allclose(np.einsum("ij,ijk->ik", hits.barycentric, corners)[:, 0], [0, 1, 2, 3], atol=1e-15)


@pytest.mark.parametrize(
    ("start", "direction"),
    [
        ((-1.0, 0.5, 0.5), (1.0, 0.0, 0.0)),  # through the diagonals of two faces
        ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)),  # through two corners
        ((-1.0, -1.0, 0.5), (1.0, 1.0, 0.0)),  # through two edges
        ((0.25, 0.25, -1.0), (0.0, 0.0, 1.0)),  # along the diagonals
    ],
)
def test_a_passage_through_an_edge_or_a_vertex_is_one_crossing(box, start, direction):
    hits = box.raycast_all([start], [direction])
    assert len(hits.t) == 2
    assert hits.t[0] < hits.t[1]
    assert box.crossing_count([start], [direction])[0] == 2
    middle = np.array(start) + np.array(direction) * hits.t.mean()
    assert box.crossing_count([middle], [direction])[0] == 1


def test_a_touch_is_none_or_two(box):
    # Past an edge, past a corner, and within a face's plane.
    starts = [[-1.0, 1.0, 0.5], [-1.0, 2.0, 0.5], [-1.0, 0.5, 1.0]]
    directions = [[1.0, 0.0, 0.0], [1.0, -1.0, 0.0], [1.0, 0.0, 0.0]]
    assert set(box.crossing_count(starts, directions) % 2) == {0}


def test_lists_are_as_long_as_counted(nested):
    rng = np.random.default_rng(4)
    starts, directions = rng.uniform(-1, 4, (500, 3)), rng.normal(size=(500, 3))
    hits = nested.raycast_all(starts, directions)
    np.testing.assert_array_equal(np.diff(hits.offsets), nested.crossing_count(starts, directions))
    times, _ = reference.all_ray_hits(nested.mesh.vertices, nested.mesh.faces, starts, directions)
    for ray in range(len(starts)):
        expected = np.sort(times[ray][np.isfinite(times[ray])])
        found = hits.t[hits.offsets[ray] : hits.offsets[ray + 1]]
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_nearer_hits_than_t_min_are_passed_over(box):
    ray = [[-1.0, 0.3, 0.4]], [[2.0, 0.0, 0.0]]
    assert box.raycast(*ray, t_min=0.4).t[0] == pytest.approx(0.5)
    assert box.raycast(*ray, t_min=0.6).t[0] == pytest.approx(1.0)
    assert box.raycast(*ray, t_min=1.1).triangle_id[0] == -1
    assert box.occluded(*ray, t_min=0.6)[0]
    assert not box.occluded(*ray, t_min=1.1)[0]
    assert box.crossing_count(*ray, t_min=0.6)[0] == 1
    assert len(box.raycast_all(*ray, t_min=1.1).t) == 0


def test_farther_hits_than_max_distance_are_misses(box):
    ray = [[-1.0, 0.3, 0.4]], [[2.0, 0.0, 0.0]]
    assert box.raycast(*ray, max_distance=0.9).triangle_id[0] == -1
    assert box.raycast(*ray, max_distance=1.1).t[0] == pytest.approx(0.5)
    assert box.crossing_count(*ray, max_distance=1.1)[0] == 1


@pytest.mark.parametrize("method", ["raycast", "raycast_all", "occluded", "crossing_count"])
class TestBadInput:
    def test_zero_direction(self, box, method):
        with pytest.raises(gk.InputError, match="directions: row 1 is zero"):
            getattr(box, method)(np.zeros((3, 3)), [[1, 0, 0], [0, 0, 0], [0, 0, 0]])

    def test_not_finite(self, box, method):
        with pytest.raises(gk.InputError, match="directions: row 2 is not finite"):
            getattr(box, method)(np.zeros((3, 3)), [[1, 0, 0], [0, 1, 0], [0, np.inf, 0]])
        with pytest.raises(gk.InputError, match="origins: row 0 is not finite"):
            getattr(box, method)([[np.nan, 0, 0]], [[1, 0, 0]])

    def test_other_lengths(self, box, method):
        with pytest.raises(gk.InputError, match="2 rows for 1 origins"):
            getattr(box, method)([[0, 0, 0]], [[1, 0, 0], [0, 1, 0]])

    @pytest.mark.parametrize("t_min", [-0.1, np.nan, np.inf])
    def test_t_min(self, box, method, t_min):
        with pytest.raises(gk.InputError, match="t_min"):
            getattr(box, method)([[0, 0, 0]], [[1, 0, 0]], t_min=t_min)

    def test_no_rays(self, box, method):
        found = getattr(box, method)(np.zeros((0, 3)), np.zeros((0, 3)))
        assert len(found) == (4 if method == "raycast_all" else 3 if method == "raycast" else 0)
