"""What a call has prepared: the launch of each kernel, and all launches of a small query on a CPU.

``warp.launch`` inspects the kernel, its module and every argument anew: 25 us for three arguments on an H100's host,
longer than most small kernels run. So a kernel is inspected at its first launch on a device; later ones only write
their arguments.

A query of one point takes 50 to 400 us from its arguments to its answer, and its kernels one or two of them: the rest
is reading arguments, making arrays and launching. Between two calls for the same number of rows with the same options
nothing of that changes but the rows. So the second such call on a CPU is recorded: the rows' arrays, the launches, and
the arrays of the answer. Later calls copy their rows to where the launches read them, make these, and copy the answer.
Tensors of torch on the host share their memory with arrays of NumPy, and so does their answer.

Nothing is checked less: recorded kernels raise the same flags, rows that kernels do not check are checked here, and
whatever is unusual (a raised flag, another type, an option of a type of its own) goes the general way, which names it.

What a query does between its launches is not repeated. One whose record says ``is_replayed`` must depend on its rows in
its launches only, and in flags (:func:`geokit.core.memory.pinned.host_flags`); where it cannot, it calls
:func:`refuse`.
"""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from geokit.core.base.late_warp import wp
from geokit.core.base.object_cache import ObjectCache
from geokit.core.base.query import Query
from geokit.core.launches import warp_private

# Above this number of rows kernels take longer than what a replay saves.
MOST_ROWS = 256
# Calls that an object keeps: numbers of rows, types and options.
MOST_KEPT = 64
# Arrays that a query reads before it writes to them are restored for each replay. A larger one [bytes] is kept for
# later calls, such as a part of a tree, rather than made for this one.
LARGEST_RESTORED = 1 << 14
# Key of the recordings in the cache of the object that is queried.
KEPT = "replays"
# Types of options that are compared by type and value. Others (arrays, functions, devices) are not recorded.
PLAIN = frozenset((bool, int, float, str, type(None), np.float64, np.int64))
# Marks calls that cannot be recorded.
NEVER = ()

# A launch of each kernel on each device, of which others are made.
_launches: dict[tuple[Any, str], warp_private.PackedLaunch] = {}


def bound(kernel: Any, count: int, arguments: Sequence[Any], device: "wp.Device", block_dim: int) -> Callable[[], Any]:
    """A function that launches ``kernel`` for ``count`` items, any number of times, as ``warp.launch`` does.

    Args:
        kernel: A kernel whose module is loaded. ``warp.launch`` chooses the overload of a generic one each time.
        count: Number of items, above 0.
        arguments: The kernel's arguments, warp arrays or KernelArrays among them, which it does not keep alive.
        device: The device to run on.
        block_dim: Threads of a block; must be the same for each launch of a kernel on a device.
    """
    known = _launches.get((kernel, device.alias))
    if known is None:
        given = [warp_private.launch_argument(argument) for argument in arguments]
        command = warp_private.record_launch(kernel, count, given, device, block_dim)
        if not warp_private.is_packed(device):
            launch: Callable[[], Any] = command.launch
            return launch
        # That of a generic kernel is of its overload.
        key = command.kernel, device.alias
        known = _launches.get(key) or _launches.setdefault(key, warp_private.PackedLaunch(command))
    return known.bound(count, arguments)


class _Thread(threading.local):
    recording: Recording | None = None


_thread = _Thread()


def answer(query: Query, search: Callable[..., Any], given: tuple[Any, ...], options: dict[str, Any]) -> Any:
    """The answer of a call, by the launches of an earlier one where it is a small call on a CPU.

    Args:
        query: Its object keeps the recordings in ``_cache`` (:class:`geokit.core.base.object_cache.CacheAttribute`):
            they end with it, and when it is cleared.
        search: ``search(query, given, options)`` answers all other calls.
        given, options: Its arguments.
    """
    if not query.is_replayed:
        return search(query, given, options)
    torch: Any = sys.modules.get("torch")
    rows = len(query.rows)
    if torch is not None and len(given) > rows and type(given[1]) is torch.Tensor:
        plain = _host_rows(torch, given, rows)
        if plain is not None:
            return _as_tensors(torch, _of_arrays(query, search, plain, options))
    return _of_arrays(query, search, given, options)


