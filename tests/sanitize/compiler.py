"""Kernel modules compiled with clang's sanitizers, once for each text."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple

import warp as wp

from tests.sanitize.generated import ROOT, located

BUILT = ROOT / "build" / "sanitize"
HERE = Path(__file__).resolve().parent
# Versions that are looked for, the newest first; `clang++` without a number last. 19 refuses what warp's own clang
# takes: a GCC vector beside an ext_vector_type in one ?:.
VERSIONS = (23, 22)

# What warp gives its own clang, but for the level of optimization. Warp fuses no products with sums unless a kernel's
# text allows it, so results are the same to the bit.
LANGUAGE = [
    "-std=c++17",
    "-march=native",
    "-mf16c",
    "-ffp-contract=off",
    "-fms-extensions",
    "-fdeclspec",
    "-DNDEBUG",
    "-DWP_ENABLE_TILES_IN_STACK_MEMORY",
]
SANITIZERS = [
    "-fsanitize=address,undefined",
    # All findings in one run; the process still ends at what it cannot survive.
    "-fsanitize-recover=all",
    "-shared-libsan",
    "-fno-omit-frame-pointer",
]
FUSED = re.compile(r"(#\s*pragma clang fp contract\()fast")
# Not optimized: clang removes loads whose values are not used before its address sanitizer sees them, and takes three
# times as long.
LEVEL = ["-O0", "-g1"]


class Clang(NamedTuple):
    program: str
    runtime: str
    symbolizer: str


@functools.lru_cache(maxsize=1)
def find_clang() -> Clang | str:
    """clang with the shared runtime of its address sanitizer, or what is missing."""
    for name in (*(f"clang++-{version}" for version in VERSIONS), "clang++"):
        program = shutil.which(name)
        if program is None:
            continue
        major = int(re.search(r"version (\d+)", _output(program, "--version"))[1])  # type: ignore[index]
        if major < VERSIONS[-1]:
            continue
        machine = _output(program, "-dumpmachine").split("-")[0]
        for runtime in (f"libclang_rt.asan-{machine}.so", "libclang_rt.asan.so"):
            path = _output(program, f"-print-file-name={runtime}")
            if os.path.isabs(path) and os.path.exists(path):
                beside = Path(program).resolve().parent / "llvm-symbolizer"
                found = str(beside) if beside.exists() else shutil.which("llvm-symbolizer")
                return Clang(program, path, found or "")
    return (
        f"clang {VERSIONS[-1]} or later with the shared runtime of its address sanitizer "
        f"(on Debian clang-22, llvm-22 and libclang-rt-22-dev); ./dev sanitize installs them"
    )


def _output(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def clean_environment() -> dict[str, str]:
    """Of a process that is not itself under the sanitizer."""
    return {key: value for key, value in os.environ.items() if key not in ("LD_PRELOAD", "ASAN_OPTIONS")}


def headers() -> Path:
    return Path(wp.__file__).resolve().parent / "native"


class Fault(NamedTuple):
    """A fault that is planted in a module's copy, to see that it is found: the first match of a pattern is replaced."""

    module: str
    pattern: str
    replacement: str


def is_fused(source: Path) -> bool:
    """Whether a text lets compilers fuse products and sums: each does so where it likes, and rounds as it does."""
    return FUSED.search(source.read_text(encoding="utf-8")) is not None


def build(source: Path, name: str, clang: Clang, fault: Fault | None = None, *, plain: bool = False) -> Path:
    """The shared library of a generated file.

    Args:
        source: C++ that warp generated.
        name: Of the module; the library and the copy of its text that findings name begin with it.
        clang: From :func:`find_clang`.
        fault: Planted where it is for this module, unless plain.
        plain: Optimized and without sanitizers, for results to compare with.
    """
    BUILT.mkdir(parents=True, exist_ok=True)
    text = source.read_text(encoding="utf-8")
    text = FUSED.sub(r"\1off", text)
    if fault is not None and fault.module == name and not plain:
        text, count = re.subn(fault.pattern, fault.replacement, text, count=1)
        if count == 0:
            raise ValueError(f"{source} has nothing that matches {fault.pattern!r}")
    watched = [*SANITIZERS, f"-fsanitize-ignorelist={HERE / 'ignored.txt'}", *LEVEL]
    flags = [*LANGUAGE, *(["-O1"] if plain else watched)]
    digest = hashlib.sha256()
    digest.update("\0".join([text, *flags, (HERE / "ignored.txt").read_text(), *clang, wp.__version__]).encode())
    stem = f"{name}_{digest.hexdigest()[:12]}"
    library = BUILT / f"{stem}.so"
    if library.exists():
        return library
    copy = BUILT / f"{stem}.cpp"
    copy.write_text(located(text, copy.relative_to(ROOT).as_posix()), encoding="utf-8")
    compile_library(copy, library, [*flags, "-I", str(headers())], clang)
    return library


def compile_library(source: Path, library: Path, flags: list[str], clang: Clang) -> None:
    unfinished = library.with_suffix(f".{os.getpid()}.tmp")
    command = [clang.program, "-shared", "-fPIC", "-w", *flags, str(source), "-o", str(unfinished)]
    run = subprocess.run(command, capture_output=True, text=True, env=clean_environment(), cwd=ROOT)
    if run.returncode != 0:
        raise RuntimeError(f"clang refuses {source}:\n{run.stderr}")
    unfinished.replace(library)


@functools.lru_cache(maxsize=1)
def load_runtime(clang: Clang) -> ctypes.CDLL:
    """The functions that generated code expects of warp beside libc's, for all libraries loaded later."""
    BUILT.mkdir(parents=True, exist_ok=True)
    source = HERE / "runtime.cpp"
    digest = hashlib.sha256("\0".join([source.read_text(), *clang]).encode()).hexdigest()
    library = BUILT / f"runtime_{digest[:12]}.so"
    if not library.exists():
        compile_library(source, library, LEVEL, clang)
    return ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
