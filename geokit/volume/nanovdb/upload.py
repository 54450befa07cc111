"""Volumes on devices: one warp.Volume per device, made on first use."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from geokit.core.base.late_warp import wp
from geokit.core.download import download_into
from geokit.core.launcher import resolve_device
from geokit.core.memory.available_memory import available
from geokit.errors import DeviceMemoryError
from geokit.volume.nanovdb.checks import check_volume
from geokit.volume.nanovdb.grid_array import array_of, copied_grid, made_volume
from geokit.volume.nanovdb.header import HEAD_SIZE, TREE_OFFSET, aligned_buffer, grid_header, tree_header
from geokit.volume.nanovdb.layout import ALIGNMENT

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from geokit.volume.model.sparse_volume import SparseVolume


def upload(volume: SparseVolume, device: Any = None) -> "wp.Volume":
    """Upload a grid to a device as a warp.Volume, which is cached with the volume.

    On the CPU it shares the host buffer's memory. To a GPU it is copied once.

    Args:
        volume: The grid.
        device: Alias or warp device; None for the first GPU, else the CPU.

    Returns:
        The same warp.Volume for all calls with the same device.

    Raises:
        InputError: There is no such device.
        FileFormatError: The buffer is not a valid grid.
        UnsupportedGridError: The grid's type is not supported.
        DeviceMemoryError: The device has too little free memory.
    """
    found = resolve_device(device)
    if found.alias in volume._uploads:
        return volume._uploads[found.alias][0]
    buffer = volume.nanovdb
    check_volume(volume)  # a kernel follows the buffer's offsets blindly
    if found.is_cuda and (free := available(found)) < len(buffer):
        raise DeviceMemoryError(
            f"volume {volume.info.name!r}: {len(buffer)} bytes do not fit into the {free} free bytes of "
            f"{found.alias}; use a coarser grid or another device",
            need=len(buffer),
        )
    if found.is_cpu and buffer.ctypes.data % ALIGNMENT:
        moved = aligned_buffer(len(buffer))
        moved[:] = buffer
        buffer = moved
    try:
        array = array_of(buffer) if found.is_cpu else copied_grid(array_of(buffer), len(buffer), found)
    except (RuntimeError, MemoryError) as error:
        raise DeviceMemoryError(
            f"volume {volume.info.name!r}: {len(buffer)} bytes could not be had on {found.alias}; use a coarser "
            "grid or another device",
            need=len(buffer),
        ) from error
    try:
        made: Any = made_volume(array, len(buffer))
    except RuntimeError:
        # Warp identifies a volume by its address, so a buffer that another volume already uses must be copied.
        if found.is_cpu:
            moved = aligned_buffer(len(buffer))
            moved[:] = buffer
            array, buffer = array_of(moved), moved
        else:
            array = copied_grid(array, len(buffer), found)
        made = made_volume(array, len(buffer))
    # The warp volume does not own its memory: the array, and with it the host buffer, must outlive it, even if the
    # caller keeps no other reference.
    made._geokit_source = (array, buffer)
    # Of threads that come at the same time all get the first one's: kernels know its address, and nobody may free it.
    kept: wp.Volume = volume._uploads.setdefault(found.alias, (made, array, buffer))[0]
    return kept


def download(volume: SparseVolume) -> NDArray[np.uint8]:
    """Download the host buffer of a volume that :func:`made_on_device` has made."""
    source = _source(volume)
    return _front(source, int(grid_header(_front(source, HEAD_SIZE))["grid_size"]))


def above_leaves(volume: SparseVolume) -> NDArray[np.uint8]:
    """The part of the buffer before its leaves (headers, root and inner nodes), or all of it.

    For a grid that exists only on a device, no more than that is copied to the host.
    """
    if "nanovdb" in volume.__dict__:
        return volume.nanovdb
    source = _source(volume)
    leaves, *others = (int(offset) for offset in tree_header(_front(source, HEAD_SIZE))["node_offset"])
    return _front(source, TREE_OFFSET + leaves) if leaves > max(others) else volume.nanovdb


def _source(volume: SparseVolume) -> Any:
    return next(entry[1] for entry in volume._uploads.values() if isinstance(entry, tuple))


def _front(source: "wp.array", size: int) -> NDArray[np.uint8]:
    """The first bytes of a grid on a device."""
    buffer = aligned_buffer(size)
    download_into(buffer, source)
    return buffer
