"""What public operations need: compared with the free memory before they start, and stated where it runs out.

Every way in which memory can run out inside an operation, also in the libraries below, ends in a DeviceMemoryError.
"""

from __future__ import annotations

import errno
import functools
import math
import os
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, TypeVar

from geokit.core.base.forks import renew_after_fork
from geokit.core.launches import captured
from geokit.core.memory import available_memory
from geokit.errors import LARGEST_NEED, DeviceMemoryError, GeokitError, InputError

# Needs up to this many bytes are not checked: to ask for the free memory takes 50 us.
UNCHECKED_BYTES = 1 << 24
# What libraries and the interpreter allocate beside the data. C++ libraries end the process where they lack it.
RESERVED_BYTES = 16 << 20
# What other libraries say where an allocation failed.
TEXTS = (
    "to allocate",
    "cannot allocate",
    "out of memory",
    "bad_alloc",
    "can't start new thread",
    "failed to map segment",
    "insufficient memory",
    "without exception set",  # the interpreter, where it has no memory for the exception
    "without setting an exception",
    "codec configuration error",  # of Pillow, as the next
    "quantization error",
    "in function scan_device",  # warp goes on without the temporary memory that it did not get
)
# What warp says of an array with more rows than it numbers. That is no lack of memory.
TOO_LONG = "must not exceed the maximum representable value"

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")


