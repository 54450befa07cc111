"""Signs of a band's voxels: a few are tested against the surface, the others follow from their distances.

Walls so thin that no voxel center lies inside them have no negative voxel: the band has lost them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory.device_arena import Scratch
from geokit.core.scan import prefix_sum
from geokit.volume.band.tiles import Lattice

if TYPE_CHECKING:
    from geokit.volume.band.band import Band

# The distances of two neighbors on either side of a wall perpendicular to their link add up to exactly one voxel.
# Rounded to float32 they may add up to a little more, and a flood must not pass there.
FLOOD_MARGIN = 1.00001
# Rounds over the diagonal neighbors of voxels without a link along an axis. They decide a third of the rest. A GPU
# does none: its threads would wait for the leaf with the most such voxels, and testing each voxel is faster.
ROUNDS_CPU, ROUNDS_CUDA = 2, 0
# Rows of eight voxels per thread; on a GPU one row per thread is more than twice as fast.
ROWS_CPU, ROWS_CUDA = 8, 1
# Leaves whose nearest triangles are looked up at a time, so that memory does not grow with the band.
LEAVES_AT_A_TIME = 1024


def inside_bits(
    lattice: Lattice,
    tiles: "wp.array",
    rows: "wp.array",
    distance: "wp.array",
    method: str,
    beyond: NDArray[np.bool_] | None,
) -> "wp.array":
    """Bit masks (L, 8) of the voxels that lie inside.

    For a closed surface, one voxel is tested for each region of a leaf that the surface separates, and each voxel that
    is too near to the surface to belong to a region. For an open surface the sign also changes in free space, so every
    voxel is tested.

    Args:
        lattice: The voxels.
        tiles: Coordinates of all tiles, (T,) of vec3i.
        rows: Tile of each leaf, (L,).
        distance: Unsigned distances of the tiles' voxels (T, 512), cut off at the lattice's reach.
        method: Sign method, as ``Surface.contains`` takes it.
        beyond: For an open surface, the leaves that lie outside whatever the test says, (L,).
    Source:
        Flooding: OpenVDB's meshToVolume. Differs: links between voxels come from exact distances, as bits.
    """
    from geokit.volume.band import signs_kernels as kernels

    count, device = len(rows), lattice.device
    spacing = float(np.float32(lattice.voxel_size * FLOOD_MARGIN))
    known = wp.zeros((count, 8), dtype=wp.uint64, device=device)
    inside = wp.zeros((count, 8), dtype=wp.uint64, device=device)
    tests = _SurfaceSigns(lattice, [tiles, rows, *lattice.arguments], distance, method)
    if beyond is not None:
        if beyond.any():
            known.assign(np.where(beyond, ~np.uint64(0), np.uint64(0))[:, None].repeat(8, axis=1))
        tests.others(known, inside)
        return inside
    regions = kernels.REGIONS * count
    links, seeds = Scratch(device, ((count, 24), wp.uint64), ((regions,), wp.int32)).arrays
    launcher.launch(kernels.links_kernel, 8 * count, [rows, distance, spacing], [links], device)
    inputs = [rows, distance, links, known, kernels.LEAST_SHARE * spacing, float(np.float32(lattice.reach))]
    launcher.launch(kernels.regions_kernel, count, inputs, [seeds], device, grain=64)
    rounds = ROUNDS_CPU if device.is_cpu else ROUNDS_CUDA
    inputs = [rows, distance, links, seeds, tests.regions(seeds), spacing, rounds]
    launcher.launch(kernels.spread_kernel, count, inputs, [known, inside], device, grain=64)
    tests.others(known, inside)
    return inside


@dataclass(frozen=True)
class _SurfaceSigns:
    """Inside tests against the surface; ``where`` are tiles, rows, translation and voxel size as kernels take them."""

    lattice: Lattice
    where: list[Any]
    distance: "wp.array"
    method: str

    def regions(self, seeds: Any) -> "wp.array":
        """Whether the voxel of each region lies inside; undefined for regions without a voxel."""
        from geokit.volume.band import inside_kernels, signs_kernels

        device, regions = self.lattice.device, signs_kernels.REGIONS
        answers = wp.zeros(len(seeds), dtype=wp.bool, device=device)
        if self._by_list:
            bits, inside = (wp.zeros((len(seeds) // regions, 8), dtype=wp.uint64, device=device) for _ in range(2))
            launcher.launch(signs_kernels.seed_bits_kernel, len(bits), [regions, seeds], [bits], device)
            self.listed(bits, bits, inside)
            inputs = [regions, seeds, inside]
            launcher.launch(signs_kernels.seed_answers_kernel, len(seeds), inputs, [answers], device)
        elif self.method == "pseudonormal":
            inputs = [regions, self._voxels, seeds, *self._pseudonormals]
            launcher.launch(inside_kernels.regions_by_pseudonormal_kernel, len(seeds), inputs, [answers], device)
        else:
            inputs = [regions, self._voxels, seeds, *self.lattice.surface._winding_arguments()]
            launcher.launch(inside_kernels.regions_by_winding_kernel, len(seeds), inputs, [answers], device)
        return answers

    def others(self, known: "wp.array", inside: "wp.array") -> None:
        """Test the voxels that are not known, and set the bits of those inside."""
        from geokit.volume.band import inside_kernels, signs_kernels

        device, count = self.lattice.device, len(known)
        # Far from an open surface the nearest triangle may be out of reach of the kernel's search.
        if self._by_list or (self.method == "pseudonormal" and not self.lattice.surface.is_closed):
            left = wp.empty_like(known)
            launcher.launch(signs_kernels.invert_bits_kernel, count, [known], [left], device)
            self.listed(left, known, inside)
            return
        span = ROWS_CPU if device.is_cpu else ROWS_CUDA
        if self.method == "pseudonormal":
            inputs = [span, known, self._voxels, *self._pseudonormals]
            kernel = inside_kernels.voxels_by_pseudonormal_kernel
        else:
            inputs = [span, known, self._voxels, *self.lattice.surface._winding_arguments()]
            kernel = inside_kernels.voxels_by_winding_kernel
        launcher.launch(kernel, 64 * count // span, inputs, [inside], device)

    def listed(self, bits: "wp.array", known: "wp.array", inside: "wp.array") -> None:
        """Test the voxels whose ``bits`` are set, as one list in one call, and mark them as known."""
        from geokit.volume.band.signs_kernels import take_answers_kernel

        counted, points = _positions(bits, self.where)
        if len(points):
            inputs = [*counted, self.lattice.surface.contains(points, sign=self.method)]
            launcher.launch(take_answers_kernel, len(bits), inputs, [known, inside], bits.device)

    @property
    def _by_list(self) -> bool:
        # Kernels take voxels on any face as outside, also on faces that were left out.
        return self.method == "parity" or self.lattice.surface._is_trimmed

    @property
    def _voxels(self) -> Any:
        from geokit.volume.band.inside_kernels import BandVoxels

        voxels = BandVoxels()
        voxels.tiles, voxels.rows, voxels.translation, voxels.voxel_size = self.where
        voxels.distance, voxels.reach = self.distance, wp.float64(self.lattice.reach)
        return voxels

    @property
    def _pseudonormals(self) -> list[Any]:
        signs = self.lattice.surface._signs
        return [signs._tree, signs._pseudonormals]


def lost_components(band: Band, pieces: NDArray[np.int32], piece_count: int) -> list[int]:
    """Connected components of a mesh without a face that is the nearest to some negative voxel.

    Args:
        band: The band.
        pieces: Connected component of each face, (F,), numbered from 0 in the order of their first faces; those that
            no face has are not lost.
        piece_count: Number of connected components.
    """
    from geokit.volume.band import signs_kernels as kernels

    device, count = band.lattice.device, len(band.leaves.keys)
    if piece_count == 1:
        return [] if band.has_negative.numpy()[0] else [0]
    found = np.ones(piece_count, np.bool_)
    found[pieces] = False
    both = wp.empty((count, 8), dtype=wp.uint64, device=device)
    launcher.launch(kernels.common_bits_kernel, count, [band.active, band.negative], [both], device)
    # If the band ends one voxel inside, a component's only negative voxels may lie beyond the band's end.
    for bits in (both, band.negative):
        _mark_nearest(band, bits, pieces, found)
        if found.all():
            return []
    return [int(piece) for piece in np.flatnonzero(~found)]


def _positions(bits: "wp.array", where: list[Any]) -> tuple[list["wp.array"], "wp.array"]:
    """Bits, ends and counts as kernels take them, and the positions of the voxels whose bits are set."""
    from geokit.volume.band import signs_kernels as kernels

    counts = wp.empty(len(bits), dtype=wp.int32, device=bits.device)
    launcher.launch(kernels.count_bits_kernel, len(bits), [bits], [counts], bits.device)
    ends, total = prefix_sum(counts)
    points = wp.empty(total, dtype=wp.vec3d, device=bits.device)
    if total:
        inputs = [bits, ends, counts, *where]
        launcher.launch(kernels.bit_positions_kernel, len(bits), inputs, [points], bits.device)
    return [bits, ends, counts], points


def _mark_nearest(band: Band, bits: "wp.array", pieces: NDArray[np.int32], found: NDArray[np.bool_]) -> None:
    """Set ``found`` for the components that are nearest to a voxel whose bit is set."""
    for start in range(0, len(bits), LEAVES_AT_A_TIME):
        part = slice(start, min(len(bits), start + LEAVES_AT_A_TIME))
        _, points = _positions(bits[part], [band.leaves.tiles, band.leaves.rows[part], *band.lattice.arguments])
        if len(points) == 0:
            continue
        nearest = band.lattice.surface.closest_point(points)
        found[np.unique(pieces[nearest.triangle_id.numpy()])] = True
        if found.all():
            return
