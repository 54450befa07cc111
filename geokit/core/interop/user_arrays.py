"""Checks and converts arrays from callers, and returns results as the caller's kind of array.

A NumPy input returns NumPy arrays, and a warp array returns warp arrays on its device. Any other exporter of DLPack or
``__cuda_array_interface__`` returns arrays of its own kind if its library has ``from_dlpack``, without a copy through
the host. Kernels see float64 rows of three. float32 input returns float32; everything else, such as float16 and whole
numbers, returns float64.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.download import download
from geokit.core.interop.arrays import (
    as_table,
    broadcast_rows,
    exporter_like,
    flat_rows,
    import_array,
    is_exporter,
    led,
    reinterpreted,
    widened,
)
from geokit.core.interop.objects import points_of
from geokit.core.launches import captured, prepared
from geokit.core.memory.device_arena import Scratch, ScratchArray
from geokit.core.memory.host_array import HostArray, row_of
from geokit.core.memory.pinned import FEWEST_ROWS, Pinned, PinnedArray, uses_pinned_memory
from geokit.core.require import read_array, require_number, require_unrecorded
from geokit.errors import InputError

# Largest coordinate of queries that measure distances: squares of differences have to stay within float64. Kernels
# have it as LARGEST of user_arrays_kernels.
LARGEST_MEASURED = 1e150
LARGEST_FLOAT = float(np.finfo(np.float64).max)
# Numbers that are converted to float32 in one launch.
NARROWED_AT_ONCE = 1 << 30
# Up to this size, checking each number is as fast as suppressing the warnings around their sum.
SMALL = 4096


@dataclass(frozen=True)
class Batch:
    """Query rows on the query device, and the way back to the caller's kind of array.

    Attributes:
        rows: The rows as kernels take them: vec3d (vec3f where float32 rows are kept), shape (N,), contiguous, on the
            query device. They are a HostArray for NumPy rows that stay on the host, and a PinnedArray where a GPU reads
            them from the host.
        is_float32: True if the caller's rows were float32; results are then float32 too.
        to_caller: Converts a result of :func:`empty` or :func:`empty_outputs` to the caller's kind of array.
            Rows of shape (..., 3) get results with their leading axes; one row, of shape (3,), without any.
        first_row: Index of the first row among the caller's rows, for error messages.
        to_lists: The same for results that do not have one entry for each row, which keep their shape.
        is_shared: Whether the caller gets the memory of float64 results itself, in which kernels may still write.
        lead: Leading axes of the caller's rows; None for a table (N, 3).
    """

    rows: Any
    is_float32: bool
    to_caller: Callable[["wp.array"], Any]
    first_row: int = 0
    to_lists: Callable[["wp.array"], Any] | None = None
    is_shared: bool = False
    lead: tuple[int, ...] | None = None

    def __len__(self) -> int:
        return len(self.rows)

    def of_poses(self, count: int) -> Callable[["wp.array"], Any]:
        """``to_caller`` of results for ``count`` poses, one after the other, whose axis comes first."""
        lead = (len(self),) if self.lead is None else self.lead
        return _shaped(self.to_lists or self.to_caller, (count, *lead))

    @property
    def array(self) -> "wp.array":
        """The rows as a warp array, shape (N,)."""
        return self.rows.warp if isinstance(self.rows, HostArray) else self.rows


def read_vectors(
    values: Any,
    name: str,
    device: "wp.Device",
    *,
    defer: bool = False,
    first_row: int = 0,
    keep_float32: bool = False,
    pin: bool = False,
    single: bool = False,
    largest: float = LARGEST_FLOAT,
) -> Batch:
    """Read an (N, 3) table from any supported container, as rows on ``device``.

    Args:
        values: Shape (N, 3): NumPy, nested lists, a warp array (also (N,) of vec3), an exporter of DLPack or the CUDA
            array interface, or an object that holds points (:func:`geokit.core.interop.objects.points_of`).
        name: The argument's name for error messages.
        device: The query device; rows elsewhere are copied to it, and results are copied back.
        defer: Skip the check for rows that are not finite. The query's kernel then has to detect them, and
            :func:`require_finite` names them. This saves a pass over the rows, and on a GPU a wait.
        first_row: Index of the first row among the caller's rows, for error messages.
        keep_float32: Keep float32 rows as vec3f, for kernels that take both types.
        pin: Keep fewer than 2,048 NumPy rows of a GPU query, and the results of :func:`empty` for them, in pinned host
            memory. Only for queries that pass both to kernels and do nothing else with them.
        single: Also take rows with other leading axes than one: (3,), (B, N, 3), ...
        largest: Largest magnitude of a coordinate; without ``defer``.
    Returns:
        A Batch.
    Raises:
        InputError: A wrong shape or dtype, or a row that is not finite; the message names the first bad row. Or a
            wp.Tape is recording, and the rows require gradients.
    """
    lead = None
    if isinstance(values, wp.array):
        require_unrecorded(values, name)
        source = _as_floats(values)
        vectors = values.dtype in (wp.vec3f, wp.vec3d)
        finish = _on_device_of(source, lambda out: out if vectors else as_table(out))
    else:
        if type(values) is not np.ndarray:
            values = points_of(values, name)
        if isinstance(values, np.ndarray) or not is_exporter(values):
            return _read_numpy(values, name, device, first_row, defer, keep_float32, pin, single, largest)
        values = widened(values)
        if single and hasattr(values, "reshape"):  # warp has arrays of four axes
            values, lead = flat_rows(values)
        source = _as_floats(import_array(values, name))
        finish = _on_device_of(source, exporter_like(values))
    if single and lead is None:
        source, lead = flat_rows(source)
    rows, is_float32 = _as_rows(source, name)
    if rows.device != device:
        captured.refuse(device, f"{name}: rows on {rows.device} are copied to {device}")
        rows = rows.to(device)
    if is_float32 and not keep_float32:
        rows = _widen(rows)
    if not rows.is_contiguous:
        rows = rows.contiguous()
    if not defer:
        _require_finite(rows, name, first_row, largest)

    def to_lists(out: "wp.array") -> Any:
        return finish(_narrowed(_as_warp(out), is_float32))

    is_shared = not is_float32 and lead != () and source.device == device
    return Batch(rows, is_float32, _shaped(to_lists, lead), first_row, to_lists, is_shared, lead)


def read_rows(values: Sequence[Any], names: Sequence[str], device: "wp.Device", **how: Any) -> list[Batch]:
    """Read arrays (..., 3) that have a row for each row of the others, as :func:`read_vectors` does; see
    :func:`same_rows`.
    """
    values = same_rows(values, names)
    batches = [read_vectors(v, name, device, single=True, **how) for v, name in zip(values, names, strict=True)]
    for batch, name in zip(batches, names, strict=True):
        if len(batch) != len(batches[0]):  # an empty list is no row for all
            raise InputError(f"{name}: {len(batch)} rows for {len(batches[0])} {names[0]}; give one for each")
    return batches


def same_rows(values: Sequence[Any], names: Sequence[str]) -> list[Any]:
    """Arrays (..., 3) of equal leading axes: one row, of shape (3,), is that of all.

    Raises:
        InputError: Leading axes differ.
    """
    first = values[0]
    if len(values) == 1 or (
        hasattr(first, "dtype")
        and all(type(v) is type(first) and v.shape == first.shape and v.dtype == first.dtype for v in values)
    ):
        return list(values)
    found = {name: points_of(v, name) for name, v in zip(names, values, strict=True)}
    tables = {name: v if is_exporter(v) else read_array(v, name) for name, v in found.items()}
    # What has nothing but an interface has no shape before it is read, and no single row.
    return list((tables | broadcast_rows({name: v for name, v in tables.items() if hasattr(v, "shape")})).values())


def read_numbers(values: Any, name: str) -> np.ndarray:
    """Read one number or an array of numbers, also from a warp array or an exporter, as float64 on the host.

    Raises:
        InputError: ``values`` cannot be read as real numbers.
    """
    if type(values) is float:
        return np.array(values)
    if isinstance(values, wp.array):
        require_unrecorded(values, name)
        values = values.numpy()
    elif not isinstance(values, (np.ndarray, np.generic)) and is_exporter(values):
        values = import_array(values, name).numpy()
    if not isinstance(values, np.ndarray) and hasattr(values, "__float__") and not hasattr(values, "__len__"):
        values = require_number(values, name)
    return read_array(values, name, np.float64)


def empty(count: int, dtype: Any, like: Any) -> Any:
    """An uninitialized array for ``count`` kernel results, in the same kind of memory as ``like``.

    Args:
        count: Number of results.
        dtype: ``wp.vec3d``, ``wp.vec3f``, or a warp scalar type.
        like: ``Batch.rows``.
    Returns:
        A HostArray if ``like`` is one (in the same pinned memory if it is pinned), else a warp array on its device.
    """
    if not isinstance(like, HostArray):
        return wp.empty(count, dtype=dtype, device=like.device)
    row = row_of(dtype)
    shape = count, *row.shape[1:]
    if isinstance(like, PinnedArray):
        return like.pinned.take(shape, row.dtype)
    results = HostArray(np.empty(shape, row.dtype))
    if recording := prepared.current():
        recording.empty(results)
    return results


def empty_outputs(count: int, dtypes: Sequence[Any], like: Any) -> list[Any]:
    """Uninitialized arrays for ``count`` results of each type in ``dtypes``; see :func:`empty`.

    Fewer than 2,048 results on a device are ScratchArrays of one allocation, because creating an array takes as long as
    launching a kernel. ``Batch.to_caller`` converts them to arrays while the kernel runs. Larger results have an
    allocation each, so that the caller can free some of them.
    """
    if isinstance(like, HostArray) or not 0 < count < FEWEST_ROWS:
        return [empty(count, dtype, like) for dtype in dtypes]
    return Scratch(like.device, *(((count,), dtype) for dtype in dtypes)).arrays


def full(count: int, value: float, dtype: Any, like: Any) -> Any:
    """An array of ``count`` results that all hold ``value``; see :func:`empty`."""
    if not isinstance(like, HostArray):
        return wp.full(count, value, dtype=dtype, device=like.device)
    results = empty(count, dtype, like)
    results.values.fill(value)
    if recording := prepared.current():
        recording.filled(results)
    return results


def mapped(results: HostArray, convert: Callable[[np.ndarray], np.ndarray]) -> HostArray:
    """``convert`` of kernel results on the host, row by row."""
    memory = _memory_of(results)
    made = HostArray(convert(memory))
    if recording := prepared.current():
        recording.derived(made.values, memory, convert)
    return made


# The bound below 0 that lets 0 pass.
FROM_ZERO = -math.ulp(0.0)


def require_finite_scalar(value: Any, name: str, *, low: float = -np.inf, infinite: bool = False) -> float:
    """Return ``value`` as a float; it must be a number above ``low``, and finite unless ``infinite``.

    Raises:
        InputError: ``value`` is not such a number.
    """
    number = require_number(value, name)
    # Threads of jax take denormal numbers, such as FROM_ZERO, for 0.
    from_zero = low > -1e-300 and math.copysign(1.0, low) < 0.0
    is_above = number > low or (number == 0.0 and from_zero)
    if math.isnan(number) or not is_above or (math.isinf(number) and not infinite):
        kind = "a number" if infinite else "a finite number"
        above = ", 0 or more" if from_zero else f" greater than {low:g}" if low > -np.inf else ""
        raise InputError(f"{name}: {number} is not usable; give {kind}{above}")
    return number


def require_finite(batch: Batch, name: str, largest: float = LARGEST_FLOAT) -> None:
    """Raise an error for rows that are not finite, or have a coordinate whose magnitude is above ``largest``.

    Raises:
        InputError: There is such a row; the message names the first one.
    """
    _require_finite(batch.rows, name, batch.first_row, largest)


def require_length(batch: Batch, name: str, shortest: float) -> None:
    """Raise an error for rows whose components are all smaller than ``shortest`` in magnitude.

    Raises:
        InputError: There is such a row; the message names the first one.
    """
    from geokit.core.interop.user_arrays_kernels import first_short_kernel

    row = reported_row(first_short_kernel, batch.rows, [wp.float64(shortest)])
    if row >= 0:
        raise InputError(f"{name}: row {row + batch.first_row} is zero or too short for a direction; give it a length")


def ray_limits(t_min: Any, max_distance: Any) -> tuple[Any, Any]:
    """Both limits of rays as kernels take them; none is negative, and the second may be infinite."""
    lowest = -math.ulp(0.0)
    start = require_finite_scalar(t_min, "t_min", low=lowest)
    reach = require_finite_scalar(max_distance, "max_distance", low=lowest, infinite=True)
    return wp.float64(start), wp.float64(reach)


def refuse_rays(bad: Any, rays: Batch, heading: Batch, shortest: float) -> None:
    """Raise InputError and name the first ray that is not usable, if a kernel has raised ``bad``."""
    if bad.numpy()[0]:
        require_finite(rays, "origins")
        require_finite(heading, "directions")
        require_length(heading, "directions", shortest)


def reported_row(kernel: Any, rows: "wp.array", inputs: list[Any]) -> int:
    """Lowest row that a checking kernel reports; -1 if it reports none."""
    none = np.iinfo(np.int32).max
    out_row = wp.full(1, none, dtype=wp.int32, device=rows.device)
    launcher.launch(kernel, len(rows), [rows, *inputs], [out_row], rows.device)
    row = int(out_row.numpy()[0])
    return -1 if row == none else row


def _read_numpy(
    values: Any,
    name: str,
    device: "wp.Device",
    first_row: int,
    defer: bool,
    keep_float32: bool,
    pin: bool,
    single: bool,
    largest: float,
) -> Batch:
    array = values if type(values) is np.ndarray and values.dtype.kind in "fiu" else read_array(values, name)
    is_float32 = array.dtype == np.float32
    table = np.ascontiguousarray(array, dtype=np.float32 if is_float32 and keep_float32 else np.float64)
    if table.size == 0 and table.ndim <= 2:
        table = table.reshape(0, 3)
    table, lead = flat_rows(table) if single else (table, None)
    if table.ndim != 2 or table.shape[1] != 3:
        raise InputError(f"{name}: shape {table.shape} is not (N, 3); {_remedy(table.shape)}")
    if not defer and not _all_within(table, largest):
        _refuse_nonfinite(table, name, first_row, largest)
    captured.refuse(device, f"{name}: rows in host memory are copied to {device}")
    if recording := prepared.current():
        table = recording.rows_of(values, table, largest=None if defer else largest)
    if pin and len(table) < FEWEST_ROWS and uses_pinned_memory(device):
        rows: Any = Pinned(device).take(table.shape, table.dtype)
        rows.values[:] = table
    else:
        host = HostArray(table)
        rows = host if device.is_cpu else host.warp.to(device)

    def to_lists(out: Any) -> NDArray[Any]:
        return _to_numpy(out, is_float32)

    return Batch(rows, is_float32, _shaped(to_lists, lead), first_row, to_lists, lead=lead)


def _shaped(give: Callable[[Any], Any], lead: tuple[int, ...] | None) -> Callable[[Any], Any]:
    """The same results with other leading axes; None leaves them."""
    if lead is None:
        return give

    def shape(out: Any) -> Any:
        found = give(out)
        if not isinstance(found, wp.array):
            shaped = led(found, lead)
            if recording := prepared.current():
                recording.derived(shaped, found, functools.partial(led, lead=lead))
            return shaped
        # warp has no arrays of no dimension.
        whole = (*lead, *found.shape[1:])
        return reinterpreted(found, found.dtype, whole) if whole else found.numpy()[0]

    return shape


def _all_within(table: np.ndarray, largest: float) -> bool:
    """Whether all numbers are finite and at most ``largest``; False where only a check of each row can tell."""
    if table.size <= SMALL:
        return not table.size or max(float(table.max()), -float(table.min())) <= largest
    # One fast pass. A sum of huge entries may overflow; then each row is checked.
    with np.errstate(over="ignore", invalid="ignore"):
        if largest == LARGEST_FLOAT:
            return bool(np.isfinite(table.sum()))
        flat = table.reshape(-1)
        return float(np.einsum("i,i->", flat, flat)) < largest * largest


def _refuse_nonfinite(table: np.ndarray, name: str, first_row: int, largest: float) -> None:
    bad = ~(np.abs(table) <= np.float64(largest)).all(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise _bad_row(name, row + first_row, table[row].tolist(), largest)


def _bad_row(name: str, row: int, values: list[float], largest: float) -> InputError:
    if all(map(math.isfinite, values)):
        return InputError(
            f"{name}: row {row} is farther than {largest:g} from the origin ({values}), where squares of distances "
            "leave float64; scale it down, with all else"
        )
    return InputError(f"{name}: row {row} is not finite ({values}); remove or replace such rows")


def _to_numpy(out: "wp.array", is_float32: bool) -> np.ndarray:
    memory = _memory_of(out) if isinstance(out, HostArray) else download(_as_warp(out))[0]
    is_cast = is_float32 and memory.dtype == np.float64
    convert = operator.methodcaller("astype", np.float32) if is_cast else np.ndarray.copy
    result = convert(memory) if is_cast else memory
    if recording := prepared.current():
        recording.derived(result, memory, convert)
    return result


def _memory_of(results: HostArray) -> np.ndarray:
    """Results on the host. A recorder notes what becomes of them; pinned ones are waited for."""
    return results.values if type(results) is HostArray else results.numpy()


def _as_rows(source: "wp.array", name: str) -> tuple["wp.array", bool]:
    """View the array as (N,) of vec3f or vec3d; also return whether it is vec3f."""
    if source.dtype in (wp.vec3f, wp.vec3d) and source.ndim == 1:
        return source, source.dtype == wp.vec3f
    if source.dtype in (wp.float32, wp.float64) and source.ndim == 2 and source.shape[1] == 3:
        is_float32 = source.dtype == wp.float32
        table = source if source.is_contiguous else source.contiguous()
        return reinterpreted(table, wp.vec3f if is_float32 else wp.vec3d, (source.shape[0],)), is_float32
    if source.size == 0:
        return wp.empty(0, dtype=wp.vec3d, device=source.device), source.dtype in (wp.vec3f, wp.float32)
    kind = getattr(source.dtype, "__name__", str(source.dtype))
    shape = tuple(source.shape)
    raise InputError(
        f"{name}: an array of {kind} with shape {shape} is not (N, 3) numbers, nor (N,) vec3; {_remedy(shape)}"
    )


def _remedy(shape: tuple[int, ...]) -> str:
    """What makes rows of three of an array of another shape."""
    if len(shape) > 2 and shape[-1] == 3:
        return "reshape it to (-1, 3), and the answer back"
    return "transpose it" if len(shape) == 2 and shape[0] == 3 else "give one row of x, y, z for each"


def _as_floats(source: "wp.array") -> "wp.array":
    """Whole numbers and float16 as float64, as NumPy's are taken; all else as it is."""
    plain = source.dtype in (wp.float32, wp.float64, wp.bfloat16) or not wp.types.type_is_scalar(source.dtype)
    return source if plain else wp.array(source.numpy().astype(np.float64), dtype=wp.float64, device=source.device)


