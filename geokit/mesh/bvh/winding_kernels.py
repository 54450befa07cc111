"""Generalised winding numbers and the signs that follow from them.

On a CPU the wide tree is walked, eight children or triangles at a time: clusters that are far enough count by their
multipole moments, triangles nearby by their solid angles. On CUDA warp's tree of solid angles answers.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core.morton_order_kernels import prefetch_query
from geokit.mesh.bvh.bvh8_build_cpu_kernels import STACK
from geokit.mesh.bvh.bvh8_leaves_cpu_kernels import PLANE_ROWS
from geokit.mesh.bvh.bvh8_moments_kernels import MOMENT_ROWS
from geokit.mesh.bvh.tree_kernels import SurfaceTree

wp.set_module_options({"enable_backward": False})

# A cluster counts by its moments where the query is farther away than this many of its radii. The error of three
# orders falls with the fourth power or so: 0.005 at 2, 0.002 at 2.5, 0.001 at 3, which opens half as many nodes again.
OPENING = 2.5
# A sign needs much less: this opens a quarter of the nodes, and is off by 0.05 at most on simple surfaces.
OPENING_SIGN = 1.25
# Where the coarse sum is nearer to 1/2 than this, the fine one decides.
SIGN_MARGIN = 0.1
# ... widened by this times the sum of the last order's sizes, which the error of the coarse sum is about as large as:
# many surfaces on top of each other err together.
SIGN_SPREAD = 2.0
# Nearer than this many local units to a triangle (to its rectangle, in its plane), its solid angle is taken in float64:
# in float32 places are off by 4e-7, which turns the angle at an edge by up to 4e-7 / NEAR.
NEAR = 1.0e-4
# So it is where the sine and the cosine that give the angle are smaller than this, being differences of larger terms:
# close to an edge in relation to its length, and about slivers farther out. Their rounding errors are some 5e-7.
SMALL = 1.0e-3
# In the plane of a triangle, the cosine (of an angle of 0 or pi) is negative inside, and zero on its edges but for the
# rounding of its terms in float64, which this share of them covers.
ON_SURFACE = 1.0e-15
# Farther away than this many local units, all is zero to float32.
FAR = 1.0e6
# On CUDA a node of warp's tree is taken as one dipole when the query is farther away than this many of its radii. 2
# agrees with exact sums on clean, holed and overlapping meshes; 0.5 is wrong for a quarter of near points, 4 costs 2.4
# times as much.
ACCURACY = 2.0
# Nodes that wait in the order they were found, which lets the processor work on several at once; what does not fit is
# walked depth first.
QUEUE = 1024
# Leaves that wait for the nodes to be done.
LEAVES = 512

# Names that the text expects: tree, winding, p.
_WIDE = f"""
    #pragma clang fp contract(fast)
    typedef float v8 __attribute__((ext_vector_type(8), aligned(4)));
    typedef int i8 __attribute__((ext_vector_type(8), aligned(4)));
    typedef bool b8 __attribute__((ext_vector_type(8)));
    typedef wp::vec_t<3, wp::float64> point;
    auto mask_of = [](i8 lanes) {{
        return (unsigned)__builtin_bit_cast(unsigned char, __builtin_convertvector(lanes, b8));
    }};
    // Appends the chosen lanes; writes up to eight places beyond the end.
    auto append = [](int* to, i8 values, unsigned lanes) {{
        #if defined(__AVX512VL__)
        typedef int x86 __attribute__((__vector_size__(32)));
        *(i8*)to = (i8)__builtin_ia32_compresssi256_mask((x86)values, (x86)values, lanes);
        return __builtin_popcount(lanes);
        #else
        int count = 0;
        for (; lanes; lanes &= lanes - 1) to[count++] = values[__builtin_ctz(lanes)];
        return count;
        #endif
    }};
    auto total = [](const v8& v) {{
        return ((double)(v[0] + v[4]) + (v[1] + v[5])) + ((double)(v[2] + v[6]) + (v[3] + v[7]));
    }};
    const v8 zero = 0.f;
    const double q[3] = {{(p[0] - tree.origin[0]) / tree.scale, (p[1] - tree.origin[1]) / tree.scale,
                         (p[2] - tree.origin[2]) / tree.scale}};
    double size = 0.0;
    for (int k = 0; k < 3; ++k) size = wp::max(size, q[k] < 0.0 ? -q[k] : q[k]);
    const float X = (float)q[0], Y = (float)q[1], Z = (float)q[2];
    bool on_surface = false;
    // Half the solid angle of one triangle, in float64.
    auto half_angle = [&](int slot) {{
        const point* corner = tree.corners.data + 3 * slot;
        const double inverse = 1.0 / tree.scale;
        const point a = (corner[0] - p) * inverse, b = (corner[1] - p) * inverse, c = (corner[2] - p) * inverse;
        const double la = wp::length(a), lb = wp::length(b), lc = wp::length(c);
        // The edges, not the corners: from nearby they are the longer ones.
        const double volume = wp::dot(a, wp::cross(b - a, c - a));
        const double cosine = lc * (la * lb + wp::dot(a, b)) + wp::dot(b, c) * la + wp::dot(c, a) * lb;
        const float area = winding.areas.data[slot];
        if (area == 0.f) return 0.0;
        if (volume == 0.0) {{
            // In its plane. On it, both sides are equally near.
            on_surface = on_surface || cosine <= {ON_SURFACE} * (la * lb * lc);
            return 0.0;
        }}
        const double angle = wp::atan2(volume, cosine);
        return area > 0.f ? -angle : angle;
    }};
    // The sum where clusters count as far from `opening` radii on; `spread` gets the sum of the last order's sizes.
    auto walk = [&](float opening, float* spread) -> double {{
        int queue[{QUEUE} + {STACK} + 8], head = 0, tail = 1;
        int list[{LEAVES} + 16], leaves = 0;
        v8 far_sum = 0.f, last = 0.f, angles = 0.f;
        double sum = 0.0, near_angles = 0.0;
        auto sum_leaves = [&]() {{
            for (int i = 0; i < leaves; ++i) {{
                const int block = -1 - list[i];
                const v8* row = (const v8*)(tree.leaves.data + (long long)block * 8 * {PLANE_ROWS});
                const v8 dx = X - row[0], dy = Y - row[1], dz = Z - row[2];
                // In the triangle's frame its corners are (0, 0, 0), (length, 0, 0) and (cx, cy, 0).
                const v8 x = dx * row[3] + dy * row[4] + dz * row[5];
                const v8 y = dx * row[6] + dy * row[7] + dz * row[8];
                const v8 z = dx * row[9] + dy * row[10] + dz * row[11];
                const v8 length = row[12], cx = row[13], cy = row[14];
                const v8 bx = x - length, ex = x - cx, ey = y - cy, zz = z * z, yz = y * y + zz, yez = y * ey + zz;
                const v8 la = __builtin_elementwise_sqrt(x * x + yz), lb = __builtin_elementwise_sqrt(bx * bx + yz);
                const v8 lc = __builtin_elementwise_sqrt(ex * ex + ey * ey + zz);
                const v8 volume = z * *(const v8*)(winding.areas.data + 8 * block);
                const v8 lab = la * lb;
                const v8 cosine = lc * (lab + (x * bx + yz)) + (bx * ex + yez) * la + (x * ex + yez) * lb;
                // Eight arctangents of volume / cosine, by their octants; the polynomial is off by 4e-7 at most.
                const v8 rise = __builtin_elementwise_abs(volume), run = __builtin_elementwise_abs(cosine);
                const v8 more = __builtin_elementwise_max(rise, run), less = __builtin_elementwise_min(rise, run);
                const v8 t = less / more, tt = t * t;
                v8 angle = 0.00737400978f * tt - 0.0355198959f;
                angle = angle * tt + 0.0821677802f;
                angle = angle * tt - 0.133988008f;
                angle = angle * tt + 0.198618561f;
                angle = angle * tt - 0.333253948f;
                angle = angle * tt * t + t;
                angle = rise > run ? 1.57079637f - angle : angle;
                angle = cosine < zero ? 3.14159274f - angle : angle;
                angle = volume < zero ? -angle : angle;
                angle = rise > zero ? angle : zero;
                const v8 away = __builtin_elementwise_max(
                    __builtin_elementwise_max(__builtin_elementwise_abs(z), __builtin_elementwise_max(-x, bx)),
                    __builtin_elementwise_max(-y, ey));
                const i8 near = (away < {NEAR}f) | (more < {SMALL}f * lab * lc);
                unsigned mask = mask_of(near);
                if (__builtin_expect(mask, 0)) {{
                    angle = near ? zero : angle;
                    for (; mask; mask &= mask - 1) near_angles += half_angle(8 * block + __builtin_ctz(mask));
                }}
                angles += angle;
            }}
            leaves = 0;
            // Terms of one sign and as many as here leave enough digits of float32; more of them might not.
            sum += total(far_sum + angles * 0.159154943f);
            far_sum = angles = zero;
        }};
        queue[0] = 0;
        const float limit = opening * opening;
        while (head < tail) {{
            const int node = __builtin_expect(tail < {QUEUE}, 1) ? queue[head++] : queue[--tail];
            const v8* m = (const v8*)(winding.moments.data + (long long)node * 8 * {MOMENT_ROWS});
            const v8 x = X - m[0], y = Y - m[1], z = Z - m[2], xx = x * x, yy = y * y, zz = z * z, rr = xx + yy + zz;
            const i8 near = rr <= m[3] * limit;
            const v8 inverse = 1.f / rr, third = __builtin_elementwise_sqrt(inverse) * inverse;
            const v8 xz = xx - zz, yz = yy - zz, less = zz * 0.333333343f;
            const v8 first = x * m[4] + y * m[5] + z * m[6];
            const v8 second = xz * m[7] + yz * m[9] + y * (x * m[8] + z * m[11]) + x * z * m[10];
            const v8 thirds = x * ((xz - 2.f * zz) * m[12] + yz * m[14]) + y * ((yz - 2.f * zz) * m[15] + xz * m[13])
                              + z * ((xx - less) * m[16] + (yy - less) * m[18] + x * y * m[17]);
            const v8 highest = thirds * inverse * inverse;
            const v8 value = third * (first + second * inverse + highest);
            far_sum += near ? zero : value;
            if (spread) last += near ? zero : __builtin_elementwise_abs(third * highest);
            const i8 child = *(const i8*)(tree.children.data + 8 * node);
            tail += append(queue + tail, child, mask_of(near & (child > 0)));
            leaves += append(list + leaves, child, mask_of(near & (child < 0)));
            if (__builtin_expect(leaves > {LEAVES}, 0)) sum_leaves();
        }}
        sum_leaves();
        if (spread) *spread = (float)total(last);
        return sum + near_angles * 0.15915494309189535;
    }};
