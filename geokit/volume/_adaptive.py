"""Distance fields of meshes with voxels only as small as the tolerance requires."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher, user_arrays
from geokit.core.pinned import host_flags
from geokit.errors import FileFormatError, InputError
from geokit.volume._io import load_all, save
from geokit.volume._model import SparseVolume
from geokit.volume.adaptive.build import build_band_level, build_finer_level
from geokit.volume.adaptive.check import DRAWN_POINTS, check_points
from geokit.volume.adaptive.level_sizes import choose
from geokit.volume.adaptive.refine import Refinement
from geokit.volume.adaptive.table import AdaptiveTable, adaptive_table, shifts_of
from geokit.volume.band.fields import hash_of, resolve_surface
from geokit.volume.nanovdb.provenance import VOXEL_SIZE, provenance, with_more
from geokit.volume.sampling.space import world_to_index
from geokit.volume.tolerance.zone import checked_within

if TYPE_CHECKING:
    from geokit.mesh._model import TriangleMesh
    from geokit.mesh._surface import Surface

__all__ = ["LEVEL", "LEVEL_COUNT", "AdaptiveSDF", "adaptive_from_mesh", "load_adaptive"]

LEVEL = "geokit:level"
LEVEL_COUNT = "geokit:level_count"
# Share of the tolerance up to which a cell is accepted. Between the checked places the error is a little larger, and
# each cell that fails a later check costs another round.
ACCEPTED_SHARE = 0.97
# Rounds of checks on fresh points. Each round finds fewer failing cells than the one before, since those are refined.
MOST_ROUNDS = 12
# Random points of a round for each cell, up to the limit on draws.
POINTS_PER_CELL = 3
MOST_DRAWS = 12
# Points of a round whose errors exceed this share of the tolerance (at most MOST_CLIMBING of them) are moved about
# within their cells CLIMBING_MOVES times, by these shares of a cell, and the worst of them again. On the bunny at 1e-4
# of its box, which has six hundred thousand cells, one point in a million misses the tolerance, and millions of random
# points did not find them all.
CLIMBING_SHARE, MOST_CLIMBING, CLIMBING_MOVES = 0.6, 100_000, 4
CLIMBING_RADII = (0.3, 0.15, 0.07)
SEED = 20
# Fewest groups of queries that are worth a thread of their own.
GRAIN = 16


@dataclass(frozen=True, eq=False)
class AdaptiveSDF:
    """A distance field in levels of grids, where each level has half the voxel size of the one before.

    A cell (the box between eight voxels) is answered by the next finer level where all 27 voxels of its eight halves
    are active in that level, else by its own level. So the finest level that has a point's cell answers the point, and
    the field is everywhere the trilinear interpolant of eight exact distances. Between cells of different levels it
    jumps by no more than their errors.

    Args:
        levels: Float grids, the coarsest first. Level 0 is a level set around the whole surface.
    Raises:
        InputError: There are no levels, they are not float grids, or the voxels of a level are not half the size of
            those of the level before.
    """

    levels: tuple[SparseVolume, ...]
    _tables: dict[str, AdaptiveTable] = field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not self.levels:
            raise InputError("levels: none given; give at least one grid")
        for number, level in enumerate(self.levels):
            if not isinstance(level, SparseVolume):
                raise InputError(f"levels[{number}]: {type(level).__name__} is not a SparseVolume; give float grids")
            if level.info.grid_type != "float":
                raise InputError(f"levels[{number}]: a grid of type {level.info.grid_type}; give float grids")
        shifts_of(self.levels)

    @property
    def level_count(self) -> int:
        """Number of levels."""
        return len(self.levels)

    @property
    def voxel_sizes(self) -> tuple[float, ...]:
        """Edge length of the voxels of each level [world]."""
        return tuple(float(level.info.voxel_size[0]) for level in self.levels)

    @property
    def byte_count(self) -> int:
        """Size of all grids in bytes."""
        return sum(level.info.byte_count for level in self.levels)

    @property
    def tolerance(self) -> float | None:
        """Requested error [world], or None if no tolerance was given."""
        return self.levels[0].info.tolerance

    @property
    def achieved_error(self) -> float | None:
        """Largest error [world] found at points that were not used to choose the cells, or None if unknown."""
        return self.levels[0].info.achieved_error

    @property
    def achieved_error_999(self) -> float | None:
        """The 99.9th percentile of those errors [world], or None if unknown."""
        return self.levels[0].info.achieved_error_999

    def sample(self, points: Any, *, device: Any = None) -> Any:
        """Signed distance at each point, negative inside.

        The result is within the tolerance of the exact distance up to ``within`` from the surface. Farther out it is
        the value of level 0, whose band ends at its background. All arithmetic is float64.

        Args:
            points: Query points [world], shape (N, 3).
            device: Where to compute; None for the first GPU, else the CPU.
        Returns:
            Distances (N,) [world] in the container of ``points``, float64 (float32 where the points are).
        Raises:
            InputError: points is not (N, 3) or not finite.

        Held by: tests/volume/adaptive/test_adaptive.py
        """
        return self._answer(points, device, gradient=False)

    def gradient(self, points: Any, *, device: Any = None) -> Any:
        """Gradient of the interpolant of :meth:`sample` at each point; next to the surface it is close to the normal.

        It is exact for the interpolant and jumps between cells. Outside the box of level 0 it is 0.

        Args:
            points: Query points [world], shape (N, 3).
            device: Where to compute; None for the first GPU, else the CPU.
        Returns:
            Gradients (N, 3) [world / world] in the container of ``points``, float64 (float32 where the points are).
        Raises:
            InputError: points is not (N, 3) or not finite.

        Held by: tests/volume/adaptive/test_adaptive.py
        """
        return self._answer(points, device, gradient=True)

    def save(self, path: str | os.PathLike[str], *, codec: str | None = None) -> None:
        """Write all levels into one .vdb or .nvdb file, which :func:`load_adaptive` reads.

        Args:
            path: Target file.
            codec: Compression, as in :func:`geokit.volume.save`.
        Raises:
            InputError: The extension is neither .vdb nor .nvdb, or the codec is unknown.
            MissingDependencyError: .vdb without the OpenVDB extension, or codec "blosc" without blosc.
        """
        save(path, *self.levels, codec=codec)

    def _answer(self, points: Any, device: Any, *, gradient: bool) -> Any:
        import warp as wp

        from geokit.volume.adaptive import sample_kernels as kernels

        target = launcher.resolve_device(device)
        table = self._table(target)
        batch = user_arrays.read_vectors(points, "points", target, defer=True, keep_float32=True)
        count, grouped = len(batch), target.is_cpu
        if gradient:
            choices = kernels.GRADIENT_GROUPS if grouped else kernels.GRADIENT_SINGLES
            kinds, outside = (wp.vec3f, wp.vec3d), wp.vec3d(0.0, 0.0, 0.0)
        else:
            choices = kernels.SAMPLE_GROUPS if grouped else kernels.SAMPLE_SINGLES
            kinds, outside = (wp.float32, wp.float64), wp.float64(self.levels[0].info.background)
        out = user_arrays.empty(count, kinds[0] if batch.is_float32 else kinds[1], batch.rows)
        bad = host_flags(1, target)
        inputs = [table.levels, batch.rows, *world_to_index(self.levels[0]), outside]
        items = -(-count // kernels.GROUP) if grouped else count
        launcher.launch(choices[batch.is_float32], items, inputs, [out, bad], target, grain=GRAIN if grouped else 0)
        if count and bad.numpy()[0]:
            user_arrays.require_finite(batch, "points")
        return batch.to_caller(out)

    def _table(self, device: Any) -> AdaptiveTable:
        if device.alias not in self._tables:
            self._tables[device.alias] = adaptive_table(self.levels, device)
        return self._tables[device.alias]

    def __repr__(self) -> str:
        sizes = ", ".join(f"{size:.4g}" for size in self.voxel_sizes)
        return f"AdaptiveSDF({self.levels[0].info.name!r}, voxel sizes {sizes}, {self.byte_count} bytes)"


def adaptive_from_mesh(
    mesh: TriangleMesh | Surface,
    tolerance: float,
    *,
    within: float | None = None,
    max_levels: int = 12,
    sign: str = "auto",
    name: str | None = None,
    device: Any = None,
) -> AdaptiveSDF:
    """Signed distance field of a mesh, negative inside, with voxels only as small as the tolerance requires.

    A trilinear interpolant needs small voxels next to sharp edges, while large voxels are enough on flat faces. Every
    cell that contains a point of the zone (all points no farther than ``within`` from the surface) is checked: on the
    edges and corners of the mesh, halfway between the faces of its edges, along the way to the surface from the cell's
    voxels and center, and, where gradients differ, at up to 125 more points. Cells that miss the tolerance are refined
    to voxels of half the size. Of the voxel sizes that were tried, those that take the least memory are kept. Where the
    faces of a part lie on a common lattice, its voxels do too.

    Then random points of the zone that took no part in the refinement are compared with the exact distance: 250,000 on
    faces, edges and corners, or three for each cell where that is more (at most 3 million), and others around the worst
    of them. While one of them misses the tolerance, its cell is refined and new points are drawn. ``achieved_error``
    and ``achieved_error_999`` are measured in the last round, in which no point missed. The metadata of each level
    holds both of them, the entries that :func:`from_mesh` describes, and the level's number as "geokit:level" and
    "geokit:level_count". The error is measured, not proven: a crease that cuts off next to nothing of a cell can stay
    undetected. In all property tests it stays within the tolerance at yet other points.

    Compared with the grid of a single voxel size that keeps the same tolerance, at 1e-3 of the box the bracket of
    data/samples takes a fifth of the bytes and a scanned bunny half; at 1e-4 they take a seventieth and a seventh
    (docs/design/adaptive.md). A smooth body gains nothing.

    Args:
        mesh: Triangles, or a Surface of them, whose tree (and device) is then used.
        tolerance: Largest error of the interpolated distance [world].
        within: Distance from the surface up to which the tolerance holds [world]. None for the tolerance itself, or a
            quarter of it if the mesh is open: beside an open border the sign jumps, and so does the field, by twice the
            distance.
        max_levels: Largest number of levels.
        sign: Method that tells inside from outside, as for ``Surface.signed_distance``.
        name: Name of level 0, and prefix of the names of the others; None for the mesh's name.
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        AdaptiveSDF with at least one level.
    Raises:
        InputError: An argument is out of range, the mesh has no faces, or ``max_levels`` levels cannot keep the
            tolerance; the message says which tolerance they keep.
        DeviceMemoryError: The cells or voxels do not fit into memory.
    Source:
        Frisken et al., "Adaptively Sampled Distance Fields" (2000), for the idea. Differs: levels are sparse grids,
            every voxel is exact, and errors are measured where the tolerance applies.
    Example:
        >>> corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
        >>> mesh = gk.mesh.TriangleMesh(corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> field = adaptive_from_mesh(mesh, 0.01, device="cpu")
        >>> bool(abs(field.sample([[0.25, 0.25, 0.0]], device="cpu")[0]) <= 0.01)
        True

    Held by: tests/volume/adaptive/test_adaptive_property.py
    """
    if sign == "none":
        raise InputError("sign: 'none' makes no signed field; use from_mesh for unsigned distances")
    tolerance = user_arrays.require_finite_scalar(tolerance, "tolerance", low=0.0)
    if isinstance(max_levels, bool) or not isinstance(max_levels, (int, np.integer)) or max_levels < 1:
        raise InputError(f"max_levels: {max_levels!r} is not a whole number of levels; give 1 or more")
    surface, method, _ = resolve_surface(mesh, sign, None, device)
    within = checked_within(within, tolerance, jumps=not surface.is_closed)
    name = surface.mesh.name if name is None else name
    tree = choose(surface, method, within, ACCEPTED_SHARE * tolerance, int(max_levels))
    made, largest, p999 = _checked(tree, name, tolerance)
    found = {
        **provenance(
            surface.mesh.name,
            hash_of(surface.mesh),
            tolerance=tolerance,
            achieved_error=largest,
            achieved_error_999=p999,
            checked_within=within,
            order=1,
        ),
        "geokit:sign_method": method,
        "geokit:sign_reason": surface.sign_reason if sign == "auto" else "asked for",
    }
    sizes, count = made.voxel_sizes, made.level_count
    for number, level in enumerate(made.levels):
        with_more(level, {**found, VOXEL_SIZE: sizes[number], LEVEL: number, LEVEL_COUNT: count})
    return made


def load_adaptive(path: str | os.PathLike[str]) -> AdaptiveSDF:
    """Load the adaptive field in a .vdb or .nvdb file; other grids of the file are ignored.

    Args:
        path: File written by :meth:`AdaptiveSDF.save`, or one that holds the same grids.
    Returns:
        AdaptiveSDF with the levels and the metadata of the file, the coarsest level first.
    Raises:
        FileFormatError: The file is damaged, or its levels do not belong to one field.
        InputError: The extension is neither .vdb nor .nvdb, or there is no such file.
        MissingDependencyError: .vdb without the OpenVDB extension.
    """
    grids = [(grid.info.metadata.get(LEVEL), grid) for grid in load_all(path).values()]
    levels = {number: grid for number, grid in grids if isinstance(number, int)}
    if not levels:
        raise FileFormatError(f"{path}: no grid has {LEVEL!r} in its metadata; save an AdaptiveSDF there")
    wanted = levels[min(levels)].info.metadata.get(LEVEL_COUNT)
    if sorted(levels) != list(range(len(levels))) or len(levels) != wanted or len(levels) != _numbered(grids):
        raise FileFormatError(
            f"{path}: levels {sorted(levels)} of {wanted} are not those of one adaptive field; save one to a file of "
            "its own"
        )
    try:
        return AdaptiveSDF(tuple(levels[number] for number in sorted(levels)))
    except InputError as error:
        raise FileFormatError(f"{path}: {error}") from error


def _numbered(grids: list[tuple[Any, SparseVolume]]) -> int:
    return sum(isinstance(number, int) for number, _ in grids)


def _checked(tree: Refinement, name: str, tolerance: float) -> tuple[AdaptiveSDF, float, float]:
    """Correct the field until a round of fresh points passes; returns it, that round's largest error and 99.9 %."""
    made, seed = _built(tree, name, None), SEED
    for _ in range(MOST_ROUNDS):
        _require_reached(tree, tolerance)
        cells = made.levels[0].info.active_voxel_count or 0
        cells += 8 * sum(map(len, tree.refined))
        draws = min(MOST_DRAWS, 1 + POINTS_PER_CELL * cells // DRAWN_POINTS)
        found, points, drawn = _errors_of(made, tree, range(seed, seed + draws), tolerance)
        seed += draws
        if found.max() <= tolerance:
            return made, float(found.max()), float(np.quantile(found[:drawn], 0.999))
        missed = found > tolerance
        tree.correct(points[missed], found[missed])
        made = _built(tree, name, made)
    tree.worst = float(found.max())
    _require_reached(tree, tolerance)
    raise AssertionError("unreachable")


def _errors_of(
    made: AdaptiveSDF, tree: Refinement, seeds: range, tolerance: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Errors (N,) at fresh points of the zone and around the worst of them, these points, and how many are fresh."""
    lattice = tree.lattice
    device = lattice.surface.device
    places, errors = [], []
    for seed in seeds:
        points, exact = check_points(lattice, seed)
        places.append(points)
        errors.append(np.abs(made.sample(points, device=device) - exact))
    points, found = np.concatenate(places), np.concatenate(errors)
    drawn, random = len(found), np.random.default_rng(seeds.start)
    for radius in CLIMBING_RADII:
        high = np.flatnonzero(found > CLIMBING_SHARE * tolerance)
        if len(high) > MOST_CLIMBING:
            high = high[np.argpartition(found[high], -MOST_CLIMBING)[-MOST_CLIMBING:]]
        level, _ = tree.locate(points[high])
        sizes = radius * lattice.size / 2.0**level
        around = np.repeat(points[high], CLIMBING_MOVES, axis=0)
        moved = around + random.uniform(-1.0, 1.0, around.shape) * np.repeat(sizes, CLIMBING_MOVES)[:, None]
        exact = np.asarray(lattice.surface.signed_distance(moved, sign=lattice.sign).distance)
        kept = np.abs(exact) <= lattice.within
        points = np.concatenate([points, moved[kept]])
        found = np.concatenate([found, np.abs(made.sample(moved[kept], device=device) - exact[kept])])
    return found, points, drawn


def _require_reached(tree: Refinement, tolerance: float) -> None:
    if tree.worst > tolerance:
        raise InputError(
            f"tolerance: {tolerance:g} is out of reach: {tree.level_count} levels down to voxels of "
            f"{tree.lattice_of(tree.level_count - 1).size:g} are off by {tree.worst:.3g}; use at least that, a smaller "
            "within, or larger max_levels"
        )


def _built(tree: Refinement, name: str, before: AdaptiveSDF | None) -> AdaptiveSDF:
    """The grids of a refinement; level 0 is taken from ``before`` if that is given."""
    coarsest = build_band_level(tree.lattice, name) if before is None else before.levels[0]
    background = float(coarsest.info.background)
    finer = [
        build_finer_level(tree.lattice_of(number), keys, background, f"{name} level {number}".strip())
        for number, keys in enumerate(tree.refined, 1)
    ]
    return AdaptiveSDF((coarsest, *finer))
