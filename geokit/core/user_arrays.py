"""The only place where arrays from outside are checked, converted, and given back in their own kind.

NumPy in gives NumPy out, a warp array gives a warp array on its own device, and any other exporter of DLPack or
``__cuda_array_interface__`` comes back as its own kind where its library has a ``from_dlpack``, without a copy through
the host. Kernels see float64 rows of three; float32 in gives float32 out, everything else gives float64.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core import launcher
from geokit.core.array_interop import as_table, imported, is_exporter, reexporter, reinterpreted
from geokit.core.device_arena import Scratch, ScratchArray
from geokit.core.download import download
from geokit.core.host_array import HostArray, row_of
from geokit.core.pinned import FEWEST_ROWS, Pinned, PinnedArray, serves
from geokit.errors import InputError

if TYPE_CHECKING:
    import warp as wp

__all__ = [
    "Batch",
    "empty",
    "full",
    "read_vectors",
    "reported_row",
    "require_finite",
    "require_finite_scalar",
    "require_length",
    "several",
]

# Numbers that are looked at one by one as quickly as warnings are held back around their sum.
SMALL = 4096


@dataclass(frozen=True)
class Batch:
    """Rows of three on the query device, and how results go back to where the rows came from.

    Attributes:
        rows: The rows as kernels take them: vec3d (vec3f where float32 rows are kept), shape (N,), contiguous, on the
            query device; a HostArray where they are NumPy's and stay on the host, a PinnedArray where a GPU reads them
            there.
        single: True where the caller's rows were float32 (results are then float32 too).
        give: Turns a result of :func:`empty` or :func:`several` into the caller's kind of array.
        first_row: Where the rows stand among the caller's, for messages.
    """

    rows: Any
    single: bool
    give: Callable[["wp.array"], Any]
    first_row: int = 0

    def __len__(self) -> int:
        return len(self.rows)

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
    keep_single: bool = False,
    pin: bool = False,
) -> Batch:
    """Rows of three from any supported container, on ``device``.

    Args:
        values: Shape (N, 3): NumPy, nested lists, a warp array (also (N,) of vec3), or a DLPack or CUDA-array exporter.
        name: The argument's name for messages.
        device: The query device; rows that live elsewhere are copied to it, results are copied back.
        defer: Leave it to the query's kernel to see rows that are not finite, and to :func:`require_finite` to name
            them: a pass over the rows, and on a GPU a wait for its answer, are saved.
        first_row: Where the rows stand among the caller's, for messages.
        keep_single: Leave float32 rows as they are, vec3f, for kernels that take both.
        pin: Let a GPU read few rows of NumPy's from the host, and write what :func:`empty` makes for them there: for
            queries that do nothing with either but pass them to kernels.
    Returns:
        A Batch.
    Raises:
        InputError: A wrong shape or dtype, or a row that is not finite; the first bad row is named.
    """
    import warp as wp

    if isinstance(values, wp.array):
        source = values
        vectors = values.ndim == 1
        give = _giver(source, lambda out: out if vectors else as_table(out))
    elif isinstance(values, np.ndarray) or not is_exporter(values):
        return _read_numpy(values, name, device, first_row, defer, keep_single, pin)
    else:
        source = imported(values, name)
        give = _giver(source, reexporter(values))
    rows, single = _as_rows(source, name)
    if rows.device != device:
        rows = rows.to(device)
    if single and not keep_single:
        rows = _widen(rows)
    if not rows.is_contiguous:
        rows = rows.contiguous()
    if not defer:
        _require_finite(rows, name, first_row)
    return Batch(rows, single, lambda out: give(_narrowed(_whole(out), single)), first_row)


def empty(count: int, dtype: Any, like: Any) -> Any:
    """Room for ``count`` results of a kernel, where ``like``, the rows of a Batch, are.

    Args:
        count: Number of results.
        dtype: ``wp.vec3d``, ``wp.vec3f``, or a warp scalar type.
        like: ``Batch.rows``.
    Returns:
        A HostArray if ``like`` is one (in the same pinned memory, if it is pinned), else a warp array on its device.
    """
    import warp as wp

    if not isinstance(like, HostArray):
        return wp.empty(count, dtype=dtype, device=like.device)
    row = row_of(dtype)
    shape = count, *row.shape[1:]
    return like.room.take(shape, row.dtype) if isinstance(like, PinnedArray) else HostArray(np.empty(shape, row.dtype))


def several(count: int, dtypes: Sequence[Any], like: Any) -> list[Any]:
    """As :func:`empty`, room for results of several types.

    Few results on a device are ScratchArrays of one allocation: to make an array takes a GPU's host as long as to
    launch a kernel. ``Batch.give`` makes arrays of them, while the kernel runs. Many are arrays of their own, of which
    the caller may drop some.
    """
    if isinstance(like, HostArray) or not 0 < count < FEWEST_ROWS:
        return [empty(count, dtype, like) for dtype in dtypes]
    return Scratch(like.device, *(((count,), dtype) for dtype in dtypes)).arrays


def full(count: int, value: float, dtype: Any, like: Any) -> Any:
    """As :func:`empty`, of a number that each result has."""
    import warp as wp

    if not isinstance(like, HostArray):
        return wp.full(count, value, dtype=dtype, device=like.device)
    results = empty(count, dtype, like)
    results.values.fill(value)
    return results


def require_finite_scalar(value: Any, name: str, *, low: float = -np.inf, infinite: bool = False) -> float:
    """``value`` as a float that is a number, above ``low``, and finite unless ``infinite``.

    Raises:
        InputError: It is none of that.
    """
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: {value!r} is not a number; give one") from error
    if np.isnan(number) or not number > low or (np.isinf(number) and not infinite):
        kind = "a number" if infinite else "a finite number"
        above = f" greater than {low:g}" if low > -np.inf else ""
        raise InputError(f"{name}: {number} is not usable; give {kind}{above}")
    return number


def require_finite(batch: Batch, name: str) -> None:
    """Refuse rows that are not finite.

    Raises:
        InputError: There is such a row; the first is named.
    """
    _require_finite(batch.rows, name, batch.first_row)


def require_length(batch: Batch, name: str, shortest: float) -> None:
    """Refuse rows all of whose components are smaller than ``shortest``.

    Raises:
        InputError: There is such a row; the first is named.
    """
    import warp as wp

    from geokit.core.user_arrays_kernels import first_short_kernel

    row = reported_row(first_short_kernel, batch.rows, [wp.float64(shortest)])
    if row >= 0:
        raise InputError(f"{name}: row {row + batch.first_row} is zero or too short for a direction; give it a length")


def reported_row(kernel: Any, rows: "wp.array", inputs: list[Any]) -> int:
    """Lowest row that a checking kernel reports, -1 for none."""
    import warp as wp

    none = np.iinfo(np.int32).max
    out_row = wp.full(1, none, dtype=wp.int32, device=rows.device)
    launcher.launch(kernel, len(rows), [rows, *inputs], [out_row], rows.device)
    row = int(out_row.numpy()[0])
    return -1 if row == none else row


def _read_numpy(
    values: Any, name: str, device: "wp.Device", first_row: int, defer: bool, keep_single: bool, pin: bool
) -> Batch:
    try:
        given = np.asarray(values)
        single = given.dtype == np.float32
        if given.dtype.kind not in "fiu" and given.size:
            raise InputError(f"{name}: dtype {given.dtype} is not a real number type; convert it to float64")
        table = np.ascontiguousarray(given, dtype=np.float32 if single and keep_single else np.float64)
    except (TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{name}: cannot be read as an (N, 3) table of numbers ({error})") from error
    if table.size == 0 and table.ndim <= 2:
        table = table.reshape(0, 3)
    if table.ndim != 2 or table.shape[1] != 3:
        raise InputError(f"{name}: shape {table.shape} is not (N, 3); give one row of x, y, z for each")
    if not defer and not _all_finite(table):
        _refuse_nonfinite(table, name, first_row)
    if pin and len(table) < FEWEST_ROWS and serves(device):
        rows: Any = Pinned(device).take(table.shape, table.dtype)
        rows.values[:] = table
    else:
        host = HostArray(table)
        rows = host if device.is_cpu else host.warp.to(device)
    return Batch(rows, single, lambda out: _to_numpy(out, single), first_row)


def _all_finite(table: np.ndarray) -> bool:
    if table.size <= SMALL:
        return bool(np.isfinite(table).all())
    # The sum is finite only if every entry is (or almost never the sum of huge ones overflows): one quick pass.
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.isfinite(table.sum()))


def _refuse_nonfinite(table: np.ndarray, name: str, first_row: int) -> None:
    bad = ~np.isfinite(table).all(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(
            f"{name}: row {row + first_row} is not finite ({table[row].tolist()}); remove or replace such rows"
        )


def _to_numpy(out: "wp.array", single: bool) -> np.ndarray:
    result = out.numpy() if isinstance(out, HostArray) else download(_whole(out))[0]
    return result.astype(np.float32) if single and result.dtype == np.float64 else result


def _as_rows(source: "wp.array", name: str) -> tuple["wp.array", bool]:
    """The array as (N,) of vec3f or vec3d, and whether it is the former."""
    import warp as wp

    if source.dtype in (wp.vec3f, wp.vec3d) and source.ndim == 1:
        return source, source.dtype == wp.vec3f
    if source.dtype in (wp.float32, wp.float64) and source.ndim == 2 and source.shape[1] == 3:
        single = source.dtype == wp.float32
        table = source if source.is_contiguous else source.contiguous()
        return reinterpreted(table, wp.vec3f if single else wp.vec3d, (source.shape[0],)), single
    if source.size == 0:
        return wp.empty(0, dtype=wp.vec3d, device=source.device), source.dtype in (wp.vec3f, wp.float32)
    kind = getattr(source.dtype, "__name__", str(source.dtype))
    raise InputError(
        f"{name}: an array of {kind} with shape {tuple(source.shape)} is not (N, 3) float32 or float64, nor (N,) vec3"
    )


def _widen(rows: "wp.array") -> "wp.array":
    import warp as wp

    if len(rows) == 0:
        return wp.empty(0, dtype=wp.vec3d, device=rows.device)
    if rows.device.is_cpu:
        wide = rows.numpy().astype(np.float64)
        return wp.array(wide, dtype=wp.vec3d, device="cpu")
    from geokit.core.user_arrays_kernels import widen_kernel

    out = wp.empty(len(rows), dtype=wp.vec3d, device=rows.device)
    launcher.launch(widen_kernel, len(rows), [rows], [out], rows.device)
    return out


def _require_finite(rows: "wp.array", name: str, first_row: int) -> None:
    if len(rows) == 0:
        return
    if isinstance(rows, HostArray) or rows.device.is_cpu:
        _refuse_nonfinite(rows.numpy(), name, first_row)
        return
    import warp as wp

    from geokit.core.user_arrays_kernels import first_nonfinite_kernel

    row = reported_row(first_nonfinite_kernel, rows if rows.dtype is wp.vec3d else _widen(rows), [])
    if row >= 0:
        bad = rows[row : row + 1].numpy()[0].tolist()
        raise InputError(f"{name}: row {row + first_row} is not finite ({bad}); remove or replace such rows")


def _whole(out: Any) -> "wp.array":
    return out.warp if isinstance(out, ScratchArray) else out


def _narrowed(out: "wp.array", single: bool) -> "wp.array":
    """float64 results as float32 where the query was float32."""
    import warp as wp

    narrow = {wp.float64: wp.float32, wp.vec3d: wp.vec3f}.get(out.dtype)
    if not single or narrow is None:
        return out
    if out.device.is_cpu:
        return wp.array(out.numpy().astype(np.float32), dtype=narrow, device="cpu")
    from geokit.core.user_arrays_kernels import narrow_kernel

    size = out.size * (3 if narrow == wp.vec3f else 1)
    flat = reinterpreted(out, wp.float64, (size,))
    result = wp.empty(size, dtype=wp.float32, device=out.device)
    launcher.launch(narrow_kernel, size, [flat], [result], out.device)
    return reinterpreted(result, narrow, out.shape)


def _giver(source: "wp.array", finish: Callable[["wp.array"], Any]) -> Callable[["wp.array"], Any]:
    home = source.device
    return lambda out: finish(out if out.device == home else out.to(home))
