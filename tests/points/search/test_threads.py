"""Threads that ask one grid for different radii: each gets the answer of its own radius."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

import geokit as gk

CPU = {"device": "cpu"}
RNG = np.random.default_rng(11)
CLOUD, QUERIES = RNG.uniform(-1.0, 1.0, (2000, 3)), RNG.uniform(-1.5, 1.5, (300, 3))


OPTIONS = {"plain": {}, "periodic": {"periodic": [2.0, 2.0, 2.0]}, "skin": {"skin": 0.1}}
ASKED = {
    "count": lambda o: (o.count(QUERIES),),
    "search": lambda o: o.radius_search(QUERIES),
    "list": lambda o: o.neighbor_list(QUERIES),
}


@pytest.mark.parametrize(
    ("kind", "name"), [(kind, name) for kind in OPTIONS for name in ASKED if name != "list" or kind == "periodic"]
)
def test_another_radius_in_the_middle_of_a_search(kind: str, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def grid() -> gk.points.NeighborGrid:
        return gk.points.NeighborGrid(CLOUD, 0.2, **OPTIONS[kind], **CPU)

    expected, asked, choose = ASKED[name](grid()), grid(), gk.points.NeighborGrid._ask
    waiting = [True]

    def interrupted(*given: Any, **options: Any) -> Any:
        chosen = choose(*given, **options)
        if waiting:
            waiting.clear()
            other = threading.Thread(target=asked.count, args=(QUERIES,), kwargs={"radius": 0.7})
            other.start()
            other.join(timeout=60.0)
            assert not other.is_alive()
        return chosen

    monkeypatch.setattr(gk.points.NeighborGrid, "_ask", interrupted)
    for found, same in zip(ASKED[name](asked), expected, strict=True):
        np.testing.assert_array_equal(found, same)
    assert not waiting
