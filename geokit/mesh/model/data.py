"""Attributes of a mesh: materials, and the checks of arrays on vertices, faces and corners."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.require import (
    read_array,
    require_instance,
    require_items,
    require_mapping,
    require_number,
    require_text,
)
from geokit.errors import InputError

Data = Mapping[str, NDArray[Any]]

NOTHING: Data = MappingProxyType({})
# Names with a meaning on vertices, faces and corners, the numbers in a row, and the kinds of types.
MEANINGS = {"normal": ((3,), "f"), "uv": ((2,), "f"), "color": ((3, 4), "fui")}


class Texture(NamedTuple):
    """An image in the encoding of its file.

    Attributes:
        name: The file's name, such as "wood.png".
        data: The bytes of the file.
    """

    name: str
    data: bytes

    def __repr__(self) -> str:
        return f"Texture({self.name!r}, {len(self.data)} bytes)"


class Material(NamedTuple):
    """How a face looks.

    Attributes:
        name: Its name in the file.
        color: Red, green, blue and alpha from 0 to 1, as the file has them; None if it has none.
        texture: The image of the base color, addressed by ``uv``; None if there is none.
        alpha_cutoff: None blends by the alpha of the color and the texture. A number makes opaque what has at least
            that alpha, and leaves out the rest: 0 is opaque all over.
    """

    name: str = ""
    color: tuple[float, float, float, float] | None = None
    texture: Texture | None = None
    alpha_cutoff: float | None = None


def checked_data(data: Any, argument: str, leading: tuple[int, ...], rows: str) -> Data:
    """Arrays by name as read-only arrays of NumPy.

    Args:
        data: The mapping that was given; None is an empty one.
        argument: Its name, for messages.
        leading: The shape that each array begins with; one more axis may follow.
        rows: What has a row, for messages.
    Raises:
        InputError: It is no mapping of names to arrays of numbers or bools of that shape.
    """
    if data is None or data is NOTHING:
        return NOTHING
    checked = {}
    for name, given in require_mapping(data, argument).items():
        values = read_array(given, f"{argument}['{name}']", kinds="fiub")
        if values.shape[: len(leading)] != leading or values.ndim > len(leading) + 1:
            shape = ", ".join(map(str, leading))
            raise InputError(
                f"{argument}['{name}']: shape {values.shape} is neither ({shape}{',' * (len(leading) == 1)}) nor "
                f"({shape}, k); give one row for each of the {leading[0]} {rows}"
            )
        if values.shape[len(leading) :] == (0,):
            raise InputError(f"{argument}['{name}']: shape {values.shape} holds no numbers; leave it out")
        if values.dtype.kind == "f" and values.dtype.itemsize > 8:
            values = values.astype(np.float64)
        checked[name] = read_only(np.ascontiguousarray(values, values.dtype.newbyteorder("=")))
    return MappingProxyType(checked) if checked else NOTHING


def checked_materials(materials: Any, face_data: Data) -> tuple[Material, ...]:
    """The materials, if ``material`` on faces names only them.

    Raises:
        InputError: One is no Material, has no color of four numbers, or a face names one that is not there.
    """
    if type(materials) is tuple and not materials:
        return ()
    found = tuple(require_items(materials, "materials", Material))
    for row, material in enumerate(found):
        require_text(material.name, f"materials[{row}].name")
        if material.color is not None:
            color = read_array(material.color, f"materials[{row}].color")
            if color.shape != (4,) or not np.isfinite(color).all():
                raise InputError(
                    f"materials[{row}].color: {material.color!r} is not red, green, blue and alpha; give four numbers"
                )
        if material.texture is not None:
            texture = require_instance(material.texture, f"materials[{row}].texture", Texture, "give one, or None")
            require_text(texture.name, f"materials[{row}].texture.name")
            require_instance(texture.data, f"materials[{row}].texture.data", bytes, "give the bytes of the file")
        if material.alpha_cutoff is not None:
            cutoff = require_number(material.alpha_cutoff, f"materials[{row}].alpha_cutoff")
            if not np.isfinite(cutoff):
                raise InputError(f"materials[{row}].alpha_cutoff: {cutoff} is no alpha; give one from 0 to 1")
    used = face_data.get("material")
    if used is not None and used.ndim == 1 and used.dtype.kind in "iu":
        bad = (used < -1) | (used >= len(found))
        if bad.any():
            row = int(np.argmax(bad))
            raise InputError(
                f"face_data['material']: face {row} has {used[row]}, but there are {len(found)} materials; "
                "count from 0, -1 is none"
            )
    return found


def has_meaning(name: str, values: NDArray[Any], axes: int = 1) -> bool:
    """Whether an array is the one of normals, texture coordinates or colors; ``axes`` is 2 for corners."""
    widths, kinds = MEANINGS.get(name, ((), ""))
    return values.dtype.kind in kinds and values.ndim == axes + 1 and values.shape[axes] in widths


def full_scale(dtype: np.dtype[Any]) -> float | int:
    """The number that means full brightness in colors of a type."""
    return int(np.iinfo(dtype).max) if dtype.kind in "iu" else 1.0


def as_bytes(colors: NDArray[Any]) -> NDArray[Any]:
    """Colors (N, k) as bytes where these say the same; others as they are.

    Floats do that where all are k / 255 to the last bit, or where they and wide integers are whole and from 0 to 255.
    Of 16 bits they stay: those of surveys are, and full at 65535.
    """
    if colors.ndim != 2 or not colors.size or colors.dtype.str[1:] in ("u1", "i1", "u2", "b1"):
        return colors
    low, high = colors.min(), colors.max()
    if not (low >= 0 and high <= 255):
        return colors
    if colors.dtype.kind == "f" and high <= 1:
        found = np.rint(colors * 255.0).astype(np.uint8)
        return found if np.array_equal((found / 255.0).astype(colors.dtype), colors) else colors
    found = colors.astype(np.uint8)
    return found if np.array_equal(found, colors) else colors


def with_alpha(colors: NDArray[Any]) -> NDArray[Any]:
    """Colors with a full alpha, if they have none."""
    if colors.shape[-1] == 4:
        return colors
    alpha = np.full((*colors.shape[:-1], 1), full_scale(colors.dtype), colors.dtype)
    return np.concatenate([colors, alpha], axis=-1)


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    # A view, so that the caller's own array stays writable.
    view = array.view()
    view.flags.writeable = False
    return view
