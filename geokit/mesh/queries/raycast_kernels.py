"""First hits and occlusion of rays, without leaks."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.mesh.bvh.bvh2_raycast_cuda_kernels import BINARY_WALK
from geokit.mesh.bvh.bvh8_ray_packets_cpu_kernels import RAY_GROUPS
from geokit.mesh.bvh.bvh8_raycast_cpu_kernels import WIDE_WALK
from geokit.mesh.bvh.ray_triangle_kernels import RAY_HIT, RAY_HIT_REFINED, SHORTEST_DIRECTION
from geokit.mesh.bvh.tree_kernels import UNDECIDED, SurfaceTree

wp.set_module_options({"enable_backward": False})

# Rays are taken as they stand: putting them in order costs more than it gives, on a CPU and on a GPU.
_FETCH = """
    auto fetch = [&](int number, int& id, point& start, point& direction, double& t_max) {
        id = number;
        start = origins.data[id];
        direction = directions.data[id];
        const double largest = wp::max(wp::max(wp::abs(direction[0]), wp::abs(direction[1])), wp::abs(direction[2]));
        // A number minus itself is zero, unless it is infinite or none.
        const point none = (start - start) + (direction - direction);
        if (!(largest >= SHORTEST && none[0] + none[1] + none[2] == 0.0)) {
            // The host refuses the whole batch and says which row is to blame; until then nothing must go astray.
            out_bad.data[0] = 1;
            start = tree.origin;
            direction = point(1.0, 0.0, 0.0);
        }
        t_max = max_distance;
        if (max_distance < (double)INFINITY) t_max /= wp::length(direction);
    };
"""


def ray_walk(hit: str, on_hit: str, on_end: str, cpu_hit: str = "") -> str:
    """The text of a walk along rays: the test of a triangle, what is done with a hit, and with a ray at its end.

    A CPU takes ``cpu_hit`` for the test, where it is given.
    """
    walk = f"""
        #if defined(__CUDA_ARCH__)
        {hit}
        {_FETCH}
        const int NOTHING_WAITS = -1;
        {BINARY_WALK}
        #else
        {cpu_hit or hit}
        const int NOTHING_WAITS = 1;
        {WIDE_WALK.replace("RAY_GROUPS", RAY_GROUPS)}
        #endif
    """
    return walk.replace("ON_HIT", on_hit).replace("ON_END", on_end).replace("SHORTEST", str(SHORTEST_DIRECTION))


# Ties go to the lowest triangle: the answer must not depend on the order of the walk.
_NEARER = """
    if (t == r.best && r.winner >= 0 && tree.slot_triangle.data[slot] > tree.slot_triangle.data[r.winner]) continue;
    r.best = t;
    r.weight_b = v;
    r.weight_c = w;
    r.winner = slot;
    shorten(r);
"""
_WRITE_HIT = """
    const double none = (double)NAN;
    const bool missed = r.winner < 0;
    out_t.data[r.id] = missed ? (double)INFINITY : r.best;
    out_triangle_id.data[r.id] = missed ? -1 : tree.slot_triangle.data[r.winner];
    out_barycentric.data[r.id] = missed ? point(none, none, none)
                                        : point(1.0 - r.weight_b - r.weight_c, r.weight_b, r.weight_c);
"""
_ANY = "r.winner = slot; r.height = NOTHING_WAITS; break;"
_WRITE_ANY = "out_occluded.data[r.id] = r.winner >= 0;"


@wp.func_native(ray_walk(RAY_HIT_REFINED, _NEARER, _WRITE_HIT))
def cast_rays(
    begin: int,
    end: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    t_min: wp.float64,
    max_distance: wp.float64,
    out_t: wp.array(dtype=wp.float64),
    out_triangle_id: wp.array(dtype=int),
    out_barycentric: wp.array(dtype=wp.vec3d),
    out_bad: wp.array(dtype=int),
): ...


# A CPU has just read which triangles are slivers; a GPU would have to ask.
@wp.func_native(ray_walk(RAY_HIT, _ANY, _WRITE_ANY, RAY_HIT_REFINED))
def test_rays(
    begin: int,
    end: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    t_min: wp.float64,
    max_distance: wp.float64,
    out_occluded: wp.array(dtype=wp.bool),
    out_bad: wp.array(dtype=int),
): ...


@wp.kernel
def raycast_kernel(
    first: int,
    group: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
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
    cast_rays(
        begin,
        end,
        origins,
        directions,
        tree,
        t_min,
        max_distance,
        out_t,
        out_triangle_id,
        out_barycentric,
        out_bad,
    )


@wp.kernel
def occluded_kernel(
    first: int,
    group: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    t_min: wp.float64,
    max_distance: wp.float64,
    out_occluded: wp.array(dtype=wp.bool),
    out_bad: wp.array(dtype=int),
):
    begin = (first + wp.tid()) * group
    end = wp.min(begin + group, origins.shape[0])
    test_rays(begin, end, origins, directions, tree, t_min, max_distance, out_occluded, out_bad)


@wp.kernel
def raycast_undecided_kernel(
    first: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    t_min: wp.float64,
    max_distance: wp.float64,
    out_t: wp.array(dtype=wp.float64),
    out_triangle_id: wp.array(dtype=int),
    out_barycentric: wp.array(dtype=wp.vec3d),
    out_bad: wp.array(dtype=int),
):
    """Second pass on CUDA: the rays that the search for candidates left undecided."""
    k = first + wp.tid()
    if out_triangle_id[k] == UNDECIDED:
        cast_rays(
            k,
            k + 1,
            origins,
            directions,
            tree,
            t_min,
            max_distance,
            out_t,
            out_triangle_id,
            out_barycentric,
            out_bad,
        )
