"""``geokit doctor``: reports what works on this machine."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from geokit.cli._console import note, plain, print_facts, print_json

__all__ = ["doctor"]

# Packages whose versions a bug report needs; the second group is optional.
PACKAGES = ("warp-lang", "numpy", "trimesh", "meshio", "pyvista", "vtk", "cyclopts", "rich")
OPTIONAL_PACKAGES = ("usd-core", "scipy", "blosc")
# A software renderer on a busy machine takes seconds to start.
GL_SECONDS = 60.0
# Draws a plane and checks the pixels. It runs in a separate process, because a failing GL library may crash it.
GL_PROBE = """
import pyvista as pv
plotter = pv.Plotter(off_screen=True, window_size=(64, 64))
plotter.set_background("white")
plotter.add_mesh(pv.Plane(), color="black", lighting=False)
picture = plotter.screenshot(return_img=True)
lines = plotter.render_window.ReportCapabilities().splitlines()
renderer = "".join(line.partition(":")[2].strip() for line in lines if line.startswith("OpenGL renderer string"))
print(type(plotter.render_window).__name__, int(picture.min()), renderer)
"""


def doctor(
    *,
    compile: Annotated[bool, Parameter(negative="")] = False,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Report versions, devices, libraries and the kernel cache.

    Args:
        compile: Compile every kernel for every device now, so that later commands start without delay.
        json: Print JSON.
    """
    report: dict[str, Any] = {
        "versions": _versions(),
        "machine": _machine(),
        "openvdb": _bridge(),
        "opengl": _opengl(),
    }
    if compile:
        from geokit.cli._compile import compile_all

        report["kernels"] = compile_all(note)
    if json:
        print_json(report)
    else:
        for index, (title, facts) in enumerate(report.items()):
            print(("\n" if index else "") + title)
            print_facts({name: value if value != "" else "not installed" for name, value in facts.items()}, indent="  ")
    failed = plain(report.get("kernels", {})).get("failed", [])
    return 1 if failed else 0


def _versions() -> dict[str, str]:
    import geokit

    versions = {"geokit": geokit.__version__, "python": platform.python_version()}
    for package in (*PACKAGES, *OPTIONAL_PACKAGES):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = ""
    return versions


def _machine() -> dict[str, Any]:
    from geokit.core import launcher

    cpu = launcher.resolve_device("cpu")
    import warp as wp

    facts: dict[str, Any] = {"system": platform.platform(), "cpu threads": launcher.thread_count(), "cpu": cpu.name}
    for alias in launcher.cuda_devices():
        device = wp.get_device(alias)
        facts[alias] = f"{device.name}, sm_{device.arch}, {device.total_memory / 2**30:.1f} GiB"
    if not launcher.cuda_devices():
        facts["cuda"] = "no device"
    folder = Path(str(wp.config.kernel_cache_dir))
    modules = sum(1 for entry in folder.glob("wp_geokit*")) if folder.is_dir() else 0
    facts["kernel cache"] = f"{folder} ({modules} geokit modules)"
    return facts


def _bridge() -> dict[str, Any]:
    from geokit import native
    from geokit.errors import MissingDependencyError

    try:
        native.require()
    except MissingDependencyError as error:
        return {"bridge": f"not available: {error}"}
    facts: dict[str, Any] = {"bridge": "available"}
    facts.update(plain(native.versions()))
    return facts


def _opengl() -> dict[str, str]:
    from geokit.errors import MissingDependencyError
    from geokit.render import gl_backend
    from geokit.render._backend import BACKENDS

    with ThreadPoolExecutor(len(BACKENDS)) as pool:
        facts = dict(zip(BACKENDS, pool.map(_try_opengl, BACKENDS.values()), strict=True))
    try:
        facts["used for figures"] = gl_backend()
    except MissingDependencyError as error:
        facts["used for figures"] = f"none: {error}"
    return facts


def _try_opengl(window: str) -> str:
    environment = {**os.environ, "VTK_DEFAULT_OPENGL_WINDOW": window}
    try:
        done = subprocess.run(
            [sys.executable, "-c", GL_PROBE], capture_output=True, text=True, timeout=GL_SECONDS, env=environment
        )
    except subprocess.TimeoutExpired:
        return f"does not answer within {GL_SECONDS:.0f} s"
    answer = done.stdout.split(maxsplit=2)
    # VTK silently uses another class if the wanted one fails.
    if done.returncode != 0 or len(answer) < 2 or answer[0] != window:
        return "does not work"
    if int(answer[1]) > 128:
        return "opens a window but draws nothing"
    return f"works, {answer[2].strip()}" if len(answer) > 2 else "works"
