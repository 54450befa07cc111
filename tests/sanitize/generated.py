"""The C++ that warp generates for a kernel module, and which of its lines came from which .inl file."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import warp as wp

from geokit.core import launcher

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "geokit"

MARKER = re.compile(r'^\s*#line (?P<line>\d+) "(?P<path>geokit/[^"]+\.inl)"\s*$')
# Warp writes this above each function that it translates.
ORIGIN = re.compile(r"^// (.*\.py):(\d+)$")


class Region(NamedTuple):
    """Lines of a generated file that are one .inl file's: ``first`` of the generated file is ``line`` of ``path``."""

    path: str
    first: int
    count: int
    line: int


def module_names() -> list[str]:
    """Kernel modules of the package, as Python imports them; some hold functions or text only."""
    paths = sorted(PACKAGE.rglob("*_kernels.py"))
    return [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in paths]


def inl_files() -> list[str]:
    return sorted(path.relative_to(ROOT).as_posix() for path in PACKAGE.rglob("*.inl"))


def kernels_of(name: str) -> set[str]:
    """The kernels of a module; none where it holds functions or text only."""
    values = vars(importlib.import_module(name)).values()
    return {value.key for value in values if isinstance(value, wp.Kernel) and value.module.name == name}


def source_of(name: str) -> Path:
    """The generated C++ of a kernel module for CPUs, which warp's kernel cache keeps beside what it compiles."""
    importlib.import_module(name)
    cpu, module = launcher.resolve_device("cpu"), wp.get_module(name)
    launcher.load_module(module, cpu)
    return source_beside(module.load(cpu, block_dim=1))


def compiled_inl_files() -> set[str]:
    """The .inl files that are part of a kernel module which warp compiles."""
    found = set()
    for name in module_names():
        if kernels_of(name):
            found |= {region.path for region in regions(source_of(name).read_text(encoding="utf-8"))}
        module = vars(importlib.import_module(name))
        # Warp translates a generic kernel once a launch has chosen its types, and with it the functions that it calls.
        # A module of functions alone is compiled with the kernels of users.
        if not kernels_of(name) or any(isinstance(value, wp.Kernel) and value.is_generic for value in module.values()):
            texts = [value.native_snippet for value in module.values() if isinstance(value, wp.Function)]
            found |= {region.path for text in texts if text for region in regions(text)}
    return found


def source_beside(executable: Any) -> Path:
    (source,) = Path(executable.binary_path).parent.glob("*.cpp")
    return source


def regions(text: str) -> Iterator[Region]:
    """Where a generated file holds .inl files: found by the #line directives of geokit/core/cpp.py."""
    lines = text.splitlines()
    markers = [(number, marker) for number, text in enumerate(lines, 1) if (marker := MARKER.match(text))]
    # A file that includes another goes on behind it.
    ends = [number for number, _ in markers[1:]] + [len(lines) + 1]
    for (number, marker), end in zip(markers, ends, strict=False):
        line = int(marker["line"])
        left = len((ROOT / marker["path"]).read_text(encoding="utf-8").rstrip("\n").split("\n")) - line + 1
        count = min(left, end - number - 1)
        if count > 0:
            yield Region(marker["path"], number + 1, count, line)


def located(text: str, name: str) -> str:
    """The same text, in which compilers name ``name`` again after the end of each .inl file.

    Nothing else tells them where a file ends: warp's own lines after it would count as its lines.
    """
    lines = text.split("\n")
    ends = {region.first + region.count - 1 for region in regions(text)}
    found = [f'#line 1 "{name}"']
    for number, line in enumerate(lines, 1):
        found.append(line)
        if number in ends:
            found.append(f'#line {number + 1} "{name}"')
    return "\n".join(found)


def origin(text: str, line: int) -> str:
    """The Python function that a line of a generated file was translated from, as ``file:line``."""
    for above in reversed(text.split("\n")[:line]):
        match = ORIGIN.match(above)
        if match:
            path = Path(match[1])
            shown = path.relative_to(ROOT) if path.is_relative_to(ROOT) else path
            return f"{shown}:{int(match[2])}"
    return ""
