"""Grids of floats and int32 from leaves on the host, in any order, built by the device writer on the CPU."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory.host_array import HostArray
from geokit.errors import InputError
from geokit.volume.nanovdb.layout import LEAF_VOXELS
from geokit.volume.nanovdb.nodes import NodeLevel, slot_of
from geokit.volume.tree.device_writer import Leaves, build_on_device
from geokit.volume.tree.grid_head import GridHead, root_keys_of


def build_leaves(
    head: GridHead,
    leaf_origins: NDArray[np.int32],
    leaf_values: NDArray[Any],
    leaf_masks: NDArray[Any],
    *,
    signed: bool,
) -> NDArray[np.uint8]:
    """Build a NanoVDB grid of floats or int32 from leaves in any order, with kernels on the CPU.

    Args:
        head: Headers and options of the grid.
        leaf_origins: First voxel of each leaf, multiples of 8, shape (L, 3) int32, each once.
        leaf_values: Values of the leaves, shape (L, 512) of the grid's type, z fastest.
        leaf_masks: Active voxels, shape (L, 512) bool in the order of the values, or packed (L, 64) uint8.
        signed: Set empty regions inside the surface to ``head.inside`` (for a level set).
    Returns:
        The grid: uint8, 32-byte aligned, with min, max and box of every node.
    Raises:
        InputError: Origins are off the lattice, repeated or too far apart, or the arrays do not fit them.
    """
    from geokit.volume.tree.device_writer_kernels import copy_leaves_kernel
    from geokit.volume.tree.node_signs_kernels import negative_bits_kernel

    origins = _checked_origins(leaf_origins)
    count = len(origins)
    values = np.ascontiguousarray(leaf_values, head.word)
    packed = np.asarray(leaf_masks).dtype != np.bool_
    for what, array, row in (("leaf_values", values, LEAF_VOXELS), ("leaf_masks", leaf_masks, 64 if packed else 512)):
        if np.shape(array) != (count, row):
            raise InputError(f"{what}: shape {np.shape(array)} is not {(count, row)}; give a row per leaf")
    masks = np.ascontiguousarray(leaf_masks if packed else np.packbits(leaf_masks, axis=1, bitorder="little"))
    leaves, _ = _ordered(origins)
    device, rows = leaves.keys.device, leaves.rows
    inside = None
    if signed:
        inside = wp.empty((count, 8), dtype=wp.uint64, device=device)
        flat = HostArray(values.reshape(-1))
        launcher.launch(negative_bits_kernel, 8 * count, [wp.int64(0), rows, flat], [inside], device)

    def write(buffer: Any, begin: int) -> None:
        words = HostArray(values.reshape(-1).view(np.int32))
        bits = HostArray(masks.reshape(-1).view(np.uint64))
        launcher.launch(copy_leaves_kernel, 8 * count, [wp.int64(begin), rows, words, bits], [buffer], device)

    built = build_on_device(leaves, head, write, inside)
    assert built.host is not None  # the device is the CPU
    return built.host


def fill_leaves(
    head: GridHead,
    leaf_origins: NDArray[np.int32],
    fill: Callable[[NDArray[np.int64], NDArray[Any], NDArray[np.uint8]], None],
) -> NDArray[np.uint8]:
    """As :func:`build_leaves`, for values that are written to the grid at once, without a copy of them.

    Args:
        head, leaf_origins: As there.
        fill: Called with the rows of the leaves, (L,), and the arrays that it fills: values (L, 512), and masks
            (L, 64) of packed bits.
    """
    leaves, order = _ordered(_checked_origins(leaf_origins))
    count, layout = len(order), head.layout
    rows = np.empty(count, np.int64)
    rows[order] = np.arange(count)

    def write(buffer: Any, begin: int) -> None:
        level = NodeLevel(
            buffer.numpy(), layout, "leaf", begin, count, layout.leaf_size, layout.leaf_table, width=8, span=1
        )
        fill(rows, level.values, level.value_mask)

    built = build_on_device(leaves, head, write)
    assert built.host is not None  # the device is the CPU
    return built.host


def _ordered(origins: NDArray[np.int32]) -> tuple[Leaves, NDArray[np.int64]]:
    """Leaves in the order of their keys, on the CPU, and which of the origins each is."""
    keys, uppers = leaf_keys(origins)
    order = np.argsort(keys, kind="stable")
    twice = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    if len(twice):
        first, second = order[twice[0]], order[twice[0] + 1]
        raise InputError(f"leaf_origins: row {second} repeats row {first}; give each leaf once")
    tiles: Any = wp.array(origins >> 3, dtype=wp.vec3i, device=launcher.resolve_device("cpu"))
    return Leaves(HostArray(keys[order]), tiles, HostArray(order.astype(np.int32)), uppers), order


def _checked_origins(leaf_origins: NDArray[np.int32]) -> NDArray[np.int32]:
    origins = np.asarray(leaf_origins)
    if origins.ndim != 2 or origins.shape[1] != 3 or not np.issubdtype(origins.dtype, np.integer):
        raise InputError(
            f"leaf_origins: {origins.dtype} {origins.shape} is not an integer array (L, 3); give voxel indices"
        )
    limits = np.iinfo(np.int32)
    bad = np.flatnonzero(((origins & 7 != 0) | (origins < limits.min) | (origins > limits.max)).any(axis=1))
    if len(bad):
        row = bad[0]
        raise InputError(f"leaf_origins: row {row} is {origins[row].tolist()}; give int32 multiples of 8")
    return np.ascontiguousarray(origins, np.int32)


def leaf_keys(origins: NDArray[np.int32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keys of leaves as in ``Leaves``, and coordinates of upper nodes (U, 3) by their ranks in the keys."""
    root, first, rank = np.unique(root_keys_of(origins), return_index=True, return_inverse=True)
    # At most 2^36 upper nodes leave 27 bits for the slots in them.
    keys = rank.reshape(-1).astype(np.int64) << 27 | slot_of(origins, 32, 128) << 12 | slot_of(origins, 16, 8)
    return keys, origins[first].astype(np.int64).reshape(len(root), 3) >> 12
