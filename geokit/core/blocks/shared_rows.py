"""Rows that several devices answer together: who answers which, and how the answers come into one.

Rows on the host are dealt in blocks to whichever device is ready. Rows in arrays of one device are divided: that device
answers its part in one call; others get fewer, in pieces, where copies take a good part of the time.
"""

from __future__ import annotations

import collections
import contextlib
import functools
import itertools
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from geokit.core.base.late_warp import wp
from geokit.core.blocks.peer_copies import copy_rows, copy_stream, open_memory
from geokit.core.interop.arrays import exporter_like, import_array
from geokit.core.running.thread_placement import Pool

# Blocks of rows on the host: so many are with each device at a time, so that one is copied while another is answered,
# and each is of so many rows.
BLOCKS_AT_A_TIME = 2
LEAST_ROWS_OF_A_BLOCK = 1 << 15
MOST_ROWS_OF_A_BLOCK = 1 << 20
# Rows in arrays, of queries that take not much longer than copies: what another device gets for each row of the device
# that has them, and into how many pieces that is divided, so that one is copied while another is answered.
SHARE_AWAY = 0.8
PIECES = 2


class Question:
    """Rows, (N, 3), with all else that a query is asked, and the query on each device.

    Args:
        queries: The query of each device.
        devices: The devices.
        rows: Arguments that are rows, of one kind and length.
        more: The arguments behind them.
        options: The query's options.
        is_quick: Whether answers take not much longer than copies between GPUs.
    """

    def __init__(
        self,
        queries: Sequence[Callable[..., Any]],
        devices: Sequence["wp.Device"],
        rows: Sequence[Any],
        more: Sequence[Any],
        options: dict[str, Any],
        *,
        is_quick: bool = False,
    ) -> None:
        self._is_quick = is_quick
        self._queries, self._devices, self._rows, self._more = queries, devices, rows, more
        self._options = dict(options)
        self._progress = self._options.pop("progress", None)
        # A radius for each row is divided as the rows are.
        self._each = {name for name, value in options.items() if name == "radius" and np.ndim(value) == 1}

    def reaches_all(self) -> bool:
        """Whether no rows go from one GPU to another through the host, which takes longer than answers."""
        home = import_array(self._rows[0], "rows").device
        return all(wp.is_peer_access_supported(home, one) for one in self._other_gpus(home))

    def _other_gpus(self, home: "wp.Device") -> list["wp.Device"]:
        """Those beside the GPU that has the rows; none if a CPU has them."""
        return [one for one in self._devices if one.is_cuda and home.is_cuda and one != home]

    def of_host_rows(self) -> Any:
        """The answer to arrays of NumPy."""
        total, count = len(self._rows[0]), len(self._devices)
        size = -(-total // (2 * BLOCKS_AT_A_TIME * count))
        size = max(LEAST_ROWS_OF_A_BLOCK, min(MOST_ROWS_OF_A_BLOCK, size))
        blocks = [(first, min(first + size, total)) for first in range(0, total, size)]
        whole = _Whole(self._ask(0, self._rows, 0, 0), total)
        progress = self._told()
        waiting = iter(blocks)

        def work(device: int) -> None:
            with _ending(waiting):
                for first, stop in waiting:  # the threads share it; the GIL makes taking the next one safe
                    whole.put(first, self._ask(device, self._rows, first, stop, progress(first)))

        with _ending(waiting):
            _at_once([functools.partial(work, device) for device in range(count) for _ in range(BLOCKS_AT_A_TIME)])
        return whole.answer()

    def of_arrays(self) -> Any:
        """The answer to arrays of warp or torch, which lies where they do."""
        rows = [import_array(value, "rows") for value in self._rows]
        rows = [value if value.is_contiguous else value.contiguous() for value in rows]
        home, total = rows[0].device, len(rows[0])
        for device in self._other_gpus(home):
            open_memory(home, device)
        parts = [list(part) for part in self._parts(home, total)]
        whole = _Whole(self._ask(0, rows, 0, 0), total, home)
        if home.is_cuda:
            wp.synchronize_stream(home.stream)  # rows and memory are ready for other streams
        progress = self._told()

        def work(device: int) -> None:
            with _Way(home, self._devices[device]) as way:
                for (first, stop), here in way.brought(rows, parts[device]):
                    way.take_back(whole, first, self._ask(device, here, first, stop, progress(first), begins=first))

        _at_once([functools.partial(work, device) for device in range(len(parts))])
        like = self._rows[0]
        return whole.answer(None if isinstance(like, wp.array) else exporter_like(like))

    def _parts(self, home: "wp.Device", total: int) -> Iterator[Iterator[tuple[int, int]]]:
        """For each device the pieces of its part."""
        away = [device != home for device in self._devices]
        weights = np.where(away, SHARE_AWAY if self._is_quick else 1.0, 1.0)
        ends = np.rint(np.append(0.0, np.cumsum(weights)) * (total / weights.sum())).astype(int).tolist()
        for (first, stop), is_away in zip(itertools.pairwise(ends), away, strict=True):
            pieces = PIECES if is_away and self._is_quick else 1
            yield itertools.pairwise(first + (stop - first) * k // pieces for k in range(pieces + 1))

    def _ask(
        self,
        device: int,
        rows: Sequence[Any],
        first: int,
        stop: int,
        progress: Callable[[int, int], None] | None = None,
        begins: int = 0,
    ) -> Any:
        """The answer of a device to rows of arrays whose first row is number ``begins`` of all."""
        own = {name: value[first:stop] if name in self._each else value for name, value in self._options.items()}
        if progress is not None:
            own["progress"] = progress
        return self._queries[device](*(value[first - begins : stop - begins] for value in rows), *self._more, **own)

    def _told(self) -> Callable[[int], Callable[[int, int], None] | None]:
        """For each part, by the number of its first row, what is to be told of its progress."""
        if not callable(self._progress):
            return lambda _: None
        done = _Progress(self._progress, len(self._rows[0]))
        return lambda first: functools.partial(done, first)


def _at_once(calls: Sequence[Callable[[], None]]) -> None:
    Pool(len(calls), "device").run(lambda call: call(), calls, len(calls))


@contextlib.contextmanager
def _ending(waiting: Iterator[Any]) -> Iterator[None]:
    """After an error nobody takes another block."""
    try:
        yield
    except BaseException:
        collections.deque(waiting, maxlen=0)
        raise


class _Way:
    """The way of rows to a device and of its answers back, on streams of their own: the device is at work meanwhile.

    Args:
        home: The device that has the rows.
        device: The device that answers, or the same.
    """

    def __init__(self, home: "wp.Device", device: "wp.Device") -> None:
        self._home, self._device = home, device
        self._kept: list[Any] = []

    def __enter__(self) -> _Way:
        self._contexts = contextlib.ExitStack()
        gpu = self._device if self._device.is_cuda else self._home
        self._streams = None
        if gpu.is_cuda:
            self._contexts.enter_context(gpu.context_guard)
            self._streams = copy_stream(gpu.alias, 0), copy_stream(gpu.alias, 1)
        return self

    def __exit__(self, *_: object) -> None:
        with self._contexts:
            for stream in self._streams or ():
                wp.synchronize_stream(stream)
        self._kept.clear()

    def brought(
        self, rows: Sequence["wp.array"], pieces: Sequence[tuple[int, int]]
    ) -> Iterator[tuple[tuple[int, int], list["wp.array"]]]:
        """Each piece with its rows on the device; those of the next one are under way by then."""
        coming: collections.deque[tuple[Any, list[Any], Any]] = collections.deque()
        for piece in [*pieces, None]:
            if piece is not None:
                coming.append((piece, *self._bring(rows, *piece)))
            if len(coming) > (piece is not None):
                asked, here, arrived = coming.popleft()
                if arrived is not None and self._device.is_cuda:
                    self._device.stream.wait_event(arrived)
                elif arrived is not None:
                    wp.synchronize_event(arrived)
                yield asked, here

    def _bring(self, rows: Sequence["wp.array"], first: int, stop: int) -> tuple[list["wp.array"], Any]:
        if self._home == self._device:
            return [value[first:stop] for value in rows], None
        here: list[Any] = [
            wp.empty((stop - first, *value.shape[1:]), dtype=value.dtype, device=self._device) for value in rows
        ]
        stream = self._streams[0] if self._streams else None
        if stream is not None and self._device.is_cuda:
            stream.wait_event(self._device.stream.record_event())  # the memory is free
        for target, value in zip(here, rows, strict=True):
            copy_rows(target, 0, value, first, stop - first, stream)
        return here, stream.record_event() if stream is not None else None

    def take_back(self, whole: _Whole, first: int, answer: Any) -> None:
        """Write the answers to rows from number ``first`` on into the whole, at the latest when this context ends."""
        stream = self._streams[1] if self._streams else None
        if stream is not None and self._device.is_cuda:
            stream.wait_event(self._device.stream.record_event())
        whole.put(first, answer, stream)
        self._kept.append(answer)


class _Whole:
    """Collects the answers of parts; those with a row for each row are written to their places in one array.

    Args:
        none: The answer to no rows, which says what fields there are.
        total: Number of rows.
        home: The device that has the rows; None for rows of NumPy.
    """

    def __init__(self, none: Any, total: int, home: "wp.Device | None" = None) -> None:
        self._kind = type(none) if isinstance(none, tuple) else None
        self._home, self._parts = home, dict[int, list[Any]]()
        self._offsets = [name == "offsets" for name in getattr(none, "_fields", ())]
        self._fields = [self._room(field, total) for field in _fields(none)]

    def _room(self, field: Any, total: int) -> Any:
        if field is None or any(self._offsets):
            return None
        if isinstance(field, np.ndarray):
            return np.empty((total, *field.shape[1:]), field.dtype)
        return wp.empty((total, *field.shape[1:]), dtype=field.dtype, device=self._home)

    def put(self, first: int, answer: Any, stream: Any = None) -> None:
        """Take the answers to rows from number ``first`` on."""
        if any(self._offsets):
            self._parts[first] = list(_fields(answer))
            return
        for target, field in zip(self._fields, _fields(answer), strict=True):
            if isinstance(target, np.ndarray):
                target[first : first + len(field)] = field
            elif target is not None:
                copy_rows(target, first, field, 0, len(field), stream)

    def answer(self, to_caller: Callable[[Any], Any] | None = None) -> Any:
        """The whole answer, its arrays as ``to_caller`` gives them."""
        if any(self._offsets):
            parts = zip(self._offsets, *(self._parts[first] for first in sorted(self._parts)), strict=True)
            self._fields = [_joined(fields, is_offsets, self._home) for is_offsets, *fields in parts]
        fields = [one if one is None or to_caller is None else to_caller(one) for one in self._fields]
        return fields[0] if self._kind is None else tuple.__new__(self._kind, fields)


class _Progress:
    """Adds up the progress of the parts."""

    def __init__(self, told: Callable[[int, int], None], total: int) -> None:
        self._told, self._total, self._done = told, total, dict[int, int]()
        self._lock = threading.Lock()

    def __call__(self, part: int, done: int, _: int) -> None:
        with self._lock:
            self._done[part] = done
            self._told(sum(self._done.values()), self._total)


def _fields(answer: Any) -> tuple[Any, ...]:
    return answer if isinstance(answer, tuple) else (answer,)


def _joined(parts: Sequence[Any], are_offsets: bool, home: "wp.Device | None") -> Any:
    """One field of lists, from those of the parts in order."""
    if parts[0] is None:
        return None
    host = [part if isinstance(part, np.ndarray) else part.numpy() for part in parts] if are_offsets else []
    if are_offsets:
        # Those of a part begin where the lists of the parts before it end.
        begins = itertools.accumulate((int(part[-1]) for part in host), initial=0)
        moved = [part + begin for part, begin in zip(host, begins, strict=False)]
        whole = np.concatenate([moved[0], *(part[1:] for part in moved[1:])])
        if isinstance(parts[0], np.ndarray):
            return whole
        return wp.array(whole, dtype=parts[0].dtype, device=home)
    if isinstance(parts[0], np.ndarray):
        return np.concatenate(parts)
    joined: Any = wp.empty((sum(map(len, parts)), *parts[0].shape[1:]), dtype=parts[0].dtype, device=home)
    begin = 0
    for part in parts:
        copy_rows(joined, begin, part, 0, len(part), joined.device.stream if joined.device.is_cuda else None)
        begin += len(part)
    if joined.device.is_cuda:
        wp.synchronize_stream(joined.device.stream)  # the parts are freed
    return joined
