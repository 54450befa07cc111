"""Small queries whose rows and results lie in pinned memory; without a GPU the same code runs in ordinary memory."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.core import launcher
from geokit.core.interop import user_arrays
from geokit.core.memory import pinned
from geokit.core.memory.pinned import Pinned, PinnedArray
from geokit.mesh.sign.parity_kernels import confidence_kernel
from tests.support.devices import DEVICES

SIGNS = ("pseudonormal", "winding", "parity")


@pytest.fixture
def pins(monkeypatch):
    """Has the rows for every device pinned, and counts the arrays."""
    taken = []
    take = Pinned.take

    def spy(self, shape, dtype):
        taken.append(shape)
        return take(self, shape, dtype)

    monkeypatch.setattr(user_arrays, "uses_pinned_memory", lambda device: True)
    monkeypatch.setattr(Pinned, "take", spy)
    return taken


@pytest.mark.parametrize("device", DEVICES)
def test_kernels_read_and_write_there(device):
    target = wp.get_device(device)
    room = Pinned(target)
    winding, confidence = room.take((3,), np.float64), room.take((3,), np.float64)
    winding.values[:] = [0.5, 1.0, -0.25]
    launcher.launch(confidence_kernel, 3, [winding], [confidence], target)
    np.testing.assert_array_equal(confidence.numpy(), [0.0, 0.5, 0.75])
    assert confidence.device == target
    np.testing.assert_array_equal(confidence[1:].numpy(), [0.5, 0.75])
    assert confidence.warp.device == target
    np.testing.assert_array_equal(confidence.warp.numpy(), [0.0, 0.5, 0.75])


def test_what_is_given_away_is_a_copy():
    room = Pinned(wp.get_device("cpu"))
    rows = room.take((4, 3), np.float64)
    rows.values[:] = 1.0
    given = rows.numpy()
    rows.values[:] = 2.0
    np.testing.assert_array_equal(given, 1.0)


def test_arrays_do_not_overlap_and_a_full_buffer_is_followed_by_another():
    room = Pinned(wp.get_device("cpu"))
    shapes = [((pinned.FEWEST_ROWS - 1, 3), np.float64), ((5,), np.int32), ((1,), np.bool_)] * 8
    arrays = [room.take(*shape) for shape in shapes]
    for number, array in enumerate(arrays):
        array.values[:] = number % 2 if array.values.dtype == np.bool_ else number
    for number, array in enumerate(arrays):
        np.testing.assert_array_equal(array.values, number % 2 if array.values.dtype == np.bool_ else number)
        assert array.values.ctypes.data % pinned.ALIGNMENT == 0 or array.values.dtype != np.float64


def test_buffers_are_used_again_once_their_kernels_are_done(monkeypatch):
    waited = []
    monkeypatch.setattr(pinned, "_idle", idle := [])
    monkeypatch.setattr(Pinned.__del__, "__defaults__", (idle,))
    monkeypatch.setattr(pinned, "_synchronize", lambda device, event=None: waited.append(device))
    room = Pinned("one")
    rows = room.take((2,), np.float64)
    data = rows.values.ctypes.data
    assert rows.descriptor.data == data
    rows.numpy()
    assert waited == ["one"]
    del room, rows
    again = Pinned("two").take((2,), np.float64)
    assert again.values.ctypes.data == data
    assert waited == ["one"]  # the first query had waited
    again.descriptor  # noqa: B018 - a kernel gets to know it, and nobody waits
    del again
    third = Pinned("three").take((2,), np.float64)
    assert third.values.ctypes.data == data
    assert waited == ["one", "two"]


@pytest.mark.parametrize("device", DEVICES)
def test_what_is_closed_waits_only_for_its_own_kernels(device):
    target = wp.get_device(device)
    winding, confidence, other = (
        wp.array([0.5, 1.0], dtype=wp.float64, device=device),
        *(Pinned(target).take((2,), np.float64) for _ in range(2)),
    )
    for _ in range(3):
        launcher.launch(confidence_kernel, 2, [winding], [confidence], target)
        confidence.pinned.close()
        launcher.launch(confidence_kernel, 2, [winding], [other], target)
        np.testing.assert_array_equal(confidence.numpy(), [0.0, 0.5])
        confidence.values.fill(7.0)
    np.testing.assert_array_equal(other.numpy(), [0.0, 0.5])


@pytest.mark.parametrize("device", DEVICES)
def test_host_arrays_are_read_as_kernels_leave_them(device):
    target = wp.get_device(device)
    winding = wp.array([0.5, 1.0], dtype=wp.float64, device=device)
    first, second = pinned.host_arrays(target, ((2,), np.float64), ((3,), np.int32))
    second.values.fill(5)
    launcher.launch(confidence_kernel, 2, [winding], [first], target)
    np.testing.assert_array_equal(first.numpy(), [0.0, 0.5])
    np.testing.assert_array_equal(second.numpy(), 5)
    large = pinned.host_arrays(target, ((pinned.BUFFER_BYTES,), np.float64))[0]
    assert len(large) == pinned.BUFFER_BYTES


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("device", DEVICES)
def test_queries_answer_the_same(device, single, monkeypatch):
    surface = gk.mesh.Surface(mesh_catalog.box(), device=device)
    rng = np.random.default_rng(5)
    points, directions = rng.normal(size=(2, 300, 3)).astype(np.float32 if single else np.float64)

    def answers():
        near = surface.closest_point(points), surface.furthest_point(points), surface.winding_number(points)
        signs = [(surface.signed_distance(points, sign=s), surface.contains(points, sign=s)) for s in SIGNS]
        rays = surface.raycast(points, directions), surface.occluded(points, directions)
        return near, signs, rays, surface.crossing_count(points, directions), surface.sign_confidence(points)

    monkeypatch.setattr(user_arrays, "uses_pinned_memory", lambda device: False)
    expected = flat(answers())
    monkeypatch.setattr(user_arrays, "uses_pinned_memory", lambda device: True)
    found = flat(answers())
    assert len(found) == len(expected) == 29
    for one, other in zip(found, expected, strict=True):
        assert type(one) is np.ndarray
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def flat(answer):
    return [array for part in answer for array in flat(part)] if isinstance(answer, (tuple, list)) else [answer]


@pytest.mark.parametrize("count", [0, 1, pinned.FEWEST_ROWS - 1, pinned.FEWEST_ROWS])
def test_only_few_rows_of_numpys_are_pinned(count, pins):
    surface = gk.mesh.Surface(mesh_catalog.box(), device="cpu")
    points = np.ones((count, 3))
    assert len(surface.closest_point(points).distance) == count
    assert bool(pins) == (count < pinned.FEWEST_ROWS)
    pins.clear()
    surface.closest_point(wp.array(points, dtype=wp.vec3d, device="cpu"))
    assert not pins


def test_rows_that_are_not_finite_are_named(pins):
    surface = gk.mesh.Surface(mesh_catalog.box(), device="cpu")
    points = np.ones((5, 3))
    points[3, 1] = np.nan
    calls = [surface.closest_point, surface.furthest_point, surface.winding_number]
    calls += [lambda p, s=s: surface.signed_distance(p, sign=s) for s in SIGNS]
    calls += [lambda p, s=s: surface.contains(p, sign=s) for s in SIGNS]
    for call in calls:
        with pytest.raises(gk.InputError, match="points: row 3 is not finite"):
            call(points)
    with pytest.raises(gk.InputError, match="directions: row 2 is zero"):
        surface.raycast(np.ones((3, 3)), np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 0]]))
    assert all(len(shape) in (1, 2) for shape in pins)


def test_results_are_the_callers_own(pins):
    surface = gk.mesh.Surface(mesh_catalog.box(), device="cpu")
    first = surface.closest_point(np.array([[2.0, 0.5, 0.5]]))
    second = surface.closest_point(np.array([[0.5, 3.0, 0.5]]))
    np.testing.assert_array_equal(first.points, [[1.0, 0.5, 0.5]])
    first.points[:] = 7.0
    np.testing.assert_array_equal(second.points, [[0.5, 1.0, 0.5]])
    assert isinstance(
        user_arrays.empty(2, wp.int32, Pinned(wp.get_device("cpu")).take((2, 3), np.float64)), PinnedArray
    )
