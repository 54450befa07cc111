"""What there is to know of a query besides what it computes; ``core/query/ask.py`` goes by it."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import sys
from collections.abc import Callable, Iterable
from typing import Any

# As ``least_rows``: no block is worth the copies between devices, so that the first device alone answers.
FIRST_ALONE = sys.maxsize


@dataclasses.dataclass(eq=False)
class Query:
    """A query of an object, which is its first parameter.

    Attributes:
        function: Answers a call on one device, for arguments without gradients, of an object that stays as it is.
        rows: Its next parameters that are tables (N, 3), of one row for each answer: points, or ``directions``.
        is_turned: Whether the answer, of one array, is directions.
        places: Called beside a transform with the object and the options, to refuse some.
        gradient: Rule of the answer's derivatives, as ".module:NAME" beside its own module; None if there is none.
        is_stepped: Without a rule: the answer is numbers or sides that change in steps, so that a derivative is 0 or
            nothing. Others are refused while a tape of warp records the object, where it would get zeros.
        inputs: Parameters that may be tensors with gradients; by default ``rows``.
        holders: Keywords whose objects may hold such tensors, besides the first parameter.
        is_replayed: Whether only its launches depend on the rows: small calls on a CPU repeat them alone, and a CUDA
            graph may capture them.
        least_rows: Fewest rows on GPUs for each of several devices, which answer blocks of them; None where an object
            on several devices answers by itself.
        row_bytes: Memory that a row needs.
        memory: Called with the arguments of a call besides ``transform``; returns further bytes that it needs.
        name: Name in messages; by default that of the function.
        parameters: Names and defaults of all parameters.
        positional: Names of those that may be given by position.
        others: Names of those that are no inputs.
        kind: NamedTuple of the answer, or None for a single array.
        is_ragged: Whether the answer is lists of any length, with ``offsets`` of each row's.
        moved: Fields of the answer that are points or directions: ``points`` and ``normals``.
        is_method: Whether it is a method.
        is_packed: Whether it is asked of many objects, with ``offsets`` of each one's rows. The function itself sees
            the transforms then, and the leading axes of rows.
        is_single: Whether rows of any leading axes are taken, (3,) or (B, N, 3), and answered with them.
        is_placed: Whether its option ``transform`` says where the object is.
        call: The query as callers see it.
        answer: The query for arguments without gradients.
    """

    function: Callable[..., Any]
    rows: tuple[str, ...] = ()
    is_turned: bool = False
    places: Callable[..., None] | None = None
    gradient: str | None = None
    is_stepped: bool = False
    inputs: tuple[str, ...] = ()
    holders: tuple[str, ...] = ()
    is_replayed: bool = False
    least_rows: int | None = None
    row_bytes: int = 0
    memory: Callable[..., float] | None = None
    name: str = ""

    def __post_init__(self) -> None:
        self._signature = inspect.signature(self.function)
        given = self._signature.parameters
        self.name, self.inputs = self.name or self.function.__name__, self.inputs or self.rows
        self.parameters = tuple((name, parameter.default) for name, parameter in given.items())
        self.others = tuple(name for name in given if name not in self.inputs)
        self.positional = tuple(name for name, one in given.items() if one.kind is not one.KEYWORD_ONLY)
        self._defaults = dict(self.parameters)
        # Results are defined above the queries that return them.
        kind = self.function.__globals__.get(str(self._signature.return_annotation))
        self.kind: Any = kind if hasattr(kind, "_fields") else None
        fields = self.kind._fields if self.kind else ()
        self.is_ragged = "offsets" in fields
        self.moved = tuple(field for field in fields if field in ("points", "normals"))
        self.is_method = self.positional[:1] == ("self",)
        self.is_packed = "offsets" in given
        self.is_single = bool(self.rows) and not self.is_packed
        self.is_placed = bool(self.rows) and "transform" in self._defaults
        self.call: Callable[..., Any] = self.function
        self.answer: Callable[..., Any] = self.function
        self._rule: Any = None
        QUERIES[f"{self.function.__module__}.{self.function.__qualname__}"] = self

    @property
    def has_rows(self) -> bool:
        """Whether each row has a row of the answer, which depends on no other row."""
        return self.least_rows is not None and not self.is_ragged

    def rule(self) -> Any:
        """The rule of its gradients; its module is imported by the first call with gradients."""
        if self._rule is None:
            module, _, name = str(self.gradient).partition(":")
            package = self.function.__module__.rpartition(".")[0]
            self._rule = getattr(importlib.import_module(module, package), name)
        return self._rule

    def bind(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> dict[str, Any]:
        """All arguments of a call by name.

        Raises:
            TypeError: The call does not fit the query.
        """
        given = dict(zip(self.positional, args, strict=False))
        found = {**self._defaults, **given, **kwargs}
        fits = len(given) == len(args) and len(found) == len(self._defaults) and given.keys().isdisjoint(kwargs)
        if fits and not any(value is inspect.Parameter.empty for value in found.values()):
            return found
        # What does not fit is named there, which takes ten times as long.
        bound = self._signature.bind(*args, **kwargs)
        bound.apply_defaults()
        return dict(bound.arguments)

    def run(self, arguments: dict[str, Any]) -> Any:
        """The answer for arguments without gradients, by name."""
        # Rows go by position: small calls are replayed then.
        rest = {name: value for name, value in arguments.items() if name not in self.positional}
        return self.answer(*(arguments[name] for name in self.positional), **rest)


# All queries whose modules have been imported, by module and name.
QUERIES: dict[str, Query] = {}


def queries_of(home: Any, names: Iterable[str] = ()) -> dict[str, Query]:
    """The queries among attributes of a class or a module, by name; without names, among all that are public."""
    asked = names or [name for name in dir(home) if not name.startswith("_")]
    found = {name: getattr(getattr(home, name, None), "query", None) for name in asked}
    return {name: query for name, query in found.items() if isinstance(query, Query)}
