"""Atomic functions that hold on a CPU too.

Warp's own are plain reads and writes there, where geokit runs a launch in several threads.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp

wp.set_module_options({"enable_backward": False})


for _number in (wp.int32, wp.int64):

    @cpp.func_native("core/atomic.inl")
    def lower_to(values: wp.array(dtype=_number), at: wp.int32, value: _number):
        """``values[at] = min(values[at], value)``."""
        ...

    @cpp.func_native("core/atomic.inl")
    def add_to(values: wp.array(dtype=_number), at: wp.int32, value: _number) -> _number:
        """``values[at] += value``; returns the old value."""
        ...


@cpp.func_native("core/atomic.inl", function="add_to_cell")
def add_to(  # noqa: F811
    values: wp.array(dtype=wp.int64, ndim=2), row: wp.int32, column: wp.int32, value: wp.int64
) -> wp.int64:
    """``values[row, column] += value``; returns the old value."""
    ...


@cpp.func_native("core/atomic.inl")
def unite(parent: wp.array(dtype=wp.int32), a: wp.int32, b: wp.int32):
    """Join the sets of a and b; the lower root becomes the root of both, whatever the order of the threads.

    Source: Anderson, Woll, Wait-free parallel algorithms for the union-find problem (1991); path halving. A root is
    replaced only while it is still a root; every other entry may be overwritten with an ancestor at any time.
    """
    ...


@wp.func
def root_of(parent: wp.array(dtype=wp.int32), x: wp.int32) -> wp.int32:
    """The root of the set of x, once no thread unites sets any more."""
    at = x
    while parent[at] != at:
        at = parent[at]
    return at
