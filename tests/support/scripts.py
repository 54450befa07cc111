"""Scripts and examples, run in this process, which has imported what they import and loaded their kernels."""

from __future__ import annotations

import contextlib
import importlib
import io
import runpy
import warnings
from pathlib import Path
from types import ModuleType

import pytest

__all__ = ["EXAMPLES", "import_example", "run_script"]

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def import_example(name: str) -> ModuleType:
    """An example as a module; what it imports stands beside it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        return importlib.import_module(name)


def run_script(path: Path, *arguments: object, folder: Path) -> str:
    """What ``python PATH ARGUMENT ...`` prints in a folder."""
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("default")
        patch.chdir(folder)
        patch.syspath_prepend(path.parent)
        patch.setattr("sys.argv", [str(path), *map(str, arguments)])
        with contextlib.redirect_stdout(io.StringIO()) as said:
            runpy.run_path(str(path), run_name="__main__")
    return said.getvalue()
