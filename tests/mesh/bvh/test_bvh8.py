"""The CPU tree: every triangle in one slot, every box around everything below it, never deeper than the stack."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import geokit as gk
from benchmarks import scenes
from benchmarks.catalog import mesh_catalog
from geokit.core import launcher
from geokit.mesh.bvh.bvh8_build_cpu_kernels import NO_CHILD, STACK, WIDTH
from geokit.mesh.bvh.leaf_planes_kernels import PLANE_ROWS, SLOT_WORDS, leaf_planes_kernel
from tests.support import reference


def chain(count):
    """Triangles that shrink by half from one to the next: each split of the heuristic removes only a few of them."""
    size = 0.5 ** np.arange(count)[:, None, None]
    corners = np.array([[1.0, 0, 0], [1.0, 0.2, 0], [1.1, 0, 0.2]]) * size
    return gk.mesh.TriangleMesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def copies(count):
    mesh = mesh_catalog.single_triangle()
    return gk.mesh.TriangleMesh(mesh.vertices, np.repeat(mesh.faces, count, axis=0))


def scattered(count):
    rng = np.random.default_rng(2)
    corners = rng.random((count, 1, 3)) + rng.normal(size=(count, 3, 3)) * 0.02
    return gk.mesh.TriangleMesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


MESHES = {
    **{f"scattered {n}": scattered(n) for n in (1, 7, 8, 9, 64, 65, 5000, 40_000)},
    **{f"copies {n}": copies(n) for n in (9, 3000)},
    **{f"chain {n}": chain(n) for n in (9, 900)},
    "torus": mesh_catalog.torus(),
    "hall": scenes.hall(5000).mesh,
    "collapsed": mesh_catalog.collapsed_faces(),
}


@pytest.fixture(params=MESHES)
def surface(request):
    return gk.mesh.Surface(MESHES[request.param], device="cpu")


def nodes_of(surface):
    tree = surface._tree
    return tree.children.numpy().reshape(-1, WIDTH), tree.boxes.numpy().reshape(-1, 2, 3, WIDTH)


def test_every_triangle_has_one_slot(surface):
    slots = surface._tree.slot_triangle.numpy()
    assert sorted(slots[slots >= 0]) == list(range(len(surface.mesh.faces)))
    corners = surface._tree.corners.numpy().reshape(-1, 3, 3)
    filled = slots >= 0
    np.testing.assert_array_equal(corners[filled], surface.mesh.vertices[surface.mesh.faces[slots[filled]]])
    assert np.isnan(corners[~filled]).all()


def test_planes_are_those_of_single_slots(surface):
    # What CUDA computes for each slot, the CPU computes for eight.
    tree, device = surface._tree, surface._device
    rows = wp.empty(SLOT_WORDS * len(tree.slot_triangle), dtype=wp.float32, device=device)
    inputs = [tree.slot_triangle, tree.corners, tree.origin, tree.scale]
    launcher.launch(leaf_planes_kernel, len(tree.slot_triangle), inputs, [rows], device)
    single = rows.numpy().reshape(-1, WIDTH, SLOT_WORDS)[..., :PLANE_ROWS].swapaxes(1, 2)
    np.testing.assert_array_equal(tree.leaves.numpy().reshape(-1, PLANE_ROWS, WIDTH), single)


def test_every_node_and_block_has_one_parent_that_comes_before_it(surface):
    children, _ = nodes_of(surface)
    inner, blocks = children[children > 0], -1 - children[children < 0]
    assert sorted(inner) == list(range(1, len(children)))
    assert sorted(blocks) == list(range(len(surface._tree.slot_triangle) // WIDTH))
    parents = np.nonzero(children > 0)[0]
    assert np.all(inner > parents)


@pytest.mark.slow
def test_boxes_hold_what_is_below_them(surface):
    children, boxes = nodes_of(surface)
    frame = surface._frame
    local = (surface._tree.corners.numpy().reshape(-1, WIDTH * 3, 3) - frame.origin) / frame.scale
    lower, upper = np.nanmin(local, axis=1), np.nanmax(local, axis=1)
    for node in range(len(children) - 1, -1, -1):
        for lane, child in enumerate(children[node]):
            low, high = boxes[node, :, :, lane].astype(np.float64)
            if child == NO_CHILD:
                assert np.all(low > high)
            elif child < 0:
                assert np.all(low <= lower[-1 - child])
                assert np.all(high >= upper[-1 - child])
                # Not much wider than necessary, either.
                assert np.all(low >= lower[-1 - child] - 3e-7)
            else:
                used = children[child] != NO_CHILD
                assert np.all(low <= boxes[child, 0][:, used].min(axis=1))
                assert np.all(high >= boxes[child, 1][:, used].max(axis=1))


def test_no_walk_outgrows_its_stack(surface):
    children, _ = nodes_of(surface)
    waiting = np.zeros(len(children), int)  # most nodes on the stack when the traversal reaches each node
    for node in range(len(children)):
        siblings = np.count_nonzero(children[node] != NO_CHILD) - 1
        below = children[node][children[node] > 0]
        waiting[below] = waiting[node] + siblings
    assert waiting.max() + WIDTH < STACK


@pytest.mark.parametrize("threads", ["1", "5"])
def test_threads_change_nothing(threads, monkeypatch):
    mesh = MESHES["scattered 40000"]
    expected = gk.mesh.Surface(mesh, device="cpu")._tree
    monkeypatch.setenv("GEOKIT_THREADS", threads)
    found = gk.mesh.Surface(mesh, device="cpu")._tree
    for name in ("boxes", "children", "slot_triangle", "leaves"):
        np.testing.assert_array_equal(getattr(found, name).numpy(), getattr(expected, name).numpy())


@pytest.mark.parametrize("name", ["copies 3000", "chain 900", "scattered 5000"])
def test_queries_over_odd_trees_are_exact(name):
    mesh = MESHES[name]
    surface = gk.mesh.Surface(mesh, device="cpu")
    rng = np.random.default_rng(3)
    lower, upper = mesh.bounds
    points = lower + (rng.random((40, 3)) * 2 - 0.5) * (upper - lower)
    expected = reference.closest_point(mesh.vertices, mesh.faces, points)
    found = surface.closest_point(points)
    np.testing.assert_allclose(found.distance, expected.distance, rtol=0, atol=1e-12 * mesh.diagonal)
    if name.startswith("copies"):
        assert np.all(found.triangle_id == 0)