"""

_CUDA = """
    const wp::vec_t<3, wp::float64> q = (p - tree.origin) / tree.scale;
    const double size = wp::max(wp::max(wp::abs(q[0]), wp::abs(q[1])), wp::abs(q[2]));
"""


def _by_device(cuda: str, cpu: str) -> str:
    return f"#if defined(__CUDA_ARCH__)\n{_CUDA}{cuda}\n#else\n{_WIDE}{cpu}\n#endif\n"


_SUM_CUDA = f"wp::mesh_query_winding_number(winding.mesh, wp::vec3(q[0], q[1], q[2]), {ACCURACY}f)"
# A point at a great distance, or one that overflowed on its way here, has nothing around it.
_OUTSIDE = f"if (!(size <= wp::min(empty, {FAR}))) return 0;\n"


@wp.struct
class WindingTree:
    """What winding numbers read beside the tree of a surface; on CUDA the handle alone is filled."""

    # Handle of the warp Mesh whose faces wind as they count.
    mesh: wp.uint64
    # For each node MOMENT_ROWS rows of eight; see bvh8_moments_kernels.
    moments: wp.array(dtype=wp.float32)
    # Minus twice the signed area of the triangle in each slot.
    areas: wp.array(dtype=wp.float32)


@wp.func_native(_by_device(_OUTSIDE + f"return {_SUM_CUDA};", _OUTSIDE + f"return walk({OPENING}f, nullptr);"))
def winding_number_at(tree: SurfaceTree, winding: WindingTree, empty: wp.float64, p: wp.vec3d) -> wp.float64:
    """Winding number around the world point p.

    Outside the cube of half width ``empty`` local units it is zero exactly: 1 for a closed mesh, infinite for others.
    """
    ...


_DECIDE = (
    _OUTSIDE
    + f"""
    float spread;
    const double coarse = walk({OPENING_SIGN}f, &spread);
    if (on_surface) return false;
    const double doubt = coarse > 0.5 ? coarse - 0.5 : 0.5 - coarse;
    if (doubt > {SIGN_MARGIN} + {SIGN_SPREAD} * spread) return coarse > 0.5;
    return walk({OPENING}f, nullptr) > 0.5;
