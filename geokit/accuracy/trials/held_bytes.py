"""Memory of the structures that a method prepared."""

from __future__ import annotations

from typing import Any

__all__ = ["held_bytes"]


def held_bytes(*things: Any) -> int:
    """Bytes of all warp arrays reachable through attributes, warp structs and tuples; each is counted once.

    Memory behind a warp handle (the tree of a ``wp.Mesh``, the cells of a ``wp.HashGrid``) is not included.
    """
    import warp as wp

    sizes: dict[int, int] = {}
    seen: set[int] = set()
    waiting = list(things)
    while waiting:
        thing = waiting.pop()
        if id(thing) in seen:
            continue
        seen.add(id(thing))
        if isinstance(thing, wp.array):
            if thing.ptr:
                sizes[thing.ptr] = max(sizes.get(thing.ptr, 0), thing.capacity)
        elif isinstance(thing, (tuple, list)):
            waiting.extend(thing)
        elif isinstance(getattr(thing, "__dict__", None), dict) and not isinstance(thing, type):
            # Warp's own objects reference all of warp.
            is_warp = type(thing).__module__.partition(".")[0] == "warp"
            parts = vars(thing).values()
            waiting.extend(part for part in parts if isinstance(part, wp.array) or not is_warp)
    return sum(sizes.values())
