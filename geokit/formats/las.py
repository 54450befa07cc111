"""Airborne laser scans (.las, .laz) through laspy, with the header checked before laspy reads it."""

from __future__ import annotations

import contextlib
import io
import re
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit._packages import remedy, require_package
from geokit.core.files import in_one_line
from geokit.errors import FileFormatError, GeokitError, InputError, MissingDependencyError
from geokit.formats.columns import Columns, integer_colors

# Coordinates are integers of 32 bits times a scale; a few values at the ends are reserved for rounding.
LARGEST_STEPS = 2**31 - 8
# Smallest power of ten that float64 distinguishes from zero.
SMALLEST_EXPONENT = -323
# Sizes of the public header block in bytes, of LAS 1.0 and of 1.4.
HEADER_SIZE, HEADER_SIZE_14 = 227, 375
# Bytes before the data of a variable length record and of an extended one.
VLR_SIZE, EVLR_SIZE = 54, 60
# Bits of the point format that mark compressed points.
COMPRESSED = 0xC0
LONGEST_NAME = 32
# Point formats of LAS 1.4 by the dimensions that they have in addition to format 6.
_FORMATS = {(): 6, ("rgb",): 7, ("nir", "rgb"): 8}
_COLORS = ("red", "green", "blue")
_POSITION = ("X", "Y", "Z", "x", "y", "z")
# Who has the records of coordinate systems, which of them are WKT, and that of keys of GeoTIFF.
_PROJECTION, _WKT, _KEYS = "LASF_Projection", (2111, 2112), 34735
# Keys of GeoTIFF whose value is an EPSG code, the more telling first: projected, geographic.
_CODES = (3072, 2048)
# Longest record before the points.
LONGEST_VLR = 65535
# Times of the week are below this; standard time is GPS time less 10^9 s.
WEEK_SECONDS = 604_800


class CoordinateSystem(NamedTuple):
    """What coordinates and times of a .las file refer to, as the file states it.

    Attributes:
        name: That of its WKT, or "EPSG:25832" by the keys of GeoTIFF; "" if neither tells.
        records: Number, description and content of each of its records, which .las and .laz keep.
        standard_time: Whether ``gps_time`` is GPS time less 10^9 seconds, not that within a week.
    """

    name: str
    records: tuple[tuple[int, str, bytes], ...]
    standard_time: bool


def _laspy() -> Any:
    return require_package("laspy")


def content_bytes(path: Path) -> int | None:
    """Size of the decompressed points in bytes, after checking the header; None if they are not compressed.

    Raises:
        MissingDependencyError: laspy is not installed, or no backend for .laz.
        FileFormatError: The file is damaged or truncated.
    """
    return _check_header(path, _laspy())


def table_shape(path: Path) -> tuple[int, int]:
    """Number of points that the header declares, and bytes of each; :func:`content_bytes` has checked it."""
    with _named(path), _laspy().open(path) as reader:
        return int(reader.header.point_count), int(reader.header.point_format.size)


def coordinate_system(path: Path) -> CoordinateSystem | None:
    """The records of a file about its coordinate system, before the points or behind them; None if it has none.

    Call :func:`content_bytes` first.

    Raises:
        FileFormatError: A record is longer than the file.
    """
    found: list[tuple[int, str, bytes]] = []
    with open(path, "rb") as file:
        head = file.read(HEADER_SIZE_14)
        start, points, count = struct.unpack_from("<HII", head, 94)
        places = [(start, count, VLR_SIZE, "<H", points)]
        if head[25] >= 4:
            start, count = struct.unpack_from("<QI", head, 235)
            places.append((start, count, EVLR_SIZE, "<Q", path.stat().st_size))
        for at, number, size, width, end in places:
            for _ in range(number):
                file.seek(at)
                record = file.read(size)
                length = int.from_bytes(record[20 : 20 + struct.calcsize(width)], "little")
                if len(record) < size or at + size + length > end:
                    raise FileFormatError(
                        f"{path}: a record of {length} bytes is longer than its place; get a whole copy"
                    )
                if record[2:18].rstrip(b"\0 ") == _PROJECTION.encode():
                    note = record[-32:].rstrip(b"\0").decode("latin-1")
                    found.append((int.from_bytes(record[18:20], "little"), note, file.read(length)))
                at += size + length
    standard = bool(head[6] & 1)
    return CoordinateSystem(_name_of(found), tuple(found), standard) if found or standard else None


