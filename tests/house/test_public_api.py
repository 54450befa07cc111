"""Every public name with its signature stands in public_api.txt, so that a change of the API is a line of a diff.

``python -m tests.house.test_public_api`` writes the file anew.
"""

from __future__ import annotations

import inspect
import re
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import geokit

FILE = Path(__file__).with_name("public_api.txt")
# What each Python words differently.
WITHOUT_SIGNATURE = (property, types.GetSetDescriptorType, types.MemberDescriptorType)


def lines() -> Iterator[str]:
    for name in geokit.__all__:
        if name.startswith("__"):
            continue
        thing = getattr(geokit, name)
        if not isinstance(thing, types.ModuleType):
            yield from described(name, thing)
            continue
        for inner in thing.__all__:
            yield from described(f"{name}.{inner}", getattr(thing, inner))


def described(name: str, thing: Any) -> Iterator[str]:
    """A line for a name, and for a class one for each public attribute."""
    if not inspect.isclass(thing):
        yield f"{name}{signature(thing)}"
        return
    if issubclass(thing, Exception):
        yield f"{name}({', '.join(base.__name__ for base in thing.__bases__)})"
        return
    yield f"{name}{signature(thing)}"
    fields = set(getattr(thing, "_fields", ())) | set(getattr(thing, "__dataclass_fields__", ()))
    for attribute in sorted(vars_of(thing) - fields):
        value = inspect.getattr_static(thing, attribute)
        if isinstance(value, (classmethod, staticmethod)):
            value = value.__func__
        yield f"{name}.{attribute}{'' if isinstance(value, WITHOUT_SIGNATURE) else signature(value)}"


def vars_of(cls: type) -> set[str]:
    """Public attributes that geokit's own classes define."""
    own = [base for base in cls.__mro__ if base.__module__.startswith("geokit")]
    return {attribute for base in own for attribute in vars(base) if not attribute.startswith("_")}


def signature(thing: Any) -> str:
    if not callable(thing):
        return f": {type(thing).__name__}"
    try:
        text = str(inspect.signature(thing))
    except (TypeError, ValueError):
        return "(...)"
    # Quotes and forward references stand where a name is imported for checkers only.
    plain = re.sub(r" at 0x[0-9a-f]+", "", text.replace("'", "").replace('"', ""))
    return re.sub(r"ForwardRef\(([^()]*?)(, module=[^()]*)?\)", r"\1", plain)


def test_the_api_is_written_down() -> None:
    known = FILE.read_text(encoding="utf-8").splitlines()
    now = sorted(lines())
    gone, new = sorted(set(known) - set(now)), sorted(set(now) - set(known))
    assert now == known, (
        f"the public API is not that of {FILE.name}; if it shall change, run python -m tests.house.test_public_api\n"
        + "\n".join([*(f"- {line}" for line in gone), *(f"+ {line}" for line in new)])
    )


if __name__ == "__main__":
    FILE.write_text("\n".join(sorted(lines())) + "\n", encoding="utf-8")
