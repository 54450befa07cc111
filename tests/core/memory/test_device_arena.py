"""Arrays in one allocation: apart from each other, seen by kernels and by warp alike."""

from __future__ import annotations

import gc

import numpy as np
import pytest
import warp as wp

from geokit.core import launcher
from geokit.core.memory.device_arena import Scratch
from geokit.mesh.sign.parity_kernels import confidence_kernel
from geokit.volume.band.signs_kernels import invert_bits_kernel
from tests.support.devices import DEVICES

SHAPES = [((5,), wp.float64), ((0,), wp.int32), ((3, 8), wp.uint64), ((7,), wp.uint8), ((2,), wp.vec3d)]


@pytest.mark.parametrize("device", DEVICES)
def test_arrays_are_apart(device):
    arrays = Scratch(wp.get_device(device), *SHAPES, zeroed=True).arrays
    for array, (shape, dtype) in zip(arrays, SHAPES, strict=True):
        assert array.shape == array.warp.shape == shape
        assert array.dtype is array.warp.dtype is dtype
        assert len(array) == shape[0]
        assert array.device == array.warp.device == wp.get_device(device)
        assert not array.numpy().any()
    for number, array in enumerate(arrays):
        array.warp.fill_(number + 1)
    for number, array in enumerate(arrays):
        assert (array.numpy() == number + 1).all()


@pytest.mark.parametrize("device", DEVICES)
def test_kernels_take_them(device):
    target = wp.get_device(device)
    winding, confidence, bits, inverted = Scratch(
        target, ((3,), wp.float64), ((3,), wp.float64), ((2, 8), wp.uint64), ((2, 8), wp.uint64), zeroed=True
    ).arrays
    winding.warp.assign([0.5, 1.0, -0.25])
    launcher.launch(confidence_kernel, 3, [winding], [confidence], target)
    launcher.launch(invert_bits_kernel, 2, [bits], [inverted], target)
    np.testing.assert_array_equal(confidence.numpy(), [0.0, 0.5, 0.75])
    np.testing.assert_array_equal(inverted.numpy(), np.full((2, 8), (1 << 64) - 1, np.uint64))


@pytest.mark.slow
def test_an_array_keeps_the_memory_alive():
    (array,) = Scratch(wp.get_device("cpu"), ((100_000,), wp.int32), zeroed=True).arrays
    seen = array.warp
    del array
    gc.collect()
    others = [wp.full(100_000, 7, dtype=wp.int32, device="cpu") for _ in range(4)]
    assert len(others) == 4
    assert not seen.numpy().any()