def _name_of(records: list[tuple[int, str, bytes]]) -> str:
    for number, _, content in records:
        if number in _WKT and (named := re.match(rb'\s*\w+\s*\[\s*"([^"]*)"', content)):
            return named[1].decode("utf-8", "replace")
    for number, _, content in records:
        if number == _KEYS:
            keys = np.frombuffer(content[: len(content) // 8 * 8], "<u2").reshape(-1, 4)[1:]
            codes = {int(key): int(value) for key, place, _, value in keys if place == 0 and 0 < value < 32767}
            if code := next((codes[key] for key in _CODES if key in codes), None):
                return f"EPSG:{code}"
    return ""


def prepare() -> None:
    """Import laspy and its backend."""
    _laspy().LazBackend.detect_available()


def read_points(path: Path) -> tuple[NDArray[np.float64], Columns]:
    """Read the points in float64, scaled as the header states, and every other dimension in its own type.

    ``red``, ``green`` and ``blue`` become ``rgb`` (N, 3) uint16. Call :func:`content_bytes` first: laspy does not check
    the sizes in the header.

    Raises:
        FileFormatError: The file is damaged.
    """
    with _named(path):
        cloud = _laspy().read(path)
        return _content(cloud, cloud.point_format)


def read_blocks(path: Path, rows: int) -> Iterator[tuple[NDArray[np.float64], Columns]]:
    """The points of :func:`read_points`, at most ``rows`` at a time; the first block has none.

    Call :func:`content_bytes` first.

    Raises:
        FileFormatError: The file is damaged.
    """
    with _named(path), _laspy().open(path) as reader:
        header = reader.header
        yield _content(_laspy().ScaleAwarePointRecord.zeros(0, header=header), header.point_format)
        left = header.point_count
        while left:
            block = reader.read_points(min(rows, left))
            if len(block) < min(rows, left):
                raise FileFormatError(f"{path}: ends {left - len(block)} points early; get a whole copy")
            left -= len(block)
            yield _content(block, header.point_format)


@contextlib.contextmanager
def _named(path: Path) -> Iterator[None]:
    """Name what laspy and its backends raise: many kinds of errors, and a backend's panic is not an Exception."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit, GeneratorExit, GeokitError, MemoryError):
        raise
    except BaseException as error:
        reason = in_one_line(str(error)) or type(error).__name__
        raise FileFormatError(f"{path}: cannot be read as .las ({reason}); get a whole copy") from None


def _content(cloud: Any, point_format: Any) -> tuple[NDArray[np.float64], Columns]:
    points = np.stack([np.asarray(cloud[axis], dtype=np.float64) for axis in "xyz"], axis=1)
    names = [name for name in point_format.dimension_names if name not in _POSITION]
    data: Columns = {name: np.array(cloud[name]) for name in names}
    if set(_COLORS) <= data.keys():
        data["rgb"] = np.stack([data.pop(color) for color in _COLORS], axis=1)
    return points, data


def _require_backend(laspy: Any, path: Path) -> None:
    if not laspy.LazBackend.detect_available():
        raise MissingDependencyError(
            f"{path}: compressed points (.laz) need the package lazrs; install it with: {remedy('lazrs')}"
        )


def _check_header(path: Path, laspy: Any) -> int | None:
    """Check the sizes in the header against the file, before memory is allocated for them.

    Returns:
        Size of the decompressed points in bytes; None if they are not compressed.
    """
    size = path.stat().st_size
    with open(path, "rb") as file:
        head = file.read(HEADER_SIZE_14)
        if head[:4] != b"LASF":
            raise FileFormatError(f"{path}: does not start with 'LASF'; the file is damaged or not a .las file")
        minor = head[25] if len(head) > 25 else 0
        needed = HEADER_SIZE_14 if minor >= 4 else HEADER_SIZE
        if len(head) < needed:
            raise FileFormatError(f"{path}: ends within its header, at byte {len(head)} of {needed}; get a whole copy")
        header_size, start, records, kind, width, count = struct.unpack_from("<HIIBHI", head, 94)
        if minor >= 4:
            extended_start, extended_count, count = struct.unpack_from("<QIQ", head, 235)
            if extended_count and not extended_count * EVLR_SIZE <= size - extended_start <= size:
                raise FileFormatError(
                    f"{path}: its {extended_count} extended records lie beyond its end; get a whole copy"
                )
        if not needed <= header_size <= start <= size or records * VLR_SIZE > start - header_size:
            raise FileFormatError(
                f"{path}: has {size} bytes, and its header puts {records} records and the points from byte {start} on; "
                "get a whole copy"
            )
        if not kind & COMPRESSED:
            have = (size - start) // max(width, 1)
            if have < count:
                raise FileFormatError(f"{path}: ends in point {have} of the {count} it declares; get a whole copy")
            return None
        _require_backend(laspy, path)
        _check_chunks(file, path, size, start, width, count)
    return int(count * width)


def _check_chunks(file: Any, path: Path, size: int, start: int, width: int, count: int) -> None:
    # The offset of the chunk table precedes the points, and each chunk begins with one uncompressed record.
    if count == 0:
        return
    file.seek(start)
    where = int.from_bytes(file.read(8), "little", signed=True)
    chunks = 0
    if start + 8 <= where <= size - 8:
        file.seek(where + 4)
        chunks = int.from_bytes(file.read(4), "little")
    if not 0 < chunks <= size // max(width, 1):
        raise FileFormatError(f"{path}: its table of compressed chunks is missing or damaged; get a whole copy")


def write_points(
    path: Path,
    points: NDArray[np.float64],
    data: Mapping[str, NDArray[np.generic]],
    system: CoordinateSystem | None = None,
) -> None:
    """Write LAS 1.4, with the smallest power of ten as the scale of each axis for which integers hold the extent.

    Raises:
        MissingDependencyError: laspy is not installed, or no backend for .laz.
        InputError: The format cannot hold a name or an array.
    """
    # Through memory, because the backend of .laz hides the system's reason when it cannot write.
    whole = io.BytesIO()
    limits = (points.min(axis=0), points.max(axis=0)) if len(points) else None
    with PointWriter(path, whole, data, limits, system) as writer:
        writer.write(points, data)
    path.write_bytes(whole.getbuffer())


class PointWriter:
    """Writes LAS 1.4 block after block, as :func:`write_points` does.

    Args:
        path: The file, for its extension and for messages.
        stream: Where to write.
        data: Arrays as they will come, with any number of rows.
        limits: Least and largest coordinates, (3,) each; None if there are no points.
        system: The coordinate system of the points, if it is known.
    Raises:
        MissingDependencyError: laspy is not installed, or no backend for .laz.
        InputError: The format cannot hold a name or an array.
    """

    def __init__(
        self,
        path: Path,
        stream: Any,
        data: Mapping[str, NDArray[np.generic]],
        limits: tuple[NDArray[np.float64], NDArray[np.float64]] | None,
        system: CoordinateSystem | None = None,
    ) -> None:
        laspy = _laspy()
        compress = path.suffix.lower() == ".laz"
        if compress:
            _require_backend(laspy, path)
        wanted = tuple(name for name in ("nir", "rgb") if name in data)
        if wanted not in _FORMATS:
            raise InputError("data: .las holds 'nir' only beside 'rgb'; give both, or rename it")
        header = laspy.LasHeader(point_format=_FORMATS[wanted], version="1.4")
        self._known = set(header.point_format.dimension_names) - {*_COLORS, *_POSITION}
        header.offsets, header.scales = _placement(limits)
        extra = [_extra(laspy, name, data[name]) for name in data if name not in self._known and name != "rgb"]
        if extra:
            header.add_extra_dims(extra)
        behind: list[Any] = []
        for number, note, content in system.records if system else ():
            record = laspy.VLR(_PROJECTION, number, note, content)
            (header.vlrs if len(content) <= LONGEST_VLR else behind).append(record)
            header.global_encoding.wkt = header.global_encoding.wkt or number in _WKT
        self._header, self._record, self._behind, self._latest = header, laspy.ScaleAwarePointRecord, behind, 0.0
        self._is_standard = system.standard_time if system else None
        self._writer = laspy.LasWriter(stream, header, do_compress=compress, closefd=False)

    def __enter__(self) -> PointWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            if self._is_standard or (self._is_standard is None and self._latest > WEEK_SECONDS):
                self._writer.header.global_encoding.gps_time_type = _laspy().header.GpsTimeType.STANDARD
            if self._behind:
                self._writer.write_evlrs(_laspy().vlrs.vlrlist.VLRList(self._behind))
            self._writer.close()

    def write(self, points: NDArray[np.float64], data: Mapping[str, NDArray[np.generic]]) -> None:
        """Write some points."""
        record = self._record.zeros(len(points), header=self._header)
        for at, axis in enumerate("XYZ"):
            steps = (points[:, at] - self._header.offsets[at]) / self._header.scales[at]
            record[axis] = np.rint(steps).astype(np.int32)
        for name, values in data.items():
            _fill(record, name, values, exact=name in self._known)
        if "gps_time" in data:
            self._latest = max(self._latest, float(np.max(data["gps_time"], initial=0.0)))
        self._writer.write_points(record)


def _placement(
    limits: tuple[NDArray[np.float64], NDArray[np.float64]] | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Offset and scale of each axis: X * scale + offset is within half a scale of the given coordinate."""
    offsets, scales = np.zeros(3), np.full(3, 1e-3)
    for axis in range(3 if limits else 0):
        assert limits is not None
        lower, upper = float(limits[0][axis]), float(limits[1][axis])
        # Halved first, since the extent of the largest float64 numbers overflows.
        middle, half = 0.5 * lower + 0.5 * upper, 0.5 * upper - 0.5 * lower
        if half == 0.0:
            offsets[axis] = lower
            continue
        exponent = max(int(np.ceil(np.log10(half / LARGEST_STEPS))), SMALLEST_EXPONENT)
        scale = float(f"1e{exponent}")
        steps = middle / scale
        # A whole number of scales, so that decimal coordinates stay the same; beyond 2^53 that is impossible.
        offset = float(np.rint(steps)) * scale if abs(steps) < 2.0**53 else middle
        offsets[axis], scales[axis] = offset, scale
    return offsets, scales


def _extra(laspy: Any, name: str, values: NDArray[np.generic]) -> Any:
    if name in _POSITION + _COLORS or not name.isascii() or not 0 < len(name) <= LONGEST_NAME:
        raise InputError(f"data: '{name}' is taken or cannot be a name in .las (at most 32 ASCII letters); rename it")
    channels = 1 if values.ndim == 1 else values.shape[1]
    if not 1 <= channels <= 3:
        raise InputError(f"data: '{name}' has {channels} columns and .las holds up to 3; write .pcd or .npz")
    kind = {"b": "u1", "f": "f4" if values.dtype.itemsize <= 4 else "f8"}.get(values.dtype.kind, values.dtype.str[1:])
    return laspy.ExtraBytesParams(name, f"{channels if channels > 1 else ''}{kind}")


def _fill(cloud: Any, name: str, values: NDArray[np.generic], *, exact: bool) -> None:
    if name == "rgb":
        values = integer_colors(values, np.uint16)
        if values.shape[1:] != (3,) or values.dtype not in (np.uint8, np.uint16):
            raise InputError(
                f"data: 'rgb' is {values.dtype} of shape {values.shape}; .las holds (N, 3) of uint8, uint16 or shares"
            )
        for at, color in enumerate(_COLORS):
            cloud[color] = values[:, at].astype(np.uint16)
        return
    try:
        cloud[name] = values
        kept = not exact or np.array_equal(np.asarray(cloud[name]), values)
    except (OverflowError, ValueError, TypeError):
        kept = False
    if not kept:
        raise InputError(f"data: '{name}' does not fit into the dimension of this name in .las; rename or convert it")
