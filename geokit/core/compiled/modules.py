"""Kernel modules of the package, and the modules of warp that importing one of them makes."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from geokit.core.base.late_warp import wp
from geokit.core.launches import warp_private

_SUFFIX = "_kernels"


def kernel_modules() -> list[str]:
    """Dotted names of all kernel modules of geokit; this imports none, so that no missing package hides one."""
    import geokit

    # An editable installation has two folders: the sources, and what was built of them.
    roots = [Path(path) for path in geokit.__path__]
    paths = {path.relative_to(root).with_suffix("") for root in roots for path in root.rglob(f"*{_SUFFIX}.py")}
    return sorted(".".join(("geokit", *path.parts)) for path in paths)


def warp_modules(name: str) -> list[Any]:
    """Modules of warp with kernels that a kernel module has: its own, and those that it made for variants."""
    python = importlib.import_module(name)
    found = {kernel.module.name: kernel.module for kernel in _kernels(vars(python).values())}
    return [module for key, module in sorted(found.items()) if key == name or key.startswith(f"{name}.")]


def _kernels(values: Iterable[Any]) -> Iterator[Any]:
    """Kernels with code among values and in the tables there; a generic kernel has none until it has an overload."""
    for value in values:
        if isinstance(value, wp.Kernel):
            if warp_private.has_code(value):
                yield value
        elif isinstance(value, dict):
            yield from _kernels(value.values())
        elif isinstance(value, list | tuple):
            yield from _kernels(value)
