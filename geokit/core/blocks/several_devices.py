"""Queries on several devices: each answers a block of the rows, and the answers are joined in order.

A row's answer does not depend on the other rows, so it has the bits that one device gives. The caller's current CUDA
device is after a call what it was before.

Held by: tests/core/blocks/test_several_devices.py
"""

from __future__ import annotations

import collections
import contextlib
import functools
import inspect
import itertools
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np

from geokit.core import launcher
from geokit.core.gradients.rules import held_by, is_tracked
from geokit.core.snapshot import snapshot
from geokit.errors import InputError

if TYPE_CHECKING:
    import warp as wp
    from numpy.typing import NDArray

__all__ = ["OnDevices", "devices_of", "over_devices", "replicas", "shares"]

# Fewest rows for each device; the first device alone answers fewer. Rows on a GPU are answered sooner, and copies
# between GPUs take a millisecond or two, so there have to be more.
LEAST_ROWS = 1 << 15
LEAST_ROWS_ON_GPUS = 1 << 20
# Rows on the host are dealt in blocks, to whichever device is ready: so many to each at a time, so that one is copied
# while another is answered, and each of at most so many rows.
BLOCKS_AT_A_TIME = 2
MOST_ROWS = 1 << 20

_Arguments = ParamSpec("_Arguments")
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


def shares(least: Mapping[str, int] = MappingProxyType({}), /, **queries: int) -> Callable[[_Class], _Class]:
    """Decorate a subclass of :class:`OnDevices`: give it these queries of its other base.

    Args:
        least: For some of them the fewest rows for each device, where the rows are on a GPU.
        queries: How many of the arguments of each are rows, (N, 3).
    """

    def decorate(cls: _Class) -> _Class:
        for name, rows in queries.items():
            setattr(cls, name, _shared(getattr(cls, name), rows, least.get(name, LEAST_ROWS_ON_GPUS)))
        return cls

    return decorate


def _shared(query: Callable[..., Any], rows: int, least: int) -> Callable[..., Any]:
    names = _row_names(query, rows)

    @functools.wraps(query)
    def run(owner: Any, *given: Any, **options: Any) -> Any:
        queries = [functools.partial(query, part) for part in owner._parts]
        devices = [part._device for part in owner._parts]
        with _current_kept(devices):
            if held_by(owner._parts[0]) or options.get("groups") is not None:
                return queries[0](*given, **options)
            values = [*given, *(options.pop(name) for name in names[len(given) :] if name in options)]
            return _answer(queries, devices, rows, least, values, options)

    return run


def _row_names(query: Callable[..., Any], rows: int) -> list[str]:
    return list(inspect.signature(query).parameters)[1 : rows + 1]


def over_devices(
    rows: int = 1, *, least: int | None = LEAST_ROWS_ON_GPUS
) -> Callable[[Callable[_Arguments, _Answer]], Callable[_Arguments, _Answer]]:
    """Decorate a query whose option ``device`` may be several devices.

    Args:
        rows: Number of the arguments after the first that are rows, (N, 3).
        least: Fewest rows for each device, where the rows are on a GPU; None where answers never take longer than the
            copies between devices, so that the first device alone answers.
    """

    def decorate(query: Callable[_Arguments, _Answer]) -> Callable[_Arguments, _Answer]:
        names = _row_names(query, rows)

        @functools.wraps(query)
        def run(*given: _Arguments.args, **options: _Arguments.kwargs) -> _Answer:
            if not launcher.is_several(options.get("device")):
                return query(*given, **options)
            answer: _Answer = on_each(*given, **options)
            return answer

        def on_each(volume: Any, *given: Any, device: Any, **options: Any) -> Any:
            devices: Any = devices_of(device)
            queries: list[Any] = [functools.partial(query, volume, device=one) for one in devices]
            with _current_kept(devices):
                if held_by(volume) or least is None:
                    return queries[0](*given, **options)
                values = [*given, *(options.pop(name) for name in names[len(given) :] if name in options)]
                return _answer(queries, devices, rows, least, values, options)

        return run

    return decorate


