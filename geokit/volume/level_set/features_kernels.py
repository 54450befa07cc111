"""Features: voxels of known distance that represent the piece of surface next to them.

A **feature** is a voxel with the direction and the curvature of the field there. Its foot is its foot point on the
surface: three coordinates [voxels] and a penalty, which is added to lengths and is 0 where the direction is well known.
``leaf_neighbors_kernels`` defines rows, elements and bits. Arrays of elements hold ``2 f + side`` for feature f, where
side is 1 inside, and -1 for no feature.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core.scan_kernels import begin_of
from geokit.volume.level_set.leaf_neighbors_kernels import bit_of, place
from geokit.volume.level_set.mask_dilation_kernels import cube_around

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

# If the central slope is below this share of the upwind slope, fronts from two directions meet. The share is 1 where
# the field is smooth, 0.71 or less where the directions differ by 90 degrees.
KINK = wp.constant(wp.float64(0.8))
# Penalty [voxels] of a foot whose direction comes from neighbors on one side only. A feature with a better direction
# gives a better distance, even if it lies a voxel to the side.
ONE_SIDED = wp.constant(wp.float64(0.2))
# Penalty [voxels] where no direction is known: distances are right straight ahead and too long to the sides.
LAST_RESORT = wp.constant(wp.float64(1.5))

# Tikhonov term of the fit; the sums of squares of neighbors' steps are 1 and more.
RIDGE = wp.constant(wp.float64(1e-3))

vec6d = wp.types.vector(length=6, dtype=wp.float64)
vec6f = wp.types.vector(length=6, dtype=wp.float32)


@wp.struct
class Features:
    """Features as arrays; lengths in voxels. The distance grows along ``normal`` on either side of the surface."""

    voxel: wp.array(dtype=wp.vec3i)
    # Zero where no foot was found.
    normal: wp.array(dtype=wp.vec3f)
    distance: wp.array(dtype=wp.float64)
    # Second derivatives xx, yy, zz, xy, xz, yz, divided by the slope.
    curve: wp.array(dtype=vec6f)


@wp.kernel
def enclosed_kernel(
    first: int,
    held: wp.array(dtype=wp.uint64),
    active: wp.array(dtype=wp.uint64),
    inside: wp.array(dtype=wp.uint64),
    beside: wp.array2d(dtype=int),
    out_enclosed: wp.array(dtype=wp.uint64),
    out_inner: wp.array(dtype=wp.uint64),
    out_outer: wp.array(dtype=wp.uint64),
):
    """Held voxels whose neighbors are all active, as central differences need: all of them, and those on each side."""
    i = first + wp.tid()
    word = held[i]
    if word != wp.uint64(0):
        word = word & ~cube_around(active, ~wp.uint64(0), beside, i >> 3, i & 7)
    out_enclosed[i] = word
    out_inner[i] = word & inside[i]
    out_outer[i] = word & ~inside[i]


@wp.kernel
def border_kernel(
    first: int,
    held: wp.array(dtype=wp.uint64),
    enclosed: wp.array(dtype=wp.uint64),
    beside: wp.array2d(dtype=int),
    out_border: wp.array(dtype=wp.uint64),
):
    """Held voxels that are not enclosed or are adjacent to such a voxel: the outer layers of a band."""
    i = first + wp.tid()
    word = held[i]
    if word != wp.uint64(0):
        word = word & cube_around(enclosed, ~wp.uint64(0), beside, i >> 3, i & 7)
    out_border[i] = word


@wp.kernel
def chosen_kernel(
    first: int,
    border: wp.array(dtype=wp.uint64),
    inner: wp.array(dtype=wp.uint64),
    outer: wp.array(dtype=wp.uint64),
    inside: wp.array(dtype=wp.uint64),
    known: wp.array(dtype=wp.float64),
    beside: wp.array2d(dtype=int),
    out_chosen: wp.array(dtype=wp.uint64),
    out_count: wp.array(dtype=int),
):
    """Voxels that become features: enclosed ones, and others without an enclosed neighbor on their side."""
    i = first + wp.tid()
    word = border[i]
    if word != wp.uint64(0):
        t = i >> 3
        near = inside[i] & cube_around(inner, wp.uint64(0), beside, t, i & 7)
        near = near | (~inside[i] & cube_around(outer, wp.uint64(0), beside, t, i & 7))
        word = word & (inner[i] | outer[i] | ~near)
    count = int(0)
    for n in range(64):
        bit = wp.uint64(1) << wp.uint64(n)
        if (word & bit) != wp.uint64(0):
            if wp.isfinite(known[(i << 6) + n]):
                count += 1
            else:
                word = word & ~bit
    out_chosen[i] = word
    out_count[i] = count


@wp.struct
class Around:
    """The field around voxel ``c`` of row ``t``; ``side`` is -1 inside."""

    values: wp.array(dtype=wp.float64)
    active: wp.array(dtype=wp.uint64)
    beside: wp.array2d(dtype=int)
    t: int
    c: wp.vec3i
    side: wp.float64


@wp.func
def outward(field: Around, i: int, j: int, k: int) -> wp.float64:
    """The field (i, j, k) voxels from the voxel, positive away from the surface; infinite if unknown."""
    at = place(field.beside, field.t, field.c[0] + i, field.c[1] + j, field.c[2] + k)
    value = wp.float64(wp.inf)
    if bit_of(field.active, at):
        value = field.side * field.values[at]
    return value


@wp.struct
class Derivatives:
    """Derivatives at a voxel of the field that is positive away from the surface."""

    gradient: wp.vec3d
    # Second derivatives xx, yy, zz, xy, xz, yz.
    curve: vec6d


@wp.func
def upwind(low: wp.float64, here: wp.float64, high: wp.float64) -> wp.float64:
    """The square of the derivative towards the surface."""
    back = wp.float64(0.0)
    front = wp.float64(0.0)
    if wp.isfinite(low):
        back = wp.max(here - low, wp.float64(0.0))
    if wp.isfinite(high):
        front = wp.min(high - here, wp.float64(0.0))
    return wp.max(back * back, front * front)


@wp.func
def mixed_derivative(field: Around, a: wp.vec3i, b: wp.vec3i) -> wp.float64:
    """The second derivative along two axes, by their unit steps."""
    low = a - b
    high = a + b
    return wp.float64(0.25) * (
        outward(field, -high[0], -high[1], -high[2])
        - outward(field, -low[0], -low[1], -low[2])
        - outward(field, low[0], low[1], low[2])
        + outward(field, high[0], high[1], high[2])
    )


@wp.func
def central_derivatives(field: Around) -> Derivatives:
    """Derivatives by central differences; all neighbors must be active."""
    h = outward(field, 0, 0, 0)
    x0 = outward(field, -1, 0, 0)
    x1 = outward(field, 1, 0, 0)
    y0 = outward(field, 0, -1, 0)
    y1 = outward(field, 0, 1, 0)
    z0 = outward(field, 0, 0, -1)
    z1 = outward(field, 0, 0, 1)
    half = wp.float64(0.5)
    twice = wp.float64(2.0) * h
    found = Derivatives()
    found.gradient = half * wp.vec3d(x1 - x0, y1 - y0, z1 - z0)
    found.curve[0] = x0 - twice + x1
    found.curve[1] = y0 - twice + y1
    found.curve[2] = z0 - twice + z1
    x = wp.vec3i(1, 0, 0)
    y = wp.vec3i(0, 1, 0)
    z = wp.vec3i(0, 0, 1)
    found.curve[3] = mixed_derivative(field, x, y)
    found.curve[4] = mixed_derivative(field, x, z)
    found.curve[5] = mixed_derivative(field, y, z)
    return found


@wp.func
def fitted_derivatives(field: Around) -> Derivatives:
    """Derivatives by least squares over active neighbors: a gradient, then a gradient and one curvature across it."""
    h = outward(field, 0, 0, 0)
    across = wp.vec3d()
    g = wp.vec4d()
    for round in range(2):
        # Directions without data get no slope, and without a first direction there is no curvature.
        system = RIDGE * wp.identity(4, dtype=wp.float64)
        right = wp.vec4d()
        for n in range(27):
            value = outward(field, n / 9 - 1, n / 3 % 3 - 1, n % 3 - 1)
            if wp.isfinite(value) and n != 13:
                d = wp.vec3d(wp.float64(n / 9 - 1), wp.float64(n / 3 % 3 - 1), wp.float64(n % 3 - 1))
                bend = wp.float64(0.0)
                if round == 1:
                    bend = wp.float64(0.5) * (wp.length_sq(d) - wp.dot(across, d) * wp.dot(across, d))
                row = wp.vec4d(d[0], d[1], d[2], bend)
                system += wp.outer(row, row)
                right += (value - h) * row
        g = wp.inverse(system) * right
        across = wp.normalize(wp.vec3d(g[0], g[1], g[2]))
    found = Derivatives()
    found.gradient = wp.vec3d(g[0], g[1], g[2])
    for e in range(3):
        found.curve[e] = g[3] * (wp.float64(1.0) - across[e] * across[e])
    found.curve[3] = -g[3] * across[0] * across[1]
    found.curve[4] = -g[3] * across[0] * across[2]
    found.curve[5] = -g[3] * across[1] * across[2]
    return found


@wp.func
def is_smooth(field: Around, slope: wp.float64) -> bool:
    """Whether a voxel's slope is as large as the upwind slope, so that fronts from one direction only reach it."""
    h = outward(field, 0, 0, 0)
    up = wp.float64(0.0)
    for e in range(3):
        a = wp.where(e == 0, 1, 0)
        b = wp.where(e == 1, 1, 0)
        d = wp.where(e == 2, 1, 0)
        low = outward(field, -a, -b, -d)
        high = outward(field, a, b, d)
        up += upwind(low, h, high)
    return wp.isfinite(slope) and slope > wp.float64(0.0) and slope > KINK * wp.sqrt(up)


