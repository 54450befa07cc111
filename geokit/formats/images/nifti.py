"""NIfTI-1 and -2 (.nii, .nii.gz): the header by nibabel. The world is in RAS: x to the right, y to the front, z up.

Of a file with neither a qform nor an sform it is not known where the axes point.
A fourth dimension (time) makes several grids, a fifth (vectors) components. Values are scaled as the header says.
"""

from __future__ import annotations

import gzip
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.core.files import extension
from geokit.errors import FileFormatError
from geokit.formats.images.image import (
    Image,
    affine,
    fitting_codec,
    grids_of,
    in_space,
    in_unit,
    note_of,
    noted,
    reading,
    require_three,
    scaled,
    stored_type,
)
from geokit.formats.images.stream import packed_writer, slabs_in
from geokit.formats.reader.warnings import warn_of

# Header and extensions are within this.
HEAD_BYTES = 1 << 20
UNITS = {"meter": "m", "mm": "mm", "micron": "um"}
# Types that are stored as another one.
TYPES = {"b1": "<u1", "f2": "<f4"} | {f"{kind}{size}": f"<{kind}{size}" for kind in "ui" for size in (1, 2, 4, 8)}
TYPES |= {"f4": "<f4", "f8": "<f8"}
# Extensions with plain text have this code.
COMMENT = 6
LARGEST_SIDE = 32767
# Where voxels begin at the earliest, in NIfTI-1 and -2: behind the header and four bytes.
LEAST_OFFSETS = (352, 544)
# Square of the length of a half turn's quaternion, with some roundings of float32.
LONGEST_TURN = 1.0 + 1e-5


def open_images(path: Path, limit: int) -> list[Image]:
    """Read the header."""
    nibabel = require_package("nibabel")
    packed = extension(path) == ".nii.gz"
    with reading(path):
        with gzip.open(path) if packed else open(path, "rb") as file:
            head = io.BytesIO(file.read(HEAD_BYTES))
        (size,) = np.frombuffer(head.getvalue()[:4], "<i4")
        second = size in (540, int(np.int32(540).byteswap()))
        if not second and size not in (348, int(np.int32(348).byteswap())):
            raise FileFormatError(f"{path}: is no NIfTI file (its header has the size {size}); check the extension")
        kind = nibabel.Nifti2Header if second else nibabel.Nifti1Header
        header = kind.from_fileobj(head, check=False)
        if bytes(header["magic"])[:3] not in (b"n+1", b"n+2"):
            raise FileFormatError(f"{path}: has its voxels in another file or is damaged; save it as one .nii again")
        _repair(header)
        sizes = [int(n) for n in header.get_data_shape()]
        sizes += [1] * (7 - len(sizes))
        dtype = header.get_data_dtype()
        offset, least = float(header["vox_offset"]), LEAST_OFFSETS[second]
        if not least <= offset < 2.0**62:
            raise FileFormatError(
                f"{path}: says that its voxels begin at byte {offset:g}, and its header ends at {least}; set vox_offset"
            )
        offset = int(offset)
        slope, shift = header.get_slope_inter()
        turned = int(header["sform_code"]) > 0 or int(header["qform_code"]) > 0
        matrix = np.array(header.get_best_affine() if turned else _by_method_1(header), np.float64)
        unit = UNITS.get(header.get_xyzt_units()[0], "") if int(header["xyzt_units"]) & 7 in (1, 2, 3) else ""
        notes = [note_of(_text(one)) for one in header.extensions]
        note = next(filter(None, notes), {})
    if others := notes.count({}):
        warn_of(path, [f"{others} extensions of its header are left out"])
    shape, frames, vectors = require_three(path, sizes[:3]), sizes[3], sizes[4]
    colors = len(dtype.fields or ())
    stored = np.dtype(next(iter(dtype.fields.values()))[0]) if dtype.fields else dtype
    if max(sizes[5:]) > 1 or min(sizes) < 1 or (colors and vectors > 1):
        raise FileFormatError(f"{path}: has the size {tuple(sizes)}; geokit reads x, y, z, time and vectors")
    if stored.kind not in "fiub" or stored.itemsize > 8:
        raise FileFormatError(f"{path}: holds {dtype} in a voxel; convert them to real numbers of at most 64 bits")
    factor, term = (1.0 if slope is None else float(slope)), (0.0 if shift is None else float(shift))
    if not (np.isfinite(factor) and np.isfinite(term)):
        raise FileFormatError(f"{path}: has the slope {factor} and the intercept {term}; the file is damaged")
    plane = int(np.prod(shape, dtype=object)) * dtype.itemsize

    def slabs(grid: int) -> Iterator[NDArray[Any]]:
        def part(number: int) -> Iterator[NDArray[Any]]:
            begin = offset + number * plane
            place: Any = {"skip": begin, "packing": "gzip"} if packed else {"offset": begin}
            return slabs_in(path, stored, (*shape, max(1, colors)), **place)

        if vectors == 1:
            yield from (scaled(slab, factor, term) for slab in part(grid))
        else:  # one component after another
            parts = [np.concatenate([slab[..., 0] for slab in part(grid + frames * at)], 2) for at in range(vectors)]
            yield scaled(np.stack(parts, axis=-1), factor, term)

    image = Image(
        shape=shape,
        dtype=stored if (factor, term) == (1.0, 0.0) else np.dtype(np.float64),
        transform=matrix,
        components=max(colors, vectors),
        unit=unit,
        space=str(note.get("space", "RAS" if turned else "")),
        packed=packed,
        note=note,
    )
    return grids_of(path, image, frames, slabs)


