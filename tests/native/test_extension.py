"""The compiled extension as a file: what it exports, what it expects from libraries, and what it says of itself."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from geokit import native

pytestmark = pytest.mark.skipif(not native.available(), reason="geokit was built without OpenVDB")


def extension() -> Path:
    from geokit.native import _bridge

    return Path(_bridge.__file__)


def test_every_symbol_is_found() -> None:
    # library_grids.h relies on code that libopenvdb must have.
    code = f"import importlib.util as u; u.module_from_spec(u.spec_from_file_location('_bridge', {str(extension())!r}))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env={**os.environ, "LD_BIND_NOW": "1"}
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(shutil.which("nm") is None, reason="no binutils")
def test_only_the_entry_is_exported() -> None:
    listed = subprocess.run(["nm", "-D", "--defined-only", extension()], capture_output=True, text=True, check=True)
    assert [row.split()[-1] for row in listed.stdout.splitlines()] == ["PyInit__bridge"]


def test_the_worker_starts_beside_it() -> None:
    done = subprocess.run([extension().with_name("geokit_vdb_worker")], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("usage: geokit_vdb_worker")


def test_build_facts() -> None:
    facts = native.build_facts()
    assert facts["extension"] == "yes"
    assert {"openvdb", "nanovdb", "tbb", "compiler", "python", "libraries"} < set(facts)
