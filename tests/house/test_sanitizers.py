"""Kernels under clang's address and undefined-behavior sanitizers; and every .inl file is compiled somewhere."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.sanitize import alone, generated
from tests.sanitize.__main__ import explained, sanitize
from tests.sanitize.calls import NAMES, rows
from tests.sanitize.compiler import Clang, Fault, find_clang
from tests.sanitize.tidy import PROGRAM
from tests.support.effort import spread

pytestmark = pytest.mark.slow

# Kernels that no watched call launches on a CPU: those of CUDA, and those for larger inputs.
UNWATCHED = Path(generated.__file__).with_name("unwatched.txt").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def clang() -> Clang:
    found = find_clang()
    if isinstance(found, str):
        pytest.skip(f"needs {found}")
    return found


# One of each kind of walk; all of them take many minutes: ./dev sanitize.
SOME_MODULES = (
    "geokit.mesh.queries.closest_point_kernels",
    "geokit.points.search.radius_cpu_kernels",
    "geokit.volume.sampling.trilinear_table_kernels",
)

# Kernels written in Python, which a fault can be planted in, and which end with it: others would walk on for ever.
MEASURES = "geokit.mesh.topology.measures_kernels"
WRITER = "geokit.volume.tree.device_writer_kernels"


def test_all_calls_that_are_watched_are_there(tmp_path: Path) -> None:
    """Also where there is no clang."""
    assert {row.name for row in rows(tmp_path)} == NAMES


def test_some_kernels(clang: Clang) -> None:
    calls = [name for name in NAMES if name.startswith(("mesh.Surface", "points.count", "volume.sample"))]
    outcome = sanitize(list(SOME_MODULES), clang, calls=calls)
    assert not outcome.findings, "\n\n".join(explained(finding) for finding in outcome.findings)
    assert {module for module, _ in outcome.launches} == set(SOME_MODULES)


@pytest.mark.skipif(os.environ.get("GEOKIT_SANITIZE") != "all", reason="many minutes: ./dev sanitize runs it")
def test_all_kernels(clang: Clang) -> None:
    outcome = sanitize([], clang)
    assert not outcome.findings, "\n\n".join(explained(finding) for finding in outcome.findings)
    kernels = {f"{name} {kernel}" for name in generated.module_names() for kernel in generated.kernels_of(name)}
    assert sorted(kernels - {" ".join(pair) for pair in outcome.launches}) == UNWATCHED.splitlines()


@pytest.mark.parametrize(
    ("module", "replacement", "report"),
    [
        pytest.param(WRITER, r"wp::address(\1, \2 + 1)", "heap-buffer-overflow", id="one element too far"),
        pytest.param(
            MEASURES, r"wp::address(\1, \2 + (0x7fffffff + (\2 > 0)) * 0)", "signed integer overflow", id="overflow"
        ),
    ],
)
def test_a_planted_fault_is_found(clang: Clang, module: str, replacement: str, report: str) -> None:
    call = "mesh.Surface.scan"
    assert call in NAMES
    outcome = sanitize([module], clang, calls=[call], fault=Fault(module, r"wp::address\((\w+), (\w+)\)", replacement))
    assert outcome.launches
    assert {finding.module for finding in outcome.findings} == {module}
    assert report in outcome.findings[0].text
    assert call in explained(outcome.findings[0])


def test_a_planted_difference_is_found(clang: Clang) -> None:
    # A kernel that answers differently under the sanitizer was not watched at all.
    module, call = MEASURES, "mesh.Surface.scan"
    fault = Fault(module, r"wp::array_store\((\w+), (\w+), (\w+)\)", r"wp::array_store(\1, \2, \3 + \3)")
    outcome = sanitize([module], clang, calls=[call], fault=fault)
    assert outcome.findings
    assert "results differ" in outcome.findings[0].text


def test_every_inl_file_is_compiled() -> None:
    compiled = generated.compiled_inl_files()
    dead = sorted(set(generated.inl_files()) - compiled)
    assert not dead, f"no kernel module holds {', '.join(dead)}"


# What a compiler for this machine is told, and for others instead; warp keeps a register of aarch64 for itself.
HERE_ONLY = {"-march=native", "-mf16c"}
TARGETS = {
    "here": [],
    "aarch64": ["--target=aarch64-linux-gnu", "-ffixed-x28"],
    "macos": ["--target=arm64-apple-darwin", "-ffixed-x28"],
    "windows": ["--target=x86_64-pc-windows-msvc", "-march=x86-64-v3"],
}


@pytest.mark.parametrize("machine", TARGETS)
def test_files_of_functions_are_read_alone(machine: str) -> None:
    program = str(PROGRAM) if PROGRAM.exists() else shutil.which("clang-tidy")
    if program is None:
        pytest.skip("needs clang-tidy, which ./dev setup installs")
    paths = alone.write()
    commands = json.loads((alone.BUILT / "compile_commands.json").read_text(encoding="utf-8"))
    arguments = {entry["file"]: entry["arguments"][1:-1] for entry in commands}
    # Those that a change touches are all read by ./dev check --changed.
    place = list(TARGETS).index(machine)
    for path in spread(paths[place:] + paths[:place], 6):
        given = arguments[path]
        if machine != "here":
            given = [word for word in given if word not in HERE_ONLY] + TARGETS[machine]
        command = [program, "--quiet", "--checks=-*,bugprone-infinite-loop", path, "--", *given]
        run = subprocess.run(command, cwd=generated.ROOT, capture_output=True, text=True)
        assert run.returncode == 0, f"{path}:\n{run.stdout}"


def test_no_kernel_has_instructions_in_text() -> None:
    # Warp's LLVM has no assembler for aarch64: it ends the process.
    for path in generated.inl_files():
        text = (generated.ROOT / path).read_text(encoding="utf-8")
        # A name in the library is none.
        assert not re.search(r"\b(?:__asm__|asm)\b(?!\(GEOKIT_YIELD\);)", text), path
