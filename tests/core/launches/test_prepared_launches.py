"""Launches that are prepared once: the arguments of each are its own, and nothing is kept alive."""

from __future__ import annotations

import ctypes
import gc
import threading
import weakref
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp

from geokit.core import launcher
from geokit.core.launches import warp_private
from geokit.core.memory.host_array import HostArray
from tests.support.devices import DEVICES


@wp.struct
class Pair:
    a: float
    rows: wp.array(dtype=float)


@wp.kernel(enable_backward=False)
def mixed_kernel(
    first: int,
    whole: wp.int64,
    narrow: float,
    wide: wp.float64,
    vector: wp.vec3d,
    pair: Pair,
    table: wp.array2d(dtype=float),
    doubled: wp.bool,
    byte: wp.uint8,
    out: wp.array(dtype=wp.float64),
):
    i = first + wp.tid()
    out[i] = (
        wp.float64(whole)
        + wp.float64(narrow)
        + wide
        + vector[2]
        + wp.float64(pair.a)
        + wp.float64(pair.rows[i])
        + wp.float64(table[i, 1])
        + wp.float64(byte)
    )
    if doubled:
        out[i] = wp.float64(2.0) * out[i]


@wp.kernel(enable_backward=False)
def generic_kernel(first: int, values: wp.array(dtype=Any), out: wp.array(dtype=Any)):
    i = first + wp.tid()
    out[i] = values[i] + values[i]


for kind in (wp.float32, wp.float64, wp.int32):
    wp.overload(generic_kernel, [int, wp.array(dtype=kind), wp.array(dtype=kind)])


@pytest.mark.parametrize("device", DEVICES)
def test_of_a_generic_kernel_the_arguments_choose_the_overload(device):
    for kind in (wp.float64, wp.float32, wp.int32, wp.float64):
        values = wp.array([1, 2, 3], dtype=kind, device=device)
        out = wp.zeros(3, dtype=kind, device=device)
        launcher.launch(generic_kernel, 3, [values], [out], wp.get_device(device))
        np.testing.assert_array_equal(out.numpy(), [2, 4, 6])


def arguments(device, count, seed):
    rng = np.random.default_rng(seed)
    numbers = [int(rng.integers(1 << 40)), float(np.float32(rng.random())), float(rng.random())]
    rows, table = rng.random(count, np.float32), rng.random((count, 2), np.float32)
    pair = Pair()
    pair.a, pair.rows = 0.5, wp.array(rows, dtype=float, device=device)
    inputs = [*numbers, wp.vec3d(0.0, 0.0, 3.0), pair, wp.array(table, dtype=float, device=device)]
    doubled, byte = (True, 200) if seed % 2 else (wp.bool(False), wp.uint8(7))
    expected = (sum(numbers) + 3.5 + rows.astype(float) + table[:, 1] + int(byte)) * (2 if seed % 2 else 1)
    return [*inputs, doubled, byte], expected


@pytest.mark.parametrize("device", DEVICES)
def test_every_kind_of_argument_is_that_of_the_call(device):
    target = wp.get_device(device)
    for seed, count in enumerate((5, 5, 1, 300, 2)):
        inputs, expected = arguments(device, count, seed)
        out = wp.zeros(count, dtype=wp.float64, device=device)
        launcher.launch(mixed_kernel, count, inputs, [out], target)
        np.testing.assert_allclose(out.numpy(), expected, rtol=1e-15)


def test_numbers_may_be_warps_numpys_or_pythons():
    device = wp.get_device("cpu")
    inputs, _ = arguments("cpu", 4, 0)
    found = []
    for kinds in ((int, float, float), (wp.int64, wp.float32, wp.float64), (np.int32, np.float32, np.float64)):
        out = np.zeros(4)
        numbers = [kind(value) for kind, value in zip(kinds, (3, 0.25, 0.125), strict=True)]
        launcher.launch(mixed_kernel, 4, [*numbers, *inputs[3:]], [HostArray(out)], device)
        found.append(out)
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])


def test_arguments_are_left_as_they_were():
    device = wp.get_device("cpu")
    inputs, _ = arguments("cpu", 4, 0)
    vector, double = wp.vec3d(1.0, 2.0, 3.0), wp.float64(5.0)
    for given in ([1, 1.0, double, vector], [2, 2.0, 7.0, wp.vec3d(9.0, 9.0, 9.0)]):
        launcher.launch(mixed_kernel, 4, [*given, *inputs[4:]], [HostArray(np.zeros(4))], device)
    assert tuple(vector) == (1.0, 2.0, 3.0)
    assert double.value == 5.0


@pytest.mark.parametrize("wrong", ["dtype", "dimensions", "count"])
def test_what_does_not_fit_is_refused_at_every_launch(wrong):
    device = wp.get_device("cpu")
    inputs, _ = arguments("cpu", 4, 0)
    out = wp.zeros(4, dtype=wp.float64, device=device)
    for _ in range(2):
        launcher.launch(mixed_kernel, 4, inputs, [out], device)
        bad = {
            "dtype": (inputs, [wp.zeros(4, dtype=wp.float32, device=device)]),
            "dimensions": (inputs, [wp.zeros((4, 2), dtype=wp.float64, device=device)]),
            "count": (inputs[1:], [out]),
        }[wrong]
        with pytest.raises((RuntimeError, ValueError)):
            launcher.launch(mixed_kernel, 4, *bad, device)


def test_a_gpu_is_given_the_address_of_each_argument():
    """Those that warp itself packs, byte by byte: of the bounds, then of each argument."""
    device = wp.get_device("cpu")
    given = [0, *arguments("cpu", 5, 0)[0], wp.zeros(5, dtype=wp.float64, device=device)]
    expected = warp_private.record_launch(mixed_kernel, 5, given, device, 1).params
    packed = warp_private.PackedLaunch(warp_private.record_launch(mixed_kernel, 3, given, device, 1))
    packed._command.device = SimpleNamespace(is_cpu=False)
    launch = packed.bound(5, given).__self__
    assert launch.bounds.size == 5
    for address, argument in zip(launch.params_addr, expected, strict=True):
        size = ctypes.sizeof(argument)
        assert ctypes.string_at(address, size) == ctypes.string_at(ctypes.addressof(argument), size)
        assert address % ctypes.alignment(type(argument)) == 0


@pytest.mark.slow
def test_no_array_is_kept_alive():
    device = wp.get_device("cpu")
    inputs, _ = arguments("cpu", 4, 0)
    for _ in range(2):
        out = wp.zeros(4, dtype=wp.float64, device=device)
        launcher.launch(mixed_kernel, 4, inputs, [out], device)
        gone = weakref.ref(out)
        del out
        gc.collect()
        assert gone() is None


@pytest.mark.slow
def test_threads_have_launches_of_their_own():
    device = wp.get_device("cpu")
    wrong = []

    def work(seed):
        for n in range(200):
            inputs, expected = arguments("cpu", 3, 1000 * seed + n)
            out = np.zeros(3)
            launcher.launch(mixed_kernel, 3, inputs, [HostArray(out)], device)
            if not np.allclose(out, expected, rtol=1e-15):
                wrong.append(seed)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
