"""Differences and intersections of meshes against closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from geokit.errors import InputError, MissingDependencyError
from geokit.mesh import (
    MeshPart,
    Surface,
    TriangleMesh,
    audit,
    box,
    cylinder,
    difference,
    intersection,
    sphere,
    torus,
    union,
)
from geokit.mesh.solids import boundary, operands, pieces
from tests.support.assemblies import blocks, concatenated, in_float32, sheet, star, turned

EMPTY = TriangleMesh([], [])
OPEN = TriangleMesh(box().vertices, box().faces[:-2])
# Name: two meshes, the volumes of what the first has alone and of what both have, and both areas.
PAIRS = {
    "in a corner": (box(), box(center=(0.5, 0.5, 0.5)), 0.875, 0.125, 6.0, 1.5),
    "apart": (box(), box(center=(3.0, 0.0, 0.0)), 1.0, 0.0, 6.0, 0.0),
    "touch in a face": (box(), box(center=(0.0, 0.0, 1.0)), 1.0, 0.0, 6.0, 0.0),
    "touch in an edge": (box(), box(center=(0.0, 1.0, 1.0)), 1.0, 0.0, 6.0, 0.0),
    "touch in a part of a face": (box(), box(center=(0.3, 0.2, 1.0)), 1.0, 0.0, 6.0, 0.0),
    "share a wall": (box((2, 2, 2)), box(center=(0.0, 0.0, 0.5)), 7.0, 1.0, 28.0, 6.0),
    "share a corner": (box((2, 2, 2)), box(center=(0.5, 0.5, 0.5)), 7.0, 1.0, 24.0, 6.0),
    "cut through": (box((2, 2, 2)), box((2, 1, 1)), 6.0, 2.0, 30.0, 10.0),
    "cut in two": (box((3, 1, 1)), box(), 2.0, 1.0, 12.0, 6.0),
    "one in the other": (box((3, 3, 3)), box(), 26.0, 1.0, 60.0, 6.0),
    "the other in the one": (box(), box((3, 3, 3)), 0.0, 1.0, 0.0, 6.0),
    "the same": (box(), box(), 0.0, 1.0, 0.0, 6.0),
    "a cavity": (concatenated(box((3, 3, 3)), TriangleMesh(box().vertices, box().faces[:, ::-1])), box((1, 1, 3)),
                 24.0, 2.0, 64.0, 12.0),
    "what fills a cavity": (box((3, 3, 3)), difference(box((3, 3, 3)), box()), 1.0, 26.0, 6.0, 60.0),
    "blocks that touch": (box((3, 1, 1)), blocks([(-0.5, 0, 0), (0.5, 0, 0)]), 1.0, 2.0, 8.0, 10.0),
    "blocks that overlap": (box((3, 1, 1)), blocks([(-0.25, 0, 0), (0.25, 0, 0)]), 1.5, 1.5, 10.0, 8.0),
    "of blocks that touch": (blocks([(0, 0, 0), (0, 0, 1)]), box(center=(0.0, 0.0, 0.5)), 1.0, 1.0, 8.0, 6.0),
    "with a sheet inside": (concatenated(box(), sheet(0.0, 0.1)), box(center=(0.5, 0.0, 0.0)), 0.5, 0.5, 4.0, 4.0),
}  # fmt: skip


def inside_out(mesh: TriangleMesh) -> TriangleMesh:
    return TriangleMesh(mesh.vertices, mesh.faces[:, ::-1])


def check(found: TriangleMesh, volume: float, area: float, tolerance: float) -> None:
    """A closed mesh of this volume and area; one without faces where there is no volume."""
    if not volume:
        assert found.face_count == 0
        return
    report = audit(found)
    assert report.signed_volume == pytest.approx(volume, rel=tolerance)
    assert found.area == pytest.approx(area, rel=tolerance)
    assert report.boundary_edge_count == 0
    assert report.oriented


@pytest.mark.parametrize("name", PAIRS)
def test_volumes_and_areas_are_those_of_closed_forms(name: str) -> None:
    one, other, alone, common, *areas = PAIRS[name]
    check(difference(one, other), alone, areas[0], 1e-12)
    # The column shrinks by 1e-9: where it fills the cavity, manifold3d leaves a skin of no thickness.
    tolerance = 1e-7 if name == "a cavity" else 1e-12
    for pair in ((one, other), (other, one)):
        check(intersection(*pair), common, areas[1], tolerance)
    assert union(one, other).volume == pytest.approx(union(one).volume + union(other).volume - common, rel=1e-12)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", [name for name in PAIRS if "edge" not in name])
def test_walls_in_one_plane_but_for_rounding_leave_no_skin(name: str, seed: int) -> None:
    one, other, alone, common, *areas = PAIRS[name]
    for single, tolerance in ((False, 1e-6), (True, 1e-4)):
        both = [turned(mesh, seed, 0.3) for mesh in (one, other)]
        one, other = map(in_float32, both) if single else both
        check(difference(one, other), alone, areas[0], tolerance)
        check(intersection(one, other), common, areas[1], tolerance)


@pytest.mark.parametrize("seed", [None, 0])
@pytest.mark.parametrize(
    ("verb", "meshes", "once"),
    [
        (union, PAIRS["in a corner"][:2], True),
        (union, PAIRS["touch in a face"][:2], False),
        (difference, PAIRS["in a corner"][:2], True),
        (difference, PAIRS["share a wall"][:2], False),
        (difference, (box((4, 4, 4)), box(), box(center=(0, 0, 1))), False),
        (intersection, PAIRS["in a corner"][:2], True),
        (intersection, PAIRS["touch in a face"][:2], False),
    ],
)
def test_bodies_are_moved_only_where_faces_of_two_face_each_other_within_contact(
    verb: Any, meshes: Any, once: bool, seed: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []
    for room in (boundary, operands):
        monkeypatch.setattr(room, "combined", lambda *given: made.append(given) or pieces.combined(*given))
    verb(*(mesh if seed is None else turned(mesh, seed, 0.3) for mesh in meshes))
    assert (len(made) == 1) == once


def test_a_rough_wall_that_faces_none_is_joined_all_the_same() -> None:
    teeth, height, at = 100, 1e-4, 100 * 2 + 1
    z, x = np.linspace(0.0, height, at), np.where(np.arange(at) % 2, 0.5 * height / teeth, 0.0)
    outline = np.concatenate([np.stack([x + 1e-9, z], axis=1), [[0.5, height], [0.5, 0.0]]])
    i, count = np.arange(at + 2), at + 2
    j = (i + 1) % count
    cap = np.concatenate([np.stack([i, j, 0 * i + at], axis=1)[: at - 1], [[0, at, at + 1]]])
    walls = [np.stack([i, j, count + j], axis=1), np.stack([i, count + j, count + i], axis=1)]
    rough = TriangleMesh(
        np.concatenate([np.insert(outline, 1, y, axis=1) for y in (0.0, 1.0)]),
        np.concatenate([*walls, cap[:, ::-1], count + cap]),
    )
    flat = box((0.5, 1.0, height), center=(-0.25, 0.5, 0.5 * height))
    assert not Surface(flat, device="cpu")._has_facing(Surface(rough, device="cpu"), 2.5e-6)
    both = union(flat, rough)
    report = audit(both)
    assert (report.component_count, report.watertight, report.oriented) == (1, True, True)
    assert report.signed_volume == pytest.approx(flat.volume + rough.volume, rel=0.02)
    # The wall and the teeth are gone.
    assert both.area == pytest.approx(flat.area + rough.area - (1.0 + 2.0**0.5) * height, abs=0.3 * height)


def test_bodies_that_are_inside_out_are_turned_first() -> None:
    for one in (box(), inside_out(box())):
        for other in (box(center=(0.5, 0.0, 0.0)), inside_out(box(center=(0.5, 0.0, 0.0)))):
            assert audit(difference(one, other)).signed_volume == pytest.approx(0.5)
            assert audit(intersection(one, other)).signed_volume == pytest.approx(0.5)


def test_several_others() -> None:
    cuts = [cylinder(0.2, 2.0, center=(x, 0.0, 0.0), segments=16) for x in (-0.6, 0.0, 0.6)]
    plate, area = box((2, 1, 0.5)), 8.0 * 0.04 * np.sin(np.pi / 8.0)
    assert difference(plate, *cuts).volume == pytest.approx(1.0 - 3.0 * 0.5 * area, rel=1e-12)
    assert intersection(plate, *cuts).face_count == 0
    thirds = [box(center=(0.25 * k, 0.0, 0.0)) for k in range(3)]
    assert intersection(*thirds).volume == pytest.approx(0.5, rel=1e-12)
    # The second one and the third one meet, within rounding, in the middle of the first.
    halves = [turned(box((1, 2, 2), center=(x, 0.0, 0.0)), 3) for x in (-0.5, 0.5)]
    assert difference(turned(box(), 3), *halves).face_count == 0


def test_nothing_and_what_is_alone() -> None:
    one = sphere(segments=12)
    assert difference(one) is one
    assert intersection(one) is one
    assert difference(one, EMPTY) is one
    assert difference(one, box(center=(9.0, 0.0, 0.0))) is one
    for found in (
        difference(EMPTY, one), intersection(EMPTY, one), intersection(one, EMPTY), intersection(one, box(), EMPTY),
        difference(EMPTY), intersection(EMPTY),
    ):  # fmt: skip
        assert found.face_count == found.vertex_count == 0
    assert difference(one, one, name := one).face_count == 0
    assert name is one


@pytest.mark.parametrize("verb", [difference, intersection])
def test_meshes_that_are_open_or_cross_themselves_are_named(verb) -> None:
    near = box(center=(0.1, 0.1, 0.1))
    for bad, why in (
        (OPEN, r"is open: 10 faces are of no closed body, such as face 0; .*from_mesh\(mesh, voxel_size, thickness="),
        (concatenated(near, sheet(2.0)), r"is open: 2 faces are of no closed body, such as face 12; "),
        (star(), r"1\d\.\d% of the surface of bodies lies inside of themselves.*volume.from_mesh\(mesh, v"),
    ):
        for name, meshes in (("mesh", (bad, near)), (r"others\[1\]", (near, near, bad))):
            with pytest.raises(InputError, match=f"^{name}: {why}"):
                verb(*meshes)
    with pytest.raises(InputError, match=r"^others\[0\]"):
        verb(near, 3)
    with pytest.raises(InputError, match=rf"^mesh: a list of meshes; give each of them: {verb.__name__}\(\*meshes\)"):
        verb([near, near])


@pytest.mark.parametrize("verb", [difference, intersection])
def test_units_are_one_world(verb) -> None:
    one = TriangleMesh(box().vertices, box().faces, name="one", meters_per_unit=0.001)
    other = TriangleMesh(box().vertices + 0.5, box().faces, up_axis="z")
    found = verb(one, other)
    assert (found.name, found.meters_per_unit, found.up_axis) == ("one", 0.001, "z")
    inches = TriangleMesh(box().vertices, box().faces, meters_per_unit=0.0254)
    with pytest.raises(InputError, match=r"others\[0\]: meters_per_unit differs: .*convert_unit"):
        verb(one, inches)


@pytest.mark.parametrize("verb", [difference, intersection, union])
def test_faces_keep_their_parts_and_what_all_have(verb) -> None:
    def tagged(mesh: TriangleMesh, begin: int, name: str) -> TriangleMesh:
        rows = begin + np.arange(mesh.face_count)
        more = {"w": np.ones(mesh.face_count)} if begin else {}
        return TriangleMesh(
            mesh.vertices, mesh.faces, name=name, face_data={"row": rows, **more},
            vertex_data={"v": np.ones(mesh.vertex_count)},
        )  # fmt: skip

    one, other = tagged(sphere(segments=16), 0, "one"), tagged(turned(box(), 1, 0.5), 1000, "other")
    found = verb(one, other)
    assert [*found.face_data] == ["row"]
    assert not found.vertex_data
    rows = found.face_data["row"]
    assert (np.diff(rows) >= 0).all()
    assert found.parts == (
        MeshPart("one", 0, int((rows < 1000).sum())),
        MeshPart("other", int((rows < 1000).sum()), int((rows >= 1000).sum())),
    )
    assert all(part.face_count for part in found.parts)
    given = np.concatenate([one.vertices[one.faces], other.vertices[other.faces]])
    source = given[np.where(rows < 1000, rows, rows - 1000 + one.face_count)]
    corners = found.vertices[found.faces]
    normals = [np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]) for c in (corners, source)]
    normals = [n / np.linalg.norm(n, axis=1, keepdims=True) for n in normals]
    side = np.where(rows >= 1000, -1.0, 1.0) if verb is difference else 1.0
    np.testing.assert_allclose((normals[0] * normals[1]).sum(axis=1), side, atol=1e-6)
    height = ((corners - source[:, :1]) * normals[1][:, None]).sum(axis=2)
    assert np.abs(height).max() < 1e-9
    # An operand of several bodies, of which some are united first: rows are those that were given.
    several = concatenated(box(), box(center=(0.3, 0.3, 0.3)))
    several = TriangleMesh(several.vertices, several.faces, face_data={"row": np.arange(24)})
    cut = verb(several, tagged(box(center=(0.6, 0.0, 0.0)), 1000, "other"))
    own = cut.face_data["row"] < 1000
    source = several.vertices[several.faces[cut.face_data["row"][own]]]
    axis = np.ptp(source, axis=1).argmin(axis=1)
    at = np.take_along_axis(source[:, 0], axis[:, None], axis=1)
    found_at = np.take_along_axis(cut.vertices[cut.faces[own]], axis[:, None, None], axis=2)[..., 0]
    np.testing.assert_allclose(found_at, np.broadcast_to(at, found_at.shape), atol=1e-12)


def test_the_same_twice_is_the_same() -> None:
    one, other = sphere(segments=40), turned(torus(0.8, 0.3, segments=50, tube_segments=20), 2, 0.2)
    for verb in (difference, intersection, union):
        first, second = verb(one, other), verb(one, other)
        np.testing.assert_array_equal(first.vertices, second.vertices)
        np.testing.assert_array_equal(first.faces, second.faces)


def test_without_manifold3d_its_name_and_command_are_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "manifold3d", None)
    with pytest.raises(MissingDependencyError, match="needs the package manifold3d"):
        difference(box(), box(center=(0.5, 0.5, 0.5)))
