"""Free memory of the host and of a device.

It is checked before a large allocation, because a process that the system kills cannot report an error.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

from geokit.core.base.late_warp import wp
from geokit.core.base.system import UNLIMITED, limits, said
from geokit.core.launches import captured
from geokit.core.launches.cuda_driver import cuda_driver
from geokit.errors import DeviceMemoryError

# Used where the system reports nothing: small enough for any machine, large enough for ordinary work.
ASSUMED_BYTES = 4 << 30
RESERVED_MEMORY, USED_MEMORY = 5, 7  # CU_MEMPOOL_ATTR_RESERVED_MEM_CURRENT, CU_MEMPOOL_ATTR_USED_MEM_CURRENT


def available_host() -> int:
    """Bytes that this process can allocate without swapping.

    The least of the system's free memory, what the limits of its control groups leave (versions 1 and 2, also those of
    groups around its own), and what its limit of address space (``ulimit -v``) leaves.
    """
    try:
        return min(_free(), _address_space_rest(), *(_rest_of(*files) for files in _control_groups()))
    except MemoryError:  # not even for a line of text
        return 0


def available(device: "wp.Device") -> int:
    """Bytes that can still be allocated on ``device``, on a GPU also those that warp's allocator holds idle."""
    return available_host() if device.is_cpu else int(device.free_memory) + _idle_in_pool(device)


def require_room(
    need: float, what: str, remedy: str | Callable[[float], str], device: "wp.Device | None" = None
) -> None:
    """Check that ``need`` bytes are free on a device, or on the host.

    Args:
        need: Estimate [bytes].
        what: What needs them, with its verb.
        remedy: What to do instead; or a function that says so, of how many times the free memory is needed.
        device: None for the host.
    Raises:
        DeviceMemoryError: They are not free; the message says how many are.
    """
    if device is not None and captured.is_captured(device):
        return  # the driver is not asked then, and a graph takes calls that have had the room
    have = available_host() if device is None else available(device)
    if need > have:
        where = "" if device is None else f" on {device.alias}"
        remedy = remedy if isinstance(remedy, str) else remedy(need / max(have, 1))
        raise DeviceMemoryError(
            f"{what} about {need / 2**20:.6g} MiB, of {have >> 20} MiB free{where}; {remedy}", need=need
        )


def _idle_in_pool(device: "wp.Device") -> int:
    """Bytes of a GPU that no array uses and warp's allocator keeps for the next: the driver counts them as taken.

    It keeps up to a quarter of the GPU, so that what fits was refused after other work.
    """
    if not device.is_mempool_enabled:
        return 0
    driver, number, pool = cuda_driver(), ctypes.c_int(), ctypes.c_void_p()
    status = driver.cuDeviceGet(ctypes.byref(number), ctypes.c_int(device.ordinal))
    status = status or driver.cuDeviceGetDefaultMemPool(ctypes.byref(pool), number)
    sizes = []
    for attribute in (RESERVED_MEMORY, USED_MEMORY):
        size = ctypes.c_uint64()
        status = status or driver.cuMemPoolGetAttribute(pool, ctypes.c_int(attribute), ctypes.byref(size))
        sizes.append(size.value)
    return 0 if status else max(0, sizes[0] - sizes[1])


def _free() -> int:
    if words := said("/proc/meminfo", "MemAvailable:"):
        return int(words[0]) << 10
    with contextlib.suppress(AttributeError, ValueError):  # not asked by that name, or not at all
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return ASSUMED_BYTES


def _address_space_rest() -> int:
    """Bytes that can still be mapped; every mapping counts, whether it is used or not."""
    limit = limits("AS")[0]
    mapped = said("/proc/self/status", "VmSize:") if limit < UNLIMITED else []
    return max(0, limit - (int(mapped[0]) << 10)) if mapped else UNLIMITED


@lru_cache(maxsize=1)
def _control_groups(
    groups: Path = Path("/proc/self/cgroup"), mounted: Path = Path("/sys/fs/cgroup")
) -> list[tuple[Path, Path, Path]]:
    """Files with the limit, the use and the statistics of each control group that bounds this process's memory.

    Groups without a limit are left out, since each costs as long as the rest of the answer.
    """
    try:
        lines = groups.read_text().splitlines()
    except OSError:
        return []
    found = []
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            root, names = mounted, ("memory.max", "memory.current")
        elif "memory" in controllers.split(","):
            root, names = mounted / "memory", ("memory.limit_in_bytes", "memory.usage_in_bytes")
        else:
            continue
        # In a container the path may be that of the host, and its own group be mounted as the root.
        own = root / path.lstrip("/")
        for folder in {root, own, *(parent for parent in own.parents if root in parent.parents)}:
            files = folder / names[0], folder / names[1], folder / "memory.stat"
            if _rest_of(*files) < UNLIMITED:
                found.append(files)
    return found


def _rest_of(limit: Path, use: Path, statistics: Path) -> int:
    try:
        with open(limit, "rb") as file:
            most = file.read().strip()
        if not most.isdigit() or int(most) >= UNLIMITED >> 2:  # "max", or the largest number of pages
            return UNLIMITED
        used = int(use.read_text())
        # The content of files that were read counts as used, but is given up when memory is needed. Version 1 has
        # a figure with the groups below, and one without.
        kept = dict(line.split() for line in statistics.read_text().splitlines())
        return max(0, int(most) - used + int(kept.get("total_inactive_file", kept.get("inactive_file", 0))))
    except (OSError, ValueError):
        return UNLIMITED
