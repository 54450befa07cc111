"""The narrow band of a mesh in a file, cell after cell, into a .nvdb file."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from geokit.core.private_folder import private_folder
from geokit.formats.blocks.triangles import TriangleFile
from geokit.formats.blocks.workers import Workers
from geokit.volume.streamed.cell_band import CellBand, CellBands, band_on_worker
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
        total, done, against = sum(cell.count for cell in cells), 0.0, 0
        made = _here(bands, cells, folder) if executor is None else _on_workers(executor, bands, cells, folder)
        # Smaller cells share the work of the one that was split.
        shares = {cell.path: cell.count / total for cell in cells}
        with closing(made):
            for cell, band in made:
                os.unlink(cell.path)
                share, against = shares.pop(cell.path), against + band.against
                if band.cells:
                    within = sum(part.count for part in band.cells)
                    shares |= {part.path: share * part.count / within for part in band.cells}
                    continue
                if isinstance(band.grid, Path):
                    parts.add(np.fromfile(band.grid, np.uint8))
                    os.unlink(band.grid)
                elif band.grid is not None:
                    parts.add(band.grid)
                done += share
                report(min(done, 1.0))
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


def _here(bands: CellBands, cells: list[Cell], folder: Path) -> Generator[tuple[Cell, CellBand], None, None]:
    """Make cells one after the other; the smaller ones of one that is split are next, so that few files wait."""
    waiting = cells[::-1]
    while waiting:
        cell = waiting.pop()
        band = bands.make(cell, folder)
        waiting += band.cells[::-1]
        yield cell, band


def _on_workers(
    executor: Any, bands: CellBands, cells: list[Cell], folder: Path
) -> Generator[tuple[Cell, CellBand], None, None]:
    """Make cells on the workers of an executor, in the order in which they are done."""
    with Workers(executor, folder.parent) as workers:

        def submit(more: list[Cell]) -> None:
            # The largest first: nobody waits for it at the end.
            for cell in sorted(more, key=lambda cell: -cell.count):
                workers.submit(cell, band_on_worker, bands, cell, folder)

        submit(cells)
        for cell, band in workers.results():
            submit(band.cells)
            yield cell, band
