"""Stacks of TIFF (.tif, .tiff) by tifffile, in a separate process: OME, ImageJ, BigTIFF, plain pages, one for each z.

Columns are x, rows y, pages z. Voxel sizes are those of OME and ImageJ; other files have none, and voxels 1 long.
Colors (samples) are components; channels and points in time are grids.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit._warn import warn
from geokit.core.files import in_one_line
from geokit.errors import FileAccessError, FileFormatError, MissingDependencyError
from geokit.formats.file_content.references import allowed_folders, require_inside
from geokit.formats.images.image import (
    METERS,
    Image,
    affine,
    fitting_codec,
    grids_of,
    note_of,
    noted,
    one_unit,
    require_straight,
    require_three,
    stored_type,
)
from geokit.formats.images.stream import rows_at_a_time, slabs_in
from geokit.formats.reader import process as reader_process

UNITS = {"µm": "um", "\\u00B5m": "um", "μm": "um", "micron": "um", "microns": "um", "Å": "angstrom", "å": "angstrom"}
TYPES = {"b1": "u1"} | {f"{kind}{size}": f"{kind}{size}" for kind in "ui" for size in (1, 2, 4)}
TYPES |= {"f2": "f4", "f4": "f4", "f8": "f8"}
# It holds no axes but those of the world: others are turned to them, where they are parallel.
STRAIGHT = True
# What the directories say is less.
FACTS_BYTES = 64 << 20
# Axes of tifffile that are z, those that are colors, and those that are grids of their own.
DEPTH, COLORS = "ZIQ", "S"


def prepare() -> None:
    """Import the reader."""
    require_package("tifffile")


def read_grids(path: Path, names: list[str]) -> tuple[Any, list[tuple[str, NDArray[Any]]]]:
    """What the directories say, or the pages with the given numbers (N, Y, X, C), in the separate process.

    Args:
        path: The file.
        names: Numbers of pages, joined by commas, then the folders that references may lead to.
    """
    tifffile = require_package("tifffile")
    said = _Damage()
    logging.getLogger("tifffile").addHandler(said)
    refused = _checked_references(tifffile, path, [Path(folder) for folder in names[1:]])
    with _opened(tifffile, path) as file:
        series = file.series[0]
        if refused:
            raise refused[0]
        if names[0]:
            return None, [("", _pages(path, series, list(map(int, names[0].split(",")))))]
        steps, unit, note = _scale(file)
        facts = {
            "axes": series.axes,
            "sizes": [int(n) for n in series.shape],
            # That of tifffile's arrays; pages in one piece are read without it, in the file's order of bytes.
            "dtype": "" if series.dtype is None else series.dtype.str,
            "order": file.byteorder,
            "steps": steps,
            "unit": unit,
            "note": note,
            "offset": None if series.dataoffset is None else int(series.dataoffset),
            "page": [int(n) for n in series.keyframe.shape],
            "page_count": len(series.pages),
            "others": len(file.series) - 1,
            "palette": series.keyframe.photometric == tifffile.PHOTOMETRIC.PALETTE,
            "compressed": int(series.keyframe.compression) != 1,
        }
    if said.found:  # tags that it has left out may be the voxel size
        raise FileFormatError(f"{path}: has damaged tags ({in_one_line(said.found[0])}); export it again")
    return facts, []


def _opened(tifffile: Any, path: Path) -> Any:
    """The file; pages that tifffile wrote one by one, each noted as an array of its own, are a stack if they fit."""
    file = tifffile.TiffFile(path)
    if not file.is_shaped or len(file.series) == 1 or any(set(one.axes) - {*"YX", *COLORS} for one in file.series):
        return file
    file.close()
    return tifffile.TiffFile(path, is_shaped=False)


def _checked_references(tifffile: Any, path: Path, folders: list[Path]) -> list[FileAccessError]:
    """Have tifffile, which follows names in OME and other metadata, open only files that are allowed.

    Returns:
        Gets the errors, which tifffile keeps: it takes the pages of such a file for zeros.
    """
    refused: list[FileAccessError] = []
    plain = tifffile.TiffFile.__init__

    def checked(self: Any, file: Any, *args: Any, **more: Any) -> None:
        if file is not path:
            try:
                require_inside(os.path.relpath(file, path.parent), Path(file), path, folders)
            except FileAccessError as error:
                refused.append(error)
                raise
        plain(self, file, *args, **more)

    tifffile.TiffFile.__init__ = checked
    return refused


class _Damage(logging.Handler):
    """Collects what tifffile says of tags that it could not read."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.found: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if "TiffFileError" in text or record.levelno >= logging.ERROR:
            self.found.append(text)


