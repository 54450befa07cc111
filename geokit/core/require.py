"""Checks of single arguments from callers: a message names the argument, what was given, and what to give instead.

Values come from anywhere. Their own methods (``__float__``, ``__array__``, ``__fspath__``, even ``__repr__``) may raise
anything, so they are called here only, and whatever they raise becomes an InputError.
"""

from __future__ import annotations

import math
import operator
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from geokit.core.base.late_warp import wp
from geokit.core.launches import warp_private
from geokit.errors import InputError

# Most characters of a value in a message.
LONGEST = 80
# pathlib joins the two slashes of a URL to one.
_URL = re.compile(r"(https?|ftp|s3|gs|file):/+", re.IGNORECASE)
# No count of anything is larger.
LARGEST_COUNT = 2**63 - 1

_Instance = TypeVar("_Instance")


def described(value: Any) -> str:
    """A value in one short line, for messages."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # of the value's own __repr__; also of integers of thousands of digits
        return f"a {type(value).__name__}"
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


def require_number(value: Any, name: str) -> float:
    """Return a real number as a float; it may be infinite or NaN.

    Texts, bytes, truth values, complex numbers, dates, masked values and arrays with a dimension are no numbers.

    Raises:
        InputError: ``value`` is not a real number, or beyond float64.
    """
    if type(value) is float:
        return value
    try:
        if isinstance(value, (np.generic, np.ndarray)):
            is_number = value.dtype.kind in "iuf" and value.ndim == 0 and value is not np.ma.masked
        else:
            is_number = not isinstance(value, bool) and (hasattr(value, "__float__") or hasattr(value, "__index__"))
        if is_number:
            return float(value)
    except OverflowError as error:
        raise InputError(f"{name}: {described(value)} is beyond float64; give a smaller number") from error
    except Exception as error:
        raise InputError(f"{name}: {described(value)} is not a number ({type(error).__name__}); give one") from error
    raise InputError(f"{name}: {described(value)} is not a number; give one")


def whole_number(value: Any) -> int | None:
    """A whole number as an int; None if ``value`` is none. True, 2.0 and dates are none."""
    try:
        # To Python, True is a whole number.
        return None if isinstance(value, (bool, np.bool_)) else operator.index(value)
    except Exception:
        return None


def require_count(value: Any, name: str, low: int = 0, high: int = LARGEST_COUNT) -> int:
    """Return a whole number from ``low`` to ``high`` as an int.

    Raises:
        InputError: ``value`` is not such a number; True and 2.0 are none.
    """
    number = whole_number(value)
    if number is None or not low <= number <= high:
        bounded = high < LARGEST_COUNT or (number is not None and number > high)
        limits = f"from {low} to {high}" if bounded else f"from {low} up"
        raise InputError(f"{name}: {described(value)} is not a whole number {limits}; give one")
    return number


def require_flag(value: Any, name: str) -> bool:
    """Return a truth value; anything else, also 0, 1 and NaN, is refused.

    Raises:
        InputError: ``value`` is neither True nor False.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(f"{name}: {described(value)} is neither True nor False; give one of them")
    return bool(value)


def require_text(value: Any, name: str) -> str:
    """Return a text.

    Raises:
        InputError: ``value`` is not a str, or has half a surrogate pair that stands for no byte.
    """
    if not isinstance(value, str):
        raise InputError(f"{name}: {described(value)} is not a text; give a str")
    try:
        value.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError as error:
        raise InputError(f"{name}: {value!r} has characters that no file can hold; use others") from error
    return value


def require_choice(value: Any, name: str, choices: Iterable[str]) -> str:
    """Return one of several texts.

    Raises:
        InputError: ``value`` is none of them; the message lists them.
    """
    if not isinstance(value, str) or value not in choices:
        raise InputError(f"{name}: {described(value)} is not known; use one of {', '.join(map(repr, choices))}")
    return value


def require_one_world(**things: Any) -> dict[str, Any]:
    """The ``meters_per_unit`` and ``up_axis`` that meshes or descriptions of volumes say, None where none does.

    Args:
        things: By the names of their arguments.
    Raises:
        InputError: Two of them say different ones.
    """
    found: dict[str, Any] = {"meters_per_unit": None, "up_axis": None}
    for key in found:
        said = [(name, value) for name, thing in things.items() if (value := getattr(thing, key)) is not None]
        if not said:
            continue
        first, found[key] = said[0]
        for name, value in said[1:]:
            # Files round the lengths of their units.
            if value != found[key] and not (key == "meters_per_unit" and math.isclose(value, found[key])):
                raise InputError(
                    f"{name}: {key} differs: {value!r}, and {found[key]!r} of {first}; mesh.convert_unit gives both "
                    "the same"
                )
    return found


