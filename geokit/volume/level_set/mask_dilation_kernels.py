"""Dilates bit masks: finds the voxels with set neighbors in a plane of a leaf, 64 bits of one word.

Rows, words and bits are those of ``leaf_neighbors_kernels``: bit ``8 y + z`` of word ``8 t + x``. A step along z is a
shift by one, along y a shift by eight, along x a step to another word. Bits shifted in at a leaf's border come from the
adjacent leaf.
"""

# mypy: ignore-errors
import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Bit masks of the voxels with z = 0 and with z = 7 in a plane.
FIRST_Z = wp.constant(wp.uint64(0x0101010101010101))
LAST_Z = wp.constant(wp.uint64(0x8080808080808080))


@wp.func
def word_of(
    words: wp.array(dtype=wp.uint64), flip: wp.uint64, beside: wp.array2d(dtype=int), t: int, side: int, x: int
) -> wp.uint64:
    """Word x of the leaf on a side of row t (0 without a leaf), with the bits of ``flip`` inverted."""
    word = wp.uint64(0)
    row = beside[t, side]
    if row >= 0:
        word = words[8 * row + x]
    return word ^ flip


@wp.func
def from_below(below: wp.uint64, word: wp.uint64) -> wp.uint64:
    """Bits that have a set neighbor before them along z."""
    return ((word << wp.uint64(1)) & ~FIRST_Z) | ((below >> wp.uint64(7)) & FIRST_Z)


@wp.func
def along_z(below: wp.uint64, word: wp.uint64, above: wp.uint64) -> wp.uint64:
    """Bits that are set or have a set neighbor along z."""
    one = wp.uint64(1)
    seven = wp.uint64(7)
    down = ((word >> one) & ~LAST_Z) | ((above << seven) & LAST_Z)
    return word | from_below(below, word) | down


@wp.func
def along_y(below: wp.uint64, word: wp.uint64, above: wp.uint64) -> wp.uint64:
    row = wp.uint64(8)
    rest = wp.uint64(56)
    return word | (word << row) | (below >> rest) | (word >> row) | (above << rest)


@wp.func
def square_around(
    words: wp.array(dtype=wp.uint64), flip: wp.uint64, beside: wp.array2d(dtype=int), t: int, x: int
) -> wp.uint64:
    """Bits of plane x, -1 to 8 relative to row t, that are set or have a set neighbor within the plane."""
    side = 9 * (x >> 3) + 13
    at = x & 7
    below = along_z(
        word_of(words, flip, beside, t, side - 4, at),
        word_of(words, flip, beside, t, side - 3, at),
        word_of(words, flip, beside, t, side - 2, at),
    )
    here = along_z(
        word_of(words, flip, beside, t, side - 1, at),
        word_of(words, flip, beside, t, side, at),
        word_of(words, flip, beside, t, side + 1, at),
    )
    above = along_z(
        word_of(words, flip, beside, t, side + 2, at),
        word_of(words, flip, beside, t, side + 3, at),
        word_of(words, flip, beside, t, side + 4, at),
    )
    return along_y(below, here, above)


@wp.func
def cube_around(
    words: wp.array(dtype=wp.uint64), flip: wp.uint64, beside: wp.array2d(dtype=int), t: int, x: int
) -> wp.uint64:
    """Bits of plane x of row t that are set or have a set neighbor among their 26."""
    return (
        square_around(words, flip, beside, t, x - 1)
        | square_around(words, flip, beside, t, x)
        | square_around(words, flip, beside, t, x + 1)
    )


@wp.func
def corners_in_plane(cells: wp.array(dtype=wp.uint64), beside: wp.array2d(dtype=int), t: int, x: int) -> wp.uint64:
    """Bits of the voxels in plane x, -1 to 7, that are corners of cells which start in this plane.

    The cell of a bit has its corners at that voxel and one further along y and z.
    """
    side = 9 * (x >> 3) + 13
    at = x & 7
    none = wp.uint64(0)
    here = word_of(cells, none, beside, t, side, at)
    low = word_of(cells, none, beside, t, side - 3, at)
    here = here | from_below(word_of(cells, none, beside, t, side - 1, at), here)
    low = low | from_below(word_of(cells, none, beside, t, side - 4, at), low)
    return here | (here << wp.uint64(8)) | (low >> wp.uint64(56))


@wp.func
def cross_around(
    words: wp.array(dtype=wp.uint64), flip: wp.uint64, beside: wp.array2d(dtype=int), t: int, x: int
) -> wp.uint64:
    """Bits of plane x, relative to row t, that are set or have one of their 4 neighbors along y or z set."""
    side = 9 * (x >> 3) + 13
    at = x & 7
    here = word_of(words, flip, beside, t, side, at)
    ways = along_z(word_of(words, flip, beside, t, side - 1, at), here, word_of(words, flip, beside, t, side + 1, at))
    return ways | along_y(
        word_of(words, flip, beside, t, side - 3, at), here, word_of(words, flip, beside, t, side + 3, at)
    )


@wp.func
def faces_around(
    words: wp.array(dtype=wp.uint64), flip: wp.uint64, beside: wp.array2d(dtype=int), t: int, x: int
) -> wp.uint64:
    """Bits of plane x of row t that are set or have a set neighbor among their 6 across a face."""
    below = word_of(words, flip, beside, t, 9 * ((x - 1) >> 3) + 13, (x - 1) & 7)
    above = word_of(words, flip, beside, t, 9 * ((x + 1) >> 3) + 13, (x + 1) & 7)
    return below | above | cross_around(words, flip, beside, t, x)


@wp.func
def edges_around(
    words: wp.array(dtype=wp.uint64), flip: wp.uint64, beside: wp.array2d(dtype=int), t: int, x: int
) -> wp.uint64:
    """Bits of plane x of row t that are set or have a set neighbor among their 18 across a face or an edge."""
    return (
        cross_around(words, flip, beside, t, x - 1)
        | square_around(words, flip, beside, t, x)
        | cross_around(words, flip, beside, t, x + 1)
    )


def _step_kernel(around: wp.Function) -> wp.Kernel:
    """The kernel of a step to the neighbors that ``around`` reaches.

    With ``flip`` all zeros it is a step of dilation; with all ones one of erosion, a dilation of the unset voxels.
    """

    @wp.kernel
    def step_kernel(
        first: int,
        words: wp.array(dtype=wp.uint64),
        flip: wp.uint64,
        beside: wp.array2d(dtype=int),
        out_words: wp.array(dtype=wp.uint64),
    ):
        i = first + wp.tid()
        out_words[i] = around(words, flip, beside, i >> 3, i & 7) ^ flip

    return step_kernel


grow_faces_kernel = _step_kernel(faces_around)
grow_edges_kernel = _step_kernel(edges_around)
grow_vertices_kernel = _step_kernel(cube_around)
