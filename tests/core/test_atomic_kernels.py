"""Minima that the threads of a launch share, against NumPy's."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from geokit.core import launcher, user_arrays
from geokit.core.atomic_kernels import lower_to
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
