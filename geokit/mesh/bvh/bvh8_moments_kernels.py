"""Multipole moments of the wide tree's nodes: what a cluster of triangles looks like from afar.

The winding number of a cluster around a point q is ``w = -1/(4 pi) sum over l of (2l-1)!! / (l-1)! * H_l(r) /
|r|^(2l+1)``, r = q - centre: H_l is the harmonic part of the homogeneous polynomial ``S_l(v) = integral of (N . v)
(x . v)^(l-1)`` over the cluster's area, N its unit normals and x places relative to the centre (a dipole for l = 1).
Three orders are kept. A harmonic polynomial is fixed by its terms without z and with z to the first power, so that
order l costs 2l + 1 numbers: 15 in all, where the symmetric tensors have 19 and plain ones 39.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.mesh.bvh.tree_kernels import SurfaceTree

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Rows of eight in a node, a column for each child: centre 0-2, squared radius 3; x y z 4-6; xx xy yy xz yz 7-11;
# xxx xxy xyy yyy xxz xyz yyz 12-18.
MOMENT_ROWS = 19
# float64 numbers of a node that are kept until its parent is done: centre, area, radius, S_1 (3), S_2 (6), S_3 (10).
RAW_SIZE = 24
# Added to all radii: float32 moves centres and queries by a few 1e-8, and a cluster of radius zero would be a pole.
RADIUS_SLACK = 1.0e-7
# Where the centre of a child that there is not stands: far, and finite to the seventh power in float32.
NOWHERE = 1.0e5

# Names that the text expects: tree, raw, moments, areas, flipped, node.
_NODE_MOMENTS = f"""
    #pragma clang fp contract(fast)
    typedef double d8 __attribute__((ext_vector_type(8), aligned(8)));
    typedef float v8 __attribute__((ext_vector_type(8), aligned(4)));
    typedef wp::vec_t<3, wp::float64> point;
    const double inverse = 1.0 / tree.scale;
    // Products with the linear form (x, y, z) . v; the terms of polynomials go by rising powers of z, then of y.
    auto add_linear_by_linear = [](const d8* d, const d8* p, d8* out) {{
        out[0] += d[0] * p[0]; out[1] += d[0] * p[1] + d[1] * p[0]; out[2] += d[1] * p[1];
        out[3] += d[0] * p[2] + d[2] * p[0]; out[4] += d[1] * p[2] + d[2] * p[1]; out[5] += d[2] * p[2];
    }};
    auto add_linear_by_square = [](const d8* d, const d8* p, d8* out) {{
        out[0] += d[0] * p[0]; out[1] += d[0] * p[1] + d[1] * p[0]; out[2] += d[0] * p[2] + d[1] * p[1];
        out[3] += d[1] * p[2]; out[4] += d[0] * p[3] + d[2] * p[0];
        out[5] += d[0] * p[4] + d[1] * p[3] + d[2] * p[1]; out[6] += d[1] * p[4] + d[2] * p[2];
        out[7] += d[0] * p[5] + d[2] * p[3]; out[8] += d[1] * p[5] + d[2] * p[4]; out[9] += d[2] * p[5];
    }};
    auto total = [](const d8& v) {{
        return ((v[0] + v[4]) + (v[1] + v[5])) + ((v[2] + v[6]) + (v[3] + v[7]));
    }};
    auto largest = [](const d8& v) {{
        double most = v[0];
        for (int j = 1; j < 8; ++j) most = v[j] > most ? v[j] : most;
        return most;
    }};
    // Centre, area, radius and moments of the triangles of a block.
    auto of_leaf = [&](int block, double* out) {{
        double corner[9][8], sign_of[8];
        int filled = 0;
        while (filled < 8 && tree.slot_triangle.data[8 * block + filled] >= 0) ++filled;
        for (int j = 0; j < 8; ++j) {{
            // Empty slots are points at the first corner.
            const int slot = 8 * block + (j < filled ? j : 0);
            const point* from = tree.corners.data + 3 * slot;
            const bool turned = flipped.data && flipped.data[tree.slot_triangle.data[slot]];
            sign_of[j] = turned ? -0.5 : 0.5;
            for (int k = 0; k < 9; ++k) corner[k][j] = j < filled ? from[k / 3][k % 3] : from[0][k % 3];
        }}
        d8 a[3], ab[3], ac[3];
        const d8 sign = *(const d8*)sign_of;
        for (int k = 0; k < 3; ++k) {{
            const d8 first = *(const d8*)corner[k];
            a[k] = (first - tree.origin[k]) * inverse;
            ab[k] = (*(const d8*)corner[3 + k] - first) * inverse;
            ac[k] = (*(const d8*)corner[6 + k] - first) * inverse;
        }}
        d8 normal[3], centroid[3];
        for (int k = 0; k < 3; ++k) {{
            normal[k] = sign * (ab[(k + 1) % 3] * ac[(k + 2) % 3] - ab[(k + 2) % 3] * ac[(k + 1) % 3]);
            centroid[k] = a[k] + (ab[k] + ac[k]) * (1.0 / 3.0);
        }}
        const d8 area = __builtin_elementwise_sqrt(
            normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]);
        *(v8*)(areas.data + 8 * block) = __builtin_convertvector(-4.0 * sign * area, v8);
        out[3] = total(area);
        d8 squared[3] = {{0.0, 0.0, 0.0}};
        for (int k = 0; k < 3; ++k) {{
            out[k] = out[3] > 0.0 ? total(area * centroid[k]) / out[3] : total(centroid[k]) * 0.125;
            a[k] -= out[k];
            centroid[k] -= out[k];
            const d8 b = a[k] + ab[k], c = a[k] + ac[k];
            squared[0] += a[k] * a[k]; squared[1] += b * b; squared[2] += c * c;
        }}
        out[4] = __builtin_sqrt(largest(__builtin_elementwise_max(
            squared[0], __builtin_elementwise_max(squared[1], squared[2]))));
        d8 s2[6] = {{}}, s3[10] = {{}}, second[6] = {{}};
        add_linear_by_linear(centroid, normal, s2);
        // The mean of x x over a triangle is the sum over its corners and nine times its centroid, by twelve.
        for (int k = 0; k < 3; ++k) {{
            ab[k] += a[k];
            ac[k] += a[k];
            centroid[k] *= 3.0;
        }}
        add_linear_by_linear(a, a, second);
        add_linear_by_linear(ab, ab, second);
        add_linear_by_linear(ac, ac, second);
        add_linear_by_linear(centroid, centroid, second);
        add_linear_by_square(normal, second, s3);
        for (int k = 0; k < 3; ++k) out[5 + k] = total(normal[k]);
        for (int k = 0; k < 6; ++k) out[8 + k] = total(s2[k]);
        for (int k = 0; k < 10; ++k) out[14 + k] = total(s3[k]) * (1.0 / 12.0);
    }};

    double buffer[{RAW_SIZE}][8] = {{}};  // a column for each child
    unsigned present = 0;
    for (int j = 0; j < 8; ++j) {{
        const int child = tree.children.data[8 * node + j];
        if (child == 0) continue;
        present |= 1u << j;
        double own[{RAW_SIZE}];
        if (child < 0) of_leaf(-1 - child, own);
        const double* from = child < 0 ? own : raw.data + (long long)child * {RAW_SIZE};
        for (int k = 0; k < {RAW_SIZE}; ++k) buffer[k][j] = from[k];
    }}
    d8 s[{RAW_SIZE}];
    for (int k = 0; k < {RAW_SIZE}; ++k) s[k] = *(const d8*)buffer[k];
    double* out = raw.data + (long long)node * {RAW_SIZE};
    out[3] = total(s[3]);
    d8 shift[3], reach = 0.0;
    for (int k = 0; k < 3; ++k) {{
        out[k] = out[3] > 0.0 ? total(s[3] * s[k]) / out[3] : total(s[k]) / __builtin_popcount(present);
        shift[k] = s[k] - out[k];
        reach += shift[k] * shift[k];
    }}
    reach = __builtin_elementwise_sqrt(reach) + s[4];
    // No child reaches farther than its ball, nor than the far corner of its box.
    double radius = 0.0;
    const float* box = tree.boxes.data + 48 * node;
    for (int j = 0; j < 8; ++j) {{
        if (!(present >> j & 1)) continue;
        double squared = 0.0;
        for (int k = 0; k < 3; ++k) {{
            const double low = out[k] - box[8 * k + j], high = box[24 + 8 * k + j] - out[k];
            const double far = low > high ? low : high;
            squared += far * far;
        }}
        const double corner = __builtin_sqrt(squared), ball = reach[j];
        const double least = corner < ball ? corner : ball;
        radius = least > radius ? least : radius;
    }}
    out[4] = radius;
    // Moved to the common centre: S_2 gains d S_1, and S_3 gains 2 d S_2 + d d S_1.
    d8 product[6] = {{}}, s2[6], s3[10];
    add_linear_by_linear(shift, s + 5, product);
    for (int k = 0; k < 6; ++k) {{
        s2[k] = s[8 + k] + product[k];
        product[k] += 2.0 * s[8 + k];
    }}
    for (int k = 0; k < 10; ++k) s3[k] = s[14 + k];
    add_linear_by_square(shift, product, s3);
    for (int k = 0; k < 3; ++k) out[5 + k] = total(s[5 + k]);
    for (int k = 0; k < 6; ++k) out[8 + k] = total(s2[k]);
    for (int k = 0; k < 10; ++k) out[14 + k] = total(s3[k]);

    // Harmonic parts of the children's own moments, with the factors of the sum over the orders.
    const double unit = -0.25 / 3.14159265358979323846;
    float* row = moments.data + (long long)node * 8 * {MOMENT_ROWS};
    auto put = [&](int r, const d8& value) {{
        *(v8*)(row + 8 * r) = __builtin_convertvector(value, v8);
    }};
    for (int k = 0; k < 3; ++k) put(k, s[k]);
    const d8 ball = s[4] + {RADIUS_SLACK};
    put(3, ball * ball);
    for (int k = 0; k < 3; ++k) put(4 + k, unit * s[5 + k]);
    const d8 trace = (s[8] + s[10] + s[13]) * (1.0 / 3.0);
    put(7, 3.0 * unit * (s[8] - trace)); put(8, 3.0 * unit * s[9]); put(9, 3.0 * unit * (s[10] - trace));
    put(10, 3.0 * unit * s[11]); put(11, 3.0 * unit * s[12]);
    // A tenth of the Laplacian, a linear form.
    const d8 x = (3.0 * s[14] + s[16] + s[21]) * 0.2, y = (s[15] + 3.0 * s[17] + s[22]) * 0.2;
    const d8 z = (s[18] + s[20] + 3.0 * s[23]) * 0.2;
    put(12, 7.5 * unit * (s[14] - x)); put(13, 7.5 * unit * (s[15] - y)); put(14, 7.5 * unit * (s[16] - x));
    put(15, 7.5 * unit * (s[17] - y)); put(16, 7.5 * unit * (s[18] - z)); put(17, 7.5 * unit * s[19]);
    put(18, 7.5 * unit * (s[20] - z));
    for (int j = 0; j < 8; ++j)
        if (!(present >> j & 1)) {{
            row[j] = {NOWHERE}f;
            row[24 + j] = 0.f;
        }}
"""


# CUDA's compiler, which sees this file too, has no vector types.
@wp.func_native(f"#if !defined(__CUDA_ARCH__)\n{_NODE_MOMENTS}\n#endif\n;")
def node_moments(
    tree: SurfaceTree,
    flipped: wp.array(dtype=wp.bool),
    node: int,
    raw: wp.array(dtype=wp.float64),
    moments: wp.array(dtype=wp.float32),
    areas: wp.array(dtype=wp.float32),
): ...


@wp.kernel
def moments_kernel(
    first: int,
    nodes: wp.array(dtype=int),
    tree: SurfaceTree,
    flipped: wp.array(dtype=wp.bool),
    raw: wp.array(dtype=wp.float64),
    out_moments: wp.array(dtype=wp.float32),
    out_areas: wp.array(dtype=wp.float32),
):
    """Moments of the children of some nodes, whose own inner nodes must be done.

    ``flipped`` tells which triangles count as wound the other way; an array without elements means none. ``out_areas``
    gets, for each slot below these nodes, minus twice the area, its sign changed for flipped triangles.
    """
    node_moments(tree, flipped, nodes[first + wp.tid()], raw, out_moments, out_areas)
