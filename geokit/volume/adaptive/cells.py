"""Cells of a lattice as arrays: their keys, the cells near a surface, and the errors of their interpolants."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.volume.band.place_keys import KEY_BITS, keys_of, places_of
from geokit.volume.tolerance.interpolation_errors import STENCILS

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh
    from geokit.mesh.surfaces.surface import Surface

# Offsets of a cell's voxels, z fastest.
CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)
# Half the diagonal of a unit cell, with a margin for rounding.
HALF_DIAGONAL = 0.5 * np.sqrt(3.0) * (1.0 + 1e-9)
# Most cells at the start of the search for cells near the surface; testing so few is cheap.
START_CELLS = 4096
# Cells that are examined at a time: some hundred megabytes.
CELLS_AT_A_TIME = 1 << 18
# Bound of a cell's error, as a share of s times the voxel size, where s is the change of the gradient across the cell.
# The worst case, a crease through the middle of a cell, gives a quarter, and a corner of three faces little more. Cells
# whose bound is below the limit are not examined further.
SPREAD_SHARE = 0.35
# Points tested on an edge of the mesh, per edge length of a cell.
CREASE_POINTS = 8
# Points of edges that are tested at a time.
POINTS_AT_A_TIME = 1 << 20
# Cells whose error exceeds this share of the limit are sampled most densely, because between the first sample points
# the error is up to half as large again.
CLOSEST_LOOK = 0.6
# Points of edges this near to a cell border [cells] count for both cells. An edge may cut off less of a cell than the
# spacing of its points, and an error on a border belongs to both sides.
BORDER = 0.5 / CREASE_POINTS
# Depths at which creases of the distance are tested, as shares of ``within``.
CREASE_DEPTHS = (0.0, 0.25, 0.5, 0.75, 1.0)
# Lower limit of the squared length of the sum of two normals, reached by faces two degrees apart. Sharper edges
# (blades) are treated as this sharp.
BLADE = 1e-3


class _Creases(NamedTuple):
    """Unique edges of a mesh.

    Attributes:
        corners: The vertices on them [world], shape (N, 3).
        ends: End points [world], shape (E, 2, 3).
        sharpness: Length of the difference of the two faces' normals, 0 to 2, shape (E,); 2 for edges without exactly
            two faces.
        between: Vector along which the distance to both faces grows by 1, on the side where the nearer of the two
            faces changes, shape (E, 3); 0 for edges without exactly two faces.
    """

    corners: NDArray[np.float64]
    ends: NDArray[np.float64]
    sharpness: NDArray[np.float64]
    between: NDArray[np.float64]


@dataclass(frozen=True)
class CellLattice:
    """Cells of one size. Cell (i, j, k) is the cube of edge ``size`` with lowest corner ``origin + size * (i, j, k)``.

    Attributes:
        surface: Surface of the distances.
        sign: Sign method, as ``Surface.signed_distance`` takes it.
        origin: Position of index 0 [world], shape (3,).
        size: Edge length of a cell [world].
        within: Distance [world] from the surface up to which errors count.
    """

    surface: Surface
    sign: str
    origin: NDArray[np.float64]
    size: float
    within: float

    def positions(self, index: NDArray[Any]) -> NDArray[np.float64]:
        """World positions of index coordinates (N, 3)."""
        return np.asarray(self.origin + self.size * index)

    def distances(self, index: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Exact signed distances (N,) and closest points (N, 3) [world] of index coordinates (N, 3)."""
        found: Any = self.surface.signed_distance(self.positions(index), sign=self.sign)
        return found.distance, found.points


def spread_keys(keys: NDArray[np.int64], offsets: NDArray[np.int64]) -> NDArray[np.int64]:
    """Unique keys of all cells that lie at ``offsets`` along each axis from cells of the given keys.

    One axis after the other: neighbors share most of what they reach, so the keys to sort stay few.
    """
    for bits in (0, KEY_BITS, 2 * KEY_BITS):
        keys = np.unique((keys[:, None] + (offsets << bits)).reshape(-1))
    return keys


