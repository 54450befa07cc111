"""Programs in pages of the documentation, each a fenced block whose first line is a comment that names it."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

__all__ = ["blocks_of", "run_block"]

ROOT = Path(__file__).resolve().parents[2]


def blocks_of(page: Path) -> dict[str, str]:
    """Programs of a page by name; all of its Python blocks have one.

    Raises:
        AssertionError: A block has no name, or that of another.
    """
    text = page.read_text(encoding="utf-8")
    blocks = dict(re.findall(r"^```python\n# (\w+)\n(.*?)^```", text, re.MULTILINE | re.DOTALL))
    assert text.count("```python") == len(blocks)
    return blocks


def run_block(page: Path, name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The block as a module of its own, run beside the samples: warp reads the source of kernels from their file."""
    (folder / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(folder)
    path = folder / f"block_{name}.py"
    path.write_text(blocks_of(page)[name], encoding="utf-8")
    spec = importlib.util.spec_from_file_location(f"{page.stem.replace('-', '_')}_{name}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
