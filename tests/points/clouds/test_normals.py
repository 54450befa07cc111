"""Normals of points: planes, spheres, the eigenvectors of the definition, signs, containers and every error."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import warp as wp
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.spatial import cKDTree

import geokit as gk
from geokit.points._normals import normals

UNIT = 2.0**-53
SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.5, 0.5, 0]])


def sphere(count, seed=0):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def nearest(points, k):
    return cKDTree(points).query(points, k)[1]


def planes(points, rows):
    """Normal, curvature and relative gap of each row of points, from the singular values of the differences."""
    found = []
    for i, row in enumerate(rows):
        d = points[row] - points[i]
        _, s, vt = np.linalg.svd(d - d.mean(axis=0), full_matrices=False)
        variance = s**2
        found.append((vt[2], variance[2] / variance.sum(), (variance[1] - variance[2]) / variance[0]))
    return (np.array(column) for column in zip(*found, strict=True))


def assert_planes(points, rows, found):
    normal, curvature, gap = planes(points, rows)
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1.0, rtol=4 * UNIT)
    sine = np.linalg.norm(np.cross(normal, found.normals), axis=1)
    # The docstring's promise; 8 more, without the gap, for the cross product of unit vectors itself.
    count = np.array([len(row) for row in rows])
    assert (sine <= ((count + 128) / gap + 8) * UNIT).all()
    assert (np.abs(found.curvature - curvature) <= (count + 16) * UNIT).all()


def edges_that_agree(points, normal, k):
    """Edges (E, 2), whether their normals are opposite, and how surely: the lesser of both comparisons."""
    distance, rows = cKDTree(points).query(points, k)
    pairs = np.stack([np.repeat(np.arange(len(points)), k), rows.ravel()], axis=1)
    i, j = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0).T
    e, n, m = points[j] - points[i], normal[i], normal[j]
    direct = (n * m).sum(axis=1)
    squared = (e**2).sum(axis=1) + 0.25 * np.minimum(distance[i, -1], distance[j, -1]) ** 2
    reflected = direct - 2.0 * (e * n).sum(axis=1) * (e * m).sum(axis=1) / squared
    kept = direct * reflected > 0.0
    sure = np.minimum(np.minimum(np.abs(direct), np.abs(reflected)), 1.0)
    return np.stack([i, j], axis=1)[kept], direct[kept] < 0.0, sure[kept]


def signs_by_votes(points, normal, k):
    """Signs, and the part of each point: three rounds along the surest edges, then rounds by votes."""
    count = len(points)
    ends, opposite, sure = edges_that_agree(points, normal, k)
    sure = 1.0 - (1.0 - sure).astype(np.float32).astype(float)
    vote = np.where(opposite, -1, 1) * (sure**3 * 2.0**24).astype(np.int64)
    sign, part = np.ones(count, np.int64), np.arange(count)
    for turn in itertools.count():
        across = part[ends[:, 0]] != part[ends[:, 1]]
        if not across.any():
            return sign, part
        pairs, at = np.unique(np.sort(part[ends[across]], axis=1), axis=0, return_inverse=True)
        votes = (vote * sign[ends].prod(axis=1))[across]
        total = np.zeros(len(pairs), np.int64)
        if turn < 3:
            rising = np.argsort(sure[across], kind="stable")
            total[at.ravel()[rising]] = votes[rising]
        else:
            np.add.at(total, at.ravel(), votes)
        best = {}
        for number in np.argsort(np.abs(total), kind="stable"):
            best.update({pairs[number, 0]: number, pairs[number, 1]: number})
        chosen = sorted(set(best.values()))
        joined = coo_array((np.sign(total[chosen]), tuple(pairs[chosen].T)), shape=(count, count)).tocsr()
        joined = joined + joined.T
        turned, root = np.ones(count, np.int64), np.arange(count)
        for first in np.unique(connected_components(joined, directed=False)[1], return_index=True)[1]:
            order, parent = breadth_first_order(joined, first, directed=False)
            root[order] = first
            for node in order[1:]:
                turned[node] = turned[parent[node]] * joined[parent[node], node]
        sign, part = sign * turned[part], root[part]


@pytest.mark.parametrize("k", [3, 4, 9, 16, 50])
def test_equals_the_definition_for_nearest_points(k):
    points = np.random.default_rng(k).random((600, 3))
    assert_planes(points, nearest(points, k), normals(points, k=k, orientation="none", device="cpu"))


@pytest.mark.parametrize("radius", [0.15, 0.4, 2.0])
def test_equals_the_definition_within_a_radius(radius):
    points = np.random.default_rng(1).random((500, 3)) * [1, 1, 0.1]
    rows = cKDTree(points).query_ball_point(points, radius)
    assert min(map(len, rows)) >= 3
    assert_planes(points, rows, normals(points, radius=radius, orientation="none", device="cpu"))


@pytest.mark.parametrize("radius", [10.0, 1e17, 1e300])
def test_a_radius_beyond_all_points_takes_all(radius):
    points = np.random.default_rng(1).random((30, 3))
    found = normals(points, radius=radius, orientation="none", device="cpu")
    assert_planes(points, [range(30)] * 30, found)


def test_types_and_shapes():
    found = normals(SQUARE, k=4, device="cpu")
    assert found._fields == ("normals", "curvature")
    assert (found.normals.shape, found.curvature.shape) == ((5, 3), (5,))
    assert (found.normals.dtype, found.curvature.dtype) == (np.float64, np.float64)
    single = normals(SQUARE.astype(np.float32), k=4, device="cpu")
    assert (single.normals.dtype, single.curvature.dtype) == (np.float32, np.float32)


def test_warp_in_warp_out():
    points = sphere(300)
    wanted = normals(points, device="cpu")
    found = normals(wp.array(points, dtype=wp.vec3d, device="cpu"), device="cpu")
    assert found.normals.dtype == wp.vec3d
    np.testing.assert_array_equal(found.normals.numpy(), wanted.normals)
    np.testing.assert_array_equal(found.curvature.numpy(), wanted.curvature)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("settings", [{"k": 5}, {"radius": 1.5}])
def test_a_plane_points_up(axis, settings):
    points = np.roll(SQUARE, axis + 1, axis=1)
    found = normals(points, device="cpu", **settings)
    np.testing.assert_array_equal(found.normals, np.tile(np.eye(3)[axis], (5, 1)))
    assert not found.curvature.any()


def test_a_sphere_points_outwards():
    points = sphere(5000)
    found = normals(points, device="cpu")
    assert ((found.normals * points).sum(axis=1) > 0.99).all()


def test_a_box_points_outwards():
    random = np.random.default_rng(0)
    points = random.random((6000, 3)) * 2 - 1
    axis = np.arange(6000) % 3
    points[np.arange(6000), axis] = np.where(np.arange(6000) % 2, 1.0, -1.0)
    found = normals(points, device="cpu").normals
    outward = found[np.arange(6000), axis] * points[np.arange(6000), axis]
    # Neighborhoods that reach around an edge are turned; at a corner the points are no plane at all.
    inner = np.sort(np.abs(points), axis=1)[:, 1] < 0.7
    assert (outward[inner] > 0.999).all()
    assert (outward > 0.0).mean() > 0.999


def test_separate_parts_each_have_an_upward_point():
    points = np.concatenate([sphere(1500), sphere(1500, 1) + 10.0, 0.2 * sphere(500, 2)])
    center = np.repeat([[0.0] * 3, [10.0] * 3, [0.0] * 3], [1500, 1500, 500], axis=0)
    found = normals(points, device="cpu").normals
    assert ((found * (points - center)).sum(axis=1) > 0.0).all()


@pytest.mark.parametrize("seed", range(4))
def test_signs_follow_the_votes(seed):
    # In a volume normals are as good as random: any other order of joining has other signs.
    points = np.random.default_rng(seed).random((400, 3))
    points[200:] += [5.0, 0.0, 0.0]
    plain = normals(points, k=8, orientation="none", device="cpu").normals
    found = normals(points, k=8, device="cpu").normals
    np.testing.assert_array_equal(np.abs(found), np.abs(plain))
    sign, part = signs_by_votes(points, plain, 8)
    turned = np.sign((found * plain).sum(axis=1)) * sign
    assert len(np.unique(part)) >= 2
    for number in np.unique(part):
        assert len(np.unique(turned[part == number])) == 1


def test_a_long_chain_of_components():
    # Weights fall along the strip: every component wants to join its successor.
    x = np.cumsum(np.linspace(1.0, 2.0, 3000))
    points = np.stack([np.repeat(x, 2), np.tile([0.0, 1.0], 3000), np.repeat(np.sin(x * 1e-3), 2)], axis=1)
    found = normals(points, k=6, device="cpu").normals
    assert (found[:, 2] > 0.0).all()


def test_the_viewpoint():
    points = sphere(1000)
    inside = normals(points, orientation="viewpoint", viewpoint=[0, 0, 0], device="cpu").normals
    assert ((inside * points).sum(axis=1) < 0.0).all()
    eye = np.array([9.0, 1, 2])
    outside = normals(points, orientation="viewpoint", viewpoint=eye, device="cpu").normals
    assert ((outside * (eye - points)).sum(axis=1) >= 0.0).all()


def test_no_orientation_has_its_largest_component_positive():
    found = normals(sphere(1000), orientation="none", device="cpu").normals
    assert (found[np.arange(1000), np.abs(found).argmax(axis=1)] > 0.0).all()


@pytest.mark.parametrize("count", [0, 1, 2])
@pytest.mark.parametrize("settings", [{}, {"radius": 5.0}])
def test_fewer_than_three_points_have_no_plane(count, settings):
    found = normals(SQUARE[:count], device="cpu", **settings)
    assert found.normals.tolist() == [[0.0] * 3] * count
    assert found.curvature.tolist() == [0.0] * count


@pytest.mark.parametrize("settings", [{"k": 8}, {"radius": 0.3}])
@pytest.mark.parametrize("direction", [[1, 0, 0], [0.3, -0.7, 0.2], [1e-9, 1, 1e9]])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_lines_and_single_places_have_no_plane(settings, direction, offset):
    direction = np.array(direction) / np.linalg.norm(direction)
    points = np.linspace(0.0, 1.0, 40)[:, None] * direction + offset
    for cloud in (points, np.tile(points[:1], (40, 1))):
        for orientation in ("none", "propagation"):
            found = normals(cloud, orientation=orientation, device="cpu", **settings)
            assert not found.normals.any()
            assert not found.curvature.any()


def test_points_without_a_plane_leave_the_others_alone():
    points = np.concatenate([sphere(500), np.linspace(5.0, 9.0, 50)[:, None] * [1.0, 0, 0]])
    found = normals(points, k=10, device="cpu")
    assert ((found.normals[:500] * points[:500]).sum(axis=1) > 0.9).all()
    assert not found.normals[500:].any()


def test_duplicates_count_as_points():
    points = np.repeat(sphere(200), 3, axis=0)
    found = normals(points, k=12, orientation="none", device="cpu")
    # Three of each, so that the four nearest places are the twelve nearest points.
    once = normals(points[::3], k=4, orientation="none", device="cpu")
    np.testing.assert_allclose(found.normals[::3], once.normals, atol=1e-12)


def test_k_beyond_the_number_of_points():
    np.testing.assert_array_equal(
        normals(SQUARE, k=1000, device="cpu").normals, normals(SQUARE, k=5, device="cpu").normals
    )


def test_input_is_left_alone():
    points = sphere(100)
    kept = points.copy()
    normals(points, device="cpu")
    np.testing.assert_array_equal(points, kept)


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("k", {"k": 2}),
        ("k", {"k": 1025}),
        ("k", {"k": 8.0}),
        ("k", {"k": True}),
        ("radius", {"radius": 0.0}),
        ("radius", {"radius": -1.0}),
        ("radius", {"radius": np.nan}),
        ("radius", {"radius": "wide"}),
        ("orientation", {"orientation": "up"}),
        ("viewpoint", {"orientation": "viewpoint"}),
        ("viewpoint", {"orientation": "viewpoint", "viewpoint": [1, 2]}),
        ("viewpoint", {"orientation": "viewpoint", "viewpoint": [1, 2, np.nan]}),
        ("viewpoint", {"orientation": "viewpoint", "viewpoint": "there"}),
        ("viewpoint", {"viewpoint": [1, 2, 3]}),
        ("viewpoint", {"orientation": "none", "viewpoint": [1, 2, 3]}),
        ("device", {"device": "abacus"}),
    ],
)
def test_settings_are_checked(name, settings):
    with pytest.raises(gk.InputError, match=f"^{name}:"):
        normals(SQUARE, **{"device": "cpu", **settings})


def test_points_are_checked():
    bad = SQUARE.copy()
    bad[2, 0] = np.nan
    with pytest.raises(gk.InputError, match="points: row 2"):
        normals(bad, device="cpu")
    with pytest.raises(gk.InputError, match=r"points: shape \(5, 2\)"):
        normals(SQUARE[:, :2], device="cpu")


def test_more_edges_than_a_tree_can_number(monkeypatch):
    from geokit.points.clouds import orientation as _orientation

    monkeypatch.setattr(_orientation, "MAX_EDGES", 24)
    with pytest.raises(gk.InputError, match="k: 5 points with 5 neighbors"):
        normals(SQUARE, k=5, device="cpu")
