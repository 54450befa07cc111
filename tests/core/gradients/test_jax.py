"""Gradients in jax, in a process of their own: jax starts threads, which forks of other tests must not meet."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
# Most of the time is spent in compiling what runs once.
QUICK_XLA = {**os.environ, "XLA_FLAGS": "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"}

SCRIPT = """
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
from jax.test_util import check_grads
import geokit as gk
from tests.support.effort import of_all

# Compiled as a whole; outside of jit XLA compiles each operation for itself, which takes most of the time here.
whole = of_all(jax.jit, lambda ask: ask)

random = np.random.default_rng(0)
body = gk.mesh.load("data/samples/bracket.obj")
surface = gk.mesh.Surface(body, device="cpu")
low, high = body.bounds
points = jnp.asarray(low + (high - low) * random.random((20, 3)))

def distance(points):
    return surface.closest_point(points).distance

check_grads(distance, (points,), order=2, modes=["rev"])
check_grads(jax.jit(distance), (points,), order=1, modes=["rev"])
batches = jax.vmap(distance)(points.reshape(4, 5, 3))
assert (batches.ravel() == distance(points)).all()
slope = jax.jit(jax.grad(lambda p: (surface.signed_distance(p).distance ** 2).sum()))(points)
assert slope.shape == (20, 3)
folded = points.reshape(4, 5, 3)
slope_of_folded = jax.jit(jax.grad(lambda p: (surface.signed_distance(p).distance ** 2).sum()))(folded)
assert (slope_of_folded.reshape(20, 3) == slope).all()
assert surface.closest_point(folded).points.shape == (4, 5, 3)
up = jnp.asarray([0.0, 0.0, 1.0])
assert surface.raycast(folded, up).t.shape == (4, 5)
assert surface.closest_point(points.astype(jnp.bfloat16)).distance.dtype == "float64"
assert gk.mesh.Surface(body, device=jax.devices("cpu")[0]).device == "cpu"

a, b = (jnp.asarray(random.random((count, 3))) for count in (15, 12))
check_grads(whole(lambda a, b: gk.points.chamfer(a, b, device="cpu").distance), (a, b), order=1, modes=["rev"])
grid = gk.points.NeighborGrid(np.asarray(a), device="cpu")
check_grads(jax.jit(lambda b: grid.knn(b, k=2).distance), (b,), order=2, modes=["rev"])

field = gk.volume.from_function(lambda p: np.linalg.norm(p, axis=1) - 1.0, [[-2, -2, -2], [2, 2, 2]], 0.5)
places = jnp.asarray(random.standard_normal((10, 3)) * 0.6)
for order in (1, 2, 3):
    sampled = whole(lambda p: gk.volume.sample(field, p, order=order, device="cpu"))
    check_grads(sampled, (places,), order=2, modes=["rev"])
adaptive = gk.volume.adaptive_from_mesh(gk.mesh.sphere(segments=8), 0.05, device="cpu")
check_grads(jax.jit(lambda p: adaptive.sample(p, device="cpu")), (places,), order=1, modes=["rev"], rtol=1e-4)
try:
    jax.grad(lambda p: gk.volume.sample(field, p, order=0, device="cpu").sum())(places)
except gk.InputError as error:
    assert "order 0" in str(error)
else:
    raise AssertionError("order 0 has no gradient")
"""


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("jax") is None, reason="needs jax")
def test_gradients():
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], cwd=ROOT, env=QUICK_XLA, capture_output=True, text=True, timeout=1500
    )
    assert done.returncode == 0, done.stderr[-3000:]
