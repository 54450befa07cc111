"""DICOM by pydicom: a folder with the slices of one or several series, or one .dcm file.

Lengths are in mm, the world in LPS: x to the left, y to the back, z up.

Slices are sorted by their positions, which need to be evenly spaced. Values are rescaled as the files say (Hounsfield
units), also where these are shown inverted (MONOCHROME1). Pixels need to be uncompressed or run-length coded, which
pydicom decodes by itself, and to be no indices.
"""

from __future__ import annotations

import io
import logging
import os
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.core.files import in_one_line
from geokit.errors import FileFormatError
from geokit.formats.file_content.references import allowed_folders, require_inside
from geokit.formats.images.image import Image, affine, grids_of, reading, scaled

# The transfer syntax "RLE Lossless".
RLE = "1.2.840.10008.1.2.5"
# pydicom reads this much and less without knowing that it is there [bytes].
PIECE = 1 << 16
# Slices may lie this share of their distance beside their even places.
LARGEST_JITTER = 0.02
# What pydicom reads of a header.
_TAGS = [
    "SeriesInstanceUID", "SeriesDescription", "InstanceNumber", "Rows", "Columns", "SamplesPerPixel", "BitsAllocated",
    "BitsStored", "PixelRepresentation", "NumberOfFrames", "PixelSpacing", "ImageOrientationPatient",
    "ImagePositionPatient", "SliceThickness", "RescaleSlope", "RescaleIntercept", "PixelPaddingValue",
    "PerFrameFunctionalGroupsSequence", "SharedFunctionalGroupsSequence", "PhotometricInterpretation",
    "ModalityLUTSequence",
]  # fmt: skip


class _Held(io.BufferedReader):
    """An open file that is refused where an element is longer than what is left: pydicom takes memory for it first."""

    def __init__(self, file: Path) -> None:
        super().__init__(io.FileIO(file))
        self._file, self._size = file, os.fstat(self.fileno()).st_size

    def _require(self, end: int) -> None:
        if end > self._size:
            raise FileFormatError(f"{self._file}: ends {end - self._size} bytes too early; get a whole copy")

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > PIECE:
            self._require(self.tell() + size)
        return super().read(size)

    def seek(self, place: int, whence: int = 0, /) -> int:
        if whence == os.SEEK_SET:
            self._require(place)
        return super().seek(place, whence)


class _Slice(NamedTuple):
    """One slice: its file, its number in it, and what its header says."""

    file: Path
    frame: int | None
    number: int
    position: NDArray[np.float64]
    axes: NDArray[np.float64]
    spacing: NDArray[np.float64]
    thickness: float
    slope: float
    shift: float
    size: tuple[int, int, int]
    dtype: np.dtype[Any]
    stored: tuple[int, int]
    padding: int | None


def open_images(path: Path, limit: int) -> list[Image]:
    """Read the headers of all files."""
    pydicom = require_package("pydicom")
    # With a handler of its own it prints nothing.
    logging.getLogger("pydicom").addHandler(logging.NullHandler())
    series: dict[str, list[_Slice]] = defaultdict(list)
    names: dict[str, str] = {}
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if not file.is_file() or file.name.upper() == "DICOMDIR":
            continue
        if file != path:  # a link of the folder, in it or in one that is allowed
            require_inside(file.name, file, path, (path, *allowed_folders(None)))
        with reading(file), _Held(file) as opened:
            try:
                # For itself: of the deflated syntax dcmread decompresses all, to any size.
                pydicom.filereader.read_preamble(opened, False)
                meta = pydicom.filereader.read_dataset(opened, False, True, stop_when=lambda tag, *_: tag >> 16 != 2)
                syntax = meta.get("TransferSyntaxUID")
            except pydicom.errors.InvalidDicomError:
                if not _is_bare(file):
                    continue  # other files lie in such folders too
                syntax = None
            if syntax is not None and ((syntax.is_encapsulated and syntax != RLE) or syntax.is_deflated):
                remedy = "decompress it first, for example with gdcmconv --raw"
                raise FileFormatError(f"{path}: {file.name} is compressed ({in_one_line(str(syntax.name))}); {remedy}")
            opened.seek(0)
            header = pydicom.dcmread(opened, stop_before_pixels=True, specific_tags=_TAGS, force=True)
            if "Rows" not in header:
                continue  # reports and presentations
            key = str(header.get("SeriesInstanceUID", ""))
            names.setdefault(key, in_one_line(str(header.get("SeriesDescription", "") or ""), 100))
            series[key] += _slices(header, file, path)
    if not series:
        raise FileFormatError(f"{path}: holds no DICOM images; name a file, or a folder of slices")
    found = []
    for key, slices in series.items():
        with reading(path):
            found += _grids(slices, names[key], path, pydicom)
    return found


