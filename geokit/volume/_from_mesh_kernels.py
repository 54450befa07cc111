"""A narrow band around a surface: the tiles near its triangles, unsigned distances, and signs by flooding."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.mesh._nearest_kernels import nearest_slot
from geokit.mesh._tree_kernels import SurfaceTree
from geokit.mesh._triangle_kernels import closest_on_triangle, offset_from_triangle
from geokit.mesh._wide_winding_kernels import WindingTree, is_inside

# Unrolled, the loops over voxels and sides would take half a minute to compile and gain nothing.
# Unfused, a GPU gives the same bits as a CPU, and ties between triangles fall alike.
wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

# Half the edge of the box around the 8^3 voxel centres of a tile [voxels], and half its diagonal.
TILE_HALF = wp.constant(wp.float64(3.5))
TILE_RADIUS = wp.constant(wp.float64(6.0621778264910705))


@wp.func
def tile_floor(x: wp.float64) -> int:
    return int(wp.floor(x / wp.float64(8.0)))


@wp.func
def is_near_tile(center: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, reach: wp.float64) -> bool:
    """False only if no voxel centre of the tile lies within ``reach`` of the triangle [voxels]."""
    normal = wp.cross(b - a, c - a)
    length = wp.length(normal)
    if length > wp.float64(0.0):
        extent = TILE_HALF * (wp.abs(normal[0]) + wp.abs(normal[1]) + wp.abs(normal[2])) / length
        if wp.abs(wp.dot(normal, center - a)) / length > reach + extent:
            return False
    barycentric = closest_on_triangle(center, a, b, c)
    return wp.length(offset_from_triangle(center, a, b, c, barycentric)) <= reach + TILE_RADIUS


@wp.func
def tile_center(x: int, y: int, z: int) -> wp.vec3d:
    return wp.vec3d(
        wp.float64(8 * x) + TILE_HALF,
        wp.float64(8 * y) + TILE_HALF,
        wp.float64(8 * z) + TILE_HALF,
    )


@wp.kernel
def measure_kernel(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    translation: wp.vec3d,
    voxel_size: wp.float64,
    reach: wp.float64,
    out_tiles: wp.array(dtype=wp.float64),
    out_area: wp.array(dtype=wp.float64),
):
    """Tiles in the box that a triangle reaches, as a float that cannot overflow, and its area [voxels^2]."""
    i = first + wp.tid()
    a = (vertices[faces[3 * i]] - translation) / voxel_size
    b = (vertices[faces[3 * i + 1]] - translation) / voxel_size
    c = (vertices[faces[3 * i + 2]] - translation) / voxel_size
    low = wp.min(wp.min(a, b), c)
    high = wp.max(wp.max(a, b), c)
    tiles = wp.float64(1.0)
    for k in range(3):
        first_tile = wp.floor((low[k] - reach) / wp.float64(8.0))
        tiles *= wp.floor((high[k] + reach) / wp.float64(8.0)) - first_tile + wp.float64(1.0)
    out_tiles[i] = tiles
    out_area[i] = wp.float64(0.5) * wp.length(wp.cross(b - a, c - a))


@wp.kernel
def count_tiles_kernel(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    translation: wp.vec3d,
    voxel_size: wp.float64,
    reach: wp.float64,
    out_count: wp.array(dtype=wp.int64),
):
    i = first + wp.tid()
    a = (vertices[faces[3 * i]] - translation) / voxel_size
    b = (vertices[faces[3 * i + 1]] - translation) / voxel_size
    c = (vertices[faces[3 * i + 2]] - translation) / voxel_size
    low = wp.min(wp.min(a, b), c)
    high = wp.max(wp.max(a, b), c)
    count = int(0)
    for x in range(tile_floor(low[0] - reach), tile_floor(high[0] + reach) + 1):
        for y in range(tile_floor(low[1] - reach), tile_floor(high[1] + reach) + 1):
            for z in range(tile_floor(low[2] - reach), tile_floor(high[2] + reach) + 1):
                if is_near_tile(tile_center(x, y, z), a, b, c, reach):
                    count += 1
    out_count[i] = wp.int64(count)


@wp.kernel
def fill_tiles_kernel(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    translation: wp.vec3d,
    voxel_size: wp.float64,
    reach: wp.float64,
    lowest: wp.vec3i,
    size: wp.vec3i,
    offsets: wp.array(dtype=wp.int64),
    out_key: wp.array(dtype=wp.int64),
):
    i = first + wp.tid()
    a = (vertices[faces[3 * i]] - translation) / voxel_size
    b = (vertices[faces[3 * i + 1]] - translation) / voxel_size
    c = (vertices[faces[3 * i + 2]] - translation) / voxel_size
    low = wp.min(wp.min(a, b), c)
    high = wp.max(wp.max(a, b), c)
    at = offsets[i]
    for x in range(tile_floor(low[0] - reach), tile_floor(high[0] + reach) + 1):
        for y in range(tile_floor(low[1] - reach), tile_floor(high[1] + reach) + 1):
            for z in range(tile_floor(low[2] - reach), tile_floor(high[2] + reach) + 1):
                if is_near_tile(tile_center(x, y, z), a, b, c, reach):
                    row = wp.int64(x - lowest[0]) * wp.int64(size[1]) + wp.int64(y - lowest[1])
                    out_key[at] = row * wp.int64(size[2]) + wp.int64(z - lowest[2])
                    at += wp.int64(1)


@wp.func
def voxel_position(leaf: wp.vec3i, voxel: int, translation: wp.vec3d, voxel_size: wp.float64) -> wp.vec3d:
    """World position of voxel ``64 x + 8 y + z`` of a leaf."""
    index = wp.vec3d(
        wp.float64(leaf[0] + (voxel >> 6)),
        wp.float64(leaf[1] + ((voxel >> 3) & 7)),
        wp.float64(leaf[2] + (voxel & 7)),
    )
    return index * voxel_size + translation


@wp.kernel
def band_distance_kernel(
    first: int,
    leaves: wp.array(dtype=wp.vec3i),
    translation: wp.vec3d,
    voxel_size: wp.float64,
    tree: SurfaceTree,
    background: wp.float64,
    out_distance: wp.array2d(dtype=wp.float32),
):
    """Unsigned distances of one row of eight voxels along z; ``background`` where they are not below it.

    Neighbours are one voxel apart, and so are their distances at most: what one voxel found bounds the search of the
    next.
    """
    i = first + wp.tid()
    leaf = i >> 6
    row = i & 63
    reach = background
    near = int(-1)
    for k in range(8):
        voxel = 8 * row + k
        p = voxel_position(leaves[leaf], voxel, translation, voxel_size)
        slot = nearest_slot(tree, p, reach * reach, near)
        distance = background
        if slot >= 0:
            near = slot
            a = tree.corners[3 * slot]
            b = tree.corners[3 * slot + 1]
            c = tree.corners[3 * slot + 2]
            distance = wp.length(offset_from_triangle(p, a, b, c, closest_on_triangle(p, a, b, c)))
        out_distance[leaf, voxel] = wp.float32(wp.min(distance, background))
        # A little more than one voxel: the next search must not lose its answer to rounding.
        reach = wp.min(background, distance + wp.float64(1.000001) * voxel_size)


@wp.func
def is_same_side(distance: wp.float32, neighbor: wp.float32, spacing: float) -> bool:
    """True where two voxels cannot have the surface between them: it would have to come closer to one of them."""
    return distance + neighbor > spacing


@wp.kernel
def seed_kernel(
    first: int,
    leaves: wp.array(dtype=wp.vec3i),
    translation: wp.vec3d,
    voxel_size: wp.float64,
    tree: SurfaceTree,
    winding: WindingTree,
    empty: wp.float64,
    distance: wp.array2d(dtype=wp.float32),
    out_sign: wp.array2d(dtype=wp.int8),
):
    """Asks the winding number at the voxel farthest from the surface among those without a sign, if there is one."""
    leaf = first + wp.tid()
    farthest = int(-1)
    largest = float(-1.0)
    for voxel in range(512):
        if out_sign[leaf, voxel] == wp.int8(0) and distance[leaf, voxel] > largest:
            largest = distance[leaf, voxel]
            farthest = voxel
    if farthest >= 0:
        p = voxel_position(leaves[leaf], farthest, translation, voxel_size)
        inside = is_inside(tree, winding, empty, p)
        out_sign[leaf, farthest] = wp.where(inside, wp.int8(-1), wp.int8(1))


@wp.func
def sign_across(
    distance: wp.array2d(dtype=wp.float32),
    signs: wp.array2d(dtype=wp.int8),
    leaf: int,
    voxel: int,
    neighbor_leaf: int,
    neighbor: int,
    spacing: float,
) -> wp.int8:
    """The neighbour's sign where it has one that must be this voxel's too, else 0."""
    sign = wp.int8(0)
    if neighbor_leaf >= 0:
        if is_same_side(distance[leaf, voxel], distance[neighbor_leaf, neighbor], spacing):
            sign = signs[neighbor_leaf, neighbor]
    return sign


@wp.kernel
def pull_kernel(
    first: int,
    neighbors: wp.array2d(dtype=int),
    distance: wp.array2d(dtype=wp.float32),
    spacing: float,
    signs: wp.array2d(dtype=wp.int8),
    out_sign: wp.array2d(dtype=wp.int8),
):
    """Takes signs over the six faces of each leaf from its neighbours: -x, +x, -y, +y, -z, +z."""
    leaf = first + wp.tid()
    for side in range(6):
        other = neighbors[leaf, side]
        if other >= 0:
            step = wp.where(side < 2, 64, wp.where(side < 4, 8, 1))
            for u in range(8):
                for v in range(8):
                    # The voxel of this face with the lower coordinate along the axis, and its partner beyond it.
                    low = wp.where(side < 2, 8 * u + v, wp.where(side < 4, 64 * u + v, 64 * u + 8 * v))
                    high = low + 7 * step
                    mine = wp.where((side & 1) == 0, low, high)
                    theirs = wp.where((side & 1) == 0, high, low)
                    if out_sign[leaf, mine] == wp.int8(0):
                        out_sign[leaf, mine] = sign_across(distance, signs, leaf, mine, other, theirs, spacing)


@wp.kernel
def flood_kernel(
    first: int,
    distance: wp.array2d(dtype=wp.float32),
    spacing: float,
    out_sign: wp.array2d(dtype=wp.int8),
    out_unknown: wp.array(dtype=int),
):
    """Spreads signs inside each leaf, between voxels that cannot have the surface between them, until none is added."""
    leaf = first + wp.tid()
    unknown = int(512)
    before = int(513)
    while unknown > 0 and unknown < before:
        before = unknown
        unknown = int(0)
        for n in range(512):
            # Forward and backward in turn: a sign crosses the leaf in few sweeps.
            voxel = wp.where((before & 1) == 0, n, 511 - n)
            if out_sign[leaf, voxel] == wp.int8(0):
                sign = wp.int8(0)
                for axis in range(3):
                    step = wp.where(axis == 0, 64, wp.where(axis == 1, 8, 1))
                    along = (voxel // step) & 7
                    if sign == wp.int8(0) and along > 0:
                        sign = sign_across(distance, out_sign, leaf, voxel, leaf, voxel - step, spacing)
                    if sign == wp.int8(0) and along < 7:
                        sign = sign_across(distance, out_sign, leaf, voxel, leaf, voxel + step, spacing)
                if sign == wp.int8(0):
                    unknown += 1
                else:
                    out_sign[leaf, voxel] = sign
    out_unknown[leaf] = unknown


@wp.kernel
def decide_kernel(
    first: int,
    voxels: wp.array(dtype=wp.int64),
    leaves: wp.array(dtype=wp.vec3i),
    translation: wp.vec3d,
    voxel_size: wp.float64,
    tree: SurfaceTree,
    winding: WindingTree,
    empty: wp.float64,
    out_sign: wp.array2d(dtype=wp.int8),
):
    """Asks the winding number at each of the listed voxels, ``512 leaf + voxel``."""
    i = first + wp.tid()
    leaf = int(voxels[i] / wp.int64(512))
    voxel = int(voxels[i] % wp.int64(512))
    p = voxel_position(leaves[leaf], voxel, translation, voxel_size)
    inside = is_inside(tree, winding, empty, p)
    out_sign[leaf, voxel] = wp.where(inside, wp.int8(-1), wp.int8(1))


@wp.kernel
def apply_sign_kernel(first: int, signs: wp.array2d(dtype=wp.int8), out_distance: wp.array2d(dtype=wp.float32)):
    leaf = first + wp.tid()
    for voxel in range(512):
        out_distance[leaf, voxel] *= wp.float32(signs[leaf, voxel])
