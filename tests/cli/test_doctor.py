"""``geokit doctor``."""

from __future__ import annotations

import importlib.metadata
import json
import subprocess

import pytest

from geokit import native
from geokit.cli import _compile
from geokit.core.compiled.modules import kernel_modules
from tests.support.effort import spread


@pytest.fixture(scope="module", params=[pytest.param("doctor", marks=pytest.mark.slow)])
def done(geokit) -> "subprocess.CompletedProcess[str]":
    """The report with everything in it. Of the kernel modules some are built: tests of wheels build all."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_compile, "kernel_modules", lambda: spread(kernel_modules(), 12))
        return geokit("doctor", "--compile", "--json")


def test_the_report(done) -> None:
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["versions"]["numpy"] == importlib.metadata.version("numpy")
    assert report["versions"]["warp-lang"] == importlib.metadata.version("warp-lang")
    assert report["machine"]["cpu threads"] >= 1
    assert "kernel cache" in report["machine"]
    assert (report["openvdb"]["bridge"] == "available") is native.available()
    working = [name for name in ("EGL", "OSMesa") if report["opengl"][name].startswith("works")]
    # What is used for figures is one of those that draw.
    used = {"vtkEGLRenderWindow": "EGL", "vtkOSOpenGLRenderWindow": "OSMesa"}.get(report["opengl"]["used for figures"])
    assert used in working if working else used is None


def test_every_kernel_module_is_found() -> None:
    from pathlib import Path

    import geokit

    root = Path(geokit.__file__).parent
    files = {".".join(("geokit", *path.relative_to(root).with_suffix("").parts)) for path in root.rglob("*_kernels.py")}
    assert set(kernel_modules()) == files


def test_compile_builds_all_of_them(done) -> None:
    modules = spread(kernel_modules(), 12)
    kernels = json.loads(done.stdout)["kernels"]
    assert kernels["modules"] == len(modules)
    assert kernels["failed"] == []
    # A line for each, and nothing else.
    said = [line.split()[2] for line in done.stderr.splitlines()]
    assert sorted(name.removesuffix(":") for name in said) == sorted(modules)
