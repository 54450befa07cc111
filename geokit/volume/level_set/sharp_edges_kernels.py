"""Distances of an eroded body beyond its sharp edges, where the nearest point of the body is on an edge.

A body that grows is one whose outside is eroded: its heights have the other sign.

Heights are values minus the isovalue, in voxels: negative in the body, and never above the distance outside if the
field is one of distances. ``leaf_neighbors_kernels`` defines rows, elements and bits.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core.scan_kernels import begin_of
from geokit.volume.level_set.feature_transform_kernels import distance_from
from geokit.volume.level_set.features_kernels import Features
from geokit.volume.level_set.leaf_neighbors_kernels import bit_of, value_at
from geokit.volume.nanovdb.read_voxel_kernels import grid_type_of, node_of, read_cell, read_voxel, vec8d

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

# A voxel is sound if its slope is this close to 1: the field holds distances there, and differences cross no edge.
SLOPE_ERROR = wp.constant(wp.float64(0.04))
# Distance [voxels] from the surface up to which voxels tell whether the field holds distances.
CLOSE = wp.constant(wp.float64(1.5))
# Largest second difference [1/voxel], on the straighter side, of a sound voxel.
MOST_BENT = wp.constant(wp.float64(0.3))
# Height [voxels] of the foot of a voxel whose nearest point is not on an edge; a radius of 2.5 voxels bends the
# interpolant by as much.
FOOT_ERROR = wp.constant(wp.float64(0.1))
# Distances that differ by less [voxels] are left as they are.
CHANGE = wp.constant(wp.float64(0.1))
# Most voxels whose tangent planes bound the body in a cell: a window of four along each axis.
MOST_PLANES = wp.constant(64)
# Distance [voxels] between such a voxel and the cell's center, squared.
FARTHEST_SQUARED = wp.constant(wp.float64(2.3 * 2.3))
# Planes count as one if the cosine of their angle (2 degrees) and their offset [voxels] differ by less from it.
SAME_DIRECTION = wp.constant(wp.float64(0.9995))
SAME_PLANE = wp.constant(wp.float64(0.01))
# A plane counts if one of another voxel, at most 20 degrees from it, has the same height [voxels] at its voxel: next to
# thin edges differences along the axes may belong to different faces.
LIKE_DIRECTION = wp.constant(wp.float64(0.94))
LIKE_PLANE = wp.constant(wp.float64(0.15))
# Fewest sound voxels in a window; with less, the field holds no distances there.
LEAST_SOUND = wp.constant(8)
# Sweeps of the projection, and the step [voxels] at which it ends.
SWEEPS = wp.constant(60)
LAST_STEP = wp.constant(wp.float64(1e-4))
# The projection is not trusted if it is farther [voxels] from the nearest point of the mesh, or the interpolant is
# higher there: it rounds off the corner of a cube by up to 0.6 voxel.
FARTHEST_STEP = wp.constant(wp.float64(2.2))
HIGHEST_FOOT = wp.constant(wp.float64(0.8))
# Error of the mesh's distances [voxels] at edges.
MESH_ERROR = wp.constant(wp.float64(0.5))

vec64d = wp.types.vector(length=64, dtype=wp.float64)


@wp.struct
class Field:
    """A volume whose isosurface is the surface of the body."""

    volume: wp.uint64
    # Width of its band, and isovalue [world].
    background: wp.float64
    isovalue: wp.float64
    # Voxel size [world]; negative where the body is the outside.
    scale: wp.float64


@wp.func
def raw_at(field: Field, i: int, j: int, k: int) -> wp.float64:
    kind = grid_type_of(field.volume)
    node = node_of(field.volume, kind, i, j, k)
    return read_voxel(field.volume, kind, node, i, j, k, wp.float64(0.0))


@wp.func
def height_at(field: Field, i: int, j: int, k: int) -> wp.float64:
    return (raw_at(field, i, j, k) - field.isovalue) / field.scale


@wp.func
def height_of(field: Field, p: wp.vec3d) -> wp.float64:
    """Height of the trilinear interpolant."""
    i = int(wp.floor(p[0]))
    j = int(wp.floor(p[1]))
    k = int(wp.floor(p[2]))
    a = p - wp.vec3d(wp.float64(i), wp.float64(j), wp.float64(k))
    c0, c1, c2, c3, c4, c5, c6, c7 = read_cell(field.volume, i, j, k, wp.float64(0.0))
    raw = vec8d(c0, c1, c2, c3, c4, c5, c6, c7)
    total = wp.float64(0.0)
    for n in range(8):
        x = n >> 2
        y = (n >> 1) & 1
        z = n & 1
        weight = (
            wp.where(x == 1, a[0], wp.float64(1.0) - a[0])
            * wp.where(y == 1, a[1], wp.float64(1.0) - a[1])
            * wp.where(z == 1, a[2], wp.float64(1.0) - a[2])
        )
        total += weight * ((raw[n] - field.isovalue) / field.scale)
    return total


@wp.func
def straight_slope(a: wp.float64, b: wp.float64, c: wp.float64, d: wp.float64, e: wp.float64) -> wp.vec2d:
    """Slope at the middle of five values, from the side on which they are straighter, and the bend of that side."""
    lower = c - wp.float64(2.0) * b + a
    upper = e - wp.float64(2.0) * d + c
    result = wp.vec2d(d - c - wp.float64(0.5) * upper, wp.abs(upper))
    if wp.abs(lower) < wp.abs(upper):
        result = wp.vec2d(c - b + wp.float64(0.5) * lower, wp.abs(lower))
    return result


@wp.func
def is_sound(x: wp.vec2d, y: wp.vec2d, z: wp.vec2d) -> bool:
    """Whether slopes along the axes are those of a distance."""
    bend = wp.max(x[1], wp.max(y[1], z[1]))
    length = wp.length(wp.vec3d(x[0], y[0], z[0]))
    return bend < MOST_BENT and wp.abs(length - wp.float64(1.0)) < SLOPE_ERROR


@wp.func
def slope_in_row(
    values: wp.array(dtype=wp.float64),
    beside: wp.array2d(dtype=int),
    field: Field,
    t: int,
    c: wp.vec3i,
    axis: int,
    here: wp.float64,
) -> wp.vec2d:
    """Slope along an axis at voxel c of row t."""
    s = wp.vec3i(wp.where(axis == 0, 1, 0), wp.where(axis == 1, 1, 0), wp.where(axis == 2, 1, 0))
    outer = field.background - field.isovalue
    inner = -field.background - field.isovalue
    h = field.scale
    return straight_slope(
        value_at(values, beside, outer, inner, t, c[0] - 2 * s[0], c[1] - 2 * s[1], c[2] - 2 * s[2]) / h,
        value_at(values, beside, outer, inner, t, c[0] - s[0], c[1] - s[1], c[2] - s[2]) / h,
        here,
        value_at(values, beside, outer, inner, t, c[0] + s[0], c[1] + s[1], c[2] + s[2]) / h,
        value_at(values, beside, outer, inner, t, c[0] + 2 * s[0], c[1] + 2 * s[1], c[2] + 2 * s[2]) / h,
    )


@wp.func
def is_sound_at(
    values: wp.array(dtype=wp.float64), beside: wp.array2d(dtype=int), field: Field, t: int, c: wp.vec3i
) -> bool:
    """Whether voxel c of row t is sound."""
    outer = field.background - field.isovalue
    inner = -field.background - field.isovalue
    here = value_at(values, beside, outer, inner, t, c[0], c[1], c[2]) / field.scale
    return is_sound(
        slope_in_row(values, beside, field, t, c, 0, here),
        slope_in_row(values, beside, field, t, c, 1, here),
        slope_in_row(values, beside, field, t, c, 2, here),
    )


@wp.kernel
def sound_kernel(
    first: int,
    values: wp.array(dtype=wp.float64),
    active: wp.array(dtype=wp.uint64),
    beside: wp.array2d(dtype=int),
    field: Field,
    out_near: wp.array(dtype=int),
    out_sound: wp.array(dtype=int),
):
    """Numbers of voxels close to the surface in a plane, and of sound ones among them."""
    i = first + wp.tid()
    near = int(0)
    sound = int(0)
    for n in range(64):
        at = (i << 6) + n
        if bit_of(active, at) and wp.abs(values[at]) < CLOSE * wp.abs(field.scale):
            near += 1
            if is_sound_at(values, beside, field, i >> 3, wp.vec3i(i & 7, n >> 3, n & 7)):
                sound += 1
    out_near[i] = near
    out_sound[i] = sound


@wp.func
def has_sound_neighbor(
    values: wp.array(dtype=wp.float64), beside: wp.array2d(dtype=int), field: Field, t: int, c: wp.vec3i
) -> bool:
    """Whether the field holds distances around voxel c of row t, which need not be sound itself."""
    return (
        is_sound_at(values, beside, field, t, c + wp.vec3i(1, 0, 0))
        or is_sound_at(values, beside, field, t, c - wp.vec3i(1, 0, 0))
        or is_sound_at(values, beside, field, t, c + wp.vec3i(0, 1, 0))
        or is_sound_at(values, beside, field, t, c - wp.vec3i(0, 1, 0))
        or is_sound_at(values, beside, field, t, c + wp.vec3i(0, 0, 1))
        or is_sound_at(values, beside, field, t, c - wp.vec3i(0, 0, 1))
    )


@wp.func
def band_distance(
    known: wp.array(dtype=wp.float64),
    held: wp.array(dtype=wp.uint64),
    nearest: wp.array(dtype=int),
    features: Features,
    field: Field,
    tiles: wp.array(dtype=wp.vec3i),
    at: int,
) -> wp.float64:
    """Distance [voxels] that an element has so far."""
    distance = wp.float64(wp.inf)
    if bit_of(held, at):
        distance = wp.abs(known[at] / field.scale)
    elif nearest[at] >= 0:
        voxel = 8 * tiles[at >> 9] + wp.vec3i((at >> 6) & 7, (at >> 3) & 7, at & 7)
        distance = wp.max(distance_from(features, nearest[at], voxel), wp.float64(0.0))
    return distance


@wp.kernel
def beyond_edges_kernel(
    first: int,
    values: wp.array(dtype=wp.float64),
    active: wp.array(dtype=wp.uint64),
    tiles: wp.array(dtype=wp.vec3i),
    beside: wp.array2d(dtype=int),
    nearest: wp.array(dtype=int),
    features: Features,
    field: Field,
    half_width: wp.float64,
    out_known: wp.array(dtype=wp.float64),
    out_held: wp.array(dtype=wp.uint64),
    out_beyond: wp.array(dtype=wp.uint64),
    out_count: wp.array(dtype=int),
):
    """Marks the voxels of a plane whose nearest point may be on an edge: their foot is not on the surface.

    The height of the others is the distance, and so it is in the body; they are held with it where their distance
    differs.
    """
    i = first + wp.tid()
    t = i >> 3
    word = active[i]
    held = out_held[i]
    beyond = wp.uint64(0)
    count = int(0)
    for n in range(64):
        at = (i << 6) + n
        bit = wp.uint64(1) << wp.uint64(n)
        height = values[at] / field.scale
        if (word & bit) != wp.uint64(0) and height > -half_width:
            c = wp.vec3i(i & 7, n >> 3, n & 7)
            x = slope_in_row(values, beside, field, t, c, 0, height)
            y = slope_in_row(values, beside, field, t, c, 1, height)
            z = slope_in_row(values, beside, field, t, c, 2, height)
            sound = is_sound(x, y, z)
            if height < wp.float64(0.0):
                sound = sound or has_sound_neighbor(values, beside, field, t, c)
            else:
                v = 8 * tiles[t] + c
                normal = wp.normalize(wp.vec3d(x[0], y[0], z[0]))
                # Beyond the band only the height matters, which is too short at most.
                known = sound and height >= half_width
                if not known and sound:
                    known = wp.abs(height_of(field, wp.vec3d(v) - height * normal)) < FOOT_ERROR
                if not known:
                    beyond = beyond | bit
                    count += 1
                    sound = False
            if sound:
                distance = band_distance(out_known, out_held, nearest, features, field, tiles, at)
                if wp.abs(distance - wp.abs(height)) > CHANGE:
                    out_known[at] = values[at]
                    held = held | bit
        elif (word & bit) == wp.uint64(0) and nearest[at] >= 0 and height > half_width:
            # The field says that the voxel is beyond the new band.
            if band_distance(out_known, out_held, nearest, features, field, tiles, at) < half_width:
                beyond = beyond | bit
                count += 1
    out_held[i] = held
    out_beyond[i] = beyond
    out_count[i] = count


@wp.kernel
def list_kernel(
    first: int,
    tiles: wp.array(dtype=wp.vec3i),
    beyond: wp.array(dtype=wp.uint64),
    ends: wp.array(dtype=int),
    out_point: wp.array(dtype=wp.vec3d),
):
    """Positions [voxels] of the marked voxels of a plane."""
    i = first + wp.tid()
    k = begin_of(ends, i)
    word = beyond[i]
    if word != wp.uint64(0):
        for n in range(64):
            if ((word >> wp.uint64(n)) & wp.uint64(1)) != wp.uint64(0):
                out_point[k] = wp.vec3d(8 * tiles[i >> 3] + wp.vec3i(i & 7, n >> 3, n & 7))
                k += 1


@wp.func
def slope_of(field: Field, v: wp.vec3i, axis: int, here: wp.float64) -> wp.vec2d:
    s = wp.vec3i(wp.where(axis == 0, 1, 0), wp.where(axis == 1, 1, 0), wp.where(axis == 2, 1, 0))
    return straight_slope(
        height_at(field, v[0] - 2 * s[0], v[1] - 2 * s[1], v[2] - 2 * s[2]),
        height_at(field, v[0] - s[0], v[1] - s[1], v[2] - s[2]),
        here,
        height_at(field, v[0] + s[0], v[1] + s[1], v[2] + s[2]),
        height_at(field, v[0] + 2 * s[0], v[1] + 2 * s[1], v[2] + 2 * s[2]),
    )


@wp.func
def in_window(n: int) -> wp.vec3i:
    """Voxel n of the window around a cell, relative to the cell's first voxel."""
    return wp.vec3i((n >> 4) - 1, ((n >> 2) & 3) - 1, (n & 3) - 1)


