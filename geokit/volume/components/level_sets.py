"""Splits a level set into bodies: each gets the distances to its own surface, as if it were alone.

A voxel outside belongs to the nearest component, which keeps its value. Where other components are near too, they get
the distance that the redistancing of ``level_set`` computes from voxels whose values are surely their own. Leaves
around one component are the rows of that computation, so many components are computed together.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.volume.components.labels import CELL_SPANS, Labels, inside_rows, label_components
from geokit.volume.components.split import tiles_of, volumes_of
from geokit.volume.level_set.leaf_neighbors import AROUND
from geokit.volume.level_set.redistance import Band
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.nodes import bits_of
from geokit.volume.tree.estimates import require_host_room
from geokit.volume.tree.leaves import voxelized
from geokit.volume.tree.typed_tree import RowTable, TypedTree, tree_of
from geokit.volume.tree.typed_writer import Tiles

# Voxels within which outside voxels are compared with voxels inside, to tell whose distance they hold.
TRUST_REACHES = (1, 2, 3)
# Layers of voxels outside to which values are extrapolated: the corners of crossed cells, and their neighbors.
EXTENDED = 2
# A surface runs within the diagonal of a cell from a voxel inside.
DIAGONAL = math.sqrt(3.0)
# The search for the nearest feature goes this much farther than the band, so that its error leaves no voxel out.
MARGIN = 1.5
# Rows that are computed together.
ROWS_AT_A_TIME = 8192
GRAIN = 64


@np.errstate(invalid="ignore")  # signaling NaN of files
def split_level_set(volume: SparseVolume, voxel_size: float, device: "wp.Device") -> list[SparseVolume]:
    """The components of the inside of a level set, with their own bands, by number of active voxels, descending."""
    volume = voxelized(volume)
    tree = tree_of(volume)
    labels = label_components(inside_rows(tree), device)
    count = len(labels.voxel_counts)
    if count < 2:
        return count * [volume]
    rows = _Rows(tree, labels, voxel_size)
    values, masks = rows.contents(device)
    whole_inside = ~masks.any(axis=1) & (values < 0.0).all(axis=1)
    kept = masks.any(axis=1) | ((values < 0.0).any(axis=1) & ~whole_inside)
    solid = Tiles(
        rows.component[whole_inside],
        rows.origins[whole_inside],
        np.full(int(whole_inside.sum()), -tree.background, tree.values.dtype),
        np.zeros(int(whole_inside.sum()), np.bool_),
    )
    tiles = [tiles_of(labels, tree, span) for span in CELL_SPANS[1:]]
    columns: Any = zip(tiles[0], solid, strict=True)
    small = Tiles(*(np.concatenate(pair) for pair in columns))
    tiles[0] = small.rows(np.argsort(small.grid, kind="stable"))
    component, leaf = rows.component[kept], np.flatnonzero(kept)
    active = np.bincount(rows.component, np.unpackbits(masks, axis=1).sum(axis=1), count)
    made = volumes_of(
        tree, component, rows.origins[kept], lambda part: (masks[leaf[part]], values[leaf[part]]), tiles, count, volume
    )
    found = list(made)
    return [found[i] for i in np.argsort(-active, kind="stable")]


class _Rows:
    """Leaves around each component: those that its band may reach, by component, then by leaf.

    Attributes:
        component: Component of each row, from 0 on.
        leaf: Leaf of the tree.
        origins: First voxel.
        shared: Whether the leaf is also near another component.
    """

    def __init__(self, tree: TypedTree, labels: Labels, voxel_size: float) -> None:
        self.tree, self.size = tree, voxel_size
        # A background may be any number; no voxel is farther than this from another.
        extent = float(np.linalg.norm(np.ptp(tree.origins.astype(np.int64), axis=0) + 8))
        self.half_width = min(float(tree.background) / voxel_size, extent)
        self._cells = labels.cells[0]
        self._row_of_leaf = np.full(len(tree.origins), -1)
        self._row_of_leaf[labels.rows[0].leaves] = np.arange(len(self._cells))
        self.component, row = labels.pieces()
        self.leaf = labels.rows[0].leaves[row]
        self._spread(max(math.ceil(self.half_width + DIAGONAL), 2 * TRUST_REACHES[-1]))
        self.origins = tree.origins[self.leaf]
        self.shared = np.bincount(self.leaf, minlength=len(tree.origins))[self.leaf] > 1

    def _spread(self, reach: int) -> None:
        """Add the leaves within ``reach`` voxels of the voxels inside."""
        steps = math.ceil(reach / 8)
        most = min((2 * steps + 1) ** 3 * len(self.leaf), len(self.tree.origins) * int(self.component.max() + 1))
        require_host_room(most * 4096, f"volume: {most:,} leaves around its components")
        low, high = np.empty((len(self.leaf), 3), np.int64), np.empty((len(self.leaf), 3), np.int64)
        for first in range(0, len(self.leaf), ROWS_AT_A_TIME):
            part = slice(first, first + ROWS_AT_A_TIME)
            cube = bits_of(self.own(part).view(np.uint8)).reshape(-1, 8, 8, 8)
            for axis in range(3):
                line: Any = cube.any(axis=tuple({1, 2, 3} - {axis + 1}))
                low[part, axis], high[part, axis] = line.argmax(axis=1), 7 - line[:, ::-1].argmax(axis=1)
        table, origins = RowTable(self.tree.origins), self.tree.origins[self.leaf].astype(np.int64)
        found = []
        for step in np.stack(np.meshgrid(*3 * [np.arange(-steps, steps + 1)], indexing="ij"), axis=-1).reshape(-1, 3):
            reached = np.asarray(
                np.where(step > 0, high + reach >= 8 * step, (step == 0) | (low - reach < 8 * step + 8))
            )
            some = np.flatnonzero(reached.all(axis=1))
            there = table.find(origins[some] + 8 * step)
            found.append(self.component[some][there >= 0] << 32 | there[there >= 0])
        both = np.unique(np.concatenate(found))
        self.component, self.leaf = both >> 32, both & 0xFFFFFFFF

    def own(self, part: Any) -> NDArray[np.uint64]:
        """Bit masks of the voxels inside the component of each row, (N, 8)."""
        row = self._row_of_leaf[self.leaf[part]]
        bits = (self._cells[row] == self.component[part, None] + 1) & (row >= 0)[:, None]
        return np.packbits(bits, axis=1, bitorder="little").view(np.uint64)

    def contents(self, device: "wp.Device") -> tuple[NDArray[Any], NDArray[np.uint8]]:
        """Values (N, 512) and masks (N, 64) of the rows, as if each component were alone."""
        tree = self.tree
        values, masks = np.array(tree.values[self.leaf]), np.array(tree.masks[self.leaf])
        # Components that share no leaf keep everything.
        rows = np.flatnonzero(self._with_any(self.shared)[self.component])
        if not len(rows):
            return values, masks
        near = np.concatenate([self._near(part, device) for part in _parts(self.component[rows], rows)])
        rows = rows[self._clear(rows, near, values, masks)]
        if not len(rows):
            return values, masks
        distance = np.concatenate([self._distances(part, device) for part in _parts(self.component[rows], rows)])
        shared = np.flatnonzero(self.shared[rows])
        order = shared[np.argsort(self.leaf[rows][shared], kind="stable")]
        leaves, starts, sizes = np.unique(self.leaf[rows][order], return_index=True, return_counts=True)
        for first in range(0, len(leaves), ROWS_AT_A_TIME):
            last = min(first + ROWS_AT_A_TIME, len(leaves)) - 1
            part = order[starts[first] : starts[last] + sizes[last]]
            nearest = np.minimum.reduceat(distance[part], starts[first : last + 1] - starts[first], axis=0)
            self._take(rows[part], distance[part], np.repeat(nearest, sizes[first : last + 1], axis=0), values, masks)
        return values, masks

    def _with_any(self, marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Whether each component has a marked row."""
        return np.bincount(self.component, marked, int(self.component[-1]) + 1) > 0

    def _clear(
        self, rows: NDArray[np.int64], near: NDArray[np.uint64], out_values: NDArray[Any], out_masks: NDArray[np.uint8]
    ) -> NDArray[np.bool_]:
        """Empty the voxels that no component's band reaches; returns the rows of components whose bands meet others."""
        shared = np.flatnonzero(self.shared[rows])
        order = shared[np.argsort(self.leaf[rows[shared]], kind="stable")]
        leaves, starts, sizes = np.unique(self.leaf[rows[order]], return_index=True, return_counts=True)
        meets = np.zeros(len(self.leaf), np.bool_)
        for first in range(0, len(leaves), ROWS_AT_A_TIME):
            last = min(first + ROWS_AT_A_TIME, len(leaves)) - 1
            part = order[starts[first] : starts[last] + sizes[last]]
            bits = bits_of(near[part].view(np.uint8)) & bits_of(out_masks[rows[part]])
            twice = np.add.reduceat(bits, starts[first : last + 1] - starts[first], axis=0, dtype=np.int32) > 1
            meets[rows[part]] = (bits & np.repeat(twice, sizes[first : last + 1], axis=0)).any(axis=1)
            own = bits_of(self.own(rows[part]).view(np.uint8))
            values = out_values[rows[part]]
            values[~own & ~bits] = self.tree.background
            out_values[rows[part]] = values
            out_masks[rows[part]] &= np.packbits(own | bits, axis=1, bitorder="little")
        return self._with_any(meets)[self.component[rows]]

    def _near(self, part: NDArray[np.int64], device: "wp.Device") -> NDArray[np.uint64]:
        """Bit masks of the voxels that the band of each row's component may reach, (N, 8)."""
        from geokit.volume.level_set.mask_dilation_kernels import grow_vertices_kernel

        rows = _DeviceRows(self, part, device)
        near = rows.inside
        # The surface runs less than a voxel along each axis from a voxel inside, and the band ends before its width.
        for _ in range(math.ceil(self.half_width)):
            grown = wp.empty_like(near)
            inputs = [near, wp.uint64(0), rows.beside]
            launcher.launch(grow_vertices_kernel, 8 * len(part), inputs, [grown], device, grain=GRAIN)
            near = grown
        return near.numpy().reshape(-1, 8)

    def _take(
        self,
        rows: NDArray[np.int64],
        distance: NDArray[np.float32],
        nearest: NDArray[np.float32],
        out_values: NDArray[Any],
        out_masks: NDArray[np.uint8],
    ) -> None:
        """Outside voxels for which another component is nearer, or that lie in one, take their own distance."""
        values = out_values[rows]
        own = bits_of(self.own(rows).view(np.uint8))
        keeps = own | ((values >= 0.0) & (distance == nearest) & np.isfinite(distance))
        background = self.tree.background
        far = (distance * self.size).astype(values.dtype)
        near = far < background
        active = np.where(keeps, bits_of(out_masks[rows]), near)
        # Outside its band a component has the background, whatever is there.
        out_values[rows] = np.where(keeps, values, np.where(near, far, background))
        out_masks[rows] = np.packbits(active, axis=1, bitorder="little")

    def _distances(self, part: NDArray[np.int64], device: "wp.Device") -> NDArray[np.float32]:
        """Distance [voxels] of the voxels outside to the component of each row, infinite beyond the band."""
        from geokit.volume.components import level_sets_kernels as kernels
        from geokit.volume.level_set.mask_dilation_kernels import grow_vertices_kernel

        rows: Any = _DeviceRows(self, part, device)
        count = len(part)

        def launch(kernel: Any, inputs: list[Any], outputs: list[Any]) -> None:
            launcher.launch(kernel, 8 * count, inputs, outputs, device, grain=GRAIN)

        size, background = wp.float64(self.size), wp.float64(self.tree.background)
        near, others = [rows.inside], rows.others
        for reach in TRUST_REACHES:
            near.append(wp.empty_like(others))
            grown = wp.empty_like(others)
            launch(grow_vertices_kernel, [near[-2], wp.uint64(0), rows.beside], [near[-1]])
            launch(grow_vertices_kernel, [others, wp.uint64(0), rows.beside], [grown])
            others = grown
            launch(kernels.trust_kernel, [rows.values, near[-1], others, wp.float64(reach), size], [rows.active])
        # Features of the known voxels on both sides extend the field to the voxels around the surface,
        known, given = wp.empty_like(others), wp.clone(rows.values)
        band = Band(rows, float(background), self.size, 0.0)
        enclosed, _ = band._choose(False)
        launch(kernels.doubt_kernel, [given, enclosed, rows.beside, band.nearest, size], [band.feet])
        inputs = [rows.on_device, rows.inside, rows.active, near[EXTENDED], rows.beside, band.nearest, band.features]
        launch(kernels.extend_kernel, [*inputs, band.feet, background, size], [rows.values, known])
        # and from these it is redistanced.
        trusted, rows.active = rows.active, known
        band = Band(rows, float(background), self.size, 0.0)
        band.hold_seeds()
        band._settle(band._still(*band._choose(False)), self.half_width + MARGIN)
        distance = wp.empty(512 * count, dtype=wp.float32, device=device)
        inputs = [
            rows.on_device,
            rows.beside,
            given,
            rows.inside,
            trusted,
            band.nearest,
            band.features,
            band.feet,
            size,
        ]
        launch(kernels.distances_kernel, inputs, [distance])
        return distance.numpy().reshape(-1, 512)


