"""Queries of surfaces and volumes that `transform` places: as of what was moved, in the world's coordinates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.errors import InputError

POSE = np.eye(4)
# A turn about (1, 2, 2) / 3 by 40 degrees, by Rodrigues' formula.
_AXIS, _ANGLE = np.array([1.0, 2.0, 2.0]) / 3.0, np.radians(40.0)
_SKEW = np.array([[0, -_AXIS[2], _AXIS[1]], [_AXIS[2], 0, -_AXIS[0]], [-_AXIS[1], _AXIS[0], 0]])
POSE[:3, :3] += np.sin(_ANGLE) * _SKEW + (1.0 - np.cos(_ANGLE)) * _SKEW @ _SKEW
POSE[:3, 3] = [5.0, -3.0, 2.0]
MESH = mesh_catalog.torus(24, 12)
RANDOM = np.random.default_rng(4)
POINTS = RANDOM.uniform(-2.0, 2.0, (300, 3)) + POSE[:3, 3]
HEADINGS = RANDOM.normal(size=(300, 3))


@pytest.fixture(scope="module")
def placed() -> gk.mesh.Surface:
    return gk.mesh.Surface(MESH, device="cpu")


@pytest.fixture(scope="module")
def moved() -> gk.mesh.Surface:
    return gk.mesh.Surface(gk.mesh.transform(MESH, POSE), device="cpu")


def same(answer: Any, expected: Any, *, atol: float = 1e-12) -> None:
    for name, one, other in zip(answer._fields, answer, expected, strict=True):
        if name == "triangle_id":
            assert np.array_equal(one < 0, other < 0)  # a point may be as near to several triangles
        elif name != "barycentric":
            assert np.allclose(one, other, rtol=0.0, atol=atol, equal_nan=True), name


@pytest.mark.parametrize("reach", [np.inf, 0.3])
def test_points_as_of_the_moved_mesh(placed, moved, reach: float) -> None:
    found = placed.closest_point(POINTS, max_distance=reach, transform=POSE)
    same(found, moved.closest_point(POINTS, max_distance=reach))
    signed = placed.signed_distance(POINTS, max_distance=reach, transform=POSE)
    same(signed, moved.signed_distance(POINTS, max_distance=reach))
    hit = found.triangle_id >= 0
    assert 20 < hit.sum() <= (300 if reach == np.inf else 200)
    # The points stand where the moved triangles are.
    corners = moved.mesh.vertices[MESH.faces[found.triangle_id[hit]]]
    assert np.allclose(np.einsum("nk,nkd->nd", found.barycentric[hit], corners), found.points[hit], atol=1e-12)
    inside = placed.contains(POINTS, transform=POSE)
    assert np.array_equal(inside, moved.contains(POINTS))
    assert 10 < inside.sum() < 290


def test_rays_as_of_the_moved_mesh(placed, moved) -> None:
    for limits in ({}, {"t_min": 0.2, "max_distance": 1.0}):
        hits = placed.raycast(POINTS, HEADINGS, transform=POSE, **limits)
        same(hits, moved.raycast(POINTS, HEADINGS, **limits), atol=1e-10)
    assert 10 < np.isfinite(hits.t).sum() < 280


def test_by_hand(placed) -> None:
    """What the option saves: the rows go to the surface by the inverse, and points come back."""
    turn, shift = POSE[:3, :3], POSE[:3, 3]
    found = placed.closest_point((POINTS - shift) @ turn)
    answer = placed.closest_point(POINTS, transform=POSE.tolist())
    assert np.allclose(found.points @ turn.T + shift, answer.points, atol=1e-13)
    assert np.allclose(found.distance, answer.distance, atol=1e-13)
    hits = placed.raycast((POINTS - shift) @ turn, HEADINGS @ turn).t
    assert np.allclose(hits, placed.raycast(POINTS, HEADINGS, transform=POSE).t, atol=1e-12)


def to_body(points: np.ndarray, pose: np.ndarray = POSE) -> np.ndarray:
    """By hand: float64 rows where the body stands."""
    return (points - pose[:3, 3]) @ pose[:3, :3]


def test_signs_by_hand(placed) -> None:
    for as_given in (False, True):
        winding = placed.winding_number(POINTS, as_given=as_given, transform=POSE)
        assert np.allclose(winding, placed.winding_number(to_body(POINTS), as_given=as_given), atol=1e-9)
    assert 10 < (winding > 0.5).sum() < 290
    confidence = placed.sign_confidence(POINTS, transform=POSE)
    assert np.array_equal(confidence, np.abs(placed.winding_number(POINTS, transform=POSE) - 0.5))


def test_furthest_points_by_hand(placed) -> None:
    found = placed.furthest_point(POINTS, transform=POSE)
    corners = MESH.vertices @ POSE[:3, :3].T + POSE[:3, 3]
    apart = np.linalg.norm(POINTS[:, None] - corners[None], axis=2)
    assert np.allclose(found.distance, apart.max(axis=1), atol=1e-12)
    assert np.allclose(np.linalg.norm(found.points - POINTS, axis=1), found.distance, atol=1e-12)
    assert all(
        np.abs(corners[MESH.faces[t]] - p).sum(axis=1).min() < 1e-12 for t, p in zip(found[2], found[0], strict=True)
    )


def test_all_crossings_by_hand(placed) -> None:
    turned = HEADINGS @ POSE[:3, :3]
    for limits in ({}, {"t_min": 0.2, "max_distance": 2.0}):
        found = placed.raycast_all(POINTS, HEADINGS, transform=POSE, **limits)
        expected = placed.raycast_all(to_body(POINTS), turned, **limits)
        assert np.array_equal(found.offsets, expected.offsets)
        assert np.array_equal(found.triangle_id, expected.triangle_id)
        assert np.allclose(found.t, expected.t, rtol=0.0, atol=1e-10)
        assert np.allclose(found.barycentric, expected.barycentric, rtol=0.0, atol=1e-8)
        count = placed.crossing_count(POINTS, HEADINGS, transform=POSE, **limits)
        assert np.array_equal(count, np.diff(found.offsets))
        hidden = placed.occluded(POINTS, HEADINGS, transform=POSE, **limits)
        assert np.array_equal(hidden, count > 0)
        assert 10 < hidden.sum() < 290
    alone = placed.raycast_all(POINTS[0], HEADINGS[0], transform=POSE)
    assert alone.offsets.shape == (2,)
    assert alone.t.shape == (alone.offsets[1],)


def test_many_surfaces_by_hand() -> None:
    """Each mesh has a map of its own, one has no rows."""
    back = np.linalg.inv(POSE)
    poses = np.stack([POSE, np.eye(4), back, POSE @ POSE])
    bodies = [MESH, mesh_catalog.icosphere(2), mesh_catalog.icosphere(1), MESH]
    many = gk.mesh.Surfaces(bodies, device="cpu")
    offsets = np.array([0, 100, 200, 200, 300])
    points = np.concatenate(
        [(RANDOM.uniform(-2, 2, (100, 3))) @ poses[m, :3, :3].T + poses[m, :3, 3] for m in (0, 1, 3)]
    )
    local, heading = points.copy(), HEADINGS.copy()
    for m, pose in enumerate(poses):
        rows = slice(offsets[m], offsets[m + 1])
        local[rows], heading[rows] = to_body(points[rows], pose), HEADINGS[rows] @ pose[:3, :3]
    for sign in ("auto", "winding", "parity"):
        found = many.signed_distance(points, offsets, sign=sign, transform=poses)
        expected = many.signed_distance(local, offsets, sign=sign)
        assert np.allclose(found.distance, expected.distance, rtol=0.0, atol=1e-12)
        inside = many.contains(points, offsets, sign=sign, transform=poses.tolist())
        assert np.array_equal(inside, found.distance < 0)
        assert 10 < inside.sum() < 290
    nearest = many.closest_point(points, offsets, max_distance=0.5, transform=poses)
    assert np.allclose(nearest.distance, many.closest_point(local, offsets, max_distance=0.5).distance, atol=1e-12)
    hit = nearest.triangle_id >= 0
    assert 20 < hit.sum() < 280
    assert np.allclose(np.linalg.norm(nearest.points - points, axis=1)[hit], nearest.distance[hit], atol=1e-12)
    assert np.isnan(nearest.points[~hit]).all()
    hits = many.raycast(points, HEADINGS, offsets, transform=poses)
    expected = many.raycast(local, heading, offsets)
    assert np.allclose(hits.t, expected.t, rtol=0.0, atol=1e-10)
    assert 10 < np.isfinite(hits.t).sum() < 290
    box = points[:200].reshape(4, 50, 3)
    assert many.closest_point(box.astype(np.float32), transform=poses).points.dtype == np.float32
    for m in range(4):
        one = gk.mesh.Surface(bodies[m], device="cpu").closest_point(box[m], transform=poses[m])
        assert np.array_equal(many.closest_point(box, transform=poses).distance[m], one.distance)


@pytest.mark.parametrize(
    ("bad", "says"),
    [
        (np.eye(4), r"shape \(4, 4\) is not \(2, 4, 4\)"),
        (np.stack([np.eye(4), np.diag([2.0, 1.0, 1.0, 1.0])]), "map 1 is not a rigid motion"),
        (np.stack([np.full((4, 4), np.inf), np.eye(4)]), "map 0 .* give finite numbers"),
        (np.stack([np.eye(4), np.ones((4, 4))]), "map 1 .* last row"),
    ],
)
def test_what_are_no_poses_is_refused(bad: np.ndarray, says: str) -> None:
    many = gk.mesh.Surfaces([MESH, MESH], device="cpu")
    for ask in (many.closest_point, many.signed_distance, many.contains):
        with pytest.raises(InputError, match=says):
            ask(POINTS, [0, 1, 300], transform=bad)
    with pytest.raises(InputError, match=says):
        many.raycast(POINTS, HEADINGS, [0, 1, 300], transform=bad)


def test_volumes_by_hand() -> None:
    turn = POSE[:3, :3]
    sdf = gk.volume.from_mesh(MESH, 0.05, half_width=8.0, device="cpu")
    local = to_body(POINTS)
    for order in (1, 3):
        asked = {"order": order, "device": "cpu"}
        value = sdf.sample(POINTS, transform=POSE, **asked)
        steep = sdf.gradient(POINTS, transform=POSE, **asked)
        assert np.allclose(value, sdf.sample(local, **asked), rtol=0.0, atol=1e-12)
        assert np.allclose(steep, sdf.gradient(local, **asked) @ turn.T, rtol=0.0, atol=1e-9)
    assert np.array_equal(value, gk.volume.sample(volume=sdf, points=POINTS, transform=POSE, **asked))
    assert (np.linalg.norm(steep, axis=1) > 0.5).sum() > 30
    assert sdf.gradient(POINTS[0], transform=POSE, device="cpu").shape == (3,)
    hits = sdf.raycast(POINTS, HEADINGS, transform=POSE, device="cpu")
    expected = sdf.raycast(local, HEADINGS @ turn, device="cpu")
    hit = np.isfinite(expected.t)
    assert 10 < hit.sum() < 280
    assert np.allclose(hits.t, expected.t, rtol=0.0, atol=1e-9)
    assert np.allclose(hits.points[hit], (POINTS + hits.t[:, None] * HEADINGS)[hit], rtol=0.0, atol=1e-9)
    assert np.allclose(hits.normals[hit], (expected.normals @ turn.T)[hit], rtol=0.0, atol=1e-6)


def test_volumes_that_cannot_be_placed() -> None:
    sdf = gk.volume.from_mesh(MESH, 0.2, device="cpu")
    vectors = gk.volume.gradient_field(sdf, device="cpu")
    for ask in (gk.volume.sample, gk.volume.gradient):
        with pytest.raises(InputError, match="space: index coordinates move with the volume"):
            ask(sdf, POINTS, space="index", transform=POSE)
        with pytest.raises(InputError, match="transform: vectors of type vec3f may have to turn too"):
            ask(vectors, POINTS, transform=POSE)
        with pytest.raises(InputError, match="not a rigid motion"):
            ask(sdf, POINTS, transform=scaled(2.0))
        with pytest.raises(InputError, match="volume"):
            ask(3, POINTS, transform=POSE)
    with pytest.raises(InputError, match="not a rigid motion"):
        sdf.raycast(POINTS, HEADINGS, transform=scaled(2.0))


def test_nothing_moves_nothing(placed) -> None:
    plain, unmoved = placed.signed_distance(POINTS), placed.signed_distance(POINTS, transform=np.eye(4))
    for one, other in zip(plain, unmoved, strict=True):
        assert np.array_equal(one, other)
    for one, other in zip(plain, placed.signed_distance(POINTS, transform=None), strict=True):
        assert np.array_equal(one, other)


def test_the_other_surface_says_the_same(placed) -> None:
    """As `distance` places it: the least distance of points on the other one."""
    other = gk.mesh.Surface(mesh_catalog.icosphere(2), device="cpu")
    nearest = placed.distance(other, transform=POSE)
    found = placed.closest_point(nearest.other_point[None], transform=POSE)
    assert found.distance[0] == pytest.approx(nearest.distance, abs=1e-12)
    assert found.points[0] == pytest.approx(nearest.point, abs=1e-9)


@pytest.mark.parametrize("kind", ["float32", "list", "one", "none", "warp", "torch"])
def test_containers_come_back(placed, kind: str) -> None:
    expected = placed.closest_point(POINTS, transform=POSE)
    if kind == "float32":
        answer = placed.closest_point(POINTS.astype(np.float32), transform=POSE)
        assert answer.points.dtype == answer.distance.dtype == np.float32
        same(answer, expected, atol=2e-6)
    elif kind == "list":
        same(placed.closest_point(POINTS.tolist(), transform=POSE), expected)
    elif kind == "one":
        answer = placed.closest_point(POINTS[0], transform=POSE)
        assert answer.points.shape == (3,)
        assert answer.distance == expected.distance[0]
        assert placed.contains(POINTS[0], transform=POSE).shape == ()
    elif kind == "none":
        assert placed.closest_point(np.empty((0, 3)), transform=POSE).points.shape == (0, 3)
    elif kind == "warp":
        import warp as wp

        answer = placed.closest_point(wp.array(POINTS, dtype=wp.vec3d, device="cpu"), transform=POSE)
        assert answer.points.dtype == wp.vec3d
        assert np.array_equal(answer.points.numpy(), expected.points)
    else:
        torch = pytest.importorskip("torch")
        answer = placed.signed_distance(torch.tensor(POINTS), transform=POSE)
        assert np.array_equal(answer.points.numpy(), placed.signed_distance(POINTS, transform=POSE).points)


def test_gradients_are_refused(placed) -> None:
    torch = pytest.importorskip("torch")
    points = torch.tensor(POINTS, requires_grad=True)
    with pytest.raises(InputError, match="points: a tensor with gradients beside transform"):
        placed.closest_point(points, transform=POSE)
    held = gk.torch.Surface(torch.tensor(MESH.vertices, requires_grad=True), MESH.faces, device="cpu")
    with pytest.raises(InputError, match="transform: the Surface holds tensors with gradients"):
        held.closest_point(POINTS, transform=POSE)
    with pytest.raises(InputError, match="points: a tensor with gradients beside transform"):
        gk.mesh.Surfaces([MESH], device="cpu").closest_point(points[None], transform=POSE[None])


def scaled(factor: float) -> np.ndarray:
    return np.diag([factor, factor, factor, 1.0])


@pytest.mark.parametrize(
    ("transform", "says"),
    [
        (scaled(2.0), "not a rigid motion"),
        (scaled(1.0 + 2e-6), "not a rigid motion"),
        (scaled(1e200), "not a rigid motion"),
        (np.zeros((4, 4)), "last row"),
        (np.eye(3), "transform"),
        (np.full((4, 4), np.nan), "transform"),
    ],
)
def test_what_is_no_pose_is_refused(placed, transform: np.ndarray, says: str) -> None:
    asked: list[Callable[[], Any]] = [
        lambda: placed.closest_point(POINTS, transform=transform),
        lambda: placed.signed_distance(POINTS, transform=transform),
        lambda: placed.contains(POINTS, transform=transform),
        lambda: placed.raycast(POINTS, HEADINGS, transform=transform),
        lambda: placed.winding_number(POINTS, transform=transform),
        lambda: placed.raycast_all(POINTS, HEADINGS, transform=transform),
        lambda: placed.occluded(POINTS, HEADINGS, transform=transform),
    ]
    for ask in asked:
        with pytest.raises(InputError, match=says):
            ask()


def test_bad_rows_are_named(placed) -> None:
    points = POINTS.copy()
    points[7, 1] = np.nan
    with pytest.raises(InputError, match=r"points.*7"):
        placed.closest_point(points, transform=POSE)
    with pytest.raises(InputError, match="directions"):
        placed.raycast(POINTS, HEADINGS[:5], transform=POSE)
    with pytest.raises(TypeError):
        placed.raycast(POINTS, transform=POSE)


def test_poses_of_float32(placed, moved) -> None:
    """They are off by 1e-7, and so are the answers."""
    found = placed.closest_point(POINTS, transform=POSE.astype(np.float32))
    assert np.allclose(found.distance, moved.closest_point(POINTS).distance, atol=2e-6)


def poses_of(count: int) -> np.ndarray:
    """Turns about the axis by steps, each with a place of its own."""
    found = np.repeat(POSE[None], count, axis=0)
    for step in range(count):
        angle = 0.7 * step
        found[step, :3, :3] = np.eye(3) + np.sin(angle) * _SKEW + (1.0 - np.cos(angle)) * _SKEW @ _SKEW
        found[step, :3, 3] += [0.3 * step, 0.0, -0.1 * step]
    return found


@pytest.mark.parametrize("count", [0, 1, 5])
@pytest.mark.parametrize("shape", [(40,), (2, 20), ()])
def test_many_poses_have_the_bits_of_each(placed, count: int, shape: tuple[int, ...]) -> None:
    points, headings = POINTS[: int(np.prod(shape))], HEADINGS[: int(np.prod(shape))]
    points, headings = points.reshape(*shape, 3), headings.reshape(*shape, 3)
    maps = poses_of(count)
    asked = {
        "closest_point": [points],
        "furthest_point": [points],
        "signed_distance": [points],
        "contains": [points],
        "winding_number": [points],
        "sign_confidence": [points],
        "raycast": [points, headings],
        "occluded": [points, headings],
        "crossing_count": [points, headings],
    }
    for name, rows in asked.items():
        query = getattr(placed, name)
        found, each = query(*rows, transform=maps), [query(*rows, transform=one) for one in maps]
        for field in getattr(found, "_fields", [None]):
            got, expected = (
                (found, each) if field is None else (getattr(found, field), [getattr(one, field) for one in each])
            )
            assert got.shape[: 1 + len(shape)] == (count, *shape), name
            if count:
                np.testing.assert_array_equal(got, np.stack(expected), err_msg=f"{name} {field}")


def test_many_poses_of_all_crossings_and_volumes(placed) -> None:
    maps = poses_of(3)
    lists = placed.raycast_all(POINTS, HEADINGS, transform=maps)
    each = [placed.raycast_all(POINTS, HEADINGS, transform=one) for one in maps]
    np.testing.assert_array_equal(lists.t, np.concatenate([one.t for one in each]))
    counts = np.concatenate([np.diff(one.offsets) for one in each])
    np.testing.assert_array_equal(np.diff(lists.offsets), counts)
    volume = gk.volume.from_mesh(MESH, voxel_size=0.1, half_width=6.0, device="cpu")
    for ask in (
        lambda pose: volume.sample(POINTS, transform=pose, device="cpu"),
        lambda pose: volume.gradient(POINTS, transform=pose, device="cpu"),
        lambda pose: volume.raycast(POINTS, HEADINGS, transform=pose, device="cpu").normals,
    ):
        np.testing.assert_array_equal(ask(maps), np.stack([ask(one) for one in maps]))


@pytest.mark.parametrize("kind", ["float32", "list", "warp", "torch"])
def test_many_poses_of_any_container(placed, kind: str) -> None:
    maps, expected = poses_of(3), placed.closest_point(POINTS, transform=poses_of(3))
    if kind == "warp":
        import warp as wp

        answer = placed.closest_point(wp.array(POINTS, dtype=wp.vec3d, device="cpu"), transform=maps)
        assert answer.points.dtype == wp.vec3d
        assert answer.points.shape == (3, 300)
        np.testing.assert_array_equal(answer.points.numpy(), expected.points)
    elif kind == "torch":
        torch = pytest.importorskip("torch")
        answer = placed.closest_point(torch.tensor(POINTS), transform=torch.tensor(maps))
        np.testing.assert_array_equal(answer.distance.numpy(), expected.distance)
    elif kind == "list":
        np.testing.assert_array_equal(
            placed.closest_point(POINTS.tolist(), transform=maps.tolist()).points, expected.points
        )
    else:
        answer = placed.closest_point(POINTS.astype(np.float32), transform=maps)
        assert answer.points.dtype == np.float32
        np.testing.assert_allclose(answer.points, expected.points, atol=2e-6)


def test_many_poses_of_several_devices_have_an_axis_of_their_own() -> None:
    surface, maps = gk.mesh.Surface(MESH, device=["cpu", "cpu"]), poses_of(3)
    points = np.repeat(POINTS, 250, axis=0)
    expected = gk.mesh.Surface(MESH, device="cpu").closest_point(points, transform=maps)
    np.testing.assert_array_equal(surface.closest_point(points, transform=maps).points, expected.points)


def test_a_pose_of_many_that_is_none_is_named(placed) -> None:
    maps = poses_of(3)
    maps[1, :3, :3] *= 1.5
    with pytest.raises(InputError, match="transform: map 1 is not a rigid motion"):
        placed.closest_point(POINTS, transform=maps)
    with pytest.raises(InputError, match=r"transform: shape \(3, 3, 4\) is not \(4, 4\) or \(B, 4, 4\)"):
        placed.closest_point(POINTS, transform=maps[:, :3])
