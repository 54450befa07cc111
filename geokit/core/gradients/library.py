"""The few array functions that closed forms are written with, for all libraries alike, and vectors made of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple


class Library(NamedTuple):
    """Functions of one array library.

    Attributes:
        where: ``where(condition, a, b)``.
        sqrt, floor: As in NumPy.
        stack: ``stack(arrays, axis)``.
        take: ``take(table, index)``: rows of a table. Its derivative adds the rows of each index in one order, so that
            it has the same bits in every run.
        add: ``add(rows, index, count)``: the sums of the rows of each index below ``count``, in the order of the rows.
        constant: ``constant(array, like)``: an array as a tensor beside ``like``, in float64 or int64.
        kept: ``kept(cache, name, array, like)``: the same of an array that belongs to an object, uploaded once and kept
            in its cache where the library can.
        wide, whole: A tensor in float64, in int64.
        detach: A tensor as a constant.
        ask: ``ask(query, points, shape, *beside)``: the numbers (N, *shape), of the points' type, that a query without
            derivatives answers for constant points (N, ...) and the arrays ``beside`` them.
        once: ``once(tensor, message, of)``: the tensor, whose derivative with respect to the tensors ``of`` is not
            known: asking for it is an InputError.
        listed: ``listed(offsets, total)``: for each of ``total`` entries that offsets (N + 1,) divide, its part; in
            torch alone, as lists of unknown length are.
    """

    where: Callable[..., Any]
    sqrt: Callable[..., Any]
    floor: Callable[..., Any]
    stack: Callable[..., Any]
    take: Callable[..., Any]
    add: Callable[..., Any]
    constant: Callable[..., Any]
    kept: Callable[..., Any]
    wide: Callable[..., Any]
    whole: Callable[..., Any]
    detach: Callable[..., Any]
    ask: Callable[..., Any]
    once: Callable[..., Any]
    listed: Any = None


def dot(a: Any, b: Any) -> Any:
    """Products of rows (N, 3), (N,)."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def cross(library: Library, a: Any, b: Any) -> Any:
    """Cross products of rows (N, 3)."""
    (ax, ay, az), (bx, by, bz) = ((v[..., 0], v[..., 1], v[..., 2]) for v in (a, b))
    return library.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], -1)


def length(library: Library, a: Any) -> Any:
    """Lengths of rows (N, 3); the derivative at 0 is 0."""
    squared = dot(a, a)
    some = squared > 0.0
    return library.where(some, library.sqrt(library.where(some, squared, 1.0)), 0.0)
