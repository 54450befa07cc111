"""Limits on the decompressed content of files: a few bytes may unfold to more than the memory holds."""

from __future__ import annotations

from pathlib import Path

from geokit.core.memory.available_memory import available_host
from geokit.core.require import require_count
from geokit.errors import DeviceMemoryError

# Measured data (scans, meshes, fields) compress two- to twentyfold, and constant fields up to about fiftyfold.
GROWTH = 100
# Small files may grow more than that: this much does no harm.
HARMLESS = 1 << 30
# Share of the free memory that one file may fill. Its content is held twice while it is converted.
SHARE = 0.5
# Least memory that may be asked of work on files that goes part by part.
LEAST_MEMORY = 1 << 28

_default: int | None = None


def set_default_limit(limit: int | None) -> None:
    """Set the limit that holds where none is given; None means the rule of :func:`content_limit`."""
    global _default
    _default = limit


def default_limit() -> int | None:
    """The limit that holds where none is given; None where the rule of :func:`content_limit` does."""
    return _default


def content_limit(file_bytes: int, memory_limit: int | None = None, *, held: bool = True) -> int:
    """Largest size [bytes] to which the content of a file may decompress.

    By default it is a hundred times the file's size, but at least 1 GiB, and at most half of the free memory.

    Args:
        file_bytes: Size of the file.
        memory_limit: The limit, if the caller gives one.
        held: Whether the content will be in memory; else the memory is no limit.
    Raises:
        InputError: memory_limit is not a positive whole number.
    """
    if memory_limit is not None:
        return require_count(memory_limit, "memory_limit", 1)
    if _default is not None:
        return _default
    limit = max(HARMLESS, GROWTH * file_bytes)
    return min(limit, int(SHARE * available_host())) if held else limit


def working_memory(memory_limit: int | None) -> int:
    """Bytes that work on files may take that goes part by part: ``memory_limit``, or half of the free memory.

    Raises:
        InputError: memory_limit is not a whole number, or below 2^28.
    """
    if memory_limit is None:
        return max(LEAST_MEMORY, int(SHARE * available_host()))
    return require_count(memory_limit, "memory_limit", LEAST_MEMORY)


def require_content(path: Path, content_bytes: int, limit: int) -> None:
    """Check what a file says of its content, before memory is allocated for it.

    Raises:
        DeviceMemoryError: It is more than the limit.
    """
    if content_bytes > limit:
        times = content_bytes / max(1, path.stat().st_size)
        raise DeviceMemoryError(
            f"{path}: its content needs {_shown(content_bytes)} of memory, {times:.3g} times the file's size, and the "
            f"limit is {_shown(limit)}; if you trust the file, raise memory_limit (--memory-limit)",
            need=content_bytes,
        )


def _shown(size: int) -> str:
    for unit, name in ((1 << 30, "GiB"), (1 << 20, "MiB")):
        if size >= unit:
            return f"{size / unit:.3g} {name}"
    return f"{size} bytes"
