"""Peers without a Python package: C++ files in cpp/, compiled here."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

# Without NDEBUG OpenVDB's templates check their own invariants at run time.
FLAGS = ("-O3", "-DNDEBUG", "-march=native", "-std=c++17", "-pthread")
SHARED = ("-fPIC", "-shared")


@functools.cache
def compiled(name: str, *libraries: str) -> ctypes.CDLL:
    """The shared library made of ``cpp/name.cpp``.

    Raises:
        ImportError: As of :func:`program`.
    """
    return ctypes.CDLL(str(_made(name, SHARED, libraries, ".so")))


@functools.cache
def program(name: str, *libraries: str) -> Path:
    """The program made of ``cpp/name.cpp``, kept in the temporary folder until the source changes.

    Raises:
        ImportError: A compiler, header or library is missing; measure treats this as a missing peer.
    """
    return _made(name, (), libraries, "")


def _made(name: str, kind: tuple[str, ...], libraries: tuple[str, ...], suffix: str) -> Path:
    source = Path(__file__).with_name("cpp") / f"{name}.cpp"
    compiler = os.environ.get("CXX") or shutil.which("c++") or shutil.which("g++")
    if compiler is None:
        raise ImportError("no C++ compiler", name=name)
    command = [compiler, *FLAGS, *kind, str(source), *(f"-l{library}" for library in libraries)]
    stamp = hashlib.sha256(source.read_bytes() + " ".join(command).encode()).hexdigest()[:16]
    target = Path(tempfile.gettempdir()) / f"geokit-benchmark-{os.getuid()}-{name}-{stamp}{suffix}"
    if not target.exists():
        made = target.with_suffix(f".{os.getpid()}")
        result = subprocess.run([*command, "-o", str(made)], capture_output=True, text=True, check=False)
        if result.returncode:
            reason = (result.stderr.strip() or "the compiler failed").splitlines()[0]
            raise ImportError(f"{name}.cpp does not compile: {reason}", name=None)
        made.replace(target)
    return target
