"""Triangles that intersect boxes, another surface, or each other: small cases and every error."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import warp as wp

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit import errors
from geokit.core.memory import available_memory
from tests.support import reference
from tests.support.assemblies import concatenated


def surface(vertices, faces):
    return gk.mesh.Surface(gk.mesh.TriangleMesh(vertices, faces), device="cpu")


def lists(overlaps):
    return [overlaps.triangle_id[a:b].tolist() for a, b in itertools.pairwise(overlaps.offsets)]


RIGHT_ANGLE = ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])


class TestOverlapping:
    def test_the_triangle_counts_not_its_box(self):
        found = surface(*RIGHT_ANGLE).overlapping([[0.6, 0.6, -1], [0.4, 0.4, -1]], [[1, 1, 1], [1, 1, 1]])
        assert lists(found) == [[], [0]]

    def test_touching_is_meeting(self):
        lower = [[1, 0, 0], [0.5, 0.5, 0], [-1, -1, -1], [-1, -1, -1]]
        upper = [[2, 1, 1], [0.5, 0.5, 0], [0, 0, 0], [-1e-300, 2, 2]]
        assert lists(surface(*RIGHT_ANGLE).overlapping(lower, upper)) == [[0], [0], [0], []]

    def test_lists_ascend_and_a_box_around_all_has_all(self):
        mesh = mesh_catalog.torus()
        found = gk.mesh.Surface(mesh, device="cpu").overlapping([mesh.bounds[0]], [mesh.bounds[1]])
        np.testing.assert_array_equal(found.triangle_id, np.arange(len(mesh.faces)))
        assert found.triangle_id.dtype == np.int32

    @pytest.mark.slow
    @pytest.mark.parametrize(
        "make", [mesh_catalog.icosphere, mesh_catalog.torus, mesh_catalog.sliver_fan, mesh_catalog.collapsed_faces]
    )
    @pytest.mark.parametrize("offset", [0.0, 1e6])
    def test_boxes_against_exact_clipping(self, make, offset):
        mesh = mesh_catalog.far_away(make(), offset) if offset else make()
        rng = np.random.default_rng(3)
        centers = mesh.bounds[0] + rng.random((12, 3)) * np.ptp(mesh.bounds, axis=0)
        half = 0.2 * mesh.diagonal * rng.random((12, 3)) ** 3
        half[0] = 0.0
        found = lists(gk.mesh.Surface(mesh, device="cpu").overlapping(centers - half, centers + half))
        corners = mesh.vertices[mesh.faces]
        for ids, center, h in zip(found, centers, half, strict=True):
            near = np.flatnonzero(
                ((corners.min(axis=1) <= center + h) & (corners.max(axis=1) >= center - h)).all(axis=1)
            )
            assert ids == [i for i in near if reference.triangle_meets_box(corners[i], center - h, center + h)]

    def test_none_is_missed_at_corners_of_boxes(self):
        """Boxes that touch a triangle's plane with a corner, where rounding decides."""
        rng = np.random.default_rng(4)
        corners = rng.random((300, 3, 3))
        weights = rng.dirichlet([1, 1, 1], 300)
        touched = np.einsum("nij,ni->nj", corners, weights)
        s = surface(corners.reshape(-1, 3), np.arange(900).reshape(-1, 3))
        outward = np.sign(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
        lower, upper = np.minimum(touched, touched + outward), np.maximum(touched, touched + outward)
        exact = [reference.triangle_meets_box(c, a, b) for c, a, b in zip(corners, lower, upper, strict=True)]
        found = [i in ids for i, ids in enumerate(lists(s.overlapping(lower, upper)))]
        assert 0 < sum(exact) < 300
        assert all(f for f, e in zip(found, exact, strict=True) if e)
        # Every false positive is within rounding of the box.
        assert all(found)

    def test_no_boxes(self):
        found = surface(*RIGHT_ANGLE).overlapping(np.zeros((0, 3)), np.zeros((0, 3)))
        assert found.offsets.tolist() == [0]
        assert len(found.triangle_id) == 0

    def test_containers(self):
        s = surface(*RIGHT_ANGLE)
        found = s.overlapping(wp.array([[0, 0, 0]], dtype=wp.vec3), wp.array([[1, 1, 1]], dtype=wp.vec3))
        assert isinstance(found.offsets, wp.array)
        assert found.triangle_id.numpy().tolist() == [0]

    def test_boxes_far_away_and_huge(self):
        found = surface(*RIGHT_ANGLE).overlapping([[1e300, 0, 0], [-1e300] * 3], [[1e301, 1, 1], [1e300] * 3])
        assert lists(found) == [[], [0]]

    @pytest.mark.parametrize(
        ("lower", "upper", "message"),
        [
            ([[0, 0, 0], [0, 2, 0]], [[1, 1, 1], [1, 1, 1]], "upper: row 1"),
            ([[0, 0, 0]], [[1, 1, 1], [1, 1, 1]], "upper: 2 rows for 1"),
            ([[0, np.nan, 0]], [[1, 1, 1]], "lower: row 0 is not finite"),
            ([[0, 0, 0]], [[1, np.inf, 1]], "upper: row 0 is not finite"),
            ([0, 0], [1, 1], "lower: shape"),
        ],
    )
    def test_boxes_that_are_none(self, lower, upper, message):
        with pytest.raises(errors.InputError, match=message):
            surface(*RIGHT_ANGLE).overlapping(lower, upper)

    def test_moved_meshes_answer_where_they_are(self):
        s = surface(*RIGHT_ANGLE)
        assert len(s.overlapping([[0, 0, 0]], [[1, 1, 1]]).triangle_id) == 1
        s.update(np.add(RIGHT_ANGLE[0], [5.0, 0.0, 0.0]))
        assert lists(s.overlapping([[0, 0, 0], [5, 0, 0]], [[1, 1, 1], [6, 1, 1]])) == [[], [0]]

    def test_too_many_say_how_many(self, monkeypatch):
        asked = surface(*RIGHT_ANGLE)
        monkeypatch.setattr(available_memory, "available", lambda device: 27)
        with pytest.raises(errors.DeviceMemoryError, match=r"1 overlaps need .* ask for fewer"):
            asked.overlapping([[0, 0, 0]], [[1, 1, 1]])


class TestIntersectingTriangles:
    def test_pairs_are_sorted_and_exact(self):
        one = mesh_catalog.box()
        other = mesh_catalog.moved(mesh_catalog.box(), (0.5, 0.25, 0.125))
        found = gk.mesh.Surface(one, device="cpu").intersecting_triangles(gk.mesh.Surface(other, device="cpu"))
        t, u = one.vertices[one.faces], other.vertices[other.faces]
        assert found.tolist() == reference.intersecting_pairs(t, u)
        assert found.dtype == np.int32

    def test_boxes_that_share_a_face(self):
        one, other = (
            gk.mesh.Surface(mesh_catalog.moved(mesh_catalog.box(), (x, 0, 0)), device="cpu") for x in (0.0, 1.0)
        )
        assert len(one.intersecting_triangles(other)) > 0
        apart = gk.mesh.Surface(mesh_catalog.moved(mesh_catalog.box(), (1.0 + 1e-15, 0, 0)), device="cpu")
        assert one.intersecting_triangles(apart).shape == (0, 2)

    def test_a_surface_against_itself_counts_what_touches(self):
        s = gk.mesh.Surface(mesh_catalog.tetrahedron(), device="cpu")
        assert len(s.intersecting_triangles(gk.mesh.Surface(mesh_catalog.tetrahedron(), device="cpu"))) == 16

    def test_other_must_be_a_surface(self):
        with pytest.raises(errors.InputError, match="other: TriangleMesh is not a Surface"):
            surface(*RIGHT_ANGLE).intersecting_triangles(mesh_catalog.box())


class TestSelfIntersections:
    @pytest.mark.slow
    @pytest.mark.parametrize("make", mesh_catalog.CLOSED)
    def test_closed_meshes_have_those_of_brute_force(self, make):
        mesh = make()
        if len(mesh.faces) > 400:
            mesh = gk.mesh.TriangleMesh(mesh.vertices, mesh.faces[:: len(mesh.faces) // 200])
        assert gk.mesh.Surface(mesh, device="cpu").self_intersections().tolist() == reference.intersecting_pairs(
            mesh.vertices[mesh.faces]
        )

    @pytest.mark.parametrize(
        "make", [mesh_catalog.icosphere, mesh_catalog.torus, mesh_catalog.l_profile, mesh_catalog.sliver_fan]
    )
    def test_clean_meshes_have_none(self, make):
        s = gk.mesh.Surface(make(), device="cpu")
        assert s.self_intersections().shape == (0, 2)
        assert not s._has_self_intersections()

    def test_overlapping_spheres_have_some(self):
        s = gk.mesh.Surface(mesh_catalog.overlapping_spheres(), device="cpu")
        assert len(s.self_intersections()) > 10
        assert s._has_self_intersections()

    def test_a_soup_answers_as_the_indexed_mesh(self):
        mesh = mesh_catalog.overlapping_spheres()
        expected = gk.mesh.Surface(mesh, device="cpu").self_intersections()
        found = gk.mesh.Surface(mesh_catalog.soup(mesh), device="cpu").self_intersections()
        np.testing.assert_array_equal(found, expected)

    def test_duplicates_meet(self):
        assert surface(RIGHT_ANGLE[0], [[0, 1, 2], [1, 0, 2], [0, 1, 2]]).self_intersections().tolist() == [
            [0, 1],
            [0, 2],
            [1, 2],
        ]

    def test_folded_over_a_shared_edge(self):
        vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.25, 0.25, 0], [0, -1, 0], [0, 0, 1]]
        assert surface(vertices, [[0, 1, 2], [0, 1, 3]]).self_intersections().tolist() == [[0, 1]]
        assert len(surface(vertices, [[0, 1, 2], [0, 1, 4]]).self_intersections()) == 0
        assert len(surface(vertices, [[0, 1, 2], [0, 1, 5]]).self_intersections()) == 0

    def test_a_t_junction_touches(self):
        vertices = [[0, 0, 0], [2, 0, 0], [0, 1, 0], [1, 0, 0], [1, -1, 0]]
        # Corner 3 of the second triangle lies on an edge of the first, but is not a corner of it.
        assert surface(vertices, [[0, 1, 2], [3, 4, 1]]).self_intersections().tolist() == [[0, 1]]

    def test_a_spike_through_a_shared_vertex(self):
        vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1], [1, 1, -1], [-1, 0, 1], [-1, 0, -1]]
        assert surface(vertices, [[0, 1, 2], [0, 3, 4]]).self_intersections().tolist() == [[0, 1]]
        assert len(surface(vertices, [[0, 1, 2], [0, 5, 6]]).self_intersections()) == 0


class TestFacesThatFaceEachOther:
    def test_two_surfaces_within_a_distance(self):
        one, above, flush = (
            gk.mesh.Surface(gk.mesh.box(size, center=(0, 0, z)), device="cpu")
            for size, z in (((1, 1, 1), 0.0), ((1, 1, 1), 1.001), ((0.5, 0.5, 0.5), 0.25))
        )
        assert one._has_facing(above, 2e-3)
        assert above._has_facing(one, 2e-3)
        assert not one._has_facing(above, 5e-4)
        # The upper walls lie in one plane: they face each other if one body is inside out.
        assert not one._has_facing(flush, 1e-6)
        assert one._has_facing(flush, 1e-6, -1.0)

    def test_bodies_of_one_surface(self):
        both = concatenated(gk.mesh.box(), gk.mesh.box(center=(0, 0, 1.001)))
        body = np.repeat(np.arange(2, dtype=np.int32), 12)
        s = gk.mesh.Surface(both, device="cpu")
        assert s._has_facing(s, 2e-3, body=body)
        assert not s._has_facing(s, 5e-4, body=body)
        assert not s._has_facing(s, 2e-3, body=0 * body)
        assert not s._has_facing(s, 2e-3, body=body - 1)
