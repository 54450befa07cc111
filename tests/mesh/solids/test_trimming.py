"""Bodies that cross themselves: what is left of their surface bounds what they enclose."""

from __future__ import annotations

import numpy as np
import pytest

from geokit.mesh import Surface, TriangleMesh, box, sample_surface, torus
from geokit.mesh.solids import trimming
from geokit.mesh.solids.trimming import trimmed
from geokit.volume.band.fields import TrimmedSurface
from tests.support.assemblies import concatenated, prism_distance, star, star_outline, turned
from tests.support.devices import DEVICES

LENGTH = 0.02


def to_outline(outline: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.abs(prism_distance(outline, 1.0, points))


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("points", "turns"), [(5, 2), (7, 2), (7, 3)])
def test_what_is_left_is_the_boundary(points: int, turns: int, device: str) -> None:
    surface, outline = Surface(star(points, turns), device=device), star_outline(points, turns)
    mesh, source = trimmed(surface, LENGTH)
    made = Surface(mesh, device=device)
    assert (np.diff(source) >= 0).all()
    # Nothing reaches farther inside than a piece is long, and no boundary is missing but next to a crossing.
    assert to_outline(outline, sample_surface(made.mesh, 20_000).points).max() <= LENGTH
    samples = sample_surface(surface.mesh, 20_000).points
    boundary = samples[to_outline(outline, samples) < 1e-12]
    assert 0.3 * len(samples) < len(boundary) < len(samples)
    assert np.asarray(made.closest_point(boundary).distance).max() < LENGTH
    # Each face lies in the one that it comes from.
    corners = surface.mesh.vertices[surface.mesh.faces[source]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    off = np.einsum("fij,fj->fi", made.mesh.vertices[made.mesh.faces] - corners[:, :1], normals)
    assert np.abs(off).max() < 1e-12


def test_signs_are_those_of_the_mesh_that_was_given() -> None:
    surface = Surface(star(), device="cpu")
    made = TrimmedSurface(trimmed(surface, LENGTH)[0], surface)
    points = np.random.default_rng(0).uniform(-1.2, 1.2, (20_000, 3))
    assert np.array_equal(made.contains(points), prism_distance(star_outline(), 1.0, points) < 0.0)
    assert np.array_equal(made.winding_number(points), surface.winding_number(points))
    assert (made.sign_method, made.is_closed) == ("winding", True)
    # A wall that was left out is inside as a whole.
    wall = np.array([[-np.cos(0.4 * np.pi), 0.0, z] for z in np.linspace(-0.4, 0.4, 9)])
    found = made.signed_distance(wall).distance
    assert np.allclose(found, prism_distance(star_outline(), 1.0, wall), rtol=0.0, atol=LENGTH)
    assert made.contains(wall).all()


def test_surface_deep_inside_goes_even_where_it_crosses_other_such_surface() -> None:
    blocks = [box((0.5, 0.5, 0.5)), turned(box((0.5, 0.5, 0.5)), 1), turned(box((0.4, 0.4, 0.4)), 2)]
    made, source = trimmed(Surface(concatenated(box((2, 2, 2)), *blocks), device="cpu"), LENGTH)
    assert source.tolist() == list(range(12))
    assert made.area == 24.0


def test_nothing_is_lost_where_nothing_crosses() -> None:
    mesh = concatenated(torus(segments=24, tube_segments=12), box(center=(5.0, 0.0, 0.0)))
    made, source = trimmed(Surface(mesh, device="cpu"), LENGTH)
    assert np.array_equal(made.faces, mesh.faces)
    assert np.array_equal(source, np.arange(mesh.face_count))


@pytest.mark.slow
def test_pairs_are_looked_at_block_after_block(monkeypatch: pytest.MonkeyPatch) -> None:
    surface = Surface(star(), device="cpu")
    expected, sizes, crosses = trimmed(surface, 0.1), [], trimming._crosses
    monkeypatch.setattr(trimming, "BLOCK", 7)
    monkeypatch.setattr(trimming, "_crosses", lambda a, *others: sizes.append(len(a)) or crosses(a, *others))
    made = trimmed(surface, 0.1)
    assert max(sizes) == 7
    assert np.array_equal(made[0].vertices, expected[0].vertices)
    assert np.array_equal(made[1], expected[1])


def test_what_cannot_be_trimmed(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = star()
    assert trimmed(Surface(TriangleMesh(mesh.vertices, mesh.faces[:-1]), device="cpu"), LENGTH) is None
    assert trimmed(Surface(mesh, device="cpu"), 1e-6) is None
    monkeypatch.setattr(trimming, "MOST_PIECES", 1000)
    assert trimmed(Surface(mesh, device="cpu"), LENGTH) is None