@wp.kernel
def features_kernel(
    first: int,
    values: wp.array(dtype=wp.float64),
    active: wp.array(dtype=wp.uint64),
    inside: wp.array(dtype=wp.uint64),
    beside: wp.array2d(dtype=int),
    tiles: wp.array(dtype=wp.vec3i),
    known: wp.array(dtype=wp.float64),
    voxel_size: wp.float64,
    enclosed: wp.array(dtype=wp.uint64),
    chosen: wp.array(dtype=wp.uint64),
    ends: wp.array(dtype=int),
    features: Features,
    feet: wp.array(dtype=wp.vec4d),
    out_nearest: wp.array(dtype=int),
):
    """Writes the features of a plane, and their names at their own voxels."""
    i = first + wp.tid()
    f = begin_of(ends, i)
    field = Around()
    field.values = values
    field.active = active
    field.beside = beside
    field.t = i >> 3
    for n in range(64):
        at = (i << 6) + n
        if bit_of(chosen, at):
            name = 2 * f
            field.side = wp.float64(1.0)
            if bit_of(inside, at):
                name += 1
                field.side = wp.float64(-1.0)
            distance = wp.abs(known[at]) / voxel_size
            field.c = wp.vec3i(i & 7, n >> 3, n & 7)
            weight = wp.float64(0.0)
            if bit_of(enclosed, at):
                found = central_derivatives(field)
            else:
                found = fitted_derivatives(field)
                weight = ONE_SIDED
            slope = wp.length(found.gradient)
            voxel = 8 * tiles[field.t] + field.c
            foot = wp.vec3d(voxel)
            normal = wp.vec3f()
            curve = vec6f()
            if is_smooth(field, slope):
                foot -= found.gradient * (distance / slope)
                normal = wp.vec3f(found.gradient / slope)
                for e in range(6):
                    curve[e] = wp.float32(found.curve[e] / slope)
            else:
                weight = distance + LAST_RESORT
            features.voxel[f] = voxel
            features.normal[f] = normal
            features.distance[f] = distance
            features.curve[f] = curve
            feet[f] = wp.vec4d(foot[0], foot[1], foot[2], weight)
            out_nearest[at] = name
            f += 1