def require_path(value: Any, name: str = "path") -> Path:
    """Return a path, given as a str, bytes or ``os.PathLike``; a ``~`` at its begin is the user's home.

    Raises:
        InputError: ``value`` is none of these, a URL, or has a zero byte or half a surrogate pair.
    """
    try:
        text = os.fsdecode(value)
        os.fsencode(text)
    except UnicodeEncodeError as error:
        raise InputError(f"{name}: {described(value)} has characters that no file name holds; use others") from error
    except Exception as error:
        raise InputError(f"{name}: {described(value)} is not a path; give a str or a pathlib.Path") from error
    if "\0" in text:
        raise InputError(f"{name}: {described(value)} has a zero byte; give the path of a file")
    if _URL.match(text):
        whole = _URL.sub(r"\1://", text)
        raise InputError(f"{whole}: is a URL; download it, and give the name of the file")
    return Path(os.path.expanduser(text) if text == "~" or text.startswith("~/") else text)


def require_callable(value: Any, name: str) -> Any:
    """Return something that can be called.

    Raises:
        InputError: ``value`` cannot be called.
    """
    if not callable(value):
        raise InputError(f"{name}: {described(value)} cannot be called; give a function")
    return value


def require_instance(value: Any, name: str, kind: type[_Instance], remedy: str) -> _Instance:
    """Return an object of a class.

    Raises:
        InputError: ``value`` is of another class.
    """
    if not isinstance(value, kind):
        raise InputError(f"{name}: {type(value).__name__} is not a {kind.__name__}; {remedy}")
    return value


def require_mapping(value: Any, name: str, *, blank: bool = False) -> dict[str, Any]:
    """Return a mapping from names to values as a dict.

    Raises:
        InputError: ``value`` is not a mapping, or one of its keys is not a text, is one that UTF-8 does not hold (half
            of a surrogate pair), or is blank without ``blank``.
    """
    if not isinstance(value, Mapping):
        raise InputError(f"{name}: {described(value)} is not a mapping; give a dict with a value for each name")
    for key in value:
        if not isinstance(key, str) or not (blank or key.strip()):
            raise InputError(f"{name}: the name {described(key)} is not a text; give each value a name")
        try:
            key.encode()
        except UnicodeEncodeError:
            raise InputError(f"{name}: the name {described(key)} cannot be encoded; rename it") from None
    return dict(value)


def require_items(value: Any, name: str, kind: type[_Instance] | None = None) -> list[_Instance]:
    """Return what is in a list or another iterable, read once; texts, bytes and mappings are no lists.

    Args:
        value: The iterable.
        name: The argument's name, for the message.
        kind: The class of each item; None for any.
    Raises:
        InputError: ``value`` cannot be iterated, or an item is of another class.
    """
    try:
        items = None if isinstance(value, (str, bytes, bytearray, memoryview, Mapping)) else list(value)
    except Exception:
        items = None
    if items is None:
        raise InputError(f"{name}: {described(value)} is not a list; give one")
    for row, item in enumerate(items):
        if kind is not None and not isinstance(item, kind):
            raise InputError(f"{name}[{row}]: {type(item).__name__} is not a {kind.__name__}; give one")
    return items


def read_array(values: Any, name: str, dtype: Any = None, *, kinds: str = "fiu") -> NDArray[Any]:
    """Read real numbers from anything that NumPy reads as an array.

    Args:
        values: The numbers.
        name: The argument's name, for the message.
        dtype: Type of the array; None for the type of the numbers.
        kinds: Kinds of NumPy types that are taken: f, i, u, or b for bool.
    Raises:
        InputError: ``values`` cannot be read, is of a type that is no real number (bool, complex, text, date, object,
            record), or is a masked array with masked entries, which would be taken for numbers; or a wp.Tape is
            recording, and ``values`` is an array of warp that requires gradients.
    """
    if type(values) is np.ndarray and values.dtype.kind in kinds:
        return values if dtype is None else values.astype(dtype, copy=False)
    if isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values):
        row = int(np.argmax(np.ma.getmaskarray(values).reshape(len(values), -1).any(axis=1))) if values.ndim else 0
        raise InputError(f"{name}: row {row} is masked; leave out such rows, or fill them")
    require_unrecorded(values, name)
    if isinstance(values, (bytes, bytearray)) or (isinstance(values, memoryview) and values.format == "B"):
        raise InputError(f"{name}: {type(values).__name__} holds bytes, not numbers; use numpy.frombuffer")
    try:
        array = np.asarray(_on_host(values))
        if array.dtype.kind in kinds or not array.size:
            return array if dtype is None else array.astype(dtype, copy=False)
    except Exception as error:
        if getattr(values, "requires_grad", False) is True:
            raise InputError(f"{name}: requires gradients, which are not recorded here; detach() it") from error
        raise InputError(f"{name}: cannot be read as an array of numbers ({_reason(error)}); give one") from error
    if array.dtype == object and not array.ndim:
        raise InputError(f"{name}: {type(values).__name__} is no array of numbers; give one")
    raise InputError(f"{name}: dtype {array.dtype} is not a real number type; convert it to float64")


