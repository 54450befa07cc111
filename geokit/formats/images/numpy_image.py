"""NumPy files (.npy) as volumes: (X, Y, Z), or (X, Y, Z, C) with 3 or 4 components, as arrays in memory.

They have no place: voxels are 1 long, and the first one lies at the origin.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.files import refuse_empty
from geokit.errors import FileFormatError
from geokit.formats.images.image import Image, fitting_codec, require_three
from geokit.formats.images.stream import rows_at_a_time
from geokit.formats.numpy_files import loaded


def is_volume(path: Path) -> bool:
    """Whether the array of a file has three axes, and not the three coordinates of an image of points."""
    refuse_empty(path)
    shape = loaded(path, "r").shape
    return len(shape) == 4 or (len(shape) == 3 and shape[2] != 3)


def open_images(path: Path, limit: int) -> list[Image]:
    """Map the array."""
    array = loaded(path, "r")
    if array.dtype.kind not in "fiub" or array.ndim not in (3, 4):
        held = f"{array.dtype} of shape {array.shape}"
        raise FileFormatError(f"{path}: holds {held}; a volume is (X, Y, Z) or (X, Y, Z, C) of real numbers")
    components = array.shape[3] if array.ndim == 4 else 1
    if components not in (1, 3, 4):
        raise FileFormatError(f"{path}: has {components} numbers in a voxel; voxels have 1, 3 or 4")
    values = array[..., 0] if array.ndim == 4 and components == 1 else array
    axis = 0 if array.flags.c_contiguous else 2

    def slabs() -> Iterator[NDArray[Any]]:
        step = rows_at_a_time(values.nbytes // max(1, values.shape[axis]))
        for first in range(0, values.shape[axis], step):
            yield values[first : first + step] if axis == 0 else values[:, :, first : first + step]

    shape = require_three(path, array.shape[:3])
    return [Image(shape, values.dtype, np.eye(4), slabs, axis=axis, components=components)]


def write_image(path: Path, image: Image, codec: str | None) -> None:
    """Write voxels; the place is left out, with a warning."""
    fitting_codec(path, codec, ("none",))
    shape = image.shape if image.components == 1 else (*image.shape, image.components)
    with open(path, "wb") as file:
        facts: Any = {"descr": np.lib.format.dtype_to_descr(image.dtype), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, facts)
        for slab in image.slabs():
            file.write(np.ascontiguousarray(slab).data)
