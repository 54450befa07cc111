"""Queries of dask arrays: the bits of the local call, one tree for each process, and named errors."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

import geokit as gk
from geokit.distributed import _map_queries, map_queries
from geokit.distributed._map_queries import _queries, _Shared
from geokit.errors import InputError
from tests.support.dask_cluster import cluster_client

dask = pytest.importorskip("dask")
array = pytest.importorskip("dask.array")

RANDOM = np.random.default_rng(5)
POINTS = RANDOM.normal(size=(900, 3))
TOWARDS = RANDOM.normal(size=(900, 3))
BODY = gk.mesh.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


@pytest.fixture(scope="module")
def things() -> dict[str, Any]:
    return {
        "surface": gk.mesh.Surface(BODY, device="cpu"),
        "volume": gk.volume.from_mesh(BODY, 0.1, device="cpu"),
        "fog": gk.volume.from_dense(np.ones((9, 9, 9)), voxel_size=0.3, grid_class="fog volume"),
        "grid": gk.points.NeighborGrid(POINTS, 0.3, device="cpu"),
    }


def _same(found: Any, expected: Any) -> None:
    found, expected = (answer if isinstance(answer, tuple) else (answer,) for answer in (found, expected))
    for one, other in zip(found, expected, strict=True):
        assert one.dtype == other.dtype
        assert one.shape == other.shape
        assert one.tobytes() == other.tobytes()


RAYS = ("raycast", "crossing_count", "occluded", "integrate")
CASES = [
    ("surface", None, {}),
    ("surface", "closest_point", {"max_distance": 0.5}),
    ("surface", "furthest_point", {}),
    ("surface", "signed_distance", {}),
    ("surface", "contains", {}),
    ("surface", "winding_number", {}),
    ("surface", "sign_confidence", {}),
    ("surface", "raycast", {}),
    ("surface", "crossing_count", {}),
    ("surface", "occluded", {"max_distance": 2.0}),
    ("volume", None, {}),
    ("volume", "sample", {"order": 3}),
    ("volume", "gradient", {"order": 2}),
    ("volume", "hessian", {}),
    ("volume", "curvature", {}),
    ("volume", "active_at", {}),
    ("volume", "raycast", {}),
    ("fog", "integrate", {"extinction": 0.1}),
    ("grid", None, {}),
    ("grid", "count", {"radius": 0.2}),
    ("grid", "knn", {"k": 4}),
    ("grid", "hybrid", {"k": 4}),
]


def test_each_query_with_an_answer_for_each_row_has_a_case(things) -> None:
    tried = {thing: {name for owner, name, _ in CASES if owner == thing and name} for thing in things}
    tried["volume"] |= tried.pop("fog")
    assert tried == {thing: set(_queries(things[thing])) for thing in tried}


@pytest.mark.parametrize("kind", [np.float64, np.float32])
@pytest.mark.parametrize(("thing", "query", "options"), CASES)
def test_the_bits_of_the_local_call(things, thing: str, query: str | None, options: dict[str, Any], kind) -> None:
    rows = [POINTS.astype(kind)] + ([TOWARDS.astype(kind)] if query in RAYS else [])
    method = query or {"surface": "closest_point", "volume": "sample", "grid": "count"}[thing]
    expected = getattr(things[thing], method)(*rows, **options)
    blocks = [array.from_array(part, chunks=chunks) for part, chunks in zip(rows, [(250, 2), (400, 3)], strict=False)]
    found = map_queries(things[thing], *blocks, query=query, **options)
    assert type(found) is (type(expected) if isinstance(expected, tuple) else array.Array)
    parts = found if isinstance(found, tuple) else (found,)
    assert all(part.chunks[0] == (250, 250, 250, 150) for part in parts)
    computed = dask.compute(*parts, scheduler="synchronous")
    _same(type(found)(*computed) if isinstance(found, tuple) else computed[0], expected)


def test_blocks_of_unknown_length(things) -> None:
    points = array.from_array(POINTS, chunks=(300, 3))
    found = map_queries(things["surface"], points[points[:, 0] > 0], query="contains").compute(scheduler="synchronous")
    _same(found, things["surface"].contains(POINTS[POINTS[:, 0] > 0]))


def test_a_tree_is_built_once_for_each_process(monkeypatch) -> None:
    # One that no other test has sent.
    surface = gk.mesh.Surface(gk.mesh.TriangleMesh(BODY.vertices * 3.0, BODY.faces), device="cpu")
    built = []
    build = gk.mesh.Surface._build_wide_tree
    monkeypatch.setattr(gk.mesh.Surface, "_build_wide_tree", lambda self: (built.append(self), build(self)))
    sent = pickle.dumps(_Shared(surface))
    first, second = pickle.loads(sent), pickle.loads(sent)
    assert first is second
    assert len(built) == 1
    # On to the next worker: the same name, and only the mesh travels.
    assert pickle.loads(pickle.dumps(first)) is first
    assert len(sent) < 4000
    other = gk.mesh.Surface(gk.mesh.TriangleMesh(BODY.vertices * 2.0, BODY.faces), device="cpu")
    assert pickle.loads(pickle.dumps(_Shared(other))) is not first
    assert len(built) == 3
    del first, second
    built.clear()
    assert not any(key == _Shared(surface).token for key in _map_queries._here)


def test_what_cannot_be_asked_is_named(things) -> None:
    points = array.from_array(POINTS, chunks=(250, 3))
    for arguments, options, words in [
        ((BODY, points), {}, "surface: a TriangleMesh is no Surface"),
        ((things["surface"], POINTS), {}, "points: a ndarray is no dask array.*from_array"),
        ((things["surface"], points[:, :2]), {}, r"points: has shape \(900, 2\)"),
        ((things["surface"], points.astype(int)), {}, "points: .*type int64"),
        ((things["surface"], points), {"query": "raycast_all"}, "query: 'raycast_all'.*closest_point"),
        ((things["surface"], points), {"query": "raycast"}, "directions: is missing"),
        ((things["surface"], points, points), {}, "directions: is for queries of rays"),
        ((things["surface"], points, points[:10]), {"query": "raycast"}, r"directions: has shape \(10, 3\)"),
        ((things["surface"], points), {"radius": 3}, "options: closest_point does not take them.*radius"),
        ((things["surface"], points), {"max_distance": -1}, "max_distance"),
        ((things["surface"], points), {"transform": np.eye(4)[None]}, "transform: several poses"),
        ((things["surface"], points), {"transform": np.eye(4)[None].tolist()}, "transform: several poses"),
    ]:
        with pytest.raises(InputError, match=words):
            map_queries(*arguments, **options)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_on_a_cluster(things) -> None:
    points = array.from_array(POINTS, chunks=(50, 3))
    with cluster_client(1):
        found = dask.compute(*map_queries(things["surface"], points))
    _same(found, things["surface"].closest_point(POINTS))
