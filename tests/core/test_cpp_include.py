"""C++ files that include others: the lines of the other file, and the compiler still names files and lines."""

from __future__ import annotations

from pathlib import Path

import pytest

from geokit.core import cpp as module
from geokit.volume.band.distances_cpu_kernels import tile_distances
from tests.sanitize import generated

OUTER = """// Adds.
    double sum = STEP;
#include "core/inner.inl"
    return sum;"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "core").mkdir()
    (tmp_path / "core" / "outer.inl").write_text(OUTER)
    (tmp_path / "core" / "inner.inl").write_text("    sum += 2.0;")
    monkeypatch.setattr(module, "_PACKAGE", tmp_path)
    module._read.cache_clear()
    yield
    module._read.cache_clear()


def numbered(text: str) -> dict[str, tuple[str, int]]:
    """For each line of C++ the file and line that a compiler names."""
    places, file, line = {}, "", 0
    for each in text.splitlines():
        if each.startswith("#line"):
            _, number, name = each.split()
            file, line = name.strip('"'), int(number)
        else:
            places[each.strip()] = (file, line)
            line += 1
    return places


def test_lines_keep_their_numbers(package):
    text = module.cpp("core/outer.inl", STEP=1.5)
    places = numbered(text)
    assert places["double sum = STEP;"] == ("geokit/core/outer.inl", 2)
    assert places["sum += 2.0;"] == ("geokit/core/inner.inl", 1)
    assert places["return sum;"] == ("geokit/core/outer.inl", 4)
    assert "#include" not in text


def test_a_file_is_included_once_where_it_says_so(package, tmp_path):
    (tmp_path / "core" / "inner.inl").write_text("#pragma once\n    sum += 2.0;")
    (tmp_path / "core" / "twice.inl").write_text('#include "core/inner.inl"\n#include "core/outer.inl"\n    last();')
    text = module.cpp("core/twice.inl", STEP=1.5)
    assert text.count("sum += 2.0;") == 1
    places = numbered(text)
    assert places["sum += 2.0;"] == ("geokit/core/inner.inl", 2)
    assert places["return sum;"] == ("geokit/core/outer.inl", 4)
    assert places["last();"] == ("geokit/core/twice.inl", 3)
    assert "#pragma" not in text


def test_a_declaration_calls_the_function_of_its_name():
    lines = tile_distances.native_snippet.split()
    assert lines[:3] == ["#if", "!defined(__CUDA_ARCH__)", "using"]
    assert "using SurfaceTree = decltype(tree);\n" in tile_distances.native_snippet
    assert "return tile_distances(tree, voxel, translation," in tile_distances.native_snippet
    assert lines[-1] == "#endif"


def test_lines_of_included_files_are_told_apart():
    text = tile_distances.native_snippet.splitlines()
    found = list(generated.regions(tile_distances.native_snippet))
    files = {region.path.rsplit("/")[-1] for region in found}
    assert files == {"distances_cpu.inl", "simd.inl", "closest.inl"}
    for region in found:
        lines = (generated.ROOT / region.path).read_text(encoding="utf-8").splitlines()
        for k in range(region.count):
            assert text[region.first - 1 + k] in (lines[region.line - 1 + k], "")
