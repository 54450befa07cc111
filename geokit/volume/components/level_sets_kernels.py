"""Distances to one component of a level set, from the voxels whose values are not those of another component.

Rows, elements and bits are those of ``leaf_neighbors_kernels``; a row is a leaf around one component.
"""

# mypy: ignore-errors
import warp as wp

from geokit.volume.level_set.feature_transform_kernels import distance_from
from geokit.volume.level_set.features_kernels import Features
from geokit.volume.level_set.leaf_neighbors_kernels import bit_of, place

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

# A surface runs within the diagonal of a cell from a voxel inside.
DIAGONAL = wp.constant(wp.float64(1.7320508075688772))
# Least slope of distances where the surface is smooth; next to edges, differences mix the faces.
CLEAN = wp.constant(wp.float64(0.97))
# Penalty [voxels] of the foot of a feature whose direction is in doubt.
DOUBT = wp.constant(wp.float64(3.0))
# Feet count as equally near within this length [voxels]; features are a voxel apart.
SAME_WAY = wp.constant(wp.float64(0.5))
# Farthest that a voxel is to the side of the nearest foot [voxels], as long as the surface does not end in between.
ASIDE = wp.constant(wp.float64(1.0))
# The same where features next to edges are in doubt.
FAR_ASIDE = wp.constant(wp.float64(1.2))


@wp.kernel
def trust_kernel(
    first: int,
    values: wp.array(dtype=wp.float64),
    near: wp.array(dtype=wp.uint64),
    others: wp.array(dtype=wp.uint64),
    reach: wp.float64,
    voxel_size: wp.float64,
    out_trusted: wp.array(dtype=wp.uint64),
):
    """Adds outside voxels whose value is the distance to this component.

    They have a voxel inside it, and none inside another component, within ``reach`` voxels along each axis. So any
    other component is at least ``reach`` + 1 voxels minus a cell's diagonal away.
    """
    i = first + wp.tid()
    word = near[i] & ~others[i]
    farthest = (reach + wp.float64(1.0) - DIAGONAL) * voxel_size
    for n in range(64):
        bit = wp.uint64(1) << wp.uint64(n)
        if (word & bit) != wp.uint64(0) and values[(i << 6) + n] >= wp.float64(0.0):
            if values[(i << 6) + n] <= farthest:
                out_trusted[i] = out_trusted[i] | bit


@wp.func
def slope_squared(
    values: wp.array(dtype=wp.float64), beside: wp.array2d(dtype=int), t: int, x: int, y: int, z: int
) -> wp.float64:
    """Square of the gradient by central differences [value units]."""
    total = wp.float64(0.0)
    for e in range(3):
        a = wp.where(e == 0, 1, 0)
        b = wp.where(e == 1, 1, 0)
        c = wp.where(e == 2, 1, 0)
        high = place(beside, t, x + a, y + b, z + c)
        low = place(beside, t, x - a, y - b, z - c)
        if high >= 0 and low >= 0:
            rise = wp.float64(0.5) * (values[high] - values[low])
            total += rise * rise
    return total


@wp.kernel
def doubt_kernel(
    first: int,
    values: wp.array(dtype=wp.float64),
    enclosed: wp.array(dtype=wp.uint64),
    beside: wp.array2d(dtype=int),
    nearest: wp.array(dtype=int),
    voxel_size: wp.float64,
    out_feet: wp.array(dtype=wp.vec4d),
):
    """Penalty for features near an edge, where the field's slope is not 1, and for those with unknown neighbors."""
    i = first + wp.tid()
    for n in range(64):
        at = (i << 6) + n
        if nearest[at] >= 0:
            least = voxel_size * CLEAN
            if not bit_of(enclosed, at) or slope_squared(values, beside, i >> 3, i & 7, n >> 3, n & 7) < least * least:
                foot = out_feet[nearest[at] >> 1]
                foot[3] = foot[3] + DOUBT
                out_feet[nearest[at] >> 1] = foot


@wp.func
def outward_distance(features: Features, name: int, voxel: wp.vec3i) -> wp.float64:
    """Signed distance of a voxel on either side from the surface that a feature represents, positive outside."""
    distance = distance_from(features, name, voxel)
    if (name & 1) != 0:
        distance = -distance
    return distance


@wp.func
def way_to(feet: wp.array(dtype=wp.vec4d), name: int, point: wp.vec3d) -> wp.float64:
    """Distance of a point from a feature's foot, without its penalty."""
    foot = feet[name >> 1]
    return wp.length(point - wp.vec3d(foot[0], foot[1], foot[2]))


