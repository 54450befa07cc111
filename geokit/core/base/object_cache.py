"""What was computed about an object and is kept with it: one cache for each mesh and each volume."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, TypeVar

_Value = TypeVar("_Value")
_MISSING: Any = object()


class ObjectCache:
    """Results by key, kept until their object is freed or :meth:`clear` is called.

    Values must not refer to the object, or it is freed only by the garbage collector. Threads may share a cache: where
    two miss a key at the same time both compute the value, and both get the one that was kept first. A pickle carries
    none of the values.
    """

    def __init__(self) -> None:
        self._values: dict[Hashable, Any] = {}

    def find(self, key: Hashable, make: Callable[[], _Value]) -> _Value:
        """The value of a key; ``make`` computes it where there is none yet, and nothing is kept where that fails."""
        value = self._values.get(key, _MISSING)
        return self._values.setdefault(key, make()) if value is _MISSING else value

    def keep(self, key: Hashable, value: Any) -> None:
        """Set the value of a key."""
        self._values[key] = value

    def __contains__(self, key: Hashable) -> bool:
        return key in self._values

    def clear(self) -> None:
        """Forget all values; they are computed again when they are needed."""
        self._values.clear()

    def __reduce__(self) -> Any:
        return ObjectCache, ()


class CacheAttribute:
    """An attribute that makes an object's cache when it is first used.

    It needs no line in ``__init__``, so that classes whose objects are also made by ``__new__`` or by
    ``dataclasses.replace`` can have it; each object has a cache of its own.
    """

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, instance: object, owner: type | None = None) -> ObjectCache:
        # setdefault: of two threads that come at the same time, both get the same cache.
        cache: ObjectCache = instance.__dict__.setdefault(self._name, ObjectCache())
        return cache
