"""register on known poses: every kind of target, degenerate shapes, and every error."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.points._register import register
from geokit.points.clouds.rigid_fit import orthonormal, plane_step, point_step
from tests.support.reference import register_by_numpy

# Poses are recovered to rounding; the remaining error is that of sums over some thousand points of size 1.
EXACT = 1e-12


def rigid(angles, shift, about=(0.0, 0.0, 0.0)):
    """A turn about a point, then a shift; shape (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(angles).as_matrix()
    matrix[:3, 3] = np.asarray(about) + shift - matrix[:3, :3] @ np.asarray(about)
    return matrix


def moved(points, matrix):
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def blob(count=3000, seed=0):
    """Points and normals of an ellipsoid, which no motion brings back to itself."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    axes = np.array([1.0, 0.7, 0.45])
    normals = points / axes
    return points * axes, normals / np.linalg.norm(normals, axis=1, keepdims=True)


# A fifth of the distance between neighbors and less: the nearest point is the right one for most from the start.
POSE = rigid([0.02, -0.03, 0.04], [0.02, -0.01, 0.015])


@pytest.mark.parametrize("method", ["point_to_plane", "point_to_point"])
@pytest.mark.parametrize("with_normals", [True, False])
def test_a_cloud_to_itself_moved(method, with_normals):
    points, normals = blob()
    target = moved(points, POSE)
    given = moved(normals, POSE) - POSE[:3, 3] if with_normals else None
    found = register(points, target, method=method, target_normals=given, max_iterations=200, device="cpu")
    assert found._fields == ("transform", "rmse", "fitness", "iterations", "converged", "rank")
    np.testing.assert_allclose(found.transform, POSE, atol=EXACT)
    assert found.rmse < EXACT
    assert (found.fitness, found.converged, found.rank) == (1.0, True, 6)
    assert type(found.converged) is bool
    assert (found.transform[3] == [0.0, 0.0, 0.0, 1.0]).all()


def test_signs_and_lengths_of_normals_do_not_matter():
    points, normals = blob()
    target = moved(points, POSE)
    factors = np.tile([1.0, -1e200, 3e-200, 0.0, -2.0], len(points) // 5)[:, None]
    turned = (moved(normals, POSE) - POSE[:3, 3]) * factors
    np.testing.assert_allclose(
        register(points, target, target_normals=turned, device="cpu").transform, POSE, atol=EXACT
    )


@pytest.mark.parametrize("method", ["point_to_plane", "point_to_point"])
def test_equals_the_reference_step_by_step(method):
    points, normals = blob(600)
    random = np.random.default_rng(1)
    target = moved(points, rigid([0.1, 0.05, -0.08], [0.05, 0.02, -0.04])) + random.normal(size=points.shape) * 0.01
    for steps in (1, 2, 7):
        found = register(
            points[:400], target, method=method, target_normals=normals, max_distance=0.3, max_iterations=steps,
            device="cpu",
        )  # fmt: skip
        transform, rmse, fitness = register_by_numpy(points[:400], target, normals, method, 0.3, steps)
        np.testing.assert_allclose(found.transform, transform, atol=1e-11)
        assert found.rmse == pytest.approx(rmse, rel=1e-10)
        assert found.fitness == fitness
        assert found.iterations == steps


def bent_torus():
    """A torus that is not the same after any motion."""
    mesh = mesh_catalog.torus()
    vertices = mesh.vertices * [1.0, 1.2, 0.8]
    return gk.mesh.TriangleMesh(vertices + 0.1 * np.sin(3.0 * vertices[:, [1, 2, 0]]), mesh.faces)


@pytest.mark.parametrize("kind", ["surface", "mesh"])
def test_points_of_a_surface(kind):
    mesh = bent_torus()
    points = moved(gk.mesh.sample_surface(mesh, 3000, seed=1).points, np.linalg.inv(POSE))
    target = gk.mesh.Surface(mesh, device="cpu") if kind == "surface" else mesh
    found = register(points, target, device="cpu")
    np.testing.assert_allclose(found.transform, POSE, atol=EXACT)
    assert found.rmse < EXACT
    assert (found.fitness, found.converged, found.rank) == (1.0, True, 6)


@pytest.mark.slow
def test_point_to_point_on_a_surface_takes_many_more_steps_and_gets_there():
    mesh = bent_torus()
    points = moved(gk.mesh.sample_surface(mesh, 400, seed=1).points, np.linalg.inv(POSE))

    def error(steps):
        found = register(points, mesh, method="point_to_point", max_iterations=steps, device="cpu")
        return np.abs(found.transform - POSE).max()

    assert error(50) > 1e-3
    assert error(800) < 1e-6


def test_points_of_a_level_set():
    mesh = bent_torus()
    sdf = gk.volume.from_mesh(mesh, 0.03, half_width=4.0, device="cpu")
    points = moved(gk.mesh.sample_surface(mesh, 3000, seed=1).points, np.linalg.inv(POSE))
    found = register(points, sdf, device="cpu")
    # The interpolated level is within about a hundredth of a voxel of the surface, to either side of it.
    np.testing.assert_allclose(found.transform, POSE, atol=3e-4)
    assert found.rmse < 0.03 * 0.05
    assert (found.fitness, found.converged, found.rank) == (1.0, True, 6)


def test_a_level_set_holds_its_own_zeros_to_rounding():
    # A plane's distance is linear: interpolated without an error, it leaves the three motions along the plane alone.
    box = mesh_catalog.box((-4, -4, -1), (4, 4, 0))
    sdf = gk.volume.from_mesh(box, 0.25, half_width=5.0, device="cpu")
    points = np.random.default_rng(0).uniform(-2.0, 2.0, (500, 3)) * [1, 1, 0]
    start = rigid([0.03, -0.02, 0.0], [0.0, 0.0, 0.3])
    found = register(moved(points, start), sdf, device="cpu")
    assert found.rank == 3
    np.testing.assert_allclose((found.transform @ start)[2], [0, 0, 1, 0], atol=1e-6)


def test_points_out_of_the_band_have_no_partner():
    sphere = mesh_catalog.icosphere(3)
    sdf = gk.volume.from_mesh(sphere, 0.05, half_width=3.0, device="cpu")
    points = np.concatenate([sphere.vertices[:200], sphere.vertices[:50] * 1.12, sphere.vertices[:50] * 3.0])
    assert register(points, sdf, max_iterations=1, device="cpu").fitness == pytest.approx(200 / 300, abs=0.02)


def test_max_distance_keeps_out_what_has_no_counterpart():
    points, normals = blob()
    lone = np.random.default_rng(5).normal(size=(600, 3)) * 0.1 + [3.0, 0.0, 0.0]
    target, planes = moved(points, POSE), moved(normals, POSE) - POSE[:3, 3]
    found = register(np.concatenate([points, lone]), target, target_normals=planes, max_distance=0.2, device="cpu")
    np.testing.assert_allclose(found.transform, POSE, atol=EXACT)
    assert found.fitness == 3000 / 3600


def test_initial_is_where_it_starts():
    points, normals = blob()
    far = rigid([0.0, 0.0, 2.0], [5.0, 0.0, 0.0])
    target, planes = moved(points, far), normals @ far[:3, :3].T
    with pytest.raises(gk.InputError, match="0 of the source's 3000 points"):
        register(points, target, target_normals=planes, max_distance=0.5, device="cpu")
    start = rigid([0.02, 0.0, 1.97], [5.01, 0.0, 0.01])
    found = register(points, target, target_normals=planes, max_distance=0.5, initial=start, device="cpu")
    np.testing.assert_allclose(found.transform, far, atol=10 * EXACT)


def test_a_plane_does_not_slide_along_itself():
    random = np.random.default_rng(0)
    flat = random.random((900, 3)) * [1, 1, 0]
    up = np.tile([0.0, 0.0, 1.0], (900, 1))
    start = rigid([0.02, -0.03, 0.0], [0.0, 0.0, 0.1])
    found = register(moved(flat[:300], start), flat, target_normals=up, device="cpu")
    assert (found.rank, found.converged) == (3, True)
    # Back on the plane, and no further: nothing turned about its normal.
    np.testing.assert_allclose(moved(moved(flat[:300], start), found.transform)[:, 2], 0.0, atol=EXACT)
    assert abs(Rotation.from_matrix(found.transform[:3, :3]).as_rotvec()[2]) < 1e-3


def test_a_sphere_turns_freely():
    points = np.random.default_rng(0).normal(size=(400, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    shift = np.array([0.01, 0.02, -0.01])
    found = register(points[:100] + shift, points, target_normals=points, device="cpu")
    assert (found.rank, found.converged) == (3, True)
    # The center is right, and the rotation about it is unchanged except for the effect of the shift.
    np.testing.assert_allclose(moved(shift, found.transform), np.zeros(3), atol=EXACT)
    assert np.linalg.norm(Rotation.from_matrix(found.transform[:3, :3]).as_rotvec()) < np.linalg.norm(shift)
    # Facets are not round.
    assert register(points, mesh_catalog.icosphere(1), device="cpu").rank == 6


def test_a_line_does_not_turn_about_itself():
    line = np.zeros((50, 3))
    line[:, 0] = np.linspace(-1.0, 1.0, 50)
    target = moved(line, rigid([0.0, 0.01, 0.015], [0.001, 0.002, 0.003]))
    found = register(line, target, method="point_to_point", device="cpu")
    assert (found.rank, found.converged) == (5, True)
    np.testing.assert_allclose(moved(line, found.transform), target, atol=EXACT)
    assert abs(Rotation.from_matrix(found.transform[:3, :3]).as_rotvec()[0]) < 1e-3


def test_points_in_one_place_only_shift():
    found = register(np.ones((5, 3)), [[2.0, 1.0, 1.0]] * 4, method="point_to_point", device="cpu")
    assert (found.rank, found.converged, found.rmse) == (3, True, 0.0)
    np.testing.assert_array_equal(found.transform[:3, :3], np.eye(3))
    np.testing.assert_array_equal(found.transform[:3, 3], [1.0, 0.0, 0.0])


def test_a_flat_cloud_is_turned_not_reflected():
    # Of a plane's points the best orthogonal matrix is a rotation or a reflection alike.
    flat = np.random.default_rng(0).random((200, 3)) * [1, 1, 0]
    target = moved(flat, rigid([0.01, 0.01, 0.01], [0.002, 0.001, 0.003]))
    found = register(flat, target, method="point_to_point", device="cpu")
    assert np.linalg.det(found.transform[:3, :3]) == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(moved(flat, found.transform), target, atol=EXACT)
    assert found.rank == 6


def pair_sums(p, q):
    return np.concatenate([[len(p), ((p - q) ** 2).sum()], p.sum(0), q.sum(0), (p.T @ q).ravel()])


@pytest.mark.parametrize("seed", range(5))
def test_point_step_is_the_best_rotation_where_a_reflection_would_be_better(seed):
    random = np.random.default_rng(seed)
    p = random.normal(size=(30, 3))
    q = p * [1, 1, -1] + random.normal(size=(30, 3)) * 0.1
    step = point_step(pair_sums(p, q))
    wanted, _ = Rotation.align_vectors(q - q.mean(axis=0), p - p.mean(axis=0))
    np.testing.assert_allclose(step.rotation, wanted.as_matrix(), atol=1e-10)
    np.testing.assert_allclose(step.shift, q.mean(axis=0) - step.rotation @ p.mean(axis=0), atol=1e-12)


@pytest.mark.parametrize("end", [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0.6, 0.0, 0.8]])
def test_point_step_of_a_line_is_the_shortest_turn(end):
    t = np.linspace(-1.0, 1.0, 9)[:, None]
    p, q = t * [1.0, 0, 0], t * np.asarray(end, float)
    step = point_step(pair_sums(p, q))
    assert step.rank == 5
    np.testing.assert_allclose(p @ step.rotation.T, q, atol=1e-14)
    assert np.linalg.det(step.rotation) == pytest.approx(1.0)
    angle = np.linalg.norm(Rotation.from_matrix(step.rotation).as_rotvec())
    assert angle == pytest.approx(np.arccos(end[0]), abs=1e-7)


def test_plane_step_of_nothing_is_no_motion():
    step = plane_step(np.concatenate([[9.0, 0.0], np.zeros(27)]), 1.0)
    assert step.rank == 0
    np.testing.assert_array_equal(step.rotation, np.eye(3))
    np.testing.assert_array_equal(step.shift, np.zeros(3))


def test_orthonormal_is_the_nearest_rotation():
    rotation = Rotation.from_rotvec([0.3, 0.2, 0.1]).as_matrix()
    np.testing.assert_allclose(orthonormal(rotation * (1.0 + 1e-6)), rotation, atol=1e-15)


def test_containers():
    points, normals = blob(500)
    target = moved(points, POSE)
    base = register(points, target, target_normals=normals, device="cpu")
    given = [wp.array(rows, dtype=wp.vec3d, device="cpu") for rows in (points, target, normals)]
    other = register(given[0], given[1], target_normals=given[2], device="cpu")
    np.testing.assert_array_equal(other.transform, base.transform)
    np.testing.assert_array_equal(given[0].numpy(), points)
    single = register(points.astype(np.float32), target, target_normals=normals, device="cpu")
    assert single.transform.dtype == np.float64
    np.testing.assert_allclose(single.transform, base.transform, atol=1e-6)


def test_the_last_step_of_few_does_not_converge():
    points, normals = blob(500)
    found = register(points, moved(points, POSE), target_normals=normals, max_iterations=1, device="cpu")
    assert (found.iterations, found.converged) == (1, False)


@pytest.mark.parametrize("method", ["plane", None, 1])
def test_unknown_method(method):
    with pytest.raises(gk.InputError, match="method"):
        register(*blob(50), method=method, device="cpu")


@pytest.mark.parametrize(
    ("option", "values"),
    [
        ("max_distance", [0.0, -1.0, np.nan, "far"]),
        ("tolerance", [0.0, -1.0, np.nan, np.inf]),
        ("max_iterations", [0, -1, 2.5, True, None]),
    ],
)
def test_options_out_of_range(option, values):
    points, normals = blob(50)
    for value in values:
        with pytest.raises(gk.InputError, match=option):
            register(points, points, target_normals=normals, **{option: value}, device="cpu")


@pytest.mark.parametrize(
    "initial",
    [np.eye(3), np.full((4, 4), np.nan), "here", 2.0 * np.eye(4), np.diag([1, 1, -1, 1.0]), np.ones((4, 4))],
)
def test_initial_must_be_rigid(initial):
    points, normals = blob(50)
    with pytest.raises(gk.InputError, match="initial"):
        register(points, points, target_normals=normals, initial=initial, device="cpu")


def test_clouds_are_checked():
    points, normals = blob(50)
    bad = points.copy()
    bad[7, 0] = np.nan
    none = np.zeros((0, 3))
    with pytest.raises(gk.InputError, match="source: row 7"):
        register(bad, points, target_normals=normals, device="cpu")
    with pytest.raises(gk.InputError, match="target: row 7"):
        register(points, bad, target_normals=normals, device="cpu")
    with pytest.raises(gk.InputError, match="target_normals: row 7"):
        register(points, points, target_normals=bad, device="cpu")
    with pytest.raises(gk.InputError, match="target_normals: 49 rows for 50 points"):
        register(points, points, target_normals=normals[1:], device="cpu")
    with pytest.raises(gk.InputError, match="source: it has no points"):
        register(none, points, target_normals=normals, device="cpu")
    with pytest.raises(gk.InputError, match="target: it has no points"):
        register(points, none, device="cpu")
    with pytest.raises(gk.InputError, match="device"):
        register(points, points, target_normals=normals, device="abacus")


def test_targets_are_checked():
    points, normals = blob(50)
    sphere = mesh_catalog.icosphere(1)
    with pytest.raises(gk.InputError, match="target_normals: a Surface has its own"):
        register(points, sphere, target_normals=normals, device="cpu")
    with pytest.raises(gk.InputError, match=r"target: grid .* is a fog volume"):
        register(
            points,
            gk.volume.from_dense(np.ones((4, 4, 4), np.float32), voxel_size=1.0, grid_class="fog volume"),
            device="cpu",
        )
    with pytest.raises(gk.InputError, match="no faces"):
        register(points, gk.mesh.TriangleMesh(points, np.zeros((0, 3), np.int32)), device="cpu")


@pytest.mark.parametrize(("method", "least"), [("point_to_plane", 6), ("point_to_point", 3)])
def test_too_few_pairs(method, least):
    points, normals = blob(200)
    few = np.concatenate([points[: least - 1], points[:20] + 50.0])
    with pytest.raises(
        gk.InputError, match=f"max_distance: {least - 1} of the source's {least + 19} points .* {least}"
    ):
        register(few, points, method=method, target_normals=normals, max_distance=0.01, device="cpu")
