"""``geokit doctor``."""

from __future__ import annotations

import importlib.metadata
import json

import pytest

from geokit import native
from geokit.core.compiled.modules import kernel_modules


@pytest.mark.slow
def test_the_report(geokit) -> None:
    done = geokit("doctor", "--json")
    assert (done.returncode, done.stderr) == (0, "")
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


@pytest.mark.slow
def test_compile_builds_all_of_them(geokit) -> None:
    # The cache is warm after the other tests, so that this takes one start of warp for each module.
    done = geokit("doctor", "--compile", "--json")
    assert done.returncode == 0, done.stderr
    kernels = json.loads(done.stdout)["kernels"]
    assert kernels["modules"] == len(kernel_modules())
    assert kernels["failed"] == []
    for module in kernel_modules():
        assert module in done.stderr
