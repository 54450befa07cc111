"""The tree of a GPU, built on a CPU: every triangle in one slot, in all boxes above it, never deeper than a stack."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk
from benchmarks import scenes
from benchmarks.catalog import mesh_catalog
from geokit.core import launcher
from geokit.mesh.bvh.bvh2 import MOST_IN_LEAF, MOST_LEVELS
from geokit.mesh.bvh.bvh2_cuda_kernels import CHUNK, LEAF_BITS, NODE_FLOATS, THREADS
from tests.mesh.bvh.test_bvh8 import MESHES, chain, scattered


def nested(count):
    """Triangles around each other: each one's best partner is the next smaller, so that only two merge at a time."""
    size = 1.01 ** -np.arange(count)[:, None, None] if count < 2000 else (1.0 - np.arange(count) / count)[:, None, None]
    corners = np.array([[-1.0, -1, -1], [1, 1, 1], [1, -1, 0.5]]) * size
    return gk.mesh.TriangleMesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def in_rows(count):
    """Rows of smaller and smaller triangles on all scales, which merge one after the other."""
    place = 0.5 ** np.arange(20)
    at = np.stack(np.meshgrid(place, place, place, indexing="ij"), axis=-1).reshape(-1, 1, 3)[:count]
    corners = at + 0.1 * at.min(axis=2, keepdims=True) * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0.5]])
    return gk.mesh.TriangleMesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


CASES = {
    **MESHES,
    **{f"scattered {n}": scattered(n) for n in (2, 3, 4, CHUNK - 1, CHUNK, CHUNK + 1, 4 * CHUNK + 1)},
    **{f"nested {n}": nested(n) for n in (300, 1500, 20_000)},
    "rows": in_rows(8000),
    "long chain": chain(60),
    "flat": mesh_catalog.collapsed_faces(),
}


def binary(mesh):
    """A CPU surface over the tree that CUDA queries walk."""
    surface = gk.mesh.Surface(mesh, device="cpu")
    surface._build_binary_tree()
    return surface


@pytest.mark.parametrize("name", CASES)
def test_boxes_hold_what_is_below(name):
    mesh = CASES[name]
    tree = binary(mesh)._tree
    slot_triangle = tree.slot_triangle.numpy()
    assert sorted(slot_triangle) == list(range(mesh.face_count))
    corners = mesh.vertices[mesh.faces[slot_triangle]]
    np.testing.assert_array_equal(tree.corners.numpy().reshape(-1, 3, 3), corners)
    local = (corners - np.array(tree.origin)) / float(tree.scale)
    rows = tree.boxes.numpy().reshape(-1, NODE_FLOATS)
    links = rows.view(np.int32)[:, 12:14]
    seen = np.zeros(mesh.face_count, int)
    waiting = [(int(tree.children.numpy()[0]), np.full(3, -np.inf), np.full(3, np.inf), 0)]
    while waiting:
        child, lower, upper, level = waiting.pop()
        assert level <= MOST_LEVELS
        if child < 0:
            begin, count = (-1 - child) >> LEAF_BITS, ((-1 - child) & ((1 << LEAF_BITS) - 1)) + 1
            assert count <= MOST_IN_LEAF
            seen[begin : begin + count] += 1
            assert (local[begin : begin + count] >= lower).all()
            assert (local[begin : begin + count] <= upper).all()
            continue
        for side in range(2):
            low, high = rows[child, 6 * side : 6 * side + 3], rows[child, 6 * side + 3 : 6 * side + 6]
            # What is below a child lies in all boxes above it.
            waiting.append((int(links[child, side]), np.maximum(lower, low), np.minimum(upper, high), level + 1))
    assert (seen == 1).all()
    # A node stands before those below it, its left child at once: what a search reads next is near.
    inner = links[:, 0] >= 0
    assert (links[inner, 0] == np.flatnonzero(inner) + 1).all()


@pytest.mark.parametrize("name", ["hall", "pipes", "terrain"])
def test_boxes_are_small(name):
    """Merging neighbors in Morton order makes boxes of more area, for pipes several times as much."""
    tree = binary(scenes.SCENES[name](20_000).mesh)._tree

    def area(rows):
        size = rows[:, [3, 4, 5]] - rows[:, [0, 1, 2]]
        return (size * np.roll(size, 1, axis=1)).sum()

    def merged(boxes):
        total = 0.0
        while len(boxes) > 1:
            boxes = boxes[: len(boxes) // 2 * 2].reshape(-1, 2, 6)
            boxes = np.concatenate([boxes[..., :3].min(axis=1), boxes[..., 3:].max(axis=1)], axis=1)
            total += area(boxes)
        return total

    corners = tree.corners.numpy().reshape(-1, 3, 3)
    local = (corners - np.array(tree.origin)) / float(tree.scale)
    key = np.zeros(len(local), np.int64)
    cell = ((local.min(axis=1) + local.max(axis=1)) * 0.25 * 1024 + 512).astype(np.int64)
    for bit in range(10):
        for axis in range(3):
            key |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
    order = np.argsort(key, kind="stable")
    boxes = np.concatenate([local.min(axis=1), local.max(axis=1)], axis=1)[order]
    rows = tree.boxes.numpy().reshape(-1, NODE_FLOATS)[:, :12].reshape(-1, 6)
    leaves = tree.boxes.numpy().reshape(-1, NODE_FLOATS).view(np.int32)[:, 12:14].ravel() < 0
    assert area(rows[~leaves]) < merged(boxes) * (0.5 if name == "pipes" else 0.9)


def test_the_same_tree_whatever_the_threads(monkeypatch):
    """Nodes get their numbers as blocks come to them; the rows do not depend on that."""
    mesh = scattered(40_000)
    first = binary(mesh)._tree
    for count in (1, 2, 3):
        monkeypatch.setenv("GEOKIT_THREADS", str(count))
        again = binary(mesh)._tree
        for name in ("boxes", "children", "slot_triangle"):
            one, other = (getattr(tree, name).numpy().view(np.int32) for tree in (again, first))
            np.testing.assert_array_equal(one, other)


def test_a_block_merges_with_all_of_its_threads():
    assert THREADS == launcher.BLOCK_DIM
