"""Rank of registrations between disjoint samples: shapes that slide or turn freely, and bodies that do not.

Source and target are different random points of one shape, 0.01 rad and some hundredths apart. Noise is in spacings.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.catalog import oriented_clouds as shapes
from geokit.points._normals import normals
from geokit.points._register import register
from tests.support.effort import of_all, spread


def plane(random, count):
    points = np.concatenate([random.random((count, 2)), np.zeros((count, 1))], axis=1)
    return points, np.tile([0.0, 0.0, 1.0], (count, 1)), np.sqrt(1.0 / count)


def open_cylinder(random, count):
    turn, height = random.random(count) * 2.0 * np.pi, random.uniform(-1.0, 1.0, count)
    normal = np.stack([np.cos(turn), np.sin(turn), np.zeros(count)], axis=1)
    return 0.5 * normal + height[:, None] * [0.0, 0.0, 1.0], normal, np.sqrt(2.0 * np.pi / count)


def ellipsoid(random, count):
    ball = shapes.sphere(random, count=count)[1]
    normal = ball / [1.0, 0.7, 0.45]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return ball * [1.0, 0.7, 0.45], normal, np.sqrt(7.0 / count)


def bracket(random, count):
    foot, foot_normal, spacing = shapes.box(random, [1.0, 0.4, 0.1], count // 2)
    leg, leg_normal, _ = shapes.box(random, [0.1, 0.4, 0.6], count - count // 2)
    return np.concatenate([foot, leg + np.array([0.9, 0.0, 0.7])]), np.concatenate([foot_normal, leg_normal]), spacing


def lumpy(random, count):
    """A sphere with smooth lumps, as of a scanned figure."""
    ball = shapes.sphere(random, count=count)[1]
    lumps = [3.0, 5.0, 4.0] * ball
    height = 1.0 + 0.25 * np.sin(lumps[:, 0] + 1.0) * np.cos(lumps[:, 1]) + 0.15 * np.sin(lumps[:, 2])
    points = ball * height[:, None]
    return points, normals(points, orientation="none", device="cpu").normals, np.sqrt(4.0 * np.pi / count)


FREE = {
    "sphere": (lambda random, count: shapes.sphere(random, count=count), 3),
    "plane": (plane, 3),
    "cylinder": (open_cylinder, 4),
    "torus": (lambda random, count: shapes.torus(random, 0.35, count), 5),
    "cone": (lambda random, count: shapes.cone(random, 25.0, count), 5),
}
FULL = {
    "box": lambda random, count: shapes.box(random, [1.0, 0.7, 0.5], count),
    "cube": lambda random, count: shapes.box(random, [1.0, 1.0, 1.0], count),
    "ellipsoid": ellipsoid,
    "bracket": bracket,
    "lumpy": lumpy,
}


def rank(shape, count, seed, noise, given, scale=1.0, offset=0.0, method="point_to_plane"):
    random = np.random.default_rng(seed)
    (source, _, spacing), (target, normal, _) = shape(random, count), shape(random, count)
    turn = Rotation.from_rotvec(0.01 * random.normal(size=3)).as_matrix()
    source = source @ turn.T + noise * spacing * random.normal(size=source.shape)
    target = target + noise * spacing * random.normal(size=target.shape)
    return register(
        source * scale + offset, target * scale + offset, target_normals=normal if given else None, method=method,
        device="cpu",
    ).rank  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", FREE)
@pytest.mark.parametrize(
    ("count", "noise"),
    of_all([(500, 0.0), (4000, 0.3)], [(count, noise) for count in (500, 1500, 4000) for noise in (0.0, 0.1, 0.3)]),
)
@pytest.mark.parametrize("given", of_all([False], [True, False]))
def test_what_only_the_sampling_determines_does_not_count(name, count, noise, given):
    shape, wanted = FREE[name]
    for seed in spread(range(3), 2):
        assert rank(shape, count, seed, noise, given) == wanted


@pytest.mark.slow
@pytest.mark.parametrize("name", FULL)
@pytest.mark.parametrize("noise", of_all([0.0, 0.3], [0.0, 0.1, 0.3]))
@pytest.mark.parametrize("given", of_all([False], [True, False]))
def test_bodies_keep_their_rank(name, noise, given):
    for count, seed in spread([(1500, 0), (1500, 1), (4000, 2)], 2):
        assert rank(FULL[name], count, seed, noise, given) == 6


@pytest.mark.parametrize("name", ["sphere", "cylinder", "torus"])
def test_pairs_of_disjoint_points_determine_no_more_than_planes(name):
    shape, wanted = FREE[name]
    assert rank(shape, 800, 0, 0.1, given=False, method="point_to_point") == wanted
    assert rank(FULL["box"], 1500, 0, 0.1, given=False, method="point_to_point") == 6


@pytest.mark.parametrize(("scale", "offset"), [(1e-6, 0.0), (1e6, 0.0), (1.0, 1e6)])
def test_scale_and_offset_do_not_matter(scale, offset):
    assert rank(FREE["torus"][0], 800, 0, 0.1, given=False, scale=scale, offset=offset) == 5
    assert rank(FULL["box"], 1500, 0, 0.1, given=False, scale=scale, offset=offset) == 6


@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_disjoint_points_of_a_line_slide(noise):
    random = np.random.default_rng(0)
    direction = np.array([2.0, -1.0, 2.0]) / 3.0
    source, target = (random.random((400, 1)) * direction for _ in range(2))
    source = source + noise * random.normal(size=source.shape) * [0.0, 2.0, 1.0] / 400
    found = register(source, target, method="point_to_point", device="cpu")
    assert found.rank == 4
    assert register(target, target, method="point_to_point", device="cpu").rank == 5


def test_few_points_with_weak_features_count_as_noise():
    # An ellipsoid whose axes differ by a tenth: between 500 points the slopes of the sampling are as large.
    def nearly_round(random, count):
        ball = shapes.sphere(random, count=count)[1]
        normal = ball / [1.0, 0.9, 0.8]
        return ball * [1.0, 0.9, 0.8], normal / np.linalg.norm(normal, axis=1, keepdims=True), 1.0

    assert rank(nearly_round, 500, 0, 0.0, given=True) < 6
    assert rank(nearly_round, 6000, 0, 0.0, given=True) == 6


@pytest.mark.parametrize("seed", range(6))
def test_exact_normals_of_faces_in_any_pose(seed):
    """Equal unit normals differ from 1 by roundings: no face is left out for that."""
    random = np.random.default_rng(seed)
    pose = Rotation.random(random_state=seed).as_matrix()
    (source, _, _), (target, normal, _) = FULL["box"](random, 1500), FULL["box"](random, 1500)
    found = register(source @ pose.T + 0.002, target @ pose.T, target_normals=normal @ pose.T, device="cpu")
    assert found.rank == 6
