"""A dense volume in a file: what its header says, and its voxels slab after slab.

A module of this folder defines ``open_images(path, limit) -> list[Image]``, one for each grid, which reads the header
only, or at most ``limit`` bytes. If it writes, it defines ``write_image(path, image, codec)``, and ``STRAIGHT = True``
if that writes no axes but those of the world. Values lie on the axes x, y, z of the index: ``values[i, j, k]`` has its
center at ``transform @ (i, j, k, 1)``.
"""

from __future__ import annotations

import contextlib
import functools
import json
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._warn import warn
from geokit.core.files import in_one_line, named_damage
from geokit.errors import FileFormatError, InputError
from geokit.formats.file_content.references import allowed_folders, require_inside
from geokit.formats.reader.warnings import warn_of

# Lengths of the units that files name.
METERS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "angstrom": 1e-10}
# Axes are at right angles where the cosine between them is at most this: files round to float32.
LARGEST_COSINE = 1e-6
# Points in time and channels.
MOST_GRIDS = 1 << 16
# Keys of a header that one warning names.
MOST_NAMED = 8
# Opposite directions of the body: right and left, anterior and posterior, superior and inferior.
_OPPOSITE = {"R": "L", "A": "P", "S": "I"}


@dataclass(frozen=True)
class Image:
    """A dense volume.

    Args:
        shape: Number of voxels along the three axes.
        dtype: Type of the numbers in the slabs.
        transform: Index to world (4, 4); index (0, 0, 0) is the first voxel.
        slabs: Gives the voxels (X, Y, Z) or (X, Y, Z, C) in order, cut along ``axis``.
        axis: Along which the slabs are cut.
        components: Numbers in a voxel.
        name: Of the grid; "" if there is only one and it has none.
        unit: Of lengths in the world, a key of METERS; "" if the file does not say.
        space: Where the axes of the world point, in letters of the body as "RAS" and "LPS"; "" if unknown.
        background: Value that the file says to be that of nothing; None if it does not.
        packed: Whether the file is compressed, so that its size does not bound the content.
        note: What geokit has written besides (see :func:`noted`).
    """

    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    transform: NDArray[np.float64]
    slabs: Callable[[], Iterator[NDArray[Any]]] = lambda: iter(())
    axis: int = 2
    components: int = 1
    name: str = ""
    unit: str = ""
    space: str = ""
    background: Any = None
    packed: bool = False
    note: Mapping[str, Any] = field(default_factory=dict)

    @property
    def byte_count(self) -> int:
        """Size of the voxels."""
        return int(np.prod(self.shape, dtype=object)) * self.components * self.dtype.itemsize

    def planes(self, dtype: np.dtype[Any]) -> Iterator[NDArray[Any]]:
        """The voxels as another type, (n, Y, X) or (n, Y, X, C), some planes at a time."""
        for slab in self.slabs():
            yield np.ascontiguousarray(slab.transpose(2, 1, 0, *range(3, slab.ndim)), dtype)

    def write_to(self, file: Any, dtype: np.dtype[Any]) -> None:
        """Write the voxels as another type, x fastest after the components."""
        for planes in self.planes(dtype):
            file.write(planes.data)


@contextlib.contextmanager
def reading(path: Path) -> Iterator[None]:
    """Context in which a library reads a file: errors become FileFormatErrors, warnings name the file."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        with named_damage(path):
            yield
    found = [str(one.message) for one in said if issubclass(one.category, (UserWarning, RuntimeWarning))]
    warn_of(path, dict.fromkeys(" ".join(text.split())[:300] for text in found))


def grids_of(
    path: Path, image: Image, frames: int, slabs: Callable[[int], Iterator[NDArray[Any]]], numbers: int = 0
) -> list[Image]:
    """The grids of a file that share all but their voxels, called after their numbers.

    Args:
        path: The file, for the message.
        image: What they share.
        frames: How many there are, one after the other.
        slabs: Gives the voxels (X, Y, Z) or (X, Y, Z, C) of a frame.
        numbers: C in a frame, if they are more than components: then these are grids of their own.
    Raises:
        FileFormatError: There are more than anyone has.
    """
    inner = max(1, numbers // image.components)
    count = frames * inner

    def voxels(grid: int) -> Iterator[NDArray[Any]]:
        for slab in slabs(grid // inner):
            yield slab[..., grid % inner] if slab.ndim > 3 and image.components == 1 else slab

    if not 0 < count <= MOST_GRIDS:
        raise FileFormatError(f"{path}: holds {count} volumes; the file is damaged, or has its axes in another order")
    return [
        replace(image, name=str(at) if count > 1 else image.name, slabs=functools.partial(voxels, at))
        for at in range(count)
    ]


def file_beside(path: Path, name: str) -> Path:
    """The file with the voxels that a header names, in the same folder."""
    if "%" in name or name.split()[:1] == ["LIST"]:
        raise FileFormatError(f"{path}: has its voxels in several files; join them to one file")
    data = require_inside(name, path.parent / name, path, allowed_folders(None))
    if not data.is_file():
        raise FileFormatError(f"{path}: refers to {name!r}, which is missing; put it beside the file")
    return data


def affine(columns: Any, origin: Any) -> NDArray[np.float64]:
    """Index to world of the steps along the three axes, as columns (3, 3), and the place of the first voxel."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = columns, origin
    return matrix