def _ask(path: Path, pages: str, limit: int) -> tuple[Any, list[tuple[str, NDArray[Any]]]]:
    return reader_process.read_grids(path, __name__, limit, [pages, *map(str, allowed_folders(None))])


def open_images(path: Path, limit: int) -> list[Image]:
    """Read the directories of all pages."""
    facts, _ = _ask(path, "", FACTS_BYTES)
    axes, sizes, page_count, contiguous = facts["axes"], facts["sizes"], facts["page_count"], facts["offset"]
    dtype = np.dtype(facts["dtype"]) if facts["dtype"] else None
    page_shape, note = tuple(facts["page"]), facts["note"]
    if dtype is None or dtype.kind not in "fiub":
        raise FileFormatError(f"{path}: holds {dtype} in a pixel; convert them to real numbers")
    stored = dtype.newbyteorder(facts["order"])
    depth = next((axis for axis in DEPTH if axis in axes), "")
    if not depth:  # a series of anything is a stack if it is the only axis
        others = [axis for axis in axes if axis not in "YX" + COLORS]
        depth = others[0] if len(others) == 1 and others[0] not in "CT" else ""
    sizes_of = dict(zip(axes, sizes, strict=True))
    colors = sizes_of.get(COLORS, 1)
    if "Y" not in axes or "X" not in axes or len(sizes_of) != len(axes) or colors not in (1, 3, 4):
        raise FileFormatError(
            f"{path}: has the axes {axes} of sizes {sizes}; geokit reads stacks of Z, Y, X and colors"
        )
    grids = [axis for axis in axes if axis not in depth + "YX" + COLORS]
    if facts["others"]:
        warn(f"{path}: only its first stack of pages of one size and type is read, not the other {facts['others']}")
    if facts["palette"]:
        warn(f"{path}: its palette of colors is left out; voxels have the numbers of the colors")
    shape = require_three(path, (sizes_of["X"], sizes_of["Y"], sizes_of.get(depth, 1)))
    count = int(np.prod([sizes_of[axis] for axis in grids], dtype=object))
    # The pages, by grid and z; those in one piece are read without tifffile.
    page_axes = [axis for axis in axes if axis not in "YX" + COLORS]
    planar = COLORS in axes and axes.index(COLORS) < axes.index("Y")
    pages = int(np.prod([sizes_of[axis] for axis in page_axes], dtype=object))
    if planar or axes.index("Y") > axes.index("X") or page_axes != list(axes[: len(page_axes)]):
        raise FileFormatError(f"{path}: has the axes {axes}; save colors last, and x after y")
    if contiguous is None and (page_count != pages or page_shape[:2] != (shape[1], shape[0])):
        raise FileFormatError(f"{path}: has {page_count} pages of {page_shape}, not {pages}; save it as plain pages")
    table = np.arange(min(pages, max(page_count, 1) if contiguous is None else pages))
    order = table.reshape([sizes_of[axis] for axis in page_axes]) if page_axes else table.reshape(1)
    if depth:
        order = np.moveaxis(order, page_axes.index(depth), -1)
    order = order.reshape(count, shape[2])

    def slabs(grid: int) -> Iterator[NDArray[Any]]:
        size = int(np.prod([shape[0], shape[1], colors], dtype=object)) * dtype.itemsize
        step = rows_at_a_time(size)
        if contiguous is not None:
            # Pages that follow each other are read at once.
            for run in np.split(order[grid], np.flatnonzero(np.diff(order[grid]) != 1) + 1):
                place: Any = {"offset": contiguous, "skip": int(run[0]) * size}
                yield from slabs_in(path, stored, (*shape[:2], len(run), colors), **place)
            return
        for first in range(0, shape[2], step):
            rows = order[grid][first : first + step]
            ((_, pages),) = _ask(path, ",".join(map(str, rows.tolist())), len(rows) * size)[1]
            if pages.dtype != dtype or pages.size != len(rows) * size // dtype.itemsize:
                raise FileFormatError(f"{path}: has pages of {pages.dtype} {pages.shape[1:]}; all need to be alike")
            yield pages.reshape(len(rows), shape[1], shape[0], colors).transpose(2, 1, 0, 3)

    image = Image(
        shape=shape,
        dtype=dtype,
        transform=_transform(facts["steps"], note),
        components=colors,
        unit=str(note.get("unit", facts["unit"])),
        space=str(note.get("space", "")),
        packed=facts["compressed"] or contiguous is None,
        note=note,
    )
    return grids_of(path, image, count, slabs)


