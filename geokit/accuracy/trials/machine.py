"""Facts about the machine and the versions, for reports."""

from __future__ import annotations

import datetime
import os
import platform
from collections.abc import Mapping

from geokit._config import show_config
from geokit.core.base.late_warp import wp
from geokit.core.base.system import said


def machine_facts() -> dict[str, str]:
    """Processor, memory, GPUs, system and date."""
    from geokit.core import launcher

    facts = {
        "processor": processor_name(),
        "cores": str(os.cpu_count() or 1),
        "threads": str(launcher.thread_count()),
        "memory": _memory_text(),
    }
    for alias in launcher.cuda_devices():
        device = wp.get_device(alias)
        facts[alias] = f"{device.name}, {device.total_memory / 2**30:.0f} GiB"
    if not launcher.cuda_devices():
        facts["GPU"] = "none that CUDA can use"
    facts["system"] = platform.platform()
    facts["date"] = datetime.datetime.now(datetime.timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    return {name: value for name, value in facts.items() if value}


def machine_line(facts: Mapping[str, str]) -> str:
    """The machine of :func:`machine_facts` in one line, for figures."""
    gpus = [value for name, value in facts.items() if name.startswith("cuda")]
    threads = f"{facts['threads']} threads" if "threads" in facts else ""
    return ", ".join(filter(None, [facts.get("processor", ""), threads, *gpus]))


def version_facts() -> dict[str, str]:
    """Versions of geokit and of its dependencies."""
    versions, build = show_config().values()
    versions.update({"warp": versions["warp-lang"], "OpenVDB": build.get("openvdb", "not installed")})
    facts = {name: versions[name] for name in ("geokit", "python", "warp", "numpy", "OpenVDB")}
    return facts | ({"NanoVDB": build["nanovdb"]} if "nanovdb" in build else {})


def processor_name() -> str:
    """Name of the processor as reported by the system."""
    return " ".join(said("/proc/cpuinfo", "model name")) or platform.processor() or platform.machine() or "unknown"


def _memory_text() -> str:
    try:
        return f"{os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 2**30:.1f} GiB"
    except (AttributeError, ValueError, OSError):
        return ""
