"""Copies of a launch's arrays in memory of their exact size, so that a byte beyond the end is a finding."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from typing import Any, NamedTuple

import warp as wp

# Addresses are 16 more than a multiple of this: malloc promises no better, and kernels may not count on luck.
ALIGNMENT = 64
PROMISED = 16


class Part(NamedTuple):
    """An array of a launch: its descriptor and the memory that its elements span."""

    name: str
    descriptor: Any
    start: int
    end: int


class Region(NamedTuple):
    """Memory that one array spans, or several that overlap; and the copy."""

    names: tuple[str, ...]
    start: int
    size: int
    copy: int


def parts(kernel: Any, arguments: Any) -> Iterator[Part]:
    """The arrays among a launch's arguments, those in structs too."""
    for argument in kernel.adj.args:
        yield from _parts(argument.label, argument.type, getattr(arguments, argument.label))


def _parts(name: str, kind: Any, value: Any) -> Iterator[Part]:
    if wp._src.types.is_array(kind):
        if not isinstance(value, wp._src.types.array_t):
            raise TypeError(f"{name}: arrays of the kind {type(value).__name__} are not known here")
        if value.data:
            size = wp._src.types.type_size_in_bytes(kind.dtype)
            yield Part(name, value, *_span(value, size))
    elif isinstance(kind, wp._src.codegen.Struct):
        for label, variable in kind.vars.items():
            yield from _parts(f"{name}.{label}", variable.type, getattr(value, label))


def _span(descriptor: Any, item: int) -> tuple[int, int]:
    shape, strides = descriptor.shape[: descriptor.ndim], descriptor.strides[: descriptor.ndim]
    if 0 in shape:
        return descriptor.data, descriptor.data
    reach = [(extent - 1) * stride for extent, stride in zip(shape, strides, strict=True)]
    first = descriptor.data + sum(step for step in reach if step < 0)
    return first, descriptor.data + sum(step for step in reach if step > 0) + item


class ExactMemory:
    """Allocates through the sanitizer's malloc, which notes the size to the byte."""

    def __init__(self) -> None:
        library = ctypes.CDLL(None)
        self._allocate = library.posix_memalign
        self._allocate.argtypes = [ctypes.POINTER(ctypes.c_void_p), ctypes.c_size_t, ctypes.c_size_t]
        self._free = library.free
        self._free.argtypes = [ctypes.c_void_p]
        # By item: Python would mangle an attribute with two underscores.
        self._poison = library["__asan_poison_memory_region"]
        self._unpoison = library["__asan_unpoison_memory_region"]
        for function in (self._poison, self._unpoison):
            function.argtypes = [ctypes.c_void_p, ctypes.c_size_t]
        self._held: list[tuple[int, int]] = []

    def copied(self, found: list[Part]) -> list[Region]:
        """Copies of the arrays' memory; their descriptors then point to the copies."""
        regions = []
        for group in _overlapping(found):
            start, end = min(part.start for part in group), max(part.end for part in group)
            copy = self._room(start, end - start)
            ctypes.memmove(copy, start, end - start)
            for part in group:
                part.descriptor.data = copy + (part.descriptor.data - start)
            regions.append(Region(tuple(part.name for part in group), start, end - start, copy))
        return regions

    def _room(self, like: int, size: int) -> int:
        # The same place within 16 bytes as the original: an array of floats may begin at any multiple of 4.
        before = PROMISED + like % PROMISED
        place = ctypes.c_void_p()
        if self._allocate(ctypes.byref(place), ALIGNMENT, before + size):
            raise MemoryError(f"no memory for a copy of {size} bytes")
        base: int = place.value or 0
        # Shadow memory has one byte for eight. Of an array without elements nothing may be touched.
        self._poison(base, before // 8 * 8 if size else before + 7)
        self._held.append((base, before + size))
        return base + before

    def free(self) -> None:
        for base, size in self._held:
            self._unpoison(base, size)
            self._free(base)
        self._held.clear()


def _overlapping(found: list[Part]) -> Iterator[list[Part]]:
    group: list[Part] = []
    end = 0
    for part in sorted(found, key=lambda part: (part.start, part.end)):
        if group and part.start >= end:
            yield group
            group = []
        end = max(end, part.end) if group else part.end
        group.append(part)
    if group:
        yield group


def differing(regions: list[Region], others: list[Region] | None) -> list[str]:
    """Names of the arrays that two runs left with different bytes, and where the first differs.

    Args:
        regions: Copies that the sanitized kernel has worked on.
        others: Copies that another build has worked on; None where it has worked on the originals.
    """
    found = []
    for index, region in enumerate(regions):
        ours = ctypes.string_at(region.copy, region.size)
        theirs = ctypes.string_at(others[index].copy if others else region.start, region.size)
        if ours != theirs:
            at = next(k for k in range(region.size) if ours[k] != theirs[k])
            found.append(f"{', '.join(region.names)}: byte {at} of {region.size}")
    return found
