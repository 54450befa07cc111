"""The house gets no larger and no more tangled: what was counted may only fall.

``python -m tests.house.test_ceilings`` prints what there is, in the form of ``CEILINGS``. A change that lowers a figure
lowers its ceiling; none is raised.
"""

from __future__ import annotations

import functools
import inspect
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import pytest

import geokit
from tests.house.test_rooms import FORWARDING, PACKAGE, edges

# Lines of all that is in the package, whatever language. Files of any kind in the folders with more than MOST_FILES.
# Folders that import each other, directly or by others. Files in import circles, with the methods of data that forward
# to verbs. Annotations of public names with Any.
MOST_FILES = 26
CEILINGS = {
    "lines": 113937,
    "folders in knots": 0,
    "files in import circles": 33,
    "public arguments with Any": 25,
    "public returns with Any": 1,
    "public fields with Any": 2,
}
SUFFIXES = {".py", ".pyi", ".inl", ".cpp", ".h", ".js", ".css", ".html", ".map", ".txt", ".yaml", ".typed"}
# A ceiling of lines is lowered now and then, not with each line.
SLACK = {"lines": 500}


def files() -> Iterator[Any]:
    for path in PACKAGE.rglob("*"):
        if path.suffix in SUFFIXES and "__pycache__" not in path.parts:
            yield path


def circles(graph: Mapping[str, set[str]]) -> list[set[str]]:
    """The sets of names that reach each other, of two or more (Tarjan's algorithm without recursion)."""
    number: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found = []
    for start in sorted(graph):
        if start in number:
            continue
        work = [(start, iter(sorted(graph[start])))]
        number[start] = low[start] = len(number)
        stack.append(start)
        while work:
            name, targets = work[-1]
            for target in targets:
                if target not in number:
                    number[target] = low[target] = len(number)
                    stack.append(target)
                    work.append((target, iter(sorted(graph.get(target, ())))))
                    break
                if target in stack:
                    low[name] = min(low[name], number[target])
            else:
                work.pop()
                if work:
                    low[work[-1][0]] = min(low[work[-1][0]], low[name])
                if low[name] == number[name]:
                    place = stack.index(name)
                    circle, stack[place:] = set(stack[place:]), []
                    found += [circle] if len(circle) > 1 else []
    return found


def imports(*, forwarders: bool) -> dict[str, set[str]]:
    """Each file with those that it imports, also within functions; what methods of data forward to, or not."""
    return {
        name: {target for target, inside in targets if forwarders or not (inside and name in FORWARDING)}
        for name, targets in edges().items()
    }


def folder_of(name: str) -> str:
    return name if (PACKAGE / name).is_dir() else name.rpartition("/")[0]


def knotted_folders() -> set[str]:
    between: dict[str, set[str]] = {}
    for name, targets in imports(forwarders=False).items():
        inside = between.setdefault(folder_of(name), set())
        inside.update(set(map(folder_of, targets)) - {folder_of(name)})
    between.pop("", None)  # geokit's own files: errors, versions, samples
    return set().union(*circles({name: targets - {""} for name, targets in between.items()}))


def public_annotations() -> Iterator[tuple[str, str, Any]]:
    """The kind, the name and the annotation of each argument, return and field of public names."""
    for door in geokit.__all__:
        module = getattr(geokit, door)
        if not inspect.ismodule(module):
            continue
        for name in module.__all__:
            thing = getattr(module, name)
            named = f"{door}.{name}"
            if not inspect.isclass(thing):
                yield from of_callable(named, thing)
                continue
            for field, annotation in inspect.get_annotations(thing).items():
                if not field.startswith("_"):
                    yield "fields", f"{named}.{field}", annotation
            for method in sorted({*dir(thing), "__init__"}):
                value = inspect.getattr_static(thing, method)
                value = getattr(value, "__func__", getattr(value, "fget", value))
                is_made = method == "__init__" and not hasattr(thing, "__dataclass_fields__")
                ours = str(getattr(value, "__module__", "")).startswith("geokit")
                if (is_made or not method.startswith("_")) and inspect.isfunction(value) and ours:
                    yield from of_callable(f"{named}.{method}", value)


def of_callable(name: str, thing: Any) -> Iterator[tuple[str, str, Any]]:
    try:
        signature = inspect.signature(thing)
    except (TypeError, ValueError):
        return
    for parameter in signature.parameters.values():
        yield "arguments", f"{name}({parameter.name})", parameter.annotation
    yield "returns", name, signature.return_annotation


@functools.cache
def counted() -> dict[str, int]:
    each = Counter(path.parent.relative_to(PACKAGE).as_posix() for path in files())
    untyped = Counter(kind for kind, _, annotation in public_annotations() if re.search(r"\bAny\b", str(annotation)))
    return {
        "lines": sum(len(path.read_text(encoding="utf-8").splitlines()) for path in files()),
        **{f"files in {folder}": count for folder, count in sorted(each.items()) if count > MOST_FILES},
        "folders in knots": len(knotted_folders()),
        "files in import circles": len(set().union(*circles(imports(forwarders=True)))),
        **{f"public {kind} with Any": untyped[kind] for kind in ("arguments", "returns", "fields")},
    }


@pytest.mark.parametrize("what", sorted(CEILINGS))
def test_nothing_is_above_its_ceiling(what: str) -> None:
    found, ceiling = counted().get(what, 0), CEILINGS[what]
    assert found <= ceiling, f"{what}: {found}, and the most is {ceiling}; see docs/design/house.md"
    least = ceiling - SLACK.get(what, 0)
    assert found >= least, f"{what}: {found}; lower its ceiling from {ceiling} in {__file__}"


def test_everything_has_a_ceiling() -> None:
    assert counted().keys() <= CEILINGS.keys()


def test_circles_are_found() -> None:
    graph = {"a": {"b"}, "b": {"c", "d"}, "c": {"a"}, "d": {"e"}, "e": {"d", "f"}, "f": set(), "g": {"g", "f"}}
    assert sorted(map(sorted, circles(graph))) == [["a", "b", "c"], ["d", "e"]]


if __name__ == "__main__":
    for name, figure in counted().items():
        print(f'    "{name}": {figure},')