def _repair(header: Any) -> None:
    """Set what other readers set: directions of 0, sizes of 0, and half turns that are a few roundings too long."""
    steps, sizes = header["pixdim"], header["dim"]
    steps[0] = -1.0 if steps[0] < 0.0 else 1.0
    sizes[1:] = np.where(sizes[1:] == 0, 1, sizes[1:])
    names = ("quatern_b", "quatern_c", "quatern_d")
    turn = np.array([header[name] for name in names], np.float64)
    square = float(turn @ turn)
    if 1.0 < square < LONGEST_TURN:
        for name, value in zip(names, turn / np.sqrt(square), strict=True):
            header[name] = value


def _by_method_1(header: Any) -> NDArray[np.float64]:
    """Steps along the axes from the first voxel at 0, as the standard says of files without a place.

    nibabel turns x round, and puts the middle at 0.
    """
    steps = np.abs(np.array(header["pixdim"][1:4], np.float64))
    return affine(np.diag(np.where(steps > 0.0, steps, 1.0)), np.zeros(3))


def _text(extension: Any) -> str:
    content = extension.get_content()
    text = content.decode("utf-8", "replace") if isinstance(content, bytes) else str(content)
    return text.rstrip("\0")


def write_image(path: Path, image: Image, codec: str | None) -> None:
    """Write voxels, place (in float32, in RAS) and unit."""
    nibabel = require_package("nibabel")
    packed = extension(path) == ".nii.gz"
    fitting_codec(path, codec, ("zip",) if packed else ("none",))
    dtype = stored_type(path, image.dtype, TYPES)
    header = (nibabel.Nifti2Header if max(image.shape) > LARGEST_SIDE else nibabel.Nifti1Header)()
    header.set_data_dtype(dtype)
    unit = image.unit if image.unit in UNITS.values() else "mm" if image.unit else ""
    header.set_data_shape(image.shape if image.components == 1 else (*image.shape, 1, image.components))
    if image.components > 1:
        header.set_intent("vector")
    matrix = in_unit(in_space(image.transform, image.space, "RAS"), image.unit, unit)
    header.set_qform(matrix, 2, strip_shears=True)
    header.set_sform(matrix, 2)
    if unit:
        header.set_xyzt_units({value: key for key, value in UNITS.items()}[unit])
    note = noted({**image.note, "space": "RAS" if image.space else ""}).encode()
    header.extensions.append(nibabel.nifti1.Nifti1Extension(COMMENT, note))
    with open(path, "wb") as file, packed_writer(file, "gzip" if packed else "") as stream:
        head = io.BytesIO()
        header.write_to(head)
        content = head.getvalue()
        stream.write(content.ljust(int(header.get_data_offset()), b"\0"))
        for at in range(image.components):
            for slab in image.slabs():
                part = slab if image.components == 1 else slab[..., at]
                stream.write(np.ascontiguousarray(part.transpose(2, 1, 0), dtype).data)
