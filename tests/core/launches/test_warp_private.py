"""Warp's private parts: what the installed warp lacks, and the public way in place of each.

The first test is the first to fail with a new warp. Its message says what changed; until geokit follows, it uses
warp's public API there, which is slower.
"""

from __future__ import annotations

import ast
import inspect
import sys
import textwrap
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.core.launches import prepared, warp_private

ROOT = Path(__file__).resolve().parents[3] / "geokit"
# Attributes of warp's objects that are not in its documentation.
PRIVATE = (
    "_src", "__ctype__", "adj", "hooks", "params", "params_addr", "fwd_args", "failed_builds", "mark_modified",
    "get_module_identifier", "_get_compile_output_name", "_get_meta_name", "is_generic", "module_exec",
)  # fmt: skip
# How warp calls a CPU kernel: the lines that make a launch, as of LAST_DIRECT.
CALL = "hooks.forward(ctypes.byref(params[0]), ctypes.byref(args))"


def test_the_installed_warp_has_every_part():
    assert warp_private.missing() == {}


def test_warp_calls_kernels_as_direct_calls_do():
    invoke = inspect.getattr_static(inspect.getmodule(wp.Launch), "invoke")
    calls = {ast.unparse(node) for node in ast.walk(ast.parse(textwrap.dedent(inspect.getsource(invoke))))}
    assert CALL in calls, f"warp {wp.__version__} calls CPU kernels in another way: see warp_private.PackedLaunch"


def test_private_parts_are_used_in_one_module():
    found = []
    for path in sorted(ROOT.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if path.name == "warp_private.py" or not any(name in text for name in PRIVATE):
            continue
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Attribute) and node.attr in PRIVATE and ast.unparse(node.value) != "warp_private":
                found.append(f"{path.relative_to(ROOT)}:{node.lineno}: {ast.unparse(node)}")
    assert not found, "through geokit/core/launches/warp_private.py, with a public way beside it"


@pytest.mark.parametrize("part", ["descriptor", "launch", "module", "direct", "tape", "all"])
def test_without_a_part_the_answers_are_the_same(part, monkeypatch):
    points, directions = np.random.default_rng(0).uniform(-2, 2, (2, 40, 3))

    def answers():
        surface = gk.mesh.Surface(mesh_catalog.icosphere(), device="cpu")
        grid = gk.points.NeighborGrid(surface.mesh.vertices, 0.5, device="cpu")
        found = []
        for _ in range(4):
            found += [*surface.signed_distance(points), *surface.raycast(points, directions)]
            found += [grid.count(points), *grid.knn(points[:1], 3), surface.contains(points[:1])]
        return found

    expected = answers()
    lacking = frozenset(["descriptor", "launch", "module", "direct", "tape"] if part == "all" else [part])
    monkeypatch.setattr(warp_private, "_missing", lambda: lacking)
    monkeypatch.setattr(prepared, "_launches", {})
    warp_private.descriptor_type.cache_clear()
    try:
        for one, other in zip(answers(), expected, strict=True):
            np.testing.assert_array_equal(one, other)
    finally:
        warp_private.descriptor_type.cache_clear()


@pytest.mark.parametrize("version", ["1.98.0", "1.98rc1", "2.0.0.dev3", "1.17.1"])
def test_another_warp_is_not_called_directly(monkeypatch, version):
    monkeypatch.setattr(wp, "__version__", version)
    assert set(warp_private.missing()) == {"direct"}


def test_a_changed_part_is_named(monkeypatch):
    monkeypatch.setattr(warp_private, "DESCRIPTOR", ("data", "shape"))
    assert "shape" in warp_private.missing()["descriptor"]
    monkeypatch.delattr(type(wp.get_module("geokit.core.launches.none")), "mark_modified")
    assert set(warp_private.missing()) == {"descriptor", "module"}


def test_the_tape_that_records():
    assert warp_private.tape_in_progress() is None
    with wp.Tape() as tape:
        assert warp_private.tape_in_progress() is tape
    assert warp_private.tape_in_progress() is None


@pytest.mark.parametrize("how", ["another meaning", "no such part"])
def test_without_the_tape_it_is_known_whether_one_records(how, monkeypatch):
    if how == "another meaning":
        monkeypatch.setattr(warp_private, "_missing", lambda: frozenset(["tape"]))
    else:
        monkeypatch.setattr(warp_private, "_runtime", None)
        monkeypatch.setitem(sys.modules, "warp", SimpleNamespace(Tape=wp.Tape))
    assert warp_private.tape_in_progress() is None
    tape = wp.Tape()
    with tape:
        assert warp_private.tape_in_progress() == "unknown"
    assert warp_private.tape_in_progress() is None
