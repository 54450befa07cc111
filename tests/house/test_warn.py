"""Warnings name the caller's line, whatever verb they come through."""

from __future__ import annotations

import re
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

import geokit as gk
from geokit._warn import warn

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def _with_lines() -> meshio.Mesh:
    return meshio.Mesh(CORNERS, [("triangle", FACES), ("line", [[0, 1]])])


@pytest.mark.slow
@pytest.mark.parametrize(
    "verb",
    [
        gk.mesh.audit,
        gk.mesh.as_mesh,
        lambda mesh: gk.mesh.Surface(mesh, device="cpu"),
        lambda mesh: gk.volume.from_mesh(mesh, 0.1, device="cpu"),
        lambda mesh: gk.volume.from_mesh(mesh, tolerance=0.2, device="cpu"),
    ],
)
def test_what_objects_lose_is_told_at_the_line_of_the_caller(verb: Callable[[Any], Any]) -> None:
    with pytest.warns(UserWarning, match="left out") as said:
        verb(_with_lines())
    assert [one.filename for one in said if "left out" in str(one.message)] == [__file__]


def test_what_files_lose_is_told_at_the_line_of_the_caller(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nl 1 2\n")
    with pytest.warns(UserWarning, match="left out") as said:
        gk.mesh.load(tmp_path / "a.obj")
    assert {one.filename for one in said} == {__file__}
    colored = gk.mesh.TriangleMesh(CORNERS, FACES, vertex_data={"color": np.full((4, 3), 0.3)})
    with pytest.warns(UserWarning, match="left out") as said:
        gk.mesh.save(tmp_path / "a.stl", colored)
    assert [one.filename for one in said] == [__file__]


def test_the_same_warning_is_told_once_a_line() -> None:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("default")
        for _ in range(2):
            gk.mesh.as_mesh(_with_lines())
        gk.mesh.as_mesh(_with_lines())
    assert len(said) == 2


def test_a_thread_without_a_caller(recwarn: pytest.WarningsRecorder) -> None:
    code = compile("warn('x')", "inner.py", "exec")
    thread = threading.Thread(target=exec, args=(code, {"__name__": "geokit.inner", "warn": warn}))
    thread.start()
    thread.join()
    assert [(str(one.message), Path(one.filename).name) for one in recwarn] == [("x", "threading.py")]


def test_geokit_warns_in_no_other_way() -> None:
    package = Path(gk.__file__).parent
    direct = [
        path.name for path in package.rglob("*.py") if re.search(r"warnings\.warn(_explicit)?\(", path.read_text())
    ]
    assert direct == ["_warn.py"]


def test_what_files_say_is_one_line_that_prints() -> None:
    with pytest.warns(UserWarning, match="left out") as said:
        warn("a.obj: 'wall\x1b[2J\r\n  roof \udce9 é' is left out\n")
    assert str(said[0].message) == r"a.obj: 'wall\x1b[2J roof \udce9 é' is left out"