def _of_arrays(query: Query, search: Callable[..., Any], given: tuple[Any, ...], options: dict[str, Any]) -> Any:
    key = _key_of(query, given, options)
    if key is None or _thread.recording is not None:
        return search(query, given, options)
    cache = getattr(given[0], "_cache", None)
    if type(cache) is not ObjectCache:  # what was given is not what is queried, which the query will refuse
        return search(query, given, options)
    kept: dict[Any, Any] = cache.find(KEPT, dict)
    idle = kept.get(key)
    if idle is None or idle is NEVER:
        answer = search(query, given, options)
        if idle is None:  # what is built at the first call is not part of the others
            if len(kept) >= MOST_KEPT:
                kept.clear()
            kept.setdefault(key, [])
        return answer
    try:
        recording = idle.pop()  # one thread at a time
    except IndexError:
        recording = None
    if recording is None:
        recording = _thread.recording = Recording(given[1 : len(query.rows) + 1])
        try:
            answer = search(query, given, options)
        finally:
            _thread.recording = None
        if not recording.finish(answer):
            kept[key] = NEVER
            return answer
        answer = recording.answer()  # the arrays themselves are those of the next call
        idle = kept.setdefault(key, [])
    else:
        try:
            answer = recording.replay(given)
        except MemoryError:
            answer = None
    if idle is not NEVER:  # another thread's call could not be recorded
        idle.append(recording)  # from here on its arrays may be those of another thread
    return search(query, given, options) if answer is None else answer


def _host_rows(torch: Any, given: Sequence[Any], rows: int) -> tuple[Any, ...] | None:
    """Arguments with tensors on the host as arrays of NumPy, which share their memory; None where that cannot be."""
    arrays = []
    for tensor in given[1 : rows + 1]:
        if type(tensor) is not torch.Tensor:
            arrays.append(tensor)
        elif tensor.is_cpu and tensor.dtype in (torch.float32, torch.float64) and not tensor.requires_grad:
            try:
                if not tensor.data_ptr():  # empty, or freed, which is named where it is read
                    return None
                arrays.append(tensor.numpy())
            except (RuntimeError, TypeError):  # inside torch.func's transforms it has no memory, a sparse one no rows
                return None
        else:
            return None
    return (given[0], *arrays, *given[rows + 1 :])


def _as_tensors(torch: Any, answer: Any) -> Any:
    if isinstance(answer, tuple):
        return tuple.__new__(type(answer), [_as_tensors(torch, part) for part in answer])
    if not isinstance(answer, (np.ndarray, np.generic)):
        return answer
    return torch.from_numpy(np.require(answer, requirements="W"))


def _key_of(query: Query, given: Sequence[Any], options: dict[str, Any]) -> Any:
    """Key of the calls that one recording answers; None for a call that is not replayed."""
    rows = len(query.rows)
    if len(given) <= rows:
        return None
    first = given[1]
    key: tuple[Any, ...]
    if type(first) is not np.ndarray or not 0 < first.size <= 3 * MOST_ROWS:
        return None
    if rows == 1:
        key = query, first.shape, first.dtype
    else:
        second = given[2]
        if type(second) is not np.ndarray or second.size != first.size:
            return None
        key = query, first.shape, first.dtype, second.shape, second.dtype
    if len(given) == rows + 1 and not options:
        return key
    values = (*given[rows + 1 :], *options.values())
    kinds = tuple(map(type, values))
    return (key, tuple(options), values, kinds) if PLAIN.issuperset(kinds) else None


def current() -> Recording | None:
    """What this thread is recording."""
    return _thread.recording


def refuse() -> None:
    """Do not record the present call: what it does depends on its rows, or is kept for later calls."""
    if _thread.recording is not None:
        _thread.recording.usable = False


