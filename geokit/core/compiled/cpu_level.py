"""The processor that CPU kernels are compiled for: a level of x86-64 rather than the exact model.

Objects of a level serve every machine that has it, so a wheel can bring them, and machines of a level give equal
answers. A level costs no speed that can be measured (docs/design/cold-start.md).
"""

from __future__ import annotations

import functools
import os
import platform
from pathlib import Path
from typing import Any

from geokit.core.base.late_warp import wp
from geokit.core.base.system import said
from geokit.errors import InputError

NATIVE = "native"
# What warp compiles for by default.
_NATIVE_FLAG = "-march=native"
_V3 = frozenset(["avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"])
# Levels of the x86-64 psABI, best first, and what Linux calls their features.
LEVELS = {"x86-64-v4": _V3 | frozenset(["avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"]), "x86-64-v3": _V3}
# Clang prefers vectors of 256 bits for v4, which made gradients of order 2 1.3 times slower on a Zen 4.
_TUNING = {"x86-64-v4": " -mprefer-vector-width=512"}
_FEATURES = Path("/proc/cpuinfo")


def level() -> str:
    """The level that CPU kernels are compiled for: GEOKIT_CPU, else the best that this machine has, else "native".

    Raises:
        InputError: GEOKIT_CPU names no level, or one that this machine does not have.
    """
    wanted = os.environ.get("GEOKIT_CPU", "")
    found = [name for name, features in LEVELS.items() if features <= _features()]
    if wanted and wanted not in (*found, NATIVE):
        raise InputError(f"GEOKIT_CPU: {wanted!r} is not for this machine; use one of {', '.join([*found, NATIVE])}")
    return wanted or (found[0] if found else NATIVE)


@functools.cache
def _features() -> frozenset[str]:
    """Features of the processors, as Linux names them; none on other systems."""
    return frozenset(said(_FEATURES, "flags") if platform.machine() == "x86_64" else ())


def flags_of(name: str) -> str | None:
    """Warp's ``cpu_compiler_flags`` for a level; None where warp's own are to be kept.

    They are warp's own with another target. Where the user's flags name no native target, they are kept.
    """
    given = wp.config.cpu_compiler_flags
    flags = [_NATIVE_FLAG] if given is None else given.split()
    if name == NATIVE or _NATIVE_FLAG not in flags:
        return None
    target = f"-target-cpu {name}{_TUNING.get(name, '')}"
    return " ".join(target if flag == _NATIVE_FLAG else flag for flag in flags)


def choose(module: Any, name: str | None = None) -> None:
    """Make warp compile a kernel module for a level (by default :func:`level`), unless its flags have been set."""
    flags = flags_of(name or level())
    if flags is not None and module.options["cpu_compiler_flags"] is None:
        wp.set_module_options({"cpu_compiler_flags": flags}, module)