@wp.kernel
def planes_kernel(
    first: int,
    cells: wp.array(dtype=wp.vec3i),
    field: Field,
    out_plane: wp.array2d(dtype=wp.vec4d),
    out_count: wp.array(dtype=int),
):
    """Planes that bound the body around a cell: normals and offsets, relative to the cell; -1 planes without distances.

    They are tangent planes of the sound voxels in the window, moved outwards until the balls around all voxels of the
    body there are behind them.
    """
    row = first + wp.tid()
    cell = cells[row]
    height = vec64d()
    is_known = wp.uint64(0)
    for n in range(MOST_PLANES):
        v = cell + in_window(n)
        raw = raw_at(field, v[0], v[1], v[2])
        height[n] = (raw - field.isovalue) / field.scale
        if wp.abs(raw) < field.background:
            is_known = is_known | (wp.uint64(1) << wp.uint64(n))
    center = wp.vec3d(wp.float64(0.5), wp.float64(0.5), wp.float64(0.5))
    sound = wp.uint64(0)
    sound_count = int(0)
    for n in range(MOST_PLANES):
        bit = wp.uint64(1) << wp.uint64(n)
        if (is_known & bit) != wp.uint64(0) and wp.length_sq(wp.vec3d(in_window(n)) - center) < FARTHEST_SQUARED:
            v = cell + in_window(n)
            x = slope_of(field, v, 0, height[n])
            y = slope_of(field, v, 1, height[n])
            z = slope_of(field, v, 2, height[n])
            if is_sound(x, y, z):
                normal = wp.normalize(wp.vec3d(x[0], y[0], z[0]))
                offset = wp.dot(normal, wp.vec3d(in_window(n))) - height[n]
                out_plane[row, sound_count] = wp.vec4d(normal[0], normal[1], normal[2], offset)
                sound = sound | bit
                sound_count += 1
    agreed = wp.uint64(0)
    at = int(0)
    for n in range(MOST_PLANES):
        if ((sound >> wp.uint64(n)) & wp.uint64(1)) != wp.uint64(0):
            plane = out_plane[row, at]
            place = wp.vec3d(in_window(n))
            for m in range(sound_count):
                other = out_plane[row, m]
                cosine = plane[0] * other[0] + plane[1] * other[1] + plane[2] * other[2]
                above = other[0] * place[0] + other[1] * place[1] + other[2] * place[2] - other[3]
                if m != at and cosine > LIKE_DIRECTION and wp.abs(above - height[n]) < LIKE_PLANE:
                    agreed = agreed | (wp.uint64(1) << wp.uint64(at))
                    break
            at += 1
    count = int(0)
    for k in range(sound_count):
        if ((agreed >> wp.uint64(k)) & wp.uint64(1)) != wp.uint64(0):
            plane = out_plane[row, k]
            normal = wp.vec3d(plane[0], plane[1], plane[2])
            offset = plane[3]
            for m in range(MOST_PLANES):
                if height[m] <= wp.float64(0.0) and ((is_known >> wp.uint64(m)) & wp.uint64(1)) != wp.uint64(0):
                    offset = wp.max(offset, wp.dot(normal, wp.vec3d(in_window(m))) - height[m])
            is_new = bool(True)
            for m in range(count):
                other = out_plane[row, m]
                beside = wp.vec3d(other[0], other[1], other[2])
                step = offset - other[3] - wp.dot(normal - beside, center)
                if wp.dot(normal, beside) > SAME_DIRECTION and wp.abs(step) < SAME_PLANE:
                    is_new = False
                    break
            if is_new:
                out_plane[row, count] = wp.vec4d(normal[0], normal[1], normal[2], offset)
                count += 1
    if sound_count < LEAST_SOUND:
        count = -1
    out_count[row] = count


