"""The narrow band of a mesh in a file, cell after cell, into a .nvdb file."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from geokit.core.base.private_folder import private_folder
from geokit.formats.blocks.triangles import TriangleFile
from geokit.formats.blocks.workers import in_turn
from geokit.volume.streamed.cell_band import CellBands
from geokit.volume.streamed.cells import LOWER_SPAN, Cell, split
from geokit.volume.streamed.grid_file import GridParts
from geokit.volume.streamed.survey import Survey
from geokit.volume.streamed.windings import AT_A_TIME

__all__ = ["write_band"]

# Cells along an axis of the whole band, before any is split.
MOST_CELLS = 4


def write_band(
    path: Path,
    source: TriangleFile,
    known: Survey,
    bands: CellBands,
    metadata: dict[str, Any],
    executor: Any,
    report: Callable[[float], None],
) -> int:
    """Write the .nvdb file of a mesh's band; returns the number of voxels with a negative winding number.

    Args:
        path: Target.
        source: The triangles.
        known: What is known of them.
        bands: What is the same for all cells.
        metadata: Of the file.
        executor: Where cells are made, as ``concurrent.futures`` has them; None for here.
        report: Called with the part of the work that is done, from 0 to 1.
    Raises:
        DeviceMemoryError: A cell of a single leaf needs more memory than may be taken.
        WorkerError: A worker was lost.
    """
    with private_folder(path.parent) as folder:
        parts = GridParts(folder, bands.head, signed=bands.signed)
        cells = _first_cells(source, known, bands, folder)
        total, done, against = sum(cell.file.count for cell in cells), 0.0, 0
        # Smaller cells share the work of the one that was split.
        shares = {cell.file.path: cell.file.count / total for cell in cells}
        with closing(in_turn(bands, cells, folder, executor, lambda cell: cell.file.count)) as made:
            for cell, band in made:
                os.unlink(cell.file.path)
                share, against = shares.pop(cell.file.path), against + band.number
                if band.tasks:
                    within = sum(part.file.count for part in band.tasks)
                    shares |= {part.file.path: share * part.file.count / within for part in band.tasks}
                    continue
                if band.found is not None:
                    parts.add(band.found)
                done += share
                report(done)
        parts.write(path, metadata)
        return against


def _first_cells(source: TriangleFile, known: Survey, bands: CellBands, folder: Path) -> list[Cell]:
    lattice = bands.lattice
    index = (known.bounds - lattice.translation + [[-lattice.reach], [lattice.reach]]) / lattice.voxel_size
    low, high = np.floor(index).astype(np.int64)
    span = LOWER_SPAN
    while (high // span - low // span).max() >= MOST_CELLS:
        span *= 2
    counts = tuple((high // span - low // span + 1).tolist())
    # The first point is outside: it lies below the box around the mesh.
    first = low // span * span
    return split(source.blocks(AT_A_TIME), source.dtype, first, span, counts, lattice, bands.winding(0), folder)
