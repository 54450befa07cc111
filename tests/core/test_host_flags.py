"""Flags that kernels raise for the host; their pinned memory is looked at on machines with a GPU."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from geokit.core import launcher
from geokit.core.memory import pinned
from geokit.core.memory.pinned import Pinned, host_flags
from geokit.mesh.sign.parity_kernels import missed_kernel
from tests.support.devices import DEVICES


def raised(device: str, triangle_id: list[int]) -> np.ndarray:
    target = wp.get_device(device)
    flags = host_flags(2, target)
    ids = wp.array(triangle_id, dtype=wp.int32, device=target)
    launcher.launch(missed_kernel, len(ids), [ids], [flags], target)
    return flags.numpy().copy()


@pytest.mark.parametrize("device", DEVICES)
def test_a_kernel_raises_what_the_host_reads(device):
    np.testing.assert_array_equal(raised(device, [4, -1, 2]), [1, 0])
    np.testing.assert_array_equal(raised(device, [4, 1, 2]), [0, 0])


@pytest.mark.parametrize("device", DEVICES)
def test_each_begins_at_zero_and_is_its_own(device):
    target = wp.get_device(device)
    first = host_flags(4, target)
    first.values[:] = 7
    second = host_flags(4, target)
    np.testing.assert_array_equal(second.numpy(), 0)
    np.testing.assert_array_equal(first.numpy(), 7)


def test_a_pinned_buffer_is_used_again(monkeypatch):
    """On any machine: the pool itself knows nothing of GPUs."""
    made, make = [], pinned._made

    def buffer(size):
        made.append(make(size))
        return made[-1]

    cpu = wp.get_device("cpu")
    monkeypatch.setattr(pinned, "uses_pinned_memory", lambda device: True)
    monkeypatch.setattr(pinned, "_made", buffer)
    monkeypatch.setattr(pinned, "_idle", idle := [])
    monkeypatch.setattr(Pinned.__del__, "__defaults__", (idle,))
    one, other = host_flags(1, cpu), host_flags(1, cpu)
    one.values[0] = 1
    assert len(made) == 2
    assert other.values[0] == 0
    del one
    again = host_flags(1, cpu)
    assert len(made) == 2
    assert again.values[0] == 0
