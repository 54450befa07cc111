"""hausdorff on random triangles: the largest distance of dense samples lies in its bounds, in either order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geokit.mesh import TriangleMesh
from geokit.mesh._hausdorff import hausdorff
from tests.support import reference
from tests.support.effort import of_all

pytestmark = pytest.mark.slow

# The first call of a process loads the kernels, which takes longer than any single example.
relaxed = settings(deadline=None, max_examples=of_all(20, 80))

LATTICE = np.array([[i, j, 40 - i - j] for i in range(41) for j in range(41 - i)]) / 40
# closest_point is good to 1e-12 of a diagonal.
ROUNDING = 4e-12


@st.composite
def pairs(draw):
    """A few triangles and a few more: separate, coplanar, without area, or nearly the same."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count, other = draw(st.integers(1, 3)), draw(st.integers(1, 8))
    kind = draw(st.sampled_from(["loose", "small", "points", "plane", "near"]))
    a = random.normal(size=(count, 3, 3))
    b = random.normal(size=(other, 3, 3))
    if kind == "small":
        b = b[:, :1] + 0.2 * random.normal(size=b.shape)
    elif kind == "points":
        b = np.repeat(b[:, :1], 3, axis=1)
    elif kind == "plane":
        b[..., 2] = 0
        a[..., 2] = 0.1
    elif kind == "near":
        # The middles of a's edges moved slightly: four triangles for each of a's.
        middles = (a + np.roll(a, -1, axis=1)) / 2 + 0.01 * random.normal(size=a.shape)
        parts = [np.stack([a[:, k], middles[:, k], middles[:, k - 1]], axis=1) for k in range(3)]
        b = np.concatenate([middles, *parts])
    return a, b


def mesh_of(triangles):
    return TriangleMesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))


def largest_of_samples(triangles, other):
    points = np.einsum("wc,fck->fwk", LATTICE, triangles).reshape(-1, 3)
    mesh = mesh_of(other)
    return reference.closest_point(mesh.vertices, mesh.faces, points).distance.max()


@relaxed
@given(pairs(), st.sampled_from([1e-2, 1e-4, 1e-7]))
def test_bounds_hold_for_dense_samples(pair, tolerance):
    a, b = pair
    found = hausdorff(mesh_of(a), mesh_of(b), tolerance=tolerance, samples=0, device="cpu")
    diagonal = np.linalg.norm(np.ptp(np.concatenate([a, b]).reshape(-1, 3), axis=0))
    for one, source, target in ((found.a_to_b, a, b), (found.b_to_a, b, a)):
        assert one.max <= one.upper <= one.max + (tolerance + ROUNDING) * diagonal
        low = largest_of_samples(source, target)
        longest = np.linalg.norm(source - np.roll(source, 1, axis=1), axis=2).max()
        # A lattice point is within a step of any point.
        assert low - ROUNDING * diagonal <= one.upper
        assert one.max <= low + longest / 40 + ROUNDING * diagonal


@relaxed
@given(pairs(), st.randoms(use_true_random=False))
def test_order_of_corners_and_triangles(pair, random):
    a, b = pair
    base = hausdorff(mesh_of(a), mesh_of(b), samples=0, device="cpu")
    turned = a[:, random.sample(range(3), 3)][random.sample(range(len(a)), len(a))]
    shuffled = b[:, random.sample(range(3), 3)][random.sample(range(len(b)), len(b))]
    other = hausdorff(mesh_of(turned), mesh_of(shuffled), samples=0, device="cpu")
    for x, y in ((base.a_to_b, other.a_to_b), (base.b_to_a, other.b_to_a)):
        # Cuts may fall elsewhere, but the largest distance is the same and lies in both.
        assert x.max <= y.upper + 1e-12
        assert y.max <= x.upper + 1e-12


@relaxed
@given(pairs(), st.integers(-30, 30))
def test_scaling_by_a_power_of_two_changes_no_digit(pair, power):
    a, b = pair
    factor = 2.0**power
    base = hausdorff(mesh_of(a), mesh_of(b), samples=0, device="cpu")
    other = hausdorff(mesh_of(a * factor), mesh_of(b * factor), samples=0, device="cpu")
    assert (other.max, other.upper) == (base.max * factor, base.upper * factor)
    np.testing.assert_array_equal(other.point_a, base.point_a * factor)


@relaxed
@given(pairs())
def test_the_triangle_inequality(pair):
    a, b = pair
    c = a + 0.3
    meshes = [mesh_of(t) for t in (a, b, c)]

    def distance(i, j):
        return hausdorff(meshes[i], meshes[j], samples=0, device="cpu")

    assert distance(0, 1).max <= distance(0, 2).upper + distance(2, 1).upper + 1e-12
    assert distance(0, 2).max <= 0.3 * np.sqrt(3) + 1e-12
