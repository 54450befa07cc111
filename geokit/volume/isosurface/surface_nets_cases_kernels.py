"""Counts the sheets of an isosurface in each cell, and finds the edges of the grid that they cross.

A face may have inside corners at the ends of a diagonal, with one sheet through both of its cuts in each of its two
cells. One vertex per sheet would then give an edge with four faces. So the inside corners are joined on that face, in
both cells, and each cell has one sheet more.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.volume.isosurface.cells_kernels import RECORD, Cells, value_at

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

NUMBERS = {"RECORD": RECORD}


@cpp.func_native("volume/isosurface/surface_nets_cases.inl", **NUMBERS)
def case_at(
    cells: Cells, table: wp.array(dtype=wp.uint32), flips: wp.array(dtype=wp.uint64), plane: int, bit: int
) -> int:
    """The case of a cell; ``flips`` is not read."""
    ...


@wp.kernel
@cpp.native_item("volume/isosurface/surface_nets_cases.inl", "count_planes", Cells, **NUMBERS)
def count_kernel(first: int):
    """Counts sheets and quads of planes, as if no cell had a joined face."""


@wp.kernel
@cpp.native_item("volume/isosurface/surface_nets_cases.inl", "count_joined_planes", Cells, **NUMBERS)
def count_joined_kernel(first: int):
    """Corrects the counts of planes with joined faces: each joined cell has one more sheet."""


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