def _is_bare(file: Path) -> bool:
    """Whether a file begins with a tag of the group 8, as old scanners write them, not with a preamble and DICM."""
    with open(file, "rb") as opened:
        head = opened.read(8)
    little, big = (int.from_bytes(head[:2], order) for order in ("little", "big"))
    return len(head) == 8 and 8 in (little, big)


def _pixels(one: _Slice, pydicom: Any) -> NDArray[Any]:
    with _Held(one.file) as opened:
        if not _is_bare(one.file):
            return np.asarray(pydicom.pixels.pixel_array(opened, index=one.frame))
        whole = pydicom.dcmread(opened, force=True)
    uid = pydicom.uid
    by_order = uid.ImplicitVRLittleEndian if whole.original_encoding[0] else uid.ExplicitVRLittleEndian
    whole.file_meta.TransferSyntaxUID = by_order if whole.original_encoding[1] else uid.ExplicitVRBigEndian
    return np.asarray(pydicom.pixels.pixel_array(whole, index=one.frame))


def _slices(header: Any, file: Path, path: Path) -> Iterator[_Slice]:
    def group(frame: Any, shared: Any, sequence: str, name: str) -> Any:
        for place in (frame, shared):
            if place is not None and sequence in place and name in (item := place[sequence][0]):
                return item[name].value
        return header.get(name)

    if header.get("ModalityLUTSequence"):
        raise FileFormatError(
            f"{path}: {file.name} has values by a table (Modality LUT), which is not read; apply that"
        )
    if header.get("PhotometricInterpretation") == "PALETTE COLOR":
        raise FileFormatError(f"{path}: {file.name} has colors by a palette, which is not read; convert it to RGB")
    bits, signed = int(header.BitsAllocated), int(header.get("PixelRepresentation", 0))
    if bits not in (8, 16, 32):
        raise FileFormatError(f"{path}: {file.name} has {bits} bits for a pixel; geokit reads 8, 16 and 32")
    stored = int(header.get("BitsStored", bits)) - signed
    low, high = (-(1 << stored) if signed else 0), (1 << stored) - 1
    frames = header.get("PerFrameFunctionalGroupsSequence")
    shared = (header.get("SharedFunctionalGroupsSequence") or [None])[0]
    for at, frame in enumerate(frames or [None]):
        position = group(frame, shared, "PlanePositionSequence", "ImagePositionPatient")
        axes = group(frame, shared, "PlaneOrientationSequence", "ImageOrientationPatient")
        spacing = group(frame, shared, "PixelMeasuresSequence", "PixelSpacing")
        if (
            position is None
            or axes is None
            or spacing is None
            or (frames is None and int(header.get("NumberOfFrames") or 1) > 1)
        ):
            raise FileFormatError(f"{path}: {file.name} does not say where its slices lie (ImagePositionPatient)")
        thickness = group(frame, shared, "PixelMeasuresSequence", "SliceThickness")
        slope = group(frame, shared, "PixelValueTransformationSequence", "RescaleSlope")
        shift = group(frame, shared, "PixelValueTransformationSequence", "RescaleIntercept")
        padding = header.get("PixelPaddingValue")
        yield _Slice(
            file,
            None if frames is None else at,
            int(header.get("InstanceNumber") or 0) + at,
            np.array(position, np.float64),
            np.array(axes, np.float64).reshape(2, 3),
            np.array(spacing, np.float64),
            float(thickness) if thickness is not None and float(thickness) > 0.0 else 1.0,
            1.0 if slope is None else float(slope),
            0.0 if shift is None else float(shift),
            (int(header.Columns), int(header.Rows), int(header.get("SamplesPerPixel", 1))),
            np.dtype(f"{'i' if signed else 'u'}{bits // 8}"),
            (low, high),
            padding if isinstance(padding, int) else None,
        )


