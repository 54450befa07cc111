"""Scans of terrestrial scanners (.e57) through pye57, whose libE57Format reads in a separate process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit._warn import warn
from geokit.core.files import in_one_line
from geokit.core.memory.row_products import row_product
from geokit.errors import FileFormatError
from geokit.formats.columns import Columns
from geokit.formats.scene_content.gltf_shapes import turn_of

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
# Not 0 where a pulse has no echo, or only a direction.
_INVALID = ("cartesianInvalidState", "sphericalInvalidState")
_NORMALS = ("nor:normalX", "nor:normalY", "nor:normalZ")
_COLORS = ("colorRed", "colorGreen", "colorBlue")
# No color has a limit beyond this.
WIDEST = 65535
_SIGNATURE = b"ASTM-E57"
# Names of scans in a message.
_SHOWN = 10


def prepare() -> None:
    """Import libE57Format."""
    require_package("pye57")


def read_points(path: Path) -> tuple[NDArray[np.float64], Columns]:
    """Read the points of all scans, each at its pose, with their numbers by name.

    Points that the file declares invalid are left out. Coordinates and scaled integers are float64, other numbers have
    the file's type. ``rgb`` (N, 3) is uint8 or uint16, or shares of full where the file has floats, full at its limits
    of colors; ``normals`` turn with the pose, and ``scan`` is the number of the scan where there are several. Images,
    names of several scans, and what not all scans with points have, are left out with a warning.

    Raises:
        FileFormatError: The file is damaged, or holds no scan.
    """
    with open(path, "rb") as file:
        if file.read(len(_SIGNATURE)) != _SIGNATURE:
            raise FileFormatError(f"{path}: does not start with 'ASTM-E57'; the file is damaged or not an .e57 file")
    libe57 = require_package("pye57").libe57
    try:
        file = libe57.ImageFile(str(path), "r")
        pictures = file.root()["images2D"].childCount() if file.root().isDefined("images2D") else 0
        listed = file.root()["data3D"] if file.root().isDefined("data3D") else ()
        scans = [_scan(libe57, file, listed[at]) for at in range(len(listed))]
        names = [str(listed[at]["name"].value()) if listed[at].isDefined("name") else "" for at in range(len(listed))]
    except libe57.E57Exception as error:
        # What follows is for developers of the library.
        reason = in_one_line(str(error).partition("****")[0])
        raise FileFormatError(f"{path}: cannot be read ({reason}); the file is damaged, get a whole copy") from None
    if not scans:
        raise FileFormatError(f"{path}: holds no scan; export the points themselves")
    points = np.concatenate([found for found, _ in scans])
    # A scan without points lacks nothing.
    columned = [data for found, data in scans if len(found)] or [scans[0][1]]
    shared = [name for name in columned[0] if all(name in data for data in columned)]
    left = sorted({name for data in columned for name in data} - set(shared))
    if left:
        warn(f"not all scans have {', '.join(left)}; left out")
    if pictures:
        warn(f"its {'image is' if pictures == 1 else f'{pictures} images are'} left out")
    if len(scans) > 1 and any(names):
        listed_names = ", ".join(f"{number} {name!r}" for number, name in enumerate(names[:_SHOWN]))
        warn(f"the names of its scans are left out, whose numbers are in 'scan': {in_one_line(listed_names)}")
    parts = {name: [data[name] for data in columned] for name in shared}
    if "rgb" in parts:
        parts["rgb"] = _alike(parts["rgb"])
    columns: Columns = {name: np.concatenate(found) for name, found in parts.items()}
    if len(scans) > 1:
        columns["scan"] = np.repeat(np.arange(len(scans), dtype=np.int32), [len(found) for found, _ in scans])
    return points, columns


def _scan(libe57: Any, file: Any, scan: Any) -> tuple[NDArray[np.float64], Columns]:
    """The valid points of one scan at its pose, and their columns."""
    points = scan["points"]
    prototype = libe57.StructureNode(points.prototype())
    raw: Columns = {}
    kinds: dict[str, Any] = {}
    limits: dict[str, tuple[float, float]] = {}
    buffers = libe57.VectorSourceDestBuffer()
    for at in range(prototype.childCount()):
        node = prototype[prototype.get(at).elementName()]
        kind = _type(libe57, node)
        if kind is not None:
            name = node.elementName()
            # pye57 takes C's int for nothing, and its long for 32 bits; only long long is what it is.
            wide = kind in (np.int32, np.int64)
            raw[name] = np.zeros(points.childCount(), np.longlong if wide else kind)
            kinds[name] = kind
            buffers.append(libe57.SourceDestBuffer(file, name, raw[name], len(raw[name]), True, True))
            if name in _COLORS:
                limits[name] = _limits(scan, node, name)
    if raw and points.childCount():
        reader = points.reader(buffers)
        got = reader.read()
        reader.close()
        if got != points.childCount():
            raise FileFormatError(f"ends in point {got} of the {points.childCount()} it declares; get a whole copy")
    raw = {name: values.astype(kinds[name], copy=False) for name, values in raw.items()}
    if set(_CARTESIAN) <= raw.keys():
        xyz = np.stack([raw.pop(name).astype(np.float64) for name in _CARTESIAN], axis=1)
    elif set(_SPHERICAL) <= raw.keys():
        reach, azimuth, elevation = (raw.pop(name).astype(np.float64) for name in _SPHERICAL)
        flat = reach * np.cos(elevation)
        xyz = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), reach * np.sin(elevation)], axis=1)
    else:
        raise FileFormatError(f"a scan has no coordinates; its columns are {in_one_line(', '.join(raw))}")
    valid = np.ones(len(xyz), bool)
    for name in _INVALID:
        if name in raw:
            valid &= raw.pop(name) == 0
    for name in _SPHERICAL + _CARTESIAN:
        raw.pop(name, None)
    turn, shift = _pose(scan)
    columns: Columns = {name: values[valid] for name, values in raw.items()}
    for name, parts in (("normals", _NORMALS), ("rgb", _COLORS)):
        if set(parts) <= columns.keys():
            joined = np.stack([columns.pop(part) for part in parts], axis=1)
            columns[name] = (
                row_product(joined, turn.T)
                if name == "normals"
                else _full_at(joined, np.array([limits[part] for part in parts], np.float64))
            )
    return row_product(xyz[valid], turn.T, shift), columns


def _type(libe57: Any, node: Any) -> Any:
    """NumPy's type for a column; None for text."""
    if isinstance(node, libe57.IntegerNode):
        least, most = node.minimum(), node.maximum()
        return next((kind for kind in (np.int8, np.uint8, np.int16, np.uint16, np.int32)
                     if np.iinfo(kind).min <= least and most <= np.iinfo(kind).max), np.int64)  # fmt: skip
    if isinstance(node, libe57.FloatNode):
        return np.float32 if node.precision() == libe57.E57_SINGLE else np.float64
    return np.float64 if isinstance(node, libe57.ScaledIntegerNode) else None


