"""Tensors of any layout reach kernels with their own numbers."""

from __future__ import annotations

import contextlib
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

torch = pytest.importorskip("torch")

from geokit.core import launcher  # noqa: E402
from geokit.core.gradients import tensor_rows  # noqa: E402
from geokit.core.gradients.tensor_rows import TensorRows, device_of, launch, number_of  # noqa: E402
from geokit.core.interop.user_arrays_kernels import narrow_kernel, widen_kernel  # noqa: E402
from geokit.core.launches import warp_private  # noqa: E402

TABLE = torch.arange(24, dtype=torch.float32).reshape(4, 6)
ROWS = {
    "whole": TABLE[:, :3].contiguous(),
    "strided rows": TABLE[:, :3],
    "every second row": TABLE[::2, 3:],
    "strided columns": TABLE[:, ::2],
    "one row for all": torch.tensor([1.0, 2.0, 3.0]).expand(5, 3),
    "one number for all": torch.tensor(2.0).expand(5, 3),
    "negated": torch._neg_view(TABLE[:, :3]),
    "none": TABLE[:0, :3],
    "in a graph": TABLE[:, :3].clone().requires_grad_(),
}


@pytest.fixture(params=[True, False], ids=["descriptor", "warp array"])
def described(request, monkeypatch):
    """With and without the private class of descriptors."""
    if not request.param:
        monkeypatch.setattr(warp_private, "descriptor_type", lambda: None)
        monkeypatch.setattr(warp_private, "is_packed", lambda device: False)
        monkeypatch.setattr("geokit.core.launches.prepared._launches", {})
    return request.param


@pytest.mark.parametrize("name", ROWS)
def test_rows(name, described):
    rows = ROWS[name]
    out = torch.full(rows.shape, -1.0, dtype=torch.float64)
    target = TensorRows(out) if described else wp.from_torch(out, dtype=wp.vec3d)
    launch(widen_kernel, len(rows), [TensorRows(rows)], [target], device_of(rows))
    assert torch.equal(out, rows.detach().double())


@pytest.mark.parametrize("numbers", [torch.arange(6.0).double(), torch.arange(12.0).double()[::2],
                                     torch.tensor(3.0).double().expand(6)])  # fmt: skip
def test_numbers(numbers, described):
    out = torch.empty(6)
    target = TensorRows(out) if described else wp.from_torch(out)
    launch(narrow_kernel, 6, [TensorRows(numbers)], [target], launcher.resolve_device("cpu"))
    assert torch.equal(out, numbers.float())


def test_another_stream_waits_and_is_waited_for(monkeypatch):
    # Of a GPU where torch works on a stream of its own.
    noted: list = []

    @contextlib.contextmanager
    def scoped(stream, **waits):
        noted.append((stream, waits))
        yield
        noted.append("end")

    monkeypatch.setattr(tensor_rows, "is_in_order", lambda *_: False)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda ordinal: f"stream of {ordinal}")
    monkeypatch.setattr(wp, "stream_from_torch", lambda stream: f"warp's {stream}")
    monkeypatch.setattr(wp, "ScopedStream", scoped)
    monkeypatch.setattr(launcher, "launch", lambda *given: noted.append(given))
    device = SimpleNamespace(ordinal=1)
    launch("kernel", 3, ["in"], ["out"], device)
    both = {"sync_enter": True, "sync_exit": True}
    assert noted == [("warp's stream of 1", both), ("kernel", 3, ["in"], ["out"], device), "end"]


def test_types():
    types = [number_of(torch.empty(1, dtype=dtype)) for dtype in (torch.float32, torch.float64, torch.int32)]
    assert types == [wp.float32, wp.float64, wp.int32]
    whole = TensorRows(torch.arange(3, dtype=torch.int32)).warp
    assert whole.dtype == wp.int32
    np.testing.assert_array_equal(whole.numpy(), [0, 1, 2])