def _pages(path: Path, series: Any, rows: list[int]) -> NDArray[Any]:
    found = []
    for row in rows:
        page = series.pages[row]
        try:
            found.append(np.zeros(series.keyframe.shape, series.dtype) if page is None else page.asarray())
        except ValueError as error:
            if "imagecodecs" not in str(error):
                raise
            what = f"{path}: is compressed with {page.compression.name}, which needs the package imagecodecs"
            raise MissingDependencyError(f"{what}; install it with: pip install imagecodecs") from None
    return np.stack(found)


def _scale(file: Any) -> tuple[list[float], str, dict[str, Any]]:
    """Voxel size, its unit, and geokit's note."""
    steps, unit = [1.0, 1.0, 1.0], ""
    note: dict[str, Any] = {}
    text = file.ome_metadata
    if text is not None:
        pixels = re.search(r"<(?:\w+:)?Pixels\b[^>]*>", text)
        found = dict(re.findall(r'\b(PhysicalSize[XYZ](?:Unit)?)="([^"]*)"', pixels.group(0) if pixels else ""))
        steps = [float(found.get(f"PhysicalSize{axis}", 1.0)) for axis in "XYZ"]
        known = [at for at, axis in enumerate("XYZ") if f"PhysicalSize{axis}" in found]
        units = [found.get(f"PhysicalSize{'XYZ'[at]}Unit", "um") for at in known]
        factors, unit = one_unit(Path(file.filename), [UNITS.get(text, text) for text in units])
        for at, factor in zip(known, factors.tolist(), strict=True):
            steps[at] *= factor
        described = re.search(r"<(?:\w+:)?Description>([^<]*)<", text)
        note = note_of(described.group(1).replace("&quot;", '"')) if described else {}
    elif (facts := file.imagej_metadata) is not None:
        unit = str(facts.get("unit", ""))
        tags = file.pages[0].tags
        for at, name in enumerate(("XResolution", "YResolution")):
            top, below = tags[name].value if name in tags else (1, 1)
            steps[at] = below / top if top and below else 1.0
        steps[2] = float(facts.get("spacing", 1.0))
        if not unit:
            steps[:2] = [1.0, 1.0]
    unit = UNITS.get(unit, unit)
    if not all(np.isfinite(step) and step > 0.0 for step in steps):
        raise FileFormatError(f"{file.filename}: has the voxel size {steps}; correct it, or save it without")
    return steps, unit if unit in METERS else "", note


def _transform(steps: list[float], note: dict[str, Any]) -> NDArray[np.float64]:
    """Voxel sizes, and the origin that geokit has noted."""
    origin = np.asarray(note.get("place", (0.0, 0.0, 0.0)), object)
    known = origin.shape == (3,) and all(isinstance(one, (int, float)) for one in origin)
    return affine(np.diag(steps), origin.astype(np.float64) if known else np.zeros(3))


def write_image(path: Path, image: Image, codec: str | None) -> None:
    """Write one OME page for each z, with the voxel size; only geokit reads the place of the first voxel again."""
    tifffile = require_package("tifffile")
    zipped = fitting_codec(path, codec, ("zip", "none")) == "zip"
    dtype = stored_type(path, image.dtype, TYPES)
    spacing = require_straight(path, image.transform, turned=False)
    x, y, z = image.shape
    colors = (image.components,) if image.components > 1 else ()
    note = noted({**image.note, "place": image.transform[:3, 3].tolist(), "space": image.space, "unit": image.unit})
    facts: dict[str, Any] = {"axes": "ZYX" + "S" * len(colors), "Description": note}
    for axis, step in zip("XYZ", spacing.tolist(), strict=True):
        facts[f"PhysicalSize{axis}"] = step
        if image.unit:
            facts[f"PhysicalSize{axis}Unit"] = {"um": "µm", "angstrom": "Å"}.get(image.unit, image.unit)

    def pages() -> Iterator[NDArray[Any]]:
        for planes in image.planes(dtype):
            yield from planes

    big = image.byte_count > (1 << 32) - (32 << 20)
    kind = "rgb" if image.components > 1 and dtype.kind == "u" else "minisblack"
    with tifffile.TiffWriter(path, bigtiff=big, ome=True) as file:
        file.write(
            pages(),
            shape=(z, y, x, *colors),
            dtype=dtype,
            photometric=kind,
            compression="zlib" if zipped else None,
            metadata=facts,
            **({"planarconfig": "contig"} if colors else {}),
            **({"extrasamples": ["unspecified"]} if image.components == 4 else {}),
        )