def _grids(slices: list[_Slice], name: str, path: Path, pydicom: Any) -> list[Image]:
    """The grids of a series: several if several slices lie at each place (points in time)."""
    first = slices[0]
    for one in slices[1:]:
        alike = one.size == first.size and one.dtype == first.dtype
        if not alike or not np.allclose(one.axes, first.axes, atol=1e-3) or not np.allclose(one.spacing, first.spacing):
            raise FileFormatError(f"{path}: {one.file.name} has another size or direction than {first.file.name}")
    normal = np.cross(first.axes[0], first.axes[1])
    along = np.array([one.position @ normal for one in slices])
    order = np.lexsort((np.array([one.number for one in slices]), np.round(along, 3)))
    count = int(np.sum(np.abs(along - along.min()) < 1e-3))
    if len(slices) % count:
        raise FileFormatError(
            f"{path}: has {len(slices)} slices, {count} of them at one place; put each series in a folder"
        )
    table = np.array(order).reshape(-1, count)
    places = np.array([slices[row[0]].position for row in table])
    step = normal * first.thickness if len(places) == 1 else (places[-1] - places[0]) / (len(places) - 1)
    away = np.abs(places - (places[0] + np.arange(len(places))[:, None] * step)).max()
    if away > LARGEST_JITTER * np.linalg.norm(step):
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
        raise FileFormatError(
            f"{path}: slices lie {steps.min():.4g} to {steps.max():.4g} mm apart; one is missing, or "
            "there are several series"
        )
    whole = all(one.slope == 1.0 and one.shift == round(one.shift) for one in slices)
    low = min(one.stored[0] + one.shift for one in slices)
    high = max(one.stored[1] + one.shift for one in slices)
    same = all((one.slope, one.shift) == (1.0, 0.0) for one in slices)
    kind = first.dtype if same else np.dtype(np.float64)
    if whole and not same:
        kind = np.dtype(np.int16 if low >= -(1 << 15) and high < 1 << 15 else np.int32)

    def slabs(grid: int) -> Iterator[NDArray[Any]]:
        for row in table[:, grid]:
            one = slices[row]
            with reading(one.file):
                pixels = _pixels(one, pydicom)
                if pixels.size != np.prod(one.size) or pixels.dtype.kind not in "iu":
                    raise FileFormatError(f"{path}: {one.file.name} holds {pixels.shape} pixels, not {one.size[1::-1]}")
                values = scaled(pixels.reshape(one.size[1], one.size[0], one.size[2]), one.slope, one.shift)
                if kind.kind == "i" and not same and not (low <= values.min() and values.max() <= high):
                    raise FileFormatError(f"{path}: {one.file.name} has pixels beyond its BitsStored; it is damaged")
            yield values.astype(kind).transpose(1, 0, 2)[:, :, None]

    columns = np.stack([first.axes[0] * first.spacing[1], first.axes[1] * first.spacing[0], step], axis=1)
    image = Image(
        shape=(first.size[0], first.size[1], len(table)),
        dtype=kind,
        transform=affine(columns, places[0]),
        components=first.size[2],
        name=name,
        unit="mm",
        space="LPS",
        background=None if first.padding is None else first.padding * first.slope + first.shift,
    )
    return grids_of(path, image, count, slabs)
