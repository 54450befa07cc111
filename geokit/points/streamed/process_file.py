"""Downsampling, normals and densities of point clouds that do not fit into memory, from file to file."""

from __future__ import annotations

import functools
import inspect
import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.base.private_folder import private_folder
from geokit.core.blocks.chunked_queries import Progress, in_percent
from geokit.core.files import atomic_path, require_extension, require_room
from geokit.core.interop.types import Device
from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.core.memory.available_memory import available
from geokit.core.memory.needs import needs
from geokit.core.require import require_flag, require_mapping, require_path
from geokit.errors import InputError
from geokit.formats.blocks.points import KINDS, Block, PointFile, PointFileWriter, open_points
from geokit.formats.blocks.records import AT_A_TIME, BYTES_AT_A_TIME, Buckets, Known, RecordFile, append
from geokit.formats.blocks.workers import Done, in_turn, task_memory
from geokit.formats.columns import Columns
from geokit.points._density import density as density_of
from geokit.points._downsample import downsample
from geokit.points._normals import normals as normals_of
from geokit.points.clouds.voxel_centroids import require_resolved
from geokit.points.clouds.voxel_centroids_kernels import PIECE
from geokit.points.streamed.columns import Density, Normals
from geokit.points.streamed.tiles import (
    MOST_POINTS,
    OWN_SHARE,
    ROW,
    Tiles,
    blocks_of,
    known_of,
    records_of,
    sample_of,
    type_of,
)

# Share of the free memory of a GPU that is taken.
DEVICE_SHARE = 0.5
# Parts of the work, of 100, after which the points are known, and downsampled, and their arrays are there.
SURVEYED, DOWNSAMPLED, COMPUTED = 10, 50, 90
# Parts that points are divided into at a time, and points of a sample for each.
MOST_PARTS, PART_SAMPLE = 512, 256


class ProcessedFile(NamedTuple):
    """What :func:`process_file` did.

    Attributes:
        read_count: Number of points in the source.
        left_out_count: Number of those that are not finite.
        written_count: Number of points in the target.
    """

    read_count: int
    left_out_count: int
    written_count: int