def needs(
    estimate: Callable[..., float] | None = None, *, late: bool = False, fatal: bool = False, name: str = ""
) -> Callable[[Callable[_Parameters, _Result]], Callable[_Parameters, _Result]]:
    """Decorate a public function with the memory that it needs.

    Args:
        estimate: Called with the function's arguments, and returns bytes: the peak, beyond the arguments. None where
            nobody can know.
        late: Call it only where memory runs out. For what a call should not delay.
        fatal: A library below ends the process where it gets no memory, so the smallest need is checked too.
        name: Name in messages; by default that of the function.
    """

    def decorated(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
        is_class = function.__name__ == "__init__"
        what = name or (function.__qualname__.split(".")[0] if is_class else function.__name__)

        def bytes_of(*args: Any, **kwargs: Any) -> int:
            return estimated(estimate, args, kwargs)

        @functools.wraps(function)
        def run(*args: _Parameters.args, **kwargs: _Parameters.kwargs) -> _Result:
            stated = 0
            if not late:
                stated = bytes_of(*args, **kwargs)
                require_free(stated, what, always=fatal)
            # Where memory has run out, the estimate may not be found a second time.
            return guarded(what, lambda: stated or bytes_of(*args, **kwargs), function, *args, **kwargs)

        run._geokit_bytes = bytes_of  # type: ignore[attr-defined]
        return run

    return decorated


def estimated(estimate: Callable[..., float] | None, args: Sequence[Any], kwargs: dict[str, Any]) -> int:
    """What an estimate says of a call [bytes]; 0 where there is none."""
    try:
        return int(min(estimate(*args, **kwargs), LARGEST_NEED)) if estimate else 0
    except Exception:  # of bad arguments, which the function itself names
        return 0


def guarded(
    what: str,
    need: Callable[[], int],
    function: Callable[_Parameters, _Result],
    /,
    *args: _Parameters.args,
    **kwargs: _Parameters.kwargs,
) -> _Result:
    """The answer of a function; where memory runs out, the error is that of a public operation.

    Args:
        what: The operation's name in messages.
        need: Called where memory runs out; returns the bytes that the operation needs.
    """
    if _native is None:
        _look_for_torch()
    try:
        if _native is None:
            return function(*args, **kwargs)
        with _native:
            return function(*args, **kwargs)
    except DeviceMemoryError as error:
        # An error of a part of the operation says what the whole needs.
        if (whole := need()) > error.need:
            error.need = whole
            error.args = (f"{error.args[0]} ({what} needs about {whole / 2**20:.0f} MiB in all)",)
        raise
    except Exception as error:
        if isinstance(error, ValueError) and TOO_LONG in str(error):
            raise InputError(
                f"{what}: a single array of this would have more than 2^31 - 1 rows; give it less at a time"
            ) from error
        if captured.WAITED in str(error):
            raise InputError(f"{what}: not while a CUDA graph is captured, as it waits for results") from error
        if not is_out_of_memory(error):
            raise
        # What the operation has made so far is freed, so that there is memory for the message.
        traceback.clear_frames(error.__traceback__)
        raise _refusal(what, need(), available_memory.available_host()) from error


class _Guest:
    """Warp's native code while a public operation runs.

    It does not print what CUDA refuses to stderr. Where there are several GPUs, it leaves the thread's current one,
    which is that of torch too, as it was: warp makes the device of each call current. A context is pushed on the
    driver's stack, whose top warp changes, and popped in the end. (Warp's own setting for that, which restores the
    context after each of its calls, makes its allocations fail.)
    """

    def __init__(self, core: Any, gpus: Sequence[Any]) -> None:
        self._core, self._was_on = core, True
        self._context = gpus[0].context if len(gpus) > 1 else None
        self._after_fork()
        renew_after_fork(self)

    def _after_fork(self) -> None:
        self._lock, self._running = threading.Lock(), 0

    def __enter__(self) -> None:
        counted, pushed = False, list[Any]()
        try:
            with self._lock:
                if not self._running:
                    self._was_on = bool(self._core.wp_is_error_output_enabled())
                self._running += 1
                counted = True
                if self._running == 1:
                    self._core.wp_set_error_output_enabled(0)
            if self._context is not None:
                # Pushed and noted in one step: no interrupt comes between.
                pushed.extend(map(self._core.wp_cuda_context_push_current, (self._context,)))
        except BaseException:
            if pushed:
                self._core.wp_cuda_context_pop_current()
            if counted:
                self._leave()
            raise

    def __exit__(self, *_: object) -> None:
        if self._context is not None:
            self._core.wp_cuda_context_pop_current()
        self._leave()

    def _leave(self) -> None:
        with self._lock:
            self._running -= 1
            if not self._running:
                self._core.wp_set_error_output_enabled(int(self._was_on))


_native: _Guest | None = None
# What loads warp, from a later room.
loaders: list[Callable[[], Any]] = []


def be_a_guest(core: Any, gpus: Sequence[Any]) -> None:
    """Keep warp's native code from printing where memory runs out, and from changing the thread's current GPU.

    Args:
        core: Warp's compiled library. Errors themselves are raised as ever.
        gpus: All CUDA devices.
    """
    global _native
    if _native is None and hasattr(core, "wp_set_error_output_enabled"):
        _native = _Guest(core, gpus)


def _look_for_torch() -> None:
    """Load warp before the first call where torch has made one of several GPUs current."""
    torch: Any = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_initialized() and torch.cuda.device_count() > 1:
        for load in loaders:
            load()


def rows(values: Any) -> int:
    """Number of rows of a table of any container."""
    if len(shape := getattr(values, "shape", ())) > 2:
        return math.prod(shape[:-1])
    return len(values) if hasattr(values, "__len__") else 0


def file_size(path: Any) -> int:
    """Size of a file [bytes]."""
    return os.stat(os.path.expanduser(path)).st_size


def require_free(need: int, what: str, *, always: bool = False, have: int | None = None) -> None:
    """Check that ``need`` bytes, and some for libraries, are free on the host.

    Args:
        need: Bytes.
        what: Begin of the message.
        always: Check small needs as well.
        have: Free bytes, if the caller knows them.
    Raises:
        DeviceMemoryError: They are not; the message starts with ``what`` and states the estimate.
    """
    if not always and need <= UNCHECKED_BYTES:
        return
    have = available_memory.available_host() if have is None else have
    if need + RESERVED_BYTES > have:
        raise _refusal(what, need, have)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error, not of geokit, says that memory ran out."""
    if isinstance(error, GeokitError):
        return False
    if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
        return True
    if not isinstance(error, (RuntimeError, SystemError, ImportError, OSError, ValueError)):
        return False
    # Warp names a library that it cannot load, and the cause says why.
    reason = error.__cause__
    return any(t in str(error).lower() for t in TEXTS) or (reason is not None and is_out_of_memory(reason))


def _refusal(what: str, need: int, have: int) -> DeviceMemoryError:
    needed = f"needs about {need / 2**20:.0f} MiB" if need >= 1 << 20 else "needs more memory"
    return DeviceMemoryError(
        f"{what}: {needed}, of {have / 2**20:.0f} MiB free; give it less at a time, or free some memory", need=need
    )
