"""Minima and sums that the threads of a launch share, against NumPy's."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from geokit.core import launcher
from geokit.core.atomic_kernels import add_to, lower_to
from geokit.core.interop import user_arrays
from tests.support.devices import DEVICES

wp.set_module_options({"enable_backward": False})


@wp.kernel
def lowest_kernel(
    first: int, at: wp.array(dtype=wp.int32), value: wp.array(dtype=wp.int64), out_int: wp.array(dtype=wp.int32),
    out_long: wp.array(dtype=wp.int64),
):  # fmt: skip
    i = first + wp.tid()
    lower_to(out_int, at[i], wp.int32(value[i] >> wp.int64(20)))
    lower_to(out_long, at[i], value[i])


@wp.kernel
def sums_kernel(
    first: int, at: wp.array(dtype=wp.int32), value: wp.array(dtype=wp.int64), out_int: wp.array(dtype=wp.int32),
    out_long: wp.array(dtype=wp.int64), out_table: wp.array(dtype=wp.int64, ndim=2), out_old: wp.array(dtype=wp.int32),
):  # fmt: skip
    i = first + wp.tid()
    add_to(out_long, at[i], value[i])
    add_to(out_table, at[i], 1, value[i])
    out_old[i] = add_to(out_int, at[i], 1)


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_sums_and_old_values(device, monkeypatch):
    monkeypatch.setenv("GEOKIT_THREADS", "4")
    rng = np.random.default_rng(62)
    count, slots = 200_000, 3
    at = rng.integers(0, slots, count).astype(np.int32)
    value = rng.integers(-(2**40), 2**40, count)
    counts, sums, old = (
        wp.zeros(size, dtype=kind, device=device)
        for size, kind in ((slots, wp.int32), (slots, wp.int64), (count, wp.int32))
    )
    table = wp.zeros((slots, 2), dtype=wp.int64, device=device)
    inputs = [wp.array(at, dtype=wp.int32, device=device), wp.array(value, dtype=wp.int64, device=device)]
    launcher.launch(sums_kernel, count, inputs, [counts, sums, table, old], wp.get_device(device))
    expected = np.zeros(slots, np.int64)
    np.add.at(expected, at, value)
    np.testing.assert_array_equal(sums.numpy(), expected)
    np.testing.assert_array_equal(table.numpy(), np.stack([np.zeros(slots, np.int64), expected], axis=1))
    np.testing.assert_array_equal(counts.numpy(), np.bincount(at))
    # Each old value is handed out once.
    for slot in range(slots):
        np.testing.assert_array_equal(np.sort(old.numpy()[at == slot]), np.arange(counts.numpy()[slot]))


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_minima_of_both_widths(device, monkeypatch):
    monkeypatch.setenv("GEOKIT_THREADS", "4")
    rng = np.random.default_rng(61)
    # Descending, so that nearly every value is lower than those before it.
    value = np.sort(rng.integers(-(2**50), 2**50, 400_000))[::-1].copy()
    at = rng.integers(0, 7, len(value)).astype(np.int32)
    target = wp.get_device(device)
    high, higher = np.full(7, 2**31 - 1, np.int32), np.full(7, 2**63 - 1, np.int64)
    out = wp.array(high, dtype=wp.int32, device=target), wp.array(higher, dtype=wp.int64, device=target)
    given = [wp.array(at, dtype=wp.int32, device=target), wp.array(value, dtype=wp.int64, device=target)]
    launcher.launch(lowest_kernel, len(value), given, list(out), target)
    for one, result in zip((value >> 20, value), out, strict=True):
        np.testing.assert_array_equal(result.numpy(), [one[at == k].min() for k in range(7)])


def test_the_first_short_direction_is_named(monkeypatch):
    monkeypatch.setenv("GEOKIT_THREADS", "4")
    directions = np.ones((300_000, 3))
    directions[1234:] = 0.0
    batch = user_arrays.read_vectors(directions, "directions", wp.get_device("cpu"))
    with pytest.raises(ValueError, match="row 1234 is zero"):
        user_arrays.require_length(batch, "directions", 1e-150)
