"""Every launch of geokit's kernels on the CPU, run by the sanitized library first and then as always."""

from __future__ import annotations

import ctypes
import json
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import warp as wp

from tests.sanitize.compiler import Clang, Fault, build, is_fused, load_runtime
from tests.sanitize.exact_memory import ExactMemory, differing, parts
from tests.sanitize.generated import source_beside

# Launches of a kernel that are looked at, and of those how many in one call.
PER_KERNEL = 24
PER_CALL = 3
# Launches with more bytes are not looked at: calls are chosen so that each kernel has smaller ones.
LARGEST = 1 << 27


class Interception:
    """Takes the place of the function that warp calls for a launch on the CPU.

    Args:
        clang: Compiles what is launched.
        wanted: Whether launches of a module are looked at.
        journal: File that gets a line of JSON for each launch looked at, before and after it.
        log: Path that the sanitizers write to; they append the process's number.
        fault: Planted in what is compiled.
    """

    def __init__(
        self, clang: Clang, wanted: Callable[[str], bool], journal: Path, log: Path, fault: Fault | None = None
    ) -> None:
        self.call = ""
        self._clang, self._wanted, self._fault = clang, wanted, fault
        self._journal = journal.open("a", encoding="utf-8")
        self._log = log
        self._seen = 0  # characters of the log that earlier launches have left
        self._launches: Counter[Any] = Counter()
        self._libraries: dict[Path, list[ctypes.CDLL]] = {}
        self._memory = ExactMemory()
        # Two slices of one launch write to one array: each has to see the same bytes twice.
        self._lock = threading.RLock()
        load_runtime(clang)

    def install(self) -> None:
        kind = wp._src.context.ModuleExec
        original = kind.get_kernel_hooks

        def get_kernel_hooks(executable: Any, kernel: Any) -> Any:
            hooks = original(executable, kernel)
            name = kernel.module.name
            if executable.device.is_cpu and name.startswith("geokit.") and not isinstance(hooks.forward, _Forward):
                hooks.forward = _Forward(self, executable, kernel, hooks.forward)
            return hooks

        kind.get_kernel_hooks = get_kernel_hooks

    def begin(self, call: str) -> None:
        self.call = call
        self._note(call=call)

    def run(self, forward: _Forward, bounds: Any, arguments: Any) -> None:
        with self._lock:
            module, kernel = forward.kernel.module.name, forward.symbol
            key = (kernel, self.call)
            found = list(parts(forward.kernel, arguments._obj))
            if (
                not self._wanted(module)
                or self._launches[kernel] >= PER_KERNEL
                or self._launches[key] >= PER_CALL
                or sum(part.end - part.start for part in found) > LARGEST
            ):
                forward.original(bounds, arguments)
                return
            self._launches[kernel] += 1
            self._launches[key] += 1
            self._check(forward, bounds, arguments)

    def _check(self, forward: _Forward, bounds: Any, arguments: Any) -> None:
        sanitized = forward.sanitized or self._sanitized(forward)
        kind = type(arguments._obj)
        copy = kind.from_buffer_copy(arguments._obj)
        where = {"module": forward.kernel.module.name, "kernel": forward.kernel.key, "call": self.call}
        self._note(**where, items=int(bounds._obj.size), started=True, log=self._seen)
        second = kind.from_buffer_copy(arguments._obj)
        try:
            regions = self._memory.copied(list(parts(forward.kernel, copy)))
            others = self._memory.copied(list(parts(forward.kernel, second))) if forward.plain else None
            sanitized(bounds, ctypes.byref(copy))
            reported = self._reported()
            if forward.plain:
                forward.plain(bounds, ctypes.byref(second))
            forward.original(bounds, arguments)
            different = differing(regions, others)
        finally:
            self._memory.free()
        if reported:
            self._note(**where, reported=reported)
        if different:
            self._note(**where, different=different)

    def _sanitized(self, forward: _Forward) -> Any:
        source, name = source_beside(forward.executable), forward.kernel.module.name
        libraries = self._libraries.get(source)
        if libraries is None:
            print(f"sanitize: {name}", flush=True)
            kinds = ("sanitized", "plain") if is_fused(source) else ("sanitized",)
            built = [build(source, name, self._clang, self._fault, plain=kind == "plain") for kind in kinds]
            libraries = self._libraries[source] = [ctypes.CDLL(str(path)) for path in built]
        functions = [getattr(library, f"{forward.symbol}_cpu_forward") for library in libraries]
        for function in functions:
            function.restype = None
        forward.sanitized = functions[0]
        forward.plain = functions[1] if len(functions) > 1 else None
        return forward.sanitized

    def _reported(self) -> str:
        """What the sanitizers have written since the last time."""
        path = next(self._log.parent.glob(self._log.name + ".*"), None)
        if path is None:
            return ""
        text = path.read_text(encoding="utf-8", errors="replace")
        new = text[self._seen :]
        self._seen = len(text)
        return new

    def _note(self, **fields: Any) -> None:
        self._journal.write(json.dumps(fields) + "\n")
        self._journal.flush()


class _Forward:
    """What warp calls for a launch of one kernel."""

    def __init__(self, owner: Interception, executable: Any, kernel: Any, original: Any) -> None:
        self.owner, self.executable, self.kernel, self.original = owner, executable, kernel, original
        self.symbol = executable.get_kernel_mangled_name(kernel)
        self.sanitized: Any = None
        # Another build whose results are to be the same, where those of warp's build cannot be.
        self.plain: Any = None

    def __call__(self, bounds: Any, arguments: Any) -> None:
        self.owner.run(self, bounds, arguments)
