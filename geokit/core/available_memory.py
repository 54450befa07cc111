"""Free memory of the host and of a device.

It is checked before a large allocation, because a process that the system kills cannot report an error.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import warp as wp

__all__ = ["available", "available_host"]

# Used where the system reports nothing: small enough for any machine, large enough for ordinary work.
ASSUMED_BYTES = 4 << 30


def available_host() -> int:
    """Bytes that the host can allocate without swapping, at most what the container's limit leaves."""
    free = ASSUMED_BYTES
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            for line in file:
                if line.startswith("MemAvailable:"):
                    free = int(line.split()[1]) << 10
                    break
    except OSError:
        if hasattr(os, "sysconf") and "SC_AVPHYS_PAGES" in os.sysconf_names:
            free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return min(free, _control_group_rest())


def _control_group_rest() -> int:
    try:
        with open("/sys/fs/cgroup/memory.max", encoding="ascii") as file:
            limit = file.read().strip()
        with open("/sys/fs/cgroup/memory.current", encoding="ascii") as file:
            used = int(file.read())
    except (OSError, ValueError):
        return 1 << 62
    return max(0, int(limit) - used) if limit.isdigit() else 1 << 62


def available(device: "wp.Device") -> int:
    """Bytes that can still be allocated on ``device``."""
    return available_host() if device.is_cpu else int(device.free_memory)
