"""Winding numbers on a lattice are exact, also where lines meet edges, corners and faces; closed meshes are told."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from benchmarks.catalog import mesh_catalog
from geokit.volume.streamed import windings
from geokit.volume.streamed.survey import survey
from geokit.volume.streamed.windings import ColumnWindings, CornerWindings

# The infinitesimal shifts as small numbers: each is far below the distances that the one before it makes.
SHIFT = Fraction(1, 10**4), Fraction(1, 10**9), Fraction(1, 10**14)


def by_fractions(corners: np.ndarray, point: list[float]) -> int:
    """Winding number at a shifted point: crossings with a ray along -x, in rational numbers."""
    p = [Fraction(x) + shift for x, shift in zip(point, SHIFT, strict=True)]
    total = 0
    across = corners[:, :, 1:]
    near = ((across.min(axis=1) <= np.add(point[1:], 0.1)) & (across.max(axis=1) >= point[1:])).all(axis=1)
    for triangle in corners[near].tolist():
        a, b, c = ([Fraction(x) for x in corner] for corner in triangle)
        areas = [(s[1] - p[1]) * (t[2] - p[2]) - (s[2] - p[2]) * (t[1] - p[1]) for s, t in ((b, c), (c, a), (a, b))]
        if not (all(area > 0 for area in areas) or all(area < 0 for area in areas)):
            continue
        x = sum(area * corner[0] for area, corner in zip(areas, (a, b, c), strict=True)) / sum(areas)
        if x < p[0]:
            total -= 1 if areas[0] > 0 else -1
    return total


def on_the_lattice(name: str) -> np.ndarray:
    """Corners of a closed mesh on multiples of 1/2, so that lines of the lattice meet edges and corners."""
    mesh = {
        "box": mesh_catalog.box,
        "nested": mesh_catalog.nested_boxes,
        "l": mesh_catalog.l_profile,
        "touching": mesh_catalog.two_boxes_touching_at_a_vertex,
        "tetrahedron": mesh_catalog.tetrahedron,
        "sphere": lambda: mesh_catalog.icosphere(1),
        "overlapping": mesh_catalog.overlapping_spheres,
        "torus": lambda: mesh_catalog.torus(9, 7),
    }[name]()
    extent = mesh.bounds[1] - mesh.bounds[0]
    return (np.rint((mesh.vertices - mesh.bounds[0]) * (10.0 / extent.max())) / 2.0)[mesh.faces]


@pytest.mark.parametrize("pairs", [1 << 16, 7])
@pytest.mark.parametrize("name", ["box", "nested", "l", "touching", "tetrahedron", "sphere", "overlapping", "torus"])
def test_they_are_those_of_rational_numbers(name: str, pairs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(windings, "PAIRS", pairs)
    corners = on_the_lattice(name)
    lattice = tuple(np.arange(-1.0, 6.5, 0.5) for _ in range(3))
    few, many = CornerWindings(lattice, 0), ColumnWindings(corners, lattice, 0)
    few.add(corners[::2])
    few.add(corners[1::2])
    found = few.numbers()
    places = np.stack(np.meshgrid(*(np.arange(len(axis)) for axis in lattice), indexing="ij"), axis=-1).reshape(-1, 3)
    np.testing.assert_array_equal(many.at(places), found[tuple(places.T)])
    some = np.random.default_rng(5).permutation(places)[:150]
    points = np.stack([lattice[k][some[:, k]] for k in range(3)], axis=1)
    np.testing.assert_array_equal(many.at(some), [by_fractions(corners, point) for point in points.tolist()])
    assert found.any()
    assert not found[0].any()
    assert not found[-1].any()


def test_a_lattice_that_begins_inside_continues_from_what_is_known() -> None:
    corners = on_the_lattice("nested")
    whole = tuple(np.arange(-1.0, 6.5, 0.5) for _ in range(3))
    numbers = CornerWindings(whole, 0)
    numbers.add(corners)
    expected = numbers.numbers()
    for first in ((4, 5, 3), (2, 2, 2), (7, 9, 6)):
        part = tuple(axis[start:] for axis, start in zip(whole, first, strict=True))
        numbers = CornerWindings(part, int(expected[first]))
        numbers.add(corners)
        np.testing.assert_array_equal(numbers.numbers(), expected[first[0] :, first[1] :, first[2] :])


@pytest.mark.slow
def test_planes_that_float64_cannot_tell_from_the_lattice() -> None:
    """Slanted faces through lattice points, moved by an ulp or not."""
    rng = np.random.default_rng(8)
    for _ in range(8):
        corners = on_the_lattice("tetrahedron")
        corners = np.where(rng.random(corners.shape) < 0.5, corners, np.nextafter(corners, rng.choice([-9.0, 9.0])))
        # The same corner moves alike in all its faces.
        _, first, group = np.unique(np.rint(2 * corners.reshape(-1, 3)), axis=0, return_index=True, return_inverse=True)
        corners = corners.reshape(-1, 3)[first][group.reshape(-1)].reshape(-1, 3, 3)
        lattice = tuple(np.arange(-0.5, 6.0, 0.5) for _ in range(3))
        places = rng.integers(0, 12, (30, 3))
        points = np.stack([lattice[k][places[:, k]] for k in range(3)], axis=1)
        expected = [by_tiny_fractions(corners, point) for point in points.tolist()]
        np.testing.assert_array_equal(ColumnWindings(corners, lattice, 0).at(places), expected)


def by_tiny_fractions(corners: np.ndarray, point: list[float]) -> int:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(globals(), "SHIFT", tuple(Fraction(1, 10**k) for k in (400, 900, 1500)))
        return by_fractions(corners, point)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_closed_meshes_are_told_from_open_ones(dtype: type) -> None:
    for make in (*mesh_catalog.CLOSED, *mesh_catalog.OPEN, mesh_catalog.flipped_faces, mesh_catalog.inside_out_box):
        mesh = make()
        corners = mesh.vertices[mesh.faces].astype(dtype)
        found = survey([part for part in (corners[:5], corners[5:]) if len(part)])
        assert found.closed == (make in (*mesh_catalog.CLOSED, mesh_catalog.inside_out_box)), mesh.name
        assert found.inside_out == (make is mesh_catalog.inside_out_box), mesh.name
        assert found.face_count == mesh.face_count
        np.testing.assert_allclose(found.bounds, mesh.bounds, rtol=1e-6)


def test_a_missing_face_among_many_is_noticed() -> None:
    sphere = mesh_catalog.icosphere(4)
    corners = sphere.vertices[sphere.faces]
    assert survey([corners]).closed
    assert not survey([np.delete(corners, 777, axis=0)]).closed
    assert not survey([np.concatenate([corners, corners[:1]])]).closed
    assert survey([np.concatenate([corners, corners[:1], corners[:1, ::-1]])]).closed
