"""Builds the tables for sampling an adaptive field on a device: a leaf table per level, and the refined cells."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.errors import InputError
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.layout import GRID_TYPES, layout_of
from geokit.volume.sampling.leaf_table import SPAN, _make
from geokit.volume.tolerance.interpolation_errors import STENCILS

# Tolerance on the steps between levels, as a share of a voxel: files may store transforms as decimal or binary doubles.
SAME = 1e-6
# Words of 32 cells per leaf.
LEAF_WORDS = 16
LEAF = 8


class AdaptiveTable(NamedTuple):
    """The kernels' AdaptiveLevels of a field; ``tables`` and ``grids`` own its memory."""

    levels: Any
    tables: list[Any]
    grids: list[Any]


def shifts_of(levels: tuple[SparseVolume, ...]) -> np.ndarray:
    """Shifts (L - 1, 3): twice a cell's index plus the shift is the index of its first half in the next level.

    Raises:
        InputError: Voxel sizes do not halve from one level to the next, or the voxels of two levels do not coincide.
    """
    shifts = np.zeros((len(levels) - 1, 3), np.int64)
    for row, (coarser, finer) in enumerate(pairwise(levels)):
        linear = coarser.info.transform[:3, :3]
        step = (coarser.info.transform[:3, 3] - finer.info.transform[:3, 3]) @ np.linalg.inv(
            finer.info.transform[:3, :3]
        ).T
        halved = np.allclose(linear, 2.0 * finer.info.transform[:3, :3], rtol=0.0, atol=SAME * np.abs(linear).max())
        if not halved or not (np.abs(step - np.round(step)) <= SAME * np.maximum(1.0, np.abs(step))).all():
            raise InputError(
                f"levels: the voxels of level {row + 1} are not halves of those of level {row}; give the grids of one "
                "adaptive field, the coarsest first"
            )
        shifts[row] = np.round(step)
    if len(shifts) and np.abs(shifts).max() > np.iinfo(np.int32).max // 4:
        raise InputError("levels: their indices are too far apart; give the grids of one adaptive field")
    return shifts


def adaptive_table(levels: tuple[SparseVolume, ...], order: int, device: "wp.Device") -> AdaptiveTable:
    """The table of a field on a device.

    Args:
        levels: Float or quantized grids, the coarsest first, each with half the voxel size of the one before.
        order: Order of interpolation.
        device: Device of the table.
    """
    from geokit.volume.adaptive.table_kernels import AdaptiveLevels, fill_finer_kernel
    from geokit.volume.sampling.leaf_table_kernels import LeafTable

    shifts = shifts_of(levels)
    is_fast = order == 1 and all(level.info.grid_type == "float" for level in levels)
    tables = [_make(level, device, *_box(level), with_pairs=is_fast) for level in levels]
    first, count = STENCILS[order]
    reach = (first, first + count)
    slots = [table.slots.numpy() for table in tables]
    entries = [np.sort(found[found >= 0]) for found in slots]
    # Entries of consecutive leaves differ by this much, or more in "fpn", whose leaves have several sizes.
    steps = [layout_of(GRID_TYPES.index(level.info.grid_type), "grid").leaf_size // 32 for level in levels]
    first_entry = np.array([found[0] if len(found) else 0 for found in entries], np.int32)
    spans = [
        (int(found[-1]) - int(found[0])) // step + 1 if len(found) else 0
        for found, step in zip(entries, steps, strict=True)
    ]
    first_word = LEAF_WORDS * np.concatenate([[0], np.cumsum(spans)])
    finer = wp.zeros(int(first_word[-1]), dtype=wp.uint32, device=device)
    for number, (table, next_table) in enumerate(pairwise(tables)):
        found = wp.array(entries[number], dtype=wp.int32, device=device)
        words = finer[int(first_word[number]) : int(first_word[number + 1])]
        inputs = [
            table,
            next_table,
            wp.vec3i(*shifts[number].tolist()),
            found,
            int(first_entry[number]),
            steps[number],
            *reach,
        ]
        launcher.launch(fill_finer_kernel, LEAF_WORDS * len(found), inputs, [words], device)
    shift: Any = np.concatenate([shifts, np.zeros((1, 3), np.int64)]).astype(np.int32)
    field = AdaptiveLevels()
    field.tables = wp.array(tables, dtype=LeafTable, device=device)
    field.finer = finer
    field.first_word = wp.array(first_word[:-1], dtype=wp.int64, device=device)
    field.step = wp.array(np.array(steps, np.int32), dtype=wp.int32, device=device)
    field.volume = wp.array([level.id(device) for level in levels], dtype=wp.uint64, device=device)
    field.first_entry = wp.array(first_entry, dtype=wp.int32, device=device)
    field.shift = wp.array(shift, dtype=wp.vec3i, device=device)
    return AdaptiveTable(field, tables, [level.on(device) for level in levels])


def _box(level: SparseVolume) -> tuple[np.ndarray, np.ndarray]:
    """Box around a level's active voxels: first voxel, a multiple of 128, and size in steps of 128 voxels."""
    bounds = level.info.index_bounds
    if bounds is None:
        return np.zeros(3, np.int64), np.ones(3, np.int64)
    # One voxel more below, because a cell that only touches the active voxels also reads the voxels around them. Above,
    # the voxels beyond the last leaves, which a GPU's pairs include. Everything farther out is background.
    first, last = (bounds[0] - 1) // SPAN, (bounds[1] // LEAF * LEAF + LEAF) // SPAN
    return first * SPAN, last - first + 1