def one_unit(path: Path, told: Sequence[str]) -> tuple[NDArray[np.float64], str]:
    """Factors (k,) that bring the lengths along axes to one unit, and that unit; "" if the file says none.

    A unit that is none of METERS is left out with a warning.

    Args:
        path: The file, for the messages.
        told: The unit of each axis.
    Raises:
        FileFormatError: The axes have several units, of which some are not known.
    """
    first = told[0] if told else ""
    if len(set(told)) < 2:
        if first and first not in METERS:
            warn(f"{path}: its unit {in_one_line(first, 40)!r} is not known and left out; lengths are as they stand")
        return np.ones(len(told)), first if first in METERS else ""
    if not set(told) <= METERS.keys():
        listed = in_one_line(", ".join(map(repr, told)), 100)
        raise FileFormatError(f"{path}: has axes in the units {listed}; save them in one of {', '.join(METERS)}")
    return np.array([METERS[unit] / METERS[first] for unit in told]), first


def in_space(matrix: NDArray[np.float64], space: str, wanted: str) -> NDArray[np.float64]:
    """A transform whose world points elsewhere: from "LPS" to "RAS" the first two axes are turned round.

    Where either is unknown, nothing is turned.
    """
    if len(space) != 3 or len(wanted) != 3:
        return matrix
    turned = matrix.copy()
    for row, (letter, other) in enumerate(zip(space, wanted, strict=True)):
        if _OPPOSITE.get(letter) == other or _OPPOSITE.get(other) == letter:
            turned[row] = -turned[row]
    return turned


def in_unit(matrix: NDArray[np.float64], unit: str, wanted: str) -> NDArray[np.float64]:
    """A transform with lengths in another unit; as it is where either is unknown."""
    if unit == wanted or unit not in METERS or wanted not in METERS:
        return matrix
    lengths = matrix.copy()
    lengths[:3] *= METERS[unit] / METERS[wanted]
    return lengths


def require_straight(path: Path, matrix: NDArray[np.float64], *, turned: bool) -> NDArray[np.float64]:
    """Edge lengths of the voxels of a transform, for formats that hold no sheared ones.

    Args:
        path: The target, for the message.
        matrix: Index to world.
        turned: Whether the format holds axes that are turned.
    Raises:
        InputError: The voxels are sheared, or turned where the format does not hold that.
    """
    spacing = np.linalg.norm(matrix[:3, :3], axis=0)
    axes = matrix[:3, :3] / spacing
    wanted = axes.T @ axes if turned else axes
    if np.abs(wanted - np.eye(3)).max() > LARGEST_COSINE:
        what = "sheared" if turned else "not aligned with the world's axes"
        raise InputError(f"{path}: the volume's voxels are {what}, which the format cannot hold; use .nrrd or .nii")
    return spacing


def scaled(values: NDArray[Any], slope: float, shift: float) -> NDArray[Any]:
    """Stored numbers as the quantity that they stand for."""
    if (slope, shift) == (1.0, 0.0):
        return values
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is counted and said later
        return values.astype(np.float64) * slope + shift


def stored_type(path: Path, dtype: np.dtype[Any], kinds: Mapping[str, str]) -> np.dtype[Any]:
    """The type in which a format holds numbers of another one.

    Args:
        path: The target, for the message.
        dtype: Of the volume.
        kinds: Type that is stored, by type of the volume ("f4", "u1", ...).
    Raises:
        InputError: It holds none.
    """
    found = kinds.get(dtype.str[1:])
    if found is None:
        raise InputError(f"{path}: the format holds no {dtype}; use .nrrd")
    return np.dtype(found)


def fitting_codec(path: Path, codec: str | None, known: tuple[str, ...]) -> str:
    """The compression of a file, by default the first that is known.

    Raises:
        InputError: The format has no such compression.
    """
    if codec is None:
        return known[0]
    if codec not in known:
        raise InputError(f"codec: {path.suffix.lower()} is not written with {codec!r}; use {' or '.join(known)}")
    return codec


def noted(facts: Mapping[str, Any]) -> str:
    """What no format but geokit's own holds, as a line of text: name, class, background, type and first index."""
    return json.dumps({"geokit": dict(facts)}, separators=(",", ":"), allow_nan=False)


def note_of(text: Any) -> dict[str, Any]:
    """What :func:`noted` has written; empty for any other text."""
    try:
        found = json.loads(text)["geokit"]
    except (ValueError, TypeError, KeyError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def left_out_keys(keys: Iterable[str]) -> list[str]:
    """What is said of a header's keys that are not read; nothing if there are none."""
    names = list(dict.fromkeys(keys))
    listed = ", ".join(repr(in_one_line(name)) for name in names[:MOST_NAMED])
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return [f"the keys {listed}{more} of its header are left out"] if names else []


def require_three(path: Path, sizes: Any) -> tuple[int, int, int]:
    """Numbers of voxels along the axes, none of which may be missing.

    Raises:
        FileFormatError: There are no voxels.
    """
    shape = tuple(int(size) for size in sizes)
    if len(shape) != 3 or min(shape) < 1:
        raise FileFormatError(f"{path}: holds no voxels (size {shape}); get a whole copy")
    return shape