@wp.kernel
def still_kernel(
    first: int,
    enclosed: wp.array(dtype=wp.uint64),
    chosen: wp.array(dtype=wp.uint64),
    out_still: wp.array(dtype=wp.uint64),
):
    i = first + wp.tid()
    out_still[i] = enclosed[i] | chosen[i]


@wp.kernel
def straighten_kernel(
    first: int,
    chosen: wp.array(dtype=wp.uint64),
    ends: wp.array(dtype=int),
    rise: wp.array(dtype=wp.vec3f),
    features: Features,
    feet: wp.array(dtype=wp.vec4d),
):
    """Corrects the directions of features for a field whose slope changes.

    The field is the distance times the slope. So its gradient is the slope times the distance's direction, plus the
    distance times the gradient of the slope; ``rise`` is the latter gradient divided by the slope.
    """
    i = first + wp.tid()
    f = begin_of(ends, i)
    for n in range(64):
        at = (i << 6) + n
        if bit_of(chosen, at):
            direction = wp.vec3d(features.normal[f])
            if wp.length_sq(direction) > wp.float64(0.0):
                distance = features.distance[f]
                turned = wp.normalize(direction - distance * wp.vec3d(rise[at]))
                foot = wp.vec3d(features.voxel[f]) - distance * turned
                features.normal[f] = wp.vec3f(turned)
                feet[f] = wp.vec4d(foot[0], foot[1], foot[2], feet[f][3])
            f += 1
