// Writes the reference of triangle i as build_bvh8_cpu.inl describes it: its local box, rounded outward, and its area.
//
// Expects core/simd.inl; i, vertices, faces, origin, scale, out_references.
#if !defined(__CUDA_ARCH__)
const int* face = faces.data + (wp::int64)3 * i;
auto corner = [&](int k) {
    const wp::vec_t<3, wp::float64>& p = vertices.data[face[k]];
    return (d4){p[0] - origin[0], p[1] - origin[1], p[2] - origin[2], 0.0};
};
const d4 a = corner(0), b = corner(1), c = corner(2);
auto least = [](const d4& p, const d4& q) { return p < q ? p : q; };
const d4 lower = least(least(a, b), c), upper = least(least(-a, -b), -c);
d8 both = __builtin_shufflevector(lower, upper, 0, 1, 2, 3, 4, 5, 6, 7);
both = both / scale;
// Within a unit in the last place below the nearest float32; the product is rounded before it is subtracted.
v8 box = __builtin_convertvector(both, v8);
const v8 slack = 1.2e-7f * __builtin_elementwise_abs(box);
box = box - slack - 1e-30f;
const v4 e = box.lo + box.hi;
box[3] = __builtin_bit_cast(float, i);
box[7] = -(e.x * e.y + e.y * e.z + e.z * e.x);
*(v8*)(out_references.data + (wp::int64)8 * i) = box;
#endif
