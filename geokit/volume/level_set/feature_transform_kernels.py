"""Feature transform: extends distances beyond known voxels, from the nearest feature (``features_kernels``).

In rounds, every voxel takes the feature with the nearest foot among those of its 26 neighbors on its own side, until no
voxel changes. Its distance is that to the feature's piece of surface.
"""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.volume.level_set.features_kernels import Features
from geokit.volume.level_set.leaf_neighbors_kernels import bit_of
from geokit.volume.level_set.mask_dilation_kernels import cube_around

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})


@wp.kernel
def reached_box_kernel(first: int, reached: wp.array(dtype=wp.uint64), out_box: wp.array2d(dtype=int)):
    """Bounding box of a leaf's set bits: first and last voxel; 8 and -1 if no bit is set."""
    t = first + wp.tid()
    lowest = wp.vec3i(8, 8, 8)
    highest = wp.vec3i(-1, -1, -1)
    for n in range(512):
        if bit_of(reached, (t << 9) + n):
            c = wp.vec3i(n >> 6, (n >> 3) & 7, n & 7)
            lowest = wp.min(lowest, c)
            highest = wp.max(highest, c)
    for e in range(3):
        out_box[t, e] = lowest[e]
        out_box[t, 3 + e] = highest[e]


@wp.kernel
def has_changed_kernel(
    first: int,
    changed: wp.array(dtype=wp.uint64),
    out_has_changed: wp.array(dtype=wp.uint8),
):
    """1 for leaves with changed voxels."""
    t = first + wp.tid()
    some = wp.uint64(0)
    for x in range(8):
        some = some | changed[8 * t + x]
    out_has_changed[t] = wp.uint8(wp.where(some != wp.uint64(0), 1, 0))


@cpp.func_native("volume/level_set/feature_transform.inl")
def nearest_of(beside: wp.array2d(dtype=int)) -> int:
    """The feature with the nearest foot to voxel (x, y, z) of row t, which is (i, j, k); the first of equal ones.

    Candidates are its own feature and those of its changed neighbors on its side, if nearer than ``reach``.
    """
    ...


@wp.kernel
def spread_kernel(
    first: int,
    tiles: wp.array(dtype=wp.vec3i),
    beside: wp.array2d(dtype=int),
    inside: wp.array(dtype=wp.uint64),
    still: wp.array(dtype=wp.uint64),
    feet: wp.array(dtype=wp.vec4d),
    reach: wp.float32,
    nearest: wp.array(dtype=int),
    changed: wp.array(dtype=wp.uint64),
    has_changed: wp.array(dtype=wp.uint8),
    reached: wp.array(dtype=wp.uint64),
    out_next: wp.array(dtype=int),
    out_changed: wp.array(dtype=wp.uint64),
):
    """One round for the voxels of a plane: each takes the feature with the nearest foot, the first of equal ones.

    Only neighbors that changed in the last round can have a nearer one. If a voxel changes, its bit is set and
    ``out_next`` holds its new feature.
    """
    i = first + wp.tid()
    t = i >> 3
    x = i & 7
    awake = wp.uint8(0)
    for m in range(27):
        row = beside[t, m]
        if row >= 0:
            awake = awake | has_changed[row]
    todo = wp.uint64(0)
    if awake != wp.uint8(0):
        todo = ~still[i] & (changed[i] | ~reached[i])
        if todo != wp.uint64(0):
            todo = todo & cube_around(changed, wp.uint64(0), beside, t, x)
    word = wp.uint64(0)
    if todo != wp.uint64(0):
        corner = 8 * tiles[t]
        for n in range(64):
            bit = wp.uint64(1) << wp.uint64(n)
            if (todo & bit) != wp.uint64(0):
                at = (i << 6) + n
                side = wp.where(bit_of(inside, at), 1, 0)
                v = wp.vec3d(corner + wp.vec3i(x, n >> 3, n & 7))
                best = nearest_of(nearest, changed, beside, feet, reach, side, t, x, n >> 3, n & 7, v[0], v[1], v[2])
                if best != nearest[at]:
                    word = word | bit
                    out_next[at] = best
    out_changed[i] = word


