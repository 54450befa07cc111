"""Small volumes with known values, made from leaves, and damaged files."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.catalog.float_grids import build_float_grid
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of

VOXELS = np.stack(np.meshgrid(*3 * [np.arange(8)], indexing="ij"), axis=-1).reshape(-1, 3)
ROTATED = np.array([[0.06, -0.08, 0.0, 5.0e6], [0.08, 0.06, 0.0, -3.0], [0.0, 0.0, 0.1, 7.0], [0.0, 0.0, 0.0, 1.0]])


def sphere_leaves(
    radius: float, center: tuple[int, int, int] = (0, 0, 0), half_width: float = 3.0
) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.bool_]]:
    """Leaves of a sphere's narrow band in voxel units: origins (L, 3), values (L, 512), masks (L, 512)."""
    middle = np.array(center)
    ends = [
        np.arange(int(np.floor((c - radius - half_width) / 8)), int((c + radius + half_width) // 8) + 1) for c in middle
    ]
    origins = 8 * np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, 3)
    nearest = np.linalg.norm(np.clip(middle, origins, origins + 7) - middle, axis=1)
    farthest = np.linalg.norm(np.maximum(np.abs(origins - middle), np.abs(origins + 7 - middle)), axis=1)
    origins = origins[(nearest < radius + half_width) & (farthest > radius - half_width)].astype(np.int32)
    distance = np.empty((len(origins), 512), np.float32)
    for first in range(0, len(origins), 1000):  # the voxels of all leaves at once would take half a gigabyte
        rows = slice(first, first + 1000)
        distance[rows] = sphere_distance(origins[rows, None, :] + VOXELS, radius, center)
    return origins, np.clip(distance, -half_width, half_width), np.abs(distance) < half_width


def sphere_distance(
    voxels: NDArray[Any], radius: float, center: tuple[int, int, int] = (0, 0, 0)
) -> NDArray[np.float32]:
    """Signed distance of voxels (..., 3) from a sphere, rounded once to float32."""
    return (np.linalg.norm((voxels - np.array(center)).astype(np.float64), axis=-1) - radius).astype(np.float32)


def sphere(
    radius: float = 10.0,
    center: tuple[int, int, int] = (0, 0, 0),
    *,
    name: str = "sphere",
    transform: NDArray[np.float64] | None = None,
) -> SparseVolume:
    """A level set of a sphere, background 3."""
    origins, values, masks = sphere_leaves(radius, center)
    buffer = build_float_grid(
        origins,
        values,
        masks,
        background=3.0,
        transform=np.eye(4) if transform is None else transform,
        name=name,
        grid_class="level set",
        signed_fill=True,
    )
    return SparseVolume(buffer, info_of(buffer))


def lookup(buffer: NDArray[np.uint8], voxels: NDArray[np.int64]) -> NDArray[np.float32]:
    """Values of a float grid at voxels (N, 3), walked down the tree in plain Python: slow and independent of geokit."""
    from struct import unpack_from

    data = buffer.tobytes()
    root = 672 + unpack_from("<Q", data, 672 + 24)[0]
    (tiles,) = unpack_from("<I", data, root + 24)
    table = {}
    for i in range(tiles):
        key, child, _, value = unpack_from("<QqIf", data, root + 64 + 32 * i)
        table[key] = (child, value)
    (background,) = unpack_from("<f", data, root + 28)
    out = np.empty(len(voxels), np.float32)
    for n, (x, y, z) in enumerate(voxels.tolist()):
        key = ((x & 0xFFFFFFFF) >> 12) << 42 | ((y & 0xFFFFFFFF) >> 12) << 21 | ((z & 0xFFFFFFFF) >> 12)
        child, out[n] = table.get(key, (0, background))
        at = root + child
        for bits, total, masks, slots in ((5, 7, 4096, 8256), (4, 3, 512, 1088)):
            if not child:
                break
            low = (1 << bits) - 1
            slot = ((x >> total) & low) << 2 * bits | ((y >> total) & low) << bits | ((z >> total) & low)
            if data[at + 32 + masks + slot // 8] >> slot % 8 & 1:
                (child,) = unpack_from("<q", data, at + slots + 8 * slot)
                at += child
            else:
                (out[n],) = unpack_from("<f", data, at + slots + 8 * slot)
                child = 0
        if child:
            (out[n],) = unpack_from("<f", data, at + 96 + 4 * ((x & 7) << 6 | (y & 7) << 3 | (z & 7)))
    return out
