"""Coverage-guided fuzzing of the C++ readers: libFuzzer under clang's address and undefined-behavior sanitizers.

Each target is a file in tests/fuzz/native. What libFuzzer learns stays in build/fuzz and is its start the next time.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import blosc
import numpy as np

from benchmarks.catalog.typed_grids import VALUED, TypedGrid
from geokit.formats.pcd import compress
from tests.fuzz.originals import Target, originals
from tests.sanitize.compiler import ROOT, clean_environment, find_clang

__all__ = ["TARGETS", "build", "fuzz_native", "run"]

BUILT = ROOT / "build" / "fuzz"
NATIVE = ROOT / "geokit" / "native"
# What each target is built with, beside its own file.
TARGETS: dict[str, list[str]] = {
    "decimal": [str(NATIVE / "core/decimal.cpp")],
    "lzf": [str(NATIVE / "core/lzf.cpp")],
    "blosc": ["-lblosc"],
    "check": [str(NATIVE / "src/check.cpp")],
}
FLAGS = ["-std=c++17", "-O1", "-g1", "-fno-omit-frame-pointer", "-fsanitize=fuzzer,address,undefined"]
# As in the extension, NanoVDB's assertions are off: what they would stop at must do no harm.
FLAGS += ["-fno-sanitize-recover=all", "-DNDEBUG"]
LARGEST = {"check": 1 << 20}
LIMITS = ["-timeout=20", "-rss_limit_mb=2048"]


def build(name: str, clang: str) -> Path:
    """The program of a target."""
    BUILT.mkdir(parents=True, exist_ok=True)
    program = BUILT / name
    sources = [Path(__file__).with_name("native") / f"{name}.cpp"]
    run = [clang, *FLAGS, *map(str, sources), *TARGETS[name], "-o", str(program)]
    subprocess.run(run, check=True, env=clean_environment())
    return program


def seeds(name: str) -> Iterator[bytes]:
    """Sound inputs of a target."""
    if name == "decimal":
        for kind in (".xyz", ".csv"):
            for original in originals(Target("points", kind)):
                yield bytes([2, kind == ".csv", 7, 0]) + original.data
    elif name == "check":
        for kind in VALUED:
            yield TypedGrid(kind).volume.nanovdb.tobytes()
    else:
        for content in (b"abcabcabc" * 40, bytes(1000), np.random.default_rng(1).bytes(800), bytes(range(256)) * 4):
            if name == "lzf":
                yield (len(content) // 4).to_bytes(2, "little") + bytes(compress(np.frombuffer(content, np.uint8)))
                continue
            for codec in blosc.compressor_list():
                for shuffle in (blosc.NOSHUFFLE, blosc.SHUFFLE, blosc.BITSHUFFLE):
                    yield blosc.compress(content, typesize=4, clevel=9, shuffle=shuffle, cname=codec)


def run(name: str, program: Path, seconds: int) -> tuple[int, int, str]:
    """Fuzz a target: inputs that were run, covered places, and what was found; empty if nothing was."""
    corpus, first = BUILT / f"{name}-corpus", BUILT / f"{name}-seeds"
    for folder in (corpus, first):
        folder.mkdir(exist_ok=True)
    for i, content in enumerate(seeds(name)):
        (first / str(i)).write_bytes(content)
    options = [f"-max_total_time={seconds}", f"-max_len={LARGEST.get(name, 4096)}", f"-artifact_prefix={BUILT / name}-"]
    command = [str(program), *options, *LIMITS, str(corpus), str(first)]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", env=clean_environment())
    count = [int(number) for number in re.findall(r"^#(\d+)", done.stderr, re.MULTILINE)]
    covered = [int(number) for number in re.findall(r"cov: (\d+)", done.stderr)]
    found = "" if done.returncode == 0 else done.stderr[-4000:]
    return max(count, default=0), max(covered, default=0), found


def fuzz_native(seconds: int) -> int:
    """Fuzz every target for so long; returns an exit code."""
    clang = find_clang()
    if isinstance(clang, str):
        print(f"fuzz: needs {clang}", file=sys.stderr)
        return 2
    findings = 0
    for name in TARGETS:
        inputs, covered, found = run(name, build(name, clang.program), seconds)
        print(f"{name}: {inputs} inputs, {covered} places covered, {'a finding' if found else 'no finding'}\n{found}")
        findings += bool(found)
    return min(findings, 1)
