"""geokit.jax: vertices, voxel values and densities. In a process of its own, as tests/core/gradients/test_jax.py."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
# Most of the time is spent in compiling what runs once.
QUICK_XLA = {**os.environ, "XLA_FLAGS": "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"}

SCRIPT = """
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
from jax.test_util import check_grads as held
import geokit as gk
from geokit.volume.nanovdb.nodes import grid_nodes
from geokit.volume.tree.leaves import assemble, leaves_of
from tests.support.effort import of_all

def check_grads(ask, given, order=1, **_):
    held(ask, given, order=order, modes=["rev"], rtol=1e-4, atol=1e-6, eps=1e-6)

# Compiled as a whole; outside of jit XLA compiles each operation for itself, which takes most of the time here.
whole = of_all(jax.jit, lambda ask: ask)

def refused(message, call, *args, **kwargs):
    try:
        call(*args, **kwargs)
    except gk.InputError as error:
        assert message in str(error), error
    else:
        raise AssertionError(message)

random = np.random.default_rng(0)
ball = gk.mesh.sphere(segments=8)
faces, vertices = ball.faces, jnp.asarray(ball.vertices)
points = jnp.asarray(random.uniform(-1.5, 1.5, (6, 3)))

# Vertices: the answers of the plain surface, derivatives by finite differences, jit and vmap.
plain = gk.mesh.Surface(ball, device="cpu")
def surface(vertices):
    return gk.jax.Surface(vertices, faces, device="cpu")
def distances(vertices, points):
    return surface(vertices).closest_point(points).distance, surface(vertices).signed_distance(points).distance
def hits(vertices, points):
    found = surface(vertices).raycast(points * 3.0, -points)
    return jnp.where(found.triangle_id >= 0, found.t, 0.0), found.barycentric
def winding(vertices, points):
    return gk.jax.Surface(vertices, faces[9:], device="cpu").winding_number(points, as_given=True)
for made, other in zip(distances(vertices, points), (plain.closest_point, plain.signed_distance)):
    assert (np.asarray(made) == other(np.asarray(points)).distance).all()
check_grads(of_all(lambda *x: distances(*x)[1], distances), (vertices, points), order=2)
check_grads(whole(hits), (vertices, points))

