"""Packages whose public names are imported when they are first used."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from types import ModuleType
from typing import Any

__all__ = ["make_lazy"]


class _LazyPackage(ModuleType):
    """A package with a table of its public names: name -> the module that defines it."""

    _lazy_modules: Mapping[str, str]

    def __getattr__(self, name: str) -> Any:
        module = self.__dict__["_lazy_modules"].get(name)
        if module is None:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(module), name)
        self.__dict__[name] = value
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        # Importing a submodule binds it here; where it has a public function's name, as ``audit`` has, users of the
        # package mean the function.
        if isinstance(value, ModuleType) and name in self.__dict__["_lazy_modules"]:
            value = getattr(value, name)
        super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted(self.__dict__["_lazy_modules"])


def make_lazy(package: str, modules: Mapping[str, str]) -> None:
    """Give ``package`` the names of ``modules``, each imported from its module when first used.

    Args:
        package: The package's ``__name__``.
        modules: Public name -> full name of the module that defines it.
    """
    module = sys.modules[package]
    module.__dict__["_lazy_modules"] = dict(modules)
    module.__class__ = _LazyPackage