def _widen(rows: "wp.array") -> "wp.array":
    if len(rows) == 0:
        return wp.empty(0, dtype=wp.vec3d, device=rows.device)
    if rows.device.is_cpu:
        wide = rows.numpy().astype(np.float64)
        return wp.array(wide, dtype=wp.vec3d, device="cpu")
    from geokit.core.interop.user_arrays_kernels import widen_kernel

    out = wp.empty(len(rows), dtype=wp.vec3d, device=rows.device)
    launcher.launch(widen_kernel, len(rows), [rows], [out], rows.device)
    return out


def _require_finite(rows: "wp.array", name: str, first_row: int, largest: float = LARGEST_FLOAT) -> None:
    if len(rows) == 0 or captured.is_captured(rows.device):
        return
    if isinstance(rows, HostArray) or rows.device.is_cpu:
        _refuse_nonfinite(rows.numpy(), name, first_row, largest)
        return
    from geokit.core.interop.user_arrays_kernels import first_nonfinite_kernel

    wide = rows if rows.dtype is wp.vec3d else _widen(rows)
    row = reported_row(first_nonfinite_kernel, wide, [wp.float64(largest)])
    if row >= 0:
        bad = rows[row : row + 1].numpy()[0].tolist()
        raise _bad_row(name, row + first_row, bad, largest)