class _DeviceRows:
    """Rows on a device, with links between those of one component, as ``Band`` takes them."""

    def __init__(self, rows: _Rows, part: NDArray[np.int64], device: "wp.Device") -> None:
        tree, leaf, origins = rows.tree, rows.leaf[part], rows.origins[part]
        own = rows.own(part)
        values = tree.values[leaf].astype(np.float64)
        inside = np.packbits(values < 0.0, axis=1, bitorder="little").view(np.uint64)
        active = np.ascontiguousarray(tree.masks[leaf]).view(np.uint64) & own
        self.device = device
        self.tiles = origins >> 3

        def on_device(array: NDArray[Any], dtype: Any) -> "wp.array":
            return wp.array(np.ascontiguousarray(array), dtype=dtype, device=device)

        self.on_device = on_device(self.tiles, wp.vec3i)
        self.values = on_device(values.reshape(-1), wp.float64)
        self.active = on_device(active.reshape(-1), wp.uint64)
        self.inside = on_device(own.reshape(-1), wp.uint64)
        self.others = on_device((inside & ~own).reshape(-1), wp.uint64)
        self.beside = on_device(_links(rows.component[part], leaf, tree.origins), wp.int32)


def _links(component: NDArray[np.int64], leaf: NDArray[np.int64], origins: NDArray[np.int32]) -> NDArray[np.int32]:
    """Row of the same component in each of the 27 places around a row, -1 without one."""
    known, number = np.unique(leaf, return_inverse=True)
    table = RowTable(origins[known])
    around = np.stack([table.find(origins[known].astype(np.int64) + 8 * step) for step in AROUND], axis=1)
    keys = component * len(known) + number.reshape(-1)
    wanted = around[number.reshape(-1)]
    both = component[:, None] * len(known) + wanted
    at = np.minimum(np.searchsorted(keys, both.reshape(-1)), len(keys) - 1).reshape(both.shape)
    return np.where((wanted >= 0) & (keys[at] == both), at, -1).astype(np.int32)


def _parts(component: NDArray[np.int64], rows: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Rows in parts of about ROWS_AT_A_TIME, each with all rows of its components."""
    starts = np.flatnonzero(np.diff(component, prepend=-1))
    cuts = starts[np.diff(starts // ROWS_AT_A_TIME, prepend=-1) > 0]
    return np.split(rows, cuts[1:])
