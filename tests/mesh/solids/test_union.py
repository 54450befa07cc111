"""Unions of meshes against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from geokit.errors import InputError, MissingDependencyError
from geokit.mesh import (
    MeshPart,
    TriangleMesh,
    audit,
    box,
    cylinder,
    drop_degenerate,
    merge_vertices,
    sphere,
    torus,
    union,
)
from tests.support.assemblies import blocks, concatenated, in_float32, sheet, turned


def hollow(inner: float) -> TriangleMesh:
    """A cube of 3 with a cubic cavity."""
    hole = box((inner, inner, inner))
    return concatenated(box((3, 3, 3)), TriangleMesh(hole.vertices, hole.faces[:, ::-1]))


def placed(mesh: TriangleMesh, by: tuple[float, float, float]) -> TriangleMesh:
    return TriangleMesh(mesh.vertices + by, mesh.faces)


OPEN = TriangleMesh(box(center=(0.0, 0.0, 5.0)).vertices, box().faces[:-2])
PEG = cylinder(0.5, 1.0, center=(0.0, 0.0, 1.5))
# Name: the mesh, and the volume and area of what its bodies enclose.
ASSEMBLIES = {
    "touch in a face": (blocks([(0, 0, 0), (0, 0, 1)]), 2.0, 10.0),
    "touch in an edge": (blocks([(0, 0, 0), (0, 1, 1)]), 2.0, 12.0),
    "touch in a corner": (blocks([(0, 0, 0), (1, 1, 1)]), 2.0, 12.0),
    "touch in a part of a face": (blocks([(0, 0, 0), (0.3, 0.2, 1)]), 2.0, 12.0 - 2.0 * 0.7 * 0.8),
    "overlap": (blocks([(0, 0, 0), (0.5, 0.5, 0.5)]), 1.875, 10.5),
    "the same twice": (blocks([(0, 0, 0), (0, 0, 0)]), 1.0, 6.0),
    "one in the other": (concatenated(box((2, 2, 2)), box()), 8.0, 24.0),
    "flush within the other": (concatenated(box((2, 2, 2)), box(center=(0.5, 0.5, 0.5))), 8.0, 24.0),
    "a wall of 27 blocks": (blocks([(i, j, k) for i in range(3) for j in range(3) for k in range(3)]), 27.0, 54.0),
    "crossed beams": (concatenated(box((9, 1, 1)), box((1, 9, 1), center=(0, 0, 1))), 18.0, 2 * 38.0 - 2.0),
    "a peg on a block": (concatenated(box((2, 2, 2)), PEG), 8.0 + PEG.volume, None),
    "hollow": (hollow(2.0), 19.0, 78.0),
    "hollow, and there twice": (concatenated(hollow(2.0), hollow(2.0)), 19.0, 78.0),
    "hollow ones that touch in a face": (concatenated(hollow(2.0), placed(hollow(2.0), (3, 0, 0))), 38.0, 138.0),
    "a block beside a hollow one": (concatenated(box((3, 3, 3)), placed(hollow(2.0), (0, 3, 0))), 46.0, 114.0),
    "hollow with a core": (concatenated(hollow(2.0), box()), 20.0, 84.0),
    "hollow with a core that touches": (concatenated(hollow(2.0), box((2, 1, 1))), 21.0, 54.0 + 24.0 + 8.0 - 2.0),
    "filled": (concatenated(hollow(2.0), box((2, 2, 2))), 27.0, 54.0),
    "overfilled": (concatenated(hollow(2.0), box((2.5, 2.5, 2.5))), 27.0, 54.0),
    "a partition": (concatenated(box(), sheet()), 1.0, 6.0),
    "three decks": (concatenated(box(), *(sheet(z, 0.1) for z in (-0.25, 0.0, 0.25))), 1.0, 6.0),
}


def cleaned(mesh: TriangleMesh) -> TriangleMesh:
    """Of two faces of a contact, one."""
    return drop_degenerate(merge_vertices(mesh), duplicates=True)


@pytest.mark.parametrize("way", ["as exported", "welded", "moved", "inside out"])
@pytest.mark.parametrize("name", ASSEMBLIES)
def test_unions_have_the_volume_and_the_area_of_closed_forms(name: str, way: str) -> None:
    mesh, volume, area = ASSEMBLIES[name]
    if way == "welded":
        mesh = merge_vertices(mesh)
    elif way == "moved":
        mesh = TriangleMesh(mesh.vertices * 2.0**-20 + 1024.0, mesh.faces)
        volume, area = volume * 2.0**-60, area and area * 2.0**-40
    elif way == "inside out":
        if name in ("a partition", "three decks") or audit(mesh).non_manifold_edge_count:
            pytest.skip("windings of bodies that share edges are taken as they are")
        mesh = TriangleMesh(mesh.vertices, mesh.faces[:, ::-1])
    found = audit(union(mesh))
    assert found.signed_volume == pytest.approx(volume, rel=1e-9)
    assert area is None or found.area == pytest.approx(area, rel=1e-9)
    assert found.boundary_edge_count == 0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", [name for name in ASSEMBLIES if name != "a partition"])
def test_contacts_within_rounding_are_contacts(name: str, seed: int) -> None:
    """Turned bodies share planes but for the rounding of float64, and of float32 as in a binary .stl."""
    mesh, volume, area = ASSEMBLIES[name]
    size = float(np.ptp(mesh.vertices, axis=0).max())
    for made, growth in ((turned(mesh, seed), 1e-8), (in_float32(turned(mesh, seed, 0.3)), 5e-6)):
        found = audit(union(made))
        tolerance = growth * size * (area or 30.0)
        assert found.signed_volume == pytest.approx(volume, abs=tolerance)
        if area is not None and "edge" not in name and "corner" not in name:
            assert found.area == pytest.approx(area, abs=tolerance)


@pytest.mark.parametrize("name", ["touch in a face", "a wall of 27 blocks"])
def test_a_wall_that_is_there_once_is_removed_too(name: str) -> None:
    mesh, volume, area = ASSEMBLIES[name]
    for each in (cleaned(mesh), cleaned(turned(mesh, 4))):
        found = audit(union(each))
        assert found.signed_volume == pytest.approx(volume, rel=1e-9)
        assert found.area == pytest.approx(area, rel=1e-9)


def test_there_is_nothing_to_remove_in_one_body() -> None:
    apart = concatenated(box(), sheet(3.0))
    for mesh in (box(), sphere(segments=12), hollow(1.0), sheet(), apart, TriangleMesh([], [])):
        assert union(mesh) is mesh


def test_bodies_that_are_near_but_do_not_touch_stay_as_they_are() -> None:
    near = concatenated(box(), box(center=(0.0, 0.0, 1.0001)))
    assert union(near) is near
    # Their boxes overlap.
    quarter = [[1, 0, 0, 1], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
    linked = concatenated(torus(1.0, 0.2), gk.mesh.transform(torus(1.0, 0.2), quarter))
    assert union(linked) is linked


def test_bodies_that_are_inside_out_are_turned() -> None:
    def inside_out(mesh: TriangleMesh) -> TriangleMesh:
        return TriangleMesh(mesh.vertices, mesh.faces[:, ::-1])

    one = box((1, 1, 1))
    apart, around, cavity = box((1, 1, 1), center=(3, 0, 0)), box((3, 3, 3)), box((0.5, 0.5, 0.5))
    for other, volume in (
        (one, 1.0),
        (apart, 2.0),
        (around, 26.0),
        (cavity, 0.875),
        (box((1, 1, 1), center=(0.5, 0, 0)), 1.5),
    ):
        for meshes in ((one, inside_out(other)), (inside_out(other), one)):
            # Several meshes, and the usual form of a file: one that holds all bodies.
            for found in (union(*meshes), union(concatenated(*meshes))):
                np.testing.assert_allclose(audit(found).signed_volume, volume)
                assert audit(found).watertight
    rows = np.arange(36).reshape(12, 3)
    alone = TriangleMesh(one.vertices, one.faces[:, ::-1], name="one", corner_data={"row": rows})
    found = union(alone)
    assert (audit(found).signed_volume, found.name) == (1.0, "one")
    np.testing.assert_array_equal(found.corner_data["row"], rows[:, ::-1])


def test_of_faces_for_each_side_one_is_left() -> None:
    one = box((1, 1, 1))
    twice = TriangleMesh(
        one.vertices, np.concatenate([one.faces, one.faces[:, ::-1]]), face_data={"row": np.arange(24)}
    )
    found = union(twice)
    assert (found.face_count, found.volume, len(found.face_data["row"])) == (12, 1.0, 12)


def test_sheets_outside_stay() -> None:
    mesh = concatenated(blocks([(0, 0, 0), (0, 0, 1)]), sheet(5.0))
    found = union(mesh)
    assert found.face_count == 22
    assert found.bounds[1, 2] == 5.0


def test_several_meshes_are_parts_and_what_they_say_is_kept() -> None:
    low = TriangleMesh(box().vertices, box().faces, name="low", meters_per_unit=0.001)
    high = TriangleMesh(box(center=(0, 0, 1)).vertices, box().faces, name="high", up_axis="z")
    found = union(low, high)
    assert found.parts == (MeshPart("low", 0, 10), MeshPart("high", 10, 10))
    assert (found.name, found.meters_per_unit, found.up_axis) == ("low", 0.001, "z")
    assert (found.area, found.volume) == (10.0, 2.0)


def test_faces_keep_their_attributes() -> None:
    mesh = blocks([(0, 0, 0), (0, 0, 1)])
    tagged = TriangleMesh(mesh.vertices, mesh.faces, face_data={"row": np.arange(24)}, vertex_data={"w": np.ones(16)})
    found = union(tagged)
    assert list(found.vertex_data) == []
    corners, source = found.vertices[found.faces], mesh.vertices[mesh.faces[found.face_data["row"]]]
    normals = [np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]) for c in (corners, source)]
    assert np.allclose(normals[0], normals[1])
    assert (np.diff(found.face_data["row"]) >= 0).all()


def test_units_that_differ_are_refused() -> None:
    meters = TriangleMesh(box().vertices, box().faces, meters_per_unit=1.0)
    inches = TriangleMesh(box().vertices, box().faces, meters_per_unit=0.0254)
    with pytest.raises(InputError, match=r"others\[0\]: meters_per_unit differs: .*convert_unit"):
        union(meters, inches)
    with pytest.raises(InputError, match=r"others\[0\]"):
        union(meters, 3)  # type: ignore[arg-type]


def test_a_list_of_meshes_is_refused_with_the_way_out() -> None:
    for meshes in ([box(), box()], (box(),)):
        with pytest.raises(InputError, match=r"^mesh: a (list|tuple) of meshes; give each of them: union\(\*meshes\)"):
            union(meshes)


def test_without_manifold3d_its_name_and_command_are_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "manifold3d", None)
    with pytest.raises(
        MissingDependencyError, match="a union, difference or intersection of solids needs the package manifold3d"
    ):
        union(ASSEMBLIES["overlap"][0])
    # Fields need no exact union, unless bodies are open as well.
    field = gk.volume.from_mesh(ASSEMBLIES["overlap"][0], 0.1, device="cpu")
    assert field.info.metadata["geokit:interior"] == "removed"
    with pytest.warns(UserWarning, match="surface inside of the solid stays in the field, because .*manifold3d"):
        gk.volume.from_mesh(concatenated(ASSEMBLIES["overlap"][0], OPEN), 0.1, sign="winding", device="cpu")
