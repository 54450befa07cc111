"""A narrow-band signed distance field from a triangle mesh; only the tiles near its surface are touched."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit import _arrays, _launch, _memory
from geokit.errors import DeviceMemoryError, InputError
from geokit.volume._build import allocate_float_grid, finish
from geokit.volume._nanovdb import info_of
from geokit.volume.model import SparseVolume

if TYPE_CHECKING:
    import warp as wp

    from geokit.mesh.model import TriangleMesh
    from geokit.mesh.surface import Surface

__all__ = ["from_mesh"]

# Beyond this index a float32 coordinate, as warp's own volume functions use, resolves less than 1/16 voxel.
LARGEST_CENTERED_INDEX = 1 << 20
# Tiles along an axis that a 63-bit key of three coordinates can tell apart.
TILES_PER_AXIS = 1 << 21
# A leaf of a float grid in NanoVDB: 512 values, a mask and extrema.
LEAF_BYTES = 2144
# Beside its leaf, a tile costs its distance, two copies of its signs, its neighbours and its keys while it is made.
WORKING_BYTES = 512 * 6 + 128
# Boxes of all triangles, in tiles, above which testing tile by tile would take longer than filling them.
MOST_TILE_TESTS = 4e9
# The distances of two neighbours on either side of a wall that is square to them add up to a voxel exactly; rounded to
# float32 they may add up to a little more, and a flood must not pass there.
FLOOD_MARGIN = 1.00001
# Rounds of seeds and floods before the voxels that are left are asked one by one: the fourth finds next to nothing.
FLOOD_ROUNDS = 3


def from_mesh(
    mesh: TriangleMesh | Surface,
    voxel_size: float,
    *,
    half_width: float = 3.0,
    name: str | None = None,
    device: Any = None,
) -> SparseVolume:
    """Signed distance to a mesh on the voxels within ``half_width`` of its surface, as a NanoVDB level set.

    Distances at active voxels are those of ``Surface.closest_point``, rounded to float32; elsewhere the value is
    ``+background`` outside and ``-background`` inside, background being ``half_width * voxel_size``. Signs come from
    the winding number; for closed, oriented meshes it is asked once for each region that the surface separates and
    spread from there, for others at every active voxel. Tested against brute force in tests/unit/test_from_mesh.py.

    Voxel centres lie at whole multiples of ``voxel_size``; the transform has a translation (of whole voxels) only
    where indices would otherwise exceed 2^20.

    Args:
        mesh: Triangles, or a Surface of them, whose tree is then used (and its device).
        voxel_size: Edge length of a voxel [world].
        half_width: Width of the band on each side of the surface [voxels], at least 1.
        name: Name of the grid; the mesh's name where None.
        device: Where to compute: "cpu", "cuda:0", a warp device, or None for the first GPU, else the CPU.
    Returns:
        SparseVolume of type "float" and class "level set".
    Raises:
        InputError: voxel_size or half_width out of range, the mesh without faces, or voxels too small to be counted.
        DeviceMemoryError: The band needs more memory than there is; the message says which voxel size would fit.
    Source:
        Museth, "VDB: High-Resolution Sparse Volumes with Dynamic Topology" (2013), for the structure. Differs:
        distances are exact at every active voxel.
    """
    from geokit.mesh.surface import Surface

    voxel_size = _arrays.require_finite_scalar(voxel_size, "voxel_size", low=0.0)
    half_width = _arrays.require_finite_scalar(half_width, "half_width")
    if half_width < 1.0:
        raise InputError(f"half_width: {half_width} voxels cannot hold a sign change on each side; use at least 1")
    surface = mesh if isinstance(mesh, Surface) else Surface(mesh, device=device)
    band = _Band(surface, voxel_size, half_width)
    grid = allocate_float_grid(
        8 * band.tiles(),
        background=band.background,
        transform=band.transform,
        name=surface.mesh.name if name is None else name,
        grid_class="level set",
        signed_fill=True,
    )
    band.fill(grid)
    buffer = finish(grid)
    return SparseVolume(buffer, info_of(buffer, {}))


class _Band:
    """One run of :func:`from_mesh`: its surface, its voxels, and the arguments that its kernels share."""

    def __init__(self, surface: Surface, voxel_size: float, half_width: float) -> None:
        import warp as wp

        self.surface = surface
        self.device = surface._device
        self.voxel_size = voxel_size
        self.half_width = half_width
        self.background = float(np.float32(half_width * voxel_size))
        self.bounds = surface.bounds
        self.translation = _translation(surface.bounds, voxel_size)
        self.transform = np.diag([voxel_size, voxel_size, voxel_size, 1.0])
        self.transform[:3, 3] = self.translation
        self._grid = [wp.vec3d(*self.translation.tolist()), wp.float64(voxel_size)]

    def tiles(self) -> NDArray[np.int32]:
        """Coordinates of the 8^3 tiles that may hold a voxel of the band, shape (T, 3), in units of tiles."""
        import warp as wp

        from geokit.volume._from_mesh_kernels import count_tiles_kernel, fill_tiles_kernel

        lowest, size = self._tile_range()
        faces = len(self.surface.mesh.faces)
        shared = [self.surface._vertices, self.surface._faces, *self._grid, wp.float64(self.half_width)]
        count = wp.empty(faces, dtype=wp.int64, device=self.device)
        _launch.launch(count_tiles_kernel, faces, shared, [count], self.device)
        offsets = wp.empty(faces, dtype=wp.int64, device=self.device)
        wp.utils.array_scan(count, offsets, inclusive=False)
        total = int(offsets[-1:].numpy()[0] + count[-1:].numpy()[0])
        # Two arrays of keys and two of payload, twice as long as the pairs.
        self._require_memory(32 * total)
        keys = wp.empty(2 * total, dtype=wp.int64, device=self.device)
        box = [wp.vec3i(*lowest.tolist()), wp.vec3i(*size.tolist())]
        _launch.launch(fill_tiles_kernel, faces, [*shared, *box, offsets], [keys], self.device)
        payload = wp.empty(2 * total, dtype=wp.int32, device=self.device)
        bits = max(1, math.ceil(math.log2(float(np.prod(size.astype(np.float64))) + 1.0)))
        wp.utils.radix_sort_pairs(keys, payload, total, end_bit=min(64, bits))
        ordered = keys.numpy()[:total]
        unique = ordered[np.concatenate([[True], ordered[1:] != ordered[:-1]])] if total else ordered
        self._require_memory(len(unique) * (LEAF_BYTES + WORKING_BYTES))
        plane, z = np.divmod(unique, int(size[2]))
        x, y = np.divmod(plane, int(size[1]))
        return (np.stack([x, y, z], axis=1) + lowest).astype(np.int32)

    def fill(self, grid: Any) -> None:
        """Distances, signs and active voxels of all leaves, written into the grid's own buffer."""
        import warp as wp

        from geokit.volume._from_mesh_kernels import apply_sign_kernel, band_distance_kernel

        count = len(grid.leaf_origins)
        if count == 0:
            return
        leaves = wp.array(grid.leaf_origins, dtype=wp.vec3i, device=self.device)
        distance = wp.empty((count, 512), dtype=wp.float32, device=self.device)
        surface = [self.surface._tree, wp.float64(self.background)]
        _launch.launch(band_distance_kernel, 64 * count, [leaves, *self._grid, *surface], [distance], self.device)
        signs = self._signs(grid.leaf_origins, leaves, distance)
        unsigned = distance.numpy()
        active = unsigned < np.float32(self.background)
        grid.masks[:] = np.packbits(active, axis=1, bitorder="little")
        _launch.launch(apply_sign_kernel, count, [signs], [distance], self.device, grain=16)
        grid.values[:] = distance.numpy()

    def _signs(self, origins: NDArray[np.int32], leaves: "wp.array", distance: "wp.array") -> "wp.array":
        import warp as wp

        from geokit.volume._from_mesh_kernels import decide_kernel, flood_kernel, pull_kernel, seed_kernel

        count, device = len(origins), self.device
        signs = wp.zeros((count, 512), dtype=wp.int8, device=device)
        unknown = wp.empty(count, dtype=wp.int32, device=device)
        neighbors = wp.array(_face_neighbors(origins), dtype=wp.int32, device=device)
        spacing = float(np.float32(self.voxel_size * FLOOD_MARGIN))
        winding = self.surface._winding_arguments()
        where = [leaves, *self._grid, *winding]

        def decide(chosen: NDArray[np.bool_]) -> None:
            listed = wp.array(np.flatnonzero(chosen), dtype=wp.int64, device=device)
            _launch.launch(decide_kernel, len(listed), [listed, *where], [signs], device)

        def flood() -> None:
            before = wp.clone(signs)
            _launch.launch(pull_kernel, count, [neighbors, distance, spacing, before], [signs], device, grain=16)
            _launch.launch(flood_kernel, count, [distance, spacing], [signs, unknown], device, grain=16)

        if not self.surface.is_closed:
            # The winding number of an open mesh changes sign in free space too: the band asks for each voxel.
            decide(distance.numpy() < np.float32(self.background))
        for _ in range(FLOOD_ROUNDS):
            _launch.launch(seed_kernel, count, [*where, distance], [signs], device, grain=16)
            flood()
            flood()
            if not unknown.numpy().any():
                return signs
        decide(signs.numpy() == 0)
        return signs

    def _tile_range(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Lowest tile and number of tiles along each axis of the box around the band."""
        lowest, size = self._tile_box(self.voxel_size)
        tests, area = self._measure(self.voxel_size)
        if not _is_countable(size, tests):
            enough = self.voxel_size
            while not _is_countable(size, tests):
                enough = max(2.0 * enough, float((self.bounds[1] - self.bounds[0]).max()) / (8.0 * TILES_PER_AXIS))
                size = self._tile_box(enough)[1]
                tests, area = self._measure(enough)
            enough *= math.sqrt(max(1.0, _least_bytes(area) / max(self._free_memory(), 1)))
            across = float(np.max(self.bounds[1] - self.bounds[0])) / self.voxel_size
            raise DeviceMemoryError(
                f"voxel_size: {self.voxel_size:g} makes the mesh {across:.3g} voxels across, more than can be "
                f"counted; use at least {1.05 * enough:.2g}"
            )
        self._require_memory(_least_bytes(area))
        return lowest.astype(np.int32), size.astype(np.int32)

    def _tile_box(self, voxel_size: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        with np.errstate(over="ignore", invalid="ignore"):
            index = (self.bounds - self.translation) / voxel_size
            lowest = np.floor((index[0] - self.half_width) / 8.0)
            return lowest, np.floor((index[1] + self.half_width) / 8.0) - lowest + 1.0

    def _measure(self, voxel_size: float) -> tuple[float, float]:
        """Tiles to be tested and the surface's area [voxels^2], each summed over the triangles."""
        import warp as wp

        from geokit.volume._from_mesh_kernels import measure_kernel

        count = len(self.surface.mesh.faces)
        tiles = wp.empty(count, dtype=wp.float64, device=self.device)
        area = wp.empty(count, dtype=wp.float64, device=self.device)
        triangles = [self.surface._vertices, self.surface._faces]
        inputs = [*triangles, self._grid[0], wp.float64(voxel_size), wp.float64(self.half_width)]
        _launch.launch(measure_kernel, count, inputs, [tiles, area], self.device)
        # Indices beyond 1e308 are infinite, and their differences NaN: too many in either case.
        test_count, voxel_area = (float(np.nan_to_num(wp.utils.array_sum(each), nan=np.inf)) for each in (tiles, area))
        return test_count, voxel_area

    def _free_memory(self) -> int:
        # Host copies of distances and signs stand beside the device's: what the device holds the host must hold too.
        return min(_memory.available(self.device), _memory.available_host())

    def _require_memory(self, need: int) -> None:
        have = self._free_memory()
        if need > have:
            # Tiles cover a surface: their number goes with the square of the resolution.
            enough = self.voxel_size * math.sqrt(need / max(have, 1)) * 1.05
            raise DeviceMemoryError(
                f"voxel_size: {self.voxel_size:g} needs about {need >> 20} MiB of the {have >> 20} MiB free on "
                f"{self.device.alias}; use {enough:.2g} or more, or a smaller half_width"
            )


def _least_bytes(area: float) -> int:
    """Lower bound of a band's memory: a surface meets a tile for each 8 x 8 voxels; duplicates may count four times."""
    return int(area / 256.0) * LEAF_BYTES


def _is_countable(size: NDArray[np.float64], tests: float) -> bool:
    return bool(size.max() < TILES_PER_AXIS) and tests <= MOST_TILE_TESTS


def _translation(bounds: NDArray[np.float64], voxel_size: float) -> NDArray[np.float64]:
    """Position of index 0: the origin, or the multiple of eight voxels nearest to a mesh that is far from it."""
    if float(np.abs(bounds).max()) / voxel_size < LARGEST_CENTERED_INDEX:
        return np.zeros(3)
    tile = 8.0 * voxel_size
    return np.asarray(np.round(bounds.mean(axis=0) / tile) * tile)


def _face_neighbors(origins: NDArray[np.int32]) -> NDArray[np.int32]:
    """Rows of the leaves beyond the faces -x, +x, -y, +y, -z, +z of each leaf, -1 for none; shape (L, 6)."""
    tiles = origins.astype(np.int64) >> 3
    low = tiles.min(axis=0) - 1
    size = tiles.max(axis=0) - low + 2

    def key_of(tile: NDArray[np.int64]) -> NDArray[np.int64]:
        shifted = tile - low
        return (shifted[:, 0] * size[1] + shifted[:, 1]) * size[2] + shifted[:, 2]

    keys = key_of(tiles)
    order = np.argsort(keys)
    ordered = keys[order]
    steps: Sequence[int] = (-int(size[1] * size[2]), int(size[1] * size[2]), -int(size[2]), int(size[2]), -1, 1)
    neighbors = np.empty((len(tiles), 6), np.int32)
    for side, step in enumerate(steps):
        wanted = keys + step
        at = np.minimum(np.searchsorted(ordered, wanted), len(ordered) - 1)
        neighbors[:, side] = np.where(ordered[at] == wanted, order[at], -1)
    return neighbors
