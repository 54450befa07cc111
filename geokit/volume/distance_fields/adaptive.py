"""Distance fields of meshes with voxels only as small as the tolerance requires."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.base.object_cache import CacheAttribute
from geokit.core.gradients.differentiable import of_constants
from geokit.core.interop import user_arrays
from geokit.core.interop.types import Array, Device, MeshLike, Rows
from geokit.core.memory.needs import file_size, needs
from geokit.core.memory.pinned import host_flags
from geokit.core.query.ask import query
from geokit.core.require import require_count, require_items, require_text
from geokit.errors import DeviceMemoryError, FileFormatError, InputError
from geokit.volume._io import load_all, save
from geokit.volume.adaptive.build import build_band_level, build_finer_level
from geokit.volume.adaptive.cells import CellLattice
from geokit.volume.adaptive.check import DRAWN_POINTS, check_points
from geokit.volume.adaptive.choice import CLOSE, WORTH_LEVELS, levels_of, levels_or_one
from geokit.volume.adaptive.refine import Refinement
from geokit.volume.adaptive.table import AdaptiveTable, adaptive_table, shifts_of
from geokit.volume.at_points.sample import gradient as volume_gradient
from geokit.volume.at_points.sample import sample as volume_sample
from geokit.volume.band.fields import hash_of, mesh_metadata
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.provenance import ORDER, VOXEL_SIZE, provenance, with_more
from geokit.volume.retyped.quantize import CODECS
from geokit.volume.sampling.space import world_to_index
from geokit.volume.tolerance.checked_fields import TOLD, Achieved, made_within
from geokit.volume.tolerance.from_mesh import make_setting, tolerance_search
from geokit.volume.tolerance.search import Search, Setting
from geokit.volume.tolerance.zone import THIN, rounding_of

if TYPE_CHECKING:
    from geokit.mesh.surfaces.surface import Surface

# Largest number of levels, if the caller does not say.
MOST_LEVELS = 12
LEVEL = "geokit:level"
LEVEL_COUNT = "geokit:level_count"
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

    A cell (the box between eight voxels) is answered by the next finer level where all voxels that the interpolants of
    its eight halves read are active in that level (3^3, 4^3 and 5^3 voxels at orders 1, 2 and 3), else by its own
    level. So the finest level that has a point's cell answers the point, and the field is everywhere an interpolant of
    exact distances, rounded to the level's codec. Between cells of different levels it jumps by no more than their
    errors. The order of interpolation is that which level 0 records ("geokit:order"), else 1.

    Args:
        levels: Float or quantized grids, the coarsest first. Level 0 is a level set around the whole surface.
    Raises:
        InputError: There are no levels, they are neither float nor quantized grids, or the voxels of a level are not
            half the size of those of the level before.
    """

    levels: tuple[SparseVolume, ...]
    _tables: dict[str, AdaptiveTable] = field(default_factory=dict, repr=False, compare=False)
    # Holds recordings of small queries.
    _cache: ClassVar[CacheAttribute] = CacheAttribute()

    def __post_init__(self) -> None:
        object.__setattr__(self, "levels", tuple(require_items(self.levels, "levels")))
        if not self.levels:
            raise InputError("levels: none given; give at least one grid")
        for number, level in enumerate(self.levels):
            if not isinstance(level, SparseVolume):
                raise InputError(f"levels[{number}]: {type(level).__name__} is not a SparseVolume; give float grids")
            if level.info.grid_type not in CODECS:
                raise InputError(
                    f"levels[{number}]: a grid of type {level.info.grid_type}; give float or quantized grids"
                )
        shifts_of(self.levels)

    def __getstate__(self) -> dict[str, Any]:
        kept = {name: value for name, value in self.__dict__.items() if name != "_cache"}
        return {**kept, "_tables": {}}  # they belong to devices

    @property
    def order(self) -> int:
        """Order of interpolation: 1, 2 or 3. Level 0 records it; without a record it is 1."""
        return self.levels[0].info.order or 1

    @property
    def codecs(self) -> tuple[str, ...]:
        """Storage of the values of each level: "float", "fp16", "fp8", "fp4" or "fpn"."""
        return tuple(level.info.grid_type for level in self.levels)

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

    @query("points", gradient="..sampling.gradients:ADAPTIVE", is_replayed=True, row_bytes=12)
    def sample(self, points: Rows, *, device: Device = None) -> Array:
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
        """
        return self._answer(points, device, gradient=False)

    @query("points", is_replayed=True, row_bytes=28)
    def gradient(self, points: Rows, *, device: Device = None) -> Array:
        """Gradient of the interpolant of :meth:`sample` at each point; next to the surface it is close to the normal.

        It is exact for the interpolant. It jumps between cells, at order 3 only between levels. Outside the box of
        level 0 it is 0.

        Args:
            points: Query points [world], shape (N, 3).
            device: Where to compute; None for the first GPU, else the CPU.
        Returns:
            Gradients (N, 3) [world / world] in the container of ``points``, float64 (float32 where the points are).
        Raises:
            InputError: points is not (N, 3) or not finite.
        """
        return self._answer(points, device, gradient=True)

    @needs(lambda self, *_, **__: 2 * sum(len(level.nanovdb) for level in self.levels))
    def save(self, path: str | os.PathLike[str], *, codec: str | None = None) -> None:
        """Write all levels into one .vdb or .nvdb file, which :func:`load_adaptive` reads.

        A .nvdb file keeps the levels as they are. OpenVDB has no quantized grids, so a .vdb file holds the same values
        as floats. Both keep the order of interpolation.

        Args:
            path: Target file.
            codec: Compression, as in :func:`geokit.volume.save`.
        Raises:
            InputError: The extension is neither .vdb nor .nvdb, or the codec is unknown.
            MissingDependencyError: .vdb without the OpenVDB extension, or codec "blosc" without blosc.
        """
        save(path, *self.levels, codec=codec)

    def _answer(self, points: Any, device: Any, *, gradient: bool) -> Any:
        from geokit.volume.adaptive import sample_kernels

        target = launcher.resolve_device(device)
        is_plain = self.order == 1 and set(self.codecs) == {"float"}
        if self.level_count == 1 and not is_plain:
            query = volume_gradient if gradient else volume_sample
            return query(self.levels[0], points, order=self.order, device=target)
        table = self._table(target)
        batch = user_arrays.read_vectors(points, "points", target, defer=True, keep_float32=True, single=True)
        count, grouped = len(batch), is_plain and target.is_cpu
        if gradient:
            choices = sample_kernels.GRADIENT_CPU if grouped else sample_kernels.GRADIENT_CUDA
            kinds, outside = (wp.vec3f, wp.vec3d), wp.vec3d(0.0, 0.0, 0.0)
        else:
            choices = sample_kernels.SAMPLE_CPU if grouped else sample_kernels.SAMPLE_CUDA
            kinds, outside = (wp.float32, wp.float64), wp.float64(self.levels[0].info.background)
        if not is_plain:
            choices = sample_kernels.STENCILS[self.order][gradient]
        out = user_arrays.empty(count, kinds[0] if batch.is_float32 else kinds[1], batch.rows)
        bad = host_flags(1, target)
        inputs = [table.levels, batch.rows, *world_to_index(self.levels[0]), outside]
        items = -(-count // sample_kernels.GROUP) if grouped else count
        launcher.launch(choices[batch.is_float32], items, inputs, [out, bad], target, grain=GRAIN if grouped else 0)
        if count and bad.numpy()[0]:
            user_arrays.require_finite(batch, "points")
        return batch.to_caller(out)

    def _table(self, device: Any) -> AdaptiveTable:
        if device.alias not in self._tables:
            self._tables[device.alias] = adaptive_table(self.levels, self.order, device)
        return self._tables[device.alias]

    def __repr__(self) -> str:
        sizes = ", ".join(f"{size:.4g}" for size in self.voxel_sizes)
        return f"AdaptiveSDF({self.levels[0].info.name!r}, voxel sizes {sizes}, {self.byte_count} bytes)"


@of_constants
@needs()
def adaptive_from_mesh(
    mesh: MeshLike | Surface,
    tolerance: float,
    *,
    within: float | None = None,
    order: int | None = None,
    codec: str | None = None,
    max_levels: int = MOST_LEVELS,
    sign: str = "auto",
    interior: str = "remove",
    name: str | None = None,
    device: Device = None,
) -> AdaptiveSDF:
    """Signed distance field of a mesh, negative inside, with voxels only as small as the tolerance requires.

    Next to sharp edges an interpolant needs small voxels, while large voxels are enough on flat and gently curved
    faces. Every cell that contains a point of the zone (all points no farther than ``within`` from the surface) is
    checked: on the edges and corners of the mesh, halfway between the faces of its edges, along the way to the surface
    from the cell's voxels and center, and, where gradients differ, at up to 125 more points. Cells that miss the
    tolerance, less what the codec may change, are refined to voxels of half the size. Orders 3 and 1 and several voxel
    sizes are tried, and each level has the codec that suits its voxels. Where the faces of a part lie on a common
    lattice, its voxels do too.

    One voxel size is a choice as well: if several do not promise at most 0.95 of its bytes, the field has one level,
    the grid that ``from_mesh(tolerance=)`` would make. The checks below are at other points than those of
    ``from_mesh``, so a grid that keeps the tolerance only just may fail one of them, and the next best one takes up to
    1.15 times as many bytes in the tests. :func:`geokit.volume.plan` says beforehand which of both is smaller.

    Then random points of the zone that took no part in the refinement are compared with the exact distance: 250,000 on
    faces, edges and corners, or three for each cell where that is more (at most 3 million), and others around the worst
    of them. While one of them misses the tolerance, its cell is refined (or one voxel size is searched again) and new
    points are drawn. ``achieved_error`` and ``achieved_error_999`` are measured in the last round, in which no point
    missed. The metadata of each level holds both of them, the entries that :func:`from_mesh` describes, and the level's
    number as "geokit:level" and "geokit:level_count". The error is measured, not proven: a crease that cuts off next to
    nothing of a cell can stay undetected (1.01 tolerances at one of 600,000 points, where bodies overlap). In all
    property tests it stays within the tolerance at yet other points.

    Several levels pay where the scale of a body differs from place to place: a ball with twenty small cubes on it at
    1e-3 of the diagonal takes 0.43 of the bytes of one voxel size. Each level costs an upper node of 270 kB, so at
    coarse tolerances, and on smooth bodies, one level is the smallest (docs/design/adaptive.md). Fields of order 1 and
    codec "float" take more memory and are sampled over ten times as fast on a CPU.

    Args:
        mesh: Triangles, or a Surface of them, whose tree (and device) is then used.
        tolerance: Largest error of the interpolated distance [world].
        within: Distance from the surface up to which the tolerance holds [world]. None for the tolerance itself, or a
            quarter of it if the mesh is open: beside an open border the sign jumps, and so does the field, by twice the
            distance.
        order: Order of interpolation, 1, 2 or 3; None for the best.
        codec: Storage of the values of all levels, as in :func:`geokit.volume.quantize`; None for the best of each.
        max_levels: Largest number of levels.
        sign: Method that tells inside from outside, as for ``Surface.signed_distance``.
        interior: What happens to surface inside of solids, as for :func:`from_mesh`.
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
    """
    if name is not None:
        require_text(name, "name")
    if require_text(sign, "sign") == "none":
        raise InputError("sign: 'none' makes no signed field; use from_mesh for unsigned distances")
    tolerance = user_arrays.require_finite_scalar(tolerance, "tolerance", low=0.0)
    max_levels = require_count(max_levels, "max_levels", 1)
    search = tolerance_search(
        mesh, tolerance, within=within, order=order, sign=sign, interior=interior, codec=codec, device=device
    )
    surface = search.memory.surface
    name = surface.mesh.name if name is None else name
    made, achieved = _least(search, name, max_levels)
    found = {
        **provenance(
            surface.mesh.name,
            hash_of(surface.mesh),
            tolerance=tolerance,
            achieved_error=achieved.largest,
            achieved_error_999=achieved.p999,
            checked_within=search.zone.within,
            order=made.order,
        ),
        "geokit:sign_method": search.sign_method,
        "geokit:sign_reason": surface._solid_choice.reason if sign == "auto" else "asked for",
        **mesh_metadata(surface.mesh),
    }
    sizes, count = made.voxel_sizes, made.level_count
    for number, level in enumerate(made.levels):
        with_more(level, {**found, VOXEL_SIZE: sizes[number], LEVEL: number, LEVEL_COUNT: count})
    return made


@needs(lambda path, **_: 2 * file_size(path))
def load_adaptive(path: str | os.PathLike[str], *, memory_limit: int | None = None) -> AdaptiveSDF:
    """Load the adaptive field in a .vdb or .nvdb file; other grids of the file are ignored.

    Args:
        path: File written by :meth:`AdaptiveSDF.save`, or one that holds the same grids.
        memory_limit: As for :func:`load`, for all grids together.
    Returns:
        AdaptiveSDF with the levels and the metadata of the file, the coarsest level first.
    Raises:
        FileFormatError: The file is damaged, or its levels do not belong to one field.
        InputError: The extension is neither .vdb nor .nvdb, or there is no such file.
        MissingDependencyError: .vdb without the OpenVDB extension.
        DeviceMemoryError: The content is larger than memory_limit.
    """
    grids = [(grid.info.metadata.get(LEVEL), grid) for grid in load_all(path, memory_limit=memory_limit).values()]
    levels = {number: grid for number, grid in grids if isinstance(number, int)}
    if not levels:
        raise FileFormatError(f"{path}: no grid has {LEVEL!r} in its metadata; save an AdaptiveSDF there")
    wanted = levels[min(levels)].info.metadata.get(LEVEL_COUNT)
    numbered = sum(isinstance(number, int) for number, _ in grids)
    if sorted(levels) != list(range(len(levels))) or len(levels) != wanted or len(levels) != numbered:
        raise FileFormatError(
            f"{path}: levels {sorted(levels)} of {wanted} are not those of one adaptive field; save one to a file of "
            "its own"
        )
    try:
        return AdaptiveSDF(tuple(levels[number] for number in sorted(levels)))
    except InputError as error:
        raise FileFormatError(f"{path}: {error}") from error


def _least(search: Search, name: str, max_levels: int) -> tuple[AdaptiveSDF, Achieved]:
    """The field of fewest bytes: several levels, or one voxel size as from_mesh makes it, and its errors."""
    one, levels = levels_or_one(search, max_levels)
    tree, single = levels.tree, None
    if one is not None and (tree is None or levels.byte_count > CLOSE * one.byte_count):
        with contextlib.suppress(InputError, DeviceMemoryError):
            # The checks may find what the search had not seen, until nothing is left.
            single = _single(search, name)
        if single is not None and (tree is None or levels.byte_count > WORTH_LEVELS * single[0].byte_count):
            return single
    tree = tree or levels_of(search, max_levels).tree
    assert tree is not None
    try:
        made = _checked(tree, name, search.tolerance)
    except InputError:
        if one is None:
            raise
        return single or _single(search, name)
    return single if single is not None and single[0].byte_count <= made[0].byte_count else made


def _single(search: Search, name: str) -> tuple[AdaptiveSDF, Achieved]:
    """The field of one voxel size of least memory that passes the checks of an adaptive field."""
    surface = search.memory.surface

    def make(setting: Setting) -> SparseVolume:
        return with_more(make_setting(search, setting, name), {ORDER: setting.option.order})

    def check(volume: SparseVolume, setting: Setting, trial: int) -> Achieved:
        size = setting.voxel_size
        lattice = CellLattice(surface, search.sign_method, search.zone.bounds[0], size, search.zone.within)
        draws = _draws(volume.info.active_voxel_count or 0)
        seeds = range(SEED + MOST_DRAWS * trial, SEED + MOST_DRAWS * trial + draws)
        alone = AdaptiveSDF((volume,))
        found, points, drawn = _errors_of(alone, lattice, lambda p: np.full(len(p), size), seeds, search.tolerance)
        worst = points[np.argsort(found)[-TOLD * len(CLIMBING_RADII) :]]
        return Achieved(float(found.max()), float(np.quantile(found[:drawn], 0.999)), worst)

    _, volume, achieved = made_within(search, make, check=check)
    assert volume is not None
    assert achieved is not None
    return AdaptiveSDF((volume,)), achieved


def _checked(tree: Refinement, name: str, tolerance: float) -> tuple[AdaptiveSDF, Achieved]:
    """Correct the field until a round of fresh points passes; returns it and that round's errors."""
    made, seed = _built(tree, name, None), SEED

    def sizes(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(tree.lattice.size / 2.0 ** tree.locate(points)[0], np.float64)

    for _ in range(MOST_ROUNDS):
        _require_reached(tree, tolerance)
        draws = _draws((made.levels[0].info.active_voxel_count or 0) + 8 * sum(map(len, tree.refined)))
        found, points, drawn = _errors_of(made, tree.lattice, sizes, range(seed, seed + draws), tolerance)
        seed += draws
        if found.max() <= tolerance:
            return made, Achieved(float(found.max()), float(np.quantile(found[:drawn], 0.999)), points[:0])
        missed = found > tolerance
        tree.correct(points[missed], found[missed])
        made = _built(tree, name, made)
    tree.worst = float(found.max())
    _require_reached(tree, tolerance)
    raise AssertionError("unreachable")


def _draws(cells: int) -> int:
    return min(MOST_DRAWS, 1 + POINTS_PER_CELL * cells // DRAWN_POINTS)


def _errors_of(
    made: AdaptiveSDF,
    lattice: CellLattice,
    sizes: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    seeds: range,
    tolerance: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Errors (N,) at fresh points of the zone and around the worst of them, these points, and how many are fresh.

    Args:
        made: The field.
        lattice: The surface and its zone.
        sizes: Returns the size of the cell around each point [world].
        seeds: Random seeds, one for each draw.
        tolerance: Points whose errors come near it are moved about.
    """
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
        around = np.repeat(points[high], CLIMBING_MOVES, axis=0)
        reach = np.repeat(radius * sizes(points[high]), CLIMBING_MOVES)
        moved = around + random.uniform(-1.0, 1.0, around.shape) * reach[:, None]
        if lattice.within < THIN * reach.max(initial=0.0):
            # Next to none would be in so thin a zone.
            moved = np.asarray(lattice.surface.closest_point(moved).points)
            moved = moved + random.uniform(-1.0, 1.0, moved.shape) * (lattice.within / np.sqrt(3.0))
        exact = np.asarray(lattice.surface.signed_distance(moved, sign=lattice.sign).distance)
        kept = np.abs(exact) <= lattice.within + rounding_of(lattice.surface.bounds)
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
    coarsest = build_band_level(tree.lattice, tree.storage, name) if before is None else before.levels[0]
    background = float(coarsest.info.background)
    finer = [
        build_finer_level(tree, number, background, f"{name} level {number}".strip())
        for number in range(1, tree.level_count)
    ]
    return AdaptiveSDF((coarsest, *finer))
