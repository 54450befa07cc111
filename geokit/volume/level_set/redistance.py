"""Redistancing: signed distances in a band around a level set's surface, from crossed cells or from a kept band.

Beyond the sharp edges of an eroded body they are those from the body behind tangent planes at the edge."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.scan import prefix_sum
from geokit.volume.level_set.band_widths import widths_of
from geokit.volume.level_set.leaf_neighbors import LinkedLeaves
from geokit.volume.model.sparse_volume import SparseVolume, made_on_device
from geokit.volume.nanovdb.header import info_of
from geokit.volume.nanovdb.layout import LAYOUTS
from geokit.volume.tree.device_leaves import leaf_keys
from geokit.volume.tree.device_writer import Leaves, build_on_device
from geokit.volume.tree.estimates import least_leaves
from geokit.volume.tree.grid_head import checked_head, info_like, result_head, volume_from_buffer
from geokit.volume.tree.leaves import build_real_grid

# Voxels by which a band grows before leaves are added. With one more for rounding it must not grow beyond the leaves
# adjacent to those that it has reached.
STAGE = 7.0
# The length to the nearest foot, with its penalty (ONE_SIDED), exceeds the distance to the surface between feet by less
# than this.
WAY_MARGIN = 0.5
# Up to this width [voxels] corners of cells that a surface on the lattice crosses may not be active: they are as far as
# the band is wide.
NARROW = 1.0 + 1e-5
# Least distance [voxels] beyond the corners of crossed cells: no cell around such a voxel is crossed, so the surface is
# a voxel away, but for how far it bulges into a cell.
BEYOND_SEEDS = 0.5
# Fewest planes of leaves per thread.
GRAIN = 64
# Share of sound voxels close to the surface with which a level set counts as one of distances.
LEAST_SOUND = 0.35


def redistance(
    volume: SparseVolume,
    voxel_size: float,
    half_width: float,
    *,
    isovalue: float = 0.0,
    keeps_band: bool = False,
    device: Any = None,
) -> SparseVolume:
    """Signed distances from a level set's surface, in a band of another width.

    Args:
        volume: Float, double or quantized level set on cubic voxels.
        voxel_size: Edge of a voxel [world].
        half_width: Half width of the new band [voxels].
        isovalue: Value of the surface [voxels]; 0 with ``keeps_band``. Distances on the side from which the surface
            came are those of the level set, and those beyond sharp edges are from the edges.
        keeps_band: Active voxels keep their values; only voxels beyond them are computed. A band of two widths counts
            as one of the narrower.
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Level set of float or double values.
    Raises:
        DeviceMemoryError: The band needs more memory than there is.
        InputError: The leaves are too far apart.
    """
    found = launcher.resolve_device(device)
    leaves = LinkedLeaves(volume, isovalue * voxel_size, found)
    background = float(volume.info.background)
    widths = widths_of(volume, voxel_size)
    if not widths.are_equal:
        background = widths.narrowest * voxel_size
    old_width = background / voxel_size
    if old_width <= NARROW:
        leaves.activate_beside_zeros((NARROW - 1.0) * voxel_size)
    band = Band(leaves, background, voxel_size, isovalue * voxel_size)
    if keeps_band:
        # Every active voxel is held with its value. Voxels beyond the band are at least as far as it is wide.
        start = least = old_width
    else:
        band.hold_seeds()
        start, least = 0.0, BEYOND_SEEDS
    beside = leaves.beside
    if half_width > start:
        band.spread(start, half_width, only_border=keeps_band)
    if isovalue != 0.0:
        spread = [band.nearest, band.features]
        field = background, isovalue * voxel_size, voxel_size
        _hold_beyond_edges(leaves, beside, field, half_width, spread, band.known, band.held)
    return band.volume(volume, half_width * voxel_size, least)


class Band:
    """A band that grows from its held voxels, whose distances are known."""

    feet: "wp.array"

    def __init__(self, leaves: LinkedLeaves, background: float, voxel_size: float, isovalue: float) -> None:
        from geokit.volume.level_set.features_kernels import Features

        self.leaves, self.device = leaves, leaves.device
        self.rows = len(leaves.tiles)
        self.size = wp.float64(voxel_size)
        self.field = [wp.float64(background), wp.float64(isovalue), self.size]
        self.known = leaves.values
        self.held = leaves.active
        self.features = Features()
        # Relative gradient of the slope; None if values are not divided by a slope.
        self.rise: wp.array | None = None
        self.nearest: wp.array = wp.full(512 * self.rows, -1, dtype=wp.int32, device=self.device)

    def hold_seeds(self) -> None:
        """Hold the corners of crossed cells, with their values divided by the slope."""
        from geokit.volume.level_set import interface_distance_kernels as kernels

        leaves = self.leaves
        slopes = wp.empty(512 * self.rows, dtype=wp.float32, device=self.device)
        crossed = self._words()
        self._launch(
            kernels.cell_slopes_kernel, [leaves.values, leaves.inside, leaves.beside, *self.field], [slopes, crossed]
        )
        self.known = wp.empty(512 * self.rows, dtype=wp.float64, device=self.device)
        self.held = self._words()
        self.rise = wp.empty(512 * self.rows, dtype=wp.vec3f, device=self.device)
        inputs = [leaves.values, leaves.active, slopes, crossed, leaves.beside, *self.field]
        self._launch(kernels.seeds_kernel, inputs, [self.known, self.held, self.rise])

    def spread(self, start: float, end: float, *, only_border: bool) -> None:
        """Give voxels up to ``end`` [voxels] from the surface their nearest feature; held voxels end at ``start``."""
        enclosed, chosen = self._choose(only_border)
        # A band that cannot fit is refused before hours of growth.
        self.leaves.require_memory(least_leaves(len(self.feet), end - start))
        still = self._still(enclosed, chosen)
        # Without a feature nothing is reached, however wide the band: a damaged background may promise 1e38 voxels.
        at = start if len(self.feet) else end
        while at < end:
            step = min(STAGE, end - at)
            at += step
            self.leaves.add(self.leaves.within(self._reached(), math.ceil(step) + 1))
            still = self.leaves.extended(still, 8, 0)
            self.nearest = self.leaves.extended(self.nearest, 512, -1)
            self._settle(still, at + WAY_MARGIN)

    def _choose(self, only_border: bool) -> tuple["wp.array", "wp.array"]:
        from geokit.volume.level_set import features_kernels as kernels

        leaves, beside = self.leaves, self.leaves.beside
        enclosed, inner, outer, chosen = (self._words() for _ in range(4))
        self._launch(
            kernels.enclosed_kernel, [self.held, leaves.active, leaves.inside, beside], [enclosed, inner, outer]
        )
        border = self.held
        if only_border:
            border = self._words()
            self._launch(kernels.border_kernel, [self.held, enclosed, beside], [border])
        counts = wp.empty(8 * self.rows, dtype=wp.int32, device=self.device)
        self._launch(kernels.chosen_kernel, [border, inner, outer, leaves.inside, self.known, beside], [chosen, counts])
        ends, count = prefix_sum(counts)
        made = self.features
        for name, kind in (
            ("voxel", wp.vec3i), ("normal", wp.vec3f), ("distance", wp.float64), ("curve", kernels.vec6f),
        ):  # fmt: skip
            setattr(made, name, wp.empty(count, dtype=kind, device=self.device))
        self.feet = wp.empty(count, dtype=wp.vec4d, device=self.device)
        inputs = [leaves.values, leaves.active, leaves.inside, beside, leaves.on_device, self.known, self.size]
        self._launch(kernels.features_kernel, [*inputs, enclosed, chosen, ends], [made, self.feet, self.nearest])
        if self.rise is not None:
            self._launch(kernels.straighten_kernel, [chosen, ends, self.rise], [made, self.feet])
        return enclosed, chosen

    def _still(self, enclosed: "wp.array", chosen: "wp.array") -> "wp.array":
        """Bit masks of the voxels that keep their feature or have none: features, and the voxels behind them."""
        from geokit.volume.level_set.features_kernels import still_kernel

        still = self._words()
        self._launch(still_kernel, [enclosed, chosen], [still])
        return still

    def _reached(self) -> "wp.array":
        """Bit masks of the voxels that have a feature."""
        from geokit.volume.level_set.feature_transform_kernels import reached_kernel

        count = 8 * len(self.leaves.tiles)
        reached = wp.empty(count, dtype=wp.uint64, device=self.device)
        launcher.launch(reached_kernel, count, [self.nearest], [reached], self.device, grain=GRAIN)
        return reached

    def _settle(self, still: "wp.array", reach: float) -> None:
        """Run rounds until no voxel finds a nearer feature."""
        from geokit.volume.level_set import feature_transform_kernels as kernels

        leaves, device = self.leaves, self.device
        count = len(leaves.tiles)
        changed = self._reached()
        reached = wp.clone(changed)
        changing = wp.empty_like(changed)
        following = wp.empty_like(self.nearest)
        has_changed = wp.empty(count, dtype=wp.uint8, device=device)
        where = [leaves.on_device, leaves.beside, leaves.inside, still, self.feet, wp.float32(reach)]
        while True:
            launcher.launch(kernels.has_changed_kernel, count, [changed], [has_changed], device)
            if not has_changed.numpy().any():
                return
            inputs = [*where, self.nearest, changed, has_changed, reached]
            launcher.launch(kernels.spread_kernel, 8 * count, inputs, [following, changing], device, grain=GRAIN)
            launcher.launch(
                kernels.take_kernel, 8 * count, [changing, following], [self.nearest, reached], device, grain=GRAIN
            )
            changed, changing = changing, changed

    def volume(self, like: SparseVolume, background: float, least: float) -> SparseVolume:
        """The band as a grid, with the transform, name and metadata of another; no new distance is below ``least``."""
        from geokit.volume.level_set import leaf_neighbors_kernels as links
        from geokit.volume.level_set.feature_transform_kernels import FILL

        leaves, device = self.leaves, self.device
        count = len(leaves.tiles)
        is_double = like.info.grid_type == "double"
        if not is_double:
            background = float(np.float32(background))
        kind = wp.float64 if is_double else wp.float32
        value = wp.empty(512 * count, dtype=kind, device=device)
        active, negative = (wp.empty(8 * count, dtype=wp.uint64, device=device) for _ in range(2))
        held = leaves.extended(self.held, 8, 0)
        lengths = [self.size, wp.float64(least), wp.float64(background)]
        inputs = [leaves.on_device, leaves.inside, held, self.known, self.nearest, self.features, *lengths]
        launcher.launch(FILL[kind], 8 * count, inputs, [value, active, negative], device, grain=GRAIN)
        needed = wp.empty(count, dtype=wp.uint8, device=device)
        launcher.launch(
            links.needed_rows_kernel, count, [active, negative, leaves.beside], [needed], device, grain=GRAIN
        )
        rows = np.flatnonzero(needed.numpy())
        if is_double:
            return _double_volume(leaves.tiles, rows, value, active, background, like)
        return _float_volume(leaves, rows, value, active, negative, background, like)

    def _words(self) -> "wp.array":
        return wp.empty(8 * self.rows, dtype=wp.uint64, device=self.device)

    def _launch(self, kernel: Any, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel for each plane of the rows that the volume had before any was added."""
        launcher.launch(kernel, 8 * self.rows, inputs, outputs, self.device, grain=GRAIN)


