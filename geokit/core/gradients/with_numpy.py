"""Rules evaluated with NumPy: first derivatives in float64, for libraries that have no functions of their own.

What a rule builds is followed by :class:`Followed` values, which know what they were made of; one pass back from the
outputs gives the derivatives. Sums run in the order of the rows, so that they have the same bits in every run.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.base.query import Query
from geokit.core.gradients.kernel_arrays import pulled_by_kernel
from geokit.core.gradients.library import Library
from geokit.core.gradients.rules import Asked

__all__ = ["LIBRARY", "Followed", "plain", "pulled", "pulled_back"]

_Array = NDArray[Any]
_Pull = Callable[[_Array], _Array]

# Values are numbered as they are made: one that is made of others has a higher number.
_numbers = itertools.count()


class Followed:
    """An array of which the derivatives of later ones are wanted.

    Attributes:
        value: The array.
        sources: What it was made of, with the function that takes a derivative back to it.
    """

    __slots__ = ("number", "sources", "value")

    # NumPy leaves operators with these to the methods here.
    __array_ufunc__ = None

    def __init__(self, value: Any, *sources: tuple[Any, _Pull]) -> None:
        self.value = np.asarray(value)
        self.sources = [(source, pull) for source, pull in sources if isinstance(source, Followed)]
        self.number = next(_numbers)

    @property
    def shape(self) -> tuple[int, ...]:
        return self.value.shape

    @property
    def ndim(self) -> int:
        return self.value.ndim

    @property
    def dtype(self) -> Any:
        return self.value.dtype

    def __len__(self) -> int:
        return len(self.value)

    def __add__(self, other: Any) -> Followed:
        return _made(lambda a, b: a + b, self, other, lambda g, a, b: g, lambda g, a, b: g)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Followed:
        return _made(lambda a, b: a - b, self, other, lambda g, a, b: g, lambda g, a, b: -g)

    def __rsub__(self, other: Any) -> Followed:
        return -self + other

    def __neg__(self) -> Followed:
        return self * -1.0

    def __mul__(self, other: Any) -> Followed:
        return _made(lambda a, b: a * b, self, other, lambda g, a, b: g * b, lambda g, a, b: g * a)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Followed:
        return _made(lambda a, b: a / b, self, other, lambda g, a, b: g / b, lambda g, a, b: -g * a / (b * b))

    def __rtruediv__(self, other: Any) -> Followed:
        return _made(lambda b, a: a / b, self, other, lambda g, b, a: -g * a / (b * b), lambda g, b, a: g / b)

    def __pow__(self, power: float) -> Followed:
        value = self.value
        return Followed(value**power, (self, lambda g: g * power * value ** (power - 1)))

    def __getitem__(self, index: Any) -> Followed:
        """Of whole numbers, slices, None and an ellipsis, which take no entry twice; see :func:`_take` for tables."""

        def back(g: _Array) -> _Array:
            whole = np.zeros(self.shape)
            whole[index] = g
            return whole

        return Followed(self.value[index], (self, back))

    def __lt__(self, other: Any) -> Any:
        return self.value < plain(other)

    def __le__(self, other: Any) -> Any:
        return self.value <= plain(other)

    def __gt__(self, other: Any) -> Any:
        return self.value > plain(other)

    def __ge__(self, other: Any) -> Any:
        return self.value >= plain(other)

    def __eq__(self, other: Any) -> Any:
        return self.value == plain(other)

    def __ne__(self, other: Any) -> Any:
        return self.value != plain(other)

    __hash__ = None  # type: ignore[assignment]

    def reshape(self, *shape: Any) -> Followed:
        return Followed(self.value.reshape(*shape), (self, lambda g: g.reshape(self.shape)))

    def sum(self, axis: int) -> Followed:
        def back(g: _Array) -> _Array:
            return np.broadcast_to(np.expand_dims(g, axis), self.shape)

        return Followed(self.value.sum(axis), (self, back))

    def mean(self) -> Followed:
        return Followed(self.value.mean(), (self, lambda g: np.broadcast_to(g / self.value.size, self.shape)))

    def argmax(self) -> int:
        """Of the first of several equal entries."""
        return int(self.value.argmax())


def plain(value: Any) -> Any:
    """An array as a constant."""
    return value.value if isinstance(value, Followed) else value


def pulled(query: Query, asked: Asked, answer: Any, slopes: Any, wanted: list[str]) -> dict[str, Any]:
    """Derivatives with respect to the arrays ``wanted``, from those with respect to the answer, by name.

    Args:
        query: The query.
        asked: The call, of constants; its tensors are float64.
        answer: The outputs.
        slopes: Derivatives with respect to the outputs; None where they are 0.
        wanted: Names of tensors.
    """
    rule = query.rule()
    with np.errstate(all="ignore"):  # of rows that were not found, which do not count
        if not rule.is_traced:
            by_kernel = pulled_by_kernel(query, asked, answer, slopes, wanted)
            if by_kernel is not None:
                return by_kernel
        if rule.pull is not None:
            given = [np.zeros(out.shape) if slope is None else slope for out, slope in zip(answer, slopes, strict=True)]
            found = rule.pull(LIBRARY, asked, answer, given)
            return {name: plain(found[name]) for name in wanted}
        if rule.prepare is not None:
            asked = asked._replace(prepared=rule.prepare(LIBRARY, asked))
        followed = {name: Followed(asked.tensors[name]) for name in wanted}
        build: Any = rule.build
        outputs = build(LIBRARY, asked._replace(tensors={**asked.tensors, **followed}), answer)
        return dict(zip(followed, pulled_back(outputs, slopes, list(followed.values())), strict=True))


def pulled_back(outputs: Any, slopes: Any, sources: list[Followed]) -> list[_Array]:
    """Derivatives with respect to the sources, from those with respect to outputs (None where they are 0)."""
    totals: dict[int, _Array] = {}
    reached: dict[int, Followed] = {}
    for output, slope in zip(outputs, slopes, strict=True):
        if slope is not None and isinstance(output, Followed):
            _gather(totals, reached, output, np.asarray(slope, np.float64))
    while reached:
        number = max(reached)  # what is made of it has been done
        for source, pull in reached.pop(number).sources:
            _gather(totals, reached, source, pull(totals[number]))
    return [totals.get(source.number, np.zeros(source.shape)) for source in sources]


def _gather(totals: dict[int, _Array], reached: dict[int, Followed], node: Followed, part: _Array) -> None:
    part = _narrowed(part, node.shape)
    totals[node.number] = totals[node.number] + part if node.number in totals else part
    reached[node.number] = node


def _narrowed(part: _Array, shape: tuple[int, ...]) -> _Array:
    """The derivative with respect to an array of this shape that was broadcast."""
    if part.shape == shape:
        return part
    part = part.sum(axis=tuple(range(part.ndim - len(shape))))
    axes = tuple(axis for axis, (size, wide) in enumerate(zip(shape, part.shape, strict=True)) if size != wide)
    return part.sum(axis=axes, keepdims=True)


def _made(value: Any, a: Any, b: Any, to_a: Any, to_b: Any) -> Followed:
    x, y = plain(a), plain(b)
    return Followed(value(x, y), (a, lambda g: to_a(g, x, y)), (b, lambda g: to_b(g, x, y)))


def _where(condition: Any, a: Any, b: Any) -> Any:
    value = np.where(condition, plain(a), plain(b))
    if not isinstance(a, Followed) and not isinstance(b, Followed):
        return value
    return Followed(value, (a, lambda g: np.where(condition, g, 0.0)), (b, lambda g: np.where(condition, 0.0, g)))


def _sqrt(a: Any) -> Any:
    value = np.sqrt(plain(a))
    return Followed(value, (a, lambda g: 0.5 * g / value)) if isinstance(a, Followed) else value


def _arctan2(a: Any, b: Any) -> Any:
    y, x = plain(a), plain(b)
    value = np.arctan2(y, x)
    if not isinstance(a, Followed) and not isinstance(b, Followed):
        return value
    squared = x * x + y * y
    return Followed(value, (a, lambda g: g * x / squared), (b, lambda g: -g * y / squared))


def _stack(arrays: list[Any], axis: int) -> Any:
    value = np.stack([plain(array) for array in arrays], axis)

    def back(number: int) -> _Pull:
        return lambda g: np.take(g, number, axis)

    if not any(isinstance(array, Followed) for array in arrays):
        return value
    return Followed(value, *((array, back(number)) for number, array in enumerate(arrays)))


def _take(table: Any, index: Any) -> Any:
    if not isinstance(table, Followed):
        return table[index]
    return Followed(table.value[index], (table, lambda g: _sums(g, index, len(table))))


def _add(rows: Any, index: Any, count: int) -> Any:
    value = _sums(plain(rows), index, count)
    return Followed(value, (rows, lambda g: g[index])) if isinstance(rows, Followed) else value


def _sums(rows: _Array, index: _Array, count: int) -> _Array:
    """Sums of the rows of each index, in the order of the rows."""
    places, shape = index.reshape(-1), rows.shape[index.ndim :]
    columns = rows.reshape(places.size, math.prod(shape)).T
    total = np.empty((len(columns), count))
    for number, column in enumerate(columns):
        total[number] = np.bincount(places, column, minlength=count)
    return total.T.reshape(count, *shape)


def _constant(values: Any, like: Any = None) -> _Array:
    array = np.asarray(plain(values))
    return array.astype(
        np.float64 if array.dtype.kind == "f" else np.int64 if array.dtype.kind in "iu" else array.dtype
    )


LIBRARY = Library(
    where=_where,
    sqrt=_sqrt,
    floor=np.floor,
    arctan2=_arctan2,
    stack=_stack,
    take=_take,
    add=_add,
    constant=_constant,
    kept=lambda cache, name, values, like: values,
    wide=lambda array: array if isinstance(array, Followed) else array.astype(np.float64),
    whole=lambda array: plain(array).astype(np.int64),
    listed=lambda offsets, total: np.repeat(np.arange(len(offsets) - 1), np.diff(offsets)),
    detach=plain,
    on_host=plain,
    ask=lambda query, points, shape, *beside: query(points, *beside),
    # There are first derivatives only.
    once=lambda array, message, of: array,
)