def require_unrecorded(values: Any, name: str) -> None:
    """Refuse an array of warp whose gradient a tape is recording, where it would stay zero.

    Raises:
        InputError: ``values`` is such an array.
    """
    is_recorded = getattr(values, "requires_grad", False) is True and warp_private.tape_in_progress() is not None
    if is_recorded and isinstance(values, wp.array):
        raise refuse_recording(name)


def refuse_recording(name: str) -> InputError:
    """The error for an array of warp that requires gradients where a tape would get zeros."""
    return InputError(
        f"{name}: a wp.Tape is recording, and the answer has no gradient for this array, which requires one; query "
        "outside the tape, or give wp.clone(array, requires_grad=False). docs/gradients.md lists what has gradients"
    )


def require_memory(tensor: Any) -> None:
    """Refuse a tensor of torch that has no memory of its own, of which others would read whatever lies at address 0.

    Classes that wrap other tensors (masked, distributed and fake ones) have none, nor has one whose storage was freed.

    Raises:
        ValueError: It has none.
    """
    if not tensor.data_ptr() and tensor.numel():
        raise ValueError("it has no memory of its own; give the plain tensor that holds its numbers")


def _on_host(values: Any) -> Any:
    """What may lie on a GPU, as an array of the host: NumPy does not copy it by itself."""
    if hasattr(values, "untyped_storage"):
        require_memory(values)
    # The property itself raises errors for tensors of the host, or with gradients.
    if hasattr(type(values), "__cuda_array_interface__"):
        for name in ("cpu", "get", "copy_to_host", "numpy"):  # torch, CuPy, Numba, warp
            if callable(copy := getattr(values, name, None)):
                return copy()
    return values


def require_table(values: Any, name: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Read finite numbers of a given shape as float64.

    Raises:
        InputError: ``values`` cannot be read, has another shape, or an entry is not finite.
    """
    table: NDArray[np.float64] = read_array(values, name, np.float64)
    if table.shape != shape:
        raise InputError(f"{name}: shape {table.shape} is not {shape}; give that many numbers")
    if not np.isfinite(table).all():
        raise InputError(f"{name}: {described(table.tolist())} is not finite; give finite numbers")
    return table


def require_affine(values: Any, name: str) -> NDArray[np.float64]:
    """Read an affine map for column vectors, (4, 4), as float64.

    Raises:
        InputError: As :func:`require_table`, or the last row is not 0, 0, 0, 1.
    """
    table = require_table(values, name, (4, 4))
    if table[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise InputError(f"{name}: the last row is {table[3].tolist()}; an affine map has 0, 0, 0, 1")
    return table


def require_affine_maps(values: Any, name: str) -> NDArray[np.float64]:
    """Read an affine map for column vectors, (4, 4), or several, (B, 4, 4), as float64.

    Raises:
        InputError: As :func:`require_affine`; of several maps the message names the one.
    """
    maps: NDArray[np.float64] = read_array(values, name, np.float64)
    if maps.ndim != 3:
        return require_affine(values, name)
    if maps.shape[1:] != (4, 4):
        raise InputError(f"{name}: shape {maps.shape} is not (4, 4) or (B, 4, 4); give one map or several")
    bad = ~np.isfinite(maps).all(axis=(1, 2)) | (maps[:, 3] != [0.0, 0.0, 0.0, 1.0]).any(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(
            f"{name}: map {row} is {maps[row].tolist()}; give finite numbers, and 0, 0, 0, 1 in the last row"
        )
    return maps


def _reason(error: Exception) -> str:
    try:
        return str(error) or type(error).__name__
    except Exception:
        return type(error).__name__
