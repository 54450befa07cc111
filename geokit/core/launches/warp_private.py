"""What geokit uses of warp besides its documented API, and what it does where a version of warp has no such part.

All of it but the tape makes small calls faster or checks the kernel cache; with ``wp.launch`` and ``wp.load_module``
alone the answers are the same. Without the tape, queries with gradients are refused while one records. ``missing()``
says what the installed warp lacks, and the test prints it.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core.base.late_warp import wp

# Fields of the descriptor by which a kernel sees an array. HostArray fills in the address, shape, strides and ndim.
DESCRIPTOR = ("data", "grad", "shape", "strides", "ndim", "flags")
# Versions of warp whose CPU kernels are known to be functions of (launch bounds, arguments in one struct). A test
# compares the source of warp's own call; another convention would crash.
FIRST_DIRECT, LAST_DIRECT = (1, 18), (1, 19)
# Marks a kernel parameter that is a warp struct.
STRUCT = object()


def missing() -> dict[str, str]:
    """Parts that the installed warp does not have, with what changed; geokit then uses warp's public way."""
    found = {}
    checks = {"descriptor": _check_descriptor, "launch": _check_launch, "module": _check_module, "tape": _check_tape}
    for name, check in checks.items():
        try:
            check()
        except Exception as error:  # whatever an attribute of another meaning leads to
            found[name] = f"{type(error).__name__}: {error}"
    version = tuple(int(part) for part in re.findall(r"\d+", wp.__version__)[:2])
    if not FIRST_DIRECT <= version <= LAST_DIRECT:
        found["direct"] = f"warp {wp.__version__} is not between {FIRST_DIRECT} and {LAST_DIRECT}"
    elif "launch" in found:
        found["direct"] = found["launch"]
    return found


@functools.lru_cache(maxsize=1)
def _missing() -> frozenset[str]:
    return frozenset(missing())


def _check_descriptor() -> None:
    fields = tuple(name for name, _ in type(wp.empty(0, dtype=wp.float64, device="cpu").__ctype__())._fields_)
    if fields != DESCRIPTOR:
        raise AttributeError(f"an array's descriptor has the fields {fields}, not {DESCRIPTOR}")


def _check_launch() -> None:
    lacking = {"hooks", "params", "params_addr", "bounds", "fwd_args"} - set(signature(wp.Launch.__init__).parameters)
    if lacking:
        raise AttributeError(f"a recorded launch has no {', '.join(sorted(lacking))}")


def _check_module() -> None:
    module = wp.get_module("geokit.core.launches.none")
    for name in ("load", "get_module_identifier", "_get_compile_output_name", "_get_meta_name"):
        if "block_dim" not in signature(getattr(module, name)).parameters:
            raise AttributeError(f"a module's {name} takes no block_dim")
    if len(module.failed_builds) or not callable(module.mark_modified):
        raise AttributeError("a module's failed builds are kept in another way")


def _check_tape() -> None:
    wp.init()
    if not hasattr(wp._src.context.runtime, "tape"):
        raise AttributeError("warp's runtime does not hold the tape that records")


# Arrays


class KernelArray:
    """Base of the array types that :func:`geokit.core.launcher.launch` takes besides warp arrays."""

    __slots__ = ()

    if TYPE_CHECKING:  # not an ABC, whose isinstance check takes four times as long

        @property
        def descriptor(self) -> Any:
            """Warp's array descriptor: address, shape and strides."""

        @property
        def warp(self) -> "wp.array":
            """A warp array over the same memory."""


def launch_argument(argument: Any) -> Any:
    """Replace a KernelArray by its descriptor; return any other kernel argument unchanged."""
    if not isinstance(argument, KernelArray):
        return argument
    return argument.descriptor if descriptor_type() else argument.warp


@functools.lru_cache(maxsize=1)
def descriptor_type() -> Any:
    """The class of an array's descriptor; None if it is not known, and kernels then take warp arrays only."""
    return None if "descriptor" in _missing() else type(wp.empty(0, dtype=wp.float64, device="cpu").__ctype__())


