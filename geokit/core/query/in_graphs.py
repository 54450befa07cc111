"""Calls that a CUDA graph captures, by warp or by torch.

A graph makes the launches of a call again, on its own memory, and the host takes no part in that. So flags of bad rows
are not read (:func:`geokit.core.memory.pinned.host_flags`), nothing is copied from the host, and a graph captures only
calls that were made before: what the first call of its kind builds and keeps would be the graph's, and empty.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Hashable
from typing import Any

import numpy as np

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.base.object_cache import ObjectCache
from geokit.core.base.query import Query
from geokit.core.interop.objects import getattr_or_none
from geokit.core.launches import captured
from geokit.core.launches.prepared import PLAIN
from geokit.errors import InputError

# Calls that an object notes: types and numbers of rows, and options.
MOST_NOTED = 256
# Key of the noted calls in the cache of the object that is queried.
NOTED = "noted calls"
# Rows of these types are copied, which is refused where they are read.
IN_HOST_MEMORY = (np.ndarray, list, tuple)


def answer(query: Query, search: Callable[..., Any], given: tuple[Any, ...], options: dict[str, Any]) -> Any:
    """The answer of a call by ``search(query, given, options)``, which a graph may be capturing.

    Raises:
        InputError: It is, and such a call was not made before, or none can be captured.
    """
    cache = getattr(given[0], "_cache", None) if given else None
    rows = given[1 : 1 + len(query.rows)]
    if type(cache) is not ObjectCache or any(isinstance(value, IN_HOST_MEMORY) for value in rows):
        return search(query, given, options)
    values = *given[1:], *options.values()
    with _capture_of_torch(getattr(given[0], "_device", None), values):
        key = query, tuple(options), *map(_kind_of, values)
        if key in cache.find(NOTED, set):
            return search(query, given, options)
        device = getattr(given[0], "_device", None) or launcher.resolve_device(options.get("device"))
        if captured.is_captured(device):
            raise InputError(
                f"{query.name}: a CUDA graph captures calls that were made before, as the first one builds what the "
                "others use; make it once before the capture, with rows of the same type and number and these options"
                if query.is_replayed
                else f"{query.name}: its answer is read on the host, where a CUDA graph has no part; call it outside"
            )
        found = search(query, given, options)
        if query.is_replayed:
            known: set[Hashable] = cache.find(NOTED, set)  # anew: the call may have cleared the cache
            if len(known) >= MOST_NOTED:
                known.clear()
            known.add(key)
        return found


def _kind_of(value: Any) -> Hashable:
    """What two calls have in common in an argument: the type and shape of an array, the value of a plain option."""
    shape = getattr_or_none(value, "shape")
    if isinstance(shape, tuple):
        return type(value), str(shape), str(getattr_or_none(value, "dtype"))
    return type(value), value if type(value) in PLAIN else id(value)


@contextlib.contextmanager
def _capture_of_torch(device: Any, values: tuple[Any, ...]) -> Any:
    """Warp's part in a capture by torch, on the device of an object or of a tensor: its stream, and notice of it."""
    torch: Any = sys.modules.get("torch")
    places = [] if device is None or not device.is_cuda else [device.ordinal]
    if torch is not None and not places:
        places = [value.device for value in values if isinstance(value, torch.Tensor) and value.is_cuda]
    if torch is None or not places or not torch.cuda.is_current_stream_capturing():
        yield
        return
    stream = wp.stream_from_torch(torch.cuda.current_stream(places[0]))
    if stream in stream.device.captures:  # a capture of warp's, in which torch is asked
        yield
        return
    with wp.ScopedStream(stream, sync_enter=False), wp.ScopedCapture(stream=stream, external=True):
        yield
