"""Links each leaf of a volume to its 26 neighbors, and reads voxels across leaf borders.

A volume's leaves are rows: voxel (x, y, z) of row t is element ``512 t + 64 x + 8 y + z`` of an array of values, and
bit ``8 y + z`` of word ``8 t + x`` of an array of bit masks.
"""

# mypy: ignore-errors
import warp as wp

from geokit.volume.nanovdb.read_voxel_kernels import grid_type_of, node_of, read_voxel

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

# Entries in the table of neighbors where there is no leaf.
OUTSIDE = wp.constant(-1)
INSIDE = wp.constant(-2)


@wp.func
def place(beside: wp.array2d(dtype=int), t: int, x: int, y: int, z: int) -> int:
    """Element of voxel (x, y, z) relative to row t, coordinates -8 to 15; OUTSIDE or INSIDE if there is no leaf."""
    at = t
    if ((x | y | z) & ~7) != 0:
        at = beside[t, (x >> 3) * 9 + (y >> 3) * 3 + (z >> 3) + 13]
    if at >= 0:
        at = (at << 9) + ((x & 7) << 6) + ((y & 7) << 3) + (z & 7)
    return at


@wp.func
def value_at(
    values: wp.array(dtype=wp.float64),
    beside: wp.array2d(dtype=int),
    outside: wp.float64,
    inside: wp.float64,
    t: int,
    x: int,
    y: int,
    z: int,
) -> wp.float64:
    at = place(beside, t, x, y, z)
    value = outside
    if at == INSIDE:
        value = inside
    if at >= 0:
        value = values[at]
    return value


@wp.func
def bit_of(words: wp.array(dtype=wp.uint64), at: int) -> bool:
    """The bit of an element; False if there is no element."""
    found = bool(False)
    if at >= 0:
        found = ((words[at >> 6] >> wp.uint64(at & 63)) & wp.uint64(1)) != wp.uint64(0)
    return found


@wp.func
def tile_is_inside(volume: wp.uint64, c: wp.vec3i, isovalue: wp.float64) -> bool:
    """Whether the first voxel of the leaf at c, or the tile in its place, is below the isovalue."""
    kind = grid_type_of(volume)
    node = node_of(volume, kind, 8 * c[0], 8 * c[1], 8 * c[2])
    return read_voxel(volume, kind, node, 8 * c[0], 8 * c[1], 8 * c[2], wp.float64(0.0)) < isovalue


@wp.kernel
def link_kernel(
    first: int,
    tiles: wp.array(dtype=wp.vec3i),
    keys: wp.array(dtype=wp.int64),
    rows: wp.array(dtype=int),
    corner: wp.vec3i,
    volume: wp.uint64,
    isovalue: wp.float64,
    out_beside: wp.array2d(dtype=int),
):
    """Row of each neighbor, or OUTSIDE or INSIDE for a tile in its place."""
    i = first + wp.tid()
    t = i / 27
    n = i % 27
    c = tiles[t] + wp.vec3i(n / 9 - 1, n / 3 % 3 - 1, n % 3 - 1)
    u = c - corner
    key = (wp.int64(u[0]) << wp.int64(42)) | (wp.int64(u[1]) << wp.int64(21)) | wp.int64(u[2])
    at = wp.lower_bound(keys, key)
    found = OUTSIDE
    if at < keys.shape[0] and keys[at] == key:
        found = rows[at]
    elif tile_is_inside(volume, c, isovalue):
        found = INSIDE
    out_beside[t, n] = found


@wp.kernel
def read_rows_kernel(
    first: int,
    volume: wp.uint64,
    tiles: wp.array(dtype=wp.vec3i),
    isovalue: wp.float64,
    out_values: wp.array(dtype=wp.float64),
    out_inside: wp.array(dtype=wp.uint64),
):
    """Values minus the isovalue, and bit masks of the negative ones; an item is a plane of a leaf."""
    i = first + wp.tid()
    c = tiles[i >> 3]
    x = 8 * c[0] + (i & 7)
    kind = grid_type_of(volume)
    node = node_of(volume, kind, x, 8 * c[1], 8 * c[2])
    word = wp.uint64(0)
    for n in range(64):
        value = read_voxel(volume, kind, node, x, 8 * c[1] + (n >> 3), 8 * c[2] + (n & 7), wp.float64(0.0)) - isovalue
        out_values[(i << 6) + n] = value
        if value < wp.float64(0.0):
            word = word | (wp.uint64(1) << wp.uint64(n))
    out_inside[i] = word


