"""Scripts run as programs, in this process, which has imported what they import and loaded their kernels."""

from __future__ import annotations

import contextlib
import io
import runpy
import warnings
from pathlib import Path

import pytest

__all__ = ["run_script"]


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