@wp.kernel
def project_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    feet: wp.array(dtype=wp.vec3d),
    cell_of: wp.array(dtype=int),
    cells: wp.array(dtype=wp.vec3i),
    planes: wp.array2d(dtype=wp.vec4d),
    counts: wp.array(dtype=int),
    field: Field,
    out_distance: wp.array(dtype=wp.float64),
):
    """Distance [voxels] of a point from the body behind the planes around its foot.

    Where the field holds no distances it is that from the foot, less than 0 as a sign of that.

    Hildreth's method: corrections for one plane after the other, whose weights stay positive.
    """
    m = first + wp.tid()
    p = points[m]
    row = cell_of[m]
    cell = wp.vec3d(cells[row])
    x = p - cell
    weight = vec64d()
    count = counts[row]
    last = wp.float64(1.0)
    for _ in range(SWEEPS):
        if last > LAST_STEP:
            last = wp.float64(0.0)
            for n in range(count):
                plane = planes[row, n]
                normal = wp.vec3d(plane[0], plane[1], plane[2])
                step = wp.max(wp.dot(normal, x) - plane[3], -weight[n])
                weight[n] = weight[n] + step
                x -= step * normal
                last = wp.max(last, wp.abs(step))
    distance = -wp.length(feet[m] - p)
    if count >= 0:
        x += cell
        distance = wp.length(x - p)
        if wp.length(x - feet[m]) > FARTHEST_STEP or height_of(field, x) > HIGHEST_FOOT:
            distance = wp.length(feet[m] - p)
        distance = wp.max(distance, height_at(field, int(p[0]), int(p[1]), int(p[2])))
    out_distance[m] = distance


@wp.kernel
def hold_kernel(
    first: int,
    tiles: wp.array(dtype=wp.vec3i),
    nearest: wp.array(dtype=int),
    features: Features,
    field: Field,
    beyond: wp.array(dtype=wp.uint64),
    ends: wp.array(dtype=int),
    distance: wp.array(dtype=wp.float64),
    out_known: wp.array(dtype=wp.float64),
    out_held: wp.array(dtype=wp.uint64),
):
    """Holds the marked voxels of a plane with their distances.

    In fields without distances only those whose distance the mesh contradicts.
    """
    i = first + wp.tid()
    k = begin_of(ends, i)
    word = beyond[i]
    held = out_held[i]
    if word != wp.uint64(0):
        for n in range(64):
            at = (i << 6) + n
            bit = wp.uint64(1) << wp.uint64(n)
            if (word & bit) != wp.uint64(0):
                found = wp.abs(distance[k])
                is_new = distance[k] > wp.float64(0.0)
                if not is_new:
                    so_far = band_distance(out_known, out_held, nearest, features, field, tiles, at)
                    is_new = wp.abs(so_far - found) > MESH_ERROR
                if is_new:
                    out_known[at] = found * field.scale
                    held = held | bit
                k += 1
    out_held[i] = held
