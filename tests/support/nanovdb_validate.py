"""What other programs know of NanoVDB's types, and Debian's nanovdb_validate asked about a file."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

# Types that .vdb files hold; of the others NanoVDB's own tools know some.
OPENVDB = ("float", "double", "int32", "int64", "uint32", "vec3f", "vec3d", "vec4f", "vec4d", "bool", "mask")
VALIDATED = ("float", "double", "int16", "int32", "int64", "uint32", "vec3f", "vec3d", "bool", "mask", "rgba8")

needs_validate = pytest.mark.skipif(
    shutil.which("nanovdb_validate") is None, reason="nanovdb_validate is not installed"
)


def assert_validated(path: Path, grids: int = 1) -> None:
    """All ``grids`` of a .nvdb file are sound."""
    done = subprocess.run(["nanovdb_validate", "-v", path], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("passed") == grids, done.stdout + done.stderr
    assert "failed" not in done.stdout
