"""Points of a file larger than memory, tile by tile, each with the points around it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.content_limit import working_memory
from geokit.core.files import require_room
from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.core.memory.needs import needs
from geokit.core.require import require_flag, require_path
from geokit.formats.blocks.points import PointFile, open_points
from geokit.formats.blocks.records import AT_A_TIME, BYTES_AT_A_TIME, work_folder
from geokit.points.streamed.columns import Around, longest_reach, smaller
from geokit.points.streamed.tiles import MOST_POINTS, OWN_SHARE, ROW, Tiles, known_of

# Memory for a point, with some 30 neighbors that the caller finds for it.
BYTES_PER_POINT = 1000


class PointTile(NamedTuple):
    """Points of a tile of a cloud, and those around it, in the order of the file.

    Attributes:
        points: Positions [world], shape (N, 3) float64.
        indices: Rows in the file, among finite points, (N,) int64.
        own: Places of the tile's own points, (M,) int64; all points within the halo of these are there. A point is the
            own of one tile.
    """

    points: NDArray[np.float64]
    indices: NDArray[np.int64]
    own: NDArray[np.int64]


@needs()
def load_tiles(
    path: str | os.PathLike[str],
    *,
    halo: float,
    finite_only: bool = False,
    memory_limit: int | None = None,
    folder: str | os.PathLike[str] | None = None,
) -> Iterator[PointTile]:
    """Read a point cloud that does not fit into memory tile by tile, for searches within a radius.

    The neighbors of a tile's own points within the halo are those of the whole cloud::

        for tile in gk.points.load_tiles("scan.laz", halo=0.1):
            found = gk.points.NeighborGrid(tile.points, 0.1).radius_search(tile.points[tile.own])
            rows, neighbors = tile.indices[tile.own], tile.indices[found.indices]

    The points are sorted into tiles of about equally many when the first one is asked for, in files of 32 bytes a
    point, which are removed after the last one.

    Args:
        path: A .las or .laz file (with laspy), or a binary .ply file that begins with its vertices.
        halo: Distance [world] from a tile's own points within which the others are added.
        finite_only: Leave out points that are not finite. Otherwise they raise FileFormatError.
        memory_limit: Bytes that a tile may take with what is computed of it, at least 2^28: a tile has at most one
            point for each 1000 bytes. None for half of the free memory.
        folder: Where the files are made; None for the folder of the source.
    Returns:
        An iterator of PointTile.
    Raises:
        InputError: An argument is out of range.
        FileAccessError: A file or the folder is missing or cannot be written, or the disk has no room.
        FileFormatError: The source is text or damaged, or a point is not finite; the message gives the row.
        DeviceMemoryError: More points lie within the halo than fit into the memory.
        MissingDependencyError: The file is .las or .laz and laspy is not installed.
    Example:
        >>> gk.points.save("scan.ply", [[0, 0, 0], [1, 0, 0], [3, 0, 0]])
        >>> for tile in gk.points.load_tiles("scan.ply", halo=1.0):
        ...     print(tile.indices[tile.own].tolist())
        [0, 1, 2]
    """
    path = require_path(path)
    reach = longest_reach(require_finite_scalar(halo, "halo", low=0.0))
    require_flag(finite_only, "finite_only")
    most = min((working_memory(memory_limit) - BYTES_AT_A_TIME) // BYTES_PER_POINT, MOST_POINTS)
    where = path.parent if folder is None else require_path(folder, "folder")
    return _tiles(open_points(path), reach, finite_only, most, where)


def _tiles(source: PointFile, reach: float, finite_only: bool, most: int, where: Path) -> Iterator[PointTile]:
    with work_folder(where) as folder:
        tiles = _sorted(source, finite_only, most, where, folder)
        for number in range(len(tiles)):
            # Parts of a tile that still wait, the next one last.
            parts = [tiles.own(number)]
            while parts:
                tile = _with_halo(tiles, parts, reach, most)
                if tile is not None:
                    yield tile


@needs(name="load_tiles")
def _sorted(source: PointFile, finite_only: bool, most: int, where: Path, folder: Path) -> Tiles:
    known = known_of(source.blocks(AT_A_TIME, finite_only=finite_only), source.count)
    require_room(where / source.path.name, known.count * ROW.itemsize, "its sorted points", "name another folder")
    blocks = source.blocks(AT_A_TIME, finite_only=finite_only)
    return Tiles(blocks, known, max(int(OWN_SHARE * most), 1), folder)


@needs(name="load_tiles")
def _with_halo(tiles: Tiles, parts: list[NDArray[Any]], reach: float, most: int) -> PointTile | None:
    """The last part with the points around it, or None where they are too many: then its halves wait instead."""
    own = parts.pop()
    around = Around(tiles, own, reach, most)
    if around.records is None:
        parts += reversed(smaller(own, reach, "halo", most))
        return None
    return PointTile(np.ascontiguousarray(around.records["points"]), around.records["row"].copy(), around.own)
