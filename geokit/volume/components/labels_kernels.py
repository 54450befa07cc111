"""Connected components of rows of cells, by union-find: within a row, then over the faces between rows.

A row is 8^3 cells: the voxels of a leaf, or tiles of one size. Cell (x, y, z) of row r is element ``512 r + 64 x + 8 y
+ z`` of an array of cells, and bit ``8 y + z`` of word ``8 r + x`` of an array of bit masks. ``links`` leads from each
set cell to the first cell of its component within the row, and from these to lower ones of other rows, a root to
itself. So the root of a component is its lowest element, whatever the order of the threads. In the end the first cells
hold -1 minus the number of their component.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.core.atomic_kernels import add_to, unite
from geokit.core.scan_kernels import begin_of
from geokit.points.search.neighbors_kernels import lowest_bit

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


# Cells with another one before them on their line along z.
NOT_FIRST = wp.constant(wp.uint64(0xFEFEFEFEFEFEFEFE))


@wp.kernel
@cpp.native_item("volume/components/labels.inl", "label_row")
def rows_kernel(first: int):
    """Components within each row; bits of their first cells, and at these the numbers of their cells."""


@wp.kernel
def faces_kernel(
    first: int,
    words: wp.array(dtype=wp.uint64),
    rows: wp.array(dtype=int),
    others: wp.array(dtype=int),
    axis: int,
    out_links: wp.array(dtype=int),
):
    """Joins a plane of a row with the next row of cells of the same size along an axis."""
    i = first + wp.tid()
    x = i & 7
    here = 8 * rows[i >> 3] + x
    there = 8 * others[i >> 3] + x
    pairs = words[there]
    # Bits from a cell to its neighbor in the row before.
    back = int(0)
    # A pair next to a pair: both ends are joined already.
    step = wp.uint64(1)
    last = NOT_FIRST
    if axis == 0:
        here += 7
        if x > 0:
            return
        pairs = pairs & words[here]
    if axis == 1:
        pairs = pairs & (words[here] >> wp.uint64(56))
        back = 56
    if axis == 2:
        pairs = pairs & (words[here] >> wp.uint64(7)) & ~NOT_FIRST
        back = 7
        step = wp.uint64(8)
        last = ~wp.uint64(0)
    pairs = pairs & ~((pairs << step) & last)
    while pairs != wp.uint64(0):
        n = lowest_bit(pairs)
        pairs = pairs & (pairs - wp.uint64(1))
        unite(out_links, out_links[(here << 6) + n + back], out_links[(there << 6) + n])


@wp.func
def cell_on_face(face: int, n: int) -> int:
    """Cell n of 64 on a face of a row, by lines: faces 0 to 5 are low and high x, y, z."""
    u = n >> 3
    v = n & 7
    w = 7 * (face & 1)
    at = (w << 6) + (u << 3) + v
    if face >> 1 == 1:
        at = (u << 6) + (w << 3) + v
    if face >> 1 == 2:
        at = (u << 6) + (v << 3) + w
    return at


@wp.kernel
def tiles_kernel(
    first: int,
    words: wp.array(dtype=wp.uint64),
    rows: wp.array(dtype=int),
    cells: wp.array(dtype=int),
    face: int,
    out_links: wp.array(dtype=int),
):
    """Joins a larger cell with the cells on the face of a row that it touches."""
    i = first + wp.tid()
    for n in range(64):
        at = (rows[i] << 9) + cell_on_face(face, n)
        if ((words[at >> 6] >> wp.uint64(at & 63)) & wp.uint64(1)) != wp.uint64(0):
            unite(out_links, out_links[at], out_links[cells[i]])


# Whether the first cell of a component within its row is the root of the whole component.
@wp.func
def is_root(links: wp.array(dtype=int), at: int) -> bool:
    return links[at] == at


@wp.kernel
def count_roots_kernel(
    first: int, firsts: wp.array(dtype=wp.uint64), links: wp.array(dtype=int), out_count: wp.array(dtype=int)
):
    r = first + wp.tid()
    count = int(0)
    for x in range(8):
        rest = firsts[8 * r + x]
        while rest != wp.uint64(0):
            if is_root(links, ((8 * r + x) << 6) + lowest_bit(rest)):
                count += 1
            rest = rest & (rest - wp.uint64(1))
    out_count[r] = count


@wp.kernel
def number_roots_kernel(
    first: int, firsts: wp.array(dtype=wp.uint64), ends: wp.array(dtype=int), out_links: wp.array(dtype=int)
):
    """Numbers the components in the order of their roots, from 0; the roots get -1 minus their number."""
    r = first + wp.tid()
    number = begin_of(ends, r)
    for x in range(8):
        rest = firsts[8 * r + x]
        while rest != wp.uint64(0):
            at = ((8 * r + x) << 6) + lowest_bit(rest)
            if is_root(out_links, at):
                out_links[at] = -1 - number
                number += 1
            rest = rest & (rest - wp.uint64(1))


@wp.kernel
def number_firsts_kernel(
    first: int,
    firsts: wp.array(dtype=wp.uint64),
    size: wp.array(dtype=wp.int16),
    begin: int,
    voxels: wp.int64,
    out_links: wp.array(dtype=int),
    out_count: wp.array(dtype=wp.int64),
):
    """Gives the first cells of rows from ``begin`` on their numbers, and adds their ``voxels`` per cell to the counts.

    A link that another thread has replaced meanwhile leads to the same number.
    """
    r = begin + first + wp.tid()
    for x in range(8):
        rest = firsts[8 * r + x]
        while rest != wp.uint64(0):
            at = ((8 * r + x) << 6) + lowest_bit(rest)
            number = out_links[at]
            while number >= 0:
                number = out_links[number]
            out_links[at] = number
            add_to(out_count, -1 - number, wp.int64(size[at]) * voxels)
            rest = rest & (rest - wp.uint64(1))


@wp.kernel
@cpp.native_item("volume/components/labels.inl", "name_row")
def names_kernel(first: int):
    """Name of the component of each set cell, 0 for others."""
