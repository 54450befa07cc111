"""chamfer and hausdorff of clouds against all pairs, on hand-sized inputs and at the edges."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import geokit as gk
from geokit.points._compare import chamfer, hausdorff

A = np.array([[0.0, 0, 0], [4, 0, 0], [0, 3, 0]])
B = np.array([[0.0, 0, 0], [1, 0, 0]])


def all_pairs(a, b):
    d = np.asarray(a)[:, None] - np.asarray(b)[None]
    return np.sqrt((d[..., 0] ** 2 + d[..., 1] ** 2) + d[..., 2] ** 2)


def test_hausdorff_by_hand():
    found = hausdorff(A, B, device="cpu")
    assert found._fields == ("max", "mean", "rms", "index_a", "index_b", "a_to_b", "b_to_a")
    assert (found.max, found.index_a, found.index_b) == (3.0, 1, 1)
    # The second and third point of A are both 3 away: the lower index is named.
    assert found.a_to_b == (3.0, 2.0, pytest.approx(np.sqrt(6.0), rel=1e-15), 1, 1)
    assert found.b_to_a == (1.0, 0.5, pytest.approx(np.sqrt(0.5), rel=1e-15), 1, 0)
    assert (found.mean, found.rms) == (2.0, found.a_to_b.rms)


def test_the_direction_is_that_of_the_larger_distance():
    found = hausdorff(B, A, device="cpu")
    assert (found.max, found.index_a, found.index_b) == (3.0, 1, 1)
    assert found.a_to_b.max == 1.0
    # Both directions are 2 long: the first one names the points.
    tied = hausdorff([[0, 0, 0], [9, 0, 0]], [[0, 0, 2.0], [9, 0, 1.0]], device="cpu")
    assert (tied.index_a, tied.index_b) == (0, 0)


def test_chamfer_by_hand():
    found = chamfer(A, B, device="cpu")
    assert found._fields == ("distance", "squared", "a_to_b", "b_to_a")
    assert found.distance == 0.5 * (2.0 + 0.5)
    assert found.squared == pytest.approx(6.0 + 0.5, rel=1e-15)
    assert found.a_to_b == hausdorff(A, B, device="cpu").a_to_b


@pytest.mark.parametrize("offset", [0.0, 1e6])
@pytest.mark.parametrize("shift", [0.0, 0.1, 30.0])
def test_random_clouds_against_all_pairs(offset, shift):
    random = np.random.default_rng(0)
    a, b = random.random((600, 3)) + offset, random.normal(size=(900, 3)) * 0.3 + shift + offset
    d = all_pairs(a, b)
    there, back = d.min(axis=1), d.min(axis=0)
    found = hausdorff(a, b, device="cpu")
    assert found.a_to_b.max == there.max()
    assert found.b_to_a.max == back.max()
    assert (found.a_to_b.index_from, found.a_to_b.index_to) == (there.argmax(), d[there.argmax()].argmin())
    assert (found.b_to_a.index_from, found.b_to_a.index_to) == (back.argmax(), d[:, back.argmax()].argmin())
    assert d[found.index_a, found.index_b] == found.max == max(there.max(), back.max())
    np.testing.assert_allclose(found.a_to_b.mean, there.mean(), rtol=1e-14)
    np.testing.assert_allclose(found.b_to_a.rms, np.sqrt((back**2).mean()), rtol=1e-14)
    near = chamfer(a, b, device="cpu")
    np.testing.assert_allclose(near.distance, (there.mean() + back.mean()) / 2, rtol=1e-14)
    np.testing.assert_allclose(near.squared, (there**2).mean() + (back**2).mean(), rtol=1e-14)


@pytest.mark.parametrize("scale", [2.0**-400, 2.0**-30, 2.0**30, 2.0**400])
def test_scales(scale):
    random = np.random.default_rng(1)
    a, b = random.random((50, 3)), random.random((60, 3))
    base, other = hausdorff(a, b, device="cpu"), hausdorff(a * scale, b * scale, device="cpu")
    assert (other.index_a, other.index_b) == (base.index_a, base.index_b)
    np.testing.assert_allclose([other.max, other.mean, other.rms], np.multiply(base[:3], scale), rtol=1e-14)


def test_a_cloud_is_0_away_from_itself_in_any_order():
    a = np.random.default_rng(2).random((300, 3))
    assert hausdorff(a, a[::-1], device="cpu")[:3] == (0.0, 0.0, 0.0)
    assert chamfer(a, a[::-1], device="cpu")[:2] == (0.0, 0.0)


@pytest.mark.parametrize("kind", ["random", "equal", "one"])
def test_pairs_of_groups_are_as_one_by_one(kind):
    random = np.random.default_rng(3)
    sizes = [random.integers(1, 300, 40) if kind == "random" else np.full(40, 1 if kind == "one" else 200)] * 2
    if kind == "random":
        sizes[1] = random.permutation(sizes[0])
    groups = [np.concatenate([[0], np.cumsum(some)]) for some in sizes]
    a, b = (random.random((each[-1], 3)) for each in groups)
    a[groups[0][3] : groups[0][3] + 1] = b[groups[1][3]]
    found = chamfer(a, b, groups=groups, device="cpu")
    for i, (p, q, s, t) in enumerate(zip(groups[0], groups[1], groups[0][1:], groups[1][1:], strict=False)):
        alone = chamfer(a[p:s], b[q:t], device="cpu")
        assert (found.distance[i], found.squared[i]) == alone[:2]
        for parts, one, first, other in ((found.a_to_b, alone.a_to_b, p, q), (found.b_to_a, alone.b_to_a, q, p)):
            moved = (*one[:3], one.index_from + first, one.index_to + other)
            assert tuple(part[i] for part in parts) == moved


def test_groups_of_pairs_are_checked():
    each = [0, 1, 2]
    for groups, message in (
        (each, "groups: .* is not a pair"),
        (([0, 3], each), "groups: 1 clouds in a and 2 in b"),
        (([0], [0, 2]), r"groups\[0\]: from 0 to 0, which are not all 3 rows of a"),
        (([0, 1, 3], [0, 1]), r"groups\[1\]: from 0 to 1, which are not all 2 rows of b"),
        (([0, 3, 3], each), "a: cloud 1 has no points"),
        (([0, 2, 3], [0, 0, 2]), "b: cloud 0 has no points"),
    ):
        with pytest.raises(gk.InputError, match=message):
            chamfer(A, B, groups=groups, device="cpu")


def test_containers():
    of_groups = chamfer(wp.array(A, dtype=wp.vec3f, device="cpu"), B, groups=([0, 1, 3], [0, 1, 2]), device="cpu")
    assert isinstance(of_groups.b_to_a.index_to, wp.array)
    assert of_groups.distance.dtype == wp.float32
    given = wp.array(A, dtype=wp.vec3d, device="cpu")
    assert hausdorff(given, B.astype(np.float32), device="cpu") == hausdorff(A, B, device="cpu")
    assert all(type(value) in (float, int) for value in hausdorff(given, B, device="cpu")[:5])


@pytest.mark.parametrize("compare", [chamfer, hausdorff])
def test_inputs_are_checked(compare):
    bad = A.copy()
    bad[1, 2] = np.nan
    with pytest.raises(gk.InputError, match="a: row 1"):
        compare(bad, B, device="cpu")
    with pytest.raises(gk.InputError, match=r"b: shape \(2, 2\)"):
        compare(A, B[:, :2], device="cpu")
    with pytest.raises(gk.InputError, match="a: a cloud without points"):
        compare(np.zeros((0, 3)), B, device="cpu")
    with pytest.raises(gk.InputError, match="b: a cloud without points"):
        compare(A, np.zeros((0, 3)), device="cpu")
    with pytest.raises(gk.InputError, match="device"):
        compare(A, B, device="abacus")