def _float_volume(
    leaves: LinkedLeaves,
    rows: NDArray[np.int64],
    value: "wp.array",
    active: "wp.array",
    negative: "wp.array",
    background: float,
    like: SparseVolume,
) -> SparseVolume:
    from geokit.volume.level_set.leaf_neighbors_kernels import gather_rows_kernel
    from geokit.volume.tree.device_writer_kernels import copy_leaves_kernel

    device, info = leaves.device, like.info
    head = checked_head("float", background, -background, info.transform, info.name, "level set")
    keys, uppers = leaf_keys(8 * leaves.tiles[rows])
    order = np.argsort(keys, kind="stable")
    in_order = wp.array(rows[order].astype(np.int32), dtype=wp.int32, device=device)
    inside = wp.empty((len(rows), 8), dtype=wp.uint64, device=device)
    launcher.launch(gather_rows_kernel, len(rows), [in_order, negative], [inside], device)

    def write(buffer: "wp.array", begin: int) -> None:
        inputs = [wp.int64(begin), in_order, value.view(wp.int32), active]
        launcher.launch(copy_leaves_kernel, 8 * len(rows), inputs, [buffer], device)

    where = Leaves(wp.array(keys[order], dtype=wp.int64, device=device), leaves.on_device, in_order, uppers)
    grid = build_on_device(where, head, write, inside)
    if grid.host is not None:
        return volume_from_buffer(grid.host, like)
    return made_on_device(grid.buffer, info_like(info_of(grid.head, byte_count=grid.size), like))