def arrays_of(argument: Any) -> Iterator[np.ndarray]:
    """The memory of an argument of a CPU kernel: that of an array, or of all arrays in a struct."""
    if isinstance(argument, wp.array) or hasattr(argument, "descriptor"):
        yield argument.numpy() if isinstance(argument, wp.array) else argument.values
    elif hasattr(argument, "__ctype__"):  # a struct
        for value in vars(argument).values():
            yield from arrays_of(value)


# Kernels and launches


def parameters(kernel: Any) -> list[tuple[str, Any]] | None:
    """Names and types of a kernel's parameters; None if they are not known."""
    return None if "launch" in _missing() else [(argument.label, argument.type) for argument in kernel.adj.args]


def has_code(kernel: Any) -> bool:
    """Whether a kernel has code of its own: a generic kernel has none until it has an overload."""
    return not getattr(kernel, "is_generic", False) or bool(kernel.overloads)


def is_packed(device: "wp.Device") -> bool:
    """Whether launches on a device may be made by :class:`PackedLaunch`."""
    return not ({"launch", "descriptor", "direct"} if device.is_cpu else {"launch", "descriptor"}) & _missing()


def record_launch(kernel: Any, count: int, arguments: Sequence[Any], device: "wp.Device", block_dim: int = 1) -> Any:
    """Record a launch, which can then be made any number of times."""
    return wp.launch(
        kernel, count, inputs=arguments, device=device, record_tape=False, record_cmd=True, block_dim=block_dim
    )


class PackedLaunch:
    """A recorded launch, of which others are made: each writes its arguments to a struct of its own.

    On a CPU a launch is a call of a C function with that struct. What warp does before (it looks for a capture, and
    makes the struct field by field) takes 10 us. On a GPU, a launch takes the address of each argument.
    """

    __slots__ = ("_array", "_bounds", "_command", "_kinds", "_offsets", "_struct")

    def __init__(self, command: Any) -> None:
        command.fwd_args = None  # or it would keep arrays alive
        self._command, self._array = command, wp.array
        self._bounds: tuple[int, Any] = 0, None
        fields = [
            (given.label, type(value)) for given, value in zip(command.kernel.adj.args, command.params[1:], strict=True)
        ]
        self._struct: Any = type("Arguments", (ctypes.Structure,), {"_fields_": fields})
        self._offsets = [getattr(self._struct, name).offset for name, _ in fields]
        self._kinds = [_kind_of(given.type) for given in command.kernel.adj.args]

    def bound(self, count: int, arguments: Sequence[Any]) -> Callable[[], Any]:
        """The launch for ``count`` items with other arguments, warp arrays or KernelArrays, which it does not keep."""
        values, array = [], self._array
        for index, (kind, value) in enumerate(zip(self._kinds, arguments, strict=True), 1):
            if isinstance(value, KernelArray):
                value = value.descriptor
            elif type(kind) is tuple and type(value) is array and value.dtype is kind[0] and value.ndim == kind[1]:
                value = value.__ctype__()
            elif type(kind) is frozenset and type(value) in kind:
                value = value if type(value) in (int, float, bool) else value.value
            elif kind is STRUCT and hasattr(value, "__ctype__"):
                value = value.__ctype__()
            elif type(value) is not kind:  # not of the expected type: warp converts it, or names the mistake
                command = self._with(params=list(self._command.params), params_addr=None)
                command.set_param_at_index(index - 1, value)
                value = command.params[index]
            values.append(value)
        known, bounds = self._bounds
        if count != known:
            command = self._with(params=[None], params_addr=None)
            command.set_dim(count)
            bounds = command.bounds
            self._bounds = count, bounds
        command, packed = self._command, self._struct(*values)
        if not command.device.is_cpu:
            start = ctypes.addressof(packed)
            places = ctypes.addressof(bounds), *[start + offset for offset in self._offsets]
            addresses = (ctypes.c_void_p * len(places))(*places)
            return self._with(bounds=bounds, params=[bounds, packed], params_addr=addresses).launch
        if command.device.is_capturing:
            return command.launch  # which refuses it: a capture needs the arrays
        # Both references keep what they refer to alive.
        return functools.partial(command.hooks.forward, ctypes.byref(bounds), ctypes.byref(packed))

    def _with(self, **changed: Any) -> Any:
        command = object.__new__(type(self._command))
        command.__dict__.update(vars(self._command), **changed)
        return command


