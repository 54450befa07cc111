"""Morton keys: queries that are near each other in space are answered one soon after the other."""

# mypy: ignore-errors
import warp as wp

wp.set_module_options({"enable_backward": False})

# Queries between the one that is answered and the one that is prefetched; 2 to 16 make no difference.
AHEAD = 4


@wp.func
def spread_bits(x: wp.uint32) -> wp.uint32:
    """The low 10 bits of x with two zeros between neighbors."""
    v = x & wp.uint32(0x3FF)
    v = (v | (v << wp.uint32(16))) & wp.uint32(0x030000FF)
    v = (v | (v << wp.uint32(8))) & wp.uint32(0x0300F00F)
    v = (v | (v << wp.uint32(4))) & wp.uint32(0x030C30C3)
    v = (v | (v << wp.uint32(2))) & wp.uint32(0x09249249)
    return v


@wp.func
def cell_of(x: wp.float64, lower: wp.float64, inverse_extent: wp.float64) -> wp.uint32:
    # Clamped as a float: an int cast of a far-away coordinate would be undefined.
    u = wp.clamp((x - lower) * inverse_extent, wp.float64(0.0), wp.float64(1.0))
    return wp.uint32(u * wp.float64(1023.0))


@wp.kernel
def morton_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    lower: wp.vec3d,
    inverse_extent: wp.float64,
    out_key: wp.array(dtype=int),
    out_index: wp.array(dtype=int),
):
    i = first + wp.tid()
    p = points[i]
    x = cell_of(p[0], lower[0], inverse_extent)
    y = cell_of(p[1], lower[1], inverse_extent)
    z = cell_of(p[2], lower[2], inverse_extent)
    out_key[i] = int(spread_bits(x) | (spread_bits(y) << wp.uint32(1)) | (spread_bits(z) << wp.uint32(2)))
    out_index[i] = i


@wp.kernel
def identity_kernel(first: int, out_index: wp.array(dtype=int)):
    i = first + wp.tid()
    out_index[i] = i


@wp.func_native(f"""
#if !defined(__CUDA_ARCH__)
    const int next = at + {AHEAD};
    if (next < points.shape[0]) __builtin_prefetch(points.data + order.data[next]);
    if (next < points.shape[0]) __builtin_prefetch((const char*)(points.data + order.data[next] + 1) - 1);
#endif
""")
def prefetch_query(points: wp.array(dtype=wp.vec3d), order: wp.array(dtype=int), at: int):
    """On a CPU prefetches the query AHEAD places after the one at this place of the order; on a GPU does nothing.

    Consecutive queries of the order lie anywhere in memory: waiting for each took a fifth of the time of a closest
    point near the surface.
    """
    ...
