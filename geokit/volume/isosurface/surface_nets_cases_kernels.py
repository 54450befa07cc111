"""Counts the sheets of an isosurface in each cell, and finds the edges of the grid that they cross.

A face may have inside corners at the ends of a diagonal, with one sheet through both of its cuts in each of its two
cells. One vertex per sheet would then give an edge with four faces. So the inside corners are joined on that face, in
both cells, and each cell has one sheet more.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core import cpp
from geokit.volume.isosurface.cells_kernels import RECORD, Cells, value_at

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Bit fields of a plane's count.
QUADS_SHIFT = 16
HAS_PROBLEM, HAS_DEAD = wp.constant(1 << 30), wp.constant(1 << 29)
COUNT_MASK = wp.constant(0xFFF)

NUMBERS = {"RECORD": RECORD, "QUADS_SHIFT": QUADS_SHIFT}


@cpp.func_native("volume/isosurface/surface_nets_cases.inl", **NUMBERS)
def count_plane(cells: Cells) -> int:
    """Counts the vertices and quads of a plane, with flags; writes bit masks of its cells by number of sheets."""
    ...


@cpp.func_native("volume/isosurface/surface_nets_cases.inl", **NUMBERS)
def case_at(
    cells: Cells, table: wp.array(dtype=wp.uint32), flips: wp.array(dtype=wp.uint64), plane: int, bit: int
) -> int:
    """The case of a cell; ``flips`` is not read."""
    ...


@wp.kernel
def count_kernel(
    first: int,
    span: int,
    cells: Cells,
    table: wp.array(dtype=wp.uint32),
    out_flips: wp.array(dtype=wp.uint64),
    out_records: wp.array(dtype=wp.uint64),
    out_problems: wp.array(dtype=wp.uint64),
    out_vertices: wp.array(dtype=int),
    out_quads: wp.array(dtype=int),
    out_flags: wp.array(dtype=int),
):
    """Counts sheets and quads of planes, as if no cell had a joined face."""
    for plane in range(span * (first + wp.tid()), span * (first + wp.tid() + 1)):
        out_flips[plane] = wp.uint64(0)
        found = count_plane(cells, table, out_flips, plane, out_records, out_problems)
        out_vertices[plane] = found & COUNT_MASK
        out_quads[plane] = (found >> QUADS_SHIFT) & COUNT_MASK
        # All threads that write here write the same value.
        if (found & HAS_PROBLEM) != 0:
            out_flags[0] = 1
        if (found & HAS_DEAD) != 0:
            out_flags[1] = 1


@wp.kernel
def count_joined_kernel(
    first: int,
    span: int,
    cells: Cells,
    table: wp.array(dtype=wp.uint32),
    flips: wp.array(dtype=wp.uint64),
    problems: wp.array(dtype=wp.uint64),
    out_records: wp.array(dtype=wp.uint64),
    out_vertices: wp.array(dtype=int),
):
    """Corrects the counts of planes with joined faces: each joined cell has one more sheet."""
    for plane in range(span * (first + wp.tid()), span * (first + wp.tid() + 1)):
        if flips[plane] != wp.uint64(0):
            found = count_plane(cells, table, flips, plane, out_records, problems)
            out_vertices[plane] = found & COUNT_MASK


@wp.func
def case_of_values(volume: wp.uint64, isovalue: wp.float64, i: int, j: int, k: int) -> int:
    code = int(0)
    for c in range(8):
        if value_at(volume, i + c / 4, j + (c / 2) % 2, k + c % 2) < isovalue:
            code = code | (1 << c)
    return code


@wp.kernel
def flips_kernel(
    first: int,
    span: int,
    cells: Cells,
    table: wp.array(dtype=wp.uint32),
    problems: wp.array(dtype=wp.uint64),
    isovalue: wp.float64,
    out_flips: wp.array(dtype=wp.uint64),
):
    """Bit masks of the cells with one loop through both cuts of a face, if the cell beyond that face has one too."""
    for plane in range(span * (first + wp.tid()), span * (first + wp.tid() + 1)):
        problem = problems[plane]
        flips = wp.uint64(0)
        if problem != wp.uint64(0):
            corner = cells.origin[cells.crossed[plane / 8]]
            for bit in range(64):
                if (problem >> wp.uint64(bit)) & wp.uint64(1) != wp.uint64(0):
                    face = int(table[case_at(cells, table, out_flips, plane, bit)] >> wp.uint32(27)) - 1
                    step = 2 * (face % 2) - 1
                    at = corner + wp.vec3i(plane % 8, bit / 8, bit % 8)
                    at[face / 2] = at[face / 2] + step
                    beyond = case_of_values(cells.volume, isovalue, at[0], at[1], at[2])
                    # In the cell beyond, the same face has the opposite side.
                    if int(table[beyond] >> wp.uint32(27)) - 1 == face - step:
                        flips = flips | (wp.uint64(1) << wp.uint64(bit))
        out_flips[plane] = flips
