"""Unions of random bodies: boxes on a lattice against counted cells, curved bodies against each body's own inside."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import geokit as gk
from geokit.errors import InputError
from geokit.mesh import TriangleMesh, box, cylinder, drop_degenerate, merge_vertices, sphere, torus, union
from tests.support.assemblies import concatenated, in_float32, subdivided, turned
from tests.support.effort import of_all

CELLS = 6
SPANS = st.tuples(st.integers(0, CELLS - 1), st.integers(1, 4))
BOXES = st.lists(st.tuples(SPANS, SPANS, SPANS, st.booleans()), min_size=1, max_size=7)
UNIT = ((0, 1), (0, 1), (0, 1), False)
SHAPES = st.lists(st.tuples(st.sampled_from("bsct"), st.integers(0, 10**6)), min_size=2, max_size=5)


def counted(spans: list[tuple[tuple[int, int], ...]]) -> tuple[TriangleMesh, float, float]:
    """Boxes on a lattice; the volume and the area of their union by its cells."""
    filled = np.zeros((CELLS + 6,) * 3, bool)
    meshes = []
    for *axes, finer in spans:
        low = np.array([begin for begin, _ in axes])
        high = low + [length for _, length in axes]
        filled[tuple(slice(a + 1, b + 1) for a, b in zip(low, high, strict=True))] = True
        block = box(high - low, center=(low + high) / 2.0)
        meshes.append(subdivided(block) if finer else block)
    area = sum(np.count_nonzero(np.diff(filled.astype(np.int8), axis=axis)) for axis in range(3))
    return concatenated(*meshes), float(np.count_nonzero(filled)), float(area)


@pytest.mark.slow
@settings(max_examples=of_all(40, 150))
@example(spans=[*[UNIT] * 4, ((0, 1), (0, 1), (0, 2), False), ((0, 1), (1, 1), (1, 1), False)], way="turned")
@given(spans=BOXES, way=st.sampled_from(["own vertices", "welded", "turned", "turned and welded", "float32"]))
def test_boxes_have_the_volume_and_the_area_of_their_cells(spans: list, way: str) -> None:
    mesh, volume, area = counted(spans)
    tolerance = 1e-7
    if way.startswith("turned"):
        mesh, tolerance = turned(mesh, len(spans)), 5e-5
    if way == "float32":
        mesh, tolerance = in_float32(turned(mesh, len(spans), 1.0)), 1e-4
    if "welded" in way:
        mesh = merge_vertices(mesh)
    try:
        found = union(mesh)
    except InputError:
        # Where boxes share edges and planes, and no body has vertices of its own, not all are told apart: it is said.
        assert "welded" in way
        return
    assert abs(found.volume) == pytest.approx(volume, rel=tolerance)
    # Bodies that touch in an edge but for rounding may join there, or not.
    assert found.area == pytest.approx(area, rel=max(tolerance, 1e-6))


def body(kind: str, seed: int) -> TriangleMesh:
    rng = np.random.default_rng(seed)
    size = rng.uniform(0.3, 1.0)
    made = {
        "b": lambda: box(size * rng.uniform(0.5, 1.5, 3)),
        "s": lambda: sphere(size, segments=10),
        "c": lambda: cylinder(0.5 * size, 2.0 * size, segments=11),
        "t": lambda: torus(size, 0.3 * size, segments=12, tube_segments=7),
    }[kind]()
    return turned(made, seed, rng.uniform(-0.8, 0.8))


@pytest.mark.slow
@settings(max_examples=of_all(25, 100), deadline=None)
@given(shapes=SHAPES, welded=st.booleans())
def test_inside_is_what_is_inside_of_any_body(shapes: list[tuple[str, int]], welded: bool) -> None:
    bodies = [body(*shape) for shape in shapes]
    mesh = concatenated(*bodies)
    found = union(merge_vertices(mesh) if welded else mesh)
    points = np.random.default_rng(1).uniform(-2.0, 2.0, (4000, 3))
    each = [gk.mesh.Surface(one, device="cpu").signed_distance(points).distance for one in bodies]
    least = np.min(each, axis=0)
    signed = gk.mesh.Surface(found, device="cpu").signed_distance(points).distance
    sure = np.abs(least) > 1e-5
    assert ((signed < 0.0) == (least < 0.0))[sure].all()
    # Outside, the union is as far as the nearest body; inside, its boundary is at least as far.
    outside = (least > 0.0) & sure
    assert np.allclose(signed[outside], least[outside], atol=1e-5)
    assert (signed[~outside] <= least[~outside] + 1e-5).all()


@pytest.mark.slow
@settings(max_examples=of_all(25, 100), deadline=None)
@given(spans=BOXES, seed=st.integers(0, 3))
def test_walls_that_are_there_once_are_removed_or_the_mesh_is_open(spans: list, seed: int) -> None:
    mesh, volume, area = counted(spans)
    mesh = drop_degenerate(merge_vertices(turned(mesh, seed) if seed else mesh), duplicates=True)
    try:
        found = union(mesh)
    except InputError:
        return
    if gk.mesh.audit(found).boundary_edge_count == 0:
        assert abs(found.volume) == pytest.approx(volume, rel=1e-6)
        assert found.area == pytest.approx(area, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [40, 66, 10700, 3])
@pytest.mark.parametrize("kind", ["b", "t"])
def test_a_body_that_is_there_twice_counts_once(kind: str, seed: int) -> None:
    """manifold3d leaves a fold in the union of some bodies with themselves."""
    one, other = body(kind, seed), body("s", seed + 1)
    shuffled = TriangleMesh(one.vertices, np.roll(np.random.default_rng(seed).permutation(one.faces), 1, axis=1))
    for mesh in (concatenated(one, one), concatenated(one, shuffled, one)):
        found = union(mesh)
        assert found.face_count == one.face_count
        assert found.volume == pytest.approx(one.volume, rel=1e-9)
    twice, once = union(concatenated(one, other, one, other)), union(concatenated(one, other))
    assert twice.volume == pytest.approx(once.volume, rel=1e-9)
    assert twice.area == pytest.approx(once.area, rel=1e-9)
