"""``geokit doctor``: reports what works on this machine, and what mends the rest."""

from __future__ import annotations

import importlib.util
import os
import platform
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from geokit.cli._program.console import note, plain, print_facts, print_json, print_table, step
from geokit.core.base.late_warp import wp

# Characters of a line of package versions.
WIDTH = 110
# A software renderer on a busy machine takes seconds to start.
GL_SECONDS = 60.0
# Draws a plane and checks the pixels. It runs in a separate process, because a failing GL library may crash it.
GL_PROBE = """
from geokit.core.running.answers import take_stdout
answers = take_stdout()
import pyvista as pv
plotter = pv.Plotter(off_screen=True, window_size=(64, 64))
plotter.set_background("white")
plotter.add_mesh(pv.Plane(), color="black", lighting=False)
picture = plotter.screenshot(return_img=True)
lines = plotter.render_window.ReportCapabilities().splitlines()
renderer = "".join(line.partition(":")[2].strip() for line in lines if line.startswith("OpenGL renderer string"))
print(type(plotter.render_window).__name__, int(picture.min()), renderer, file=answers)
"""


def doctor(
    *,
    compile: Annotated[bool, Parameter(negative="")] = False,
    latency: Annotated[bool, Parameter(negative="")] = False,
    device: str | None = None,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Report versions, devices, what works on this machine, what does not, and the command that mends it.

    Args:
        compile: Compile every kernel for every device now, so that later commands start without delay.
        latency: Instead of the report, measure the first and the second call of every query, each in a new process
            with an empty kernel cache. It takes a minute, or many where kernels have to be compiled.
        device: Device of the queries: cpu, cuda:0, ...; by default the first GPU, else the CPU.
        json: Print JSON.
    """
    import geokit

    if latency:
        return _latency(device, json)
    report: dict[str, Any] = {**geokit.show_config(), "machine": _machine(), "openvdb": _bridge()}
    with step("try what draws figures", quiet=json):
        report["opengl"] = _opengl()
    report["works"], report["missing"] = _abilities(report)
    if compile:
        from geokit.cli._compile import compile_all

        report["kernels"] = compile_all(note)
    if json:
        print_json(report)
    else:
        installed = ", ".join(f"{name} {version}" for name, version in report["versions"].items() if version)
        print(textwrap.fill(installed, WIDTH))
        for title in ("machine", "works", "missing", "kernels"):
            if report.get(title):
                print(f"\n{title}")
                print_facts(report[title], indent="  ")
    failed = plain(report.get("kernels", {})).get("failed", [])
    return 1 if failed else 0


def _latency(device: str | None, json: bool) -> int:
    from geokit.cli._latency import COLUMNS, measure_latency

    rows = measure_latency(device, note)
    if json:
        print_json(rows)
    else:
        print_table(COLUMNS, [list(row.values()) for row in rows])
    return 0


def _abilities(report: dict[str, Any]) -> tuple[dict[str, str], dict[str, str]]:
    """What works here, and how well; what does not, and what mends it."""
    from geokit._packages import PACKAGES, remedy

    works, missing = {"queries on the CPU": f"{report['machine']['cpu threads']} threads"}, {}
    if report["machine"].get("cuda") == "no device":
        missing["queries on a GPU"] = "needs an NVIDIA GPU and its driver"
    else:
        works["queries on a GPU"] = ", ".join(name for name in report["machine"] if name.startswith("cuda"))
    if report["openvdb"]["bridge"] == "available":
        works[".vdb files, CSG, filters"] = f"OpenVDB {report['openvdb']['openvdb']}, {report['build']['libraries']}"
    else:
        missing[".vdb files, CSG, filters"] = report["openvdb"]["bridge"].removeprefix("not available: ")
    used = report["opengl"]["used for figures"]
    if used.startswith("none: "):
        missing["figures"] = used.removeprefix("none: ").rpartition("; ")[2]
    else:
        works["figures"] = used
    folder = Path(report["machine"]["kernel cache"].rpartition(" (")[0])
    present = next(parent for parent in (folder, *folder.parents) if parent.exists())
    if os.access(present, os.W_OK):
        works["kept kernels"] = str(folder)
    else:
        missing["kept kernels"] = f"{folder} is not writable: chmod u+w it, or set WARP_CACHE_PATH to a folder that is"
    for module, package in PACKAGES.items():
        what = package.needed_by.removeprefix("a ").removeprefix("an ").rstrip(",")
        if importlib.util.find_spec(module) is None:
            missing[what] = remedy(module)
        elif package.extra:
            works[what] = f"{package.name} {report['versions'][package.name]}"
    return works, missing


def _machine() -> dict[str, Any]:
    from geokit.core import launcher
    from geokit.core.compiled import cpu_level, shipped

    cpu = launcher.resolve_device("cpu")
    facts: dict[str, Any] = {"system": platform.platform(), "cpu threads": launcher.thread_count(), "cpu": cpu.name}
    for alias in launcher.cuda_devices():
        device = wp.get_device(alias)
        facts[alias] = f"{device.name}, sm_{device.arch}, {device.total_memory / 2**30:.1f} GiB"
    if not launcher.cuda_devices():
        facts["cuda"] = "no device"
    folder = Path(str(wp.config.kernel_cache_dir))
    modules = sum(1 for entry in folder.glob("wp_geokit*")) if folder.is_dir() else 0
    facts["cpu kernels for"] = cpu_level.level()
    facts["kernels of the wheel"] = (
        f"{shipped.count()} objects for warp {wp.__version__}" if shipped.count() else "none"
    )
    facts["kernel cache"] = f"{folder} ({modules} geokit modules)"
    return facts


def _bridge() -> dict[str, Any]:
    from geokit import native
    from geokit.errors import MissingDependencyError

    try:
        native.require()
    except MissingDependencyError as error:
        return {"bridge": f"not available: {error}"}
    return {"bridge": "available", **native.versions()}


def _opengl() -> dict[str, str]:
    from geokit._packages import require_package
    from geokit.errors import MissingDependencyError
    from geokit.render import gl_backend
    from geokit.render._backend import BACKENDS

    try:
        require_package("pyvista")
    except MissingDependencyError as error:
        return {"used for figures": f"none: {error}"}
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
