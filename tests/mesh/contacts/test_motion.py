"""Motions up to a contact: bodies by hand, and against poses along the motion."""

from __future__ import annotations

import numpy as np
import pytest

import geokit as gk


def surface(mesh):
    return gk.mesh.Surface(mesh, device="cpu")


def pose(by=(0, 0, 0), axis=(0, 0, 1), degrees=0.0):
    x, c, s = np.asarray(axis) / np.linalg.norm(axis), np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix = np.eye(4)
    matrix[:3, :3] = c * np.eye(3) + s * np.cross(np.eye(3), x) + (1 - c) * np.outer(x, x)
    matrix[:3, 3] = by
    return matrix


UNIT = gk.mesh.box((1, 1, 1))


def test_a_thin_wall_stops_what_is_fast():
    wall, ball = surface(gk.mesh.plane((20, 20))), surface(gk.mesh.sphere(0.5, segments=24))
    found = ball.until_contact(wall, motion=np.stack([pose([0, 0, 1e4]), pose([0, 0, -1e4])]))
    assert found.time == pytest.approx((1e4 - 0.5) / 2e4, abs=1e-9)
    assert found.time <= (1e4 - 0.5) / 2e4
    assert 0.0 <= found.separation <= 1e-6


def test_a_motion_without_contact_ends():
    one, other = surface(UNIT), surface(gk.mesh.box((1, 1, 1), center=(0, 0, 5)))
    found = one.until_contact(other, motion=np.stack([pose(), pose([0, 0, 3])]))
    assert found == (1.0, pytest.approx(1.0, abs=1e-12))
    still = one.until_contact(other, motion=np.stack([pose(), pose()]))
    assert still == (1.0, 4.0)


def test_contact_from_the_beginning():
    one = surface(UNIT)
    assert one.until_contact(one, motion=np.stack([pose(), pose([3, 0, 0])])) == (0.0, 0.0)


def test_the_separation_is_that_at_the_time_when_steps_run_out():
    """A box glides 1 down while it moves 1000 along a floor: 1000 steps do not reach it."""
    floor = surface(gk.mesh.box((4000, 4000, 1), center=(0, 0, -0.5)))
    motion = np.stack([pose([0, 0, 0.51]), pose([1000, 0, -0.49])])
    found = surface(UNIT).until_contact(floor, motion=motion, tolerance=1e-9)
    assert 0.005 < found.time < 0.01
    assert found.separation == pytest.approx(0.01 - found.time, abs=1e-8)


@pytest.mark.parametrize("degrees", [90.0, 179.9, 180.0, 1e-4])
def test_a_turning_bar(degrees):
    """A bar turns about its center towards a wall beside it: its corner touches at an angle of arcsine."""
    bar = surface(gk.mesh.box((4, 1e-6, 1)))
    height = min(1.0, 2.0 * np.sin(np.radians(degrees / 2)))
    wall = surface(gk.mesh.box((9, 1, 9), center=(0, height + 0.5, 0)))
    found = bar.until_contact(wall, motion=np.stack([pose(), pose(degrees=degrees)]), tolerance=1e-9)
    assert found.time == pytest.approx(np.degrees(np.arcsin(height / 2)) / degrees, abs=2e-6 / min(height, 1.0))


def test_never_later_than_poses_along_the_motion():
    rng = np.random.default_rng(2)
    one, other = surface(gk.mesh.torus(1.0, 0.2, segments=16, tube_segments=8)), surface(gk.mesh.box((0.5, 0.5, 4)))
    paths = np.stack(
        [
            np.stack([pose(rng.uniform(-3, 3, 3), rng.normal(size=3), rng.uniform(0, 360)) for _ in range(2)])
            for _ in range(40)
        ]
    )
    found = one.until_contact(other, motion=paths)
    assert 5 < (found.time < 1.0).sum() < 35
    for i, path in enumerate(paths):
        single = one.until_contact(other, motion=path)
        assert single == (pytest.approx(found.time[i], abs=1e-9), pytest.approx(found.separation[i], abs=1e-9))
        if found.time[i] == 0.0:
            assert one.distance(other, transform=path[0]).distance <= 2e-6 * 1.2
            continue
        # Before it nothing touches, at no pose of the same motion.
        first, turn = path[0, :3, :3], path[0, :3, :3].T @ path[1, :3, :3]
        angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
        axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        times = np.linspace(0.0, found.time[i], 50)[:-1]
        poses = np.stack([pose((1 - t) * path[0, :3, 3] + t * path[1, :3, 3], axis, t * angle) for t in times])
        poses[:, :3, :3] = first @ poses[:, :3, :3]
        assert (one.distance(other, transform=poses).distance > 0.0).all()
        if found.time[i] < 1.0:
            assert found.separation[i] <= 2e-6 * 1.2
        else:
            last = one.distance(other, transform=path[1]).distance
            assert found.separation[i] == pytest.approx(last, abs=1e-9)


def test_no_motions():
    found = surface(UNIT).until_contact(surface(UNIT), motion=np.zeros((0, 2, 4, 4)))
    assert found.time.shape == found.separation.shape == (0,)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"motion": np.eye(4)}, r"motion: shape \(4, 4\) is not \(2, 4, 4\)"),
        ({"motion": np.stack([np.eye(4), np.diag([2.0, 1, 1, 1])])}, "transform: map 1 is not a rigid motion"),
        ({"motion": np.stack([np.eye(4), np.diag([-1.0, 1, 1, 1])])}, "motion: 0 turns into its mirror image"),
        ({"motion": np.stack([np.eye(4)] * 2), "tolerance": 0.0}, "tolerance: 0.0 is not a distance"),
        ({"motion": np.stack([np.eye(4)] * 2), "other": UNIT}, "other: TriangleMesh is not a Surface"),
    ],
)
def test_refuses(options, message):
    with pytest.raises(gk.errors.InputError, match=message):
        surface(UNIT).until_contact(**{"other": surface(UNIT), **options})


def test_a_motion_beyond_all_numbers_is_free_for_no_time_that_could_be_told():
    one = surface(UNIT)
    assert one.until_contact(one, motion=np.stack([pose([5, 0, 0]), pose([1e300, 0, 0])])) == (0.0, 4.0)
