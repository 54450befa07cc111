"""Compiles all kernel modules ahead of their first use."""

from __future__ import annotations

import contextlib
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from geokit.core.compiled.modules import kernel_modules

# Processes rather than threads, because warp compiles one module at a time in a process. Several processes can share
# its cache. A builder reads module names from stdin and answers each with a line: "ok", or the error.
_BUILDER = """
import sys
from geokit.core.running.answers import take_stdout
answers = take_stdout()
from geokit.core import launcher
from geokit.core.compiled.modules import warp_modules
devices = [launcher.resolve_device(alias) for alias in sys.argv[1:]]
for line in sys.stdin:
    try:
        for module in warp_modules(line.strip()):
            for device in devices:
                launcher.load_module(module, device)
        answer = "ok"
    except Exception as error:
        answer = " ".join(f"{type(error).__name__}: {error}".split())
    print(answer, file=answers)
"""


def compile_all(report: Callable[[str], None]) -> dict[str, Any]:
    """Compile all kernel modules for the CPU and all CUDA devices, on all CPU cores.

    Args:
        report: Called with one line per module.
    Returns:
        A dict with the number of compiled modules, the devices, the seconds and the modules that failed.
    """
    from geokit.core import launcher

    started = time.perf_counter()
    devices = ["cpu", *launcher.cuda_devices()]
    modules = kernel_modules()
    waiting: queue.SimpleQueue[str] = queue.SimpleQueue()
    for name in modules:
        waiting.put(name)
    failed: list[str] = []
    done = 0
    lock = threading.Lock()

    def finished(name: str, answer: str, seconds: float) -> None:
        nonlocal done
        with lock:
            done += 1
            if answer != "ok":
                failed.append(name)
            report(f"{done}/{len(modules)} {name}: {answer} [{seconds:.1f} s]")

    count = min(launcher.thread_count(), len(modules))
    builders = [threading.Thread(target=_build_all, args=(waiting, devices, finished)) for _ in range(count)]
    try:
        for builder in builders:
            builder.start()
        for builder in builders:
            builder.join()
    except BaseException:  # Ctrl-C, which in a terminal has ended the processes too: no other module is compiled
        with contextlib.suppress(queue.Empty):
            while True:
                waiting.get_nowait()
        raise
    return {
        "modules": len(modules) - len(failed),
        "devices": devices,
        "seconds": round(time.perf_counter() - started, 1),
        "failed": sorted(failed),
    }


def _build_all(
    waiting: "queue.SimpleQueue[str]", devices: list[str], finished: Callable[[str, str, float], None]
) -> None:
    """Give modules to a builder process until none is left; start a new process if one dies."""
    while not waiting.empty():
        with subprocess.Popen(
            [sys.executable, "-c", _BUILDER, *devices],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        ) as process:
            while True:
                try:
                    name = waiting.get_nowait()
                except queue.Empty:
                    break
                started = time.perf_counter()
                answer = _build_one(process, name)
                finished(name, answer or "the compiler ended the process", time.perf_counter() - started)
                if not answer:
                    break


def _build_one(process: "subprocess.Popen[str]", name: str) -> str:
    """Send a module name to the builder and return its answer, or "" if the process has ended."""
    try:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(name + "\n")
        process.stdin.flush()
        return process.stdout.readline().strip()
    except OSError:
        return ""