@needs()
def process_file(
    path: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    voxel_size: float | None = None,
    normals: Mapping[str, Any] | None = None,
    density: Mapping[str, Any] | None = None,
    finite_only: bool = False,
    memory_limit: int | None = None,
    device: Device = None,
    executor: Any = None,
    progress: Progress | None = None,
) -> ProcessedFile:
    """Downsample a point cloud and add normals and densities, from file to file; neither has to fit into memory.

    The points are those of ``downsample(voxel_size=...)`` bit for bit and in its order, with the arrays of the point
    that is nearest to each centroid; without ``voxel_size`` all points, in the order of the source. Then arrays are
    added to those of the source, or replace them:

    - ``normals``: "normals" and "curvature" of :func:`normals`, of what it finds in the whole cloud. Bit for bit if the
      neighborhoods are the nearest points. Within a radius the same points are summed in another order, which changes
      last digits (the error bound is that of :func:`normals`).
    - ``density``: "density" of :func:`density`, bit for bit for the kernel "count", and within its error bound for the
      others.

    Points are sorted into tiles of about equally many, in files beside ``out``. Each tile is answered with the points
    around it: those within the radius, or as far as the nearest points reach. The files take about the size of the
    points (32 bytes each, with ``voxel_size`` also the arrays) and of what is added; they are removed at the end, and
    after ``kill -9`` when geokit next writes into that folder.

    Args:
        path: A .las or .laz file (with laspy), or a binary .ply file that begins with its vertices. A .laz file is
            decompressed in this process.
        out: Target, .ply, .las or .laz; an existing file is replaced. It appears complete or not at all.
        voxel_size: Edge length of the voxels [world] whose centroids replace the points; None keeps all points.
        normals: Arguments of :func:`normals` besides points and device; None for no normals. ``orientation`` is "none"
            if it is not given; "propagation" is refused, because the sign of a normal may depend on all others.
        density: Arguments of :func:`density` besides points, queries and device, with one mass for all points; None for
            no densities.
        finite_only: Leave out points that are not finite. Otherwise they raise FileFormatError.
        memory_limit: Bytes that may be taken beyond those of the running process, at least 2^28; with an executor, by
            each of its tasks too. None for half of the free memory, or for 2^30 with an executor.
        device: Where to compute: "cpu", "cuda:0", a warp device, or None for the first GPU, else the CPU.
        executor: Workers that make normals and densities of tiles, side by side: an executor of
            ``concurrent.futures``, a Dask ``Client``, or another object whose ``submit(function, *arguments)`` gives
            such futures. All must see the folder of ``out``. The file is that of the calling process with the same
            ``memory_limit``, byte for byte. None for the calling process.
        progress: Called as ``progress(percent, 100)``.
    Returns:
        ProcessedFile with the numbers of points.
    Raises:
        InputError: An argument is out of range or not one of the function that it is for, the target cannot hold an
            array of the source, or voxel_size is too small for the coordinates.
        FileAccessError: A file is missing, or cannot be written, or the disk has no room for the result.
        FileFormatError: The source is text or damaged, or a point is not finite; the message gives the row.
        DeviceMemoryError: More points lie within a radius than fit into the memory.
        WorkerError: The executor lost a worker, or a worker does not see the folder of ``out``.
        MissingDependencyError: A file is .las or .laz and laspy is not installed.
    Source:
        Isenburg, Liu, Shewchuk, Snoeyink, Streaming computation of Delaunay triangulations (2006), for points that are
        sorted on disk before they are processed. Bentley, Multidimensional binary search trees used for associative
        searching (1975), for the tiles.
    Example:
        >>> gk.points.save("scan.ply", gk.points.sample(gk.mesh.sphere(), 5000))
        >>> gk.points.process_file("scan.ply", "thin.ply", voxel_size=0.1, normals={"k": 12}, device="cpu").read_count
        5000
    """
    path, target = require_path(path), require_path(out, "out")
    require_extension(target, KINDS, "streamed point")
    if voxel_size is not None:
        voxel_size = require_finite_scalar(voxel_size, "voxel_size", low=0.0)
    require_flag(finite_only, "finite_only")
    ends = 0, SURVEYED, DOWNSAMPLED, COMPUTED, 100
    surveying, thinning, computing, writing = (in_percent(progress, *part) for part in itertools.pairwise(ends))
    resolved = launcher.resolve_device(device)
    memory = task_memory(executor, memory_limit) - BYTES_AT_A_TIME
    if resolved.is_cuda:
        memory = min(memory, int(DEVICE_SHARE * available(resolved)))
    work = _Work(normals, density, memory, resolved)
    source = open_points(path)
    with atomic_path(target) as part, private_folder(part.parent) as folder:
        known = known_of(_told(_source(source, finite_only), source.count, surveying), source.count)
        read_count, left_out_count = source.count, source.count - known.count
        # What the format cannot hold is refused before the work.
        with PointFileWriter(part, {**known.data, **work.data}, 0, None):
            pass
        least = known.count * (type_of(known.data).itemsize + (work.bytes_on_disk if voxel_size is None else 0))
        require_room(target, least, "the points and what is written before them", "use another disk")
        with np.errstate(over="ignore"):
            if not np.isfinite(known.upper - known.lower).all():
                raise InputError(
                    f"{path}: its points spread from {known.lower.tolist()} to {known.upper.tolist()}, more than a "
                    "float64 can hold; scale them down"
                )
        points: Callable[[], Iterator[Block]] = functools.partial(_source, source, finite_only)
        if voxel_size is not None:
            kept = Voxels(voxel_size, memory, folder, resolved, thinning).of(points(), known)
            points, known = functools.partial(blocks_of, kept), known_of(blocks_of(kept), kept.count)
        results = work.done(points(), known, folder, executor, computing)
        limits = (known.lower, known.upper) if known.count else None
        with PointFileWriter(part, {**known.data, **work.data}, known.count, limits, source.system) as file:
            for some, data in _told(points(), known.count, writing):
                if len(some):
                    file.write(some, {**data, **results.take(len(some))} if results else data)
    return ProcessedFile(read_count, left_out_count, known.count)


def _source(source: PointFile, finite_only: bool) -> Iterator[Block]:
    return source.blocks(AT_A_TIME, finite_only=finite_only)


def _told(blocks: Iterable[Block], count: int, report: Callable[[float], None]) -> Iterator[Block]:
    done = 0
    for points, data in blocks:
        yield points, data
        done += len(points)
        report(min(done / max(count, 1), 1.0))