def _limits(scan: Any, node: Any, name: str) -> tuple[float, float]:
    """The values of a color that mean none and full: those of the scan, or those that its column can have."""
    if scan.isDefined("colorLimits"):
        ends = [f"{name}{end}" for end in ("Minimum", "Maximum")]
        if all(scan["colorLimits"].isDefined(end) for end in ends):
            low, high = (scan["colorLimits"][end] for end in ends)
            return tuple(  # type: ignore[return-value]
                float(end.scaledValue() if hasattr(end, "scaledValue") else end.value()) for end in (low, high)
            )
    scaled = hasattr(node, "scaledMinimum")
    return float(node.scaledMinimum() if scaled else node.minimum()), float(
        node.scaledMaximum() if scaled else node.maximum()
    )


def _full_at(colors: NDArray[Any], limits: NDArray[np.float64]) -> NDArray[Any]:
    """Colors as uint8 or uint16, or as shares where they are floats, full at the upper limits."""
    low, high = limits.T
    if colors.dtype.kind == "f":
        # A file that tells no limits has those of its type.
        known = (low >= -WIDEST).all() and (high <= WIDEST).all() and (high > low).all()
        return (colors - low) / (high - low) if known and ((low != 0.0) | (high != 1.0)).any() else colors
    least, most = (colors.min(initial=0), colors.max(initial=0))
    for kind in (np.uint8, np.uint16):
        full = np.iinfo(kind).max
        told = not low.any() and (high == full).all()
        # Limits that no color has are those of the type of the column.
        if least >= 0 and most <= full and (told or (high > WIDEST).any()):
            return colors.astype(kind)
    if not (high > low).all():
        return colors
    shares = np.clip((colors - low) / (high - low), 0.0, 1.0)
    return np.rint(shares * np.iinfo(np.uint16).max).astype(np.uint16)


def _alike(parts: list[NDArray[Any]]) -> list[NDArray[Any]]:
    """Colors of several scans with one number for full."""
    kinds = {part.dtype for part in parts}
    if len(kinds) == 1:
        return parts
    if any(kind.kind == "f" for kind in kinds):
        return [part if part.dtype.kind == "f" else part / float(np.iinfo(part.dtype).max) for part in parts]
    return [part.astype(np.uint16) * np.uint16(257) if part.dtype == np.uint8 else part for part in parts]


def _pose(scan: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The rotation matrix and the translation of a scan."""

    def numbers(name: str, parts: str, default: tuple[float, ...]) -> NDArray[np.float64]:
        if not scan.isDefined(f"pose/{name}"):
            return np.array(default)
        found = scan["pose"][name]
        return np.array([found[part].value() for part in parts], np.float64)

    quaternion = numbers("rotation", "wxyz", (1.0, 0.0, 0.0, 0.0))
    length = float(np.linalg.norm(quaternion))
    if not length > 0.0:
        raise FileFormatError("the rotation of a scan's pose is zero; export it again")
    return turn_of(*quaternion / length), numbers("translation", "xyz", (0.0, 0.0, 0.0))
