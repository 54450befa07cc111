"""Kernels that are declared by the C++ function that each item calls."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
import pytest
import warp as wp

from geokit.core import cpp, launcher
from geokit.core.sorting.gather_kernels import GATHER


@wp.struct
class Pair:
    low: wp.float64


def test_an_item_is_the_place_in_the_share_and_other_arguments_keep_their_order(monkeypatch: Any) -> None:
    text = "static constexpr auto item = [](int i, int times, wp::array_t<int>& rows, wp::array_t<int>& out_rows) {\n"
    text += "    out_rows.data[i] = times * rows.data[i] + i;\n};\n"
    read = cpp._read
    monkeypatch.setattr(cpp, "_read", lambda file: text if file == "a/test.inl" else read(file))

    @wp.kernel(enable_backward=False)
    @cpp.native_item("a/test.inl", "item")
    def times_kernel(first: int, times: int, rows: wp.array(dtype=wp.int32), out_rows: wp.array(dtype=wp.int32)): ...

    rows = wp.array(np.arange(10), dtype=wp.int32, device="cpu")
    out = wp.zeros_like(rows)
    launcher.launch(times_kernel, 10, [3, rows], [out], rows.device)
    np.testing.assert_array_equal(out.numpy(), 4 * np.arange(10))
    # Warp, tracebacks and debuggers find the text of the kernel.
    assert "times_kernel_item(first + wp.tid(), times, rows, out_rows)" in inspect.getsource(times_kernel.func)


def test_a_declaration_without_parameters_has_those_of_the_function(monkeypatch: Any) -> None:
    text = "static constexpr auto item = [](int i, const Pair& pair, const wp::array_t<wp::vec3d>& rows,\n"
    text += "    double share, uint8_t kind, wp::array_t<double>& out_rows) -> void {\n"
    text += "    out_rows.data[i] = share * rows.data[i][kind] + pair.low;\n};\n"
    read = cpp._read
    monkeypatch.setattr(cpp, "_read", lambda file: text if file == "a/test.inl" else read(file))

    @wp.kernel(enable_backward=False)
    @cpp.native_item("a/test.inl", "item", Pair)
    def share_kernel(first: int): ...

    names = [argument.label for argument in share_kernel.adj.args]
    assert names == ["first", "pair", "rows", "share", "kind", "out_rows"]
    pair = Pair()
    pair.low = 7.0
    rows = wp.array(np.arange(30).reshape(10, 3), dtype=wp.vec3d, device="cpu")
    out = wp.empty(10, dtype=wp.float64, device="cpu")
    launcher.launch(share_kernel, 10, [pair, rows, wp.float64(0.5), wp.uint8(2)], [out], rows.device)
    np.testing.assert_array_equal(out.numpy(), 7.0 + 0.5 * (3 * np.arange(10) + 2))
    with pytest.raises(AssertionError, match=r"a/test.inl: there is no absent"):
        cpp.native_item("a/test.inl", "absent")(lambda first: None)


def test_a_declaration_says_what_the_function_leaves_open(monkeypatch: Any) -> None:
    text = "static constexpr auto item = [](int i, int times, const auto& rows, auto shift,\n"
    text += "    wp::array_t<int>& out_rows) {\n"
    text += "    out_rows.data[i] = times * rows.data[i * rows.shape[1]] + (int)shift;\n};\n"
    read = cpp._read
    monkeypatch.setattr(cpp, "_read", lambda file: text if file == "a/test.inl" else read(file))

    @wp.kernel(enable_backward=False)
    @cpp.native_item("a/test.inl", "item")
    def column_kernel(first: int, shift: wp.float64, rows: wp.array2d(dtype=wp.int32)): ...  # type: ignore[valid-type]

    names = [argument.label for argument in column_kernel.adj.args]
    assert names == ["first", "times", "rows", "shift", "out_rows"]
    rows = wp.array(np.arange(20).reshape(10, 2), dtype=wp.int32, device="cpu")
    out = wp.empty(10, dtype=wp.int32, device="cpu")
    launcher.launch(column_kernel, 10, [3, rows, wp.float64(4.0)], [out], rows.device)
    np.testing.assert_array_equal(out.numpy(), 3 * np.arange(0, 20, 2) + 4)

    def absent_kernel(first: int, low: int, rows: Any, shift: Any): ...

    with pytest.raises(AssertionError, match=r"a/test.inl: item has no parameter low"):
        cpp.native_item("a/test.inl", "item")(absent_kernel)


@pytest.mark.parametrize("kind", GATHER)
def test_rows_may_be_gathered_in_their_own_stead(kind: Any) -> None:
    order = np.random.default_rng(0).permutation(50)
    width = wp.types.type_size(kind)
    rows = np.arange(50 * width).reshape(50, width).squeeze()
    given, places = wp.array(rows, dtype=kind, device="cpu"), wp.array(order, dtype=wp.int32, device="cpu")
    out = places if kind is wp.int32 else wp.empty_like(given)
    launcher.launch(GATHER[kind], 50, [given, places], [out], given.device)
    np.testing.assert_array_equal(out.numpy(), rows[order])
