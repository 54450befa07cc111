"""Fields of several bodies are those of their union: against closed forms, on and off the lattice."""

from __future__ import annotations

import sys
import warnings
from itertools import product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import geokit as gk
from geokit.mesh import TriangleMesh, box, drop_degenerate, merge_vertices, torus
from geokit.mesh.solids import trimming
from geokit.mesh.topology.normals import face_normals
from tests.support.assemblies import concatenated, in_float32, prism_distance, sheet, star, star_outline, tube, turned
from tests.support.effort import of_all

LOW, HIGH = box(center=(0.5, 0.5, 0.5)), box(center=(0.5, 0.5, 1.5))
TWO = concatenated(LOW, HIGH)
WALL_ONCE = drop_degenerate(merge_vertices(TWO), duplicates=True)
OVERLAPPING = concatenated(box((1, 1, 1.3), center=(0.5, 0.5, 0.65)), box((1, 1, 1.3), center=(0.5, 0.5, 1.35)))
DECK = TriangleMesh(sheet().vertices + np.array([0.5, 0.5, 1.0]), sheet().faces)
COLUMNS = {
    "touching": TWO,
    "welded": merge_vertices(TWO),
    "one wall": WALL_ONCE,
    "overlapping": OVERLAPPING,
    "deck": concatenated(box((1, 1, 2), center=(0.5, 0.5, 1.0)), DECK),
}

# Without a search for the best storage, which is not what is asked here.
PLAIN: dict[str, Any] = {"order": 1, "codec": "float", "device": "cpu"}
SMALL: dict[str, Any] = {"order": 3, "codec": "fp16", "device": "cpu"}


def places(field: gk.volume.SparseVolume) -> NDArray[np.float64]:
    """The centers of the active voxels [world]."""
    return np.asarray(gk.volume.active_voxels(field).coordinates) * field.info.voxel_size[0]