@wp.kernel
def extend_kernel(
    first: int,
    tiles: wp.array(dtype=wp.vec3i),
    own: wp.array(dtype=wp.uint64),
    known: wp.array(dtype=wp.uint64),
    near: wp.array(dtype=wp.uint64),
    beside: wp.array2d(dtype=int),
    nearest: wp.array(dtype=int),
    features: Features,
    feet: wp.array(dtype=wp.vec4d),
    background: wp.float64,
    voxel_size: wp.float64,
    out_values: wp.array(dtype=wp.float64),
    out_known: wp.array(dtype=wp.uint64),
):
    """Extrapolates to voxels outside near the component, and forgets the values of all others that are not known.

    The value is the largest distance to the pieces of surface whose feet are nearest: beyond a convex edge, the body
    lies behind all of its faces. Without a direction nearby, it is the distance to the largest ball around a neighbor
    that fits inside.
    """
    i = first + wp.tid()
    t = i >> 3
    todo = ~own[i] & ~known[i]
    found = known[i]
    for n in range(64):
        bit = wp.uint64(1) << wp.uint64(n)
        if (todo & bit) != wp.uint64(0):
            at = (i << 6) + n
            x = i & 7
            y = n >> 3
            z = n & 7
            voxel = 8 * tiles[t] + wp.vec3i(x, y, z)
            place_of = wp.vec3d(voxel)
            here = wp.abs(out_values[at])
            value = background
            if (near[i] & bit) != wp.uint64(0):
                shortest = wp.float64(wp.inf)
                foot_way = wp.float64(wp.inf)
                highest = wp.float64(-wp.inf)
                ball = wp.float64(wp.inf)
                for step in range(2):
                    for m in range(343):
                        a = m / 49 - 3
                        b = m / 7 % 7 - 3
                        c = m % 7 - 3
                        other = place(beside, t, x + a, y + b, z + c)
                        if other >= 0:
                            name = nearest[other]
                            if name >= 0:
                                f = name >> 1
                                if wp.length_sq(features.normal[f]) > wp.float32(0.0):
                                    way = way_to(feet, name, place_of)
                                    foot_way = wp.min(foot_way, way)
                                    way += feet[f][3]
                                    if step == 0:
                                        shortest = wp.min(shortest, way)
                                    elif way < shortest + SAME_WAY:
                                        highest = wp.max(highest, outward_distance(features, name, voxel))
                            if step == 0 and bit_of(own, other) and bit_of(known, other):
                                length = wp.sqrt(wp.float64(a * a + b * b + c * c))
                                ball = wp.min(ball, out_values[other] + length * voxel_size)
                if wp.isfinite(shortest):
                    if foot_way > FAR_ASIDE:
                        highest = wp.max(highest, wp.sqrt(foot_way * foot_way - FAR_ASIDE * FAR_ASIDE))
                    ball = wp.min(ball, highest * voxel_size)
                if wp.isfinite(ball):
                    # No component is nearer than the level set's own value tells, outside or inside another one.
                    value = wp.max(ball, here)
                    found = found | bit
            out_values[at] = value
    out_known[i] = found


@wp.kernel
def distances_kernel(
    first: int,
    tiles: wp.array(dtype=wp.vec3i),
    beside: wp.array2d(dtype=int),
    values: wp.array(dtype=wp.float64),
    own: wp.array(dtype=wp.uint64),
    trusted: wp.array(dtype=wp.uint64),
    nearest: wp.array(dtype=int),
    features: Features,
    feet: wp.array(dtype=wp.vec4d),
    voxel_size: wp.float64,
    out_distance: wp.array(dtype=wp.float32),
):
    """Distance [voxels] of the voxels outside to this component; infinite where no feature reaches.

    No component is nearer than the level set's own value tells, outside or inside another one. Nor is it much nearer
    than the nearest foot: a feature's piece of surface ends at edges.
    """
    i = first + wp.tid()
    for n in range(64):
        at = (i << 6) + n
        bit = wp.uint64(1) << wp.uint64(n)
        distance = wp.float64(wp.inf)
        known = wp.abs(values[at]) / voxel_size
        if (trusted[i] & bit) != wp.uint64(0):
            distance = known
        elif (own[i] & bit) == wp.uint64(0) and nearest[at] >= 0:
            voxel = 8 * tiles[i >> 3] + wp.vec3i(i & 7, n >> 3, n & 7)
            best = nearest[at]
            shortest = way_to(feet, best, wp.vec3d(voxel)) + feet[best >> 1][3]
            for m in range(27):
                other = place(beside, i >> 3, (i & 7) + m / 9 - 1, (n >> 3) + m / 3 % 3 - 1, (n & 7) + m % 3 - 1)
                if other >= 0:
                    name = nearest[other]
                    if name >= 0 and name != best and (name & 1) == 0:
                        way = way_to(feet, name, wp.vec3d(voxel)) + feet[name >> 1][3]
                        if way < shortest:
                            shortest = way
                            best = name
            distance = wp.max(distance_from(features, best, voxel), known)
            if wp.length_sq(features.normal[best >> 1]) > wp.float32(0.0):
                way = way_to(feet, best, wp.vec3d(voxel))
                if way > ASIDE:
                    distance = wp.max(distance, wp.sqrt(way * way - ASIDE * ASIDE))
        out_distance[at] = wp.float32(distance)