# On the surface the slope of a signed distance is the outward normal, with and without vertices that jax traces.
for wound in (faces, faces[:, ::-1], np.concatenate([faces[:, ::-1], faces])):
    wound = gk.mesh.TriangleMesh(ball.vertices, wound)
    found = gk.mesh.sample_surface(ball, 50, seed=0)
    a, b, c = np.moveaxis(ball.vertices[faces[found.triangle_id]], 1, 0)
    normals = np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a), axis=1)[:, None]
    rows = jnp.asarray(np.concatenate([found.points, ball.vertices]))
    kept = gk.mesh.Surface(wound, device="cpu")
    def by_points(rows):
        return kept.signed_distance(rows).distance.sum()
    def by_both(vertices, rows):
        return gk.jax.Surface(vertices, wound.faces, device="cpu").signed_distance(rows).distance.sum()
    alone = jax.grad(by_points)(rows)
    of_vertices, among = jax.jit(jax.grad(by_both, (0, 1)))(vertices, rows)
    np.testing.assert_allclose(alone[:50], normals, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(alone, axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(among, alone, atol=1e-9)
    np.testing.assert_allclose(of_vertices.sum(0), -alone.sum(0), atol=1e-9)
    single = jax.jit(jax.grad(by_both, (0, 1)))(vertices.astype("float32"), rows.astype("float32"))[1]
    np.testing.assert_allclose(single[:50], normals, atol=1e-3)
for ask in of_all((distances,), (distances, hits)):
    check_grads(jax.jit(ask), (vertices, points))
def exact(vertices, points):
    a, b, c = (vertices[faces[9:, k]][None] - points[:, None] for k in range(3))
    la, lb, lc = (jnp.linalg.norm(side, axis=-1) for side in (a, b, c))
    below = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return jnp.arctan2((jnp.cross(a, b) * c).sum(-1), below).sum(1) / (2 * jnp.pi)
assert jnp.allclose(winding(vertices, points), exact(vertices, points), atol=0.005)
for which in (0, 1):
    slope, other = (jax.jit(jax.grad(lambda *x: (ask(*x) * jnp.arange(6)).sum(), which)) for ask in (winding, exact))
    assert jnp.allclose(slope(vertices, points), other(vertices, points), atol=1e-10)
slopes = jax.grad(lambda v: distances(v, points)[1].sum())
many = jnp.stack([vertices, vertices * 1.25])
each = jnp.stack([whole(slopes)(v) for v in many])
for ask in of_all((), (jax.vmap(slopes),)) + (jax.jit(jax.vmap(slopes)),):
    assert jnp.allclose(ask(many), each, atol=1e-14)
both = jax.vmap(lambda p: surface(vertices).closest_point(p).distance)(points.reshape(2, 3, 3))
assert (both.ravel() == distances(vertices, points)[0]).all()
with jax.checking_leaks():
    jax.jit(slopes)(vertices)
refused("as_given", surface(vertices).winding_number, points)
refused("not an array of jax", gk.jax.Surface, ball.vertices.tolist(), faces)
refused("(V, 3)", gk.jax.Surface, many, faces)
refused("no gradients", gk.jax.Surface, jnp.zeros((3, 3), int), [[0, 1, 2]])
refused("faces", gk.jax.Surface, vertices, [[0, 1, 999]])
def many(vertices):
    return gk.mesh.Surfaces((vertices, faces, [0, 40, len(faces)]), device="cpu")
check_grads(jax.jit(lambda p: many(ball.vertices).closest_point(p, [0, 2, 6])[:2]), (points,))
check_grads(whole(lambda o: many(ball.vertices).raycast(o, -points, [0, 2, 6]).t.clip(0.0, 9.0)), (points * 3.0,))
refused("geokit.jax.Surface", jax.grad(lambda v: many(v).raycast(points, points, [0, 2, 6]).t.sum()), vertices)
refused("faces", jax.jit(lambda f: gk.jax.Surface(vertices, f).closest_point(points)), jnp.asarray(faces))

# Voxel values.
field = gk.volume.from_function(lambda p: np.linalg.norm(p, axis=1) - 1.0, [[-2, -2, -2], [2, 2, 2]], 0.5)
values = jnp.asarray(gk.volume.active_voxels(field).values.astype(np.float64))
places = jnp.asarray(random.standard_normal((5, 3)) * 0.6)
# In float64, so that differences of values are not rounded to float32.
leaf_values = grid_nodes(field.nanovdb).leaf.values.astype(np.float64)
double = assemble(leaves_of(field), leaf_values, field, background=1.5, grid_class="level set")
def samples(order):
    return lambda v, p: gk.jax.with_values(double, v).sample(p, order=order, device="cpu")
for order in (1, 2, 3):
    assert np.allclose(samples(order)(values, places), double.sample(np.asarray(places), order=order), atol=1e-6)
    check_grads(jax.jit(samples(order)), (values, places))
check_grads(
    whole(lambda v, p: gk.volume.gradient(gk.jax.with_values(double, v), p, order=1, device="cpu")),
    (values, places),
)
check_grads(
    whole(lambda v, o: gk.volume.raycast(gk.jax.with_values(double, v), o, -places, device="cpu").t),
    (values, places * 4.0),
)
two = jnp.stack([values, values + 0.1])
slopes = jax.grad(lambda v: (samples(1)(v, places) ** 2).sum())
assert jnp.allclose(jax.jit(jax.vmap(slopes))(two), jnp.stack([whole(slopes)(v) for v in two]), atol=1e-14)
refused("one for each active voxel", gk.jax.with_values, double, values[:3])
refused("not an array of jax", gk.jax.with_values, double, values.tolist())
refused("take order 1", jax.grad(lambda v: gk.jax.with_values(double, v).gradient(places, order=2).sum()), values)
refused("volume", gk.volume.statistics, gk.jax.with_values(double, values))

# Densities.
cloud, asked = jnp.asarray(random.random((20, 3))), jnp.asarray(random.random((7, 3)))
for kernel in ("cubic_spline", "wendland_c2", "poly6"):
    def density(points, queries=None):
        return gk.points.density(points, radius=0.4, kernel=kernel, mass=2.0, queries=queries, device="cpu")
    check_grads(jax.jit(density), (cloud,))
    check_grads(whole(density), (cloud, asked))
clouds = jnp.stack([cloud, cloud * 0.9])
slopes = jax.grad(lambda points: (density(points) ** 2).sum())
assert jnp.allclose(jax.vmap(slopes)(clouds), jnp.stack([whole(slopes)(c) for c in clouds]), atol=1e-12)
refused("second derivatives", jax.grad(lambda p: slopes(p).sum()), cloud)
refused("'count'", jax.grad(lambda p: gk.points.density(p, radius=0.4, device="cpu").sum()), cloud)
pairs = jax.vmap(lambda a: gk.points.chamfer(a, asked, device="cpu").distance)(clouds)
assert jnp.allclose(pairs, jnp.stack([gk.points.chamfer(c, asked, device="cpu").distance for c in clouds]))

# Transmittances.
fog = assemble(leaves_of(field), np.abs(leaf_values), field, background=0.0, grid_class="fog volume")
def light(origins, directions):
    return gk.volume.integrate(fog, origins, directions, extinction=0.3, device="cpu").transmittance
check_grads(jax.jit(light), (places * 3.0, -places + 0.1), order=1)
# Both grids of traced values.
shares = jnp.asarray(np.abs(gk.volume.active_voxels(fog).values))
def glow(density, light, origins):
    smoke, lamp = gk.jax.with_values(fog, density), gk.jax.with_values(fog, light)
    return smoke.integrate(origins, -origins, emission=lamp, extinction=0.3, device="cpu")
check_grads(jax.jit(glow), (shares, shares[::-1], places * 3.0))
lamp = gk.jax.with_values(fog, shares)
assert np.allclose(
    gk.volume.integrate(fog, places, -places, emission=lamp).emission,
    gk.volume.integrate(fog, np.asarray(places), -np.asarray(places), emission=fog).emission,
)
print("all held")
"""


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("jax") is None, reason="needs jax")
def test_vertices_values_and_densities():
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], cwd=ROOT, env=QUICK_XLA, capture_output=True, text=True, timeout=1500
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "all held" in done.stdout
