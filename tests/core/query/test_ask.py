"""The table of queries: each has a record, and each call takes the same steps."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import geokit as gk
from geokit.core.base.object_cache import CacheAttribute
from geokit.core.base.query import QUERIES, Query, queries_of
from geokit.core.query import ask
from geokit.errors import InputError

ROOT = Path(__file__).resolve().parents[3]
ROWS = ("points", "queries", "origins", "directions", "lower", "upper")


@pytest.fixture(scope="module")
def table() -> dict[str, Query]:
    """All queries, by the names that callers use."""
    for module in pkgutil.walk_packages(gk.__path__, "geokit."):
        if module.name.startswith(("geokit.mesh", "geokit.points", "geokit.volume")) and "kernels" not in module.name:
            importlib.import_module(module.name)
    classes = (gk.mesh.Surface, gk.mesh.Surfaces, gk.points.NeighborGrid, gk.volume.AdaptiveSDF)
    named = {f"{cls.__name__}.{name}": query for cls in classes for name, query in queries_of(cls).items()}
    for door, room in (("points", gk.points), ("volume", gk.volume)):
        named |= {f"{door}.{name}": query for name, query in queries_of(room).items()}
    return named


def test_each_query_has_a_record(table: dict[str, Query]) -> None:
    private = [name for name in QUERIES if name.startswith("geokit.") and name.split(".")[-1].startswith("_")]
    assert len(table) == len([name for name in QUERIES if name.startswith("geokit.")]) - len(private)
    for cls in (gk.mesh.Surface, gk.mesh.Surfaces, gk.points.NeighborGrid, gk.volume.AdaptiveSDF):
        for name, method in inspect.getmembers(cls, inspect.isfunction):
            given = list(inspect.signature(method).parameters)[1:2]
            if name[0] != "_" and given and given[0] in ROWS and name != "update":
                assert f"{cls.__name__}.{name}" in table


def test_rows_are_the_parameters_after_the_object(table: dict[str, Query]) -> None:
    for name, query in table.items():
        assert query.rows == query.positional[1 : 1 + len(query.rows)], name
        assert set(query.inputs) <= dict(query.parameters).keys(), name


def test_gradients_have_a_rule_and_a_line_in_the_document(table: dict[str, Query]) -> None:
    page = (ROOT / "docs" / "gradients.md").read_text(encoding="utf-8").partition("## What has a gradient")[2]
    page = page.partition("\n\nA rigid")[0]
    told = set()
    for line in re.findall(r"^\| (`[^|]*) \|", page, re.MULTILINE):
        owner = ""
        for name in re.findall(r"`([\w.]+)`", line.partition(": as of")[0]):
            owner = name.rpartition(".")[0] or owner
            told.add(f"{owner}.{name.rpartition('.')[2]}")
    carrying = {name: query for name, query in table.items() if query.gradient is not None}
    for name, query in carrying.items():
        assert len(query.rule().has_slope) == len(getattr(query.kind, "_fields", "1")), name
    # These are made of other queries.
    assert told - {"torch.sample_surface", "points.chamfer", "points.hausdorff"} == carrying.keys()


class Body:
    """What a query is asked; ``update`` makes it one that is asked as it is at the start."""

    _cache = CacheAttribute()

    def __init__(self) -> None:
        self.seen: list[Any] = []

    def update(self) -> None: ...

    @ask.query("points", is_stepped=True, row_bytes=10, memory=lambda self, points, **_: 5)
    def count(self, points: Any, *, scale: float = 1.0) -> Any:
        self.seen.append(self)
        return len(points) * scale


def test_a_call_that_does_not_fit_is_named_by_python() -> None:
    for call in (lambda: Body().count(), lambda: Body().count([1], 2.0), lambda: Body().count([1], transform=None)):
        with pytest.raises(TypeError, match=r"count\(\)"):
            call()


def test_an_object_is_asked_as_it_is_at_the_start() -> None:
    body = Body()
    assert body.count([1, 2], scale=0.5) == 1.0
    assert body.seen[0] is not body
    assert body.seen[0].__dict__ is body.__dict__


def test_memory_is_that_of_the_rows_and_of_the_rest() -> None:
    assert Body.count._geokit_bytes(Body(), np.zeros((7, 3))) == 75
    need, points = gk.mesh.Surface.closest_point._geokit_bytes, np.zeros((10, 3))
    assert need(None, points) == need(None, points=points) == 800
    assert need(None, points, transform=np.eye(4)) == 800 + 2 * 240  # rows, and what is found


@pytest.mark.parametrize("name", ["furthest_point", "sign_confidence", "raycast_all", "distance"])
def test_numbers_without_a_rule_are_refused_on_a_tape(name: str) -> None:
    import warp as wp

    mesh = gk.mesh.box()
    held = wp.array(mesh.vertices, dtype=wp.vec3d, device="cpu", requires_grad=True)
    surface = gk.mesh.Surface((held, mesh.faces), device="cpu")
    given = {"raycast_all": (np.eye(3), np.eye(3)), "distance": (gk.mesh.Surface(mesh, device="cpu"),)}
    rows = given.get(name, (np.eye(3),))
    getattr(surface, name)(*rows)
    with wp.Tape() as tape, pytest.raises(InputError, match=f"{name} has no gradient"):
        getattr(surface, name)(*rows)
    assert not tape.launches