def _as_warp(out: Any) -> "wp.array":
    return out.warp if isinstance(out, ScratchArray) else out


def _narrowed(out: "wp.array", is_float32: bool) -> "wp.array":
    """Convert float64 results to float32 if the query was float32."""
    narrow = {wp.float64: wp.float32, wp.vec3d: wp.vec3f}.get(out.dtype)
    if not is_float32 or narrow is None:
        return out
    if out.device.is_cpu:
        return wp.array(out.numpy().astype(np.float32), dtype=narrow, device="cpu")
    return narrowed(out, narrow)


def narrowed(out: "wp.array", narrow: Any) -> "wp.array":
    """Numbers or vectors of float64 as ``narrow``, of float32, on their device."""
    from geokit.core.interop.user_arrays_kernels import narrow_kernel

    result: Any = wp.empty(out.shape, dtype=narrow, device=out.device)
    size = out.size * (3 if narrow == wp.vec3f else 1)
    # All numbers together may be more than warp counts: 8 nearest of 400 million points.
    for first in range(0, size, NARROWED_AT_ONCE):
        count = min(NARROWED_AT_ONCE, size - first)
        wide: Any = wp.array(ptr=out.ptr + 8 * first, dtype=wp.float64, shape=count, device=out.device)
        short: Any = wp.array(ptr=result.ptr + 4 * first, dtype=wp.float32, shape=count, device=out.device)
        launcher.launch(narrow_kernel, count, [wide], [short], out.device)
    return result


def _on_device_of(source: "wp.array", finish: Callable[["wp.array"], Any]) -> Callable[["wp.array"], Any]:
    home = source.device
    return lambda out: finish(out if out.device == home else out.to(home))