def _double_volume(
    tiles: NDArray[np.int32],
    rows: NDArray[np.int64],
    value: "wp.array",
    active: "wp.array",
    background: float,
    like: SparseVolume,
) -> SparseVolume:
    head = result_head(like, LAYOUTS["double"], background, "level set", like.info.transform)
    masks = active.numpy().view(np.uint8).reshape(-1, 64)[rows]
    values = value.numpy().reshape(-1, 512)[rows]
    return volume_from_buffer(build_real_grid(head, 8 * tiles[rows], masks, values), like)


def _hold_beyond_edges(
    leaves: LinkedLeaves,
    beside: "wp.array",
    field: tuple[float, float, float],
    half_width: float,
    spread: list[Any],
    known: "wp.array",
    held: "wp.array",
) -> None:
    """Give the voxels outside of an eroded body, or inside of one that grew, the distances from its sharp edges.

    Distances on the side from which the surface came are those of the field. Beyond edges, each voxel starts from the
    nearest point of the surface as a mesh that keeps edges; tangent planes around that point then bound the body.
    Nothing changes if the level set does not hold distances.

    Args:
        leaves: Leaves of the level set whose surface moves, relative to the isovalue.
        beside: Neighbors of its rows before any was added, because only those have values.
        field: Width of its band, isovalue and voxel size [world].
        half_width: Half width of the new band [voxels].
        spread: Nearest feature of each voxel, and the features.
        known, held: Distances [world], and bit masks of the voxels that have one; both are changed.
    """
    from geokit.mesh.model.device_mesh import mesh_on_device
    from geokit.mesh.surfaces.surface import Surface
    from geokit.volume.isosurface.surface_nets import surface_nets
    from geokit.volume.level_set import sharp_edges_kernels as kernels

    device, planes = leaves.device, len(held)
    source = kernels.Field()
    source.volume = leaves.handle
    background, isovalue, voxel_size = field
    source.background, source.isovalue = wp.float64(background), wp.float64(isovalue)
    source.scale = wp.float64(voxel_size if isovalue < 0.0 else -voxel_size)
    near, sound = (wp.empty(planes, dtype=wp.int32, device=device) for _ in range(2))
    inputs = [leaves.values, leaves.active, beside, source]
    launcher.launch(kernels.sound_kernel, planes, inputs, [near, sound], device, grain=GRAIN)
    if prefix_sum(sound)[1] < LEAST_SOUND * prefix_sum(near)[1]:
        return
    beyond = wp.empty(planes, dtype=wp.uint64, device=device)
    counts = wp.empty(planes, dtype=wp.int32, device=device)
    inputs = [leaves.values, leaves.active, leaves.on_device, beside, *spread, source, wp.float64(half_width)]
    launcher.launch(kernels.beyond_edges_kernel, planes, inputs, [known, held, beyond, counts], device, grain=GRAIN)
    ends, count = prefix_sum(counts)
    if not count:
        return
    vertices, faces = surface_nets(leaves.volume, field[1], device, turned=False, sharp=True, transform=np.eye(4))
    if not len(faces):
        return
    points = wp.empty(count, dtype=wp.vec3d, device=device)
    launcher.launch(kernels.list_kernel, planes, [leaves.on_device, beyond, ends], [points], device, grain=GRAIN)
    feet = Surface(mesh_on_device(vertices, faces, ""), device=device).closest_point(points).points
    cells, cell_of = np.unique(np.floor(feet.numpy()).astype(np.int32), axis=0, return_inverse=True)
    rows = wp.array(cells, dtype=wp.vec3i, device=device)
    bounds = wp.empty((len(cells), int(kernels.MOST_PLANES)), dtype=wp.vec4d, device=device)
    bound_counts = wp.empty(len(cells), dtype=wp.int32, device=device)
    launcher.launch(kernels.planes_kernel, len(cells), [rows, source], [bounds, bound_counts], device, grain=16)
    distance = wp.empty(count, dtype=wp.float64, device=device)
    of = wp.array(cell_of.reshape(-1).astype(np.int32), dtype=wp.int32, device=device)
    inputs = [points, feet, of, rows, bounds, bound_counts, source]
    launcher.launch(kernels.project_kernel, count, inputs, [distance], device, grain=GRAIN)
    inputs = [leaves.on_device, *spread, source, beyond, ends, distance]
    launcher.launch(kernels.hold_kernel, planes, inputs, [known, held], device, grain=GRAIN)