def _answer(
    queries: Sequence[Callable[..., Any]],
    devices: Sequence["wp.Device"],
    rows: int,
    least: int,
    given: Sequence[Any],
    options: dict[str, Any],
) -> Any:
    """The answer to rows that are arguments of one kind: arrays of NumPy or of warp, or tensors of torch."""
    values, total = given[:rows], _rows_of(given, rows)
    if any(held_by(value) or is_tracked(value) for value in options.values()):
        total = 0  # a graph stays on its device
    count = min(len(queries), total // (least if total and _is_on_gpu(values[0]) else LEAST_ROWS))
    if count < 2:
        return queries[0](*given, **options)
    each = {name for name, value in options.items() if name == "radius" and np.ndim(value) == 1}
    on_host = isinstance(values[0], np.ndarray)
    size = total / count
    if on_host:
        size = max(LEAST_ROWS, min(MOST_ROWS, -(-total // (2 * BLOCKS_AT_A_TIME * count))))
    blocks = -(-total // size) if on_host else count
    ends = [min(round(size * k), total) for k in range(int(blocks) + 1)]
    progress = options.get("progress")
    done = _Progress(progress, total, len(ends) - 1) if callable(progress) else None
    whole = _Whole(total)

    def ask(k: int, device: int, values: Sequence[Any]) -> None:
        own = {name: value[ends[k] : ends[k + 1]] if name in each else value for name, value in options.items()}
        if done is not None:
            own["progress"] = functools.partial(done, k)
        whole.put(k, ends[k], queries[device](*values, *given[rows:], **own))

    if on_host:
        waiting = iter(range(len(ends) - 1))

        def work(device: int) -> None:
            for k in waiting:  # the threads share it; the GIL makes taking the next one safe
                ask(k, device, [value[ends[k] : ends[k + 1]] for value in values])

        calls = [functools.partial(work, device) for device in range(count) for _ in range(BLOCKS_AT_A_TIME)]
    else:
        waiting = iter(())
        # Copies between GPUs are enqueued by this thread, whose stream has made the rows.
        moved = [[_part(value, ends[k], ends[k + 1], devices[k]) for value in values] for k in range(count)]
        calls = [functools.partial(ask, k, k, moved[k]) for k in range(count)]
    with ThreadPoolExecutor(len(calls)) as pool:
        try:
            for job in [pool.submit(call) for call in calls]:
                job.result()
        except InputError:
            # Of a row, whose number is that in its part: asked again it is named as the caller counts.
            return queries[0](*given, **options)
        finally:
            collections.deque(waiting, maxlen=0)  # after an error nobody takes another block
    return whole.answer(values[0])


class _Whole:
    """Collects the answers of parts; arrays on the host with a row for each row are filled in place."""

    def __init__(self, total: int) -> None:
        self._total, self._parts = total, dict[int, Any]()
        self._arrays: list[NDArray[Any]] | None = None
        self._kind: Any = None
        self._lock = threading.Lock()

    def put(self, k: int, first: int, answer: Any) -> None:
        arrays = answer if isinstance(answer, tuple) else (answer,)
        lists = "offsets" in getattr(answer, "_fields", ())
        if lists or not all(isinstance(array, np.ndarray) for array in arrays):
            self._parts[k] = answer
            return
        with self._lock:
            if self._arrays is None:
                self._kind = type(answer) if isinstance(answer, tuple) else None
                self._arrays = [np.empty((self._total, *array.shape[1:]), array.dtype) for array in arrays]
        for target, array in zip(self._arrays, arrays, strict=True):
            target[first : first + len(array)] = array

    def answer(self, like: Any) -> Any:
        if self._arrays is None:
            return _joined([self._parts[k] for k in sorted(self._parts)], like)
        return self._arrays[0] if self._kind is None else tuple.__new__(self._kind, self._arrays)


class _Progress:
    """Adds up the progress of the parts."""

    def __init__(self, told: Callable[[int, int], None], total: int, count: int) -> None:
        self._told, self._total, self._done = told, total, [0] * count
        self._lock = threading.Lock()

    def __call__(self, part: int, done: int, _: int) -> None:
        with self._lock:
            self._done[part] = done
            self._told(sum(self._done), self._total)


def _rows_of(given: Sequence[Any], rows: int) -> int:
    """Number of rows; 0 for what the query has to judge, and for what one device answers."""
    values = given[:rows]
    if len(values) < rows or any(type(value) is not type(values[0]) for value in values):
        return 0
    if not _is_known(values[0]) or any(np.ndim(value) != 2 or is_tracked(value) for value in values):
        return 0
    return len(values[0]) if len({len(value) for value in values}) == 1 else 0


def _is_known(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return True
    torch, warp = sys.modules.get("torch"), sys.modules.get("warp")
    return (torch is not None and type(value) is torch.Tensor) or (warp is not None and isinstance(value, warp.array))


def _is_on_gpu(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return False
    return bool(value.device.is_cuda if isinstance(value, _warp_array()) else value.is_cuda)


def _part(value: Any, first: int, stop: int, device: "wp.Device") -> Any:
    part = value[first:stop]
    if isinstance(value, np.ndarray) or device.is_cpu:
        return part
    return _on(part, device.alias)


def _on(value: Any, alias: str) -> Any:
    """A part of what the caller gave, or of an answer, on a GPU; what is on the host stays there."""
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(value, torch.Tensor):
        return value if value.is_cpu else value.to(alias)
    import warp as wp

    return value if value.device.is_cpu or value.device.alias == alias else wp.clone(value, device=alias)


def _joined(answers: list[Any], like: Any) -> Any:
    first = answers[0]
    if not isinstance(first, tuple):
        return _concatenated(answers, like)
    fields: list[Any] = []
    for name, *parts in zip(getattr(first, "_fields", ()), *answers, strict=True):
        if parts[0] is None:
            fields.append(None)
        elif name == "offsets":
            # Those of a part begin where the lists of the parts before it end.
            begins = itertools.accumulate((int(_host(part)[-1]) for part in parts), initial=0)
            moved = [_plus(part, begin) for part, begin in zip(parts, begins, strict=False)]
            fields.append(_concatenated([moved[0], *(part[1:] for part in moved[1:])], like))
        else:
            fields.append(_concatenated(parts, like))
    return tuple.__new__(type(first), fields)


def _host(value: Any) -> Any:
    return value.numpy() if isinstance(value, _warp_array()) else value


def _plus(value: Any, number: int) -> Any:
    if not isinstance(value, _warp_array()):
        return value + number
    import warp as wp

    return wp.array(value.numpy() + number, dtype=value.dtype, device=value.device)


def _warp_array() -> Any:
    import warp as wp

    return wp.array


def _concatenated(parts: Sequence[Any], like: Any) -> Any:
    if isinstance(parts[0], np.ndarray):
        return np.concatenate(parts)
    if not isinstance(parts[0], _warp_array()):
        torch: Any = sys.modules["torch"]
        return torch.cat([_on(part, str(like.device)) for part in parts])
    import warp as wp

    total = sum(map(len, parts))
    joined = wp.empty((total, *parts[0].shape[1:]), dtype=parts[0].dtype, device=like.device)
    begin = 0
    for part in parts:
        if len(part):
            wp.copy(joined[begin : begin + len(part)], part)
        begin += len(part)
    return joined
