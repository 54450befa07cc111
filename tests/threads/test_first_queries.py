"""Threads that meet at the first queries of an object: each gets the bits that one thread gets."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

import geokit as gk
from tests.support.effort import of_all, spread

pytestmark = pytest.mark.slow

CPU = {"device": "cpu"}
ROUNDS = of_all(30, 150)
RNG = np.random.default_rng(11)
POINTS, DIRECTIONS, CLOUD = RNG.uniform(-1.5, 1.5, (300, 3)), RNG.normal(size=(300, 3)), RNG.uniform(-1, 1, (2000, 3))
TORUS = gk.mesh.torus()
# Some faces are wound the wrong way round.
TURNED = gk.mesh.TriangleMesh(TORUS.vertices, np.concatenate([TORUS.faces[:100, ::-1], TORUS.faces[100:]]))
LEVEL_SET = gk.volume.from_mesh(TORUS, voxel_size=0.05, **CPU)
FOG = gk.volume.from_dense(RNG.uniform(0.1, 1.0, (20, 20, 20)), voxel_size=0.1)

Ask = Callable[[Any], Any]
SURFACE: dict[str, Ask] = {
    "closest": lambda o: o.closest_point(POINTS),
    "signed": lambda o: o.signed_distance(POINTS),
    "winding": lambda o: o.winding_number(POINTS),
    "as given": lambda o: o.winding_number(POINTS, as_given=True),
    "rays": lambda o: o.raycast(POINTS, DIRECTIONS),
    "occluded": lambda o: o.occluded(POINTS, DIRECTIONS),
    "all": lambda o: o.raycast_all(POINTS, DIRECTIONS),
    "furthest": lambda o: o.furthest_point(POINTS),
    "contains": lambda o: o.contains(POINTS),
}
GRID: dict[str, Ask] = {
    "count": lambda o: o.count(POINTS),
    "own": lambda o: o.count(),
    "other radius": lambda o: o.count(POINTS, radius=0.7),
    "search": lambda o: o.radius_search(POINTS),
    "nearest": lambda o: o.knn(POINTS, k=4),
    "pairs": lambda o: o.pairs(),
}
PERIODIC: dict[str, Ask] = {
    "count": lambda o: o.count(POINTS),
    "list": lambda o: o.neighbor_list(POINTS),
    "other radius": lambda o: o.count(POINTS, radius=0.5),
}
VOLUME: dict[str, Ask] = {
    "order 0": lambda o: o.sample(POINTS, order=0, **CPU),
    "order 1": lambda o: o.sample(POINTS, **CPU),
    "order 3": lambda o: o.sample(POINTS, order=3, **CPU),
    "many": lambda o: o.sample(np.repeat(POINTS, 100, axis=0), **CPU),
    "gradient": lambda o: o.gradient(POINTS, **CPU),
    "rays": lambda o: o.raycast(POINTS, DIRECTIONS, **CPU),
    "active": lambda o: o.active_at(POINTS, **CPU),
    "faces": lambda o: gk.mesh.from_volume(o, **CPU).faces,
    "offset": lambda o: gk.volume.offset(o, 0.05, **CPU).nanovdb,
}
LIGHT: dict[str, Ask] = {
    "integral": lambda o: o.integrate(POINTS, DIRECTIONS, **CPU),
    "sample": lambda o: o.sample(POINTS, **CPU),
}
MESHES = [gk.mesh.sphere(segments=12), TORUS, gk.mesh.box()]
PACKED, HEADED, OFFSETS = np.tile(POINTS, (3, 1)), np.tile(DIRECTIONS, (3, 1)), [0, 300, 600, 900]
MANY: dict[str, Ask] = {
    "closest": lambda o: o.closest_point(PACKED, OFFSETS),
    "signed": lambda o: o.signed_distance(PACKED, OFFSETS),
    "rays": lambda o: o.raycast(PACKED, HEADED, OFFSETS),
    "contains": lambda o: o.contains(PACKED, OFFSETS),
}


def copy_of(volume: gk.volume.SparseVolume) -> gk.volume.SparseVolume:
    return gk.volume.SparseVolume(volume.nanovdb.copy(), volume.info)


OBJECTS: dict[str, tuple[Callable[[], Any], dict[str, Ask]]] = {
    "surface": (lambda: gk.mesh.Surface(TORUS, **CPU), SURFACE),
    "turned faces": (lambda: gk.mesh.Surface(TURNED, **CPU), SURFACE),
    "surfaces": (lambda: gk.mesh.Surfaces(MESHES, **CPU), MANY),
    "grid": (lambda: gk.points.NeighborGrid(CLOUD, 0.2, **CPU), GRID),
    "grid without radius": (lambda: gk.points.NeighborGrid(CLOUD, **CPU), GRID),
    "grid with skin": (lambda: gk.points.NeighborGrid(CLOUD, 0.2, skin=0.1, **CPU), GRID),
    "periodic grid": (lambda: gk.points.NeighborGrid(CLOUD, 0.2, periodic=[2.0, 2.0, 2.0], **CPU), PERIODIC),
    "level set": (lambda: copy_of(LEVEL_SET), VOLUME),
    "quantized": (lambda: copy_of(gk.volume.quantize(LEVEL_SET, "fp8")), VOLUME),
    "fog": (lambda: copy_of(FOG), LIGHT),
}


def parts_of(answer: Any) -> list[Any]:
    return list(answer) if isinstance(answer, tuple) else [answer]


@pytest.mark.parametrize("kind", spread(OBJECTS, 5))
def test_three_threads(kind: str) -> None:
    make, questions = OBJECTS[kind]
    expected = {name: parts_of(ask(make())) for name, ask in questions.items()}
    names, rng = list(questions), np.random.default_rng(3)
    with ThreadPoolExecutor(3) as pool:
        for _ in range(ROUNDS):
            owner, met = make(), threading.Barrier(3)
            asked = [names[i] for i in rng.integers(0, len(names), 3)]

            def answer(name: str, owner: Any = owner, met: threading.Barrier = met) -> list[Any]:
                met.wait(timeout=60.0)
                return parts_of(questions[name](owner))

            for name, found in zip(asked, pool.map(answer, asked), strict=True):
                for one, same in zip(found, expected[name], strict=True):
                    np.testing.assert_array_equal(one, same, err_msg=f"{name} beside {asked}")
