"""What the system says of this process and of the machine; little where it is not Linux, nothing where not POSIX."""

from __future__ import annotations

import contextlib
from pathlib import Path

UNLIMITED = 1 << 62


def limits(kind: str) -> list[int]:
    """Soft and hard limit of RLIMIT_ and ``kind``; UNLIMITED where there is none."""
    try:
        import resource
    except ImportError:
        return [UNLIMITED, UNLIMITED]
    found = resource.getrlimit(getattr(resource, f"RLIMIT_{kind}"))
    return [UNLIMITED if limit == resource.RLIM_INFINITY else limit for limit in found]


def said(file: str | Path, name: str) -> list[str]:
    """The words after a name in the first line of a file of /proc that begins with it; none without such a line."""
    with contextlib.suppress(OSError), open(file, encoding="utf-8", errors="replace") as lines:
        return next((line.partition(":")[2].split() for line in lines if line.startswith(name)), [])
    return []