def column(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signed distance from the column 1 x 1 x 2 that all of them fill."""
    beyond = np.abs(points - [0.5, 0.5, 1.0]) - [0.5, 0.5, 1.0]
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "voxel_size"),
    # Each on the lattice or off it.
    of_all([*zip(COLUMNS, [0.05, 0.047] * 3, strict=False)], [*product(COLUMNS, (0.05, 0.047))]),
)
def test_values_bodies_offsets_and_rays_are_those_of_the_union(name: str, voxel_size: float) -> None:
    field = gk.volume.from_mesh(COLUMNS[name], voxel_size, device="cpu")
    assert field.info.metadata["geokit:interior"] == "removed"
    values = np.asarray(gk.volume.active_voxels(field).values)
    assert np.abs(values - column(places(field))).max() < 1e-6
    found = gk.mesh.audit(gk.mesh.from_volume(field, method="dual_contouring", device="cpu"))
    assert found.component_count == 1
    assert found.signed_volume == pytest.approx(2.0, rel=0.01)
    assert found.area == pytest.approx(10.0, rel=0.01)
    inner = gk.mesh.audit(gk.mesh.from_volume(gk.volume.offset(field, -0.1), device="cpu"))
    assert inner.component_count == 1
    assert inner.signed_volume == pytest.approx(0.8 * 0.8 * 1.8, rel=0.03)
    hits = gk.volume.raycast(field, [[0.52, 0.49, 1.0], [0.51, 0.48, -3.0]], [[0.0, 0.0, 1.0]] * 2, device="cpu")
    assert np.allclose(hits.t, [1.0, 3.0], atol=0.02)


@pytest.mark.parametrize("made", [turned(TWO, 1), in_float32(turned(TWO, 2, 0.7)), merge_vertices(turned(TWO, 3))])
def test_bodies_that_touch_but_for_rounding(made: TriangleMesh) -> None:
    field = gk.volume.from_mesh(made, 0.05, device="cpu")
    assert field.info.metadata["geokit:interior"] == "removed"
    middle = made.vertices.mean(axis=0)
    assert gk.volume.sample(field, middle, device="cpu") == pytest.approx(-0.15, abs=1e-6)


@pytest.mark.slow
def test_all_makers_of_fields_agree() -> None:
    """Also the other ones: their interior="keep" has the wall."""
    middle = [[0.5, 0.5, 1.0]]
    makers: dict[str, Any] = {
        "tolerance": lambda **options: gk.volume.from_mesh(TWO, tolerance=0.03, within=0.3, **PLAIN, **options),
        "levels": lambda **options: gk.volume.adaptive_from_mesh(TWO, 0.03, within=0.3, **PLAIN, **options),
        "triangles": lambda **options: gk.volume.from_mesh_with_triangles(TWO, 0.1, device="cpu", **options).distance,
    }
    for name, make in makers.items():
        assert make().sample(middle, device="cpu")[0] < -0.2, name
        assert abs(make(interior="keep").sample(middle, device="cpu")[0]) < 0.02, name
    planned = [gk.volume.plan(TWO, 0.01, interior=interior, **PLAIN)[0] for interior in ("remove", "keep")]
    assert planned[0].byte_count <= planned[1].byte_count


def test_nearest_triangles_are_rows_of_the_given_mesh() -> None:
    band = gk.volume.from_mesh_with_triangles(OVERLAPPING, 0.1, device="cpu")
    points = places(band.distance)
    rows = np.asarray(gk.volume.sample(band.triangle_id, points, order=0, device="cpu")).astype(int)
    given = gk.mesh.Surface(gk.mesh.union(OVERLAPPING), device="cpu").closest_point(points)
    corners = OVERLAPPING.vertices[OVERLAPPING.faces[rows]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # The nearest point of the union lies in the plane of the face whose row is given.
    off = np.einsum("ij,ij->i", np.asarray(given.points) - corners[:, 0], normals)
    assert np.abs(off).max() < 1e-6
    assert rows.min() < 12 <= rows.max() < 24


@pytest.mark.parametrize(
    "options",
    [{"interior": "keep"}, {"sign": "parity"}, {"sign": "none"}, {"sign": "pseudonormal"}, {"thickness": 0.1}],
)
def test_who_asks_for_walls_has_them(options: dict[str, Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        field = gk.volume.from_mesh(TWO, 0.1, device="cpu", **options)
    assert "geokit:interior" not in field.info.metadata
    nearest = abs(float(gk.volume.sample(field, [[0.5, 0.5, 1.0]], device="cpu")[0]))
    assert nearest == pytest.approx(0.05 if "thickness" in options else 0.0, abs=1e-6)


def test_one_body_has_the_same_bytes_either_way() -> None:
    mesh = torus(segments=24, tube_segments=12)
    fields = [gk.volume.from_mesh(mesh, 0.1, interior=interior, device="cpu") for interior in ("remove", "keep")]
    assert np.array_equal(fields[0].nanovdb, fields[1].nanovdb)


def test_metadata_are_those_of_the_given_mesh() -> None:
    fields = [gk.volume.from_mesh(TWO, 0.1, interior=interior, device="cpu") for interior in ("remove", "keep")]
    first, second = (field.info.metadata for field in fields)
    assert first["geokit:source_sha256"] == second["geokit:source_sha256"]
    # A part that is wholly inside is not lost, one that is too thin is, with its number among all parts.
    thin = box((0.5, 0.5, 1e-4), center=(5.0, 5.0, 5.0))
    inside = concatenated(box((2, 2, 2)), box(), thin)
    with pytest.warns(UserWarning, match="1 of its pieces are too thin"):
        field = gk.volume.from_mesh(inside, 0.11, device="cpu")
    assert field.info.metadata["geokit:lost_components"] == "2"


@pytest.mark.slow
@pytest.mark.parametrize(("points", "voxel_size"), of_all([(5, 0.05), (7, 0.047)], [*product((5, 7), (0.05, 0.047))]))
def test_a_body_that_crosses_itself(points: int, voxel_size: float) -> None:
    outline = star_outline(points)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        field = gk.volume.from_mesh(star(points), voxel_size, device="cpu")
    assert field.info.metadata["geokit:interior"] == "removed"
    values, expected = np.asarray(gk.volume.active_voxels(field).values), prism_distance(outline, 1.0, places(field))
    assert np.abs(values - expected).max() < 0.25 * voxel_size
    assert np.array_equal(values < 0.0, expected < 0.0)
    inner = gk.mesh.audit(gk.mesh.from_volume(gk.volume.offset(field, -0.05), device="cpu"))
    assert inner.component_count == 1
    kept = gk.volume.from_mesh(star(points), voxel_size, interior="keep", device="cpu")
    assert gk.mesh.audit(gk.mesh.from_volume(gk.volume.offset(kept, -0.05), device="cpu")).component_count > 1


@pytest.mark.slow
@pytest.mark.parametrize("seed", of_all([2], [2, 6, 10]))
def test_a_random_tube_that_crosses_itself(seed: int) -> None:
    """Against samples of its boundary, a tenth of a voxel apart."""
    voxel_size, mesh = 0.05, tube(seed)
    surface = gk.mesh.Surface(mesh, device="cpu")
    samples = gk.mesh.sample_surface(mesh, 200_000, seed=0)
    off = 1e-5 * face_normals(mesh)[samples.triangle_id]
    in_front, behind = (surface.winding_number(samples.points + side * off) > 0.5 for side in (1.0, -1.0))
    assert 0.02 < np.mean(in_front == behind) < 0.3
    boundary = gk.points.NeighborGrid(samples.points[in_front != behind], radius=voxel_size, device="cpu")
    too_near = {}
    for interior in ("remove", "keep"):
        field = gk.volume.from_mesh(mesh, voxel_size, interior=interior, device="cpu")
        values = np.asarray(gk.volume.active_voxels(field).values)
        assert np.array_equal(values < 0.0, surface.winding_number(places(field)) > 0.5)
        depth = boundary.knn(places(field), 1).distance[:, 0] - np.abs(values)
        assert depth.min() > -1e-6
        too_near[interior] = depth.max() / voxel_size
    assert too_near["remove"] < 0.35
    assert too_near["keep"] > 2.0


@pytest.mark.slow
def test_all_makers_of_fields_leave_out_what_a_body_has_inside_of_itself() -> None:
    # A wall passes here.
    place = [[0.0, 0.309, 0.0]]
    depth = float(-prism_distance(star_outline(), 1.0, np.array(place))[0])
    makers: dict[str, Any] = {
        "tolerance": lambda **options: gk.volume.from_mesh(star(), tolerance=0.03, within=0.15, **SMALL, **options),
        "levels": lambda **options: gk.volume.adaptive_from_mesh(star(), 0.03, within=0.15, **SMALL, **options),
        "triangles": lambda **options: (
            gk.volume.from_mesh_with_triangles(star(), 0.1, half_width=6.0, device="cpu", **options).distance
        ),
    }
    for name, make in makers.items():
        assert make().sample(place, device="cpu")[0] == pytest.approx(-depth, abs=0.03), name
        assert abs(make(interior="keep").sample(place, device="cpu")[0]) < 0.05, name
    band = gk.volume.from_mesh_with_triangles(star(), 0.1, device="cpu")
    rows = np.asarray(gk.volume.sample(band.triangle_id, places(band.distance), order=0, device="cpu"))
    assert 0 <= rows.min() < rows.max() < star().face_count


def test_a_body_too_crumpled_is_said_to_keep_its_inner_surface(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trimming, "MOST_PIECES", 10)
    with pytest.warns(UserWarning, match=r"% of the surface of bodies lies inside of themselves.*; interior=\"keep\""):
        gk.volume.from_mesh(star(), 0.1, device="cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gk.volume.from_mesh(star(), 0.1, interior="keep", device="cpu")


@pytest.mark.slow
def test_without_manifold3d_walls_go_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "manifold3d", None)
    for mesh in (TWO, OVERLAPPING):
        field = gk.volume.from_mesh(mesh, 0.05, device="cpu")
        assert np.abs(np.asarray(gk.volume.active_voxels(field).values) - column(places(field))).max() < 0.25 * 0.05


def test_cavities_stay() -> None:
    hole = box()
    shell = concatenated(box((2, 2, 2)), TriangleMesh(hole.vertices, hole.faces[:, ::-1]), box(center=(1.0, 0.0, 0.0)))
    field = gk.volume.from_mesh(shell, 0.1, device="cpu")
    assert gk.volume.sample(field, [[0.0, 0.0, 0.0]], device="cpu")[0] > 0.0
    assert field.info.metadata["geokit:interior"] == "removed"


def test_what_is_not_known_is_refused() -> None:
    with pytest.raises(gk.errors.InputError, match="interior: 'drop' is not known; use one of 'remove', 'keep'"):
        gk.volume.from_mesh(TWO, 0.1, interior="drop", device="cpu")
