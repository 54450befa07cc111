"""The active values of a volume as one flat array: read, and replaced."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.gradients.rules import hold, split
from geokit.core.interop.arrays import import_array, is_exporter, reinterpreted
from geokit.core.interop.user_arrays import reported_row
from geokit.core.memory.needs import needs
from geokit.core.require import read_array
from geokit.errors import InputError
from geokit.volume.model.sparse_volume import SparseVolume, made_on_device
from geokit.volume.nanovdb.checks import check_volume, mark_checked
from geokit.volume.nanovdb.grid_array import array_of, copied_grid
from geokit.volume.nanovdb.header import FLAG_HAS_MIN_MAX, aligned_buffer, grid_header
from geokit.volume.nanovdb.layout import LAYOUTS
from geokit.volume.nanovdb.nodes import grid_nodes, set_bits, slot_places
from geokit.volume.tree.leaves import leaves_of, require_volume, value_places

TYPES = ("float", "double")


class ActiveVoxels(NamedTuple):
    """The active voxels of a volume's leaves, each once.

    Attributes:
        coordinates: The voxels [index], shape (A, 3) int32.
        values: Their values, shape (A,), float32 or float64 as the grid.
    """

    coordinates: NDArray[np.int32]
    values: NDArray[np.floating]


@needs(lambda volume: 80 * volume.info.active_voxel_count)
def active_voxels(volume: SparseVolume) -> ActiveVoxels:
    """The active voxels of a volume's leaves, in the order of the leaves in its buffer.

    Active tiles are not among them.

    Args:
        volume: A float or double grid.
    Returns:
        ActiveVoxels with coordinates (A, 3) int32 [index] and values (A,), float32 or float64 as the grid.
    Raises:
        UnsupportedGridError: The grid is neither float nor double.
        FileFormatError: The buffer is not a valid grid.
    Example:
        >>> from geokit.volume import load
        >>> active_voxels(load("data/samples/torus.vdb")).coordinates.shape[1]
        3
    """
    _require_real(volume)
    leaf, rows = grid_nodes(volume.nanovdb).leaf, leaves_of(volume)
    node, slot = set_bits(rows.masks)
    return ActiveVoxels(rows.origins[node] + slot_places(slot, 8).astype(np.int32), leaf.values[node, slot])


@needs(lambda volume, *_, **__: volume.nanovdb.nbytes + 16 * volume.info.active_voxel_count)
def with_values(volume: SparseVolume, values: Any) -> SparseVolume:
    """The same voxels with other active values.

    Values that are a torch tensor which requires gradients are kept as such, and so is an array of warp for a
    ``wp.Tape``: samples, gradients and hits of the new volume then carry gradients with respect to them, so that a
    distance field can be optimized. A tensor on a GPU makes a volume there, without a copy through the host. The new
    grid states no smallest and largest value.

    Args:
        volume: A float or double grid.
        values: One value for each row of :func:`active_voxels`, shape (A,), in any supported container.
    Returns:
        A SparseVolume with the tree, transform and metadata of ``volume``; tiles and background as they are.
    Raises:
        InputError: values is not (A,), or a value is not finite.
        UnsupportedGridError: The grid is neither float nor double.
        FileFormatError: The buffer is not a valid grid.
    Example:
        >>> from geokit.volume import load
        >>> torus = load("data/samples/torus.vdb")
        >>> thicker = with_values(torus, active_voxels(torus).values - 0.01)
        >>> thicker.info.active_voxel_count == torus.info.active_voxel_count
        True
    """
    _require_real(volume)
    plain, tracked = split(values)
    count = len(value_places(volume))
    on_gpu = False
    if is_exporter(plain) and not isinstance(plain, np.ndarray):
        rows = import_array(plain, "values")
        on_gpu = rows.device.is_cuda
        plain = rows if on_gpu else rows.numpy()
    if not on_gpu:
        plain = read_array(plain, "values")
    if tuple(plain.shape) != (count,):
        raise InputError(f"values: shape {tuple(plain.shape)} is not ({count},); give one for each active voxel")
    made = _on_gpu(volume, plain) if on_gpu else _on_host(volume, plain)
    # What belongs to the tree alone is shared.
    for key in ("places of values", "numbers of values"):
        if key in volume._cache:
            made._cache.keep(key, volume._cache.find(key, lambda: None))
    if tracked is not None:
        hold(made, values=tracked)
    return made


def _require_real(volume: SparseVolume) -> None:
    require_volume(volume, "volume", TYPES)
    if volume.info.grid_type not in TYPES:
        raise InputError(f"volume: grid {volume.info.name!r} is quantized; make a float grid of it first (resample)")
    check_volume(volume)


def _on_host(volume: SparseVolume, values: NDArray[Any]) -> SparseVolume:
    bad = ~np.isfinite(values)
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(f"values: row {row} is {values[row]}; give finite numbers")
    buffer = aligned_buffer(len(volume.nanovdb))
    buffer[:] = volume.nanovdb
    kind = LAYOUTS[volume.info.grid_type].background
    buffer[: len(buffer) // kind.itemsize * kind.itemsize].view(kind)[value_places(volume)] = values
    grid_header(buffer)["flags"] &= ~np.uint32(FLAG_HAS_MIN_MAX)
    made = dataclasses.replace(volume, nanovdb=buffer, _uploads={})
    mark_checked(made)
    return made


def _on_gpu(volume: SparseVolume, values: "wp.array") -> SparseVolume:
    from geokit.volume.nanovdb.write_values_kernels import FIRST_BAD, REALS, WRITE_VALUES

    device = values.device

    def template() -> tuple["wp.array", "wp.array"]:
        buffer = volume.nanovdb.copy()
        grid_header(buffer)["flags"] &= ~np.uint32(FLAG_HAS_MIN_MAX)
        places = wp.array(value_places(volume), dtype=wp.int64, device=device)
        return copied_grid(array_of(buffer), len(buffer), device), places

    source, places = volume._cache.find(("values on", device.alias), template)
    if values.dtype not in REALS:
        raise InputError(f"values: {values.dtype.__name__} is not float32 or float64; convert the values")
    row = reported_row(FIRST_BAD[values.dtype], values, [])
    if row >= 0:
        raise InputError(f"values: row {row} is not finite; give finite numbers")
    size = len(volume.nanovdb)
    buffer = copied_grid(source, size, source.device)
    kind = wp.float32 if volume.info.grid_type == "float" else wp.float64
    cells = reinterpreted(buffer, kind, (size // LAYOUTS[volume.info.grid_type].background.itemsize,))
    launcher.launch(WRITE_VALUES[values.dtype, kind], len(values), [places, values], [cells], device)
    return made_on_device(buffer, volume.info)