@wp.kernel
def beside_zeros_kernel(
    first: int,
    values: wp.array(dtype=wp.float64),
    isovalue: wp.float64,
    rounding: wp.float64,
    active: wp.array(dtype=wp.uint64),
    beside: wp.array2d(dtype=int),
    out_active: wp.array(dtype=wp.uint64),
):
    """Active voxels, and those with an active neighbor of value 0 across a face; an item is a plane of a leaf."""
    i = first + wp.tid()
    word = active[i]
    for n in range(64):
        if ((word >> wp.uint64(n)) & wp.uint64(1)) == wp.uint64(0):
            for way in range(6):
                step = wp.vec3i(0, 0, 0)
                step[way >> 1] = 1 - 2 * (way & 1)
                at = place(beside, i >> 3, (i & 7) + step[0], (n >> 3) + step[1], (n & 7) + step[2])
                if at >= 0 and at < values.shape[0] and bit_of(active, at):
                    if wp.abs(values[at] + isovalue) <= rounding:
                        word = word | (wp.uint64(1) << wp.uint64(n))
    out_active[i] = word


@wp.kernel
def tile_side_kernel(
    first: int,
    volume: wp.uint64,
    tiles: wp.array(dtype=wp.vec3i),
    start: int,
    isovalue: wp.float64,
    out_inside: wp.array(dtype=wp.uint64),
):
    """Sets or clears all inside bits of the rows from ``start`` on, which replace tiles."""
    t = start + first + wp.tid()
    word = wp.uint64(0)
    if tile_is_inside(volume, tiles[t], isovalue):
        word = ~word
    for x in range(8):
        out_inside[8 * t + x] = word


@wp.func
def touches_other_side(
    inside: wp.array(dtype=wp.uint64), beside: wp.array2d(dtype=int), t: int, n: int, is_inside: bool
) -> bool:
    """Whether a voxel of row t next to neighbor n is not on the side ``is_inside``."""
    a = n / 9 - 1
    b = n / 3 % 3 - 1
    c = n % 3 - 1
    found = bool(False)
    for x in range(wp.where(a > 0, 7, 0), wp.where(a < 0, 1, 8)):
        for y in range(wp.where(b > 0, 7, 0), wp.where(b < 0, 1, 8)):
            for z in range(wp.where(c > 0, 7, 0), wp.where(c < 0, 1, 8)):
                if bit_of(inside, (t << 9) + (x << 6) + (y << 3) + z) != is_inside:
                    found = True
    return found


@wp.kernel
def open_sides_kernel(
    first: int,
    inside: wp.array(dtype=wp.uint64),
    beside: wp.array2d(dtype=int),
    out_open: wp.array(dtype=wp.uint8),
):
    """Whether the surface runs between a leaf and a tile beside it."""
    i = first + wp.tid()
    t = i / 27
    n = i % 27
    other = beside[t, n]
    if other < 0 and touches_other_side(inside, beside, t, n, other == INSIDE):
        out_open[i] = wp.uint8(1)


@wp.func
def differ_across(
    inside: wp.array(dtype=wp.uint64), beside: wp.array2d(dtype=int), t: int, axis: int, step: int
) -> bool:
    """Whether voxels that face each other across a border of row t are on different sides; False without a neighbor."""
    found = bool(False)
    for n in range(64):
        u = n >> 3
        v = n & 7
        w = wp.where(step > 0, 7, 0)
        x = wp.where(axis == 0, w, u)
        y = wp.where(axis == 1, w, wp.where(axis == 0, u, v))
        z = wp.where(axis == 2, w, v)
        other = place(
            beside,
            t,
            x + wp.where(axis == 0, step, 0),
            y + wp.where(axis == 1, step, 0),
            z + wp.where(axis == 2, step, 0),
        )
        if other >= 0 and bit_of(inside, other) != bit_of(inside, (t << 9) + (x << 6) + (y << 3) + z):
            found = True
    return found


@wp.kernel
def needed_rows_kernel(
    first: int,
    active: wp.array(dtype=wp.uint64),
    inside: wp.array(dtype=wp.uint64),
    beside: wp.array2d(dtype=int),
    out_needed: wp.array(dtype=wp.uint8),
):
    """Marks the leaves that a grid needs: those with active voxels, and those that the surface runs through or along.

    Only the latter show which side their neighbors are on.
    """
    t = first + wp.tid()
    some = wp.uint64(0)
    any_inside = wp.uint64(0)
    all_inside = ~wp.uint64(0)
    for x in range(8):
        some = some | active[8 * t + x]
        any_inside = any_inside | inside[8 * t + x]
        all_inside = all_inside & inside[8 * t + x]
    needed = some != wp.uint64(0) or any_inside != all_inside
    if not needed:
        for axis in range(3):
            if differ_across(inside, beside, t, axis, -1) or differ_across(inside, beside, t, axis, 1):
                needed = True
    out_needed[t] = wp.uint8(wp.where(needed, 1, 0))


@wp.kernel
def gather_rows_kernel(
    first: int, rows: wp.array(dtype=int), words: wp.array(dtype=wp.uint64), out_words: wp.array2d(dtype=wp.uint64)
):
    i = first + wp.tid()
    for x in range(8):
        out_words[i, x] = words[8 * rows[i] + x]