"""
)


@wp.func_native(_by_device(_OUTSIDE + f"return {_SUM_CUDA} > 0.5f;", _DECIDE))
def is_inside(tree: SurfaceTree, winding: WindingTree, empty: wp.float64, p: wp.vec3d) -> wp.bool:
    """Whether the winding number exceeds 1/2 and p is not on the surface; several times quicker than the number."""
    ...


@wp.kernel
def winding_number_kernel(
    first: int,
    order: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    winding: WindingTree,
    empty: wp.float64,
    out_winding: wp.array(dtype=wp.float64),
    out_bad: wp.array(dtype=int),
):
    """A query that is not finite has no number, and raises ``out_bad`` for the host to see which row it is."""
    prefetch_query(points, order, first + wp.tid())
    i = order[first + wp.tid()]
    p = points[i]
    if wp.isfinite(p):
        out_winding[i] = winding_number_at(tree, winding, empty, p)
    else:
        out_winding[i] = wp.float64(wp.nan)
        out_bad[0] = 1


@wp.kernel
def sign_kernel(
    first: int,
    order: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3d),
    tree: SurfaceTree,
    winding: WindingTree,
    empty: wp.float64,
    out_distance: wp.array(dtype=wp.float64),
):
    """Turns the distance of inside points negative, in place."""
    prefetch_query(points, order, first + wp.tid())
    i = order[first + wp.tid()]
    if is_inside(tree, winding, empty, points[i]):
        out_distance[i] = -out_distance[i]