@wp.kernel
def take_kernel(
    first: int,
    changed: wp.array(dtype=wp.uint64),
    next: wp.array(dtype=int),
    out_nearest: wp.array(dtype=int),
    out_reached: wp.array(dtype=wp.uint64),
):
    """End of a round: voxels that change take their new features."""
    i = first + wp.tid()
    word = changed[i]
    if word != wp.uint64(0):
        out_reached[i] = out_reached[i] | word
        for n in range(64):
            if ((word >> wp.uint64(n)) & wp.uint64(1)) != wp.uint64(0):
                out_nearest[(i << 6) + n] = next[(i << 6) + n]


@wp.func
def distance_from(features: Features, name: int, voxel: wp.vec3i) -> wp.float64:
    """Distance [voxels] of a voxel from the piece of surface that a feature represents.

    The level set at the feature's voxel is approximated by a sphere with its normal curvature towards the voxel.
    """
    f = name >> 1
    step = voxel - features.voxel[f]
    r = wp.vec3d(wp.float64(step[0]), wp.float64(step[1]), wp.float64(step[2]))
    n = wp.vec3d(features.normal[f])
    result = features.distance[f] + wp.length(r)
    if wp.length_sq(n) > wp.float64(0.0):
        h = wp.dot(n, r)
        a = r - n * h
        across = wp.length_sq(a)
        k = wp.float64(0.0)
        if across > wp.float64(0.0):
            c = features.curve[f]
            k = (
                wp.float64(c[0]) * a[0] * a[0]
                + wp.float64(c[1]) * a[1] * a[1]
                + wp.float64(c[2]) * a[2] * a[2]
                + wp.float64(2.0)
                * (wp.float64(c[3]) * a[0] * a[1] + wp.float64(c[4]) * a[0] * a[2] + wp.float64(c[5]) * a[1] * a[2])
            ) / across
        u = wp.float64(1.0) + k * h
        root = wp.sqrt(u * u + k * k * across)
        result = features.distance[f] + (wp.float64(2.0) * h + k * (h * h + across)) / (root + wp.float64(1.0))
    return result


@wp.kernel
def fill_kernel(
    first: int,
    tiles: wp.array(dtype=wp.vec3i),
    inside: wp.array(dtype=wp.uint64),
    held: wp.array(dtype=wp.uint64),
    known: wp.array(dtype=wp.float64),
    nearest: wp.array(dtype=int),
    features: Features,
    voxel_size: wp.float64,
    least: wp.float64,
    background: wp.float64,
    out_value: wp.array(dtype=Any),
    out_active: wp.array(dtype=wp.uint64),
    out_inside: wp.array(dtype=wp.uint64),
):
    """Values and active voxels of a plane: held values, else distances if they are below the background.

    No distance is less than ``least`` [voxels]: where two surfaces meet, directions of features do not tell it.
    """
    i = first + wp.tid()
    active = wp.uint64(0)
    negative = wp.uint64(0)
    for n in range(64):
        at = (i << 6) + n
        bit = wp.uint64(1) << wp.uint64(n)
        value = background
        if bit_of(inside, at):
            value = -background
        if bit_of(held, at):
            value = known[at]
        elif nearest[at] >= 0:
            distance = voxel_size * distance_from(
                features, nearest[at], 8 * tiles[i >> 3] + wp.vec3i(i & 7, n >> 3, n & 7)
            )
            distance = wp.max(distance, voxel_size * least)
            value = distance
            if bit_of(inside, at):
                value = -distance
        # The stored value decides, because rounding may lift a value to the background.
        stored = out_value.dtype(value)
        if wp.abs(wp.float64(stored)) < background:
            active = active | bit
        elif value < wp.float64(0.0):
            stored = out_value.dtype(-background)
        else:
            stored = out_value.dtype(background)
        if stored < out_value.dtype(0.0):
            negative = negative | bit
        out_value[at] = stored
    out_active[i] = active
    out_inside[i] = negative


FILL = {kind: wp.overload(fill_kernel, {"out_value": wp.array(dtype=kind)}) for kind in (wp.float32, wp.float64)}


@wp.kernel
def reached_kernel(first: int, nearest: wp.array(dtype=int), out_reached: wp.array(dtype=wp.uint64)):
    """Bit masks of the voxels that have a feature."""
    i = first + wp.tid()
    word = wp.uint64(0)
    for n in range(64):
        if nearest[(i << 6) + n] >= 0:
            word = word | (wp.uint64(1) << wp.uint64(n))
    out_reached[i] = word
