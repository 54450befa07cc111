"""Points of .ply, .las and .laz files, block after block."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._warn import warn
from geokit.core.files import named_damage, refuse_empty, require_extension, require_file
from geokit.errors import FileFormatError, InputError
from geokit.formats import las, ply
from geokit.formats.blocks.records import rows_at_a_time
from geokit.formats.blocks.triangles import LONGEST_HEADER
from geokit.formats.columns import Columns, joined

KINDS = (".las", ".laz", ".ply")

Block = tuple[NDArray[np.float64], Columns]


@dataclass(frozen=True)
class PointFile:
    """Points in a file.

    Attributes:
        path: The file.
        count: Number of points that it declares.
        width: Bytes of a point.
        read: Reads the points and their arrays, at most so many at a time. The first block has no points.
        system: The coordinate system that a .las file states.
    """

    path: Path
    count: int
    width: int
    read: Callable[[int], Iterator[Block]]
    system: las.CoordinateSystem | None = None

    def blocks(self, rows: int, *, finite_only: bool) -> Iterator[Block]:
        """Finite points and their arrays in the file's order, at most ``rows`` at a time; the first block has none.

        Raises:
            FileFormatError: The file is damaged, or a point is not finite and ``finite_only`` is false.
        """
        first = 0
        with named_damage(self.path):
            for points, data in self.read(rows_at_a_time(rows, self.width)):
                finite = np.isfinite(points).all(axis=1)
                if finite.all():
                    yield points, data
                elif finite_only:
                    yield points[finite], {name: values[finite] for name, values in data.items()}
                else:
                    row = int(finite.argmin())
                    raise FileFormatError(
                        f"{self.path}: point {first + row} is not finite ({points[row].tolist()}); remove or replace "
                        "it, or leave out all such points with finite_only=True"
                    )
                first += len(points)


def open_points(path: Path) -> PointFile:
    """Read the header of a point file, and check its size.

    Raises:
        InputError: The extension is not .ply, .las or .laz.
        FileAccessError: The file is missing or not readable.
        FileFormatError: The file is text, damaged, or has no points.
        MissingDependencyError: The file is .las or .laz and laspy is not installed.
    """
    kind = require_extension(path, KINDS, "streamed point")
    path = require_file(path)
    refuse_empty(path)
    with named_damage(path):
        if kind == ".ply":
            return _open_ply(path)
        las.content_bytes(path)
        system = las.coordinate_system(path)
        return PointFile(path, *las.table_shape(path), lambda rows: las.read_blocks(path, rows), system)


def _open_ply(path: Path) -> PointFile:
    with open(path, "rb") as file:
        order, elements, start = ply.read_header(file.read(LONGEST_HEADER), path)
    if order == "":
        raise FileFormatError(
            f"{path}: is text, which has no blocks; read it with points.load and save it as binary .ply"
        )
    if not elements or elements[0].name != "vertex":
        raise FileFormatError(f"{path}: does not begin with its vertices; a point set needs them first")
    vertex = elements[0]
    record = ply.vertex_record(vertex, order, path.stat().st_size - start, path)

    def read(rows: int) -> Iterator[Block]:
        for first in range(-rows, vertex.count, rows):
            # Before the first points: none.
            number = min(rows, vertex.count - first) if first >= 0 else 0
            records = np.fromfile(path, record, number, offset=start + max(first, 0) * record.itemsize)
            if len(records) < number:
                raise FileFormatError(f"{path}: became shorter while it was read; do not change it meanwhile")
            yield joined({name: records[name].astype(record[name].newbyteorder("=")) for name in vertex_names}, path)

    vertex_names = record.names or ()
    return PointFile(path, vertex.count, record.itemsize, read)


class PointFileWriter:
    """Writes points block after block.

    Args:
        path: The file, .ply (binary), .las or .laz.
        data: Arrays as they will come, with any number of rows.
        count: Number of points in all.
        limits: Least and largest coordinates, (3,) each; None if there are no points.
        system: Their coordinate system, if it is known; .ply does not hold it, which a UserWarning says.
    Raises:
        InputError: The format cannot hold a name or an array.
        MissingDependencyError: The file is .las or .laz and laspy is not installed.
        OSError: Writing failed.
    """

    def __init__(
        self,
        path: Path,
        data: Mapping[str, NDArray[Any]],
        count: int,
        limits: tuple[NDArray[np.float64], NDArray[np.float64]] | None,
        system: las.CoordinateSystem | None = None,
    ) -> None:
        kind = require_extension(path, KINDS, "streamed point")
        self._file = _Watched(path)
        self._las: las.PointWriter | None = None
        try:
            if kind == ".ply":
                self._file.write(ply.points_header(np.zeros((0, 3)), data, count))
                if system is not None and system.records:
                    warn(f"{kind} holds no coordinate system; {system.name or 'that of the points'} is left out")
            else:
                with self._file:
                    self._las = las.PointWriter(path, self._file, data, limits, system)
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> PointFileWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if self._las is not None:
                with self._file:
                    self._las.__exit__(kind)
        finally:
            self._file.close()

    def write(self, points: NDArray[np.float64], data: Mapping[str, NDArray[Any]]) -> None:
        """Write some points with their arrays."""
        if self._las is None:
            self._file.write(ply.points_body(points, data))
        else:
            with self._file:
                self._las.write(points, data)


class _Watched:
    """A file for laspy, whose backends hide the system's reason when it cannot write: the context raises it again."""

    def __init__(self, path: Path) -> None:
        self._file = open(path, "wb+")  # noqa: SIM115
        self._error: OSError | None = None

    def write(self, content: Any) -> int:
        return self._asked(self._file.write, content)

    def seek(self, *where: int) -> int:
        return self._asked(self._file.seek, *where)

    def flush(self) -> None:
        self._asked(self._file.flush)

    def tell(self) -> int:
        return self._file.tell()

    def close(self) -> None:
        self._file.close()

    def _asked(self, work: Callable[..., Any], *given: Any) -> Any:
        try:
            return work(*given)
        except OSError as error:
            self._error = error
            raise

    def __enter__(self) -> None:
        self._error = None

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and self._error is not None and not issubclass(kind, (OSError, InputError)):
            raise self._error from None