def _kind_of(kind: Any) -> Any:
    """How arguments of a type are passed.

    Returns:
        (dtype, number of dimensions) for an array, the types that need no conversion for a number, the type itself for
        a vector, STRUCT for a struct, and None where warp has to convert.
    """
    if hasattr(kind, "ndim"):
        return kind.dtype, kind.ndim
    if kind in (wp.int32, wp.int64, wp.uint32, wp.uint64, wp.uint8):
        return frozenset((int, kind))
    if kind in (wp.float32, wp.float64):
        return frozenset((float, int, kind))
    if kind is wp.bool:
        return frozenset((bool, kind))
    if not isinstance(kind, type):
        return STRUCT
    return kind if issubclass(kind, ctypes.Array) else None


# Modules


def native_library() -> Any:
    """warp's compiled library, as ctypes loaded it; None if it is not known."""
    with contextlib.suppress(AttributeError):
        return wp._src.context.runtime.core
    return None


def last_noted_error() -> str:
    """The last error that warp's compiled library has noted in this process; empty if none, or if it is not known."""
    with contextlib.suppress(AttributeError):
        return str(wp._src.context.runtime.get_error_string() or "")
    return ""


def load_module(module: Any, device: "wp.Device", block_dim: int, shipped: Any = None) -> None:
    """Compile a kernel module, or load it from the cache; or load what came with the package."""
    if "module" in _missing():
        wp.load_module(module, device, block_dim=block_dim)
    elif shipped is not None:
        module.load(device, block_dim, shipped.binary, shipped.arch, shipped.meta)
    else:
        module.load(device, block_dim=block_dim)


def module_folder(module: Any, block_dim: int) -> Path | None:
    """The folder of a module in the kernel cache; None if it is not known."""
    if "module" in _missing():
        return None
    return Path(str(wp.config.kernel_cache_dir)) / str(module.get_module_identifier(block_dim))


def module_files(module: Any, device: "wp.Device", block_dim: int) -> tuple[Path, Path] | None:
    """Object and metadata of a module in the kernel cache; None if they are not known."""
    folder = module_folder(module, block_dim)
    if folder is None:
        return None
    return folder / module._get_compile_output_name(device, block_dim=block_dim), folder / module._get_meta_name(
        block_dim=block_dim
    )


def module_name(module: Any, block_dim: int) -> str | None:
    """Name of a module with the digest of all that goes into it; None if it is not known."""
    return None if "module" in _missing() else str(module.get_module_identifier(block_dim))


def output_name(module: Any, device: "wp.Device", block_dim: int) -> str:
    """File name of a module's object for a device."""
    return str(module._get_compile_output_name(device, block_dim=block_dim))


def has_failed_to_build(module: Any) -> bool:
    """Whether the compiler has refused a module; True if that is not known."""
    return "module" in _missing() or bool(module.failed_builds)


def mark_modified(module: Any) -> None:
    """Make warp load a module anew."""
    if "module" not in _missing():
        module.mark_modified()


# Tapes


# Warp's runtime once it has started, which holds the tape: every query looks at it.
_runtime: Any = None


def tape_in_progress() -> Any:
    """The ``wp.Tape`` that records now; None if none does, and "unknown" if one does that warp does not tell."""
    try:
        tape = _runtime.tape
    except AttributeError:  # before the first look, or there is no such part
        return _first_tape()
    return tape if tape is None or "tape" not in _missing() else _unknown_tape()


def _first_tape() -> Any:
    global _runtime
    warp = sys.modules.get("warp")
    if warp is None:
        return None
    try:
        runtime = warp._src.context.runtime  # None until warp has started
        tape = None if runtime is None else runtime.tape
    except AttributeError:
        return _unknown_tape()
    _runtime = runtime
    return tape


def _unknown_tape() -> str | None:
    """Whether a tape records, by trying to begin another."""
    try:
        with wp.Tape():
            return None
    except RuntimeError:
        return "unknown"
