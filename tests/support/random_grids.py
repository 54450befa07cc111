"""Random sparse grids of any value type, and the same voxels as dense arrays."""

from __future__ import annotations

import functools
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.volume._dense import from_dense
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.layout import LAYOUTS
from geokit.volume.nanovdb.nodes import bits_of
from geokit.volume.tree.typed_tree import Nodes, TypedTree
from geokit.volume.tree.typed_writer import rebuilt

# Voxels of the box that the dense arrays cover: it holds everything but inactive background, with room to grow.
LOW, HIGH = -32, 40
METADATA = MappingProxyType({"author": "tests", "seed": 7})
TRANSFORM = np.array([[0.5, 0.1, 0.0, 3.0], [0.0, 0.4, 0.0, -2.0], [0.0, 0.0, 0.3, 1.0], [0.0, 0.0, 0.0, 1.0]])


class RandomGrid(NamedTuple):
    """The volume, and values (S, S, S) or (S, S, S, C) and states (S, S, S) of the voxels from LOW to HIGH - 1."""

    volume: SparseVolume
    values: NDArray[Any]
    active: NDArray[np.bool_]


def random_values(grid_type: str, rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[Any]:
    """Values that the type holds; float64 holds them too."""
    kind = LAYOUTS[grid_type].background
    full = (*shape, *kind.shape)
    if kind.base.kind == "b":
        return rng.random(full) < 0.5
    if kind.base.kind == "f":
        return rng.uniform(-100.0, 100.0, full).astype(kind.base)
    low = 0 if kind.base.kind == "u" else -100
    return rng.integers(low, 100, full).astype(kind.base)


def random_grid(grid_type: str, seed: int, *, tiles: bool = True, speckles: bool = True) -> RandomGrid:
    """Leaves with speckles, boxes and full ones on both sides of the origin, tiles of 8^3 voxels between them.

    Args:
        grid_type: One that stores values as they are.
        seed: Of everything random.
        tiles: Whether there are active and inactive tiles beside the leaves.
        speckles: Whether half of the leaves hold single voxels.
    """
    rng = np.random.default_rng(seed)
    layout = LAYOUTS[grid_type]
    kind = layout.background
    is_mask = grid_type == "mask"
    background = np.zeros(kind.shape, kind.base) if is_mask else random_values(grid_type, rng, ())
    background = np.asarray(background, kind.base)
    steps = np.arange(LOW + 16, HIGH - 16, 8)
    places = np.stack(np.meshgrid(*3 * [steps], indexing="ij"), axis=-1).reshape(-1, 3).astype(np.int32)
    places = places[rng.permutation(len(places))]
    count, extra = len(places) // 4, 12 if tiles else 0
    leaves, on, off = places[:count], places[count : count + extra], places[count + extra : count + 2 * extra]
    active = rng.random((count, 8, 8, 8)) < rng.random((count, 1, 1, 1)) ** 2
    active &= speckles
    active[: count // 4] = True
    for i in range(count // 4, count // 2):
        a, b = np.sort(rng.integers(0, 9, (2, 3)), axis=0)
        active[i] = False
        active[i][tuple(map(slice, a, b))] = True
    active = active.reshape(count, 512)
    values = active.copy() if is_mask else random_values(grid_type, rng, (count, 512))
    on_values = np.ones(extra, np.bool_) if is_mask else random_values(grid_type, rng, (extra,))
    off_values = np.zeros(extra, np.bool_) if is_mask else random_values(grid_type, rng, (extra,))
    corners = np.unique(np.concatenate([on, off]) & ~np.int32(127), axis=0)
    slots = np.empty((len(corners), 4096, *kind.shape), kind.base)
    slots[:] = background
    states = np.zeros((len(corners), 4096), np.bool_)
    for origins, tile, state in ((on, on_values, True), (off, off_values, False)):
        row = (origins[:, None] & ~np.int32(127) == corners).all(axis=2).argmax(axis=1) if len(origins) else []
        at = (origins >> 3 & 15).astype(np.int64) @ [256, 16, 1]
        slots[row, at], states[row, at] = tile, state
    tree = TypedTree(
        layout,
        background,
        leaves,
        np.packbits(active, axis=1, bitorder="little"),
        values,
        Nodes(corners.reshape(-1, 3), slots, states),
        Nodes.none(layout, 32768),
        Nodes.none(layout),
    )
    # NanoVDB has these classes for these types only.
    grid_class = {"float": "fog volume", "double": "fog volume", "vec3f": "staggered", "vec3d": "staggered"}
    grid_class["mask"] = "topology"
    head = from_dense(
        np.zeros((1, 1, 1)), transform=TRANSFORM, name="some voxels", grid_class=grid_class.get(grid_type, "unknown")
    )
    volume = rebuilt(tree, SparseVolume(head.nanovdb, replace(head.info, metadata=METADATA)))
    size = HIGH - LOW
    dense = np.empty((size, size, size, *kind.shape), kind.base)
    dense[:] = background
    dense_active = np.zeros((size, size, size), np.bool_)
    for origins, contents, bits in (
        (leaves, values, active),
        (on, on_values[:, None], np.ones((extra, 1), np.bool_)),
        (off, off_values[:, None], np.zeros((extra, 1), np.bool_)),
    ):
        for origin, content, bit in zip(origins - LOW, contents, bits, strict=True):
            box = tuple(slice(i, i + 8) for i in origin)
            dense[box] = np.broadcast_to(content, (512, *kind.shape)).reshape(8, 8, 8, *kind.shape)
            dense_active[box] = np.broadcast_to(bit, 512).reshape(8, 8, 8)
    return RandomGrid(volume, dense, dense_active)


def dense_of(volume: SparseVolume) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Values and states of the voxels from LOW to HIGH - 1, as geokit's kernels read them."""
    values = volume.to_dense(bounds=[[LOW] * 3, [HIGH - 1] * 3], device="cpu").values
    active = np.asarray(volume.active_at(_voxels(), space="index", device="cpu"))
    return values, active.reshape(3 * (HIGH - LOW,))


@functools.cache
def _voxels() -> NDArray[np.float64]:
    found = np.moveaxis(np.indices(3 * (HIGH - LOW,), float), 0, -1).reshape(-1, 3) + LOW
    found.flags.writeable = False
    return found


__all__ = ["HIGH", "LOW", "METADATA", "TRANSFORM", "RandomGrid", "bits_of", "dense_of", "random_grid", "random_values"]
