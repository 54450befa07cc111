"""NumPy rows that kernels on the CPU read and write in place."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import geokit as gk
from benchmarks.catalog import mesh_catalog
from geokit.core import launcher
from geokit.core.interop import user_arrays
from geokit.core.launches.warp_private import launch_argument
from geokit.core.memory.host_array import HostArray
from geokit.mesh.sign.parity_kernels import confidence_kernel

CPU = launcher.resolve_device("cpu")


def test_kernels_write_into_the_rows_themselves():
    winding, confidence = np.array([0.5, 1.0, -0.25]), np.zeros(3)
    launcher.launch(confidence_kernel, 3, [HostArray(winding)], [HostArray(confidence)], CPU)
    np.testing.assert_array_equal(confidence, [0.0, 0.5, 0.75])


def test_slices_stay_in_place():
    winding, confidence = np.array([0.5, 1.0, -0.25, 3.0]), np.zeros(4)
    rows, out = HostArray(winding)[2:], HostArray(confidence)[2:]
    assert len(rows) == 2
    launcher.launch(confidence_kernel, 2, [rows], [out], CPU)
    np.testing.assert_array_equal(confidence, [0.0, 0.0, 0.75, 2.5])


@pytest.mark.parametrize(
    ("values", "dtype"),
    [
        (np.arange(6.0).reshape(2, 3), wp.vec3d),
        (np.arange(2.0), wp.float64),
        (np.arange(2, dtype=np.int32), wp.int32),
        (np.array([True, False]), wp.bool),
        (np.zeros((0, 3)), wp.vec3d),
    ],
)
def test_as_a_warp_array_it_is_the_same_memory(values, dtype):
    rows = HostArray(values)
    assert rows.warp.dtype == dtype
    assert rows.warp.shape == (len(values),)
    assert rows.warp is rows.warp
    np.testing.assert_array_equal(rows.warp.numpy(), values)
    assert rows.numpy() is values
    assert rows.device.is_cpu
    if len(values):
        assert rows.warp.ptr == values.ctypes.data == rows.descriptor.data


def test_other_arguments_pass_as_they_are():
    given = [1.0, None, wp.float64(2.0), np.zeros(3)]
    assert all(launch_argument(argument) is argument for argument in given)


@pytest.mark.parametrize("dtype", [wp.vec3d, wp.float64, wp.int32, wp.bool])
def test_results_lie_where_the_rows_lie(dtype):
    rows = HostArray(np.zeros((4, 3)))
    assert isinstance(user_arrays.empty(4, dtype, rows), HostArray)
    assert isinstance(user_arrays.empty(4, dtype, wp.zeros(4, dtype=wp.vec3d, device="cpu")), wp.array)


def test_results_are_writable_and_their_own():
    surface = gk.mesh.Surface(mesh_catalog.box(), device="cpu")
    points = np.array([[2.0, 0.5, 0.5]])
    points.setflags(write=False)
    first, second = surface.closest_point(points), surface.closest_point(points)
    first.points[:] = 7.0
    np.testing.assert_array_equal(second.points, [[1.0, 0.5, 0.5]])
    np.testing.assert_array_equal(points, [[2.0, 0.5, 0.5]])
