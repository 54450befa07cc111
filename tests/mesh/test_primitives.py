"""Simple bodies: closed, wound outwards, as large as they say and as near to the true surface as documented."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from geokit.mesh import box, cone, cylinder, plane, sphere, torus

CENTER = (1.0, -2.0, 3.0)
BODIES = {
    "box": (box((1, 2, 3), center=CENTER), 6.0, 0),
    "sphere": (sphere(2.0, segments=7, center=CENTER), 4 / 3 * np.pi * 8, 0),
    "fine sphere": (sphere(2.0, segments=200, center=CENTER), 4 / 3 * np.pi * 8, 0),
    "cylinder": (cylinder(2.0, 3.0, segments=64, center=CENTER), np.pi * 12, 0),
    "cone": (cone(2.0, 3.0, segments=64, center=CENTER), np.pi * 4, 0),
    "torus": (torus(2.0, 0.5, segments=64, tube_segments=32, center=CENTER), 2 * np.pi**2 * 2 * 0.25, 1),
    "coarse": (torus(2.0, 0.5, segments=3, tube_segments=3, center=CENTER), None, 1),
}


@pytest.mark.parametrize("name", BODIES)
def test_bodies_are_closed_and_wound_outwards(name):
    mesh, volume, handles = BODIES[name]
    report = gk.mesh.audit(mesh, self_intersections=True)
    assert report.watertight
    assert report.manifold
    assert report.oriented
    assert not report.inside_out
    assert report.degenerate_count == report.coincident_count == report.unreferenced_count == 0
    assert report.self_intersection_count == 0
    assert report.euler_number == 2 - 2 * handles
    if volume is not None:
        assert mesh.volume == pytest.approx(volume, rel=0.35 if name == "sphere" else 0.02)
        assert mesh.volume <= volume * (1 + 1e-12)


def deviation(mesh, distance) -> float:
    points = gk.mesh.sample_surface(mesh, 20_000).points - CENTER
    return float(np.abs(distance(points)).max())


@pytest.mark.parametrize("segments", [3, 4, 5, 12, 49])
def test_faces_are_as_near_as_documented(segments):
    one = 1 - np.cos(np.pi / segments)
    found = deviation(sphere(2.0, segments=segments, center=CENTER), lambda p: np.linalg.norm(p, axis=1) - 2.0)
    assert found <= 2.0 * (1 - np.cos(np.pi / segments) ** 2) + 1e-12

    def from_cylinder(points):
        side = np.hypot(points[:, 0], points[:, 1]) - 2.0
        return np.where(np.abs(points[:, 2]) > 1.5 - 1e-9, np.maximum(side, 0.0), side)

    assert deviation(cylinder(2.0, 3.0, segments=segments, center=CENTER), from_cylinder) <= 2.0 * one + 1e-12
    tube = 1 - np.cos(np.pi / 8)
    found = deviation(
        torus(2.0, 0.5, segments=segments, tube_segments=8, center=CENTER),
        lambda p: np.hypot(np.hypot(p[:, 0], p[:, 1]) - 2.0, p[:, 2]) - 0.5,
    )
    assert found <= 2.5 * one + 0.5 * tube + 1e-12


def test_vertices_lie_on_the_surface():
    ball = sphere(3.0, segments=31)
    np.testing.assert_allclose(np.linalg.norm(ball.vertices, axis=1), 3.0, rtol=1e-15)
    assert ball.bounds[:, 2].tolist() == [-3.0, 3.0]


def test_a_plane_faces_upwards():
    mesh = plane((2, 3), segments=4, center=CENTER)
    assert (mesh.vertex_count, len(mesh)) == (25, 32)
    np.testing.assert_array_equal(mesh.face_normals, [[0, 0, 1]] * 32)
    assert mesh.bounds.tolist() == [[0.0, -3.5, 3.0], [2.0, -0.5, 3.0]]
    assert mesh.area == pytest.approx(6.0, rel=1e-15)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: box((1, 0, 1)), "not positive"),
        (lambda: box(1.0), r"size: shape \(\) is not \(3,\)"),
        (lambda: sphere(0.0), "radius"),
        (lambda: sphere(segments=2), "segments: 2 is not a whole number from 3"),
        (lambda: sphere(center=(0, 0)), r"center: shape \(2,\) is not \(3,\)"),
        (lambda: cylinder(1.0, -1.0), "height"),
        (lambda: cone(np.inf, 1.0), "radius"),
        (lambda: torus(1.0, 1.0), "tube_radius: 1 is not less than the radius, 1"),
        (lambda: plane((1, -1)), "not positive"),
        (lambda: plane(segments=0), "segments"),
    ],
)
def test_refused(call, message):
    with pytest.raises(gk.InputError, match=message):
        call()
