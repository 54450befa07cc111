"""Narrow bands of meshes that do not fit into memory, from file to file."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from geokit._warn import warn
from geokit.core import launcher
from geokit.core.base.private_folder import private_folder
from geokit.core.blocks.chunked_queries import Progress, in_percent
from geokit.core.files import atomic_path, require_extension, require_room
from geokit.core.interop import user_arrays
from geokit.core.interop.types import Device
from geokit.core.memory.needs import needs
from geokit.core.require import require_choice, require_path, require_text
from geokit.errors import InputError
from geokit.formats.blocks.triangles import TriangleFile, open_triangles
from geokit.formats.blocks.workers import in_turn, task_memory
from geokit.volume.band.band import BandShape
from geokit.volume.band.fields import half_widths, in_float32
from geokit.volume.band.lattice_origin import checked_band, index_translation
from geokit.volume.band.tiles import LEAF_BYTES, MOST_TILES, TILE_VOXELS
from geokit.volume.nanovdb import file
from geokit.volume.nanovdb.grid_info import GridInfo
from geokit.volume.nanovdb.provenance import provenance
from geokit.volume.streamed.cell_band import CellBands
from geokit.volume.streamed.cells import LOWER_SPAN, Cell, CellLattice, split
from geokit.volume.streamed.grid_file import GridParts
from geokit.volume.streamed.survey import Survey, survey
from geokit.volume.streamed.windings import AT_A_TIME
from geokit.volume.tree.grid_head import checked_head

# Cells along an axis of the whole band, before any is split.
MOST_CELLS = 4

SIGNS = ("winding", "none")
# Voxels nearer to the surface than this share of the largest coordinate are on it, and so outside: their positions are
# not known better.
ON_SURFACE = 1e-15


@needs()
def from_mesh_file(
    path: str | os.PathLike[str],
    out: str | os.PathLike[str],
    voxel_size: float,
    *,
    half_width: float | tuple[float, float] = 3.0,
    sign: str = "winding",
    thickness: float | None = None,
    name: str | None = None,
    memory_limit: int | None = None,
    device: Device = None,
    executor: Any = None,
    progress: Progress | None = None,
) -> GridInfo:
    """Build the narrow band of a mesh in a file, and write it to a .nvdb file; neither has to fit into memory.

    The file has the grid of :func:`from_mesh` with ``interior="keep"``, bit for bit: voxels, values, tiles, statistics.
    Only its metadata differ, and, on a mesh that intersects itself, signs of voxels where a winding number of
    ``from_mesh`` (within 0.005) is off. Distances of voxels within 1e-14 of the mesh's size from the surface may have
    either sign.

    Triangles are read block after block and sorted into cubes of voxels, with those that come within reach of a
    cube, in files beside ``out``. A cube that is too large for the memory is split. Then the band of each is built as
    by :func:`from_mesh`, and its nodes are put together in ``out``. The files take about the size of the triangles
    (36 bytes each, 72 in a .ply of doubles) and of the grid, and are removed at the end.

    The mesh must be closed: each edge is used as often in one direction as in the other. Faces keep their winding (of a
    mesh with a negative volume all are turned), where :func:`from_mesh` turns each part outward. Surface inside of
    solids stays, as with ``interior="keep"`` there. Signs are those of exact winding numbers. They are counted from a
    point outside of the mesh, crossing after crossing, from cube to cube, so that they do not depend on triangles that
    are far away. Faces back to back cancel. Of an open mesh there are unsigned distances, or a solid shell.

    Args:
        path: A mesh of triangles in a binary .stl or .ply file. Vertices of a .ply file are mapped into memory, and
            read fast where faces refer to vertices that lie near each other in the file.
        out: Target, .nvdb; an existing file is replaced. It appears complete or not at all. It may be larger than
            memory; ``load(bounds=)`` takes parts of it.
        voxel_size: Edge length of a voxel [world].
        half_width: Width of the band on either side of the surface [voxels], at least 1; or a pair: outside and inside.
        sign: "winding", or "none" for unsigned distances in a grid of class "unknown".
        thickness: Thickness [world] of a solid shell around the surface, as for :func:`from_mesh`; without ``sign``.
        name: Name of the grid; None for the file's name without its extension.
        memory_limit: Bytes that may be taken beyond those of the running process, at least 2^28; with an executor, for
            each of its tasks. None for half of the free memory, or for 2^30 with an executor.
        device: Where to compute: "cpu", "cuda:0", a warp device, or None for the first GPU, else the CPU.
        executor: Workers that make the bands of the cubes, side by side: an executor of ``concurrent.futures``, a Dask
            ``Client``, or another object whose ``submit(function, *arguments)`` gives such futures. All must see
            the folder of ``out``. The file has the same bytes. None for the calling process.
        progress: Called as ``progress(percent, 100)``.
    Returns:
        GridInfo of the grid in ``out``. Its metadata say "geokit:source" (the file), "geokit:source_sha256" (of the
        triangles' corners), "geokit:voxel_size", "geokit:version", "geokit:sign_method" and "geokit:sign_reason".
    Raises:
        InputError: An argument is out of range, the mesh has no faces, is open or not wound alike, or the voxels of
            the band are too many to be numbered.
        FileAccessError: A file is missing, or cannot be written, or the disk has no room for the grid.
        FileFormatError: The mesh file is text, damaged, or has other faces than triangles.
        DeviceMemoryError: More triangles lie near 8^3 voxels than fit into the memory.
        WorkerError: The executor lost a worker, or a worker does not see the folder of ``out``.
    Source:
        Museth, "VDB: High-Resolution Sparse Volumes with Dynamic Topology" (2013), for the structure.
    Example:
        >>> gk.mesh.save("ball.ply", gk.mesh.sphere())
        >>> gk.volume.from_mesh_file("ball.ply", "ball.nvdb", 0.05, device="cpu").grid_class
        'level set'
    """
    path, target = require_path(path), require_path(out, "out")
    require_extension(target, (".nvdb",), "streamed volume")
    require_choice(sign, "sign", SIGNS)
    name = path.stem if name is None else require_text(name, "name")
    report = in_percent(progress)
    widths = half_widths(half_width)
    voxel_size, _ = checked_band(voxel_size, max(widths))
    offset = 0.0
    if thickness is not None:
        offset = 0.5 * user_arrays.require_finite_scalar(thickness, "thickness", low=0.0)
    memory = task_memory(executor, memory_limit)
    exterior, interior = (in_float32(width * voxel_size) for width in widths)
    # The band calls "parity" what asks for single voxels: here their exact winding numbers.
    unsigned = sign == "none" or offset > 0.0
    shape = BandShape(exterior, interior, offset, "none" if unsigned else "parity")
    resolved = launcher.resolve_device(device)
    source = open_triangles(path)
    if source.count == 0:
        raise InputError(f"{path}: has no faces; a band needs at least one triangle")
    with atomic_path(target) as part:
        known = survey(source.blocks(AT_A_TIME))
        if not (unsigned or known.closed):
            raise InputError(
                f"{path}: is open, or its faces are not wound alike, so that it has no inside; orient or repair it, or "
                "give sign='none', or thickness"
            )
        lattice = CellLattice(voxel_size, index_translation(known.bounds, voxel_size), shape.reach)
        extent = float((known.bounds[1] - known.bounds[0]).max())
        across = (extent + 2.0 * shape.reach) / voxel_size
        if not across < MOST_TILES * TILE_VOXELS:
            what, enough = "voxel_size", f"at least {1.05 * voxel_size * across / (MOST_TILES * TILE_VOXELS):.2g}"
            if 2.0 * shape.reach > extent:  # larger voxels make a band of as many voxels no smaller
                what, enough = "half_width", "a smaller half_width or thickness"
            raise InputError(f"{what}: the band is {across:.3g} voxels across, more than can be counted; use {enough}")
        require_room(
            target,
            _least_leaves(known.area, shape, voxel_size) * 2 * LEAF_BYTES,
            "the grid and what is written before it",
            f"use a voxel_size over {voxel_size:g}, a smaller half_width, or another disk",
        )
        transform = np.diag([voxel_size, voxel_size, voxel_size, 1.0])
        transform[:3, 3] = lattice.translation
        level_set = not unsigned or offset > 0.0
        inside = -interior if level_set else exterior
        head = checked_head("float", exterior, inside, transform, name, "level set" if level_set else "unknown")

        bands = CellBands(
            lattice,
            shape,
            head,
            memory,
            str(resolved),
            turn=-1 if known.inside_out else 1,
            near=ON_SURFACE * float(np.abs(known.bounds).max()),
        )
        method, reason = ("shell" if offset else "none", "asked for") if unsigned else ("winding", "closed")
        metadata = {
            **provenance(name, known.sha256, voxel_size),
            "geokit:sign_method": method,
            "geokit:sign_reason": reason,
        }
        against = write_band(part, source, known, bands, metadata, executor, report)
    if against:
        warn(
            f"{path}: {against} voxels near the surface have a negative winding number: parts of the mesh are "
            "inside out, or folded over; there all is outside. Orient the mesh if it has an inside there"
        )
    return file.inspect(target)[0]


def _least_leaves(area: float, shape: BandShape, voxel_size: float) -> float:
    """Leaves that the band has at least: a surface meets one for each 8 x 8 voxels, and folds may count four times.

    Whatever the mesh, its band is no smaller than that of a point (Brunn and Minkowski).
    """
    ball = 4.0 / 3.0 * math.pi * ((shape.reach / voxel_size) ** 3 - (shape.hollow / voxel_size) ** 3)
    return max(area / voxel_size**2 / 256.0, ball / 512.0)


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
