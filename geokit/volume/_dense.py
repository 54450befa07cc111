"""Conversion of dense arrays to sparse volumes and back."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.interop import user_arrays
from geokit.core.interop.objects import image_of
from geokit.core.interop.types import Device
from geokit.core.memory import available_memory
from geokit.core.memory.needs import needs
from geokit.core.require import described, read_array, require_text, require_unrecorded
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import info_of
from geokit.volume.nanovdb.layout import LAYOUTS
from geokit.volume.nanovdb.types import INDEX_TYPES
from geokit.volume.tree.dense_tiles import (
    BYTES_PER_FILLED_LEAF,
    BYTES_PER_LEAF,
    VOXELS_AT_A_TIME,
    DenseTiles,
    mark_inside,
)
from geokit.volume.tree.dense_typed import DenseRule, background_of, layout_for, require_leaves, tree_of_dense
from geokit.volume.tree.device_leaves import fill_leaves
from geokit.volume.tree.grid_head import GridHead, checked_head
from geokit.volume.tree.leaves import require_volume
from geokit.volume.tree.typed_writer import build_grid

# Fewest rows of voxels that are worth a slice of a launch.
ROW_GRAIN = 16
INT32 = np.iinfo(np.int32)


class DenseGrid(NamedTuple):
    """A box of voxels of a volume.

    Attributes:
        values: Values of the voxels, shape (X, Y, Z), or (X, Y, Z, C) for grids of C components.
        origin: Index of the voxel ``values[0, 0, 0]``, shape (3,) int64.
        transform: Indices of the volume to world, shape (4, 4): the center of voxel ``values[i, j, k]`` is
            ``transform[:3, :3] @ (origin + (i, j, k)) + transform[:3, 3]``. Those of the array are taken there by
            ``array_transform``.
    """

    values: np.ndarray
    origin: NDArray[np.int64]
    transform: NDArray[np.float64]

    @property
    def array_transform(self) -> NDArray[np.float64]:
        """Indices of the array to world, shape (4, 4): the center of voxel ``values[i, j, k]`` is that of (i, j, k).

        For other programs, and for arrays that are made from ``values``: ``from_dense(values == 1,
        transform=dense.array_transform)`` lies where the volume lies, at other indices.
        """
        moved = self.transform.copy()
        moved[:3, 3] += self.transform[:3, :3] @ self.origin
        return moved


def _dense_bytes(values: Any, *, grid_type: str | None = None, **_: Any) -> float:
    shape = np.shape(values)
    leaves = math.prod(-(-length // 8) for length in shape[:3])
    own = "float" if getattr(values, "dtype", None) == np.float32 and len(shape) == 3 else ""
    is_filled = (grid_type or own) == "float"
    return leaves * (BYTES_PER_FILLED_LEAF if is_filled else BYTES_PER_LEAF) * math.prod(shape[3:])


@needs(_dense_bytes, late=True)
def from_dense(
    values: Any,
    *,
    transform: ArrayLike | None = None,
    voxel_size: Any = None,
    origin: Any = None,
    background: Any = 0,
    tolerance: float = 0.0,
    name: str = "",
    grid_class: str = "unknown",
    grid_type: str | None = None,
) -> SparseVolume:
    """Build a grid from a dense array. Values equal to the background take no memory.

    Voxels within ``tolerance`` of the background become inactive and take its value; leaves of 8^3 voxels without an
    active voxel are not stored. In a level set the same holds for minus the background, which the inside keeps. Every
    other value is kept; grids of floats store the nearest value of their type. Outside the array the grid has the
    background. So ``to_dense`` of the result differs from ``values`` by at most the tolerance plus the rounding to the
    grid's type. An array returned by ``to_dense`` is not rounded in a grid of its type.

    Without ``grid_type``, floats of any size become "float", "vec3f" or "vec4f", bools become "bool", and whole numbers
    keep their own type where NanoVDB has it (int8 becomes "int16", uint16 "int32"; four uint8 are "rgba8"). In a level
    set or fog volume, whole numbers become "float". Other types must be requested by name. OpenVDB's files store the
    types that OpenVDB has; saving another as .vdb is an error that says so.

    Args:
        values: Values of the voxels, shape (X, Y, Z), or (X, Y, Z, C) with C = 3 or 4 components: a NumPy array or
            anything that NumPy can read, a warp array, or a DLPack exporter. Or an object with values, a place and a
            name, which hold where no arguments are given: a DenseGrid, pyvista's ImageData (its active scalars; those
            of cells lie at their centers), or xarray's DataArray (dims x, y, z in any order, else by place; evenly
            spaced coordinates).
        transform: Index to world, shape (4, 4); give this or ``voxel_size``.
        voxel_size: Edge length of a voxel [world], or three of them; index (0, 0, 0) then lies at the world's origin.
            None, and no transform, is 1.
        origin: Index of the voxel ``values[0, 0, 0]``, three whole numbers; None is (0, 0, 0).
        background: Value of all voxels that are not stored: a number, or one for each component. Positive for a level
            set, False for a mask.
        tolerance: Largest difference from the background, in each component, that still counts as background [value
            units].
        name: Name of the grid.
        grid_class: "level set", "fog volume", "unknown" or another class of NanoVDB.
        grid_type: Type of the grid, as ``GridInfo.grid_type`` names it; None for the type of the array.
    Returns:
        SparseVolume of that type.
    Raises:
        InputError: values is not (X, Y, Z) or (X, Y, Z, C), has a dtype that no grid has, or holds a number that the
            type cannot represent (numbers that are not finite, and for types of whole numbers all others that they
            lack); or the transform, origin, background, tolerance, name, class or type is invalid.
        DeviceMemoryError: The grid does not fit into memory.
    Source:
        OpenVDB's copyFromDense. Differs: both signs of a level set's background count, and the inside becomes tiles.
    Example:
        >>> import numpy as np
        >>> cube = np.zeros((32, 32, 32))
        >>> cube[10:12, 10:12, 10:12] = 1.0
        >>> from_dense(cube, voxel_size=0.1).info.active_voxel_count
        8
        >>> from_dense(cube.astype(np.int32), voxel_size=0.1).info.grid_type
        'int32'
    """
    if grid_type is not None:
        require_text(grid_type, "grid_type")
    require_text(grid_class, "grid_class")
    placed = values if isinstance(values, DenseGrid) else image_of(values, "values")
    if placed is not None:
        values = placed.values
        origin = placed.origin if origin is None else origin
        transform = placed.transform if transform is None and voxel_size is None else transform
        name = name or getattr(placed, "name", "")
    dense = _read_dense(values)
    layout = layout_for(dense, grid_type, grid_class)
    matrix = _transform_of(transform, voxel_size)
    start = _whole_numbers((0, 0, 0) if origin is None else origin, "origin", (3,))
    last = start + np.array(dense.shape[:3])
    if (start < INT32.min).any() or (last - 1 > INT32.max).any():
        raise InputError(f"origin: {start.tolist()} puts voxels beyond int32; use a smaller one")
    tolerance = user_arrays.require_finite_scalar(tolerance, "tolerance", low=user_arrays.FROM_ZERO)
    if layout.name == "float":
        with np.errstate(over="ignore"):
            background = float(np.float32(user_arrays.require_finite_scalar(background, "background")))
    else:
        background = background_of(background, layout)
    level_set = grid_class == "level set"
    if level_set and background <= 0.0:
        raise InputError(f"background: {background} of a level set is not positive; give its largest distance")
    # First, since it rejects options that no grid can have.
    head = checked_head(layout.name, background, background, matrix, name, grid_class)
    if layout.name == "float":
        buffer = _float_grid(DenseTiles(dense, start, background, tolerance, level_set), head)
    else:
        buffer = build_grid(tree_of_dense(dense, start, DenseRule(layout, background, tolerance, level_set)), head)
    return SparseVolume(buffer, info_of(buffer))


def _float_grid(tiles: DenseTiles, head: GridHead) -> NDArray[np.uint8]:
    leaves, inside = tiles.sort_out()
    require_leaves(len(leaves), BYTES_PER_FILLED_LEAF)
    buffer = fill_leaves(head, leaves.astype(np.int32), lambda *rows: tiles.fill(leaves, *rows))
    mark_inside(buffer, inside, head.background)
    return buffer


@needs()
def to_dense(
    volume: SparseVolume,
    *,
    bounds: ArrayLike | None = None,
    dtype: DTypeLike | None = None,
    channel: int | str | None = None,
    device: Device = None,
) -> DenseGrid:
    """Read all voxels of a box into a dense array, whether stored or not.

    Every voxel has the value of the tree, that is of its leaf, its tile or the background, bit for bit where ``dtype``
    can hold it.

    Args:
        volume: A grid of any scalar, vector or color type, or an index grid with channels.
        bounds: First and last voxel [index], shape (2, 3), both inclusive; None for the box around the active voxels.
        dtype: Type of the result; None for the grid's own (float32 for quantized grids, bool for masks).
        channel: Number or name of the channel of an index grid; None for its first. See :func:`from_channel`.
        device: Device that reads the voxels; None for the first GPU, else the CPU. The result is on the host.
    Returns:
        DenseGrid with values (X, Y, Z), or (X, Y, Z, C) for grids of C components. It is empty if bounds is None and no
            voxel is active.
    Raises:
        InputError: bounds is not (2, 3), not whole, beyond int32, or its last voxel comes before its first; dtype
            cannot hold the grid's values; there is no such channel.
        FileFormatError: The buffer is not a valid grid, or a channel has fewer values than the grid has indices.
        UnsupportedGridError: The grid stores points, or indices without a channel, instead of values.
        DeviceMemoryError: The array does not fit into memory.
    Example:
        >>> import numpy as np
        >>> cube = np.zeros((4, 4, 4), np.float32)
        >>> cube[1, 2, 3] = 5.0
        >>> grid = to_dense(from_dense(cube, voxel_size=1.0, origin=(10, 0, 0)), device="cpu")
        >>> grid.values.shape, grid.values[0, 0, 0].item(), grid.origin.tolist()
        ((1, 1, 1), 5.0, [11, 2, 3])
    """
    require_volume(volume, "volume")
    if channel is not None or volume.info.grid_type in INDEX_TYPES:
        from geokit.volume.retyped.from_channel import from_channel

        volume = from_channel(volume, 0 if channel is None else channel)
    native, components = native_of(volume)
    wanted = native if dtype is None else _dtype(dtype, native)
    box = volume.info.index_bounds if bounds is None else _whole_numbers(bounds, "bounds", (2, 3))
    if box is None:
        box = np.array([[0, 0, 0], [-1, -1, -1]], np.int64)
    elif (box < INT32.min).any() or (box > INT32.max).any() or (box[0] > box[1]).any():
        raise InputError(f"bounds: {box.tolist()} is not a box of int32 indices; give its first and its last voxel")
    size = [int(n) for n in box[1] - box[0] + 1]
    need = size[0] * size[1] * size[2] * components * wanted.itemsize
    what = f"bounds: {' x '.join(map(str, size))} voxels of {wanted} need"
    available_memory.require_room(need, what, "ask for a smaller box, or sample() the points that matter")
    values = np.empty((*size, components), wanted)
    _read_box(volume, box[0], values, launcher.resolve_device(device))
    shape = tuple(size) if components == 1 else (*size, components)
    return DenseGrid(values.reshape(shape), box[0].copy(), volume.info.transform.copy())


def _read_box(volume: SparseVolume, origin: NDArray[np.int64], values: NDArray[Any], device: Any) -> None:
    """Fill ``values`` (X, Y, Z, C): in place on the CPU if the types agree, else a few slabs or rows at a time."""
    if not values.size:
        return
    size_x, size_y, size_z, components = values.shape
    kernel, dtype = _reader_of(volume.info.grid_type, components)
    handle = wp.uint64(volume.id(device))

    def read(x: int, y: int, count_x: int, count_y: int, out: Any) -> None:
        lower = wp.vec3i(int(origin[0]) + x, int(origin[1]) + y, int(origin[2]))
        launcher.launch(kernel, count_x * count_y, [handle, lower, count_y, size_z], [out], device, grain=ROW_GRAIN)

    if device.is_cpu and components == 1 and values.dtype == wp.dtype_to_numpy(dtype):
        read(0, 0, size_x, size_y, wp.array(values.reshape(-1), dtype=dtype, device=device, copy=False))
        return
    rows = max(1, VOXELS_AT_A_TIME // size_z)
    step_y = min(size_y, rows)
    step_x = max(1, rows // size_y)
    scratch = wp.empty(step_x * step_y * size_z, dtype=dtype, device=device)
    for x in range(0, size_x, step_x):
        for y in range(0, size_y, step_y):
            part = values[x : x + step_x, y : y + step_y]
            count = part.shape[0] * part.shape[1]
            read(x, y, part.shape[0], part.shape[1], scratch)
            np.copyto(part, scratch[: count * size_z].numpy().reshape(part.shape), casting="unsafe")


def _reader_of(grid_type: str, components: int) -> tuple[Any, Any]:
    """The kernel that reads rows of a grid, and the type of the values that it writes."""
    from geokit.volume.tree.dense_rows_kernels import DENSE_KERNELS, exact_kernel, float_kernel

    if grid_type == "int64":
        return exact_kernel, wp.int64
    if grid_type == "float":
        return float_kernel, wp.float32
    return DENSE_KERNELS[components], {1: wp.float64, 3: wp.vec3d, 4: wp.vec4d}[components]


def _read_dense(values: Any) -> NDArray[Any]:
    require_unrecorded(values, "values")
    try:
        if isinstance(values, wp.array):
            array = values.numpy()
        elif not isinstance(values, np.ndarray) and hasattr(values, "__dlpack__"):
            array = wp.from_dlpack(values).numpy()
        else:
            array = read_array(values, "values", kinds="fiub")
    except InputError:
        raise
    except Exception as error:  # of the other library, or warp
        raise InputError(f"values: cannot be read as an array of numbers ({error}); pass a NumPy array") from error
    if array.ndim not in (3, 4) or array.dtype.kind not in "fiub":
        raise InputError(
            f"values: {array.dtype} with shape {array.shape} is not an (X, Y, Z) or (X, Y, Z, C) array of real "
            "numbers; give one scalar or vector for each voxel"
        )
    return array


def _transform_of(transform: Any, voxel_size: Any) -> NDArray[np.float64]:
    if transform is not None and voxel_size is not None:
        raise InputError("transform: give either a transform or a voxel_size")
    if transform is not None:
        return read_array(transform, "transform", np.float64)
    sizes = read_array(1.0 if voxel_size is None else voxel_size, "voxel_size", np.float64)
    if sizes.shape not in ((), (1,), (3,)) or not (np.isfinite(sizes) & (sizes > 0.0)).all():
        raise InputError(f"voxel_size: {sizes.tolist()} is not positive and finite; give one edge length or three")
    return np.diag([*np.broadcast_to(sizes, 3), 1.0])


def _whole_numbers(value: Any, name: str, shape: tuple[int, ...]) -> NDArray[np.int64]:
    numbers = read_array(value, name, np.float64)
    if numbers.shape != shape or not np.isfinite(numbers).all() or (numbers != np.floor(numbers)).any():
        raise InputError(f"{name}: {described(value)} is not an array {shape} of whole numbers; give voxel indices")
    if (np.abs(numbers) > 2.0**53).any():
        raise InputError(f"{name}: {described(value)} is beyond int32; give voxel indices")
    return numbers.astype(np.int64)


def native_of(volume: SparseVolume) -> tuple[np.dtype[Any], int]:
    """Type in which the values of a grid are stored, and number of components of a voxel."""
    layout = LAYOUTS.get(volume.info.grid_type)
    if layout is None:
        raise UnsupportedGridError(
            f"volume: grid {volume.info.name!r} of type {volume.info.grid_type} stores no values of its own; convert "
            f"it to one of {', '.join(LAYOUTS)}"
        )
    return layout.background.base, math.prod(layout.background.shape)


def _dtype(dtype: Any, native: np.dtype[Any]) -> np.dtype[Any]:
    try:
        if isinstance(dtype, (np.generic, np.ndarray)):
            raise TypeError("a value, not a type")
        wanted = np.dtype(dtype)
    except Exception as error:  # of the caller's own type
        raise InputError(f"dtype: {described(dtype)} is no NumPy type; use one that holds {native}") from error
    if wanted.kind not in "fiub" or not np.can_cast(native, wanted, "same_kind"):
        raise InputError(f"dtype: {wanted} does not hold the grid's {native}; use a float type or {native}")
    return wanted
