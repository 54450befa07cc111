"""Contacts of two surfaces: bodies by hand, and what a contact is."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import exact_convex

TETRAHEDRON = gk.mesh.TriangleMesh(
    [[-1.0, -1, -1], [2, 0, 0], [0, 2, 0], [0, 0, 2]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
)


def surface(*meshes):
    starts = np.cumsum([0, *(mesh.vertex_count for mesh in meshes)])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)])
    mesh = gk.mesh.TriangleMesh(np.concatenate([mesh.vertices for mesh in meshes]), faces)
    return gk.mesh.Surface(mesh, device="cpu")


def box(*size, at=(0, 0, 0)):
    return gk.mesh.box(size, center=at)


def moved(by, turned=None):
    matrix = np.eye(4)
    matrix[:3, :3] = np.eye(3) if turned is None else turned
    matrix[:3, 3] = by
    return matrix


def about(axis, degrees):
    x, c, s = np.asarray(axis) / np.linalg.norm(axis), np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return c * np.eye(3) + s * np.cross(np.eye(3), x) + (1 - c) * np.outer(x, x)


def check(found, error=1e-11):
    """What holds of all contacts, of poses that are rigid."""
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1.0, atol=1e-12)
    away = found.separations[:, None] * found.normals
    np.testing.assert_allclose(found.points + away, found.points_other, atol=error)
    assert (found.depths[:, 0] <= found.depths[:, 1] + error).all()
    np.testing.assert_array_equal(np.maximum(-found.separations, 0.0), found.depths[:, 0])
    assert (found.penetrations[:, 0] <= found.penetrations[:, 1] + error).all()
    assert found.offsets[-1] == len(found.points)
    return found


def of(one, other, transform=None, margin=0.0):
    return check(one.contacts(other, transform=transform, margin=margin))


def test_boxes_face_to_face():
    unit, floor = surface(box(1, 1, 1)), surface(box(4, 4, 2, at=(0, 0, -1)))
    found = of(unit, floor, np.stack([moved([0, 0, 0.5 + gap]) for gap in (0.0, 0.25, 1.0)]), margin=0.5)
    assert found.offsets.tolist() == [0, 1, 2, 2]
    assert found.separations.tolist() == [0.0, 0.25]
    assert found.normals.tolist() == [[0, 0, -1]] * 2
    assert found.areas == pytest.approx([1.0, 1.0], abs=1e-9)
    assert found.depths[1].tolist() == [0, 0]
    assert found.penetrations[0] == pytest.approx([0, 0], abs=1e-11)
    below = of(unit, floor, moved([0, 0, 0.25]))
    assert below.separations == pytest.approx([-0.25], abs=1e-15)
    assert below.normals[0] == pytest.approx([0, 0, -1], abs=1e-12)
    assert below.depths[0] == pytest.approx([0.25, 0.25], abs=1e-11)
    assert below.penetrations[0] == pytest.approx([0.25, 0.25], abs=1e-11)


def test_corner_to_face():
    corner = about(np.cross([1, 1, 1], [0, 0, -1]), np.degrees(np.arccos(-(3**-0.5))))
    unit, floor = surface(box(2, 2, 2)), surface(box(8, 8, 2, at=(0, 0, -1)))
    for gap in (0.125, -0.125):
        found = of(unit, floor, moved([0.1, 0.2, 3**0.5 + gap], corner), margin=0.25)
        assert found.separations == pytest.approx([gap], abs=1e-12)
        assert found.points[0] == pytest.approx([0.1, 0.2, gap], abs=1e-12)
        assert found.normals[0] == pytest.approx([0, 0, -1], abs=1e-12)


def test_edge_to_edge():
    """No vertex is inside: the depth is found where the edges cut in."""
    one, other = surface(box(8, 2, 2)), surface(box(2, 8, 2))
    turned = about([1, 0, 0], 45)
    stand = about([0, 1, 0], 45)
    for gap in (0.25, -0.25):
        high = gk.mesh.transform(other.mesh, moved([0, 0, 0], stand))
        found = of(one, surface(high), moved([0, 0, 2 * 2**0.5 + gap], turned), margin=0.3)
        assert len(found.points) == 1
        assert found.normals[0] == pytest.approx([0, 0, -1], abs=1e-9) or gap < 0
        if gap > 0:
            assert found.separations[0] == pytest.approx(gap, abs=1e-12)
        else:
            assert 0.0 < found.depths[0, 0] <= 0.25 + 1e-12
            assert found.penetrations[0, 1] == pytest.approx(0.25, abs=1e-9)


def test_spheres_against_the_formula():
    # The poles lie on the line of centers.
    one, other = (surface(gk.mesh.sphere(1.0, segments=96)) for _ in range(2))
    found = of(one, other, np.stack([moved([0, 0, z]) for z in (2.1, 1.5)]), margin=0.2)
    assert found.separations == pytest.approx([0.1, -0.5], abs=3e-4)  # facets beside the pole are nearer
    assert found.points[1] == pytest.approx([0, 0, 0.5], abs=1e-12)
    assert found.normals == pytest.approx(np.array([[0, 0, -1.0]] * 2), abs=0.04)
    assert found.penetrations[1] == pytest.approx([0.5, 0.5], abs=3e-4)


def test_a_body_that_was_swallowed_is_a_contact():
    inner, outer = surface(box(1, 1, 1)), surface(box(4, 4, 4))
    found = of(inner, outer, moved([0, 0, 0.5]))
    assert found.separations.tolist() == [-1.5]
    assert found.penetrations[0] == pytest.approx([1.5, 2.0], abs=1e-11)
    back = of(outer, inner, moved([0, 0, -0.5]))
    assert back.separations.tolist() == [-1.5]
    # A hollow shell has no inside there.
    shell = surface(box(4, 4, 4), gk.mesh.TriangleMesh(box(3, 3, 3).vertices, box(3, 3, 3).faces[:, ::-1]))
    assert len(of(inner, shell).points) == 0


def test_open_sheets_have_no_inside():
    sheet = surface(gk.mesh.plane((2, 2)))
    upright = about([1, 0, 0], 90)
    crossing = of(sheet, sheet, moved([0.1, 0.2, 0.3], upright))
    assert crossing.separations.tolist() == [0.0]
    assert crossing.depths[0].tolist() == [0.0, 0.0]
    above = of(sheet, sheet, moved([0, 0, 0.25]), margin=0.25)
    assert above.separations.tolist() == [0.25]
    assert above.areas == pytest.approx([4.0])


def test_each_leg_and_each_wall_is_a_contact():
    stool = surface(*(box(1, 1, 4, at=(x, y, 2)) for x in (-2, 2) for y in (-2, 2)), box(6, 6, 1, at=(0, 0, 4.6)))
    floor = surface(box(20, 20, 1, at=(0, 0, -0.5)))
    found = of(stool, floor)
    assert found.areas.tolist() == pytest.approx([1.0] * 4)
    assert found.separations.tolist() == [0.0] * 4
    cup = surface(box(4, 4, 1, at=(0, 0, -0.5)), *(box(1, 4, 3, at=(x, 0, 1.5)) for x in (-2.05, 2.05)))
    ball = surface(gk.mesh.sphere(1.5, segments=48, center=(0, 0, 1.53)))
    found = of(ball, cup, margin=0.1)
    assert found.separations == pytest.approx([0.03, 0.05, 0.05], abs=1e-9)
    assert {tuple(row) for row in found.normals.round(6) + 0.0} == {(0, 0, -1), (1, 0, 0), (-1, 0, 0)}


def test_a_rod_through_a_plate_is_one_contact():
    plate, square = surface(box(6, 6, 1)), np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])

    def rod(*heights):
        vertices = np.concatenate([np.column_stack([square, np.full(4, z)]) for z in heights])
        sides = [
            [[a, b, b + 4], [a, b + 4, a + 4]]
            for ring in range(0, 4 * len(heights) - 4, 4)
            for a, b in ((ring + k, ring + (k + 1) % 4) for k in range(4))
        ]
        top = 4 * len(heights) - 4
        ends = [[0, 2, 1], [0, 3, 2], [top, top + 1, top + 2], [top, top + 2, top + 3]]
        return surface(gk.mesh.TriangleMesh(vertices, np.concatenate([np.reshape(sides, (-1, 3)), ends])))

    found = of(rod(-4, 0.125, 4), plate)
    assert found.separations.tolist() == [-0.375]
    # Without vertices inside each ring is one of its own, and what is between is looked at in the middle of faces.
    assert len(of(rod(-4, 4), plate).points) == 2


@pytest.mark.parametrize(
    "pair", [(TETRAHEDRON, box(2, 2, 2)), (box(2, 2, 2), box(2, 2, 2)), (TETRAHEDRON, box(6, 6, 6))]
)
def test_none_is_missed(pair):
    """Random poses and such that touch, against rational arithmetic; and bounds of the depth against its value."""
    maps = exact_convex.random_maps(np.random.default_rng(3), 1500, 3.0, lattice=0.02)
    found = check(surface(pair[0]).contacts(surface(pair[1]), transform=maps), error=4e-6)
    expected = exact_convex.meet(*pair, maps)
    np.testing.assert_array_equal(np.diff(found.offsets) > 0, expected)
    depth = np.maximum(-exact_convex.widest_gap(*pair, maps), 0.0)
    assert (found.penetrations[:, 0] <= depth + 1e-6).all()
    assert (found.penetrations[:, 1] >= depth - 1e-6)[expected].all()


def test_what_changes_nothing():
    """Each of many poses has the bits of one; swapped surfaces mirror, moved ones move."""
    rng = np.random.default_rng(4)
    one, other = surface(gk.mesh.sphere(1.0, segments=12)), surface(gk.mesh.torus(1.5, 0.5, segments=24))
    maps = np.stack([moved(rng.uniform(-2, 2, 3), about(rng.normal(size=3), rng.uniform(0, 360))) for _ in range(30)])
    found = of(one, other, maps, margin=0.1)
    assert len(found.points) > 10
    for i, map in enumerate(maps):
        single = of(one, other, map, margin=0.1)
        rows = slice(*found.offsets[i : i + 2])
        for field in single._fields[1:-1]:
            np.testing.assert_array_equal(getattr(single, field), getattr(found, field)[rows])
        np.testing.assert_array_equal(single.penetrations[0], found.penetrations[i])
        back = of(other, one, np.linalg.inv(map), margin=0.1)
        # Of edges that cut in, points between those that two faces share are looked at: any of them.
        assert back.separations == pytest.approx(single.separations, abs=0.01)
        same = np.abs(back.separations - single.separations) < 1e-9
        assert same.all() or single.separations[~same].min() > -0.02
        rows = np.array([back.points_other @ map[:3, :3].T + map[:3, 3], -back.normals @ map[:3, :3].T])
        assert rows[:, same] == pytest.approx(np.array([single.points, single.normals])[:, same], abs=1e-6)
        away = np.array([8.0, -16.0, 4.0])
        far = of(one, surface(gk.mesh.transform(other.mesh, moved(away))), moved(away) @ map, margin=0.1)
        assert far.separations == pytest.approx(single.separations, abs=1e-9)
        assert far.areas == pytest.approx(single.areas, abs=1e-9)


def test_depths_bound_what_is_inside():
    """Dense samples of either surface are nowhere deeper than the bound, and no bound is below another."""
    rng = np.random.default_rng(5)
    one, other = surface(gk.mesh.sphere(0.7, segments=10)), surface(gk.mesh.torus(1.5, 0.5, segments=20))
    samples = [gk.mesh.sample_surface(each.mesh, 4000, seed=1).points for each in (one, other)]
    for _ in range(12):
        map = moved(rng.uniform(-1.5, 1.5, 3) * [1, 1, 0.5], about(rng.normal(size=3), rng.uniform(0, 360)))
        found = of(one, other, map)
        placed = samples[0] @ map[:3, :3].T + map[:3, 3]
        deepest = -min(
            other.signed_distance(placed).distance.min(), one.signed_distance(samples[1], transform=map).distance.min()
        )
        assert deepest <= max(found.depths[:, 1].max(initial=0.0), 0.0) + 1e-12
        assert deepest <= found.penetrations[0, 1] + 1e-12
        if deepest > 0.02:
            assert found.separations.min() < 0.0


def test_soups_loose_vertices_and_updates():
    body = box(2, 2, 2)
    soup = surface(gk.mesh.TriangleMesh(body.vertices[body.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3)))
    floor = surface(box(8, 8, 2, at=(0, 0, -1)))
    assert of(soup, floor, moved([0, 0, 0.75])).separations == pytest.approx([-0.25])
    loose = gk.mesh.TriangleMesh(np.concatenate([[[0, 0, -1.5]], body.vertices, [[0, 0, -9]]]), body.faces + 1)
    found = of(surface(loose), floor, moved([0, 0, 0.75]))
    assert found.separations == pytest.approx([-0.25])
    assert found.penetrations[0] == pytest.approx([0.25, 0.25], abs=1e-11)
    assert len(of(surface(loose), floor, moved([0, 0, 1.75])).points) == 0
    floor.update(floor.mesh.vertices - [0, 0, 1])
    assert of(soup, floor, moved([0, 0, 0.75])).separations.tolist() == []
    assert of(soup, floor, moved([0, 0, 0.75]), margin=1.0).separations == pytest.approx([0.75])


@pytest.mark.parametrize("kinds", [(0, 1), (1, 1)], ids=["mesh and level set", "two level sets"])
def test_level_sets_by_their_isosurfaces(kinds):
    """Two balls of a formula: no contact is missed or lies elsewhere by more than the deviation of the isosurface."""
    radius, voxel, rng = (1.0, 0.6), 0.08, np.random.default_rng(3)
    balls, off = [], 0.0
    for size, kind in zip(radius, kinds, strict=True):
        mesh = gk.mesh.sphere(size, segments=48)
        off += size * (1 - np.cos(np.pi / 48)) * 2
        if kind:
            mesh = gk.mesh.from_volume(gk.volume.from_mesh(mesh, voxel, device="cpu"), device="cpu")
            off += voxel / 10
        balls.append(gk.mesh.Surface(mesh, device="cpu"))
    poses = np.tile(np.eye(4), (60, 1, 1))
    along = rng.normal(size=(60, 3))
    apart = rng.uniform(1.0, 1.9, 60)
    poses[:, :3, 3] = along * (apart / np.linalg.norm(along, axis=1))[:, None]
    found, truth = of(*balls, poses, margin=0.1), apart - sum(radius)
    count = np.diff(found.offsets)
    assert (count[truth < 0.1 - off] == 1).all()
    assert (count[truth > 0.1 + off] == 0).all()
    one = count == 1
    np.testing.assert_allclose(found.separations, truth[one], atol=off)
    # Both bounds of the depth, and of the shortest move that parts two balls.
    deep = one & (truth < -off)
    assert (found.penetrations[deep, 0] <= -truth[deep] + off).all()
    assert (found.penetrations[deep, 1] >= -truth[deep] - off).all()


def test_no_poses():
    found = surface(TETRAHEDRON).contacts(surface(TETRAHEDRON), transform=np.zeros((0, 4, 4)))
    assert found.offsets.tolist() == [0]
    assert found.penetrations.shape == (0, 2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"margin": -1.0}, "margin: -1.0 is not a distance"),
        ({"margin": np.inf}, "margin: inf is not a distance"),
        ({"margin": "wide"}, "margin: 'wide' is not a number"),
        ({"transform": 2.0 * np.diag([1, 1, 1, 0.5])}, "transform: .*not a rigid motion"),
        ({"transform": np.eye(3)}, r"transform: shape \(3, 3\)"),
        ({"transform": moved([1e200, 0, 0])}, "transform: it moves a corner beyond"),
    ],
)
def test_refuses(options, message):
    with pytest.raises(gk.errors.InputError, match=message):
        surface(TETRAHEDRON).contacts(surface(TETRAHEDRON), **options)


def test_refuses_what_is_no_surface():
    with pytest.raises(gk.errors.InputError, match="other: TriangleMesh is not a Surface"):
        surface(TETRAHEDRON).contacts(TETRAHEDRON)
    sizes = [
        gk.mesh.TriangleMesh(TETRAHEDRON.vertices, TETRAHEDRON.faces, meters_per_unit=unit) for unit in (0.3, 0.0254)
    ]
    with pytest.raises(gk.errors.InputError, match="meters_per_unit differs"):
        gk.mesh.Surface(sizes[0], device="cpu").contacts(gk.mesh.Surface(sizes[1], device="cpu"))