def contains(keys: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether each wanted key is among the sorted ``keys``."""
    if not len(keys):
        return np.zeros(len(wanted), bool)
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.asarray(keys[place] == wanted)


def near_cells(lattice: CellLattice) -> NDArray[np.int64]:
    """All cells that may hold a point of the zone around the surface, and few others."""
    bounds = lattice.surface.bounds
    low = np.floor((bounds[0] - lattice.within - lattice.origin) / lattice.size).astype(np.int64) - 1
    high = np.floor((bounds[1] + lattice.within - lattice.origin) / lattice.size).astype(np.int64) + 1
    span = 1
    while np.prod((high // span - low // span + 1).astype(np.float64)) > START_CELLS:
        span *= 2
    axes = [np.arange(a // span, b // span + 1) for a, b in zip(low, high, strict=True)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    while True:
        cells = cells[near(lattice, cells, span)]
        if span == 1:
            return cells
        span //= 2
        cells = (2 * cells[:, None] + CORNERS).reshape(-1, 3)


def near(lattice: CellLattice, cells: NDArray[np.int64], span: int = 1) -> NDArray[np.bool_]:
    """Whether each cell, of ``span`` times the lattice's size, may hold a point of the zone."""
    if not len(cells):
        return np.zeros(0, bool)
    reach = lattice.within + HALF_DIAGONAL * span * lattice.size
    found = lattice.surface.closest_point(lattice.positions((cells + 0.5) * span), max_distance=reach)
    return np.asarray(found.triangle_id >= 0)


def examine(lattice: CellLattice, cells: NDArray[np.int64], limit: float, order: int = 1) -> NDArray[np.float64]:
    """Largest error [world] of the interpolant found in the part of each cell that lies in the zone.

    Args:
        lattice: Lattice of the cells.
        cells: Cells near the surface, shape (N, 3).
        limit: Cells whose error may exceed it are sampled more densely.
        order: Order of interpolation, 1, 2 or 3.
    """
    step = CELLS_AT_A_TIME if order == 1 else CELLS_AT_A_TIME // 4
    errors = [_examine(lattice, cells[start : start + step], limit, order) for start in range(0, len(cells), step)]
    return np.concatenate(errors) if errors else np.zeros(0)


class _Stencils(NamedTuple):
    """The voxels that the interpolants of cells read.

    Attributes:
        order: Order of interpolation.
        values: Exact distances of all voxels, float64, on the surface's device.
        rows: The first voxel of each row along z of each cell's stencil, as a row of ``values``, (N, width^2) int32.
            The others of a row follow it.
    """

    order: int
    values: "wp.array"
    rows: NDArray[np.int32]

    def rows_on(self, device: "wp.Device", chosen: NDArray[np.int64] | None = None) -> "wp.array":
        """The rows of all cells, or of some, on a device."""
        return wp.array(self.rows if chosen is None else self.rows[chosen], dtype=wp.int32, device=device)


def _examine(lattice: CellLattice, cells: NDArray[np.int64], limit: float, order: int) -> NDArray[np.float64]:
    from geokit.volume.adaptive.check_kernels import examine_kernel

    device = lattice.surface._device
    first, width = STENCILS[order]
    keys = keys_of(cells)
    voxels = spread_keys(keys, np.arange(first, first + width))
    # Keys of voxels along z follow each other, so only the first of each row is looked up.
    across = np.stack(np.meshgrid(*[np.arange(first, first + width)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    begin = (across[:, 0] << (2 * KEY_BITS)) + (across[:, 1] << KEY_BITS) + first
    exact = lattice.distances(places_of(voxels))
    values, closest = _on(device, *exact)
    rows = np.searchsorted(voxels, keys[:, None] + begin).astype(np.int32)
    stencils = _Stencils(order, values, rows)
    middle = _on(device, *lattice.distances(cells + 0.5))
    place = [wp.vec3d(*lattice.origin.tolist()), wp.float64(lattice.size), wp.float64(lattice.within)]
    error, spread = (wp.empty(len(cells), dtype=wp.float64, device=device) for _ in range(2))
    all_rows = stencils.rows_on(device)
    where = [_cells_on(device, cells), all_rows, order]
    launcher.launch(examine_kernel, len(cells), [*where, values, closest, *middle, *place], [error, spread], device)
    errors = np.maximum(error.numpy(), _crease_errors(lattice, cells, [all_rows, order, values], limit))
    suspect = (errors <= limit) & (SPREAD_SHARE * lattice.size * spread.numpy() > limit)
    for width, share in ((3, 0.0), (5, CLOSEST_LOOK)):
        chosen = np.flatnonzero(suspect & (errors > share * limit) & (errors <= limit))
        errors[chosen] = np.maximum(errors[chosen], _inspect(lattice, cells[chosen], stencils, chosen, width))
    return np.asarray(errors)


def _inspect(
    lattice: CellLattice, cells: NDArray[np.int64], stencils: _Stencils, chosen: NDArray[np.int64], width: int
) -> NDArray[np.float64]:
    """Largest error of each cell on the segments from ``width ** 3`` points in it to their closest points.

    Args:
        lattice: Lattice of the cells.
        cells: Cells, shape (N, 3).
        stencils: Voxels of these cells and of others.
        chosen: Row of each cell among those of ``stencils``.
        width: Points along each axis.
    """
    from geokit.volume.adaptive.check_kernels import inspect_kernel

    device = lattice.surface._device
    place = [wp.vec3d(*lattice.origin.tolist()), wp.float64(lattice.size), wp.float64(lattice.within)]
    inner = (np.stack(np.meshgrid(*[np.arange(width)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5) / width
    errors = np.zeros(len(cells))
    step = max(1, 8 * CELLS_AT_A_TIME // len(inner))
    for start in range(0, len(cells), step):
        some = slice(start, start + step)
        index = (cells[some][:, None] + inner).reshape(-1, 3)
        asked = _on(device, *lattice.distances(index))
        rows = [_cells_on(device, cells[some]), stencils.rows_on(device, chosen[some])]
        where = _points_on(device, lattice.positions(index))
        worst = wp.empty(len(cells[some]), dtype=wp.float64, device=device)
        inputs = [*rows, stencils.order, stencils.values, len(inner), where, *asked, *place]
        launcher.launch(inspect_kernel, len(worst), inputs, [worst], device)
        errors[some] = worst.numpy()
    return errors


def _crease_errors(
    lattice: CellLattice, cells: NDArray[np.int64], stencils: list[Any], limit: float
) -> NDArray[np.float64]:
    """Largest error of each cell on creases of the distance: on edges of the mesh and on their bisecting planes.

    On an edge the distance is 0. The crease that leaves it, halfway between its faces, lies inside at convex edges and
    outside at concave ones. A point up to BORDER beyond a cell's border counts for that cell too.
    """
    from geokit.volume.adaptive.check_kernels import crease_kernel, touched_kernel

    device = lattice.surface._device
    keys = keys_of(cells)
    order = np.argsort(keys)
    lookup = [wp.array(keys[order], device=device), wp.array(order.astype(np.int32), device=device)]
    place = [wp.vec3d(*lattice.origin.tolist()), wp.float64(lattice.size), wp.float64(BORDER)]
    read = [*stencils, *place]
    reach = wp.float64(lattice.within * (1.0 + BORDER))
    # As bits, negative: see crease_kernel.
    worst = wp.zeros(len(cells), dtype=wp.int64, device=device)
    most = -int(np.float64(limit).view(np.int64))
    for points, between in _crease_points(lattice, limit, POINTS_AT_A_TIME):
        for depth in CREASE_DEPTHS if between.any() else CREASE_DEPTHS[:1]:
            asked = points + between * (depth * lattice.within)
            exact, open_from = np.zeros(len(asked)), np.iinfo(np.int64).min
            if depth > 0.0:
                touched, open_from = wp.empty(len(asked), dtype=wp.uint8, device=device), most
                inputs = [_points_on(device, asked), *lookup, worst, most, *place]
                launcher.launch(touched_kernel, len(asked), inputs, [touched], device)
                asked = asked[touched.numpy() != 0]
                exact = np.asarray(lattice.surface.signed_distance(asked, sign=lattice.sign).distance)
            # What is open is decided before, so that no answer depends on which thread comes first.
            inputs = [*_on(device, exact, asked)[::-1], *lookup, wp.clone(worst), open_from, *read, reach]
            launcher.launch(crease_kernel, len(asked), inputs, [worst], device)
    return np.asarray((-worst.numpy()).view(np.float64))


def _crease_points(
    lattice: CellLattice, limit: float, at_a_time: int
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """All vertices of the mesh, and points on its edges that are sharp enough to exceed the limit in such cells.

    Each point comes with ``_Creases.between`` of its edge; vertices with 0.
    """
    mesh = lattice.surface.mesh
    creases: _Creases = mesh._cache.find("creases", lambda: _find_creases(mesh))
    yield creases.corners, np.zeros_like(creases.corners)
    sharp = SPREAD_SHARE * lattice.size * creases.sharpness > limit
    ends, between = creases.ends[sharp], creases.between[sharp]
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    counts = np.ceil(lengths / lattice.size * CREASE_POINTS).astype(np.int64) + 1
    last = np.cumsum(counts)
    start = 0
    while start < len(counts):
        # At least one edge, however many points it has.
        stop = max(start + 1, int(np.searchsorted(last, last[start] - counts[start] + at_a_time, side="right")))
        count = counts[start:stop]
        step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        t = (step / np.repeat(np.maximum(count - 1, 1), count))[:, None]
        a, b, way = (np.repeat(part[start:stop], count, axis=0) for part in (ends[:, 0], ends[:, 1], between))
        yield a * (1.0 - t) + b * t, way
        start = stop


def _find_creases(mesh: TriangleMesh) -> _Creases:
    pairs = np.sort(np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    names, inverse, count = np.unique(pairs @ [len(mesh.vertices), 1], return_inverse=True, return_counts=True)
    edges = np.stack(np.divmod(names, len(mesh.vertices)), axis=1)
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    order = np.argsort(inverse.reshape(-1), kind="stable") // 3
    begin = np.cumsum(count) - count
    first, second = order[begin], order[np.minimum(begin + 1, len(order) - 1)]
    single = count != 2
    sharpness = np.where(single, 2.0, np.linalg.norm(normals[first] - normals[second], axis=1))
    both = normals[first] + normals[second]
    middle = corners.mean(axis=1)
    convex = np.einsum("ek,ek->e", middle[second] - middle[first], normals[first]) < 0.0
    length_squared = np.einsum("ek,ek->e", both, both)
    # At a blade this vector is long and leaves the cell in any case.
    between = np.where(convex, -2.0, 2.0)[:, None] * both / np.maximum(length_squared, BLADE)[:, None]
    between[single] = 0.0
    return _Creases(mesh.vertices[np.unique(edges)], mesh.vertices[edges], sharpness, between)


def _on(device: "wp.Device", distance: NDArray[np.float64], points: NDArray[np.float64]) -> list["wp.array"]:
    return [wp.array(distance, dtype=wp.float64, device=device), _points_on(device, points)]


def _points_on(device: "wp.Device", points: NDArray[np.float64]) -> "wp.array":
    return wp.array(np.ascontiguousarray(points), dtype=wp.vec3d, device=device)


def _cells_on(device: "wp.Device", cells: NDArray[np.int64]) -> "wp.array":
    return wp.array(np.ascontiguousarray(cells, np.int32), dtype=wp.vec3i, device=device)
