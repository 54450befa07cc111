"""Queries on several devices: each answers a block of the rows, and the answers are joined in order.

A row's answer does not depend on the other rows, so it has the bits that one device gives. The caller's current CUDA
device is after a call what it was before.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.base.query import FIRST_ALONE, Query
from geokit.core.base.snapshot import snapshot
from geokit.core.blocks.shared_rows import Question
from geokit.core.gradients.rules import held_by, is_tracked, is_warp_array
from geokit.errors import InputError

# Fewest rows for each device; the first device alone answers fewer. Rows on a GPU are answered sooner, and copies
# between GPUs take a millisecond or two, so there have to be more.
LEAST_ROWS = 1 << 15
LEAST_ON_GPUS = 1 << 20

_Answer = TypeVar("_Answer")
_Class = TypeVar("_Class", bound=type)


def devices_of(device: Any) -> list["wp.Device"] | None:
    """The devices of a list, or all GPUs for "cuda:*"; None for one device.

    Raises:
        InputError: The list is empty, an entry is None, or there is no such device, or no GPU at all.
    """
    if not launcher.is_several(device):
        return None
    if not device:
        raise InputError("device: the list is empty; name at least one device")
    given = [device] if isinstance(device, str) else list(device)
    if any(one is None for one in given):
        raise InputError(f"device: entry {given.index(None)} is None; name each device of a list")
    return [launcher.resolve_device(name) for one in given for name in _named(one)]


def _named(one: Any) -> Sequence[Any]:
    if not (isinstance(one, str) and launcher.is_several(one)):
        return (one,)
    gpus = launcher.cuda_devices()
    if not gpus:
        raise InputError(f"device: {one!r} is all GPUs, and this machine has none; use 'cpu'")
    return gpus


def _current_kept(devices: Sequence["wp.Device"]) -> Any:
    """Context that leaves the current CUDA device of the calling thread as it was, which is that of torch too.

    Warp makes a device current for each call on it, and leaves it so. This one is pushed on the driver's stack, whose
    top warp changes, and popped in the end.
    """
    return next((device.context_guard for device in devices if device.is_cuda), contextlib.nullcontext())


def replicas(make: Callable[["wp.Device"], _Answer], device: Any) -> tuple[_Answer, ...]:
    """What ``make`` returns for each device."""
    devices = devices_of(device) or []
    with _current_kept(devices):
        return tuple(map(make, devices))


class OnDevices:
    """Base of an object that has a replica on each of several devices; all but its queries is that of the first."""

    _parts: tuple[Any, ...]

    def __getattr__(self, name: str) -> Any:
        # Called for what is not in this object itself.
        if name == "_parts":
            raise AttributeError(name)
        return getattr(self._parts[0], name)

    @property
    def _aliases(self) -> list[str]:
        return [part.device for part in self._parts]

    def _update(self, rows: Any) -> None:
        """Move the vertices or points of each replica."""
        moved = [snapshot(part) for part in self._parts]
        with _current_kept([part._device for part in moved]):
            for part in moved:
                part.update(rows)
        self.__dict__ = {"_parts": tuple(moved)}  # at once: see snapshot


def shows_arguments(cls: _Class) -> _Class:
    """Decorate a class whose ``__new__`` chooses a subclass: ``help`` shows the arguments of its ``__init__``."""
    whole = inspect.signature(cls.__init__)  # type: ignore[misc]
    cls.__signature__ = whole.replace(parameters=list(whole.parameters.values())[1:])  # type: ignore[attr-defined]
    return cls


def are_asked(given: Sequence[Any], options: Mapping[str, Any]) -> bool:
    """Whether a call is one of several devices: of its object, or of its option ``device``."""
    device = options.get("device")
    return (len(given) > 0 and isinstance(given[0], OnDevices)) or (device is not None and launcher.is_several(device))


def answer(query: Query, given: tuple[Any, ...], options: dict[str, Any]) -> Any:
    """The answer of a call of several devices, which is joined from those of each, in the order of the rows."""
    owner, options = query.bind(given, options)[query.positional[0]], dict(options)
    if isinstance(owner, OnDevices):
        devices = [part._device for part in owner._parts]
        queries = [functools.partial(query.call, part) for part in owner._parts]
        owner = owner._parts[0]
    else:
        devices = devices_of(options.pop("device")) or []
        queries = [functools.partial(query.call, owner, device=one) for one in devices]
    values = list(given[1:])
    values += [options.pop(name) for name in query.rows[len(values) :] if name in options]
    options.pop(query.positional[0], None)
    rows, least = len(query.rows), query.least_rows or FIRST_ALONE
    # A graph stays on its device, and groups are not cut.
    whole = held_by(owner) or any(held_by(value) or is_tracked(value) for value in options.values())
    whole = whole or options.get("groups") is not None
    with _current_kept(devices):
        total = 0 if whole or least == FIRST_ALONE else _rows_of(values, rows)
        on_gpu = total > 0 and _is_on_gpu(values[0])
        count = min(len(queries), total // (least if on_gpu else LEAST_ROWS))
        quick = least > LEAST_ON_GPUS
        asked = Question(queries[:count], devices[:count], values[:rows], values[rows:], options, is_quick=quick)
        if count < 2 or (on_gpu and not asked.reaches_all()):
            return queries[0](*values, **options)
        try:
            return asked.of_host_rows() if isinstance(values[0], np.ndarray) else asked.of_arrays()
        except InputError:
            # Of a row, whose number is that in its part: asked again it is named as the caller counts.
            return queries[0](*values, **options)


def _rows_of(given: Sequence[Any], rows: int) -> int:
    """Number of rows; 0 for what the query has to judge, and for what one device answers."""
    values = given[:rows]
    if len(values) < rows or any(type(value) is not type(values[0]) for value in values):
        return 0
    if not _is_known(values[0]) or any(np.ndim(value) != 2 or is_tracked(value) for value in values):
        return 0
    return len(values[0]) if len({len(value) for value in values}) == 1 else 0


def _is_known(value: Any) -> bool:
    torch = sys.modules.get("torch")
    return isinstance(value, np.ndarray) or is_warp_array(value) or (torch is not None and type(value) is torch.Tensor)


def _is_on_gpu(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return False
    return bool(value.device.is_cuda if is_warp_array(value) else value.is_cuda)
