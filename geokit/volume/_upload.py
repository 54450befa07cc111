"""Volumes on devices: one warp.Volume per device, made when first asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from geokit._launch import resolve_device
from geokit.errors import DeviceMemoryError
from geokit.volume._nanovdb import aligned_buffer
from geokit.volume._nanovdb_checks import check_grid
from geokit.volume._nanovdb_layout import ALIGNMENT
from geokit.volume.model import SparseVolume

if TYPE_CHECKING:
    import warp as wp

__all__ = ["upload"]


def upload(volume: SparseVolume, device: Any = None) -> "wp.Volume":
    """The grid as a warp.Volume on a device, kept with the volume.

    On the CPU it shares the host buffer's memory; on a GPU it is copied there once.

    Args:
        volume: The grid.
        device: Alias or warp device; None for the first GPU, else the CPU.

    Returns:
        The same warp.Volume for every call with the same device.

    Raises:
        InputError: There is no such device.
        FileFormatError: The buffer is not a sound grid.
        UnsupportedGridError: The grid's type cannot be used.
        DeviceMemoryError: The device has too little free memory.
    """
    import warp as wp

    found = resolve_device(device)
    if found.alias in volume._uploads:
        return volume._uploads[found.alias][0]
    buffer = volume.nanovdb
    if not volume._uploads:
        # A kernel follows the buffer's offsets blindly, whoever made it.
        check_grid(buffer, f"volume {volume.info.name!r}")
    if found.is_cuda and found.free_memory < len(buffer):
        raise DeviceMemoryError(
            f"volume {volume.info.name!r}: {len(buffer)} bytes do not fit into the {found.free_memory} free bytes of "
            f"{found.alias}; use a coarser grid or another device"
        )
    if found.is_cpu and buffer.ctypes.data % ALIGNMENT:
        moved = aligned_buffer(len(buffer))
        moved[:] = buffer
        buffer = moved
    try:
        array: Any = wp.array(buffer, dtype=wp.uint8, device=found, copy=not found.is_cpu)
    except (RuntimeError, MemoryError) as error:
        raise DeviceMemoryError(
            f"volume {volume.info.name!r}: {len(buffer)} bytes could not be had on {found.alias}; use a coarser "
            "grid or another device"
        ) from error
    made = wp.Volume(array, copy=False)
    # The warp volume does not own its memory: the array, and with it the host buffer, must outlive it.
    volume._uploads[found.alias] = (made, array, buffer)
    return made
