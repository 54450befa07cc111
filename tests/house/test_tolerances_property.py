"""Tolerances keep their word on meshes, points and voxels that nobody tuned for, judged by brute force."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.catalog import mesh_catalog
from geokit.errors import InputError
from geokit.mesh._audit import audit
from geokit.mesh._sample_surface import sample_surface
from geokit.mesh._simplify import simplify
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.volumes.from_volume import from_volume, from_volume_with_deviation
from geokit.points._downsample import cover, downsample
from geokit.volume.distance_fields.from_mesh import from_mesh
from geokit.volume.retyped.quantize import quantize
from tests.support.effort import of_all
from tests.support.reference import closest_point

SAMPLES = 300
# Rounding of the brute force, as a share of the tolerance.
ROUNDING = 1e-9


def bumpy() -> TriangleMesh:
    """A ball with bumps of 3% of its radius."""
    ball = mesh_catalog.icosphere(3)
    bumps = 1.0 + 0.03 * np.prod(np.sin(7.0 * ball.vertices), axis=1, keepdims=True) ** 2
    return TriangleMesh(ball.vertices * bumps, ball.faces, name="bumpy")


def thin() -> TriangleMesh:
    """A plate with rounded rims, a fiftieth as thick as it is wide."""
    ball = mesh_catalog.icosphere(3)
    return TriangleMesh(ball.vertices * [1.0, 0.7, 0.02], ball.faces, name="thin")


def rotated(mesh: TriangleMesh, seed: int = 4) -> TriangleMesh:
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return TriangleMesh(mesh.vertices @ (turn * np.sign(np.linalg.det(turn))).T, mesh.faces, name=mesh.name)


MESHES = {
    "smooth": lambda: rotated(mesh_catalog.torus(32, 16)),
    "sharp": mesh_catalog.l_profile,
    "cube": lambda: rotated(mesh_catalog.box()),
    "thin": thin,
    "bumpy": bumpy,
    "needles": lambda: mesh_catalog.cone(150, 4.0),
    "open": lambda: mesh_catalog.open_shell(20),
    "holed": lambda: mesh_catalog.with_large_hole(mesh_catalog.icosphere(3)),
    "several bodies": lambda: mesh_catalog.join(
        mesh_catalog.icosphere(2, 0.5), mesh_catalog.moved(mesh_catalog.box(), (0, 2, 0))
    ),
    "overlapping": mesh_catalog.overlapping_spheres,
    "cavity": mesh_catalog.nested_boxes,
    "tiny": lambda: mesh_catalog.scaled(mesh_catalog.torus(24, 12), 1e-9),
    "huge": lambda: mesh_catalog.scaled(mesh_catalog.torus(24, 12), 1e9),
    "far": lambda: mesh_catalog.far_away(mesh_catalog.icosphere(2), 1e5),
}
# An unclosed mesh has no inside for a level set.
SOLID = [name for name in MESHES if name not in ("open", "holed")]


def farthest(one: TriangleMesh, other: TriangleMesh, seed: int) -> float:
    """The largest distance found from points of one surface to the other, in float64 by brute force."""
    corners = one.vertices[np.unique(one.faces)]
    rng = np.random.default_rng(seed)
    corners = corners[rng.permutation(len(corners))[:SAMPLES]]
    points = np.concatenate([corners, sample_surface(one, SAMPLES, seed=seed).points])
    # Next to the origin: what is judged is the mesh, not how float64 resolves large coordinates.
    origin = one.vertices[0]
    return float(closest_point(other.vertices - origin, other.faces, points - origin).distance.max())


def assert_within(simple, original: TriangleMesh, tolerance: float, seed: int) -> None:
    found = max(farthest(original, simple.mesh, seed), farthest(simple.mesh, original, seed + 1))
    rounding = ROUNDING * tolerance + 1e-15 * np.abs(original.vertices).max()
    assert found <= simple.deviation + rounding
    assert simple.deviation_p999 <= simple.deviation <= tolerance


@pytest.mark.slow
@pytest.mark.parametrize("name", MESHES)
def test_simplified_meshes_are_within(name):
    mesh = MESHES[name]()
    tolerance = 0.01 * mesh.diagonal
    simple = simplify(mesh, tolerance=tolerance, device="cpu")
    assert_within(simple, mesh, tolerance, seed=len(name))
    before, after = audit(mesh), audit(simple.mesh)
    assert (after.watertight, after.manifold) == (before.watertight, before.manifold)
    assert (after.component_count, after.euler_number) == (before.component_count, before.euler_number)


@pytest.mark.slow
@pytest.mark.parametrize("name", SOLID)
def test_simplified_isosurfaces_are_within(name):
    mesh = MESHES[name]()
    volume = from_mesh(mesh, mesh.diagonal / 24, device="cpu")
    tolerance = 0.2 * mesh.diagonal / 24
    full = from_volume(volume, device="cpu")
    simple = from_volume_with_deviation(volume, tolerance=tolerance, device="cpu")
    assert_within(simple, full, tolerance, seed=len(name))
    assert len(simple.mesh.faces) < 0.5 * len(full.faces)
    assert audit(simple.mesh).watertight == audit(full).watertight


@pytest.mark.slow
@settings(max_examples=6, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.01, 0.2), st.floats(-20, 20), st.sampled_from([2, 3]))
def test_any_shaken_ball_is_within(seed, share, exponent, subdivisions):
    rng = np.random.default_rng(seed)
    ball = mesh_catalog.icosphere(subdivisions)
    shaken = ball.vertices * rng.uniform(0.3, 1.0, 3) + rng.normal(scale=0.01, size=ball.vertices.shape)
    scale = 10.0**exponent
    mesh = TriangleMesh(shaken * scale, ball.faces)
    tolerance = share * scale
    simple = simplify(mesh, tolerance=tolerance, device="cpu")
    assert_within(simple, mesh, tolerance, seed % 1000)
    assert audit(simple.mesh).euler_number == 2


@pytest.mark.slow
@settings(max_examples=of_all(20, 40), deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 400), st.floats(1e-3, 3.0), st.floats(-100, 100), st.integers(0, 9))
def test_covers_are_within(seed, count, share, exponent, order_seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)) * 10.0**exponent
    tolerance = share * 10.0**exponent
    found = cover(points, tolerance=tolerance, seed=order_seed, device="cpu")
    unit = 10.0**exponent
    apart = np.linalg.norm((points[:, None] - points[found.indices][None]) / unit, axis=2)
    assert found.deviation == pytest.approx(apart.min(axis=1).max() * unit, rel=1e-12)
    assert found.deviation_p999 <= found.deviation <= tolerance
    np.testing.assert_array_equal(found.points, points[found.indices])
    between = apart[found.indices]
    np.fill_diagonal(between, np.inf)
    # None of them could be left out: no two are nearer than the tolerance.
    assert between.min(initial=np.inf) * unit >= tolerance * (1 - 1e-12)
    same = downsample(points, tolerance=tolerance, seed=order_seed, device="cpu")
    np.testing.assert_array_equal(same.indices, found.indices)


@pytest.mark.parametrize("codec", ["fp4", "fp8", "fp16"])
def test_what_quantization_refuses_names_what_it_reaches(codec):
    volume = from_mesh(bumpy(), 0.08, device="cpu")
    with pytest.raises(InputError, match="reaches") as caught:
        quantize(volume, codec, tolerance=1e-9)
    named = re.search(r"reaches (\S+)", str(caught.value))
    assert named is not None
    reachable = float(named[1])
    # Three digits are shown.
    small = quantize(volume, codec, tolerance=1.01 * reachable)
    assert 0.99 * reachable <= small.info.metadata["geokit:achieved_error"] <= 1.01 * reachable
    with pytest.raises(InputError, match="reaches"):
        quantize(volume, codec, tolerance=0.99 * reachable)
