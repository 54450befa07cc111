"""A replay answers as the query itself does: for any rows, types, options and numbers of rows."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.core.base.query import QUERIES
from geokit.core.launches import prepared


def surface(make=mesh_catalog.torus):
    return gk.mesh.Surface(make(), device="cpu")


def level_set():
    return gk.volume.from_mesh(surface(), 0.1)


def fog():
    """Doubles, so that samples have no leaf table."""
    values = np.random.default_rng(3).normal(size=(20, 20, 20))
    return gk.volume.from_dense(values, voxel_size=0.15, origin=(-10, -10, -10))


@functools.cache
def adaptive():
    return gk.volume.adaptive_from_mesh(mesh_catalog.box(), 0.05, order=1, device="cpu")


def cloud():
    return gk.points.NeighborGrid(np.random.default_rng(0).uniform(-1, 1, (3000, 3)), 0.3, device="cpu")


# Each decorated query: what is asked, the function, the options of its calls, and the number of its arguments of rows.
CASES = {
    "closest_point": (surface, gk.mesh.Surface.closest_point, [{}, {"max_distance": 0.2}, {"max_distance": 1}], 1),
    "furthest_point": (surface, gk.mesh.Surface.furthest_point, [{}], 1),
    "signed_distance": (
        surface,
        gk.mesh.Surface.signed_distance,
        [{}, {"sign": "winding"}, {"sign": "parity"}, {"max_distance": 0.3}, {"sign": "winding", "max_distance": 0.3}],
        1,
    ),
    "contains": (surface, gk.mesh.Surface.contains, [{}, {"sign": "winding"}, {"sign": "parity"}], 1),
    "winding_number": (surface, gk.mesh.Surface.winding_number, [{}, {"as_given": True}], 1),
    "sign_confidence": (surface, gk.mesh.Surface.sign_confidence, [{}], 1),
    "raycast": (surface, gk.mesh.Surface.raycast, [{}, {"t_min": 0.5, "max_distance": 2.0}], 2),
    "crossing_count": (surface, gk.mesh.Surface.crossing_count, [{}, {"t_min": 0.5}], 2),
    "occluded": (surface, gk.mesh.Surface.occluded, [{}, {"max_distance": 1.0}], 2),
    "sample": (level_set, gk.volume.sample, [{"order": order, "device": "cpu"} for order in (None, 0, 1, 2, 3)], 1),
    "gradient": (level_set, gk.volume.gradient, [{"device": "cpu"}, {"order": 3, "device": "cpu"}], 1),
    "hessian": (level_set, gk.volume.hessian, [{"device": "cpu"}], 1),
    "curvature": (level_set, gk.volume.curvature, [{"device": "cpu"}], 1),
    "active_at": (level_set, gk.volume.active_at, [{"device": "cpu"}, {"space": "index", "device": "cpu"}], 1),
    "volume raycast": (level_set, gk.volume.raycast, [{"device": "cpu"}, {"isovalue": 0.1, "device": "cpu"}], 2),
    "adaptive sample": (adaptive, gk.volume.AdaptiveSDF.sample, [{"device": "cpu"}], 1),
    "adaptive gradient": (adaptive, gk.volume.AdaptiveSDF.gradient, [{"device": "cpu"}], 1),
    "count": (cloud, gk.points.NeighborGrid.count, [{}, {"radius": 0.25}], 1),
    "knn": (cloud, gk.points.NeighborGrid.knn, [{}, {"k": 7}], 1),
    "hybrid": (cloud, gk.points.NeighborGrid.hybrid, [{"k": 3}, {"k": 5, "radius": 0.1}], 1),
}
# Further objects whose queries take other ways.
OTHERS = {
    "of doubled faces": (lambda: surface(lambda: mesh_catalog.doubled(mesh_catalog.box())), "contains"),
    "signs of doubled faces": (lambda: surface(lambda: mesh_catalog.doubled(mesh_catalog.box())), "signed_distance"),
    "by winding number": (lambda: surface(mesh_catalog.holed_sphere), "signed_distance"),
    "of doubles": (fog, "sample"),
    "gradients of doubles": (fog, "gradient"),
    "rays through doubles": (fog, "volume raycast"),
}


def same(found, expected):
    assert type(found) is type(expected)
    pairs = zip(found, expected, strict=True) if isinstance(found, tuple) else [(found, expected)]
    for one, other in pairs:
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
        assert one.flags.writeable


def rows_of(rng, count, arguments, dtype):
    given = [rng.uniform(-1.3, 1.3, (count, 3)) for _ in range(arguments)]
    if dtype == np.int64:
        return [np.rint(3.0 * values).astype(np.int64) | 1 for values in given]
    return [values.astype(dtype) for values in given]


@pytest.mark.parametrize("case", [*CASES, *OTHERS])
def test_replays_answer_as_the_query(case, monkeypatch):
    make, name = OTHERS.get(case, (None, case))
    first, query, all_options, arguments = CASES[name]
    asked, reference, rng = (make or first)(), (make or first)(), np.random.default_rng(11)
    made = itertools.count()
    run = prepared.Recording.replay

    def counted(self, given):
        answer = run(self, given)
        if answer is not None:
            next(made)
        return answer

    monkeypatch.setattr(prepared.Recording, "replay", counted)
    calls = 0
    for options in all_options:
        for count, dtype in ((1, np.float64), (1, np.float32), (3, np.float64), (2, np.int64), (1, np.dtype(">f8"))):
            before = next(made)
            for _ in range(7):
                given = rows_of(rng, count, arguments, dtype)
                same(query(asked, *given, **options), query.__wrapped__(reference, *given, **options))
            calls = next(made) - before - 1
            # Points farther than max_distance from the surface are decided in another way.
            if not (name == "signed_distance" and options.get("max_distance")):
                assert calls >= 5, (options, count, dtype)


@pytest.mark.parametrize("case", ["closest_point", "raycast", "sample", "count", "knn", "signed_distance"])
@pytest.mark.parametrize("count", [2, 15, 16, 17, 40, 255, 256, 257])
def test_of_any_number_of_rows(case, count):
    make, query, (options, *_), arguments = CASES[case]
    asked, rng = make(), np.random.default_rng(count)
    for _ in range(4):
        given = rows_of(rng, count, arguments, np.float64)
        same(query(asked, *given, **options), query.__wrapped__(asked, *given, **options))


def test_each_replayed_query_has_a_case():
    replayed = [query.name for name, query in QUERIES.items() if name.startswith("geokit.") and query.is_replayed]
    assert sorted(replayed) == sorted(name.split()[-1] for name in CASES)
