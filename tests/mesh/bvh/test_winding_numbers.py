"""Winding numbers in the CPU tree: small inputs, the far field, and invariances."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from benchmarks.catalog import mesh_catalog
from geokit.core import launcher
from geokit.errors import InputError
from geokit.mesh import Surface, TriangleMesh
from geokit.mesh.bvh.winding_kernels import QUEUE, sign_kernel, winding_number_kernel
from geokit.mesh.bvh.winding_moments import build_winding_tree
from tests.support import reference


class Winding:
    """The kernels with the tree of a surface, without the orientation handling of a Surface."""

    def __init__(self, mesh: TriangleMesh, flipped: np.ndarray | None = None) -> None:
        self.surface = Surface(mesh, device="cpu")
        self.winding = build_winding_tree(self.surface._tree, flipped)

    def run(self, kernel, points: np.ndarray, out: np.ndarray, empty: float, flags: list | None = None) -> np.ndarray:
        device = wp.get_device("cpu")
        result = wp.array(out, dtype=wp.float64, device=device)
        inputs = [self.surface._tree, self.winding, wp.float64(empty)]
        points = wp.array(np.asarray(points, np.float64), dtype=wp.vec3d, device=device)
        half = 2.0 * self.surface.scale
        lower = self.surface.origin - half
        box = {"lower": lower, "extent": 2.0 * half}
        launcher.launch_queries(kernel, points, inputs, [result], device, **box, flags=flags or [])
        return result.numpy()

    def numbers(self, points, empty: float = np.inf) -> np.ndarray:
        bad = wp.zeros(1, dtype=wp.int32, device="cpu")
        found = self.run(winding_number_kernel, points, np.full(len(points), np.nan), empty, [bad])
        assert bool(bad.numpy()[0]) == (not np.isfinite(points).all())
        return found

    def inside(self, points, empty: float = np.inf) -> np.ndarray:
        return self.run(sign_kernel, points, np.ones(len(points)), empty) < 0.0


def stacked(mesh: TriangleMesh, times: int) -> TriangleMesh:
    return TriangleMesh(mesh.vertices, np.concatenate([mesh.faces] * times), name=f"{mesh.name}_times_{times}")


def test_inside_and_outside_of_a_box():
    box = Winding(mesh_catalog.box())
    points = [[0.5, 0.4, 0.3], [2, 2, 2], [0.99, 0.99, 0.99], [1.01, 0.5, 0.5]]
    np.testing.assert_allclose(box.numbers(points), [1, 0, 1, 0], atol=1e-4)
    assert box.inside(points).tolist() == [True, False, True, False]


def test_a_side_of_a_box_is_a_sixth_of_the_sphere_around_its_middle():
    box = mesh_catalog.box()
    for side in range(6):
        one = Winding(TriangleMesh(box.vertices, box.faces[2 * side : 2 * side + 2]))
        np.testing.assert_allclose(one.numbers([[0.5, 0.5, 0.5]]), [1 / 6], atol=1e-6)


def test_points_on_the_surface_have_one_half_on_faces_and_are_outside():
    box = Winding(mesh_catalog.box())
    points = np.array([[0.5, 0.25, 0.0], [0.25, 1.0, 0.5], [1.0, 0.75, 0.5], [0.5, 0.5, 0.0]])
    np.testing.assert_allclose(box.numbers(points), 0.5, atol=1e-6)
    points = np.concatenate([points, [[0.5, 0.0, 1.0], [0.0, 0.0, 0.0], [1.0, 0.25, 1.0]]])
    assert not box.inside(points).any()


@pytest.mark.parametrize(
    "mesh", [mesh_catalog.zero_area_triangles(), mesh_catalog.collapsed_faces()], ids=lambda m: m.name
)
def test_triangles_without_area_count_nothing(mesh):
    rng = np.random.default_rng(1)
    face = mesh.faces[len(mesh_catalog.box().faces) :][rng.integers(len(mesh.faces) - 12, size=400)]
    on_them = np.einsum("nk,nkd->nd", rng.dirichlet(np.ones(3), 400), mesh.vertices[face])
    points = on_them + rng.normal(size=(400, 3)) * 10.0 ** rng.uniform(-12, -1, (400, 1))
    box = mesh_catalog.box()
    expected = reference.winding_number(box.vertices, box.faces, points)
    np.testing.assert_allclose(Winding(mesh).numbers(points), expected, atol=1e-3)


def test_flipped_triangles_count_the_other_way():
    mesh = mesh_catalog.icosphere(3)
    rng = np.random.default_rng(2)
    flipped = rng.random(len(mesh.faces)) < 0.3
    points = rng.uniform(-1.5, 1.5, (500, 3))
    turned = TriangleMesh(mesh.vertices, np.where(flipped[:, None], mesh.faces[:, ::-1], mesh.faces))
    found = Winding(mesh, flipped).numbers(points)
    np.testing.assert_allclose(found, Winding(turned).numbers(points), atol=1e-5)
    near = mesh.vertices[mesh.faces].mean(axis=1) * (1 + rng.choice([-1e-9, 1e-9], (len(mesh.faces), 1)))
    expected = reference.winding_number(turned.vertices, turned.faces, near)
    np.testing.assert_allclose(Winding(mesh, flipped).numbers(near), expected, atol=5e-3)


@pytest.mark.parametrize(("radii", "share"), [(6, 2e-3), (12, 3e-4), (24, 4e-5)])
def test_far_away_the_relative_error_falls_with_the_third_power_of_the_distance(radii, share):
    # Three orders: the number falls with the second power of the distance, the truncation error with the fifth.
    for mesh in (
        mesh_catalog.open_shell(),
        mesh_catalog.single_triangle(),
        mesh_catalog.half_shell(mesh_catalog.icosphere()),
    ):
        directions = np.random.default_rng(3).normal(size=(300, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        points = mesh.bounds.mean(axis=0) + directions * radii * mesh.diagonal / 2
        expected = reference.winding_number(mesh.vertices, mesh.faces, points)
        error = np.abs(Winding(mesh).numbers(points) - expected).max()
        assert error <= share * np.abs(expected).max()


@pytest.mark.slow
def test_many_surfaces_on_top_of_each_other():
    # All nodes must be opened, about one for 16 of these: more than the queue holds.
    times = 40 * QUEUE
    mesh = stacked(mesh_catalog.tetrahedron(), times)
    points = np.random.default_rng(4).uniform(-0.2, 0.8, (40, 3))
    one = mesh_catalog.tetrahedron()
    expected = times * reference.winding_number(one.vertices, one.faces, points)
    found = Winding(mesh)
    np.testing.assert_allclose(found.numbers(points), expected, atol=1e-4 * times)
    np.testing.assert_array_equal(found.inside(points), expected > 0.5)


def test_a_coarse_sum_does_not_decide_where_many_surfaces_err_together():
    mesh = stacked(mesh_catalog.icosphere(3), 40)
    rng = np.random.default_rng(5)
    directions = rng.normal(size=(20000, 3))
    points = directions / np.linalg.norm(directions, axis=1, keepdims=True) * rng.uniform(0.6, 1.6, (20000, 1))
    radius = np.linalg.norm(points, axis=1)
    sure = (radius < 0.985) | (radius > 1.001)
    found = Winding(mesh).inside(points)
    np.testing.assert_array_equal(found[sure], radius[sure] < 1)


def test_threads_and_order_change_no_bit(monkeypatch):
    mesh = mesh_catalog.with_flips(mesh_catalog.torus())
    rng = np.random.default_rng(6)
    points = rng.uniform(-1.5, 1.5, (6000, 3))
    points[::3] = mesh_catalog.torus().vertices[rng.integers(len(mesh.vertices), size=2000)] + 1e-9
    found = Winding(mesh)
    expected = found.numbers(points), found.inside(points)
    shuffled = rng.permutation(len(points))
    for threads in ("1", "3"):
        monkeypatch.setenv("GEOKIT_THREADS", threads)
        again = Winding(mesh)
        np.testing.assert_array_equal(again.numbers(points[shuffled]), expected[0][shuffled])
        np.testing.assert_array_equal(again.inside(points[shuffled]), expected[1][shuffled])


def test_nothing_is_around_points_outside_the_empty_cube():
    shell = Winding(mesh_catalog.open_shell())
    points = np.array([[1.5, 0.0, 0.2], [0.0, 0.0, 0.5]])
    assert (shell.numbers(points) != 0.0).all()
    assert shell.numbers(points, empty=1.0)[0] == 0.0
    assert shell.numbers(points, empty=1.0)[1] == shell.numbers(points)[1]


def test_points_at_any_distance_have_a_number():
    shell = Winding(mesh_catalog.scaled(mesh_catalog.open_shell(), 1e-9))
    directions = np.random.default_rng(7).normal(size=(200, 3))
    for distance in (1e-3, 1e12, 1e149):
        numbers = shell.numbers(directions * distance)
        assert np.isfinite(numbers).all()
        assert np.abs(numbers).max() < 1e-6


def test_after_an_update_it_is_built_anew():
    mesh = mesh_catalog.torus()
    surface = Surface(mesh, device="cpu")
    points = np.random.default_rng(8).uniform(-2, 2, (300, 3))
    surface.winding_number(points)
    moved = mesh.vertices * [1.2, 0.7, 1.0] + 0.1
    surface.update(moved)
    expected = reference.winding_number(moved, mesh.faces, points)
    np.testing.assert_allclose(surface.winding_number(points), expected, atol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("count", [3, 300_000])
@pytest.mark.parametrize("query", ["winding_number", "sign_confidence"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_points_that_are_not_finite_are_named(query, value, count, monkeypatch):
    monkeypatch.setattr("geokit.core.blocks.chunked_queries.MOST_ROWS", 100_000)
    surface = Surface(mesh_catalog.box(), device="cpu")
    points = np.full((count, 3), 0.5)
    points[0] = 5e149  # near the farthest that is allowed
    points[1] = -5e149
    progress = {"progress": lambda done, total: None} if query == "winding_number" else {}
    assert np.isfinite(getattr(surface, query)(points, **progress)).all()
    points[count - 1, 1] = value
    with pytest.raises(InputError, match=f"points: row {count - 1} "):
        getattr(surface, query)(points, **progress)
    with pytest.raises(InputError, match=f"points: row {count - 1} "):
        getattr(surface, query)(wp.array(points, dtype=wp.vec3d, device="cpu"))
    np.testing.assert_array_equal(Winding(mesh_catalog.box()).numbers(points)[[0, -1]], [0.0, np.nan])