class Recording:
    """What a query does, noted while it does it, to be done again for other rows. One thread uses it at a time."""

    def __init__(self, arguments: Sequence[np.ndarray]) -> None:
        self.usable = True
        self._arguments = list(arguments)
        self._rows: list[Any] = [None] * len(arguments)
        self._checked: list[tuple[np.ndarray, float]] = []
        self._calls: list[Callable[[], Any]] = []
        self._flags: list[Any] = []
        # Of each array that was computed: itself, the memory that kernels write, and how it follows from that.
        self._noted: dict[int, tuple[Any, np.ndarray, Callable[[np.ndarray], Any]]] = {}
        self._results: list[tuple[np.ndarray, Callable[[np.ndarray], Any]]] = []
        self._kind: Any = None
        self._empty: dict[int, Any] = {}  # arrays that kernels write to before they read them
        self._restored: list[tuple[np.ndarray, np.ndarray]] = []
        self._seen: set[int] = set()
        self._device: Any = None
        self._alive: list[Any] = []

    def rows_of(self, given: Any, table: np.ndarray, *, largest: float | None) -> np.ndarray:
        """The memory where the launches of all replays read an argument's rows, with the rows of this call.

        Args:
            given: The argument as the caller gave it.
            table: Its rows, as kernels take them.
            largest: Largest magnitude of a number, which replays check; None where a kernel does.
        """
        place = next((k for k, a in enumerate(self._arguments) if a is given and self._rows[k] is None), None)
        if place is None or given.dtype.kind not in "fiu":
            self.usable = False
            return table
        rows = table.copy()
        self._rows[place] = rows.reshape(given.shape)
        if largest is not None:
            self._checked.append((rows.reshape(-1), largest))
        return rows

    def flags(self, array: Any) -> None:
        """Note flags that are zero before each call; where one is raised, the call is repeated the general way."""
        self._flags.append(array.values)
        self.empty(array)

    def empty(self, array: Any) -> None:
        """Note an array whose contents before the call do not matter."""
        self._empty[id(array)] = array

    def filled(self, array: Any) -> None:
        """Note that an array has been written."""
        self._empty.pop(id(array), None)

    def read(self, values: np.ndarray) -> None:
        """Note that the host reads an array of kernel results."""
        if not any(values is flags for flags in self._flags):
            self.usable = False

    def derived(self, values: Any, memory: np.ndarray, convert: Callable[[np.ndarray], Any]) -> None:
        """Note that ``values`` is ``convert(memory)``, which may be derived itself."""
        _, source, before = self._noted.get(id(memory), (None, memory, None))
        if before is None:
            self._noted[id(values)] = values, source, convert
        elif values is not memory:
            self._noted[id(values)] = values, source, lambda results: convert(before(results))

    def launch(self, call: Callable[[], Any], arguments: list[Any], outputs: Sequence[Any], device: Any) -> None:
        """Note a launch of one slice that is about to be made.

        Args:
            call: Makes the launch.
            arguments: All its arguments.
            outputs: Those of them that it writes to.
            device: The CPU.
        """
        if not self.usable:
            return
        for output in outputs:
            if id(output) not in self._empty:
                self._keep_contents(output)
        self._calls.append(call)
        self._alive.append(arguments)
        self._device = device

    def _keep_contents(self, output: Any) -> None:
        """Keep what an array holds before the first launch that writes to it: the query may have filled it."""
        for memory in warp_private.arrays_of(output):
            address = memory.__array_interface__["data"][0]
            if address in self._seen or not memory.size:
                continue
            self._seen.add(address)
            if memory.nbytes > LARGEST_RESTORED:
                self.usable = False
            else:
                self._restored.append((memory, memory.copy()))

    def finish(self, answer: Any) -> bool:
        """End the recording; returns whether the call can be replayed."""
        parts = answer if isinstance(answer, tuple) else (answer,)
        found = [self._noted.get(id(part)) for part in parts]
        if not self.usable or not self._calls or any(entry is None for entry in (*self._rows, *found)):
            return False
        if any(flags.any() for flags in self._flags):
            return False
        self._kind = type(answer) if isinstance(answer, tuple) else None
        self._results = [entry[1:] for entry in found if entry is not None]
        self._alive.append(self._flags)
        self._flags = [memoryview(flags.data) for flags in self._flags]  # faster to index than arrays
        self._arguments, self._noted, self._empty = [], {}, {}
        return True

    def replay(self, given: Sequence[Any]) -> Any:
        """The answer to the query with other rows; None if the general way has to answer.

        Args:
            given: Its positional arguments: the object, then the rows.
        """
        if self._device.is_capturing:
            return None
        for place, rows in enumerate(self._rows, 1):
            rows[...] = given[place]
        for rows, largest in self._checked:
            numbers = rows.tolist()
            # A sum that is finite has no NaN in it, which would confuse the comparisons.
            if not (math.isfinite(sum(numbers)) and -largest <= min(numbers) and max(numbers) <= largest):
                return None
        for memory, contents in self._restored:
            memory[...] = contents
        for call in self._calls:
            call()
        for flags in self._flags:
            if any(flags):
                for k in range(len(flags)):
                    flags[k] = 0
                return None
        return self.answer()

    def answer(self) -> Any:
        """New arrays with the present results."""
        if self._kind is None:
            memory, convert = self._results[0]
            return convert(memory)
        return tuple.__new__(self._kind, [convert(memory) for memory, convert in self._results])
