"""All crossings of rays with a surface: their number, then their places in order."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.mesh.bvh.ray_triangle_kernels import RAY_CROSSING, REFINE
from geokit.mesh.bvh.tree_kernels import SurfaceTree
from geokit.mesh.queries.raycast_kernels import ray_walk

wp.set_module_options({"enable_backward": False})

# Of a thread on a GPU; see docs/design/layers.md.
REGISTERS = 64

_COUNT = "++r.count;"
_WRITE_COUNT = "out_count.data[r.id] = r.count;"
# Kept in order as they come, by t and then by triangle: rays have few crossings. What is within the ray's limits was
# decided before t is refined, as it was for their number.
_INSERT = """
    refine(origins.data[r.id], directions.data[r.id], slot, t, v, w);
    const int triangle = tree.slot_triangle.data[slot];
    const wp::int64 from = offsets.data[r.id];
    wp::int64 place = from + r.count++;
    for (; place > from; --place) {
        const double before = out_t.data[place - 1];
        if (before < t || (before == t && out_triangle_id.data[place - 1] < triangle)) break;
        out_t.data[place] = before;
        out_triangle_id.data[place] = out_triangle_id.data[place - 1];
        out_barycentric.data[place] = out_barycentric.data[place - 1];
    }
    out_t.data[place] = t;
    out_triangle_id.data[place] = triangle;
    out_barycentric.data[place] = point(1.0 - v - w, v, w);
"""


@wp.func_native(ray_walk(RAY_CROSSING, _COUNT, _WRITE_COUNT))
def count_crossings(
    begin: int,
    end: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    t_min: wp.float64,
    max_distance: wp.float64,
    out_count: wp.array(dtype=int),
    out_bad: wp.array(dtype=int),
): ...


@wp.func_native(ray_walk(RAY_CROSSING + REFINE, _INSERT, ""))
def list_crossings(
    begin: int,
    end: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    offsets: wp.array(dtype=wp.int64),
    tree: SurfaceTree,
    t_min: wp.float64,
    max_distance: wp.float64,
    out_t: wp.array(dtype=wp.float64),
    out_triangle_id: wp.array(dtype=int),
    out_barycentric: wp.array(dtype=wp.vec3d),
    out_bad: wp.array(dtype=int),
): ...


@wp.kernel(cuda_max_registers=REGISTERS)
def count_crossings_kernel(
    first: int,
    group: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    t_min: wp.float64,
    max_distance: wp.float64,
    out_count: wp.array(dtype=int),
    out_bad: wp.array(dtype=int),
):
    begin = (first + wp.tid()) * group
    end = wp.min(begin + group, origins.shape[0])
    count_crossings(begin, end, origins, directions, tree, t_min, max_distance, out_count, out_bad)


@wp.kernel(cuda_max_registers=REGISTERS)
def list_crossings_kernel(
    first: int,
    group: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    offsets: wp.array(dtype=wp.int64),
    tree: SurfaceTree,
    t_min: wp.float64,
    max_distance: wp.float64,
    out_t: wp.array(dtype=wp.float64),
    out_triangle_id: wp.array(dtype=int),
    out_barycentric: wp.array(dtype=wp.vec3d),
    out_bad: wp.array(dtype=int),
):
    begin = (first + wp.tid()) * group
    end = wp.min(begin + group, origins.shape[0])
    list_crossings(
        begin,
        end,
        origins,
        directions,
        offsets,
        tree,
        t_min,
        max_distance,
        out_t,
        out_triangle_id,
        out_barycentric,
        out_bad,
    )