class _Work:
    """The arrays that are added.

    Args:
        normals: Arguments of normals, or None.
        density: Arguments of density, or None.
        memory: Bytes that may be taken.
        device: Where to compute.
    """

    def __init__(self, normals: Any, density: Any, memory: int, device: "wp.Device") -> None:
        self.data: Columns = {}
        self._parts: list[Normals | Density] = []
        self._memory = memory
        none = np.zeros((0, 3))
        if normals is not None:
            given = {"orientation": "none", **_arguments(normals, "normals", normals_of, ("points", "device"))}
            if given["orientation"] == "propagation":
                raise InputError(
                    "normals: orientation 'propagation' carries signs across the whole cloud, which need not fit into "
                    "memory; use 'none' or 'viewpoint', or points.normals"
                )
            # It checks its arguments.
            normals_of(none, **given, device="cpu")
            k, radius = int(given.get("k", 16)), given.get("radius")
            viewpoint = None if given.get("viewpoint") is None else [float(x) for x in given["viewpoint"]]
            most = min(memory // Normals.bytes_per_point(k if radius is None else 0), MOST_POINTS)
            self._parts.append(Normals(k, None if radius is None else float(radius), viewpoint, most, str(device)))
            self.data.update(normals=none, curvature=np.zeros(0))
        if density is not None:
            given = _arguments(density, "density", density_of, ("points", "queries", "device"))
            if "radius" not in given:
                raise InputError("density: radius is missing; give one, as in density={'radius': 0.1}")
            if np.ndim(given.get("mass", 1.0)):
                raise InputError("density: mass has several numbers; give one for all points")
            density_of(none, **given, device="cpu")
            most = min(memory // Density.BYTES_PER_POINT, MOST_POINTS)
            self._parts.append(Density(given, most, str(device)))
            self.data["density"] = np.zeros(0)

    @property
    def bytes_on_disk(self) -> int:
        """Of a point in its tile, and of its arrays, there and in the target."""
        return ROW.itemsize + 2 * type_of(self.data).itemsize if self.data else 0

    def done(
        self, points: Iterable[Block], known: Known, folder: Path, executor: Any, report: Callable[[float], None]
    ) -> Results | None:
        """The arrays of all points; None if there are none."""
        if not self._parts:
            return None
        most = min(part.most for part in self._parts)
        tiles = Tiles(points, known, max(int(OWN_SHARE * most), 1), folder)
        answers = TileAnswers(tiles, self._parts, self.data)
        results, done = Results(answers.dtype, folder, self._memory // 4, known.count), 0
        with closing(in_turn(answers, range(len(tiles)), folder, executor)) as found:
            for _, answer in found:
                results.add(answer.found)
                done += len(answer.found)
                report(done / known.count)
        return results


def _arguments(given: Any, name: str, function: Callable[..., Any], left_out: tuple[str, ...]) -> dict[str, Any]:
    """Checked names of arguments of a function."""
    options = require_mapping(given, name)
    known = [key for key in inspect.signature(function).parameters if key not in left_out]
    for key in options:
        if key not in known:
            raise InputError(f"{name}: {key!r} is none of its arguments; use {', '.join(known)}")
    return options


class TileAnswers:
    """Arrays by tile.

    Args:
        tiles: The points.
        parts: What is asked of them.
        data: The arrays without rows.
    """

    def __init__(self, tiles: Tiles, parts: Sequence[Normals | Density], data: Columns) -> None:
        self._tiles, self._parts = tiles, parts
        fields = [(name, values.dtype, values.shape[1:]) for name, values in data.items()]
        self.dtype = np.dtype([("row", np.int64), *fields])

    def make(self, number: int, _: Path) -> Done:
        """The arrays of a tile's points, by row."""
        own = self._tiles.own(number)
        records = np.empty(len(own), self.dtype)
        records["row"] = own["row"]
        for part in self._parts:
            for rows, found in part.of(self._tiles, own):
                places = np.searchsorted(own["row"], rows)
                for name, values in found.items():
                    records[name][places] = values
        return Done(records)


class Results:
    """Arrays of points by row.

    Args:
        dtype: Type of the records: "row", and a field for each array.
        folder: Where the files are made.
        memory: Bytes that may be taken.
        count: Number of points.
    """

    def __init__(self, dtype: np.dtype[Any], folder: Path, memory: int, count: int) -> None:
        self._dtype = dtype
        # The rows of a file, twice while they are put in order.
        self._rows = max(memory // (2 * dtype.itemsize), 1)
        self._buckets = Buckets(folder / "results", dtype, -(-count // self._rows))
        self._held, self._first = np.empty(0, dtype), 0

    def add(self, records: NDArray[Any]) -> None:
        """Keep arrays of some points."""
        self._buckets.add(records, records["row"] // self._rows)

    def take(self, count: int) -> Columns:
        """The arrays of the next points."""
        found = []
        while count:
            if not len(self._held):
                self._held = self._next()
            found.append(self._held[:count])
            self._held = self._held[count:]
            count -= len(found[-1])
        whole = np.concatenate([np.empty(0, self._dtype), *found])
        return {name: whole[name] for name in self._dtype.names or () if name != "row"}

    def _next(self) -> NDArray[np.void]:
        records = self._buckets.file(self._first // self._rows).take()
        whole = np.empty_like(records)
        whole[records["row"] - self._first] = records
        self._first += len(records)
        return whole


class Voxels:
    """Downsamples by voxels.

    Args:
        voxel_size: Edge length of a voxel [world].
        memory: Bytes that may be taken.
        folder: Where the files are made.
        device: Where to compute.
        report: Called with the part of the points that is done, from 0 to 1.
    """

    def __init__(
        self, voxel_size: float, memory: int, folder: Path, device: "wp.Device", report: Callable[[float], None]
    ) -> None:
        self._size, self._memory, self._folder, self._device = voxel_size, memory, folder, device
        self._report, self._done, self._total = report, 0, 1

    def of(self, blocks: Iterable[Block], known: Known) -> RecordFile:
        """Centroids of the voxels in ascending (z, y, x), with the arrays of the point nearest to each.

        Raises:
            InputError: The voxels are too small for coordinates of this size.
        """
        require_resolved(known.lower, known.upper, self._size)
        self._dtype, self._total = type_of(known.data), max(known.count, 1)
        # The records twice, and what downsample needs.
        self._most = min(self._memory // (2 * self._dtype.itemsize + 130), MOST_POINTS)
        self._target, self._count = self._folder / "centroids", 0
        records = (records_of(points, data) for points, data in blocks)
        self._divide(records, known.count, known.sample, known.lower, known.upper, "voxels")
        return RecordFile(self._target, self._dtype, self._count)

    def _divide(
        self,
        parts: Iterable[NDArray[Any]],
        count: int,
        sample: NDArray[np.float64],
        lower: NDArray[np.float64],
        upper: NDArray[np.float64],
        stem: str,
    ) -> None:
        """Sort points into files of layers of voxels, and handle these in ascending order."""
        if not count:
            return
        low, high = np.floor(lower / self._size), np.floor(upper / self._size)
        # Whole layers along z first, then rows, so that the parts follow each other in the order of the voxels.
        axis = next((axis for axis in (2, 1) if low[axis] < high[axis]), 0)
        layers = np.sort(np.floor(sample[:, axis] / self._size))
        wanted = min(max(2 * count // self._most, 1) + 1, MOST_PARTS)
        some = layers[np.arange(1, wanted) * len(layers) // wanted]
        # A layer of many points becomes a part of its own.
        cuts = np.unique(np.concatenate([some, some + 1.0, [low[axis] + 1.0]]))
        cuts = cuts[(cuts > low[axis]) & (cuts <= high[axis])]
        number = len(cuts) + 1
        lows, highs = np.full((number, 3), np.inf), np.full((number, 3), -np.inf)
        buckets = Buckets(self._folder / stem, self._dtype, number)
        for records in parts:
            points = records["points"]
            place = np.searchsorted(cuts, np.floor(points[:, axis] / self._size), side="right")
            for at, rows in buckets.add(records, place):
                lows[at] = np.minimum(lows[at], points[rows].min(axis=0))
                highs[at] = np.maximum(highs[at], points[rows].max(axis=0))
        for at, file in buckets.files():
            self._make(file, lows[at], highs[at])

    def _make(self, file: RecordFile, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> None:
        """Handle points of whole voxels, in their first order, in a box."""
        if file.count <= self._most:
            records = file.read()
            found = downsample(np.ascontiguousarray(records["points"]), voxel_size=self._size, device=self._device)
            kept = records[found.indices]
            kept["points"] = found.points
            self._add(kept)
        elif (np.floor(lower / self._size) == np.floor(upper / self._size)).all():
            self._add(self._centroid(file))
        else:
            some = sample_of(file, PART_SAMPLE * MOST_PARTS)
            self._divide(file.parts(), file.count, some, lower, upper, file.path.name)
            os.unlink(file.path)
            return
        os.unlink(file.path)
        self._done += file.count
        self._report(min(self._done / self._total, 1.0))

    def _add(self, kept: NDArray[Any]) -> None:
        append(self._target, kept)
        self._count += len(kept)

    def _centroid(self, file: RecordFile) -> NDArray[Any]:
        """The centroid of all points, and the arrays of the nearest one: the sums of the kernel, block after block."""
        origin = file.read(0, 1)["points"][0]
        piece = int(PIECE)
        total = np.zeros(3)
        for records in file.parts(max(file.rows // piece, 1) * piece):
            apart = records["points"] - origin
            for first in range(0, len(apart), piece):
                # Added one after the other, as in a loop.
                total += np.cumsum(apart[first : first + piece], axis=0)[-1]
        mean = total / file.count
        best, kept = np.inf, file.read(0, 1)
        for records in file.parts():
            d = (records["points"] - origin) - mean
            squared = (d[:, 0] * d[:, 0] + d[:, 1] * d[:, 1]) + d[:, 2] * d[:, 2]
            at = int(np.argmin(squared))
            if squared[at] < best:
                best, kept = squared[at], records[at : at + 1].copy()
        kept["points"] = origin + mean
        return kept
