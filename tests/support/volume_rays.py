"""Volumes and rays that the tests of rays through volumes share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.catalog.float_grids import build_float_grid
from geokit.volume._raycast import VolumeHits, raycast
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of
from geokit.volume.rays import crossing_blocks
from tests.support import reference

# t in voxels: roundings of coordinates up to 100 voxels, and of voxels of size 1, divided by slopes that are seldom
# below 1e-3.
ROUNDING = 1e-10


class Field:
    """A float grid of whole leaves with known voxels: those of ``dense`` from ``lower`` on, elsewhere a background."""

    def __init__(
        self,
        dense: NDArray[np.float64],
        lower: tuple[int, int, int] = (0, 0, 0),
        background: float = 1.0,
        transform: NDArray[np.float64] | None = None,
        stored: NDArray[np.bool_] | None = None,
    ) -> None:
        self.dense, self.lower, self.background = dense.astype(np.float32).copy(), np.array(lower), background
        self.transform = np.eye(4) if transform is None else transform
        blocks = np.array(dense.shape) // 8
        kept = np.ones(blocks, bool) if stored is None else stored
        self.dense[~np.repeat(np.repeat(np.repeat(kept, 8, 0), 8, 1), 8, 2)] = background
        leaves = self.dense.reshape(blocks[0], 8, blocks[1], 8, blocks[2], 8).transpose(0, 2, 4, 1, 3, 5)
        leaves = leaves[kept].reshape(-1, 512)
        buffer = build_float_grid(
            (np.argwhere(kept) * 8 + self.lower).astype(np.int32),
            leaves,
            np.ones(leaves.shape, bool),
            background=background,
            transform=self.transform,
            name="field",
            grid_class="unknown",
            signed_fill=False,
        )
        self.volume = SparseVolume(buffer, info_of(buffer))

    def at(self, ijk: NDArray[np.int64]) -> NDArray[np.float64]:
        """Values of voxels (N, 3)."""
        local = ijk - self.lower
        inside = ((local >= 0) & (local < self.dense.shape)).all(axis=1)
        out = np.full(len(ijk), float(np.float32(self.background)))
        out[inside] = self.dense[tuple(local[inside].T)]
        return out

    def to_world(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Points and vectors of index space in world space."""
        linear = self.transform[:3, :3]
        return u @ linear.T + self.transform[:3, 3], v @ linear.T


def rays_through(
    lower: NDArray[np.float64], upper: NDArray[np.float64], count: int, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rays in index space that start within a few voxels of a box or in it, and lead through a point of it."""
    rng = np.random.default_rng(seed)
    start = rng.uniform(lower - 12, upper + 12, (count, 3))
    toward = rng.uniform(lower, upper, (count, 3)) - start
    return start, toward / np.abs(toward).max(axis=1, keepdims=True)


def both_ways(monkeypatch, *arguments, **options) -> VolumeHits:
    """The hits, found cell by cell from the tree, and the same bits by the blocks that hold crossings."""
    monkeypatch.setattr(crossing_blocks, "BLOCKS_PER_RAY", 0)
    plain = raycast(*arguments, device="cpu", **options)
    monkeypatch.setattr(crossing_blocks, "BLOCKS_PER_RAY", 1 << 20)
    by_blocks = raycast(*arguments, device="cpu", **options)
    for one, other in zip(plain, by_blocks, strict=True):
        np.testing.assert_array_equal(one, other)
    return plain


def assert_first_crossings(at, start, toward, t, *, isovalue=0.0, first=0.0, last=80.0, atol=ROUNDING, size=1.0):
    """No ray crosses the isovalue before its t, up to ``last``, and at t it is there; voxels of about ``size``."""
    for o, d, found in zip(start, toward, t, strict=True):
        wanted = reference.first_level(at, o, d, isovalue, first, last)
        assert found <= wanted + atol
        if found > last:
            continue
        assert first <= found
        # The value at t is the isovalue, up to how much it changes within the error of t.
        near = reference.interpolant_along(at, o, d, np.array([found - atol, found, found + atol]))
        assert np.abs(near[1] - isovalue) <= 1e-12 * size + np.abs(near - near[1]).max()
